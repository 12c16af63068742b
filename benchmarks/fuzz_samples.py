"""Small inputs of every kind that dfsm reads, for `fuzz` to damage."""

from __future__ import annotations

import hashlib
import json
import runpy
import shutil
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save
from scipy.io import savemat

from benchmarks.outb import outb_bytes
from dfsm.config.control import ControlConfig
from dfsm.config.fit import parse_candidates, parse_config
from dfsm.config.parse import parse_file
from dfsm.config.sweep import load_sweep
from dfsm.config.tune import load_tuning
from dfsm.control.solution_folder import load_solution, save_solution
from dfsm.controllers.rosco import read_rosco
from dfsm.core.bundle import MANIFEST, checksum, signed
from dfsm.core.files import json_bytes
from dfsm.core.types import Array
from dfsm.data.readers import read, with_wall_times
from dfsm.data.readers.rotor_table import read_rotor_table
from dfsm.data.readers.tables import write_table
from dfsm.data.readers.turbsim import read_turbsim
from dfsm.data.readers.uniform import UniformSettings, read_uniform
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.models.model_folder import load_all
from dfsm.models.model_folder import save as save_model
from dfsm.selection.compare import _read as read_result
from dfsm.validation.intervals import Intervals, load_intervals

# A model and a solution of version 0.1; they are read, and written as this version does.
_SAVED = Path(__file__).parents[1] / "tests" / "data" / "saved_by_0.1"


@dataclass(frozen=True)
class Sample:
    """An input.

    Attributes
    ----------
    name
        Of the kind.
    raw
        What is damaged.
    put
        Writes damaged bytes into a folder; returns what is read.
    read
        Reads it and returns all that it says.
    told
        What the undamaged input says.
    checked
        Whether a checksum or a size tells every change.
    signed
        Turns another tree of JSON into an input whose checksum holds; None where there is none.
    """

    name: str
    raw: bytes
    put: Callable[[bytes, Path], Path]
    read: Callable[[Path], Any]
    told: Any
    checked: bool
    signed: Callable[[Any], bytes] | None = None

    def is_signed(self, raw: bytes) -> bool:
        """Whether the checksum in damaged JSON holds, or whether it has none."""
        try:
            tree = json.loads(raw)
            return bool(tree["checksum"] == checksum(tree))
        except (ValueError, TypeError, KeyError, RecursionError):
            return False


def samples(folder: Path, kind: str | None = None) -> dict[str, Sample]:
    """One input per kind, made in a folder; where one kind is named, perhaps not all."""
    made = [*_tables(folder), *_texts(folder), *_loops(folder)]
    # These take longest to make.
    if kind is None or kind.startswith(("model", "solution")):
        made += _folders(folder)
    return {sample.name: sample for sample in made}


# -- runs and fields ------------------------------------------------------------------------------


def _run() -> Trajectory:
    time = 0.05 * np.arange(60)
    values = np.stack([np.sin(time), 0.01 * np.rint(100 * np.cos(time)), time**2], axis=1)
    channels = (Channel("q", "m"), Channel("w", "m/s", 0.01), Channel("y", "kN"))
    return Trajectory(time, values, channels, name="r", wall_time=2.0, notes=("noted",))


def _tables(folder: Path) -> list[Sample]:
    run = _run()
    found = []
    for name, packed in (("run.csv", False), ("run.parquet", False), ("packed.parquet", True)):
        write_table(run, folder / name, packed=packed)
        kept = name.endswith("parquet")
        found.append(_file(name, (folder / name).read_bytes(), _said, folder, checked=kept))
    found.append(_file("run.out", _out(run), _said, folder))
    units = [c.unit for c in run.channels]
    outb = outb_bytes(run.time, run.values, run.names, units)
    for name, raw in (("run.outb", outb), ("run.lvm", _lvm(run)), ("toa5.csv", _toa5(run))):
        found.append(_file(name, raw, _said, folder))
    found.append(_file("commas.csv", _commas(run), _said, folder))
    found.append(_file("field.bts", wind_field(), _wind, folder))
    found.append(_file("gust.wnd", _GUST, _uniform, folder))
    found.append(_bladed(run, folder))
    found.append(_hawc2(run, folder))
    savemat(folder / "run.mat", {"time": run.time, **{n: run[n] for n in run.names}})
    found.append(_file("run.mat", (folder / "run.mat").read_bytes(), _said, folder))
    found.append(_file("rotor.txt", _rotor(), lambda p: read_rotor_table(p).cp.tolist(), folder))
    return found


def _said(path: Path) -> Any:
    run = read(path)
    return run.digest, run.channels, run.notes, run.wall_time


def _wind(path: Path) -> Any:
    field = read_turbsim(path)
    return field.mean_wind, [block.sum() for block in field.blocks()]


_GUST = b"""! Time Speed Dir Vert HShr VShr VLin Gust
0.0  8.0   0.0 0.0 0.0 0.2 0.00 0.0
5.0 10.0   1.0 0.0 0.1 0.2 0.05 2.0
9.0 12.0 359.0 0.1 0.1 0.1 0.05 0.0
"""


def _uniform(path: Path) -> Any:
    wind = read_uniform(path, UniformSettings(hub_height=90.0))
    return [block.sum() for block in wind.over(np.arange(4.0), 50.0).blocks()]


def _bladed(run: Trajectory, folder: Path) -> Sample:
    """A header of Bladed, with samples beside it that stay as they are."""
    head = ["ACCESS D", "FORM U", "RECL 4", "FORMAT R*8", "NDIMENS 3", f"DIMENS 1 3 {len(run)}"]
    head += ["GENLAB 'Tower'", "VARIAB 'Tower My'", "VARUNIT FL", "AXISLAB 'Height'", "AXIUNIT L"]
    head += ["AXIMETH 3", "AXIVAL 0.0", " 20.5 87.25", "AXISLAB 'Time'", "AXIUNIT T", "AXIMETH 2"]
    head += ["MIN 0.0", "STEP 5.0000001E-002", "NVARS 0", ""]

    def put(damaged: bytes, where: Path) -> Path:
        run.values.astype("<f8").tofile(where / "damaged.$25")
        path = where / "damaged.%25"
        path.write_bytes(damaged)
        return path

    raw = "\r\n".join(head).encode()
    return Sample("run.%25", raw, put, _said, _said(put(raw, folder)), checked=False)


def _hawc2(run: Trajectory, folder: Path) -> Sample:
    """A .sel of HAWC2, with binary samples beside it that stay as they are."""
    table = np.column_stack([run.time, run.values])
    scales = np.abs(table).max(axis=0) / 32000
    head = ["Version ID : HAWC2 12.9", "Time : 10:00", "Date : 1", "Result file : a.dat", "", ""]
    head += ["Scans Channels Time Format", f"{len(run)} 4 {0.05 * len(run):.3f} BINARY", "", "", ""]
    for k, (name, unit) in enumerate([("Time", "s"), *((c.name, c.unit) for c in run.channels)]):
        head.append(f"{k + 1:>7}     {name:<31}{unit:<11}{name} of a run")
    head += ["Scale factors:", *(f"{s:.5E}" for s in scales), ""]

    def put(damaged: bytes, where: Path) -> Path:
        np.rint(table / scales).T.astype("<i2").tofile(where / "damaged.dat")
        path = where / "damaged.sel"
        path.write_bytes(damaged)
        return path

    raw = "\r\n".join(head).encode()
    return Sample("run.sel", raw, put, _said, _said(put(raw, folder)), checked=False)


def _out(run: Trajectory) -> bytes:
    lines = ["", "Predictions were generated by hand", "", "made for damage", "", ""]
    lines.append("\t".join(["Time", *run.names]))
    lines.append("\t".join(["(s)", *(f"({c.unit})" for c in run.channels)]))
    table = np.column_stack([run.time, run.values])
    lines += ["\t".join(f"{v:.4E}" for v in row) for row in table]
    return "\n".join([*lines, ""]).encode()


def _lvm(run: Trajectory) -> bytes:
    """Two segments of LabVIEW that follow one another by their times, with decimal commas."""
    lines = ["LabVIEW Measurement", "Separator\tTab", "Decimal_Separator\t,", "X_Columns\tNo"]
    lines += ["***End_of_Header***", ""]
    for first, clock in ((0, "10:00:00,5"), (30, "10:00:02,0")):
        told = {"Date": "2020/01/02", "Time": clock, "X0": "0,0E+0", "Delta_X": "0,05"}
        lines += ["Channels\t3", *("\t".join([tag, *[v] * 3]) for tag, v in told.items())]
        lines.append("\t".join(["Y_Unit_Label", *(c.unit for c in run.channels)]))
        lines += ["***End_of_Header***", "\t".join(["X_Value", *run.names, "Comment"])]
        lines += _rows(run.values[first : first + 30], "\t", "\t")
    return "\n".join([*lines, ""]).encode()


def _commas(run: Trajectory) -> bytes:
    """A table as spreadsheets write it where commas are decimal, with points between thousands."""
    units = (f"{c.name} [{c.unit}]" for c in run.channels)
    table = np.column_stack([run.time, 1e4 * run.values])
    return "\n".join(["Zeit [s];" + ";".join(units), *_rows(table, ";"), ""]).encode()


def _rows(table: Array, separator: str, before: str = "") -> list[str]:
    points = str.maketrans(",.", ".,")
    return [before + separator.join(f"{v:,.4f}" for v in row).translate(points) for row in table]


def _toa5(run: Trajectory) -> bytes:
    """A table of Campbell's loggers."""
    lines = [
        '"TOA5","Mast","CR1000","1","Std","CPU","2","Fast"',
        '"TIMESTAMP","RECORD","q","w","y"',
    ]
    lines += ['"TS","RN","m","m/s","kN"', '"","","Smp","Smp","Smp"']
    for k, (t, row) in enumerate(zip(run.time, run.values, strict=True)):
        lines.append(f'"2020-01-02 10:00:0{t:.4g}",{k},' + ",".join(f"{v:.5g}" for v in row))
    return "\n".join([*lines, ""]).encode()


def wind_field(points: int = 4) -> bytes:
    """A small TurbSim field, 30 m wide and high, of so many points in either direction."""
    codes = np.random.default_rng(0).integers(-3000, 3000, (40, 3 * points**2)).astype("<i2")
    head, apart = struct.pack("<h4i", 7, points, points, 0, 40), 30 / (points - 1)
    head += struct.pack("<6f", apart, apart, 0.1, 10.0, 90.0, 75.0)
    head += struct.pack("<6fi", 1000.0, -10000.0, 1000.0, 0.0, 1000.0, 0.0, 4) + b"made"
    return head + codes.tobytes()


def _rotor() -> bytes:
    pitch, ratio = np.linspace(-2, 20, 8), np.linspace(2, 14, 9)
    cp = 0.45 * np.exp(-(((ratio[:, None] - 8) / 4) ** 2) - (pitch / 12) ** 2)
    tables = {"Power": cp, "Thrust": 0.8 * cp / 0.45 + 0.05, "Torque": cp / ratio[:, None]}
    lines = ["# Pitch angle vector - x axis (matrix columns) (deg)", _numbers(pitch)]
    lines += ["# TSR vector - y axis (matrix rows) (-)", _numbers(ratio)]
    lines += ["# Wind speed vector - z axis (m/s)", "11.0", ""]
    for name, table in tables.items():
        lines += [f"# {name} coefficient", "", *map(_numbers, table), "", ""]
    return "\n".join(lines).encode()


def _numbers(values: Array) -> str:
    return "  ".join(f"{v:.6f}" for v in values)


# -- texts ----------------------------------------------------------------------------------------

_CONFIG = """\
data: {train: [a.csv, "b*.parquet"], start: 1.0, stop: null}
signals:
  states: [{name: q, order: 2}]
  controls: [u]
  disturbances: &w [w, w_rate]
  features: [{kind: rate, source: w}]
  outputs: [y]
linear: {kind: LPV, schedule: w, points: 3, known: {q_dot: {u: 0.5}}}
terms: [{kind: quadratic_drag, velocity: q_dot}, {kind: product, factors: [u, w]}]
corrective: {kind: rbf, samples: 25}
refine: {iterations: 3}
azimuth: {speed: q_dot, blades: 3}
seed: 0x1F
compare:
  candidates: {gp: {corrective: {kind: gp}}, lti: {linear: {kind: LTI}}}
"""
_PROBLEM = """\
model: m
horizon: [0, 10]
disturbances: run.csv
cost: [{weight: -1.0, value: y}, {weight: 1e-3, track: q, reference: 0.2}]
bounds: {u: [-1, 1], q: [null, 3.0]}
rates: {u: [-0.5, 0.5]}
nodes: 51
"""


def _texts(folder: Path) -> list[Sample]:
    times = json.dumps({"r": 12.0, "s": 3}).encode()
    half = np.array([[0.1, 0.2], [0.3, 0.4]])
    intervals = Intervals(("q", "y"), ("m", "kN"), "w", np.array([6.0, 12.0]), half, 0.9, (), ())
    intervals.save(folder / "intervals.json")
    result = {
        "format": 2,
        "outcome": {"message": "", "nrmse": {"q": 0.2}, "diverged": 0, "fit_seconds": 1.0},
        "model": "0" * 64,
        "fingerprint": "1" * 64,
        "changes": "seed = 1",
    }
    return [
        _file("config.yaml", _CONFIG.encode(), _config, folder),
        _file("problem.yaml", _PROBLEM.encode(), _problem, folder),
        _file("times.json", times, lambda p: with_wall_times([_run()], p)[0].wall_time, folder),
        _file(
            "intervals.json",
            (folder / "intervals.json").read_bytes(),
            lambda p: repr(load_intervals(p)),
            folder,
            checked=True,
            sign=_signed,
        ),
        _file("result.json", json_bytes(signed(result)), _result, folder, True, _signed),
    ]


# -- closed loops ---------------------------------------------------------------------------------

_LOOPS = """\
model: m
controller: DISCON.IN
runs: ["runs/*.outb"]
"""
_TUNE = """\
parameters: {omega_pc: [0.12, 0.35], Kp_float: [-14.0, -4.0]}
objective: [{measure: damage, channel: y, exponent: 4}, {measure: std, channel: q, weight: 0.5}]
"""
_SWEEP = "weights: {mean: 9.5}\ngains: {omega_pc: [0.15, 0.2]}\npower: P\nextremes: [y]\n"


def _loops(folder: Path) -> list[Sample]:
    """What closed loops are asked for with: the rotor's table of the deck stays as it is."""
    path = Path(__file__).parents[1] / "tests" / "decks.py"
    deck = runpy.run_path(str(path))["write_deck"](folder).read_bytes()
    return [
        _file("deck.IN", deck, lambda p: repr(read_rosco(p, interval=0.05).parameters), folder),
        _file("tune.yaml", (_LOOPS + _TUNE).encode(), lambda p: repr(load_tuning(p)), folder),
        _file("sweep.yaml", (_LOOPS + _SWEEP).encode(), lambda p: repr(load_sweep(p)), folder),
    ]


def _config(path: Path) -> Any:
    parse_config(path).fit_settings()
    return repr(parse_candidates(path))


def _problem(path: Path) -> Any:
    return repr(parse_file(path, ControlConfig, "write one"))


def _result(path: Path) -> Any:
    content = read_result(path)
    if content is None:
        raise DfsmError("no result of a comparison")
    return repr(content)


def _signed(tree: Any) -> bytes:
    return json_bytes(signed(tree) if isinstance(tree, dict) else tree)


def _file(
    name: str,
    raw: bytes,
    reader: Callable[[Path], Any],
    folder: Path,
    checked: bool = False,
    sign: Callable[[Any], bytes] | None = None,
) -> Sample:
    def put(damaged: bytes, where: Path) -> Path:
        path = where / f"damaged{Path(name).suffix}"
        path.write_bytes(damaged)
        return path

    return Sample(name, raw, put, reader, reader(put(raw, folder)), checked, sign)


# -- folders --------------------------------------------------------------------------------------


def _folders(folder: Path) -> list[Sample]:
    models = load_all(_SAVED / "model")
    save_model(models["multi-fidelity"], folder / "model", models["nonlinear-only"])
    save_solution(load_solution(_SAVED / "solution"), folder / "solution")
    found = []
    for name, reader in (("model", _model), ("solution", _solution)):
        source = folder / name
        (arrays,) = source.glob("*.safetensors")
        manifest = source / MANIFEST
        told = reader(source)
        parts: tuple[tuple[str, Path, Any], ...] = (
            ("manifest", manifest, _signed),
            ("arrays", arrays, None),
        )
        for part, file, sign in parts:
            put = _replacing(source, file.name)
            found.append(Sample(f"{name} {part}", file.read_bytes(), put, reader, told, True, sign))
        tensors = load_file(arrays)
        shapes = {key: [*value.shape, str(value.dtype)] for key, value in tensors.items()}
        put, raw = _reshaping(source, arrays.name, tensors), json_bytes(shapes)
        found.append(Sample(f"{name} shapes", raw, put, reader, told, False, json_bytes))
    return found


def _model(path: Path) -> Any:
    models = load_all(path)
    return [(m.summary(), repr(m), np.asarray(m.f.offsets).tolist()) for m in models.values()]


def _solution(path: Path) -> Any:
    solution = load_solution(path)
    states = solution.at(np.linspace(0, 1, 3))[0]
    return solution.summary(), repr(solution), states.tolist()


def _replacing(source: Path, name: str) -> Callable[[bytes, Path], Path]:
    def put(damaged: bytes, where: Path) -> Path:
        target = where / f"damaged {source.name}"
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target)
        (target / name).write_bytes(damaged)
        return target

    return put


def _reshaping(
    source: Path, name: str, tensors: Mapping[str, Array]
) -> Callable[[bytes, Path], Path]:
    """Arrays of other shapes and types, with digests that hold."""

    def put(damaged: bytes, where: Path) -> Path:
        try:
            shapes = json.loads(damaged)
            raw = save({k: _cut(tensors.get(k, np.zeros(1)), *v) for k, v in shapes.items()})
        except (ValueError, TypeError, AttributeError, OverflowError, SafetensorError):
            raw = save(dict(tensors))  # shapes that no file can hold
        target = _replacing(source, name)(raw, where)
        manifest = json.loads((target / MANIFEST).read_bytes())
        manifest["sha256"] = hashlib.sha256(raw).hexdigest()
        (target / MANIFEST).write_bytes(_signed(manifest))
        return target

    return put


def _cut(values: Array, *shape: Any) -> Array:
    *sizes, kind = shape
    if np.prod(sizes, dtype=float) > 1e6 or any(type(n) is not int or n < 0 for n in sizes):
        raise ValueError("no shape")
    return np.resize(values, sizes).astype(kind)
