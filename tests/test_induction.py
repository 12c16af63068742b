"""Dynamic inflow: the induced velocity of a rotor as a hidden state of its term."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import brentq

import dfsm
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, hushed
from dfsm.models.latents import at_rest
from dfsm.models.terms import RotorTerm
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.record import record_of
from dfsm.refinement.rollout_error import ErrorWeights, RolloutError
from dfsm.refinement.slopes import state_matrix
from dfsm.refinement.start import start_latents
from dfsm.refinement.windows import start_slopes, starts, windows_of
from systems import cost_slopes, wander

TABLE = dfsm.read_rotor_table(
    Path(__file__).parents[1] / "examples" / "iea15" / "Cp_Ct_Cq.IEA15MW.txt"
)
RADIUS, DENSITY = 120.97, 1.225
ROTOR = dfsm.Rotor(
    table=TABLE,
    radius=RADIUS,
    wind="Wind",
    speed="Speed",
    pitch="Pitch",
    inertia=318.6e6,
    generator_torque="Torque",
    memory="wind",
)
LAGGING = replace(ROTOR, induction="lag")
SETTINGS = dfsm.FitSettings(
    states=(dfsm.StateSpec(name="Speed"),),
    controls=("Torque", "Pitch"),
    disturbances=("Wind",),
    linear=dfsm.LTI(),
    terms=(LAGGING,),
    corrective=dfsm.NoCorrection(),
    nonlinear_only=False,
)
CHANNELS = {
    "Torque": Channel("Torque", "kN-m"),
    "Pitch": Channel("Pitch", "deg"),
    "Wind": Channel("Wind", "m/s"),
    "Speed": Channel("Speed", "rpm"),
}
# Of I = [torque, pitch, wind, speed, induced velocity].
COLUMNS = {name: k for k, name in enumerate(CHANNELS)}
WAKE = 4


# -- the term -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def steady() -> RotorTerm:
    return ROTOR.term(CHANNELS, COLUMNS)


STATES = ("rotor.induced", "rotor.induced_slow")


@pytest.fixture(scope="module", params=[1, 2])
def lagging(request, steady) -> RotorTerm:
    """With one state, as in models made before there were two, and with two."""
    return steady.lagging(STATES[: request.param], WAKE)


def induction(thrust_coefficient: float) -> float:
    """Madsen et al. 2020, Eq. 3."""
    c = thrust_coefficient
    return 0.251163 * c + 0.054496 * c**2 + 0.089207 * c**3


def inflow_of(thrust: RectBivariateSpline, tips: float, pitch: float, wind: float) -> float:
    """Wind in m/s that reaches the blades of a rotor whose wake has settled."""
    return wind * (1 - induction(float(thrust.ev(tips / wind, pitch))))


def apart(axial: Callable[[float], float], inflow: float, wind: float) -> float:
    return axial(wind) - inflow


OPERATING = np.array(
    [(6.0, 4.9, 0.4), (8.0, 5.6, 0.3), (10.6, 7.56, 0.1), (12.2, 7.5, 7.4), (18, 7.6, 14.6)]
)


def inputs_of(signals: jax.Array) -> jax.Array:
    """I of wind, speed, pitch and the wake's states, ``(..., 3 + n)`` to ``(..., 4 + n)``."""
    wind, speed, pitch, *induced = jnp.moveaxis(signals, -1, 0)
    return jnp.stack([jnp.zeros_like(wind), pitch, wind, speed, *induced], axis=-1)


def test_a_settled_wake_has_the_forces_of_the_table(steady, lagging):
    rng = np.random.default_rng(0)
    at = jnp.asarray(rng.uniform([-20.0, -1.0, -12.0], [40.0, 15.0, 40.0], (300, 3)))
    count = lagging.about.lags
    rest = jnp.concatenate([at, jnp.zeros((300, count))], axis=1)
    settled, lags = jax.vmap(lagging.wake)(inputs_of(rest))
    values = jax.vmap(lagging.values)(rest.at[:, 3:].set(settled[:, None]))
    plain = jax.vmap(steady.values)(at)
    np.testing.assert_allclose(values[:, :2], plain, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(values[:, 2:], 0.0, atol=1e-12)
    assert values.shape == (300, 2 + count)
    assert (lags > 0).all()
    assert (np.abs(settled) <= np.abs(at[:, 0])).all()


def test_forces_and_lag_before_it_has_settled(lagging):
    """Against momentum theory and the table, solved point by point."""
    thrust = RectBivariateSpline(TABLE.tip_speed_ratio, TABLE.pitch, TABLE.ct)
    torque = RectBivariateSpline(TABLE.tip_speed_ratio, TABLE.pitch, TABLE.cq)
    size = 0.5e-3 * DENSITY * np.pi * RADIUS**2
    for wind, rpm, pitch in OPERATING:
        tips = rpm * np.pi / 30 * RADIUS
        axial = partial(inflow_of, thrust, tips, pitch)
        settled = wind - axial(wind)
        still = [wind, rpm, pitch, *[0.0] * lagging.about.lags]
        own = float(lagging.wake(inputs_of(jnp.array(still)))[0])
        assert own == pytest.approx(settled, rel=0.01)
        for change in (-0.5, 0.3):
            # Of one state alone four tenths of the induced velocity have settled at once.
            two, now = lagging.about.lags == 2, 0.6 * change
            inflow = axial(wind) - now
            seen = brentq(partial(apart, axial, inflow), 0.8 * wind, 1.25 * wind)
            expected = np.array(
                [thrust.ev(tips / seen, pitch), RADIUS * torque.ev(tips / seen, pitch)]
            )
            slow = -2 * change if two else change
            states = [own + now, own + slow][-lagging.about.lags :]
            values = np.asarray(lagging.values(jnp.array([wind, rpm, pitch, *states])))
            np.testing.assert_allclose(values[:2], size * seen**2 * expected, rtol=0.005)
            lag = 1.1 * RADIUS / (wind - 1.3 * settled)
            assert values[-1] == pytest.approx(-slow / lag, rel=0.08)
            if two:
                # Six tenths of what has settled are followed at a quarter of the lag.
                quick = (0.4 * slow - now) / (0.25 * lag)
                assert values[2] == pytest.approx(quick, rel=0.08)


def test_it_is_smooth_and_finite_everywhere(lagging):
    rng = np.random.default_rng(1)
    more = lagging.about.lags
    low, high = [-70, -1, -90, *[-60] * more], [70, 25, 90, *[60] * more]
    at = rng.uniform(low, high, (400, 3 + more))
    at[:8, 0], at[4:12, 1], at[2:6, 3:] = 0.0, 0.0, 0.0
    second = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(lagging.values))))(jnp.asarray(at))
    assert np.isfinite(np.asarray(second)).all()
    # From behind, through no wind and the table, and beyond: no step in the second derivative.
    still = [7.0, 2.0, *[2.0] * more]
    a, b = jnp.array([-9.0, *still]), jnp.array([30.0, *still])
    bend = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(lambda t: lagging.values(a + t * (b - a))))))
    fine = [np.asarray(bend(jnp.linspace(0, 1, n))) for n in (20001, 40001)]
    steps = [np.abs(np.diff(f, axis=0)).max(axis=0) for f in fine]
    assert (steps[1] < 0.7 * steps[0]).all()


# -- models ---------------------------------------------------------------------------------------


def recorded(seed: int, mean: float, pace: Array | None = None) -> Trajectory:
    """A rotor whose wake lags, under a controller, by small steps."""
    rng = np.random.default_rng(seed)
    step, time = 0.25, np.arange(0, 150.01, 0.25)
    wind = wander(rng, mean, 2.0, 0.3)(time)
    pitch = 1.0 + wander(rng, 2.0, 2.0, 0.2)(time)
    torque = wander(rng, 8e3, 3e3, 0.2)(time) * (mean / 9) ** 2
    term = replace(
        ROTOR.term(CHANNELS, COLUMNS).lagging(STATES, WAKE),
        pace=jnp.zeros(3) if pace is None else jnp.asarray(pace),
    )
    driven = jnp.stack([jnp.asarray(c) for c in (wind, pitch, torque)], axis=1)
    x0 = jnp.array([5.5, 0.0, 0.0])
    start = inputs_of(jnp.array([wind[0], x0[0], pitch[0], 0.0, 0.0]))
    x0 = x0.at[1:].set(term.wake(start)[0])

    def rate(x, v):
        _, torque, *wake = term.values(jnp.array([v[0], x[0], v[1], *x[1:]]))
        return jnp.array([(torque - v[2]) * 1e3 / 318.6e6 * 30 / np.pi, *wake])

    def march(x, pair):
        first, last = pair
        middle = (first + last) / 2
        k1 = rate(x, first)
        k2 = rate(x + step / 2 * k1, middle)
        k3 = rate(x + step / 2 * k2, middle)
        x = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + step * k3, last))
        return x, x

    path = jax.jit(lambda: jax.lax.scan(march, x0, (driven[:-1], driven[1:]))[1])()
    speed = np.concatenate([[5.5], np.asarray(path)[:, 0]])
    values = np.column_stack([torque, pitch, wind, speed])
    return Trajectory(time, values, tuple(CHANNELS.values()), name=f"lag{mean:g}_{seed}")


# The truth's wake lags by three times Øye's.
SLOW = np.array([np.arctanh(np.log(3) / np.log(4)), 0.0, 0.0])


@pytest.fixture(scope="module")
def runs() -> list[Trajectory]:
    return [recorded(seed, mean, SLOW) for seed, mean in enumerate((8.0, 10.0, 9.0))]


@pytest.fixture(scope="module")
def model(runs) -> dfsm.DFSM:
    with hushed():
        return dfsm.fit(runs[:2], SETTINGS).model


def wake_of(model: dfsm.DFSM, run: Trajectory, at: int) -> float:
    signals = jnp.array([*(run[n][at] for n in ("Wind", "Speed", "Pitch")), 0.0, 0.0])
    return float(model.terms.parts[0].wake(inputs_of(signals))[0])


def test_the_wake_is_a_hidden_state_that_has_settled_at_the_start(model, runs, tmp_path):
    assert model.signals.names("states") == ("Speed", *STATES)
    assert [c.name for c in model.terms.channels][-2:] == [f"{n}_rate" for n in STATES]
    late = replace(runs[2], time=runs[2].time + 20)
    rollout = dfsm.simulate(model, late, start=60.0).trajectory
    k = int(np.searchsorted(late.time, 60.0))
    for name in STATES:
        assert rollout[name][0] == pytest.approx(wake_of(model, late, k), rel=1e-6)
        assert np.ptp(rollout[name]) > 0.1
    given = dfsm.simulate(model, late, start=60.0, initial=[late["Speed"][k]]).trajectory
    np.testing.assert_array_equal(given.values, rollout.values)
    dfsm.save(model, tmp_path / "model")
    again = dfsm.simulate(dfsm.load(tmp_path / "model"), late, start=60.0).trajectory
    np.testing.assert_array_equal(again.values, rollout.values)
    settled = dfsm.steady_state(model)
    assert settled.converged
    inputs = model.join(settled.states, settled.controls, settled.disturbances)
    np.testing.assert_allclose(at_rest(model, inputs), inputs, rtol=1e-9)


def test_an_optimum_begins_with_the_wake_of_the_record(model, runs):
    problem = dfsm.OptimalControlProblem(
        model=model, horizon=(50.0, 80.0), cost=lambda s: s.x.Speed, disturbances=runs[2]
    )
    k = int(np.searchsorted(runs[2].time, 50.0))
    assert problem.latent_starts["rotor.induced"][0] == pytest.approx(wake_of(model, runs[2], k))
    assert not problem.latent_paths(np.array([50.0]))
    # Nothing but the wind is known: what the training runs did in that wind is taken.
    wind = replace(problem, disturbances=runs[2].select(["Wind"]), initial={"Speed": 6.0})
    values = np.array(model.region.operating)[0]
    values[[2, 3]] = runs[2]["Wind"][k], 6.0
    expected = float(model.terms.parts[0].wake(jnp.asarray(values))[0])
    assert wind.latent_starts["rotor.induced"][0] == pytest.approx(expected)


def test_exports_have_the_wake(model):
    exported = dfsm.to_casadi(model)
    x, u, w = [5.8, 1.7, 1.9], [8e3, 2.0], [9.0]
    ours = np.asarray(model.derivative(x, u, w))
    theirs = exported.f(x, u, w, [])
    np.testing.assert_allclose(np.asarray(theirs).ravel(), ours, rtol=1e-11)


@pytest.mark.parametrize("length", [None, 15.0])
def test_slopes_agree_with_differences(model, runs, length):
    record = record_of(model, runs[0], 0.5, 0.0, 30.0)
    wide = start_latents(model, [record], 2, np.array([0.05]))
    assert wide.signals.names("states") == ("Speed", *STATES, "latent1", "latent2")
    parameters = Parametrization.of(wide, np.array([0.05]))
    problem = RolloutError(parameters, [[record]], length, ErrorWeights(np.ones(1)))
    at = 0.003 * np.random.default_rng(0).normal(size=parameters.size)
    _, Jtr = problem.normal_equations(at)
    slopes = cost_slopes(problem, at)
    np.testing.assert_allclose(2 * Jtr, slopes, rtol=1e-4, atol=1e-5 * np.abs(slopes).max())


def test_slopes_at_the_starts_are_nearly_those_of_the_starts(model, runs):
    """Of latent pairs and of the wakes that they change, through all the record before a window."""
    record = record_of(model, runs[0], 0.5, 0.0, 30.0)
    wide = start_latents(model, [record], 2, np.array([0.05]))
    parameters = Parametrization.of(wide, np.array([0.05]))
    windows = windows_of(record, 15.0, wakes=True)
    at = jnp.asarray(0.003 * np.random.default_rng(0).normal(size=parameters.size))
    exact = jax.jit(jax.jacfwd(lambda w: starts(parameters.at(w), windows)))(at)
    pairs, marched = eqx.filter_jit(start_slopes)(parameters, at, windows)
    found = np.zeros(exact.shape)
    found[:, :3] = marched
    found[:, 3:, parameters.latent_columns[0]] = pairs[:, 0]
    assert np.linalg.norm(found - exact) < 0.01 * np.linalg.norm(exact)
    assert np.abs(exact[1, 1:3]).max() > 0.1


def test_slopes_in_the_states_written_out_are_those_of_the_model(model, runs):
    scheduled = replace(
        model,
        f=replace(
            model.f,
            schedule=model.signals.state_columns.start,
            grid=jnp.array([4.0, 8.0]),
            coefficients=jnp.concatenate([model.f.coefficients, 1.1 * model.f.coefficients]),
            offsets=jnp.concatenate([model.f.offsets, model.f.offsets + 0.1]),
        ),
    )
    record = record_of(model, runs[0], 0.5, 0.0, 30.0)
    for one in (model, scheduled):
        inputs = jnp.asarray(record.inputs_at(one)[::7])
        marched = one.signals.marched

        def rates(x, others, one=one, marched=marched):
            return one.derivative(x, *others)[:marched]

        for at in inputs:
            x, *others = one.split(at)
            exact = jax.jacfwd(rates)(x, others)
            np.testing.assert_allclose(state_matrix(one, at), exact, rtol=1e-10, atol=1e-12)


def test_the_lag_is_learnt_from_rollouts(model, runs):
    settings = dfsm.RefineSettings(windows=(None,), step=0.5, iterations=8, hold_out=0.4)
    with hushed():
        refined = dfsm.refine(model, runs[:2], settings).model
        errors = [
            np.sqrt(
                np.mean((dfsm.simulate(m, runs[2]).trajectory["Speed"] - runs[2]["Speed"]) ** 2)
            )
            for m in (model, refined)
        ]
    assert errors[1] < 0.3 * errors[0]
    factor = 4 ** np.tanh(np.asarray(refined.terms.parts[0].pace)[0])
    assert factor == pytest.approx(3.0, rel=0.15)


def test_another_signal_of_that_name_is_refused(runs):
    values = np.column_stack([runs[0].values, runs[0]["Wind"]])
    run = replace(
        runs[0], values=values, channels=(*runs[0].channels, Channel("rotor.induced", "m/s"))
    )
    settings = replace(SETTINGS, disturbances=("Wind", "rotor.induced"))
    with hushed(), pytest.raises(DfsmError, match=r"called 'rotor.induced', as another signal is"):
        dfsm.fit([run], settings)
