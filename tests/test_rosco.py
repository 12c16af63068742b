"""Optimal controls to a file of ROSCO, and a high-fidelity run against the prediction."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.control import (
    DirectTranscription,
    OptimalControlProblem,
    check_run,
    load_solution,
    save_solution,
    solve,
)
from dfsm.control.flown import commands_told
from dfsm.controllers.bladed import BladedLibrary
from dfsm.controllers.discon import read_discon, write_discon
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.exports.rosco import write_rosco
from dfsm.numerics.fatigue import damage_equivalent_load
from dfsm.simulators import ODESystem

MOST = 7.56  # rpm


def turbine(drag: float = 1.0, torque: str = "kN-m", pitch: str = "deg") -> ODESystem:
    """A rotor that spins up in a steady wind; its tower load follows from pitch and speed."""
    to_kn = {"kN-m": 1.0, "N-m": 1e-3, "MN·m": 1e3, "lbf ft": 1.0}[torque]
    to_deg = {"deg": 1.0, "rad": 180 / np.pi}.get(pitch, 1.0)

    def f(x, u, _w, _p):
        power = 18 - 0.8 * to_deg * u[1] - 0.05 * drag * x[0] ** 2
        return jnp.stack([0.1 * (power - 1e-3 * to_kn * u[0])])

    def g(x, u, _w, _p):
        return jnp.stack([2.0 * x[0] ** 2 * (1 - 0.03 * to_deg * u[1])])

    return ODESystem(
        f,
        states=(Channel("GenSpeed", "rpm"),),
        controls=(Channel("GenTq", torque), Channel("BldPitch1", pitch)),
        outputs=(Channel("TwrBsMyt", "kN-m"),),
        g=g,
        name="turbine",
    )


@pytest.fixture(scope="module")
def solution():
    found = solve(
        OptimalControlProblem(
            model=turbine(),
            horizon=(100.0, 130.0),
            cost=lambda s: 1e-6 * (s.u.GenTq - 13000) ** 2 + (s.u.BldPitch1 - 2) ** 2,
            initial={"GenSpeed": 7.0},
            bounds={"GenSpeed": (5.0, MOST), "GenTq": (0.0, 21000.0), "BldPitch1": (0.0, 20.0)},
            rates={"BldPitch1": (-2.0, 2.0)},
            name="spin up",
        ),
        DirectTranscription(mesh=30, refine=None),
        simulate=False,
    )
    assert found.solved
    return found


@pytest.fixture
def result(solution, tmp_path):
    save_solution(solution, tmp_path / "result")
    return tmp_path / "result"


@pytest.fixture(scope="module")
def run(solution):
    """What a turbine does that is braked less than the model believes."""
    optimum = solution.trajectory
    time = np.linspace(100, 130, 301)
    controls = optimum.select(["GenTq", "BldPitch1"])
    return turbine(drag=0.97).simulate(time, [7.0], controls, name="truth")


# -- export -------------------------------------------------------------------------------------


def table(path):
    return np.loadtxt(path, comments="!")


def test_the_file_holds_time_pitch_and_torque_in_units_of_rosco(solution, tmp_path):
    written = write_rosco(solution, tmp_path / "ol.dat")
    found, optimum = table(tmp_path / "ol.dat"), solution.trajectory
    assert (written.pitch, written.torque, written.rows) == ("BldPitch1", "GenTq", len(optimum))
    np.testing.assert_allclose(found[:, 0], optimum.time, rtol=1e-9)
    np.testing.assert_allclose(found[:, 1], np.radians(optimum["BldPitch1"]), atol=1e-9)
    np.testing.assert_allclose(found[:, 2], 1000 * optimum["GenTq"], rtol=1e-8)
    heads = [t for t in (tmp_path / "ol.dat").read_text().splitlines() if t.startswith("!")]
    assert heads[-1] == "! Time (s)  BldPitch1 (rad)  GenTq (N m)"
    assert written.discon == {
        "OL_Mode": "1",
        "OL_Filename": '"ol.dat"',
        "Ind_Breakpoint": "1",
        "Ind_BldPitch": "2 2 2",
        "Ind_GenTq": "3",
        "PC_ControlMode": "1",
        "PA_Mode": "0",
    } | {k: written.discon[k] for k in ("PC_MinPit", "PC_MaxPit", "PC_MinRat", "PC_MaxRat")}


def test_limits_that_the_pitch_needs_are_printed_and_none_is_narrower(solution, tmp_path):
    written = write_rosco(solution, tmp_path / "ol.dat")
    time, pitch = table(tmp_path / "ol.dat")[:, :2].T
    rates = np.diff(pitch) / np.diff(time)
    needs = {k: float(v) for k, v in written.discon.items() if k.startswith("PC_M")}
    assert needs["PC_MinPit"] <= pitch.min() + 1e-9
    assert pitch.max() - 1e-9 <= needs["PC_MaxPit"] <= pitch.max() + 1e-4
    assert -needs["PC_MinRat"] == needs["PC_MaxRat"] >= np.abs(rates).max() - 1e-9
    assert "lets the torque pass beyond VS_MaxTq" in " ".join(written.lines())


def test_a_model_with_an_actuator_keeps_that_of_rosco_off_the_list(solution, tmp_path):
    def with_state(run):
        named = (replace(c, name="BldPitch") if c.role == "state" else c for c in run.channels)
        return replace(run, channels=tuple(named))

    own = replace(solution, trajectories=tuple(map(with_state, solution.trajectories)))
    written = write_rosco(own, tmp_path / "ol.dat", pitch="BldPitch1")
    assert "PA_Mode" not in written.discon
    assert any("its own pitch actuator" in note for note in written.notes)


def test_negative_torque_is_warned_of(solution, tmp_path):
    def lowered(run):
        values = np.array(run.values)
        values[:, run.names.index("GenTq")] -= 1e5
        return replace(run, values=values)

    below = replace(solution, trajectories=tuple(map(lowered, solution.trajectories)))
    with pytest.warns(DfsmWarning, match=r"torque is negative in 61 of 61 rows.* ROSCO makes it 0"):
        write_rosco(below, tmp_path / "ol.dat")


DISCON = """! a deck
{lowest}      ! PC_MinPit    - Lowest pitch, [rad]
1.57          ! PC_MaxPit    - Highest pitch, [rad]
0.1           ! PC_MaxRat    - Fastest pitch, [rad/s]
-0.1          ! PC_MinRat    - Fastest pitch, [rad/s]
{mode}        ! PA_Mode      - Pitch actuator
1             ! PC_ControlMode
{most}        ! VS_MaxTq     - Most torque, [Nm]
1D9           ! VS_MaxRat    - Fastest torque, [Nm/s]
"""


def test_every_limit_of_a_deck_that_the_file_breaks_is_named(solution, result, tmp_path, dfsm):
    wide, narrow = tmp_path / "wide.IN", tmp_path / "narrow.IN"
    wide.write_text(DISCON.format(lowest="-0.2", mode=0, most="1e9"), "ascii")
    narrow.write_text(DISCON.format(lowest="0.5", mode=2, most="1e3"), "ascii")
    passed = write_rosco(solution, tmp_path / "ol.dat", discon=wide)
    assert len(passed.notes) == 1
    assert float(passed.discon["PC_MinPit"]) == -0.2
    assert float(passed.discon["PC_MaxPit"]) == 1.57
    broken = write_rosco(solution, tmp_path / "ol.dat", discon=narrow).notes[1:]
    assert [note.split()[0] for note in broken] == ["PA_Mode", "PC_MinPit", "VS_MaxTq"]
    assert "which ROSCO lets pass" in broken[2]
    shown = dfsm("export-rosco", result, "-o", tmp_path / "ol.dat", "--discon", narrow)
    assert "PC_MinPit is 0.5: the file goes to" in shown.out
    narrow.write_text("nothing of ROSCO\n", "ascii")
    with pytest.raises(DfsmError, match=r"expected ROSCO's DISCON\.IN"):
        write_rosco(solution, tmp_path / "ol.dat", discon=narrow)


@pytest.mark.parametrize(("torque", "factor"), [("N-m", 1.0), ("MN·m", 1e6), ("kN-m", 1e3)])
@pytest.mark.parametrize(("pitch", "angle"), [("rad", 1.0), ("deg", np.pi / 180)])
def test_units_are_those_of_the_channels(solution, tmp_path, torque, factor, pitch, angle):
    given = with_units(solution, GenTq=torque, BldPitch1=pitch)
    write_rosco(given, tmp_path / "ol.dat")
    found, optimum = table(tmp_path / "ol.dat"), solution.trajectory
    np.testing.assert_allclose(found[:, 1], angle * optimum["BldPitch1"], atol=1e-9)
    np.testing.assert_allclose(found[:, 2], factor * optimum["GenTq"], rtol=1e-8)


def test_torque_alone_and_rows_between_the_nodes(solution, tmp_path):
    written = write_rosco(with_units(solution, BldPitch1="-"), tmp_path / "ol.dat", step=0.25)
    found = table(tmp_path / "ol.dat")
    assert found.shape == (121, 2)
    np.testing.assert_allclose(found[:, 0], np.linspace(100, 130, 121))
    tau = np.linspace(0, 1, 121)
    np.testing.assert_allclose(found[:, 1], 1000 * solution.at(tau)[1][:, 0], rtol=1e-8)
    assert written.discon["Ind_BldPitch"] == "0 0 0"
    assert written.discon["Ind_GenTq"] == "2"


def test_controls_that_are_none_or_too_many_earn_a_sentence(solution, tmp_path):
    path = tmp_path / "ol.dat"
    nothing = with_units(solution, GenTq="kN", BldPitch1="%")
    with pytest.raises(DfsmError, match="its controls are GenTq in 'kN', BldPitch1 in '%'"):
        write_rosco(nothing, path)
    both = with_names(with_units(solution, BldPitch1="kN m"), BldPitch1="GenTorque")
    with pytest.raises(DfsmError, match="the torque may be GenTq or GenTorque"):
        write_rosco(both, path)
    assert write_rosco(both, path, torque="GenTq").torque == "GenTq"
    with pytest.raises(DfsmError, match="pitch: 'GenTq' is in 'kN-m', expected an angle"):
        write_rosco(solution, path, pitch="GenTq")
    with pytest.raises(DfsmError, match="did you mean 'BldPitch1'"):
        write_rosco(solution, path, pitch="BldPitch")
    with pytest.raises(DfsmError, match="scenario is 2, expected 1 to 1"):
        write_rosco(solution, path, scenario=2)
    with pytest.raises(DfsmError, match="step is -1"):
        write_rosco(solution, path, step=-1)


def test_a_unit_alone_makes_no_control_the_pitch_or_the_torque(solution, tmp_path):
    path = tmp_path / "ol.dat"
    yaws = with_names(solution, BldPitch1="NacYaw")
    with pytest.raises(DfsmError, match=r"NacYaw in 'deg' has no name .* with --pitch"):
        write_rosco(yaws, path)
    assert not path.exists()
    assert write_rosco(yaws, path, pitch="NacYaw").pitch == "NacYaw"
    alone = write_rosco(yaws, path, torque="GenTq")
    assert (alone.pitch, alone.discon["Ind_BldPitch"]) == (None, "0 0 0")
    slow = with_names(solution, GenTq="RotTorq", BldPitch1="PtchPMzc1")
    with pytest.raises(DfsmError, match=r"RotTorq in 'kN-m' has no name .* with --torque"):
        write_rosco(slow, path)
    assert write_rosco(slow, path, pitch="PtchPMzc1").torque is None
    # A yaw beside what is known by its name is no reason to ask.
    beside = with_names(with_units(solution, GenTq="deg"), GenTq="NacYaw")
    assert write_rosco(beside, path).pitch == "BldPitch1"


def test_the_command_prints_what_to_set(result, tmp_path, dfsm):
    shown = dfsm("export-rosco", result, "-o", tmp_path / "ol.dat")
    assert shown.code == 0
    assert "2 2 2                ! Ind_BldPitch" in shown.out
    assert "1                    ! Ptch_Cntrl" in shown.out
    shown = dfsm("export-rosco", result, "-o", tmp_path / "ol.dat", "--json")
    assert json.loads(shown.out)["discon"]["Ind_GenTq"] == "3"
    assert "there is no folder" in dfsm("export-rosco", result, "-o", "no/ol.dat").sentence
    assert "is no folder of a solution" in dfsm("export-rosco", tmp_path, "-o", "x.dat").sentence


# -- the way back -------------------------------------------------------------------------------


def test_a_run_of_the_same_system_is_as_predicted(solution):
    time = np.linspace(100, 130, 601)
    tau = (time - 100) / 30
    controls = solution.trajectory.select(["GenTq", "BldPitch1"]).channels
    same = turbine().simulate(
        time, [7.0], Trajectory(time, solution.at(tau)[1], controls), name="same"
    )
    found = check_run(solution, same)
    assert found.complete
    assert found.missing == ()
    assert found.channels["GenSpeed"].rmse < 1e-3
    assert found.channels["GenTq"].largest < 1e-9
    assert found.power["actual"] == pytest.approx(found.power["predicted"], rel=1e-3)


def test_a_run_of_another_system_is_told_apart(solution, run):
    found = check_run(solution, run)
    speed, load = found.channels["GenSpeed"], found.channels["TwrBsMyt"]
    assert found.limits["GenSpeed"].predicted < 1e-3
    assert found.limits["GenSpeed"].actual == pytest.approx(run["GenSpeed"].max() - MOST)
    assert found.limits["GenSpeed"].actual > 0.05
    assert run.time[np.argmax(run["GenSpeed"])] == found.limits["GenSpeed"].at
    assert found.limits["GenTq"].actual == 0.0
    assert found.limits["GenTq"].at is None
    assert set(found.limits) == {"GenSpeed", "GenTq", "BldPitch1", "rate of BldPitch1"}
    assert speed.rmse > 0.02
    assert load.actual.damage["4"] == damage_equivalent_load(run["TwrBsMyt"], 30.0, 4)
    assert load.actual.maximum == run["TwrBsMyt"].max()
    power = run["GenTq"] * run["GenSpeed"] * np.pi / 30
    assert found.power["actual"] == pytest.approx(np.trapezoid(power, run.time) / 30)
    assert found.power_source == "GenTq × GenSpeed"


def test_parts_and_missing_channels_are_told(solution, run):
    part = run.select(["GenSpeed"]).window(110, 120)
    found = check_run(solution, part)
    assert (found.start, found.stop, found.complete) == (110.0, 120.0, False)
    assert found.missing == ("GenTq", "BldPitch1", "TwrBsMyt")
    assert found.power is None


def test_runs_that_do_not_fit_earn_a_sentence(solution, run):
    with pytest.raises(DfsmError, match="they have no time in common"):
        check_run(solution, replace(run, time=run.time + 100))
    other = tuple(replace(c, name="x" + c.name) for c in run.channels)
    with pytest.raises(DfsmError, match="no channels 'GenSpeed'"):
        check_run(solution, replace(run, channels=other))
    other = tuple(replace(c, unit="m/s" if c.unit == "rpm" else c.unit) for c in run.channels)
    with pytest.raises(DfsmError, match="'GenSpeed' is in 'm/s', in the solution in 'rpm'"):
        check_run(solution, replace(run, channels=other))


def test_a_run_in_other_units_is_converted(solution, run):
    size = {"GenSpeed": ("rad/s", np.pi / 30), "GenTq": ("N·m", 1e3), "BldPitch1": ("degrees", 1)}
    units, sizes = zip(*(size.get(c.name, (c.unit, 1)) for c in run.channels), strict=True)
    channels = tuple(replace(c, unit=u) for c, u in zip(run.channels, units, strict=True))
    with pytest.warns(DfsmWarning, match="'GenSpeed' from rad/s to rpm, 'GenTq' from N·m to kN-m"):
        found = check_run(solution, replace(run, values=run.values * sizes, channels=channels))
    as_it_was = check_run(solution, run)
    assert found.channels["GenTq"].rmse == pytest.approx(as_it_was.channels["GenTq"].rmse)
    assert found.power["actual"] == pytest.approx(as_it_was.power["actual"])


def test_power_is_that_of_one_shaft_or_the_runs_own(solution, run):
    geared = with_names(solution, GenSpeed="RotSpeed")
    turned = replace(
        run,
        channels=tuple(
            replace(c, name="RotSpeed" if c.name == "GenSpeed" else c.name) for c in run.channels
        ),
    )
    product = np.trapezoid(run["GenTq"] * run["GenSpeed"] * np.pi / 30, run.time) / 30
    found = check_run(geared, turned)
    assert found.power is None
    assert "gearbox ratio between them with --ratio" in found.power_advice
    assert check_run(geared, turned, ratio=97).power["actual"] == pytest.approx(97 * product)
    with pytest.raises(DfsmError, match="ratio is -1, expected a number above 0"):
        check_run(geared, turned, ratio=-1)
    made = turned.with_channels([Channel("GenPwr", "MW")], np.full(len(run), 2.5))
    made = made.with_channels([Channel("RotPwr", "kW")], np.full(len(run), 9.0))
    found = check_run(geared, made)
    assert found.power == {"predicted": None, "actual": pytest.approx(2500)}
    assert found.power_source == "GenPwr"
    found = check_run(solution, run.with_channels([Channel("Power", "kW")], np.full(len(run), 9.0)))
    assert found.power["actual"] == pytest.approx(9)
    assert found.power_source == "GenTq × GenSpeed → Power"


FLOWN = {
    "as commanded": (lambda t, a: a, None),
    "cut": (lambda t, a: np.maximum(a, 2.0), "held at 2 from below"),
    "not taken": (lambda t, a: 0 * a, "stays at 0 throughout"),
    "late": (lambda t, a: np.interp(t - 0.6, t, a), "about 0.6 s late"),
    "shifted": (lambda t, a: a + 0.7, "differs by 0.7 throughout"),
}


@pytest.mark.parametrize("case", FLOWN)
def test_controls_flown_otherwise_are_told_with_the_cause(case):
    change, cause = FLOWN[case]
    time = np.linspace(0, 30, 601)
    channels = (Channel("BldPitch1", "deg", role="control"),)
    pitch = 3 + 3 * np.sin(0.5 * time) + np.sin(1.3 * time)
    told = commands_told(
        Trajectory(time, pitch[:, None], channels),
        Trajectory(time, change(time, pitch)[:, None], channels),
    )
    if cause is None:
        assert told == ()
    else:
        assert "BldPitch1 was flown otherwise than commanded" in told[0]
        assert cause in told[0]


def test_a_rate_limit_is_told_as_one():
    time = np.linspace(0, 30, 601)
    pitch = 3.0 * (np.sin(1.5 * time) > 0)
    flown = np.zeros_like(pitch)
    for k in range(600):
        flown[k + 1] = flown[k] + np.clip(pitch[k + 1] - flown[k], -0.1, 0.1)
    channels = (Channel("BldPitch1", "deg", role="control"),)
    runs = (Trajectory(time, v[:, None], channels) for v in (pitch, flown))
    assert "rate stays below 2 per second: a rate limit" in commands_told(*runs)[0]


def test_limits_survive_saving(solution, result, run):
    assert check_run(load_solution(result), run) == check_run(solution, run)


def test_the_command_prints_tables_and_json(result, run, tmp_path, dfsm):
    write_table(run, tmp_path / "run.parquet")
    shown = dfsm("check-run", result, tmp_path / "run.parquet")
    assert shown.code == 0
    assert "mean power (GenTq × GenSpeed)" in shown.out
    assert "beyond its limits by" in shown.out
    assert "TwrBsMyt" in shown.out
    shown = dfsm("check-run", result, tmp_path / "run.parquet", "--json")
    found = json.loads(shown.out)
    assert found["limits"]["GenSpeed"]["actual"] > 0.05
    assert "no.parquet" in dfsm("check-run", result, "no.parquet").sentence


def with_names(solution, **names):
    def changed(run):
        channels = [replace(c, name=names.get(c.name, c.name)) for c in run.channels]
        return replace(run, channels=tuple(channels))

    return replace(solution, trajectories=tuple(map(changed, solution.trajectories)))


def with_units(solution, **units):
    def changed(run):
        channels = [replace(c, unit=units.get(c.name, c.unit)) for c in run.channels]
        return replace(run, channels=tuple(channels))

    return replace(solution, trajectories=tuple(map(changed, solution.trajectories)))


@pytest.mark.slow
def test_the_library_of_the_wheel_flies_the_file(solution, tmp_path):
    wheel = Path(str(pytest.importorskip("rosco").__path__[0]))
    (deck,) = wheel.parent.glob("Examples/**/IEA-15-240-RWT-UMaineSemi_DISCON.IN")
    written = write_rosco(solution, tmp_path / "ol.dat", discon=deck)
    write_discon(read_discon(deck), tmp_path / "DISCON.IN")
    lines = (tmp_path / "DISCON.IN").read_text().splitlines()
    for key, value in written.discon.items():
        at = [i for i, line in enumerate(lines) if line.partition("!")[2].split()[:1] == [key]]
        lines[at[-1]] = f"{value} ! {key}"
    (tmp_path / "DISCON.IN").write_text("\n".join(lines) + "\n")
    interval, channels = 0.05, {"pitch": ("BldPitch1", "deg")}
    library = BladedLibrary(
        next(wheel.glob("lib/libdiscon.*")), tmp_path / "DISCON.IN",
        interval=interval, channels=channels,
    )  # fmt: skip
    seen, flown = np.array([7.0, 11.0, 0.0]), []
    time = np.arange(98.0, 130.0, interval)
    state = library.start(seen, np.array([1.5e4, 2.0]))
    for t in time:
        state, commands = library.step(state, seen, float(t))
        flown.append(commands)
    state.close()
    optimum, part = solution.trajectory, time > 101.0
    for column, name, tolerance in ((1, "BldPitch1", 0.01), (0, "GenTq", 1.0)):
        told = np.interp(time[part], optimum.time, optimum[name])
        assert np.abs(np.array(flown)[part, column] - told).max() < tolerance, name
