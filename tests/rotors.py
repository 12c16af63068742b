"""Terms of inputs with names and units, and the rotor of the bundled turbine among them."""

from __future__ import annotations

from pathlib import Path

from dfsm.data.readers.rotor_table import read_rotor_table
from dfsm.data.trajectory import Channel
from dfsm.models.terms import Rotor, Term

IEA15 = Path(__file__).parents[1] / "examples" / "iea15"
TABLE = read_rotor_table(IEA15 / "Cp_Ct_Cq.IEA15MW.txt")
RADIUS = 120.97

UNITS = {
    "Torque": "kN-m",
    "Pitch": "deg",
    "Wind": "m/s",
    "Inner": "m/s",
    "Outer": "m/s",
    "Speed": "rpm",
    "PitchRate": "deg/s",
    "Surge": "m/s",
    "Radians": "rad",
    "RadPerSecond": "rad/s",
    "Generator": "deg/s",
}
CHANNELS = {name: Channel(name, unit) for name, unit in UNITS.items()}
COLUMNS = {name: i for i, name in enumerate(UNITS)}


def rotor(**changes) -> Rotor:
    plain = {"table": TABLE, "radius": RADIUS, "wind": "Wind", "speed": "Speed", "pitch": "Pitch"}
    return Rotor(**(plain | changes))


def term_of(settings) -> Term:
    return settings.term(CHANNELS, COLUMNS)
