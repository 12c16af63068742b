"""Records that stand still in the middle, states too fast for their samples, units of runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dfsm.data.conversion import in_one_unit
from dfsm.data.derivatives import StateSpec
from dfsm.data.info import describe
from dfsm.data.readers.tables import write_table
from dfsm.data.stuck import stuck_notes
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.models.model_folder import save

SETTINGS = FitSettings(
    states=(StateSpec(name="x"),),
    controls=("u",),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


def run_of(time, name="run", unit="", **channels):
    named = tuple(Channel(n, unit if n == "x" else "") for n in channels)
    return Trajectory(time, np.stack(list(channels.values()), axis=1), named, name=name)


def answered(time, phase=0.0):
    """x' = -0.5 x + u, its answer to each sine."""
    w = np.array([[0.4], [1.3]])
    at = w * time + phase
    x = (0.5 * np.sin(at) - w * np.cos(at)) / (0.25 + w**2)
    return {"x": x.sum(axis=0), "u": np.sin(at).sum(axis=0)}


def test_what_stands_still_in_mid_motion_is_named():
    time = np.arange(0, 100, 0.1)
    a, b, c = np.sin(time), np.cos(0.7 * time), np.sin(0.3 * time) + 2
    assert stuck_notes(run_of(time, a=a, b=b, c=c)) == []
    frozen, gone = b.copy(), np.stack([a, b, c], axis=1)
    frozen[300:340] = b[300]
    (note,) = stuck_notes(run_of(time, a=a, b=frozen, c=c))
    assert note.startswith("'b' is the same from 30 to 33.9 s")
    gone[400:460] = 0.0
    missing = run_of(time, **dict(zip("abc", gone.T, strict=True)))
    (note,) = stuck_notes(missing)
    assert note.startswith("almost every channel is zero from 40 to 45.9 s")
    assert note in describe(missing).warnings
    # A limit, a rest that a step ends, a valve that stays and jumps, a rounded signal.
    x = np.where(time < 20, 0.0, 1 - np.exp(-(time - 20)))
    valve = np.repeat(np.random.default_rng(0).normal(size=50), 20)
    fine = run_of(time, a=np.clip(a, -0.5, 0.7), x=x, valve=valve, r=np.round(c, 2))
    assert stuck_notes(fine) == []
    # A torque that is at its limit in a gust comes and leaves faster than it usually moves.
    gust = np.minimum(0.02 * np.sin(time) + 3 * np.exp(-(((time - 50) / 6) ** 2)), 1.0)
    assert stuck_notes(run_of(time, torque=gust)) == []


def test_a_fit_names_run_channel_and_time():
    time = np.arange(0, 100, 0.1)
    channels = answered(time)
    channels["x"][500:530] = channels["x"][500]
    with pytest.warns(DfsmWarning, match=r"run: 'x' is the same from 50 to 52\.9 s"):
        fit([run_of(time, **channels)], SETTINGS)


def test_a_mode_that_is_over_between_samples_is_told():
    u = np.repeat(np.random.default_rng(0).normal(size=60), 3)
    x, decay = np.zeros(180), np.exp(-3.0)
    for k in range(179):
        x[k + 1] = decay * x[k] + (1 - decay) * u[k]
    with pytest.warns(DfsmWarning) as caught:
        model = fit([run_of(np.arange(180.0), x=x, u=u)], SETTINGS).model
    assert any("is over within the 1 s between samples" in str(w.message) for w in caught)
    entry = model.provenance.record["verdicts"][0]
    assert entry["verdict"] == "for trends only"
    assert "its samples are too far apart (x_dot)" in entry["text"]


def test_training_runs_of_one_dimension_are_converted():
    time = np.arange(0, 60, 0.1)
    first, second, third = answered(time), answered(time, 1.0), answered(time, 2.0)
    runs = [run_of(time, "a", "m", **first), run_of(time, "b", "m", **second)]
    thousands = run_of(time, "c", "mm", **(third | {"x": 1e3 * third["x"]}))
    expected = fit([*runs, run_of(time, "c", "m", **third)], SETTINGS).model
    with pytest.warns(DfsmWarning, match="c: units converted: 'x' from mm to m"):
        model = fit([thousands, *runs], SETTINGS).model
    assert_allclose(model.f.coefficients, expected.f.coefficients, rtol=1e-9)
    assert model.signals.states[0].unit == "m"
    other = replace(runs[1], channels=(Channel("x", "s"), runs[1].channels[1]))
    assert in_one_unit([runs[0], other], ["x"]) == [runs[0], other]


def test_the_step_of_samples_and_that_of_rk4_have_names_of_their_own(tmp_path, dfsm):
    time = np.arange(0, 30, 0.1)
    run = run_of(time, **answered(time))
    save(fit([run], SETTINGS).model, tmp_path / "m")
    write_table(run, tmp_path / "run.csv")
    lines = (tmp_path / "run.csv").read_text().splitlines()
    bare = [line.split(",", 1)[1] for line in lines]
    (tmp_path / "bare.csv").write_text("\n".join(bare) + "\n")
    where = ("simulate", tmp_path / "m", tmp_path / "bare.csv", "-o", tmp_path / "out.csv")
    said = dfsm(*where, "--sample-step", 0.1, "--step", 0.02)
    assert said.code == 0, said.err
    assert dfsm(*where, "--step", 0.1).code == 0
    assert dfsm("info", tmp_path / "bare.csv", "--sample-step", 0.1).code == 0
    assert dfsm("validate", tmp_path / "m", tmp_path / "bare.csv", "--sample-step", 0.1).code == 0
