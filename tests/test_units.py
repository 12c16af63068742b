"""Units: spellings, conversions, and that a model gets every run in its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from dfsm.control import OptimalControlProblem
from dfsm.control.guess import start_of
from dfsm.core.units import agree, conversion, factor, known
from dfsm.data.conversion import in_units_of
from dfsm.data.dataset import Dataset
from dfsm.data.derivatives import StateSpec
from dfsm.data.features import Feature
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.wind import undisturbed_rotor_wind
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LTI
from dfsm.fitting.samples import extract, select
from dfsm.fitting.settings import FitSettings
from dfsm.models.completion import completed
from dfsm.models.dfsm import DFSM
from dfsm.models.signals import Azimuth
from dfsm.refinement.record import record_of
from dfsm.selection.trial import Course
from dfsm.simulation.simulate import initial_state, simulate
from dfsm.simulators.start import as_signal
from dfsm.validation.calibrate import calibrate
from dfsm.validation.intervals import load_intervals
from dfsm.validation.validate import validate

pytestmark = pytest.mark.filterwarnings("ignore:.*outside the training range")

# -- texts --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "spellings",
    [
        ["kN-m", "kN·m", "kN m", "kN*m", "kN.m", "kNm", "(kN-m)", "[kN m]", "KN-m", "m kN"],
        ["m/s", "m/sec", "m s-1", "m·s⁻¹", "m s^-1", "m per s", "metre/second", "m / s"],
        ["deg/s", "deg/sec", "°/s", "degrees/s", "deg s^{-1}", "dps"],
        ["m/s^2", "m/s2", "m/s²", "m/s**2", "m/s/s", "m s-2", "m/(s*s)", "m/s-s"],
        ["-", "(-)", "[-]", "1", "unitless"],
        ["degC", "°C", "deg C", "℃", "celsius", "C", "Deg C", "ºC", "º C", "Degrees Celsius"],
        ["V", "Volts", "volt"],
        ["L/min", "liters/min", "litre per minute"],
        ["rpm", "RPM", "rev/min", "r/min"],
        ["J/kg-K", "J/(kg K)", "J/kg/K"],
        ["Foo/s", "Foo/sec"],
        ["m/s (10 min)"],
    ],
)
def test_spellings_of_one_unit(spellings):
    for a in spellings:
        for b in spellings:
            assert agree(a, b), (a, b)
            assert factor(a, b) == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize(
    ("source", "target", "value", "expected"),
    [
        ("rad", "deg", np.pi, 180),
        ("rpm", "rad/s", 60, 2 * np.pi),
        ("rpm", "deg/s", 1, 6),
        ("N-m", "MN·m", 5e6, 5),
        ("kW", "MW", 15e3, 15),
        ("km/h", "m/s", 36, 10),
        ("kn", "m/s", 3600, 1852),
        ("ft", "mm", 1, 304.8),
        ("h", "s", 2, 7200),
        ("hPa", "kPa", 1013, 101.3),
        ("mbar", "Pa", 1, 100),
        ("degC", "K", 20, 293.15),
        ("degF", "degC", 212, 100),
        ("degC/min", "K/s", 60, 1),
        ("%", "-", 50, 0.5),
        ("L/min", "m^3/h", 1000, 60),
        ("g/cm3", "kg/m^3", 1, 1000),
        ("kWh", "MJ", 1, 3.6),
        ("mA", "A", 20, 0.02),
        ("N-m/deg", "N-m/rad", np.pi / 180, 1),
        ("lbf ft", "N-m", 1, 1.3558179483),
        ("hp", "W", 1, 745.69987158),
        ("mmHg", "kPa", 760, 101.32501444),
        ("gpm", "L/min", 1, 3.785411784),
    ],
)
def test_values_are_converted(source, target, value, expected):
    scale, zero = conversion(source, target)
    assert scale * value + zero == pytest.approx(expected, rel=1e-9)
    back, shift = conversion(target, source)
    assert back * expected + shift == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(
    ("a", "b"),
    [("m", "s"), ("rpm", "Hz"), ("N", "kN-m"), ("g", "m/s^2"), ("Foo", "kFoo"), ("-", "deg"),
     ("m/s (rel)", "m/s"), ("kVA", "kW"), ("m-", "m"), ("deg/s", "deg")],
)  # fmt: skip
def test_other_dimensions_and_words_are_kept_apart(a, b):
    assert conversion(a, b) is None
    assert not agree(a, b)


def test_a_unit_that_nobody_knows_agrees_with_all():
    for none in ("", " ", "()", "n/a", "?"):
        assert not known(none)
        assert agree(none, "kN-m")
        assert factor(none, "m") is None


# -- runs ---------------------------------------------------------------------------------------

TIME = np.arange(0, 20.01, 0.1)
OWN = {"x": "deg", "u": "kN-m", "w": "m/s", "y": "kN"}
SI = {"x": ("rad", np.pi / 180), "u": ("N·m", 1e3), "w": ("m/sec", 1.0), "y": ("N", 1e3)}


def recorded(seed: int, rest: float = 1.0) -> Trajectory:
    """x' = -0.5 x + u + 0.3 w, y = 2 x + w, in deg, kN m, m/s and kN."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.05, 0.3, (2, 4)), rng.uniform(0, 6, (2, 4))
    u, w = rest * np.sin(2 * np.pi * f * TIME[:, None, None] + phase).sum(-1).T
    fine = np.arange(0, TIME[-1] + 1e-9, 0.001)
    drive = np.interp(fine, TIME, u + 0.3 * w)
    decay = np.exp(-0.0005)
    x = lfilter([0, 1 - decay], [1, -decay], 2 * drive)[::100]
    values = np.stack([x, u, w, 2 * x + w], axis=1)
    channels = tuple(Channel(n, unit) for n, unit in OWN.items())
    return Trajectory(TIME, values, channels, name=f"run{seed}", source=f"run{seed}.csv")


def in_si(run: Trajectory) -> Trajectory:
    units, sizes = zip(*(SI[n] for n in run.names), strict=True)
    return replace(
        run,
        values=run.values * sizes,
        channels=tuple(replace(c, unit=u) for c, u in zip(run.channels, units, strict=True)),
    )


def wrong(run: Trajectory) -> Trajectory:
    return relabelled(run, u="m")


def relabelled(run: Trajectory, **units: str) -> Trajectory:
    channels = tuple(replace(c, unit=units.get(c.name, c.unit)) for c in run.channels)
    return replace(run, channels=channels)


SETTINGS = FitSettings(
    states=(StateSpec(name="x"),),
    controls=("u",),
    disturbances=("w",),
    outputs=("y",),
    linear=LTI(),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


@cache
def model() -> DFSM:
    return fit([recorded(0), recorded(1)], SETTINGS).model


def problem(run: Trajectory, **fields: object) -> OptimalControlProblem:
    asked = {"model": model(), "horizon": (0.0, 10.0), "cost": lambda s: s.u.u**2, **fields}
    return OptimalControlProblem(disturbances=run, **asked)  # pyright: ignore[reportArgumentType]


def calibrated(run: Trajectory):
    rest = [recorded(5), recorded(6)]
    return calibrate(model(), [run, *rest]).half_width


# What takes recorded runs for a model, as numbers that must not depend on the units of the run.
TAKES: dict[str, Callable[[Trajectory], object]] = {
    "simulate": lambda run: simulate(model(), run).trajectory.values,
    "initial_state": lambda run: initial_state(model(), run, 7.0),
    "validate": lambda run: validate(model(), [run]).mean_error("multi-fidelity", "y", "rmse"),
    "calibrate": calibrated,
    "refinement": lambda run: record_of(model(), run, 0.1, None, None).inputs,
    "disturbances": lambda run: problem(run).scenarios[0].select(["u", "w"]).values,
    "guess": lambda run: start_of(problem(recorded(3)), run, np.linspace(0, 1, 5)).U,
    "bounds": lambda run: problem(recorded(3), bounds={"u": (run, 9.0)}).limits("u", TIME[:9])[0],
    "compare": lambda run: Course.of([recorded(0)], [run], SETTINGS).references[0]["x"],
}


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
@pytest.mark.parametrize("takes", TAKES)
def test_every_way_to_a_model_converts_or_refuses(takes):
    run, take = recorded(2), TAKES[takes]
    expected = np.asarray(take(run))
    np.testing.assert_allclose(take(in_si(run)), expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(take(relabelled(run, x="", u="", w="", y="")), expected)
    np.testing.assert_array_equal(take(relabelled(run, u="kN m", w="m s^-1")), expected)
    with pytest.raises(DfsmError, match=r"run2.csv: 'u' is in 'm', in .+ in 'kN-m'"):
        take(wrong(run))


def test_what_was_converted_is_told_once():
    with pytest.warns(DfsmWarning, match="run2.csv and 1 more: units converted") as told:
        simulate(model(), [in_si(recorded(2)), in_si(recorded(3)), recorded(4)])
    text = next(str(w.message) for w in told if "units" in str(w.message))
    assert "'x' from rad to deg" in text
    assert "'u' from N·m to kN-m" in text
    assert "'w'" not in text
    found = validate(model(), [in_si(recorded(2))])
    assert "units converted" in found.warnings[0]


def test_steps_and_runs_of_the_fit():
    coarse = relabelled(recorded(0), x="rad")
    coarse = replace(
        coarse, channels=(replace(coarse.channels[0], step=0.01), *coarse.channels[1:])
    )
    found = in_units_of(coarse, [Channel("x", "deg"), Channel("nobody", "s")])
    assert found.channel("x").step == pytest.approx(0.01 * 180 / np.pi)
    same = recorded(0)
    assert in_units_of(same, model().signals.inputs) is same
    # A run that trained the model is known again, in whatever unit it comes.
    assert any("were used in training" in w for w in validate(model(), [recorded(0)]).warnings)


def test_training_runs_may_spell_units_differently_or_leave_them_out():
    spelled = relabelled(recorded(1), u="kN·m", w="m/sec")
    bare = relabelled(recorded(2), x="", u="", w="", y="")
    again = fit([recorded(0), spelled], SETTINGS).model
    np.testing.assert_allclose(again.f.coefficients, model().f.coefficients, rtol=1e-9)
    data = Dataset([recorded(0), bare])
    assert [data.channel(n).unit for n in OWN] == list(OWN.values())
    with pytest.raises(DfsmError, match=r"'kN-m' in .* 'm' in .*: convert one of them"):
        Dataset([recorded(0), wrong(recorded(1))]).channel("u")


def test_features_and_recorded_rates_are_converted_too():
    source = Feature(source="v")
    settings = replace(
        SETTINGS, states=(StateSpec(name="x", rate="x_rate"),), features=(source,), outputs=()
    )
    signals = extract(select([with_more(recorded(k)) for k in (0, 1)], settings), settings).signals
    new = with_more(recorded(2))
    other = replace(
        relabelled(new, v="cm", x_rate="rad/s"),
        values=new.values * [1, 1, 1, 1, 100, np.pi / 180],
    )
    with pytest.warns(DfsmWarning) as told:
        found = completed(other, signals)
    assert "'x_rate' from rad/s to deg/s" in str(told[0].message)
    assert "'v_dot' from cm/s to m/s" in str(told[1].message)
    names = ["x_rate", "v_dot"]
    expected = completed(new, signals).select(names)
    assert found.select(names).channels == expected.channels
    np.testing.assert_allclose(found.select(names).values, expected.values, rtol=1e-6, atol=1e-6)
    assert completed(found, signals).notes == found.notes


def with_more(run: Trajectory) -> Trajectory:
    rate = -0.5 * run["x"] + run["u"] + 0.3 * run["w"]
    more = np.stack([np.cos(TIME + run["w"][0]), rate], axis=1)
    return run.with_channels([Channel("v", "m"), Channel("x_rate", "deg/s")], more)


def test_an_azimuth_in_rad_gives_the_same_phase():
    turning = [
        run.with_channels(
            [Channel("speed", "rpm"), Channel("psi", "deg")],
            np.stack([6 + 0.1 * np.sin(TIME + k), (36 * TIME + 10 * k) % 360], axis=1),
        )
        for k, run in enumerate((recorded(0), recorded(1)))
    ]
    settings = replace(
        SETTINGS,
        states=(*SETTINGS.states, StateSpec(name="speed")),
        azimuth=Azimuth(speed="speed", angle="psi"),
    )
    in_rad = [
        replace(relabelled(r, psi="rad"), values=r.values * [1, 1, 1, 1, 1, np.pi / 180])
        for r in turning
    ]
    found, expected = (extract(select(r, settings), settings) for r in (in_rad[:1], turning[:1]))
    np.testing.assert_allclose(found.psi, expected.psi, rtol=1e-9)
    with pytest.warns(DfsmWarning, match="'psi' from rad to deg"):
        assert completed(in_rad[0], expected.signals).channel("psi").unit == "deg"


def test_systems_take_runs_in_other_units_and_wind_in_other_units_is_corrected():
    run = recorded(0).select(["u"])
    other = replace(relabelled(run, u="N-m"), values=1e3 * run.values)
    channels = [Channel("u", "kN-m")]
    with pytest.warns(DfsmWarning, match="'u' from N-m to kN-m, as in the system"):
        found = as_signal("controls", other, channels, TIME)
    np.testing.assert_allclose(found(3.3), as_signal("controls", run, channels, TIME)(3.3))
    wind = Trajectory(
        TIME,
        np.stack([np.full(len(TIME), 36.0), np.full(len(TIME), 1.0)], axis=1),
        (Channel("RtVAvgxh", "km/h"), Channel("PtfmRVyt", "rad/sec")),
    )
    np.testing.assert_allclose(undisturbed_rotor_wind(wind, 10.0)["RtVAvgxhCorr"], 36 + 36)


def test_intervals_know_the_unit_of_their_schedule(tmp_path):
    found = calibrate(model(), [recorded(5), recorded(6), recorded(7)])
    scheduled = replace(
        found,
        schedule="w",
        schedule_unit="m/s",
        grid=np.array([-2.0, 2.0]),
        half_width=np.array([[1.0, 1.0], [3.0, 3.0]]),
    )
    scheduled.save(tmp_path / "i.json")
    loaded = load_intervals(tmp_path / "i.json")
    run = recorded(8)
    fast = replace(relabelled(run, w="km/h"), values=run.values * [1, 1, 3.6, 1])
    rollout = simulate(model(), run)
    for a, b in zip(loaded.around(rollout, fast), scheduled.around(rollout, run), strict=True):
        np.testing.assert_allclose(a.values, b.values, rtol=1e-9)


# -- runs that hardly move ----------------------------------------------------------------------


def test_a_run_that_hardly_moves_has_no_nrmse_and_the_mean_leaves_it_out():
    still = recorded(9, rest=1e-4)
    moved = still.with_channels("x", still["x"] + 1e-3, replace=True)
    both = validate(model(), [recorded(3), moved])
    alone = validate(model(), [recorded(3)])
    for name in ("x", "y"):
        assert np.isnan(both.runs[1].models["multi-fidelity"].errors[name].nrmse)
        assert both.mean_nrmse("linear-fit", name) == alone.mean_nrmse("linear-fit", name)
    assert both.runs[1].models["multi-fidelity"].errors["x"].rmse > 1e-4
    assert "'x', 'y': less than 1% of the spread in training in run9.csv" in both.warnings[-1]
    nothing = validate(model(), [moved])
    assert nothing.mean_nrmse("multi-fidelity", "x") is None
    assert nothing.to_dict()["models"]["multi-fidelity"]["mean_nrmse"]["x"] is None
