"""Several inputs that act late, and lags that are no dead time: what `fit` says of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from dfsm import (
    Channel,
    DfsmWarning,
    Feature,
    FitSettings,
    StateSpec,
    Trajectory,
    fit,
    validate,
)
from dfsm.fitting.corrective import NoCorrection

STEP, FINE = 0.5, 40
SETTINGS = FitSettings(
    states=(StateSpec(name="x"),),
    controls=("a", "b"),
    disturbances=("c",),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


def behind(rate, values):
    """y' = -rate y + v on the fine mesh, exact for what is held there."""
    decay = np.exp(-rate * STEP / FINE)
    return lfilter([0.0, (1 - decay) / rate], [1.0, -decay], values)


def recorded(seed, late=(0.0, 0.0), lag=None, count=800):
    """x' = -0.2 x + a(t - d1) + 0.5 b(t - d2) + 0.4 c, or all of its inputs behind a lag."""
    rng, ahead = np.random.default_rng(seed), 20
    hold = round(8 / STEP) * FINE
    u = np.repeat(rng.uniform(-1, 1, (count // 16 + 6, 3)), hold, axis=0).T
    shift = [round((ahead - d) / STEP * FINE) for d in (*late, 0.0)]
    acting = [v[s : s + count * FINE] for v, s in zip(u, shift, strict=True)]
    force = acting[0] + 0.5 * acting[1] + 0.4 * acting[2]
    if lag is not None:
        force = behind(1 / lag, force) / lag
    x = behind(0.2, force)[::FINE]
    first = round(ahead / STEP) * FINE
    values = np.stack([x, *(v[first : first + count * FINE : FINE] for v in u)], axis=1)
    time = np.arange(count) * STEP
    return Trajectory(time, values, tuple(Channel(n) for n in "xabc"), name=f"r{seed}")


def told(runs, settings=SETTINGS):
    with pytest.warns(DfsmWarning) as caught:
        fit(runs, settings)
    return [str(w.message) for w in caught if w.category is DfsmWarning]


@pytest.mark.parametrize("late", [(1.25, 6.0), (3.0, 6.0), (6.0, 6.0)])
def test_two_inputs_that_act_late_are_both_named(late):
    (note,) = told([recorded(k, late) for k in range(3)])
    first, second = (float(part.split(" s")[0]) for part in note.split("about ")[1:])
    assert abs(first - late[0]) < 0.1
    assert abs(second - late[1]) < 0.1
    assert "'a' acts about" in note
    assert f"{{source: b, kind: delay, seconds: {second:.3g}}}" in note
    delays = [Feature(source=n, kind="delay", seconds=d) for n, d in zip("ab", late, strict=True)]
    # What is left over then, as half a sample is no place of a jump, is no other delay.
    model = fit([recorded(k, late) for k in range(3)], replace(SETTINGS, features=tuple(delays)))
    row = dict(zip(model.model.signals.order.names, model.model.f.coefficients[0, 0], strict=True))
    found = [float(row[n]) for n in (delays[0].name, delays[1].name, "c", "x")]
    on_samples = late[0] % STEP == 0
    assert found == pytest.approx([1, 0.5, 0.4, -0.2], abs=1e-3 if on_samples else 0.01)


@pytest.mark.parametrize("late", [(0.0, 6.0), (1.25, 0.0)])
def test_one_that_acts_late_is_named_alone(late):
    (note,) = told([recorded(k, late) for k in range(3)])
    name, other = ("a", "b") if late[0] else ("b", "a")
    assert f"'{name}' acts about" in note
    assert f"'{other}'" not in note


@pytest.mark.parametrize("early", [1.25, 6.0])
def test_a_disturbance_that_is_recorded_late_is_told_as_early(early):
    runs = []
    for k in range(3):
        run = recorded(k)
        # What a mast behind the plant, or a clock that is late, makes of c.
        behind = np.interp(run.time - early, run.time, run["c"])
        values = np.column_stack([run.select(["x", "a", "b"]).values, behind])
        runs.append(replace(run, values=values).window(10))
    (note,) = told(runs)
    told_by = float(note.split("acts about ")[1].split(" s")[0])
    assert abs(told_by - early) < 0.3
    assert f"{{source: c, kind: lead, seconds: {told_by:.3g}}}" in note
    lead = Feature(source="c", kind="lead", seconds=early)
    model = fit(runs, replace(SETTINGS, features=(lead,))).model
    row = dict(zip(model.signals.order.names, model.f.coefficients[0, 0], strict=True))
    assert float(row["x"]) == pytest.approx(-0.2, abs=0.01)


def test_inputs_that_act_at_once_are_not_late():
    fit([recorded(k) for k in range(3)], SETTINGS)  # warnings are errors in these tests


@pytest.mark.parametrize("lag", [1.0, 4.0])
def test_a_row_that_wants_an_order_more_is_not_called_late_nor_fed_back(lag):
    runs = [recorded(k, lag=lag) for k in range(3)]
    (note,) = told(runs)
    assert "acts through a lag of about" in note
    assert "set {name: x, order: 2} among signals.states" in note
    second = replace(SETTINGS, states=(StateSpec(name="x", order=2),))
    row = np.asarray(fit(runs, second).model.f.coefficients[0, 1])
    want = np.array([1, 0.5, 0.4, -0.2]) / lag
    assert row == pytest.approx([*want, -0.2 - 1 / lag], abs=0.02)


def test_a_comparison_leaves_out_what_acted_before_the_record():
    delays = tuple(Feature(source=n, kind="delay", seconds=6.0) for n in "ab")
    runs = [recorded(k, (6.0, 6.0)) for k in range(4)]
    model = fit(runs[:3], replace(SETTINGS, features=delays)).model
    # The hidden past of a short run is a fifth of it.
    judged = validate(model, [runs[3].window(100, 130)])
    assert judged.runs[0].recorded.time[0] == 106
    assert judged.runs[0].models["multi-fidelity"].errors["x"].nrmse < 0.01
    assert any("compared from 106 s on" in text for text in judged.warnings)
    assert validate(model, runs[3:], start=50).runs[0].recorded.time[0] == 50
