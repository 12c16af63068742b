"""Runs of a small known system on disk, and one model folder fitted to them by the command line."""

from __future__ import annotations

import copy
import ctypes
import gc
import importlib.util
import os
import resource
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np
import pytest
from ruamel.yaml import YAML
from threadpoolctl import threadpool_limits

from benchmarks.outb import write_outb
from dfsm import cli
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from systems import DUFFING

CONFIG: dict[str, Any] = {
    "data": {"train": ["train/a.csv", "train/b.parquet", "train/c.outb"], "start": 1.0},
    "signals": {
        "states": [{"name": "q", "order": 2}],
        "controls": ["u"],
        "disturbances": ["w"],
        "outputs": ["y", "z"],
    },
    "corrective": {"kind": "rbf", "samples": 25},
}

# Files that take longest; workers take them first, so that none is left alone with one at the end.
LONG = (
    *("test_results", "test_robot_results", "test_parameter_study", "test_studies"),
    *("test_turbine_control", "test_latents", "test_adaptive", "test_refine"),
    *("test_control_problems",),
)

# What was compiled for one worker, for a process that a test starts, or in an earlier run, is not
# compiled again.
COMPILED = {
    "JAX_COMPILATION_CACHE_DIR": str(Path(__file__).parents[1] / ".pytest_cache" / "compiled"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0.0,
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": -1,
}
for name, value in COMPILED.items():
    if name not in os.environ:
        os.environ[name] = str(value)
        # JAX has read its environment.
        jax.config.update(name.lower(), value)

# As in `fit`: each worker has a processor, and threads of BLAS would wait for one another many
# times longer than they work.
threadpool_limits(limits=1)

# Bytes that a process may take on before it drops what was compiled.
MOST_COMPILED = 500_000_000

# A job in the background may have been told to ignore Ctrl-C, and would hand that on to commands
# whose reaction to it is tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {stem: place for place, stem in enumerate(LONG)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONG)))


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Workers tell how much memory they took at most, in kB."""
    output = getattr(session.config, "workeroutput", None)
    if output is not None:
        output["peak"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


class Peaks:
    """Memory of the workers, for the summary."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        peak = getattr(node, "workeroutput", {}).get("peak")
        if peak is not None:
            self.lines.append(f"{node.gateway.id}: {peak / 1e6:.2f} GB at most")

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for line in self.lines:
            terminalreporter.write_line(line)


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Peaks())


def sentence(path: Path, step: float | None = None) -> str:
    """The one sentence with which a file is refused."""
    with pytest.raises(DfsmError) as caught:
        read(path, step)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def resident() -> int:
    """Bytes of memory that this process has now; 0 where that is not told."""
    table = Path("/proc/self/statm")
    pages = int(table.read_text().split()[1]) if table.exists() else 0
    return pages * resource.getpagesize()


@pytest.fixture(autouse=True)
def compiled_code_is_dropped(kept: list[int]) -> Iterator[None]:
    """JAX keeps what it compiles for every function and shape: here some gigabytes in an hour."""
    yield
    if resident() - kept[0] < MOST_COMPILED:
        return
    jax.clear_caches()
    gc.collect()
    # What was freed lies between what is kept, and the C library would not give it back by itself.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    kept[0] = resident()


@pytest.fixture(scope="session")
def kept() -> list[int]:
    """Memory in bytes when compiled code was dropped the last time, or at the start."""
    return [resident()]


def example_module(name: str) -> ModuleType:
    """One of the scripts in ``examples/``, by name, as a module."""
    path = Path(__file__).parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Result:
    """What a run of the command line left: exit code, standard output and error."""

    code: int
    out: str
    err: str

    @property
    def sentence(self) -> str:
        """The one sentence on standard error that bad input earns, and nothing else anywhere."""
        assert self.code == 2, self
        assert self.out == "", self.out
        assert self.err.startswith("error: "), self.err
        assert self.err.endswith("\n"), self.err
        assert self.err.count("\n") == 1, self.err
        assert "Traceback" not in self.err
        return self.err.removeprefix("error: ").rstrip("\n")


Dfsm = Callable[..., Result]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`train/` and `test/` with one run per kind of file, and `config.yaml`."""
    base = tmp_path_factory.mktemp("runs")
    for part in ("train", "test"):
        (base / part).mkdir()
    time = np.arange(0, 15.01, 0.05)
    a, b, c, d = DUFFING.many(4, [(0.3, 1.0), (0.0, 1.0)], time, seed=3)
    write_table(a, base / "train" / "a.csv")
    write_table(b, base / "train" / "b.parquet")
    for run, path in ((c, "train/c.outb"), (d, "test/d.outb")):
        units = [channel.unit for channel in run.channels]
        write_outb(base / path, run.time, run.values, run.names, units)
    write_config(base / "config.yaml", CONFIG)
    return base


@pytest.fixture(scope="session")
def fitted(folder: Path) -> Path:
    """Model folder of `folder/config.yaml`; read only."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        patch.setattr(sys, "argv", ["dfsm", "fit", f"{folder}/config.yaml", "-o", f"{folder}/m"])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    assert stop.value.code == 0
    return folder / "m"


@pytest.fixture
def dfsm(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Dfsm:
    """Run the command line in this process."""

    def run(*arguments: object) -> Result:
        monkeypatch.setattr(sys, "argv", ["dfsm", *map(str, arguments)])
        capsys.readouterr()
        with warnings.catch_warnings(), pytest.raises(SystemExit) as stop:
            cli.main()
        captured = capsys.readouterr()
        assert isinstance(stop.value.code, int)
        return Result(stop.value.code, captured.out, captured.err)

    return run


@pytest.fixture
def here(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Fresh working folder with links `train` and `test` to the runs."""
    for part in ("train", "test"):
        (tmp_path / part).symlink_to(folder / part)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not [p for p in tmp_path.rglob(".*")], "a temporary file was left behind"


def write_config(path: Path, content: object) -> Path:
    """Write a configuration."""
    with path.open("w", encoding="utf-8") as stream:
        YAML().dump(content, stream)
    return path


def changed(*path: object, value: object) -> dict[str, Any]:
    """`CONFIG` with the value at one path replaced."""
    config = copy.deepcopy(CONFIG)
    node: Any = config
    for key in path[:-1]:
        node = node.setdefault(key, {}) if isinstance(node, dict) else node[key]
    node[path[-1]] = value
    return config


def files_of(path: Path) -> dict[str, bytes]:
    """Content of every file below a folder, links not followed."""
    return {
        str(p.relative_to(path)): p.read_bytes()
        for p in sorted(path.rglob("*"))
        if p.is_file() and not p.is_symlink()
    }


def renamed(run: Trajectory, names: dict[str, str]) -> Trajectory:
    """Give channels other names."""
    from dataclasses import replace

    channels = tuple(replace(c, name=names.get(c.name, c.name)) for c in run.channels)
    return replace(run, channels=channels)
