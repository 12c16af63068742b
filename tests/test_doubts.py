"""What a fit tells of its own coefficients: feedback, dead time, noise, standard errors, verdicts.

Systems of one state are integrated here with the exact step, so the true coefficients are known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from dfsm import (
    DerivativeSettings,
    DfsmError,
    DfsmWarning,
    Feature,
    FitSettings,
    StateSpec,
    Trajectory,
    simulate,
)
from dfsm.control.names import plant_of
from dfsm.data.suspects import screened
from dfsm.data.trajectory import Channel
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.held_inputs import held_unseen
from dfsm.fitting.noisy_inputs import effect_of_fast_parts, noise_shares
from dfsm.fitting.standard_errors import standard_errors
from dfsm.fitting.verdicts import grade
from dfsm.models.stability import Growth

A, B = -0.05, 0.1
SETTINGS = FitSettings(
    states=(StateSpec(name="x"),),
    controls=("u",),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


def run(time, **channels):
    names = tuple(Channel(name) for name in channels)
    return Trajectory(time, np.stack(list(channels.values()), axis=1), names)


def slow(rng, count, memory):
    """Noise that two lags have smoothed, of unit variance."""
    x = rng.standard_normal(count)
    for lag in (memory, memory / 5):
        a = np.exp(-1 / lag)
        for k in range(1, count):
            x[k] = a * x[k - 1] + (1 - a) * x[k]
    return x / x.std()


def plant(control, force, count, fine=10):
    """x' = A x + B u + force; the control is a function of x, its integral and the step."""
    x, integral, state, u = np.zeros(count), 0.0, 0.0, np.zeros(count)
    for k in range(count):
        x[k], u[k] = state, control(state, integral, k)
        for j in range(fine if k < count - 1 else 0):
            share = j / fine
            now = control(state, integral, k + share)
            r = force[k] * (1 - share) + force[k + 1] * share
            integral += state / fine
            state += (A * state + B * now + r) / fine
    return run(np.arange(count, dtype=float), x=x, u=u)


def told(runs, settings=SETTINGS):
    with pytest.warns() as caught:
        result = fit(runs, settings)
    return result.model, [str(w.message) for w in caught if w.category is DfsmWarning]


def quietly(runs, settings=SETTINGS):
    """Warnings are errors in these tests."""
    return fit(runs, settings).model


def test_a_control_that_follows_the_state_is_not_believed():
    force = 0.1 * slow(np.random.default_rng(0), 600, 30)
    model, notes = told([plant(lambda x, i, _: -(1.0 * x + 0.05 * i), force, 600)])
    assert float(model.f.coefficients[0, 0, 0]) < B / 2  # what the note is about
    assert notes[0].startswith("x_dot: ")
    assert "'u' (9" in notes[0]
    assert "follows from the states" in notes[0]
    assert "linear.known" in notes[0]
    assert not any("set linear.margin" in note for note in notes)


@pytest.mark.parametrize("size", [0.0, 0.1])
def test_an_excited_control_is_believed_whatever_is_unexplained(size):
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 61), 10)
    force = size * slow(rng, 600, 30)
    at = np.arange(len(u))
    quietly([plant(lambda x, i, k: np.interp(k, at, u), force, 600)])


def delayed(seconds, count=800):
    rng = np.random.default_rng(2)
    time = np.arange(count, dtype=float)
    u = slow(rng, count, 40)
    late = np.interp(time - seconds, time, u)
    x, decay = np.zeros(count), np.exp(A)
    ramp = (1 + (1 - decay) / A) / -A  # the exact answer to a line from one sample to the next
    for k in range(count - 1):
        step = late[k + 1] - late[k]
        x[k + 1] = decay * x[k] + B * (late[k] * (1 - decay) / -A + step * ramp)
    return run(time, x=x, u=u)


def test_an_input_that_acts_late_is_named_and_a_delay_mends_it():
    data = delayed(7)
    late, notes = told([data])
    entry = late.provenance.record["verdicts"][0]
    assert entry["nrmse"] < 0.7  # which alone would be enough for some trust
    assert entry["verdict"] != "usable"
    assert "'u' acts late on it (x_dot)" in entry["text"]
    assert "x_dot: 'u' acts about " in notes[0]
    assert abs(float(notes[0].split("about ")[1].split(" s")[0]) - 7) < 0.3
    # Told of a single sample, too, and not where there is no delay.
    _, (note,) = told([delayed(1)])
    assert abs(float(note.split("'u' acts about ")[1].split(" s")[0]) - 1) < 0.1
    quietly([delayed(0)])
    late = FitSettings(
        states=SETTINGS.states,
        controls=("u",),
        features=(Feature(source="u", kind="delay", seconds=7.0),),
        corrective=NoCorrection(),
        nonlinear_only=False,
    )
    model = quietly([data], late)
    assert_allclose(model.f.coefficients[0, 0], [0, B, A], atol=2e-3)
    assert model.provenance.record["verdicts"][0]["verdict"] == "usable"
    rollout = simulate(model, data)
    assert_allclose(rollout.trajectory["x"], data["x"], atol=0.02 * data["x"].std())
    # A record that starts later does not hold what acts on its first seconds.
    model = fit([data.window(100)], late).model
    assert_allclose(model.f.coefficients[0, 0], [0, B, A], atol=2e-3)
    with pytest.raises(DfsmError, match="'u_delay7' is what the control 'u' did some time ago"):
        plant_of(model)


def test_a_delay_needs_its_seconds():
    with pytest.raises(DfsmError, match=r"features\.seconds"):
        Feature(source="u", kind="delay")
    with pytest.raises(DfsmError, match=r"features\.seconds"):
        Feature(source="u", kind="lag", time_constant=2.0, seconds=1.0)


def test_noise_of_a_sensor_is_told_and_a_white_input_is_not():
    rng = np.random.default_rng(3)
    data = delayed(0)
    noisy = run(data.time, x=data["x"], u=data["u"] + 0.5 * rng.standard_normal(len(data)))
    model, notes = told([noisy])
    share = 1 - float(model.f.coefficients[0, 0, 0]) / B
    assert any("'u' does on its own is white" in note for note in notes)
    assert share > 0.1
    white = rng.standard_normal(400)
    at = np.arange(400)
    quietly([plant(lambda x, i, k: np.interp(k, at, white), np.zeros(400), 400)])


def test_noise_is_judged_within_runs():
    rng = np.random.default_rng(6)
    slow_ones = np.cumsum(rng.standard_normal((600, 2)), axis=0) * 0.05
    inputs = slow_ones + np.array([0.0, 0.3]) * rng.standard_normal((600, 2))
    inputs[300:] += 50.0  # between runs, which no difference may see
    target, row = slow_ones @ [1.0, 2.0], np.array([1.0, 2.0])
    parts = [slice(0, 300), slice(300, 600)]
    seconds = [np.diff(np.column_stack([inputs[p], target[p]]), 2, axis=0) for p in parts]
    fast = np.concatenate(seconds) - np.concatenate(seconds).mean(axis=0)
    effect = np.linalg.lstsq(fast[:, :2], fast[:, 2], rcond=None)[0]
    assert np.abs(effect[1]) < 0.3 * row[1]
    assert_allclose(effect_of_fast_parts(inputs, target, parts), effect, rtol=1e-9)
    shares = noise_shares(inputs, target, parts, row)
    others = np.column_stack([inputs[:, 0], np.ones(600)])
    own = inputs[:, 1] - others @ np.linalg.lstsq(others, inputs[:, 1], rcond=None)[0]
    assert shares[0] == 0
    assert_allclose(shares[1], 0.09 / own.var(), rtol=0.3)


def test_standard_errors_are_the_scatter_of_fits():
    rng = np.random.default_rng(4)
    slopes, errors = [], []
    for _ in range(60):
        x, r = slow(rng, 1000, 8)[:, None], slow(rng, 1000, 8)
        slope = float(x[:, 0] @ r / (x[:, 0] @ x[:, 0]))
        slopes.append(slope)
        left = r - slope * x[:, 0]
        errors.append(standard_errors(x, left, [slice(0, 1000)])[0])
    assert 0.6 < np.mean(errors) / np.std(slopes) < 1.4


def test_few_samples_leave_effects_unknown_however_small_the_residual():
    time = np.linspace(0, 0.4, 12)  # of a period of 10 s
    w, rng = 2 * np.pi / 10, np.random.default_rng(5)
    q = np.cos(w * time) + 1e-4 * rng.standard_normal(12)
    settings = FitSettings(
        states=(StateSpec(name="q", order=2),),
        controls=("u",),
        corrective=NoCorrection(),
        nonlinear_only=False,
    )
    model, notes = told([run(time, q=q, u=np.sin(3 * w * time))], settings)
    assert any("chance" in note or "independent samples" in note for note in notes)
    assert "(± " in model.summary()


def test_an_integrator_is_called_one():
    time = np.arange(0, 60, 0.1)
    rate = np.sin(0.3 * time) + 0.5 * np.sin(1.1 * time)
    x = (1 - np.cos(0.3 * time)) / 0.3 + 0.5 * (1 - np.cos(1.1 * time)) / 1.1
    model = quietly([run(time, x=x, u=rate)])
    text = model.summary()
    assert "integrator" in text
    assert "UNSTABLE" not in text


def test_growth_is_judged_by_what_it_does():
    assert Growth(0, 1e-9, seconds=100).word == "integrator"
    assert Growth(0, 0.3, seconds=100).word == "UNSTABLE"
    assert Growth(0, 0.3, seconds=100, error=0.2).word.startswith("growth within")
    assert Growth(0, -0.3, seconds=100).word == ""


def test_verdicts_have_words():
    assert [grade(e) for e in (0.1, 0.5, 2.0, None)] == [
        "usable",
        "for trends only",
        "not usable",
        "not usable",
    ]


def test_stray_samples_and_runs_in_another_unit():
    time = np.arange(100.0)
    rng = np.random.default_rng(6)
    runs = [run(time, x=5 + rng.standard_normal(100)) for _ in range(3)]
    window = (None, None)
    assert screened(runs, ["x"], "refuse", window, DerivativeSettings()) == runs
    for value in (1e6, 1e160):
        x = runs[0]["x"].copy()
        x[40] = value
        bad = [run(time, x=x), *runs[1:]]
        with pytest.raises(DfsmError, match=r"run: 'x' is 1e\+\d+ at 40 s, far beyond"):
            screened(bad, ["x"], "refuse", window, DerivativeSettings())
        mended = screened(bad, ["x"], "drop", window, DerivativeSettings())[0]
        assert mended["x"][40] == pytest.approx((x[39] + x[41]) / 2)
        if value < 1e100:  # whose squares are numbers
            assert screened(bad, ["x"], "keep", window, DerivativeSettings()) == bad
    mixed = [run(time, x=runs[0]["x"] * 1000), *runs[1:]]
    with pytest.raises(DfsmError, match=r"'x' \(no unit\) is \d+ times .* \(a thousand\)"):
        screened(mixed, ["x"], "refuse", window, DerivativeSettings())
    assert screened(mixed, ["x"], "drop", window, DerivativeSettings()) == mixed[1:]
    pulse = np.zeros(100)
    pulse[30] = 1.0
    screened([run(time, x=pulse)], ["x"], "refuse", window, DerivativeSettings())


def test_a_run_that_is_small_as_a_whole_is_no_run_in_another_unit():
    time, rng = np.arange(100.0), np.random.default_rng(9)
    pairs = np.sin(2 * np.pi / 20 * time + rng.uniform(0, 6, (3, 2, 1)))
    for factor in (1000.0, 57.3, 9.55):
        small = [run(time, x=x, u=u * 1e3, p=x * u) for x, u in pairs]
        x, u = pairs[0] / factor
        small[0] = run(time, x=x, u=u * 1e3, p=x * u)
        screened(small, ["x", "u", "p"], "refuse", (None, None), DerivativeSettings())
        # One that moves as it does in the others tells that the rest is in another unit.
        small[0] = run(time, x=x, u=pairs[0][1] * 1e3, p=x * u)
        with pytest.raises(DfsmError, match="as if in another unit"):
            screened(small, ["x", "u", "p"], "refuse", (None, None), DerivativeSettings())


def test_standard_errors_are_those_of_the_time_on_bunched_meshes():
    even = np.linspace(0, 100, 1001)
    bunched = np.unique(np.concatenate([even, np.linspace(50, 50.05, 1000)]))
    errors = []
    for time in (even, bunched):
        u = np.sin(0.9 * time) + np.sin(0.37 * time)
        x = solve_ivp(
            lambda t, x: -0.5 * x + np.sin(0.9 * t) + np.sin(0.37 * t) + 0.05 * np.sin(2.1 * t + 1),
            (0, 100), [1.0], t_eval=time, rtol=1e-9, atol=1e-10, max_step=0.1,
        ).y[0]  # fmt: skip
        row = quietly([run(time, x=x, u=u)]).provenance.record["rows"][0]
        errors.append([error for *_, error in row["coefficients"]])
    assert_allclose(errors[1], errors[0], rtol=0.3)


def test_runs_in_two_units_are_told_of_their_units_first():
    time = np.arange(100.0)
    runs = [
        Trajectory(time, np.sin(time + k)[:, None] * scale, (Channel("x", unit),))
        for k, (scale, unit) in enumerate([(1e3, "N"), (1.0, "kN"), (1.0, "kN")])
    ]
    assert len(screened(runs, ["x"], "refuse", (None, None), DerivativeSettings())) == 3


def test_a_state_that_is_held_in_its_file_is_told_and_joined_where_named():
    time = np.arange(0, 200, 0.2)
    u = np.sin(0.4 * time) + np.sin(0.15 * time)
    # x' = -0.5 x + u, its answer to each sine
    w = np.array([[0.4], [0.15]])
    x = ((0.5 * np.sin(w * time) - w * np.cos(w * time)) / (0.25 + w**2)).sum(axis=0)
    staircase = run(time, x=x[np.arange(len(time)) // 5 * 5], u=u)
    model, notes = told([staircase])
    assert "'x' changes every 1 s only" in notes[0]
    assert "data.slower: {x: linear}" in notes[0]
    assert float(model.f.coefficients[0, 0, 1]) > -0.45
    joined = fit([staircase], replace(SETTINGS, slower={"x": "linear"})).model
    assert_allclose(joined.f.coefficients[0, 0], [1, -0.5], rtol=0.05)


def test_an_input_that_is_held_and_new_at_every_sample_is_told():
    u, decay = np.random.default_rng(8).standard_normal(800), np.exp(-0.4)
    held, lines = np.zeros(800), np.zeros(800)
    ramp = 1 - (1 - decay) / 0.4
    for k in range(799):
        held[k + 1] = decay * held[k] + (1 - decay) * u[k]
        step = u[k + 1] - u[k]
        lines[k + 1] = decay * lines[k] + (1 - decay) * u[k] + ramp * step
    assert held_unseen(lambda: [(held[:, None], u[:, None])]) == [0]
    assert held_unseen(lambda: [(lines[:, None], u[:, None])]) == []
    halves = [(held[k : k + 400, None], u[k : k + 400, None]) for k in (0, 400)]
    assert held_unseen(lambda: halves) == [0]
    _, notes = told([run(np.arange(800.0), x=held, u=u)])
    assert any("set inputs: {u: hold}" in note for note in notes)
    chosen = fit([run(np.arange(800.0), x=held, u=u)], replace(SETTINGS, inputs="hold")).model
    assert_allclose(chosen.f.coefficients[0, 0], [0.4, -0.4], rtol=1e-3)


def test_a_loop_that_is_excited_a_little_is_not_believed_either():
    rng = np.random.default_rng(4)
    force = 0.1 * slow(rng, 900, 30)
    wanted = 0.5 * slow(rng, 900, 10)
    at = np.arange(900.0)

    def control(x, i, k):
        return np.interp(k, at, wanted) - 1.0 * x - 0.05 * i

    model, notes = told([plant(control, force, 900)])
    first = float(model.f.coefficients[0, 0, 0])
    assert first < 0.7 * B  # what the note is about
    (note,) = [n for n in notes if n.startswith("x_dot: what the fit leaves over is correlated")]
    second = float(note.split("modelled ")[1].split(" ")[0])
    assert abs(second - B) < abs(first - B) / 2
    assert model.provenance.record["verdicts"][0]["verdict"] != "usable"


@pytest.mark.parametrize("seed", range(3))
def test_sines_in_open_loop_are_believed(seed):
    rng = np.random.default_rng(seed)
    force = 0.05 * slow(rng, 900, 30)
    rates, phases = rng.uniform(0.05, 0.4, 4), rng.uniform(0, 6, 4)
    quietly([plant(lambda x, i, k: np.sin(rates * k + phases).sum(), force, 900)])
