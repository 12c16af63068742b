"""Black boxes from right-hand sides, against independent solvers, energy balances and formulas."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import simpson, solve_ivp
from scipy.linalg import expm

import dfsm
from dfsm import (
    Channel,
    DerivativeSettings,
    Multisine,
    ODESystem,
    RandomKnots,
    RandomSteps,
    StateSpec,
    Trajectory,
    Uniform,
    differentiate,
    excite,
    mass_chain,
    two_link_robot,
    two_link_robot_with_gravity,
)
from dfsm.simulators.two_link_robot import holding_torques
from dfsm.simulators.waveforms import held

TIME = np.linspace(0, 1, 201)
KNOTS = RandomKnots(low=-1.0, high=1.0, spacing=0.25)
STRONG = RandomKnots(low=-5.0, high=5.0, spacing=0.25)
STEPS = RandomSteps(low=-1.0, high=1.0, hold=(0.1, 0.3))
J1, J2, G, L1, L2, M1 = 0.12, 0.15, 9.81, 0.6, 0.8, 3.0
AT_REST, HOLDING = [0.7854, 0, -0.5236, 0], [26.1239, 9.4757]


# -- the robots, written another way ------------------------------------------------------------


def gravity_arm(x, u, m2=2.5):
    """Mass matrix and forces of the arm with gravity; solved by NumPy."""
    a, va, b, vb = x
    c = m2 * L1 * L2 * np.cos(b)
    M = np.array(
        [
            [M1 * L1**2 / 4 + J1 + m2 * (L1**2 + L2**2 / 4) + c + J2, m2 * L2**2 / 4 + c / 2 + J2],
            [m2 * L2**2 / 4 + c / 2 + J2, m2 * L2**2 / 4 + J2],
        ]
    )
    h = m2 * L1 * L2 * np.sin(b) / 2
    outer = m2 * G * L2 * np.cos(a + b) / 2
    inner = (M1 / 2 + m2) * G * L1 * np.cos(a) + outer
    forces = [u[0] + h * vb * (2 * va + vb) - inner, u[1] - h * va**2 - outer]
    accelerations = np.linalg.solve(M, forces)
    return np.array([va, accelerations[0], vb, accelerations[1]]), M


def flat_arm(x, u):
    """The arm without gravity from its mass matrix in the links' speeds in space."""
    a, b, angle, _ = x
    M = np.array([[7 / 3, 1.5 * np.cos(angle)], [1.5 * np.cos(angle), 4 / 3]])
    bend = 1.5 * np.sin(angle)
    speeds = np.linalg.solve(M, [u[0] - u[1] + bend * b**2, u[1] - bend * a**2])
    return np.array([*speeds, b - a, a]), M


def reference(f, time, x0, signal):
    """Solve to 1e-11 with DOP853, corner by corner."""
    inside = [t for t in signal.corners if 0 < t < time[-1]]
    states, x = [x0], np.asarray(x0, dtype=float)
    for a, b in pairwise([0.0, *inside, time[-1]]):
        rows = time[(time > a) & (time <= b)]
        last = np.nextafter(b, 0)
        solution = solve_ivp(
            lambda t, x, last=last: f(x, signal(min(t, last))),
            (a, b),
            x,
            method="DOP853",
            t_eval=np.unique([*rows, b]),
            rtol=1e-11,
            atol=1e-11,
        )
        assert solution.success
        states += list(solution.y.T[: len(rows)])
        x = solution.y[:, -1]
    return np.array(states)


def states_of(run, system):
    return run.select(c.name for c in system.states).values


@pytest.fixture(scope="module")
def flat_runs():
    return two_link_robot().campaign(4, TIME, Uniform(low=-0.5, high=0.5), KNOTS, seed=3)


@pytest.fixture(scope="module")
def gravity_runs():
    return two_link_robot_with_gravity().campaign(
        2, TIME, Uniform(low=-0.5, high=0.5), STRONG, seed=1
    )


def check_against_reference(run, f, kind, seed):
    signal = excite(kind, 2, 1.0, seed)
    assert np.array_equal(run.select(["tau1", "tau2"]).values, signal(TIME))
    states = reference(lambda x, u: f(x, u)[0], TIME, run.values[0, :4], signal)
    assert np.abs(states - run.values[:, :4]).max() < 1e-7


def test_the_flat_arm_agrees_with_an_independent_solver(flat_runs):
    check_against_reference(flat_runs[0], flat_arm, KNOTS, (3, 0, 1))
    check_against_reference(flat_runs[2], flat_arm, KNOTS, (3, 2, 1))


def test_the_arm_with_gravity_agrees_with_an_independent_solver(gravity_runs):
    check_against_reference(gravity_runs[1], gravity_arm, STRONG, (1, 1, 1))


def test_work_of_the_torques_becomes_energy_with_gravity(gravity_runs):
    for run in gravity_runs:
        x, tau = run.values[:, :4], run.values[:, 4:]
        a, b = x[:, 0], x[:, 2]
        speeds = x[:, [1, 3]]
        kinetic = [
            0.5 * v @ gravity_arm(row, [0, 0])[1] @ v for v, row in zip(speeds, x, strict=True)
        ]
        height1, height2 = L1 / 2 * np.sin(a), L1 * np.sin(a) + L2 / 2 * np.sin(a + b)
        energy = np.array(kinetic) + M1 * G * height1 + 2.5 * G * height2
        work = simpson((tau * speeds).sum(axis=1), x=run.time)
        assert np.ptp(energy) > 1
        assert energy[-1] - energy[0] == pytest.approx(work, abs=1e-5 * np.ptp(energy))


def test_work_of_the_torques_becomes_energy_without_gravity(flat_runs):
    for run in flat_runs:
        x, tau = run.values[:, :4], run.values[:, 4:]
        kinetic = [0.5 * v[:2] @ flat_arm(v, [0, 0])[1] @ v[:2] for v in x]
        # The second motor pushes the second link and, the other way, the first.
        power = (tau[:, 0] - tau[:, 1]) * x[:, 0] + tau[:, 1] * x[:, 1]
        work = simpson(power, x=run.time)
        assert kinetic[-1] - kinetic[0] == pytest.approx(work, abs=1e-6)


def test_the_arm_with_gravity_rests_where_it_should():
    arm = two_link_robot_with_gravity()
    A, B, C, D = arm.jacobians(AT_REST, HOLDING)
    assert (A.shape, B.shape, C.shape, D.shape) == ((4, 4), (4, 2), (0, 4), (0, 2))
    poles = arm.eigenvalues(AT_REST, HOLDING)
    assert poles == pytest.approx([4.9329, 1.9881, -1.9881, -4.9329], abs=5e-5)
    without = arm.eigenvalues(AT_REST, [0, 0])
    assert without == pytest.approx([5.2160, 2.6533, -2.6533, -5.2160], abs=5e-5)
    still = Trajectory(TIME, np.tile([*AT_REST, *HOLDING], (201, 1)), arm.states + arm.controls)
    residual = np.abs(arm.derivative(still)).max()
    assert 1e-4 < residual < 4.5e-4


@pytest.mark.parametrize("mass", [(), (1.7,)])
def test_the_arm_is_held_by_its_torques(mass):
    arm = two_link_robot_with_gravity(vary_mass=bool(mass))
    torques = holding_torques(arm, AT_REST, mass)
    assert np.allclose(gravity_arm(AT_REST, torques, *mass)[0], 0, atol=1e-12)


def test_the_arm_without_gravity_rests_anywhere():
    arm = two_link_robot()
    assert np.abs(arm.eigenvalues(np.zeros(4), [0, 0])).max() < 1e-6
    still = arm.simulate(TIME, [0, 0, 0.5, 0.2], [0.0, 0.0])
    assert np.abs(states_of(still, arm) - [0, 0, 0.5, 0.2]).max() < 1e-12


def test_mass_may_be_a_parameter():
    arm, varied = two_link_robot_with_gravity(), two_link_robot_with_gravity(vary_mass=True)
    start, signal = [0.1, 0.2, -0.3, 0.4], excite(KNOTS, 2, 1.0, 1)
    same = varied.simulate(TIME, start, signal, parameters=[2.5])
    assert same.channel("m2") == Channel("m2", "kg", role="parameter")
    assert np.allclose(states_of(same, arm), states_of(arm.simulate(TIME, start, signal), arm))
    x, u = np.array(start), [3.0, -2.0]
    point = Trajectory(
        [0, 1], [[*x, *u, 1.7]] * 2, varied.states + varied.controls + (Channel("m2", "kg"),)
    )
    assert np.allclose(varied.derivative(point)[0], gravity_arm(x, u, 1.7)[0], atol=1e-12)


def test_states_can_be_fitted_as_they_are(flat_runs):
    arm = two_link_robot()
    specs = [StateSpec(name=c.name) for c in arm.states]
    found = differentiate(flat_runs[0], specs, DerivativeSettings(method="cubic_spline"))
    assert found.names == ("omega1", "omega2", "theta2", "theta1")
    error = np.abs(found.derivatives - arm.derivative(flat_runs[0]))
    assert error.mean() < 1e-6


# -- campaigns ----------------------------------------------------------------------------------


def test_a_run_does_not_depend_on_how_many_there_are(flat_runs):
    arm = two_link_robot()
    fewer = arm.campaign(2, TIME, Uniform(low=-0.5, high=0.5), KNOTS, seed=3)
    for a, b in zip(flat_runs, fewer, strict=False):
        assert a.digest == b.digest
    other = arm.campaign(1, TIME, Uniform(low=-0.5, high=0.5), KNOTS, seed=4)[0]
    assert not np.allclose(other.values, flat_runs[0].values)
    assert [r.name for r in flat_runs] == ["run000", "run001", "run002", "run003"]
    assert len({r.digest for r in flat_runs}) == 4
    assert len(dfsm.Dataset(flat_runs)) == 4
    starts = np.stack([r.values[0, :4] for r in flat_runs])
    assert np.abs(starts).max() <= 0.5
    assert np.unique(starts).size == 16
    roles = [c.role for c in flat_runs[0].channels]
    assert roles == ["state"] * 4 + ["control"] * 2
    assert [c.unit for c in flat_runs[0].channels] == ["rad/s", "rad/s", "rad", "rad", "-", "-"]


def spring(x, u, w, p):
    """A spring of stiffness p in flowing air w, pushed by u; NumPy and JAX alike."""
    return [x[1], -p[0] * x[0] - 0.8 * (x[1] - w[0]) + 2 * u[0]]


SPRING = ODESystem(
    spring,
    (Channel("q", "m"), Channel("v", "m/s")),
    (Channel("u", "N"),),
    (Channel("w", "m/s"),),
    (Channel("k", "N/m"),),
    (Channel("force", "N"), Channel("twice", "m")),
    lambda x, u, w, p: [p[0] * x[0] + w[0] * u[0], 2 * x[0]],
    name="spring",
)
both = pytest.mark.parametrize("system", [SPRING, replace(SPRING, backend="numpy")], ids=["j", "n"])


@both
def test_channels_of_all_roles(system):
    runs = system.campaign(
        4,
        TIME,
        [[0.0, 1.0], [1.0, 0.0]],
        STEPS,
        Multisine(low=0.0, high=2.0, frequencies=(0.5, 3.0)),
        [2.0, 3.0, 4.0],
        seed=1,
    )
    roles = [c.role for c in runs[0].channels]
    assert roles == ["state", "state", "control", "disturbance", "parameter", "output", "output"]
    assert [r["k"][0] for r in runs] == [2, 3, 4, 2]
    assert [r["q"][0] for r in runs] == [0, 1, 0, 1]
    for run in runs:
        assert np.ptp(run["k"]) == 0
        assert np.allclose(run["force"], run["k"] * run["q"] + run["w"] * run["u"])
        assert np.allclose(run["twice"], 2 * run["q"])
        expected = -run["k"] * run["q"] - 0.8 * (run["v"] - run["w"]) + 2 * run["u"]
        assert np.allclose(system.derivative(run), np.stack([run["v"], expected], axis=1))
        assert (run.wall_time is not None) == (system.backend == "numpy")
    faster = Multisine(low=0.0, high=2.0, frequencies=(1.0, 6.0))
    drawn = system.campaign(2, TIME, [0.0, 1.0], STEPS, faster, Uniform(low=2.0, high=4.0), seed=1)
    assert 2 <= drawn[0]["k"][0] <= 4
    assert drawn[0]["k"][0] != drawn[1]["k"][0]
    # Other disturbances leave the drawn controls as they were.
    assert np.array_equal(drawn[0]["u"], runs[0]["u"])
    assert not np.array_equal(drawn[0]["w"], runs[0]["w"])


@both
def test_steps_are_solved_exactly(system):
    signal, time = excite(STEPS, 1, 1.0, 5), TIME[::10]
    run = system.simulate(time, [0.3, -0.2], signal, [0.5], [3.0])
    # Constant inputs: the matrix exponential of [A, B; 0, 0] over each interval.
    M = np.array([[0, 1, 0, 0], [-3, -0.8, 2, 0.8], [0, 0, 0, 0], [0, 0, 0, 0]])
    x, exact, now = np.array([0.3, -0.2]), [], 0.0
    corners = signal.corners[signal.corners < 1]
    for t in np.unique([*time, *corners]):
        x = (expm(M * (t - now)) @ [*x, signal(now)[0], 0.5])[:2]
        now = t
        if t in time:
            exact.append(x)
    assert len(corners) >= 3
    assert np.abs(states_of(run, system) - exact).max() < 1e-8


@both
def test_jacobians_of_all_parts(system):
    A, B, C, D = system.jacobians([0.1, 0.2], [0.3], [0.4], [3.0])
    slack = 1e-12 if system.backend == "jax" else 1e-9
    assert np.allclose(A, [[0, 1], [-3, -0.8]], rtol=0, atol=slack)
    assert np.allclose(B, [[0, 0], [2, 0.8]], rtol=0, atol=slack)
    assert np.allclose(C, [[3, 0], [2, 0]], rtol=0, atol=slack)
    assert np.allclose(D, [[0.4, 0.3], [0, 0]], rtol=0, atol=slack)
    poles = system.eigenvalues([0.1, 0.2], [0.3], [0.4], [3.0])
    assert np.allclose(sorted(poles.imag), np.array([-1, 1]) * np.sqrt(3 - 0.16))
    assert np.allclose(poles.real, -0.4)


@pytest.mark.parametrize("kind", [KNOTS, STEPS], ids=["knots", "steps"])
def test_backends_agree(kind):
    jax_arm = replace(two_link_robot(), rtol=1e-11, atol=1e-11)
    numpy_arm = replace(jax_arm, f=lambda x, u, w, p: flat_arm(x, u)[0], backend="numpy")
    for name in ("states", "controls"):
        assert getattr(jax_arm, name) == getattr(numpy_arm, name)
    a, b = (
        arm.campaign(1, TIME, Uniform(low=-0.5, high=0.5), kind, seed=2)[0]
        for arm in (jax_arm, numpy_arm)
    )
    assert np.abs(a.values - b.values).max() < 1e-8
    slopes = [arm.jacobians([0.3, -0.2, 0.5, 0.1], [0.4, 0.6])[:2] for arm in (jax_arm, numpy_arm)]
    for exact, difference in zip(*slopes, strict=True):
        assert np.abs(exact - difference).max() < 1e-8
    assert np.abs(jax_arm.derivative(a) - numpy_arm.derivative(a)).max() < 1e-12


def test_inputs_of_a_recorded_run_can_be_used_again(flat_runs):
    arm, run = two_link_robot(), flat_runs[0]
    start = states_of(run, arm)[0]
    again = arm.simulate(TIME, start, run, name="again")
    assert again.name == "again"
    assert np.abs(again.values - run.values).max() < 1e-6
    samples = arm.simulate(TIME, start, run.select(["tau1", "tau2"]).values)
    assert np.array_equal(samples.values, again.values)


def test_switching_controls_and_a_late_start():
    arm = two_link_robot()
    signal = held([0.0, 0.4], [[1.0, -1.0], [-1.0, 1.0]], 1.0)
    run = arm.simulate(TIME, [0, 0, 0.5, 0], signal)
    later = arm.simulate(0.5 + TIME / 2, run.values[100, :4], signal)
    assert np.abs(later.values[::2] - run.values[100:]).max() < 1e-8


def test_no_step_sees_a_jump():
    calls = []

    def f(x, u, w, p):
        calls.append(u[0])
        return u - x

    system = ODESystem(f, (Channel("x"),), (Channel("u"),), backend="numpy")
    system.simulate(TIME, [1.0], held([0.0, 0.3, 0.6], [[0.0], [1.0], [-1.0]], 1.0))
    # One change at each jump: a step across one would be tried again and again.
    assert np.count_nonzero(np.diff(calls)) == 2
    assert len(calls) < 200


# -- the chain ----------------------------------------------------------------------------------


def test_the_chain_has_the_poles_of_a_string_of_springs():
    n = 5
    chain = mass_chain(n)
    assert (len(chain.states), len(chain.controls)) == (10, 5)
    assert [c.name for c in chain.states] == [
        *(f"q{i + 1}" for i in range(n)),
        "v1",
        "v2",
        "v3",
        "v4",
        "v5",
    ]
    frequency = 2 * np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1)))
    poles = chain.eigenvalues(np.zeros(10), np.zeros(5))
    assert np.allclose(poles.real, -0.05)
    assert np.allclose(np.sort(np.abs(poles))[::2], frequency)


def test_the_chain_loses_only_what_its_dampers_take():
    chain = mass_chain(3)
    time = np.linspace(0, 3, 601)
    run = chain.campaign(1, time, Uniform(low=-1.0, high=1.0), replace(KNOTS, spacing=1.0))[0]
    q, v, u = np.split(run.values, 3, axis=1)
    stretch = np.diff(q, axis=1, prepend=0, append=0)
    energy = (v**2).sum(axis=1) / 2 + (stretch**2 / 2 + 0.5 * stretch**4 / 4).sum(axis=1)
    work = simpson((u * v - 0.1 * v**2).sum(axis=1), x=time)
    assert energy[-1] - energy[0] == pytest.approx(work, abs=1e-6)
