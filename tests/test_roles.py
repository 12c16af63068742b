"""What `init` proposes for systems whose equations are known."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from dfsm.config.proposal import Proposal, propose
from dfsm.config.template import fill
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.demos.two_link_robot.multi_fidelity import draw
from dfsm.errors import DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings

Array = NDArray[np.float64]
Signal = Callable[[float], float]


def smooth(seed: int, fastest: float, count: int = 12, decades: float = 1) -> Signal:
    rng = np.random.default_rng(seed)
    rates, phases = fastest * 10 ** rng.uniform(-decades, 0, count), rng.uniform(0, 6.28, count)
    sizes = rng.dirichlet(3 * np.ones(count)) * 3
    return lambda t: float(np.sin(rates * t + phases) @ sizes)


def steps(seed: int, interval: float) -> Signal:
    values = np.random.default_rng(seed).uniform(-1, 1, 1000)
    return lambda t: float(values[int(t / interval + 1e-9)])


def marched(
    f: Callable[[Array, float], Sequence[float]], start: Sequence[float], time: Array
) -> Array:
    """States at `time`: RK4 with inputs that do not jump within a step's quarters."""
    x, rows = np.array(start, dtype=float), [np.array(start, dtype=float)]
    for begin, end in pairwise(time):
        h = (end - begin) / 4
        for t in begin + h * np.arange(4):
            a = np.array(f(x, t + 1e-6 * h))
            b = np.array(f(x + h / 2 * a, t + h / 2))
            c = np.array(f(x + h / 2 * b, t + h / 2))
            x = x + h / 6 * (a + 2 * b + 2 * c + np.array(f(x + h * c, t + h - 1e-6 * h)))
        rows.append(x)
    return np.array(rows)


def recorded(columns: Mapping[str, Array], time: Array, name: str = "run") -> Trajectory:
    labels = [text.removesuffix(")").split(" (") for text in columns]
    channels = [Channel(name, unit) for name, unit in labels]
    return Trajectory(time, np.column_stack(list(columns.values())), tuple(channels), name=name)


def on(signal: Signal, time: Array) -> Array:
    return np.array([signal(t) for t in time])


def proposed(*runs: Trajectory) -> Proposal:
    return propose(runs, list(runs[0].names), [])


def orders(proposal: Proposal) -> dict[str, int]:
    return {s["name"]: s["order"] for s in proposal.states}


def motor(seed: int, time: Array) -> dict[str, Array]:
    u, q = steps(seed, 5.0), smooth(seed + 50, 0.5)
    x = marched(lambda x, t: [-0.3 * x[0] + 50 * u(t) + 2 * q(t)], [0.0], time)[:, 0]
    return {"Speed (rpm)": x, "Torque (Nm)": on(u, time), "Flow (L/min)": on(q, time)}


def test_what_follows_at_once_is_an_output() -> None:
    """Load = 0.1 Speed + Torque jumps with the torque: it would tell the model its own answer."""
    time = np.arange(0, 60, 0.1)
    runs = []
    for seed in (1, 2):
        columns = motor(seed, time)
        columns["Load (kN)"] = 0.1 * columns["Speed (rpm)"] + columns["Torque (Nm)"]
        runs.append(recorded(columns, time, f"run{seed}"))
    found = proposed(*runs)
    assert orders(found) == {"Speed": 1}
    assert (found.controls, found.disturbances) == (["Torque"], ["Flow"])
    assert found.outputs == ["Load"]
    assert not found.hidden
    assert found.reasons["Load"] == "output: it follows from the others at once"


def test_integrals_are_states_and_voltages_outputs() -> None:
    """A battery: the charge integrates the current, the voltage is static."""
    time, current = np.arange(0, 1200, 2.0), steps(3, 60.0)
    f = lambda x, t: [-current(t) / 1800, -x[1] / 40 + current(t) / 20]  # noqa: E731
    charge, slow = marched(f, [60.0, 0.0], time).T
    columns = {"SOC (%)": charge, "V1 (mV)": slow, "Current (A)": on(current, time)}
    columns["Vterm (V)"] = 3.4 + 0.005 * charge - 0.001 * slow - 0.003 * columns["Current (A)"]
    found = proposed(recorded(columns, time))
    assert orders(found) == {"SOC": 1, "V1": 1}
    assert (found.controls, found.outputs, found.hidden) == (["Current"], ["Vterm"], False)


@pytest.mark.parametrize("load", [lambda x: 3 * x + 20, lambda x: 90 + 120 * np.exp(x / 2)])
def test_a_static_load_of_a_mass_is_no_state(load: Callable[[Array], Array]) -> None:
    time, force = np.arange(0, 60, 0.1), smooth(5, 0.6)
    f = lambda x, t: [x[1], -2 * x[0] - 0.5 * x[1] + force(t)]  # noqa: E731
    x, v = marched(f, [0.0, 0.0], time).T
    columns = {"x (m)": x, "F (N)": on(force, time), "Load (kN)": load(x)}
    found = proposed(recorded(columns, time))
    assert orders(found) == {"x": 2}
    assert (found.disturbances, found.outputs) == (["F"], ["Load"])
    found = proposed(recorded(columns | {"v (m/s)": v}, time))
    assert found.states == [{"name": "x", "order": 2, "rate": "v"}]
    assert (found.disturbances, found.outputs) == (["F"], ["Load"])


@pytest.mark.parametrize("seed", [5, 6, 7, 8])
def test_a_slow_input_is_no_state(seed: int) -> None:
    """The response to a slow input, and its rate, tell nearly all of it."""
    time, force = np.arange(0, 60, 0.1), smooth(seed, 0.6)
    mass = lambda x, t: [x[1], -2 * x[0] - 0.5 * x[1] + force(t)]  # noqa: E731
    for f, order in ((mass, 2), (lambda x, t: [-2 * x[0] + force(t)], 1)):
        x = marched(f, [0.0] * order, time)[:, 0]
        found = proposed(recorded({"x (m)": x, "F (N)": on(force, time)}, time))
        assert (orders(found), found.disturbances) == ({"x": order}, ["F"])


def test_waves_and_forces_are_no_states() -> None:
    """Narrow spectra tell much of their own second derivative; they are inputs all the same."""
    time, wave, force = np.arange(0, 200, 0.2), smooth(7, 1.0, 30, 0.2), smooth(8, 0.8)
    f = lambda x, t: [x[1], -1.2 * x[0] - 0.4 * x[1] + 0.9 * wave(t) - force(t)]  # noqa: E731
    z, v = marched(f, [0.0, 0.0], time).T
    columns = {"Heave (m)": z, "Vel (m/s)": v, "WaveElev (m)": on(wave, time)}
    found = proposed(recorded(columns | {"Fpto (kN)": on(force, time)}, time))
    assert found.states == [{"name": "Heave", "order": 2, "rate": "Vel"}]
    assert found.disturbances == ["WaveElev", "Fpto"]


def test_a_held_input_on_uneven_samples_needs_no_hidden_states() -> None:
    rng = np.random.default_rng(0)
    u = steps(2, 15.0)
    time = np.unique(np.r_[np.cumsum(rng.uniform(0.2, 2, 300)).round(4), np.arange(0, 300, 15.0)])
    h = marched(lambda x, t: [-0.02 * x[0] + 0.05 * u(t)], [1.0], time)[:, 0]
    run = recorded({"h (m)": h, "u (%)": on(u, time)}, time)
    found = proposed(run)
    assert (orders(found), found.controls, found.hidden) == ({"h": 1}, ["u"], False)
    text, told = fill([run], ["run.csv"], "config.yaml")
    assert not told
    assert "\nhidden: {}" not in text


def test_noise_of_a_sensor_is_no_hidden_state() -> None:
    time, u = np.arange(0, 200, 0.1), steps(4, 5.0)
    T = marched(lambda x, t: [-0.3 * x[0] + 0.6 * u(t)], [0.0], time)[:, 0]
    noisy = T + 0.03 * np.random.default_rng(0).standard_normal(len(time))
    found = proposed(recorded({"T (degC)": noisy, "P (kW)": on(u, time)}, time))
    assert (orders(found), found.controls, found.hidden) == ({"T": 1}, ["P"], False)


@pytest.mark.parametrize("spoiled", ["noise", "dropouts"])
def test_fit_calls_no_noise_a_hidden_state(spoiled: str) -> None:
    """White noise of 5 % covers the derivative, and so do a few zeros; windows of time tell it."""
    time, u = np.arange(0, 200, 0.1), steps(4, 5.0)
    T = marched(lambda x, t: [-0.3 * x[0] + 0.6 * u(t)], [0.0], time)[:, 0]
    T += 0.03 * np.random.default_rng(0).standard_normal(len(time)) * (spoiled == "noise")
    if spoiled == "dropouts":
        T[[400, 900, 901, 902, 1400]] = 3.0
    run = recorded({"T (degC)": T, "P (kW)": on(u, time)}, time)
    settings = FitSettings(
        states=(StateSpec(name="T"),),
        controls=("P",),
        corrective=NoCorrection(),
        nonlinear_only=False,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        told = fit([run], settings).model.provenance.record["warnings"]
    assert not [text for text in told if "hidden" in text]


def test_a_coarse_input_is_no_state() -> None:
    """An input in whole degrees: the past of the level tells more of it than of the level."""
    time, w = np.arange(0, 600, 1.0), smooth(9, 0.03)
    temperature = lambda t: 10 + 6 * w(t)  # noqa: E731
    x = marched(lambda x, t: [-0.05 * x[0] + 0.5 * temperature(t)], [100.0], time)[:, 0]
    run = recorded({"x (m)": x, "Temp (degC)": np.round(on(temperature, time))}, time)
    found = proposed(run)
    assert orders(found) == {"x": 1}
    assert [*found.controls, *found.disturbances] == ["Temp"]
    assert "leaves )" not in fill([run], ["run.csv"], "config.yaml")[1]


def test_a_set_point_acts_through_the_control() -> None:
    """A hover loop: with throttle and set-point both as inputs, nothing tells their effects."""
    time, ref = np.arange(0, 60, 0.02), steps(6, 6.0)
    rows, z, v = [], 2.0, 0.0
    gust = smooth(3, 1.5)
    for t in time:
        throttle = min(max(0.5 + 0.12 * (2 + ref(t) - z) - 0.12 * v, 0.2), 0.8)
        rows.append((z, v, 100 * throttle, 2 + ref(t)))
        for _ in range(4):
            v += 0.005 * (19.62 * throttle - 9.81 - 0.2 * v + 0.1 * gust(t))
            z += 0.005 * v
    names = ("Alt (m)", "Climb (m/s)", "Throttle (%)", "AltRef (m)")
    found = proposed(recorded(dict(zip(names, np.array(rows).T, strict=True)), time))
    assert found.states == [{"name": "Alt", "order": 2, "rate": "Climb"}]
    assert (found.controls, found.disturbances, found.outputs) == (["Throttle"], [], [])
    assert found.reasons["AltRef"] == "set-point, left out: it acts through Throttle"


def test_the_arm_keeps_its_states() -> None:
    """Two links, of which one rate is no derivative of its angle: nonlinear, without hidden."""
    found = proposed(*draw(5, 10.0, 0))
    assert orders(found) == {"theta1": 2, "theta2": 1, "omega2": 1}
    assert [*found.controls, *found.disturbances] == ["tau1", "tau2"]
    assert not found.hidden


@pytest.mark.parametrize("count", [2, 3, 4, 6, 9, 12, 40])
def test_short_records_and_ramps_are_looked_at(count: int) -> None:
    """A ramp has no second difference, and a few samples make no windows: both are proposed."""
    time = 0.1 * np.arange(float(count))
    columns: dict[str, Array] = {"x (m)": np.sin(time), "ramp (s)": time, "z (kg)": np.cos(time)}
    found = proposed(recorded(columns, time))
    roles = [*orders(found), *found.controls, *found.disturbances, *found.outputs]
    assert sorted(roles) == ["ramp", "x", "z"]


def test_an_input_of_two_values_has_powers_that_rest() -> None:
    """Their products with other channels tell nothing new, and do no harm."""
    time = np.arange(0, 200, 0.1)
    force = np.sign(np.sin(2 * np.pi * time / 20 + 0.1))
    at = lambda t: force[min(int(t / 0.1 + 1e-9), len(force) - 1)]  # noqa: E731
    f = lambda x, t: [  # noqa: E731
        x[2],
        x[3],
        -3 * x[0] + 2 * x[1] - 0.2 * x[2] + at(t),
        2 * x[0] - 2 * x[1] - 0.2 * x[3],
    ]
    x = marched(f, [0.0] * 4, time)
    noise = 0.01 * x.std(axis=0) * np.random.default_rng(0).standard_normal(x.shape)
    x = x + noise
    columns = {"Force (N)": force, "x1 (m)": x[:, 0], "x2 (m)": x[:, 1]}
    found = proposed(recorded(columns, time))
    assert found.controls == ["Force"]
    assert set(orders(found)) == {"x1", "x2"}
