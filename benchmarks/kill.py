"""Kill every command at every file event: what stands at its target must be whole, old or new.

A command is run again and again in copies of one folder, killed before its first, second, … event
on a file, until it ends by itself. Each time its target must be what it was or what it is to be,
and the command must work afterwards and leave nothing else behind. Then the same with a disk that
is full from that event on: one sentence, exit code 2, and the target as it was.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import dfsm
from dfsm.core.bundle import checksum
from dfsm.core.exchange import recover
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory

# What Python does to files; writing itself is between the events, in temporary files.
EVENTS = {
    *("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.chmod", "os.truncate"),
    *("os.link", "os.symlink", "shutil.rmtree", "tempfile.mkstemp", "tempfile.mkdtemp"),
}
# Those that a full disk refuses.
_GROWS = {"open", "os.rename", "os.mkdir"}
_NEVER = 10**9


@dataclass(frozen=True)
class Ended:
    """How a run of a command ended: exit code, negative for a signal, and standard error."""

    code: int
    err: str


# A command in a folder, ended at an event, by a kill or by a full disk.
Attempt = Callable[[Path, int, bool], Ended]


def end_at(limit: int, full: bool) -> None:
    """End this process before an event on a file below its working folder.

    Parameters
    ----------
    limit
        Number of the event, from 1.
    full
        Let this event and all later ones find the disk full instead.
    """
    below, seen = str(Path.cwd()), 0

    def event(name: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if name not in EVENTS or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        changes = os.O_WRONLY | os.O_RDWR | os.O_CREAT
        if name == "open" and not (arguments[2] or 0) & changes:
            return
        where = os.path.abspath(os.fsdecode(arguments[0]))  # noqa: PTH100
        if not where.startswith(below):
            return
        seen += 1
        if seen < limit:
            return
        if not full:
            os.kill(os.getpid(), signal.SIGKILL)
        if name in _GROWS:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), where)

    sys.addaudithook(event)


def command(*arguments: str) -> Attempt:
    """A command of the command line, in a process of its own."""
    roots = [str(Path(__file__).parents[1]), str(Path(dfsm.__file__).parents[1])]

    def attempt(folder: Path, at: int, full: bool) -> Ended:
        code = (
            f"from benchmarks.kill import end_at; end_at({at}, {full}); "
            "from dfsm.cli import main; main()"
        )
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(roots)},
            capture_output=True,
            text=True,
            timeout=900,
            check=False,
        )
        return Ended(done.returncode, done.stderr)

    return attempt


def forked(work: Callable[[], object]) -> Attempt:
    """A function of this process, in a copy of it: quick, for processes without threads."""

    def attempt(folder: Path, at: int, full: bool) -> Ended:
        child = os.fork()
        if child:
            return Ended(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), "")
        code = 2
        try:
            os.chdir(folder)
            end_at(at, full)
            work()
            code = 0
        finally:
            os._exit(code)

    return attempt


def killed_everywhere(
    attempt: Attempt, source: Path, target: str, *, full: bool = False, in_steps: bool = False
) -> tuple[int, list[str]]:
    """End a command at every event, each time in a fresh copy of a folder.

    Parameters
    ----------
    attempt
        Runs it.
    source
        Folder to copy.
    target
        What it writes.
    full
        Whether the disk is full from that event on instead.
    in_steps
        Whether the target may be away until the next start, as without Linux's exchange.

    Returns
    -------
    tuple
        Number of events, and one sentence per thing that went wrong.
    """
    wrong: list[str] = []
    untouched = _everything(source)
    with tempfile.TemporaryDirectory() as base:
        whole = Path(base) / "whole"
        shutil.copytree(source, whole, symlinks=True)
        before = content(whole / target)
        done = attempt(whole, _NEVER, False)
        after = content(whole / target)
        if done.code not in (0, 1) or after is None:
            return 0, [f"exit {done.code} undisturbed: {done.err[-300:]}"]
        at = 0
        while True:
            at += 1
            folder = Path(base) / str(at)
            shutil.copytree(source, folder, symlinks=True)
            done = attempt(folder, at, full)
            if done.code in (0, 1):
                return at - 1, wrong
            if in_steps:
                recover(folder / target)
            found = content(folder / target)
            if found not in (before, after) and not (found and is_new(found, before, after)):
                wrong.append(f"event {at}: the target is neither old nor new")
            if full and (done.code != 2 or done.err.count("\n") > 1):
                wrong.append(f"event {at}: exit {done.code}, {done.err[-300:]!r}")
            # It ended undisturbed in a folder without anything left behind.
            if not full and _everything(folder) != untouched:
                again = attempt(folder, _NEVER, False)
                left = sorted(p.name for p in folder.rglob(".*dfsm-*"))
                if again.code not in (0, 1) or left:
                    wrong.append(f"event {at}: then exit {again.code}, left {left}, {again.err!r}")
            shutil.rmtree(folder)


def _everything(folder: Path) -> dict[str, bytes]:
    paths = sorted(folder.rglob("*"))
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in paths}


def content(path: Path) -> Mapping[str, bytes] | None:
    """What a file or folder holds but for hidden files and journals; None where nothing is."""
    if path.is_file():
        return {"": path.read_bytes()}
    if not path.exists():
        return None
    files = (p for p in sorted(path.rglob("*")) if p.is_file())
    named = {str(p.relative_to(path)): p.read_bytes() for p in files}
    hidden = {n for n in named if any(x.startswith(".") for x in Path(n).parts)}
    return {n: b for n, b in named.items() if n not in hidden and not n.endswith(".jsonl")}


def is_new(
    found: Mapping[str, bytes], before: Mapping[str, bytes] | None, expected: Mapping[str, bytes]
) -> bool:
    """Whether something is the complete new result, though its wall times may be others."""
    if set(found) != set(expected):
        return False
    replaced = {n: b for n, b in (before or {}).items() if expected.get(n) != b}
    if any(found[n] == b for n, b in replaced.items() if n in found):
        return False
    for name, raw in found.items():
        if name.endswith("manifest.json"):
            manifest = json.loads(raw)
            arrays = [b for n, b in found.items() if n.endswith(".safetensors")]
            digests = [hashlib.sha256(b).hexdigest() for b in arrays]
            if manifest["checksum"] != checksum(manifest) or manifest["sha256"] not in digests:
                return False
        elif raw[:1] == b"{":
            json.loads(raw)
        elif raw[-8:] != expected[name][-8:]:
            return False
    return True


def run() -> dict[str, Any]:
    """Kill every command that writes, and let it meet a full disk, at every event.

    Returns
    -------
    dict
        Per command the number of events and what went wrong.
    """
    commands: dict[str, tuple[str, ...]] = {
        "new.yaml": ("init", "train/*", "-o", "new.yaml", "--force"),
        "m": ("fit", "config.yaml", "-o", "m", "-q"),
        "r.html": ("validate", "model", "test.csv", "-o", "r.html", "-q"),
        "r.json": ("validate", "model", "test.csv", "--json", "r.json", "-q"),
        "o.csv": ("simulate", "model", "test.csv", "-o", "o.csv", "-q"),
        "o.parquet": ("simulate", "model", "test.csv", "-o", "o.parquet", "-q"),
        "i.json": ("calibrate", "model", "held/*", "-o", "i.json", "-q"),
        "s": ("optimize", "problem.yaml", "-o", "s", "-q"),
        "c": ("export-rosco", "solution", "--torque", "Torque", "-o", "c"),
        "w/calm.parquet": ("wind", "field.bts", "calm.csv", "--radius", "12", "-o", "w", "-q"),
        "all/raw": ("compare", "config.yaml", "-o", "all", "--jobs", "1", "-q"),
        "card.html": ("report", "model", "-o", "card.html", "-q"),
        "loop": (*_LOOP, "-o", "loop", "-q"),
        "loop.html": (*_LOOP, "-o", "loop", "--report", "loop.html", "-q"),
        "swept": ("sweep", "sweep.yaml", "-o", "swept", "-q"),
        "tuned": ("tune", "tune.yaml", "-o", "tuned", "-q"),
        "lines.mat": ("export", "state-space", "model", "-o", "lines.mat", "-q"),
        "m.casadi": ("export", "casadi", "model", "-o", "m.casadi", "-q"),
        "code": ("export", "c", "model", "-o", "code", "-q"),
        "script": ("export", "python", "model", "-o", "script", "-q"),
        "m.fmu": ("export", "fmu", "model", "-o", "m.fmu", "-q"),
    }
    with tempfile.TemporaryDirectory() as base, ThreadPoolExecutor(os.cpu_count()) as pool:
        source = Path(base) / "source"
        _prepare(source)
        tried = {
            f"{arguments[0]} {target}{' on a full disk' if full else ''}": pool.submit(
                killed_everywhere, command(*arguments), source, target, full=full
            )
            for target, arguments in commands.items()
            for full in (False, True)
        }
        figures: dict[str, Any] = {}
        for name, ended in tried.items():
            events, wrong = ended.result()
            figures[name] = {"events": events, "wrong": wrong}
            print(f"{name}: {events} events, {len(wrong)} wrong", file=sys.stderr, flush=True)
    return figures


_LOOP = (
    *("closed-loop", "model", "test.csv", "--controller", "control.py:pid"),
    *("--start-up", "1", "--start", "2"),
)


_CONFIG = """\
data: {train: [train/a.csv, train/b.csv, train/c.csv]}
signals: {states: [{name: q, order: 2}], controls: [Torque], disturbances: [RotWind], outputs: [y]}
corrective: {kind: none}
nonlinear_only: false
compare: {candidates: {raw: {linear: {kind: LTI, affine: false}}}, hold_out: 0.3}
"""
_PROBLEM = """\
model: model
horizon: [0, 4]
disturbances: test.csv
cost: [{weight: 1, track: q, reference: 0.2}, {weight: 0.1, square: Torque}]
bounds: {Torque: [-2, 2]}
initial: recorded
nodes: 11
"""
_CONTROLLER = """\
import dfsm

pid = dfsm.PID(
    kp=0.5, ki=0.2, setpoint=0.2, limits=(-2.0, 2.0), interval=0.05,
    measurements=["q"], measurement_units=["m"], commands=["Torque"], command_units=["kNm"],
)
"""
_LOOPS = "{model: model, controller: control.py:pid, runs: test.csv, start: 2, start_up: 1, "
_TUNE = """\
parameters: {kp: [0.1, 2.0]}, objective: [{measure: std, channel: q}], starts: 1, iterations: 2}
"""


def _prepare(source: Path) -> None:
    """Runs of an oscillator, a configuration, a model, a solution and a wind field."""
    from benchmarks.fuzz_samples import wind_field

    for part in ("train", "held"):
        (source / part).mkdir(parents=True)
    for k, name in enumerate(("train/a", "train/b", "train/c", "held/d", "held/e", "held/f")):
        write_table(_oscillator(k), source / f"{name}.csv")
    write_table(_oscillator(9), source / "test.csv")
    write_table(_oscillator(9).select(["q", "Torque", "y"]).window(0, 2), source / "calm.csv")
    (source / "field.bts").write_bytes(wind_field(7))
    (source / "config.yaml").write_text(_CONFIG)
    (source / "problem.yaml").write_text(_PROBLEM)
    (source / "control.py").write_text(_CONTROLLER)
    (source / "sweep.yaml").write_text(_LOOPS + "gains: {kp: [0.2, 0.4]}}\n")
    (source / "other.yaml").write_text(_LOOPS + "gains: {kp: [0.3, 0.6]}}\n")
    (source / "tune.yaml").write_text(_LOOPS + _TUNE)
    (source / "wide.yaml").write_text(_LOOPS + _TUNE.replace("2.0", "3.0"))
    for arguments in (
        ("fit", "config.yaml", "-o", "model", "-q"),
        ("optimize", "problem.yaml", "-o", "solution", "-q"),
        # What stands where the commands write: other results, and a file of somebody else's.
        (*_LOOP, "--stop", "5", "-o", "loop", "-q"),
        ("sweep", "other.yaml", "-o", "swept", "-q"),
        ("tune", "wide.yaml", "-o", "tuned", "-q"),
    ):
        done = command(*arguments)(source, _NEVER, False)
        if done.code:
            raise RuntimeError(done.err)
    for folder in ("loop", "swept"):
        (source / folder / "notes.txt").write_text("mine")


def _oscillator(seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    time = np.arange(0, 6.0, 0.05)
    a, b, c = rng.uniform(0.5, 2.5, 3)
    torque, wind = np.sin(a * time), np.cos(b * time) + 0.3 * np.sin(3 * c * time)
    q, v, values = 0.2, 0.0, []
    for u, w in zip(torque, wind, strict=True):
        values.append([q, u, w, 2 * q - u])
        v += 0.05 * (-q - 0.4 * v + u + 0.5 * w)
        q += 0.05 * v
    channels = tuple(Channel(*c) for c in (("q", "m"), ("Torque", "kNm"), ("RotWind", "m/s")))
    return Trajectory(time, np.array(values), (*channels, Channel("y", "kN")), name=f"run{seed}")
