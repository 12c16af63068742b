"""What ROSCO's own library answers, recorded; run as a program, it records again.

    PYTHONPATH=src:tests python tests/rosco_variants.py path/to/libdiscon.so

The turbine of `decks.py` was simulated with ROSCO in JAX in a gusty wind that rises through rated;
its speed, wind, power and accelerations, in single precision, were then fed to the library of the
rosco 2.10.6 wheel in every variant, once every 0.2 s.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from decks import write_deck
from dfsm.controllers.bladed import BladedLibrary
from dfsm.controllers.rosco import ROSCO, read_rosco
from dfsm.controllers.rosco_blocks import lookup_2

RECORDS = Path(__file__).parent / "data" / "rosco-2.10.6.npz"
# ROSCO's library reads the interval in single precision.
INTERVAL = float(np.float32(0.2))
STEPS = 700
INERTIA, AREA = 312456272.0, 0.5 * 1.225 * np.pi * 120.97**2
# SI units, which single precision holds.
CHANNELS = {
    "generator_speed": ("GenSpeed", "rad/s"),
    "wind": ("Wind1VelX", "m/s"),
    "power": ("GenPwr", "W"),
    "nacelle_pitch_acceleration": ("NcIMURAys", "rad/s^2"),
    "nacelle_acceleration": ("YawBrTAxp", "m/s^2"),
    "torque": ("GenTq", "N-m"),
    "pitch": ("BldPitch1", "rad"),
}
# Below its minimum of 0 the library's own rounding takes the pitch, and its estimator goes off.
DECK = {"PC_MinPit": "-0.02"}
VARIANTS = {
    "floating": {},
    "komega": {
        **{"VS_ControlMode": "1", "VS_ConstPower": "1", "WE_Mode": "1", "Fl_Mode": "1"},
        **{"PA_Mode": "1", "F_LPFType": "1", "F_TwrTopNotch_N": "0", "Fl_Kp": "-0.06"},
    },
    "power": {
        **{"VS_ControlMode": "3", "VS_ConstPower": "1", "WE_Mode": "0", "Fl_Mode": "0"},
        **{"PA_Mode": "0", "SS_Mode": "0", "PS_Mode": "0"},
    },
    "torque": {"VS_ControlMode": "4", "F_GenSpdNotch_N": "0", "WE_FOPoles": "-0.05 -0.1 -0.3"},
    # A pitch beyond the rotor's table switches the estimator off and on.
    "bounds": {"PC_GS_KI": "-0.6 -0.6 -0.6 -0.6", "PC_MaxRat": "0.12"},
}
SLOW_VARIANTS = {
    "komega_torque": {"VS_ControlMode": "1", "VS_ConstPower": "0"},
    "constant_power": {"VS_ConstPower": "1"},
    "no_shaving": {"PS_Mode": "0", "SS_Mode": "0"},
    "scheduled": {"Fl_n": "3", "Fl_Kp": "-9.0 -4.0 -2.0", "Fl_U": "8.0 12.0 16.0"},
}


@dataclass(frozen=True)
class Records:
    """Measurements by role and shape ``(time,)``, and commands, shape ``(time, command)``."""

    measurements: dict[str, np.ndarray]
    start: np.ndarray
    commands: dict[str, np.ndarray]

    def seen(self, controller: ROSCO | BladedLibrary) -> np.ndarray:
        """What a controller measures, shape ``(time, measurement)``."""
        names = {name: role for role, (name, _) in CHANNELS.items()}
        columns = [self.measurements[names[name]] for name in controller.measurements]
        return np.column_stack(columns).astype(np.float64)


def records() -> Records:
    """What is stored."""
    with np.load(RECORDS, allow_pickle=False) as stored:
        parts = {name: stored[name] for name in stored.files}
    measured = {r: parts.pop(f"measured_{r}") for r in CHANNELS if f"measured_{r}" in parts}
    return Records(measured, parts.pop("start").astype(np.float64), parts)


def channels(deck: dict[str, str]) -> dict[str, tuple[str, str]]:
    """Those that a variant reads."""
    unread = {"0": ("nacelle_pitch_acceleration", "nacelle_acceleration")}
    unread["1"], unread["2"] = ("nacelle_pitch_acceleration",), ("nacelle_acceleration",)
    left = unread[deck.get("Fl_Mode", "2")]
    return {role: channel for role, channel in CHANNELS.items() if role not in left}


@jax.jit
def answers(controller: ROSCO, start: jax.Array, measurements: jax.Array) -> jax.Array:
    """Commands to recorded measurements, the first of which are those of the start call."""
    state = controller.start(measurements[0], start)
    return jax.lax.scan(lambda s, x: controller.step(s, x, 0.0), state, measurements[1:])[1]


def library_answers(library: Path, deck: Path, told: Records, variant: dict[str, str]):
    """The same from a library."""
    controller = BladedLibrary(library, deck, interval=INTERVAL, channels=channels(variant))
    measurements = told.seen(controller)
    state, found = controller.start(measurements[0], told.start), []
    for i, row in enumerate(measurements[1:]):
        state, commands = controller.step(state, row, INTERVAL * (i + 1))
        found.append(commands)
    state.close()
    return np.array(found)


def _simulated(controller: ROSCO) -> dict[str, np.ndarray]:
    """The turbine with ROSCO in JAX: speed, wind, power, accelerations."""
    p, power = controller.parameters, controller.power
    assert power is not None
    time = INTERVAL * np.arange(STEPS + 1)
    gusts = 0.5 * np.sin(0.31 * time) + 0.7 * np.sin(0.083 * time)
    wind = 7.0 + 9.0 * np.clip((time - 20) / 90, 0, 1) + gusts
    swing = 0.0006 * np.sin(0.2 * time) + 0.0005 * np.sin(1.1 * time)

    def step(carry, x):
        state, speed, torque = carry
        efficient = torque * speed * p["VS_GenEff"] / 100
        seen = {"generator_speed": speed, "wind": x[0], "power": efficient}
        seen |= {"nacelle_pitch_acceleration": x[1], "nacelle_acceleration": 150 * x[1]}
        names = {name: role for role, (name, _) in CHANNELS.items()}
        state, u = controller.step(
            state, jnp.stack([seen[names[n]] for n in controller.measurements]), 0.0
        )
        ratio = speed * p["WE_BladeRadius"] / x[0]
        cp = lookup_2(*power, (ratio, jnp.rad2deg(u[1])))
        driving = AREA * x[0] ** 3 * cp / speed
        return (state, speed + INTERVAL * (driving - u[0]) / INERTIA, u[0]), seen

    speed = jnp.asarray(0.55)
    seen = jnp.asarray([0.55, wind[0], 0.0, 0.0, 0.0])
    state = controller.start(seen, jnp.asarray([1e7, 0.01]))
    _, found = jax.lax.scan(step, (state, speed, jnp.asarray(1e7)), np.column_stack([wind, swing]))
    return {role: np.asarray(values, dtype=np.float32) for role, values in found.items()}


def _record(library: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        deck = write_deck(Path(folder), **DECK)
        controller = read_rosco(deck, interval=INTERVAL, channels=CHANNELS)
        told = Records(_simulated(controller), np.array([1e7, np.float32(0.03)]), {})
        stored = {f"measured_{role}": values for role, values in told.measurements.items()}
        for name, changes in VARIANTS.items():
            deck = write_deck(Path(folder), **(DECK | changes))
            found = library_answers(library, deck, told, changes)
            stored[name] = found.astype(np.float32)
        np.savez_compressed(RECORDS, start=np.float32(told.start), **stored)


if __name__ == "__main__":
    _record(Path(sys.argv[1]))
