"""A model as one file of C99 and its header, without dependencies but for the C library."""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from dfsm.core.files import check_folder, visible, write_folder
from dfsm.core.version import __version__
from dfsm.exports.casadi_model import c_functions
from dfsm.exports.functions import GROUPS, RESULTS, description
from dfsm.exports.identifiers import comment, identifier, numbers, strings
from dfsm.models.dfsm import DFSM

_MARK = "/* Made by dfsm"
_GROUPS = (*GROUPS, "outputs", "field")
# What functions are called that CasADi writes under a short name.
_LONG = {
    "f": "derivative",
    "g": "output",
    "g_at_azimuth": "output_at_azimuth",
    "d": "distance",
}
# What inputs do between samples, as numbers.
_BETWEEN = ("hold", "linear", "cubic")


@dataclass(frozen=True)
class CSource:
    """Two files.

    Attributes
    ----------
    name
        Prefix of everything that the files define, and their name.
    header, source
        What stands in ``<name>.h`` and ``<name>.c``.
    description
        Names, units and start values, see `CasadiModel`.
    """

    name: str
    header: str
    source: str
    description: dict[str, Any]


def to_c(model: DFSM, name: str = "model") -> CSource:
    """Write a model down in C99.

    Parameters
    ----------
    model
        Any model; terms may be functions of one's own.
    name
        Prefix of all names in C; what C cannot have in a name becomes an underscore.

    Returns
    -------
    CSource
        ``<name>_derivative`` and ``<name>_output``, which equal `DFSM.derivative` and
        `DFSM.output` up to rounding, ``<name>_step``, one step of RK4, ``<name>_simulate``, a
        rollout as `simulate` does it, ``<name>_distance``, how far from the training data a point
        is, and names, units, start values and training ranges as arrays.

    Raises
    ------
    DfsmError
        A term is a function with something in it that has no counterpart; names both.
    """
    name = identifier(name)
    code, sizes = c_functions(model, name)
    told = description(model)
    turning = "g_at_azimuth" in sizes
    header = _header(name, told, turning=turning)
    parts = [f'{_first(name)}\n#include "{name}.h"\n#include <stdlib.h>\n', code]
    parts += [_arrays(name, told), *(_call(name, short, size) for short, size in sizes.items())]
    rollout = resources.files("dfsm.exports").joinpath("sources", "rollout.c")
    parts.append(_named(rollout.read_text(encoding="ascii"), name))
    return CSource(name, header, "\n".join(parts), told)


def _named(text: str, name: str) -> str:
    """C code with the model's name for NAME, and its capitals for UPPER."""
    names = {"NAME": name, "UPPER": name.upper()}
    return re.sub("NAME|UPPER", lambda found: names[found[0]], text)


def write_c(model: DFSM, path: str | Path, name: str | None = None) -> CSource:
    """Write ``<name>.c`` and ``<name>.h`` into a folder.

    Parameters
    ----------
    model
        See `to_c`.
    path
        Folder to make; one that dfsm wrote such files into is replaced.
    name
        See `to_c`; None takes the folder's.

    Raises
    ------
    DfsmError
        The folder holds something else or cannot be written, and as for `to_c`.
    """
    path = Path(path)
    check_folder(path, is_ours=_is_ours)
    made = to_c(model, path.resolve().name if name is None else name)
    with write_folder(path, is_ours=_is_ours) as folder:
        (folder / f"{made.name}.h").write_text(made.header, encoding="ascii")
        (folder / f"{made.name}.c").write_text(made.source, encoding="ascii")
    return made


def _is_ours(path: Path) -> bool:
    names = visible(path)
    if sorted(Path(n).suffix for n in names) != [".c", ".h"]:
        return False
    return all((path / n).read_bytes().startswith(_MARK.encode()) for n in names)


def _first(name: str) -> str:
    return f"{_MARK} {__version__}: the model {name}, C99. */"


def _header(name: str, told: dict[str, Any], *, turning: bool) -> str:
    upper = name.upper()
    lines = [_first(name), f"#ifndef {upper}_H", f"#define {upper}_H", ""]
    lines += [f"#define {upper}_{g.upper()} {len(told[g])}" for g in _GROUPS]
    lines += ["", "/*", *_vectors(told), "*/", ""]
    lines += ["#ifdef __cplusplus", 'extern "C" {', "#endif", ""]
    for group in _GROUPS:
        lines += [f"extern const char *const {name}_{group}_names[];"]
        lines += [f"extern const char *const {name}_{group}_units[];"]
    for what in ("starts", "low", "high"):
        lines += [f"extern const double {name}_{g}_{what}[];" for g in GROUPS]
    lines += [f"extern const double {name}_longest_step; /* in s; 0 where nothing limits it */"]
    functions = _DECLARATIONS + (_TURNING if turning else "")
    lines += [_named(functions, name), "#ifdef __cplusplus", "}", "#endif", "#endif", ""]
    return "\n".join(lines)


def _vectors(told: dict[str, Any]) -> list[str]:
    """What the elements of all vectors are, as lines of a comment."""
    lines = list[str]()
    for group in _GROUPS:
        if told[group]:
            lines.append(f"{group}:")
        for k, entry in enumerate(told[group]):
            unit = f" ({comment(entry['unit'])})" if entry["unit"] else ""
            kind = entry.get("between_samples")
            between = f", {kind} between samples" if kind else ""
            low, high = entry.get("trained", (None, None))
            trained = "" if low is None else f", trained from {low:.6g} to {high:.6g}"
            lines.append(f"  [{k}] {comment(entry['name'])}{unit}{between}{trained}")
    if told["latent_states"]:
        names = comment(", ".join(told["latent_states"]))
        lines += textwrap.wrap(
            f"Nobody measures {names}; start values: {told['latent_starts']}", 96
        )
    if told["step"] is not None:
        lines.append(f"Longest step: {told['step']:.6g} s.")
    for sentence in told["computed_inputs"]:
        lines += textwrap.wrap(comment(sentence), 96)
    return lines


def _arrays(name: str, told: dict[str, Any]) -> str:
    parts = list[str]()
    for group in _GROUPS:
        parts.append(strings(f"{name}_{group}_names", [e["name"] for e in told[group]]))
        parts.append(strings(f"{name}_{group}_units", [e["unit"] for e in told[group]]))
    for g in GROUPS:
        parts.append(numbers(f"{name}_{g}_starts", [e["start"] for e in told[g]]))
        for k, end in enumerate(("low", "high")):
            parts.append(numbers(f"{name}_{g}_{end}", [e["trained"][k] for e in told[g]]))
    parts.append(f"const double {name}_longest_step = {float(told['step'] or 0.0)!r};\n")
    kinds = [e["between_samples"] for g in ("controls", "disturbances") for e in told[g]]
    places = ", ".join(str(_BETWEEN.index(kind)) for kind in kinds) or "0"
    parts.append(f"static const int {name}_between[] = {{{places}}};\n")
    return "".join(parts)


def _call(name: str, short: str, sizes: tuple[int, int, int, int]) -> str:
    """The function with plain arguments around the one that CasADi wrote."""
    arg, res, iw, w = (max(1, s) for s in sizes)
    turning = short == "g_at_azimuth"
    long, result = _LONG[short], RESULTS[short]
    more = ", double azimuth, const double *field" if turning else ""
    given = ", &azimuth, field" if turning else ""
    return f"""int {name}_{long}(const double *states, const double *controls,
    const double *disturbances, const double *parameters{more}, double *{result}) {{
  const double *arg[{arg}] = {{states, controls, disturbances, parameters{given}}};
  double *res[{res}] = {{{result}}};
  casadi_int iw[{iw}];
  double w[{w}];
  return {name}_{short}(arg, res, iw, w, 0);
}}
"""


_DECLARATIONS = """
/* Derivatives of the states per second. All functions return 0; vectors without elements may be
   null pointers. */
int NAME_derivative(const double *states, const double *controls, const double *disturbances,
    const double *parameters, double *derivatives);

/* Outputs; of a model with blade-passing harmonics their average over a revolution. */
int NAME_output(const double *states, const double *controls, const double *disturbances,
    const double *parameters, double *outputs);

/* One classical Runge-Kutta step of so many seconds. Controls and disturbances go along straight
   lines from their values at its start to those at its end; give one that is held twice. `next`
   may be `states`. */
int NAME_step(double seconds, const double *states,
    const double *controls_start, const double *disturbances_start,
    const double *controls_end, const double *disturbances_end,
    const double *parameters, double *next);

/* States at many times in s, one row each, of which the first is given. Inputs, one row per time,
   are held, or go along lines or splines between two, as told above; intervals are divided where
   the longest step is shorter. Returns 2 where times go back, or splines have fewer than four or
   two at one instant, and 3 without memory. */
int NAME_simulate(int samples, const double *time, const double *controls,
    const double *disturbances, const double *parameters, double *states);

/* How far from the training data: up to 1 inside them. Each signal is seen against its range, of
   which the middle is 0 and both ends are 1, and all together against what occurred together. */
int NAME_distance(const double *states, const double *controls, const double *disturbances,
    const double *parameters, double *distance);
"""
_TURNING = """
/* Outputs at an azimuth in rad, in a wind field with these harmonics. */
int NAME_output_at_azimuth(const double *states, const double *controls,
    const double *disturbances, const double *parameters, double azimuth, const double *field,
    double *outputs);
"""
