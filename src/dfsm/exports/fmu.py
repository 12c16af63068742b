"""A model as an FMU: for FMI 2.0 or 3.0, for model exchange, co-simulation or both.

The description is written here, the C code is that of `c_code` with functions of FMI around it;
where a C compiler is present the archive holds a binary for this system, and always the sources.
"""

from __future__ import annotations

import platform
import shutil
import subprocess
import tempfile
import uuid
import zipfile
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dfsm.core.files import check_file, write_file
from dfsm.core.settings import require
from dfsm.errors import DfsmError
from dfsm.exports.c_code import CSource, to_c
from dfsm.exports.fmu_description import Variable, build_description, model_description
from dfsm.exports.identifiers import numbers, one_line
from dfsm.models.dfsm import DFSM

Kind = Literal["model-exchange", "co-simulation"]
KINDS: tuple[Kind, ...] = ("model-exchange", "co-simulation")
# Longest step of a co-simulation in s, unless told otherwise.
_LONGEST = 0.1
# What the last output is, and what a description says of inputs between samples.
_DISTANCE = (
    "training_distance",
    "how far signals are from the training data: up to 1 inside them, where 1 is an end of a range",
)
_BETWEEN = {
    "hold": "held between samples",
    "linear": "goes along lines between samples",
    "cubic": "goes along a spline between samples",
}
# Entries of an archive have this date, so that the same model makes the same file.
_DATE = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class FMU:
    """What was written.

    Attributes
    ----------
    path
        The file.
    variables
        Name, unit, role and start value of each, in the order of the description.
    binary
        Which system the archive has a binary for; None where no compiler was there.
    computed_inputs
        Which inputs must be computed from others before they are supplied.
    notes
        These, and where hidden states start.
    """

    path: Path
    variables: tuple[Variable, ...]
    binary: str | None
    computed_inputs: tuple[str, ...]
    notes: tuple[str, ...]


def write_fmu(
    model: DFSM,
    path: str | Path,
    *,
    fmi: int = 3,
    kind: Kind | None = None,
    step: float | None = None,
) -> FMU:
    """Write a model as an FMU.

    Parameters
    ----------
    model
        Any model; terms may be functions of one's own.
    path
        File to write, ``.fmu``.
    fmi
        Version of the standard: 2 or 3.
    kind
        ``"model-exchange"``, ``"co-simulation"``, or None for both.
    step
        Longest Runge-Kutta step of a co-simulation in s, the start value of the parameter
        ``rk4_step``; None takes the step that a model with hidden states was made for, for others
        half of what the fastest eigenvalue allows, and 0.1 s at most.

    Raises
    ------
    DfsmError
        There is no such version or kind, the file has another suffix than .fmu or cannot be
        written, a compiler fails, or a term is a function with something in it that has no
        counterpart.
    """
    path = Path(path)
    require(fmi in (2, 3), "fmi", fmi, "2 or 3")
    require(kind is None or kind in KINDS, "kind", kind, " or ".join(KINDS))
    require(step is None or (np.isfinite(step) and step > 0), "step", step, "more than 0 s")
    if path.suffix.lower() != ".fmu":
        raise DfsmError(
            f"{path} has the suffix '{path.suffix}', expected .fmu, by which other programs know it"
        )
    check_file(path)
    code = to_c(model, path.stem)
    step = _safe_step(model, code.description["step"]) if step is None else float(step)
    variables = _variables(code, step)
    kinds = KINDS if kind is None else (kind,)
    source = _source(model, code, variables, fmi)
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_OID, code.source + source + str((fmi, kinds)))}}}"
    source = source.replace("THE_TOKEN", token)
    description = model_description(code.name, token, fmi, kinds, variables, step)
    files: dict[str, bytes] = {
        "modelDescription.xml": description,
        f"sources/{code.name}.c": code.source.encode(),
        f"sources/{code.name}.h": code.header.encode(),
        "sources/fmu.c": source.encode(),
    }
    if fmi == 3:
        files["sources/buildDescription.xml"] = build_description(code.name)
    binary = compiled(files, code.name, fmi)
    files |= dict([binary] if binary is not None else [])
    with write_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _DATE)
            archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
    where = None if binary is None else binary[0].split("/")[1]
    told = code.description
    return FMU(path, variables, where, tuple(told["computed_inputs"]), tuple(told["notes"]))


def _safe_step(model: DFSM, longest: float | None) -> float:
    """The model's own step, or half of the longest one that is stable."""
    if longest is not None and model.signals.step is not None:
        return longest
    return _LONGEST if longest is None else min(_LONGEST, 0.5 * longest)


def _variables(code: CSource, step: float) -> tuple[Variable, ...]:
    """All variables in the order of their value references."""
    told, turn = code.description, code.description.get("azimuth")
    rows: list[tuple[str, str, float | None, str, str, bool]]
    rows = [("time", "s", 0.0, "independent", "", False)]
    latent = f"latent state, start value: {told['latent_starts']}"
    for e in told["states"]:
        note = latent if e["name"] in told["latent_states"] else "state"
        rows.append((e["name"], e["unit"], e["start"], "state", _said(note, e), False))
    if turn is not None:
        rows.append(("azimuth", "rad", 0.0, "state", "state: the azimuth of the rotor", False))
    states = rows[1:]
    for name, unit, *_ in states:
        rows.append((f"der({name})", f"{unit}/s" if unit else "1/s", None, "derivative", "", False))
    for group in ("controls", "disturbances", "field"):
        for e in told[group]:
            note, start = _said(group.removesuffix("s"), e), e.get("start", 0.0)
            moves = e.get("between_samples", "hold") != "hold"
            rows.append((e["name"], e["unit"], start, "input", note, moves))
    for e in told["parameters"]:
        rows.append((e["name"], e["unit"], e["start"], "parameter", _said("", e), False))
    note = "longest Runge-Kutta step of a co-simulation"
    rows.append(("rk4_step", "s", step, "parameter", note, False))
    rows += [(e["name"], e["unit"], None, "output", "", False) for e in told["outputs"]]
    rows.append((_DISTANCE[0], "", None, "output", _DISTANCE[1], False))
    variables, taken = list[Variable](), set[str]()
    for reference, (name, unit, start, role, note, moves) in enumerate(rows):
        plain = wanted = one_line(name) or "unnamed"
        count = 1
        while plain in taken:
            count += 1
            plain = f"{wanted}_{count}"
        taken.add(plain)
        of = reference - len(states) if role == "derivative" else None
        shown = (start, role, one_line(note), reference, of, moves)
        variables.append(Variable(plain, one_line(unit), *shown))
    return tuple(variables)


def _said(what: str, entry: dict[str, Any]) -> str:
    """What a variable is, what it does between samples, and its training range."""
    between = _BETWEEN.get(entry.get("between_samples", ""))
    parts = [entry.get("computed", what), between]
    if "trained" in entry:
        low, high = entry["trained"]
        parts.append(f"trained from {low:.6g} to {high:.6g}")
    return ", ".join(part for part in parts if part)


def _source(model: DFSM, code: CSource, variables: tuple[Variable, ...], fmi: int) -> str:
    """The file that gives the model the functions of FMI."""
    told, turn, name = code.description, code.description.get("azimuth"), code.name
    count = len(told["states"]) + (turn is not None)
    spread = np.asarray(model.region.scale)[model.signals.state_columns]
    nominal = [float(v) for v in spread] + [1.0] * (turn is not None)
    lines = [f'#include "{name}.h"', f"#define COUNT__STATES {count}"]
    for group in ("controls", "disturbances", "field", "parameters", "outputs"):
        lines.append(f"#define COUNT__{group.upper()} {len(told[group])}")
    lines.append(f"#define MODEL_DERIVATIVE {name}_derivative")
    lines.append(f"#define MODEL_OUTPUT {name}_output{'_at_azimuth' if turn else ''}")
    lines.append(f"#define MODEL_DISTANCE {name}_distance")
    lines.append(f"#define TURNS {int(turn is not None)}")
    if turn is not None:
        speed = [e["name"] for e in told["states"]].index(turn["speed"])
        lines += [f"#define SPEED {speed}", f"#define RADIANS {turn['rad/s']!r}"]
    lines.append('#define MODEL_TOKEN "THE_TOKEN"')
    starts = [0.0 if v.start is None else v.start for v in variables]
    lines.append("static " + numbers("start_values", starts))
    lines.append("static " + numbers("nominal_values", nominal))
    moves = ", ".join(str(int(v.moves)) for v in variables if v.role == "input") or "0"
    lines.append(f"static const int moves_within[] = {{{moves}}};")
    folder = resources.files("dfsm.exports").joinpath("sources")
    files = ("instance.h", f"fmi{fmi}.c", "fmi.c")
    parts = [folder.joinpath(f).read_text(encoding="ascii") for f in files]
    return "\n".join([*lines, *parts])


def compiled(files: dict[str, bytes], name: str, fmi: int) -> tuple[str, bytes] | None:
    """Name in the archive and content of the binary for this system; None without a compiler."""
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    system, machine = platform.system(), platform.machine().lower()
    endings = {"Linux": ("linux64", "linux", "so"), "Darwin": ("darwin64", "darwin", "dylib")}
    if compiler is None or system not in endings:
        return None
    old, new, ending = endings[system]
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    where = old if fmi == 2 else f"{machine}-{new}"
    with tempfile.TemporaryDirectory() as folder:
        for path, content in files.items():
            if path.startswith("sources/"):
                (Path(folder) / Path(path).name).write_bytes(content)
        target = Path(folder) / f"{name}.{ending}"
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden", "-o", str(target)]
        command = [compiler, *options, f"{name}.c", "fmu.c", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise DfsmError(
                f"the C compiler '{compiler}' failed on the model's code "
                f"({done.stderr.strip().splitlines()[:1]}): try another one, or none at all"
            )
        return f"binaries/{where}/{name}.{ending}", target.read_bytes()
