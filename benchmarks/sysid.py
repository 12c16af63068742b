"""Published system identification benchmarks, and twins of our own: errors of free runs.

python -m benchmarks sysid --data FOLDER     records as docs/hidden-states.md says where to get them
python -m benchmarks sysid                   twins, whose structure is the same

Each by one call on the configuration that `dfsm init` proposes; the first 50 samples of a test
record tell the state and are not scored. Training records of twins have noise of one hundredth of
what is seen, their test records none: a ratio to that floor below one is a model better than the
instrument. Where `python -m benchmarks peer` has made the environment of jax-sysid, a recurrent
model of that package is trained and tested beside, on as many samples as it takes in minutes.
"""

from __future__ import annotations

import tempfile
import time as clock
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import peer
from benchmarks.twins import TWINS
from dfsm.config.fit import load_config
from dfsm.config.template import write_config
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.fit import fit
from dfsm.simulation.simulate import simulate

# Files by record: what trains, and what tests, with the unit and the factor to it.
PUBLISHED: Mapping[str, tuple[str, Sequence[str], str, float]] = {
    "cascaded tanks": ("cascaded_tanks_train.csv", ("cascaded_tanks_test.csv",), "V", 1.0),
    "silverbox": (
        "silverbox_train.parquet",
        ("silverbox_test.parquet", "silverbox_arrow.parquet"),
        "mV",
        1e3,
    ),
}
SEEDS, TWIN_SEEDS = (0, 1, 2, 3, 4), (0, 1, 2)
_TOLD = 50
_TRAIN, _TEST, _NOISE = 1000, 800, 0.01
# Samples that train the peer, the share of them that judges its seeds, and its numbers of states.
_PEER, _HELD, _PEER_STATES = 6000, 0.25, (2, 3, 6)
_PEER_NAME = "jax-sysid, 16 units"


def run(folder: str | None = None, seeds: Iterable[int] | None = None) -> dict[str, object]:
    """One row per record and seed, and a table of what they come to over the seeds."""
    if folder is not None:
        rows, peers = _published(Path(folder), tuple(SEEDS if seeds is None else seeds))
        return {"table": _table(rows), "peers": peers, "rows": rows}
    rows, peers = [], list[dict[str, object]]()
    with tempfile.TemporaryDirectory() as place:
        for name, twin in TWINS.items():
            train = Path(place) / f"{name}.csv"
            record = twin.record(_TRAIN, 1, _NOISE)
            write_table(record, train)
            tests = {"test": twin.record(_TEST, 2)}
            floor = {"floor": _NOISE * float(record["y"].std())}
            for seed in TWIN_SEEDS if seeds is None else seeds:
                rows.append(_row(name, train, tests, (twin.unit, 1.0), seed) | floor)
            peers += _peers(name, record, tests, (twin.unit, 1.0))
    return {"table": _table(rows), "peers": peers, "rows": rows}


def _table(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, object]]:
    """Errors over the seeds, by record and test."""
    lines: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        for test in row["rmse"]:
            lines.setdefault((row["record"], test), []).append(row)
    table: list[dict[str, object]] = []
    for (record, test), of in lines.items():
        errors = [np.inf if (e := row["rmse"][test]) is None else e for row in of]
        middle, worst = float(np.median(errors)), float(np.max(errors))
        line = {"record": record, "test": test, "unit": of[0]["unit"], "median": middle}
        line |= {"worst": worst, "worst_over_best": worst / float(np.min(errors))}
        line["seconds"] = float(np.median([row["seconds"] for row in of]))
        if "floor" in of[0]:
            line["median_over_floor"] = middle / of[0]["floor"]
        table.append(line)
    return table


def _published(
    folder: Path, seeds: Sequence[int]
) -> tuple[list[dict[str, object]], list[dict[str, object]]]:
    rows, peers = list[dict[str, object]](), list[dict[str, object]]()
    for name, (train, tests, unit, factor) in PUBLISHED.items():
        missing = [f for f in (train, *tests) if not (folder / f).exists()]
        if missing:
            raise DfsmError(
                f"{folder} lacks {missing[0]}: a table with columns Time, u and y, as "
                "docs/hidden-states.md describes it"
            )
        records = {Path(f).stem: read(folder / f) for f in tests}
        rows += [_row(name, folder / train, records, (unit, factor), seed) for seed in seeds]
        peers += _peers(name, read(folder / train), records, (unit, factor))
    return rows, peers


def _peers(
    name: str, train: Trajectory, tests: Mapping[str, Trajectory], unit: tuple[str, float]
) -> list[dict[str, object]]:
    """The error of a recurrent model of jax-sysid, where that is installed."""
    if not peer.PYTHON.exists():
        return []
    train = train if len(train) <= _PEER else train.window(None, float(train.time[_PEER - 1]))
    last = round(len(train) * (1 - _HELD))
    longest = max(map(len, tests.values()))
    data = {"states": np.array(_PEER_STATES)}
    for kind, channel in (("inputs", "u"), ("outputs", "y")):
        values = train[channel][None, :, None]
        data[f"training_{kind}"], data[f"held_{kind}"] = values[:, :last], values[:, last:]
        each = [np.pad(r[channel], (0, longest - len(r)), mode="edge") for r in tests.values()]
        data[f"test_{kind}"] = np.array(each)[:, :, None]
    data["test_outputs"] = data["test_outputs"][:, : _TOLD + 1]
    outputs, seconds = peer.predicted(data)
    errors = {}
    for (test, record), values in zip(tests.items(), outputs, strict=True):
        apart = values[: len(record) - _TOLD, 0] - record["y"][_TOLD:]
        errors[test] = unit[1] * float(np.sqrt(np.mean(apart**2)))
    return [
        {"record": name, "peer": _PEER_NAME, "unit": unit[0], "rmse": errors, "seconds": seconds}
    ]


def _row(
    name: str, train: Path, tests: Mapping[str, Trajectory], unit: tuple[str, float], seed: int
) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "config.yaml"
        write_config([str(train)], path)
        config, runs = load_config(path)
    config = config.model_copy(update={"seed": seed})
    began = clock.perf_counter()
    model = fit(runs, config.fit_settings(), config.refine).model
    seconds = clock.perf_counter() - began
    errors = {}
    for test, record in tests.items():
        rollout = simulate(model, record, start=float(record.time[_TOLD])).trajectory
        if len(rollout) < len(record) - _TOLD:
            errors[test] = None
            continue
        apart = rollout["y"] - record["y"][_TOLD:]
        errors[test] = unit[1] * float(np.sqrt(np.mean(apart**2)))
    told = model.provenance.record.get("hidden", {})
    return {
        "record": name,
        "seed": seed,
        "unit": unit[0],
        "rmse": errors,
        "seconds": seconds,
        "hidden": told.get("count"),
        "form": told.get("form"),
        "inputs": model.signals.between,
        "step_s": told.get("step"),
    }
