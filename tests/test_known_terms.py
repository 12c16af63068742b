"""Models with known terms inside their linear fits: drag, and a rotor that spins and pitches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dfsm
from conftest import write_config
from dfsm.config.fit import load_config
from dfsm.core.types import Array
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, hushed
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.record import record_of
from dfsm.refinement.rollout_error import ErrorWeights, RolloutError
from dfsm.refinement.start import start_latents
from systems import cost_slopes, wander

TABLE = Path(__file__).parents[1] / "examples" / "iea15" / "Cp_Ct_Cq.IEA15MW.txt"
TIME = np.arange(0, 60.01, 0.05)
RADIUS, INERTIA, HUB = 120.97, 318.6e6, 150.0
# kN m of generator torque to rpm/s.
BRAKING = -30 / np.pi * 1e3 / INERTIA


def solved(f: Any, x0: list[float], time: Array) -> Array:
    answer = solve_ivp(f, (time[0], time[-1]), x0, "DOP853", time, rtol=1e-10, atol=1e-10)
    return answer.y.T


# -- a body with quadratic drag -------------------------------------------------------------------

DRAG = dfsm.FitSettings(
    states=(dfsm.StateSpec(name="q", order=2),),
    controls=("u",),
    linear=dfsm.LTI(),
    terms=(dfsm.QuadraticDrag(velocity="q_dot"),),
    corrective=dfsm.NoCorrection(),
    nonlinear_only=False,
)


def body(seed: int, size: float = 6.0) -> Trajectory:
    """q'' = -4 q - 0.2 q' - 0.5 |q'| q' + 2 u."""
    u = wander(np.random.default_rng(seed), 0.0, size, 2.0)

    def f(t: float, x: Array) -> list[float]:
        force = 2 * float(u(np.array([t]))[0])
        return [x[1], -4 * x[0] - 0.2 * x[1] - 0.5 * abs(x[1]) * x[1] + force]

    values = np.column_stack([solved(f, [0.5, 0.0], TIME)[:, 0], u(TIME)])
    return Trajectory(TIME, values, (Channel("q", "m"), Channel("u", "N")), name=f"body{seed}")


@pytest.fixture(scope="module")
def bodies() -> list[Trajectory]:
    return [body(seed) for seed in range(4)]


@pytest.fixture(scope="module")
def dragged(bodies) -> dfsm.DFSM:
    return dfsm.fit(bodies[:3], DRAG).model


def test_coefficients_of_terms_are_learnt(dragged, bodies):
    row = np.asarray(dragged.f.coefficients)[0, 1]
    np.testing.assert_allclose(row, [2.0, -4.0, -0.2, -0.5], rtol=2e-3)
    with hushed():
        rollout = dfsm.simulate(dragged, bodies[3])
        plain = dfsm.simulate(dfsm.fit(bodies[:3], replace(DRAG, terms=())).model, bodies[3])
    errors = [
        np.sqrt(np.mean((r.trajectory["q"] - bodies[3]["q"]) ** 2)) / bodies[3]["q"].std()
        for r in (rollout, plain)
    ]
    assert errors[0] < 2e-3
    assert errors[1] > 20 * errors[0]


def test_jacobians_and_eigenvalues_see_terms(dragged):
    x, u = np.array([0.3, 0.8]), np.array([0.4])
    A, *_ = dragged.jacobians(x, u, [])
    np.testing.assert_allclose(A[1], [-4.0, -0.2 - 2 * 0.5 * 0.8], rtol=2e-3)
    step = 1e-6
    up, down = (dragged.derivative(x + np.array([0, d]), u, []) for d in (step, -step))
    np.testing.assert_allclose(A[:, 1], (up - down) / (2 * step), rtol=1e-6)
    # The mean velocity is almost zero, and so is the slope of the drag there.
    linear = np.linalg.eigvals(np.array([[0.0, 1.0], [-4.0, -0.2]]))
    (_, values), *_ = dragged.eigenvalues()
    np.testing.assert_allclose(sorted(values.imag), sorted(linear.imag), rtol=0.02)


def test_terms_are_saved_and_loaded(dragged, bodies, tmp_path):
    dfsm.save(dragged, tmp_path / "model")
    loaded = dfsm.load(tmp_path / "model")
    with hushed():
        both = [dfsm.simulate(m, bodies[3]).trajectory.values for m in (dragged, loaded)]
    np.testing.assert_array_equal(*both)


def test_a_summary_names_terms(dragged):
    assert "terms: drag(q_dot)" in dragged.summary()


def test_a_users_function_is_passed_again(bodies, tmp_path):
    def cubic(x: jax.Array) -> jax.Array:
        return x**3

    term = dfsm.Function(name="cube", function=cubic, inputs=("q",))
    model = dfsm.fit(bodies[:2], replace(DRAG, terms=(*DRAG.terms, term))).model
    assert np.asarray(model.f.coefficients)[0, 1, -1] == pytest.approx(0.0, abs=0.02)
    dfsm.save(model, tmp_path / "model")
    with pytest.raises(DfsmError, match=r"Python function 'cube'.*pass functions="):
        dfsm.load(tmp_path / "model")
    loaded = dfsm.load(tmp_path / "model", {"cube": cubic})
    point = ([0.1, 0.2], [0.3], [])
    np.testing.assert_array_equal(loaded.derivative(*point), model.derivative(*point))


def test_a_margin_counts_the_slopes_of_terms(bodies):
    """A term that drives the velocity: the linear part must damp more than it."""
    push = dfsm.Function(name="push", function=lambda v: 0.3 * v, inputs=("q_dot",))
    linear = dfsm.LTI(known={"q": {"push": 1.0}}, margin=0.25)
    settings = replace(DRAG, terms=(*DRAG.terms, push), linear=linear)
    with hushed():
        model = dfsm.fit(bodies[:3], settings).model
    x, u, w, _ = model.split(model.region.operating[0])
    A = model.jacobians(x, u, w)[0]
    assert np.linalg.eigvals(A).real.max() == pytest.approx(-0.25, rel=0.02)
    assert model.eigenvalues()[0][1].real.max() <= -0.25


def test_an_optimum_uses_the_terms(dragged):
    """The energy of a fixed motion, which its own drag tells: ∫ u² of the exact inverse."""
    problem = dfsm.OptimalControlProblem(
        model=dragged,
        horizon=(0.0, 4.0),
        cost=lambda s: s.u.u**2,
        initial={"q": 0.0, "q_dot": 0.0},
        final={"q": 2.0, "q_dot": 0.0},
    )
    solution = dfsm.solve(problem, dfsm.DirectTranscription(mesh=40), simulate=False)
    assert solution.solved
    t = solution.trajectory.time
    q, v = solution.trajectory["q"], solution.trajectory["q_dot"]
    force = (np.gradient(v, t) + 4 * q + 0.2 * v + 0.5 * abs(v) * v) / 2
    inner = slice(3, -3)
    np.testing.assert_allclose(solution.trajectory["u"][inner], force[inner], atol=0.15)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (replace(DRAG, terms=(dfsm.QuadraticDrag(velocity="speed"),)), "'speed' is no state"),
        (replace(DRAG, linear=dfsm.LTI(only={"z": ("u",)})), "linear.only names 'z'"),
        (replace(DRAG, linear=dfsm.LTI(only={"q": ("v",)})), "linear.only.q names 'v'"),
        (replace(DRAG, linear=dfsm.LTI(known={"q": {"drg(q_dot)": 1.0}})), "drag"),
        (replace(DRAG, terms=(DRAG.terms[0], DRAG.terms[0])), "two inputs of the linear fit"),
    ],
)
def test_wrong_names_are_told(bodies, settings, message):
    with pytest.raises(DfsmError, match=message):
        dfsm.fit(bodies[:2], settings)


# -- a rotor on a platform that pitches -----------------------------------------------------------

ROTOR = dfsm.Rotor(
    table=TABLE,
    radius=RADIUS,
    wind="Wind",
    speed="Speed",
    pitch="Pitch",
    hub_height=HUB,
    pitch_rate="Lean_dot",
    corrections=("Ring",),
    inertia=INERTIA,
    generator_torque="Torque",
)
SPINNING = dfsm.FitSettings(
    states=(dfsm.StateSpec(name="Lean", order=2), dfsm.StateSpec(name="Speed")),
    controls=("Torque", "Pitch"),
    disturbances=("Wind", "Ring"),
    linear=dfsm.LTI(only={"Lean": ("rotor.thrust", "Lean", "Lean_dot")}),
    terms=(ROTOR,),
    corrective=dfsm.NoCorrection(),
    nonlinear_only=False,
)
# Share of the ring in the wind at the rotor.
RING = 0.4


def spinning(seed: int, mean: float, overhang: float | None = None) -> Trajectory:
    """A rotor in closed loop in wind of which a share of the ring's is no part of `Wind`.

    One with an overhang in m stands so far upwind of where the wind is told, less what it leans,
    and the ring tells it nothing.
    """
    share, pace = (RING, 0.3) if overhang is None else (0.0, 0.15)
    rng = np.random.default_rng(seed)
    time = np.arange(0, 300.01, 0.25)
    wind, ring = wander(rng, mean, 1.5, pace), wander(rng, 0.0, 0.8, pace)
    table = dfsm.read_rotor_table(TABLE)
    channels = {c: Channel(c, u) for c, u in (("Wind", "m/s"), ("Speed", "rpm"), ("Pitch", "deg"))}
    columns = {name: k for k, name in enumerate(channels)}
    plain = dfsm.Rotor(table=table, radius=RADIUS, wind="Wind", speed="Speed", pitch="Pitch")
    term = plain.term(channels, columns)
    forces = jax.jit(lambda signals: term.values(signals))

    def controls(speed: float) -> tuple[float, float]:
        return 1.5e3 * speed, max(0.0, 4.0 * (speed - 6.5))

    def f(t: float, x: Array) -> list[float]:
        ahead = 0.0 if overhang is None else (overhang - HUB * np.deg2rad(x[0])) / mean
        at = np.array([t + ahead])
        flow = float(wind(at)[0] + share * ring(at)[0]) - HUB * np.deg2rad(x[1])
        torque, pitch = controls(x[2])
        thrust, driving = np.asarray(forces(jnp.array([flow, x[2], pitch])))
        lean = -0.06 * x[0] - 0.05 * x[1] + 2e-4 * thrust
        return [x[1], lean, -BRAKING * (driving - torque)]

    answer = solve_ivp(f, (0, 300), [3.0, 0.0, 6.0], "RK45", time, rtol=1e-7, atol=1e-8, max_step=1)
    lean, _, speed = answer.y
    torque, pitch = np.array([controls(s) for s in speed]).T
    values = np.column_stack([lean, speed, torque, pitch, wind(time), ring(time)])
    listed = ("Lean", "deg"), ("Speed", "rpm"), ("Torque", "kN-m"), ("Pitch", "deg")
    names = (*listed, ("Wind", "m/s"), ("Ring", "m/s"))
    return Trajectory(time, values, [Channel(*n) for n in names], name=f"rotor{mean:g}_{seed}")


@pytest.fixture(scope="module")
def turbines() -> list[Trajectory]:
    return [spinning(seed, mean) for seed, mean in enumerate((8.0, 13.0, 10.0))]


@pytest.fixture(scope="module")
def started(turbines) -> dfsm.DFSM:
    with hushed():
        return dfsm.fit(turbines[:2], SPINNING).model


def test_mechanics_of_a_rotor_of_known_inertia(started):
    names = [c.name for c in (*started.signals.inputs, *started.terms.channels)]
    row = dict(zip(names, np.asarray(started.f.coefficients)[0, 1], strict=True))
    assert row.pop("Torque") == pytest.approx(BRAKING)
    assert row.pop("rotor.torque") == pytest.approx(-BRAKING)
    assert set(row.values()) == {0.0}
    lean = dict(zip(names, np.asarray(started.f.coefficients)[0, 2], strict=True))
    assert lean["rotor.thrust"] == pytest.approx(2e-4, rel=0.1)
    assert lean["Wind"] == lean["Torque"] == 0.0


def test_what_reaches_the_rotor_is_learnt_from_rollouts(started, turbines):
    """Trained at 8 and 13 m/s, right at 10, because the share of the ring is the same there."""
    settings = dfsm.RefineSettings(windows=(50.0, None), step=1.0, iterations=8, hold_out=0.4)
    with hushed():
        refined = dfsm.refine(started, turbines[:2], settings).model
        runs = [dfsm.simulate(m, turbines[2]).trajectory for m in (started, refined)]
    gains = np.asarray(refined.terms.parts[0].gains)
    assert gains[0] == pytest.approx(RING, abs=0.05)
    errors = [
        np.sqrt(np.mean((run["Speed"] - turbines[2]["Speed"]) ** 2)) / turbines[2]["Speed"].std()
        for run in runs
    ]
    assert errors[1] < 0.05
    assert errors[0] > 3 * errors[1]


def test_the_wind_is_met_where_a_rotor_stands():
    runs = [spinning(seed, mean, 24.0) for seed, mean in enumerate((8.0, 13.0, 10.0))]
    gusts = dfsm.Feature(source="Wind", kind="rate", seconds=0.5)
    place = {"overhang": 24.0, "wind_rate": gusts.name, "platform_pitch": "Lean"}
    there = replace(SPINNING, features=(gusts,), terms=(replace(ROTOR, **place),))
    errors = []
    for settings in (SPINNING, there):
        with hushed():
            model = dfsm.fit(runs[:2], settings).model
            found = dfsm.simulate(model, runs[2], stop=299).trajectory
        seen = runs[2].window(None, 299)
        errors.append(np.sqrt(np.mean((found["Speed"] - seen["Speed"]) ** 2)))
    # The wind's rate has no other way to act.
    names = [c.name for c in (*model.signals.inputs, *model.terms.channels)]
    assert not np.asarray(model.f.coefficients)[..., names.index(gusts.name)].any()
    assert errors[1] < 0.4 * errors[0]


@pytest.fixture(scope="module")
def remembering(turbines) -> dfsm.DFSM:
    """As `started`, with latent states that change the wind."""
    settings = replace(SPINNING, terms=(replace(ROTOR, memory="wind"),))
    with hushed():
        return dfsm.fit(turbines[:2], settings).model


def test_latent_states_change_the_wind_at_a_rotor_of_known_inertia(remembering, turbines):
    settings = dfsm.RefineSettings(windows=(50.0,), step=1.0, iterations=1, latents=2, hold_out=0.4)
    with hushed():
        refined = dfsm.refine(remembering, turbines[:2], settings).model
        rollout = dfsm.simulate(refined, turbines[2])
    assert rollout.status is dfsm.Status.COMPLETED
    rotor = refined.terms.parts[0]
    taken = [refined.signals.order.names[c] for c in rotor.columns]
    # The last column is the schedule's, of which a model with one point has none.
    assert taken[:-1] == [*ROTOR.inputs, "latent1", "latent2"]
    assert np.all(np.asarray(rotor.late)[0, :2] != 0)
    # What mechanics knows of the speed is the same, and nothing is added to it.
    names = [c.name for c in (*refined.signals.inputs, *refined.terms.channels)]
    row = dict(zip(names, np.asarray(refined.f.coefficients)[0, 1], strict=True))
    assert row.pop("Torque") == pytest.approx(BRAKING)
    assert row.pop("rotor.torque") == pytest.approx(-BRAKING)
    assert set(row.values()) == {0.0}
    assert float(refined.f.offsets[0, 1]) == 0.0


@pytest.mark.parametrize("latents", [0, 2])
def test_slopes_through_terms_agree_with_differences(started, remembering, turbines, latents):
    # Steps and windows of the refinements, so that what was compiled for them serves here.
    record = record_of(started, turbines[0], 1.0, None, None)
    spread = np.array([0.05, 0.02, 0.05])
    model = start_latents(remembering, [record], latents, spread) if latents else started
    parameters = Parametrization.of(model, spread)
    problem = RolloutError(parameters, [[record]], 50.0, ErrorWeights(np.ones(3)))
    at = 0.003 * np.random.default_rng(0).normal(size=parameters.size)
    _, Jtr = problem.normal_equations(at)
    slopes = cost_slopes(problem, at)
    np.testing.assert_allclose(2 * Jtr, slopes, rtol=1e-4, atol=1e-5 * np.abs(slopes).max())


# -- configuration --------------------------------------------------------------------------------


def test_terms_in_a_configuration(turbines, tmp_path):
    write_table(turbines[0], tmp_path / "a.parquet")
    (tmp_path / "table.txt").write_bytes(TABLE.read_bytes())
    rotor = {
        "kind": "rotor",
        "table": "table.txt",
        "radius": RADIUS,
        "wind": "Wind",
        "speed": "Speed",
        "pitch": "Pitch",
    }
    content = {
        "data": {"train": ["a.parquet"]},
        "signals": {
            "states": [{"name": "Speed"}],
            "controls": ["Torque", "Pitch"],
            "disturbances": ["Wind"],
        },
        "terms": [rotor, {"kind": "product", "factors": ["Torque", "Speed"], "name": "Power"}],
        "linear": {"kind": "LTI", "known": {"Speed": {"Power": 0.0}}},
        "corrective": {"kind": "none"},
    }
    config, runs = load_config(write_config(tmp_path / "c.yaml", content))
    with hushed():
        model = dfsm.fit(runs, config.fit_settings()).model
    assert [c.name for c in model.terms.channels] == ["rotor.thrust", "rotor.torque", "Power"]
    told = model.provenance.record["settings"]["terms"]
    assert told[0]["table"].endswith("table.txt")
    dfsm.save(model, tmp_path / "model")
    assert dfsm.load(tmp_path / "model").terms is not None


def test_radians_taken_for_turns_are_told(turbines):
    """A speed in rad/s under a name that says rpm puts every tip speed ratio off the table."""
    wrong = [
        replace(
            run, values=run.values * np.where([n == "Speed" for n in run.names], np.pi / 30, 1.0)
        )
        for run in turbines[:2]
    ]
    with pytest.raises(DfsmError, match=r"tip speed ratio"), hushed():
        dfsm.fit(wrong, SPINNING)
