"""ROSCO in JAX against the answers of ROSCO's library, its limits, start, gradients, bad input."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from decks import write_deck
from dfsm.controllers.bladed import BladedLibrary
from dfsm.controllers.controller import Controller
from dfsm.controllers.discon import read_discon
from dfsm.controllers.rosco import read_rosco
from dfsm.errors import DfsmError
from rosco_variants import (
    CHANNELS,
    DECK,
    INTERVAL,
    SLOW_VARIANTS,
    VARIANTS,
    answers,
    channels,
    library_answers,
    records,
)

WHEEL = importlib.util.find_spec("rosco")


@pytest.fixture(scope="module")
def told():
    return records()


def variant(folder: Path, changes: dict[str, str], as_library: bool = True):
    deck = write_deck(folder, **(DECK | changes))
    return read_rosco(deck, interval=INTERVAL, channels=channels(changes), as_library=as_library)


def differ(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference, as a share of the largest torque and pitch."""
    return float((np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)).max())


# Each set of modes is compiled on its own.
SELDOM = ("power", "torque")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SELDOM else n for n in VARIANTS]
)
def test_agrees_with_the_library_to_single_precision(tmp_path, told, name):
    controller = variant(tmp_path, VARIANTS[name])
    found = answers(controller, jnp.asarray(told.start), jnp.asarray(told.seen(controller)))
    # What the library answers has 24 bits.
    assert differ(np.asarray(found), told.commands[name]) < 1e-7


@pytest.mark.slow
@pytest.mark.skipif(WHEEL is None, reason="the rosco wheel is not installed")
@pytest.mark.parametrize("name", [*VARIANTS, *SLOW_VARIANTS])
def test_agrees_with_the_library_of_the_wheel(tmp_path, told, name):
    changes = (VARIANTS | SLOW_VARIANTS)[name]
    controller = variant(tmp_path, changes)
    library = Path(next(iter(WHEEL.submodule_search_locations))) / "lib" / "libdiscon.so"
    expected = library_answers(library, tmp_path / "DISCON.IN", told, changes)
    found = answers(controller, jnp.asarray(told.start), jnp.asarray(told.seen(controller)))
    assert differ(np.asarray(found), expected) < 1e-7
    if name in told.commands:
        assert differ(told.commands[name], expected) < 1e-7


@pytest.mark.slow
@pytest.mark.skipif(WHEEL is None, reason="the rosco wheel is not installed")
@pytest.mark.parametrize(
    ("name", "wind"), [("NREL-5MW/DISCON.IN", 12.0), ("MHK_RM1/MHK_RM1_DISCON.IN", 2.0)]
)
def test_agrees_with_the_library_on_decks_of_other_turbines(name, wind):
    """A geared turbine on land, a tidal one that floats and tracks its power."""
    # At 0.2 s the Kalman filter of the first deck is lost, in the library and here.
    interval = float(np.float32(0.1))
    assert WHEEL is not None
    assert WHEEL.origin is not None
    wheel = Path(WHEEL.origin).parent
    deck = wheel.parent / "Examples" / "Test_Cases" / name
    feedback = read_rosco(deck, interval=interval).inputs.roles[2:]
    roles = ("generator_speed", "wind", *feedback, "power", "torque", "pitch")
    told = {role: CHANNELS[role] for role in roles}
    ours = read_rosco(deck, interval=interval, channels=told, as_library=True)
    theirs = BladedLibrary(
        next(wheel.glob("lib/libdiscon.*")), deck, interval=interval, channels=told
    )
    time = interval * np.arange(700)
    rated, torque = (float(ours.parameters[k]) for k in ("PC_RefSpd", "VS_RtTq"))
    speed = rated * (0.93 + 0.1 * np.sin(0.05 * time) + 0.02 * np.sin(0.5 * time))
    measured = {
        "GenSpeed": speed,
        "Wind1VelX": wind * (1 + 0.2 * np.sin(0.05 * time - 0.4)),
        "YawBrTAxp": 0.05 * np.sin(0.3 * time),
        "GenPwr": 0.76 * torque * speed,
    }
    # The library takes single precision.
    rows = np.float32(np.column_stack([measured[n] for n in ours.measurements])).astype(float)
    begun = np.float32([0.8 * torque, 0.02]).astype(float)
    found = answers(ours, jnp.asarray(begun), jnp.asarray(rows))
    state, expected = theirs.start(rows[0], begun), []
    for at, row in zip(time[1:], rows[1:], strict=True):
        state, commands = theirs.step(state, row, float(at))
        expected.append(commands)
    state.close()
    assert np.ptp(np.array(expected), axis=0).min() > 0.1
    assert differ(np.asarray(found), np.array(expected)) < 1e-6


@pytest.fixture(scope="module")
def floating(tmp_path_factory):
    return variant(tmp_path_factory.mktemp("floating"), {}, as_library=False)


def test_is_a_controller_that_continues_what_the_turbine_does(floating, told):
    assert isinstance(floating, Controller)
    assert floating.commands == ("GenTq", "BldPitch1")
    for speed, wind, torque, pitch in ((0.70, 9.5, 1.4e7, 0.03), (0.80, 15.0, 1.978e7, 0.15)):
        seen = told.seen(floating)
        names = {name: i for i, name in enumerate(floating.measurements)}
        seen[:, names["GenSpeed"]], seen[:, names["Wind1VelX"]] = speed, wind
        seen[:, names["GenPwr"]], seen[:, names["NcIMURAys"]] = torque * speed * 0.95756, 0.0
        found = np.asarray(answers(floating, jnp.asarray([torque, pitch]), jnp.asarray(seen)))
        jump = np.abs(found[0] - [torque, pitch])
        assert jump[0] < 0.002 * torque
        assert jump[1] < 1e-4


def test_no_limit_is_ever_exceeded(floating, told):
    generator = np.random.default_rng(3)
    p = {key: np.asarray(value) for key, value in floating.parameters.items()}
    start = jnp.asarray([5e6, 0.1])
    for _ in range(3):
        seen = told.seen(floating)
        # Jumps of everything, far out of the ordinary.
        seen[20:] *= generator.uniform(0.2, 3.0, size=seen[20:].shape)
        torque, pitch = np.asarray(answers(floating, start, jnp.asarray(seen))).T
        assert np.isfinite(torque).all()
        assert torque.min() >= p["VS_MinTq"]
        assert torque.max() <= min(p["VS_MaxTq"], p["VS_RtTq"]) * (1 + 1e-12)
        assert pitch.min() >= p["PC_MinPit"]
        assert pitch.max() <= p["PC_MaxPit"]
        slack = 1 + 1e-9
        assert np.abs(np.diff(torque)).max() <= p["VS_MaxRat"] * INTERVAL * slack
        assert np.diff(pitch).max() <= p["PC_MaxRat"] * INTERVAL * slack
        assert np.diff(pitch).min() >= p["PC_MinRat"] * INTERVAL * slack


def test_gains_have_exact_gradients(floating, told):
    seen, start = jnp.asarray(told.seen(floating))[300:420], jnp.asarray([1.6e7, 0.08])
    weights = jnp.asarray([1e-7, 1.0])
    names = ("Fl_Kp", "SS_PCGain", "PC_GS_KI", "F_LPFCornerFreq", "VS_KP")

    def cost(gains):
        state = floating.changed(gains).start(seen[0], start)
        step = floating.changed(gains).step
        found = jax.lax.scan(lambda s, x: step(s, x, jnp.asarray(0.0)), state, seen[1:])[1]
        return jnp.sum((found * weights) ** 2)

    gains = {name: floating.parameters[name] for name in names}
    values = jax.jit(jax.value_and_grad(cost))
    _, slopes = values(gains)
    for name in names:
        step = 1e-6 * gains[name]
        up, down = (values(gains | {name: gains[name] + s * step})[0] for s in (1, -1))
        expected = float(up - down) / 2e-6
        assert float(jnp.sum(slopes[name] * gains[name])) == pytest.approx(expected, rel=1e-5)


def test_what_is_not_implemented_is_refused_by_key(tmp_path):
    for key, value in (("IPC_ControlMode", 1), ("OL_Mode", 1), ("VS_FBP", 1), ("PRC_Mode", 2)):
        deck = write_deck(tmp_path, **{key: str(value)})
        if key == "OL_Mode":
            deck.write_text(deck.read_text() + '"DISCON.IN" ! OL_Filename\n1 ! Ind_Breakpoint\n')
        with pytest.raises(DfsmError, match=f"{key} is {value}, and ROSCO in JAX has 0"):
            read_rosco(deck, interval=0.1)
    with pytest.raises(DfsmError, match="WE_Mode is 3, and ROSCO in JAX has 0 or 1 or 2"):
        read_rosco(write_deck(tmp_path, WE_Mode="3"), interval=0.1)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"PerfTableSize": "17 13"}, r"PerfTableSize is \[17, 13\], and .* has \[18, 13\]"),
        ({"F_TwrTopNotch_Ind": "3"}, "F_TwrTopNotch_Ind names notch filter 3 of 2"),
        ({"PS_WindSpeeds": "3 7 7 25"}, "PS_WindSpeeds does not rise"),
        ({"PC_GS_KI": "-1 nan -1 -1"}, "PC_GS_KI holds nan, expected finite numbers"),
        ({"VS_RtTq": "1.9e7x"}, "VS_RtTq is '1.9e7x', expected numbers"),
    ],
)
def test_values_that_rosco_cannot_compute_with_are_told(tmp_path, changes, told):
    with pytest.raises(DfsmError, match=told):
        read_rosco(write_deck(tmp_path, **changes), interval=0.1)


def test_parameters_are_changed_by_key(floating):
    changed = floating.changed({"Fl_Kp": [-5.0]})
    assert float(changed.parameters["Fl_Kp"][0]) == -5.0
    assert float(floating.parameters["Fl_Kp"][0]) == -9.1984
    with pytest.raises(DfsmError, match="no parameter Fl_Kpp; did you mean 'Fl_Kp'"):
        floating.changed({"Fl_Kpp": 1.0})
    with pytest.raises(DfsmError, match=r"PC_GS_KP is 1\.0, expected as many values"):
        floating.changed({"PC_GS_KP": 1.0})


def test_measurements_are_what_the_modes_need(tmp_path):
    deck = read_discon(write_deck(tmp_path))
    assert read_rosco(deck, interval=0.1).measurements == ("GenSpeed", "RotWind", "NcIMURAys")
    assert read_rosco(deck.changed({"Fl_Mode": 1}), interval=0.1).measurements[2] == "YawBrTAxp"
    plain = read_rosco(deck.changed({"Fl_Mode": 0}), interval=0.1, channels={"power": "GenPwr"})
    assert plain.measurements == ("GenSpeed", "RotWind", "GenPwr")
    assert plain.measurement_units == ("rpm", "m/s", "kW")
    assert "Fl_Kp" not in plain.parameters
    assert set(CHANNELS) > {"wind"}
