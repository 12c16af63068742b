"""Blade-passing loads from a wind field: against loads whose every harmonic is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import gaussian_filter1d

from dfsm.config.fit import Config
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning, hushed
from dfsm.fitting.corrective import GP, NoCorrection
from dfsm.fitting.fit import FitResult, fit
from dfsm.fitting.linear import LPV
from dfsm.fitting.settings import FitSettings
from dfsm.models.model_folder import load_all, save
from dfsm.models.passing import field_harmonics, harmonics_of
from dfsm.models.signals import Azimuth
from dfsm.numerics.fatigue import damage_equivalent_load
from dfsm.numerics.spectra import Band, spectrum
from dfsm.refinement.settings import RefineSettings
from dfsm.simulation.simulate import SimulationSettings, Status, simulate
from dfsm.validation.validate import validate

RINGS = (20.0, 40.0)
FIELD = Azimuth(speed="speed", angle="psi", rings=RINGS)
PLAIN = replace(FIELD, rings=())
TIME = np.arange(0, 300.05, 0.1)
OUTPUTS = ("tower", "blade", "calm")
SETTINGS = FitSettings(
    states=(StateSpec(name="speed"),),
    controls=("torque",),
    disturbances=("wind",),
    outputs=OUTPUTS,
    corrective=NoCorrection(),
    nonlinear_only=False,
    azimuth=FIELD,
)
RPM = np.pi / 30


def smooth(rng: np.random.Generator, width: float) -> np.ndarray:
    """Random signal that varies over `width` seconds, with a standard deviation of one."""
    values = gaussian_filter1d(rng.standard_normal(len(TIME)), width / 0.1)
    return (values - values.mean()) / values.std()


def turbine(seed: int, *, direction: int = -1, noise: float = 0.05, scheduled: float = 0.0):
    """A rotor around 12 rpm whose loads follow the field that its blades turn in."""
    rng = np.random.default_rng(seed)
    wind, torque = 10 + 2 * smooth(rng, 10), smooth(rng, 5)
    speed = np.full(len(TIME), 12.0)
    drive = 12 + 0.8 * (wind - 10) - 0.5 * torque
    for i in range(len(TIME) - 1):
        middle = (drive[i] + drive[i + 1]) / 2
        speed[i + 1] = middle + (speed[i] - middle) * np.exp(-0.1 / 4)
    psi = rng.uniform(0, 2 * np.pi) + cumulative_trapezoid(speed * RPM, TIME, initial=0)
    names = [
        f"{p}_r{r:03g}"
        for r in RINGS
        for p in ("U", *(f"{c}{n}" for n in range(1, 5) for c in "CS"))
    ]
    field = {name: smooth(rng, 4) + (10 if name[0] == "U" else 0) for name in names}

    def q(n: int, ring: str) -> np.ndarray:
        return field[f"C{n}_{ring}"] - 1j * field[f"S{n}_{ring}"]

    turn = np.exp(1j * direction * psi)
    relative, s = speed / 12, 1 + scheduled * (wind - 10)
    met = (2 + 1j) * q(3, "r040") + 1.5 * q(2, "r020")
    tower = 5 * (speed - 12) + relative * s * (turn**3 * met).real
    blade = wind + relative * (turn * (3 * q(1, "r040") + 2 - 4j) + turn**3 * q(3, "r020")).real
    blade += 2 * relative * field["U_r020"] * turn.real
    calm = 2 * speed + 0.5 * torque
    outputs = [y + noise * rng.standard_normal(len(TIME)) for y in (tower, blade, calm)]
    columns = [speed, torque, wind, *outputs, np.rad2deg(psi) % 360, *field.values()]
    units = ["rpm", "kNm", "m/s", "kN", "kNm", "kN", "deg", *["m/s"] * len(field)]
    channels = ["speed", "torque", "wind", *OUTPUTS, "psi", *field]
    return Trajectory(
        TIME,
        np.stack(columns, axis=1),
        tuple(Channel(*c) for c in zip(channels, units, strict=True)),
        name=f"turbine{seed}",
    )


@cache
def runs() -> tuple[Trajectory, ...]:
    return tuple(turbine(seed) for seed in range(4))


@cache
def unseen() -> Trajectory:
    return turbine(9)


@cache
def fitted() -> FitResult:
    return fit(runs(), SETTINGS)


def rows(result: FitResult) -> dict[str, dict]:
    return {r["name"]: r for r in result.model.provenance.record["rows"]}


def ratios(rollout: Trajectory, record: Trajectory, output: str, k: int) -> tuple[float, float]:
    """Power around kP and damage-equivalent load, over those recorded."""
    passing = k * record["speed"].mean() / 60
    band = Band("kP", 0.8 * passing, 1.2 * passing)
    power = [spectrum(r.time, r[output]).power(band) for r in (rollout, record)]
    damage = [damage_equivalent_load(r[output], r.duration, 4.0) for r in (rollout, record)]
    return power[0] / power[1], damage[0] / damage[1]


# -- harmonics ----------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [-1, 1])
def test_a_blade_meets_the_series_of_its_ring(direction):
    rng = np.random.default_rng(0)
    azimuth = replace(FIELD, orders={k: (k,) for k in (1, 2, 3)}, direction=direction)
    psi, values = rng.uniform(0, 20, 7), rng.standard_normal((7, len(azimuth.field)))
    by_name = dict(zip(azimuth.field, values.T, strict=True))
    h = np.asarray(field_harmonics(psi, values, azimuth))
    places = harmonics_of(azimuth)
    assert h.shape == (7, 2 * len(places))
    for ring in RINGS:
        met = sum(h[:, i] for i, p in enumerate(places) if p.ring == ring)
        alpha = direction * psi
        series = sum(
            by_name[f"C{n}_r{ring:03g}"] * np.cos(n * alpha)
            + by_name[f"S{n}_r{ring:03g}"] * np.sin(n * alpha)
            for n in (1, 2, 3)
        )
        np.testing.assert_allclose(met, series, atol=1e-12)
    alone = [i for i, p in enumerate(places) if p.n is None]
    np.testing.assert_allclose(h[:, alone], np.cos(np.outer(psi, [1, 2, 3])), atol=1e-12)


def test_what_is_tried_and_read_by_default():
    assert FIELD.tried == {1: (0, 1, 2), 2: (1, 2, 3), 3: (2, 3, 4), 4: (3, 4)}
    assert FIELD.field[:4] == ("U_r020", "U_r040", "C1_r020", "S1_r020")
    assert len(FIELD.field) == 2 + 4 * 2 * 2
    assert replace(FIELD, blades=2).tried == {1: (0, 1, 2), 2: (1, 2, 3), 3: (2, 3)}
    assert PLAIN.tried == {}
    assert replace(FIELD, orders={3: (3,)}).field == ("C3_r020", "S3_r020", "C3_r040", "S3_r040")


# -- what a fit learns --------------------------------------------------------------------------


def test_every_output_gets_the_harmonics_that_explain_it():
    told = rows(fitted())
    assert set(told["tower"]["passing"]) == {"3P"}
    assert set(told["blade"]["passing"]) == {"1P", "3P"}
    assert told["calm"]["passing"] == {}
    assert min(*told["tower"]["passing"].values(), *told["blade"]["passing"].values()) > 0.95
    assert "% of the 3P band (n = 2, 3) explained on runs left out" in told["tower"]["decision"]
    assert "of the 1P band (n = 0, 1)" in told["blade"]["decision"]
    assert "explain nothing on runs left out" in told["calm"]["decision"]
    assert "3P band (n = 2, 3)" in fitted().model.summary()


def test_coefficients_are_those_of_the_loads():
    model = fitted().model
    C = np.asarray(model.passing.coefficients)
    assert not C[:, 2].any()
    np.testing.assert_array_equal(C[[0, 2]], 0)  # all go with the speed alone
    places = harmonics_of(FIELD)
    n = len(places)
    # Re[p z] = Re p Re z - Im p Im z, at the mean speed.
    p = {(h.k, h.n, h.ring): C[1, 0, i] - 1j * C[1, 0, n + i] for i, h in enumerate(places)}
    speed = float(model.passing.speed) / 12
    assert p[3, 3, 40.0] == pytest.approx((2 + 1j) * speed, abs=0.03)
    assert p[3, 2, 20.0] == pytest.approx(1.5 * speed, abs=0.03)
    assert max(abs(v) for key, v in p.items() if key not in {(3, 3, 40.0), (3, 2, 20.0)}) < 0.05


@pytest.mark.parametrize(("output", "k"), [("tower", 3), ("blade", 1), ("blade", 3)])
def test_spectra_and_damage_of_a_rollout_are_right(output, k):
    result = simulate(fitted().model, unseen())
    assert result.status is Status.COMPLETED
    power, damage = ratios(result.trajectory, unseen(), output, k)
    assert power == pytest.approx(1, abs=0.05)
    assert damage == pytest.approx(1, abs=0.03)


def test_phases_that_drift_leave_the_band_its_power():
    model = fitted().model
    # A rotor that runs 1.5 % too fast: most of a turn over the run, and over two of the 3P load.
    faster = replace(model.f, offsets=model.f.offsets + 0.015 * 12 / 4)
    drifting = simulate(replace(model, f=faster), unseen()).trajectory
    turned = [cumulative_trapezoid(r["speed"] / 60, r.time)[-1] for r in (drifting, unseen())]
    assert turned[0] - turned[1] > 0.7
    met = [r["tower"] - 5 * (r["speed"] - 12) for r in (drifting, unseen())]
    assert np.corrcoef(*met)[0, 1] < 0.5
    power, damage = ratios(drifting, unseen(), "tower", 3)
    assert power == pytest.approx(1, abs=0.1)
    assert damage == pytest.approx(1, abs=0.05)


def test_without_a_field_the_model_says_what_is_missing():
    with pytest.warns(
        DfsmWarning, match=r"cos 3ψ and sin 3ψ explain little of the 3P band"
    ) as seen:
        result = fit(runs(), replace(SETTINGS, azimuth=PLAIN))
    (text,) = [str(w.message) for w in seen if "3P" in str(w.message)]
    assert "% for tower" in text
    assert "calm" not in text
    assert "dfsm wind adds its harmonics to runs, for azimuth.rings" in text
    assert text in result.model.provenance.record["warnings"]
    power, _ = ratios(simulate(result.model, unseen()).trajectory, unseen(), "tower", 3)
    assert power < 0.2


# What the torque does to the speed here is noise, and told.
@pytest.mark.filterwarnings("ignore:speed_dot")
def test_what_reaches_into_the_band_without_the_field_is_told():
    # The torque shakes at 3P by much more than the tower does.
    shaken = []
    for run in runs():
        values, psi = run.values.copy(), np.deg2rad(run["psi"])
        values[:, run.column("torque")] += 2 * np.cos(3 * psi + 0.5 * run["S4_r020"])
        values[:, run.column("calm")] += 2 * values[:, run.column("torque")]
        values[:, run.column("calm")] -= 3.9 * np.cos(3 * psi + 0.5 * run["S4_r020"])
        shaken.append(replace(run, values=values))
    with pytest.warns(DfsmWarning, match=r"leaves \d+\.\d times the 3P band of calm: ") as seen:
        fit(shaken, SETTINGS)
    (text,) = [str(w.message) for w in seen if "3P" in str(w.message)]
    assert "tower" not in text
    assert "lags of the same channel do not" in text


def test_coefficients_follow_the_schedule_where_runs_say_so():
    linear = LPV(schedule="wind", points=2)
    some = [turbine(seed, scheduled=0.2) for seed in range(3)]
    model = fit(some, replace(SETTINGS, outputs=("tower",), linear=linear)).model
    C = np.asarray(model.passing.coefficients)
    assert np.abs(C[2]).max() > 0.3 * np.abs(C[1]).max()
    test = turbine(9, scheduled=0.2)
    power, _ = ratios(simulate(model, test).trajectory, test, "tower", 3)
    assert power == pytest.approx(1, abs=0.05)
    level = fit(runs(), replace(SETTINGS, outputs=("tower",), linear=linear)).model
    assert not np.asarray(level.passing.coefficients)[2].any()


def test_one_run_is_left_out_block_by_block():
    told = rows(fit(runs()[:1], SETTINGS))
    assert told["tower"]["passing"]["3P"] > 0.9
    assert told["calm"]["passing"] == {}


def test_runs_in_the_same_wind_are_left_out_together():
    # A field that has nothing to do with the loads explains them only where it was seen before.
    strange = [turbine(seed + 20) for seed in range(2)]
    names = FIELD.field
    mixed = []
    for k, run in enumerate([*runs()[:2], *runs()[:2]]):
        values = run.values.copy()
        values[:, run.columns(names)] = strange[k % 2].select(names).values
        values[:, run.column("torque")] *= 1 + k // 2  # not the same run again
        mixed.append(replace(run, values=values))
    assert set(rows(fit(mixed, SETTINGS))["tower"]["passing"]) == set()


def test_an_uneven_mesh_is_evened_out():
    uneven = []
    for run in runs()[:2]:
        keep = np.arange(len(run)) % 7 != 3
        uneven.append(replace(run, time=run.time[keep], values=run.values[keep]))
    assert rows(fit(uneven, SETTINGS))["tower"]["passing"]["3P"] > 0.9


def test_a_refined_model_and_a_nonlinear_one_have_them_too():
    few = replace(SETTINGS, outputs=("tower",), nonlinear_only=True, corrective=GP(samples=30))
    result = fit(runs()[:3], few, RefineSettings(windows=(5.0,), iterations=1))
    assert result.nonlinear is not None
    for model in (result.model, result.nonlinear):
        with hushed():
            rollout = simulate(model, unseen()).trajectory
        power, _ = ratios(rollout, unseen(), "tower", 3)
        assert power == pytest.approx(1, abs=0.1)


def test_the_speed_may_be_the_rate_of_a_measured_angle():
    turning = []
    for run in runs()[:2]:
        turned = Channel("turned", "rad")
        psi = np.unwrap(np.deg2rad(run["psi"]))
        turning.append(run.with_channels([turned], psi[:, None]))
    states = (StateSpec(name="turned", order=2),)
    azimuth = replace(FIELD, speed="turned_dot")
    told = rows(fit(turning, replace(SETTINGS, states=states, azimuth=azimuth)))
    assert told["tower"]["passing"]["3P"] > 0.9


# -- evaluation and simulation ------------------------------------------------------------------


def test_the_mean_over_a_revolution_needs_no_field():
    model, around = fitted().model, 2 * np.pi * np.arange(60) / 60
    field = unseen().select(model.signals.names("field")).values[100]
    point = ([12.3], [0.4], [9.0])
    outputs = np.asarray(model.output(*point, azimuth=around, field=field))
    assert np.ptp(outputs[:, 0]) > 0.5
    np.testing.assert_allclose(model.output(*point), outputs.mean(axis=0), atol=1e-9)
    C, D = model.jacobians(*point)[2:]
    assert C.shape == (3, 1)
    assert D.shape == (3, 2)
    with pytest.raises(DfsmError, match=r"wind field has shape None.*U_r020.*or neither"):
        model.output(*point, azimuth=1.0)
    with pytest.raises(
        DfsmError, match=r"wind field has shape \(3,\), expected .* its 18 harmonics"
    ):
        model.output(*point, azimuth=1.0, field=field[:3])


@pytest.mark.parametrize(
    "settings",
    [
        SimulationSettings(step=0.05),
        SimulationSettings(step=0.05, interpolation="cubic"),
        SimulationSettings(method="tsit5"),
    ],
)
def test_steps_and_solvers_agree(settings):
    model, short = fitted().model, unseen().window(50, 80)
    plain = simulate(model, short).trajectory
    other = simulate(model, short, settings=settings).trajectory
    np.testing.assert_allclose(other["tower"], plain["tower"], atol=2e-3)


def test_models_survive_a_folder(tmp_path):
    model = fitted().model
    save(model, tmp_path / "m")
    again = load_all(tmp_path / "m")["multi-fidelity"]
    assert again.signals == model.signals
    assert again.signals.azimuth == FIELD
    short = unseen().window(10, 30)
    np.testing.assert_array_equal(
        simulate(again, short).trajectory.values, simulate(model, short).trajectory.values
    )


def test_validation_sees_the_field():
    model = fitted().model
    assert model.signals.recorded[-18:] == FIELD.field
    result = validate(model, [unseen()])
    errors = result.runs[0].models["multi-fidelity"].errors
    assert errors["blade"].nrmse < 0.2


# -- bad input ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gone", "said"),
    [
        ("S3_r040", r"lacks S3_r040, harmonics of the wind field .*--harmonics 4 --rings 20,40\)"),
        ("psi", r"lacks azimuth.angle 'psi', without which nobody knows"),
    ],
)
def test_runs_without_a_field_are_refused(gone, said):
    lacking = unseen().select(n for n in unseen().names if n != gone)
    with pytest.raises(DfsmError, match=said):
        simulate(fitted().model, lacking)
    with pytest.raises(DfsmError, match=said):
        fit([lacking, *runs()], SETTINGS)


def test_an_azimuth_that_runs_the_other_way_is_refused():
    said = (
        r"turns the other way .* explain \d+% instead of \d% of the .*set azimuth.direction to 1$"
    )
    with pytest.raises(DfsmError, match=said):
        fit([turbine(seed, direction=1) for seed in range(3)], SETTINGS)
    right = replace(SETTINGS, azimuth=replace(FIELD, direction=1))
    result = fit([turbine(seed, direction=1) for seed in range(3)], right)
    assert rows(result)["tower"]["passing"]["3P"] > 0.95


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda psi: -psi, "'psi' turns by -1 times what azimuth.speed 'speed' says"),
        (lambda psi: 2 * psi, "'psi' turns by 2 times"),
    ],
)
def test_an_azimuth_of_another_rotor_is_refused(change, said):
    changed = []
    for run in runs():
        values = run.values.copy()
        values[:, run.column("psi")] = change(np.rad2deg(np.unwrap(np.deg2rad(run["psi"]))))
        changed.append(replace(run, values=values))
    with pytest.raises(DfsmError, match=said):
        fit(changed, SETTINGS)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rings": (20.0, 20.0)}, r"azimuth.rings is \[20, 20\], expected different radii"),
        ({"rings": (0.0,)}, r"azimuth.rings is \[0\], expected different radii in m above 0"),
        ({"angle": None}, "azimuth.angle is not set"),
        ({"direction": 0}, "azimuth.direction is 0, expected -1 or 1"),
        ({"orders": {0: (1,)}}, "azimuth.orders is set for 0, expected multiples"),
        ({"orders": {3: (3, 3)}}, r"azimuth.orders.3 is \[3, 3\], expected different numbers"),
        ({"rings": (), "orders": {3: (3,)}}, "azimuth.orders is set, expected no value without"),
    ],
)
def test_settings_that_make_no_sense(change, said):
    with pytest.raises(DfsmError, match=said):
        replace(FIELD, **change)


def test_configuration():
    raw = {
        "data": {"train": ["a"]},
        "signals": {"states": [{"name": "speed"}]},
        "azimuth": {"speed": "speed", "angle": "psi", "rings": [20, 40], "orders": {3: [3, 2]}},
    }
    azimuth = Config.model_validate(raw).fit_settings().azimuth
    assert azimuth == replace(FIELD, orders={3: (3, 2)})
