"""Thrust and aerodynamic torque of a rotor, from its table of coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from dfsm.core.host import from_host
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.core.units import factor
from dfsm.data.readers.rotor_table import RotorTable, read_rotor_table
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.models.terms.inputs import input_columns
from dfsm.models.terms.rotor_surface import make_surface
from dfsm.models.terms.rotor_term import RotorConstants, RotorTerm

# kg/m³ of what rotors turn in.
_AIR, _WATER = (0.8, 1.6), (950.0, 1100.0)
_SPEEDS = ("rpm", "rad/s", "deg/s")


@settings_class
class Rotor:
    """Quasi-steady thrust and torque of a rotor, as two known terms of the linear fit.

    Attributes
    ----------
    table
        File of its coefficients, see `read_rotor_table`, or the table itself.
    radius
        In m.
    wind
        Wind at the undisturbed rotor, in m/s.
    speed
        Speed of the rotor or the generator, in rpm, rad/s or deg/s.
    pitch
        Blade pitch, in deg or rad.
    density
        In kg/m³.
    hub_height, pitch_rate
        Height of the hub above the point about which the platform pitches, in m, and the channel
        of that motion in deg/s or rad/s, positive downwind: hub_height times it is taken off the
        wind.
    surge_rate
        Channel of the platform's velocity downwind in m/s, which is taken off the wind.
    overhang, wind_rate
        How far upwind of the tower's place at rest, where `wind` is told, the middle of the blades
        stands, in m, and the channel of the wind's rate in m/s² (a feature of kind rate): the rotor
        meets the wind by so much earlier, see `terms.rotor_place`. In derivatives that rate acts
        through the rotor alone.
    platform_pitch, surge
        With these, channels of what carries it downwind: the platform's pitch in deg or rad (times
        hub_height), positive downwind, and its surge in m.
    gearbox_ratio
        Of `speed` to the speed of the rotor.
    corrections
        Further channels d_k in m/s, e.g. averages of the wind over rings of the disk less that
        over the disk: Σ a_k d_k is added to the wind, with weights that refinement learns. In
        derivatives they act through the rotor alone.
    inertia, generator_torque
        Of all that turns, about the rotor's axis, in kg m², and the channel of the torque that
        brakes it, in kN-m: with both the fit knows what the torques do to the speed.
    efficiency
        Of the gearbox: the part of the rotor's power that reaches the generator.
    memory
        How latent states reach the speed of a rotor of known inertia. ``"speed"``: they add to its
        rate. ``"wind"``: they change the wind that the rotor feels, so that neither thrust nor
        torque exceed what the table has, whatever an optimizer does; with an `uncertainty` this
        also predicts runs best.
    uncertainty
        Share by which the table's thrust and torque may well be off: with one above 0 refinement
        learns smooth factors of both, quadratic in blade pitch and inflow.
    induction
        ``"steady"``: the table holds at every moment. ``"lag"``: the induced velocity is a hidden
        state ``<name>.induced`` in m/s, which follows momentum theory with two lags, as its slow
        part ``<name>.induced_slow`` does with one, and the table is read at the wind that has the
        blades' present inflow; see `terms.induction`. A steady state has the table's forces.
        Refinement learns the lags within a factor of four.
    name
        What the values are called: ``<name>.thrust`` in kN and ``<name>.torque`` in kN-m.
    """

    table: str | Path | RotorTable
    radius: float
    wind: str
    speed: str
    pitch: str
    density: float = 1.225
    hub_height: float | None = None
    pitch_rate: str | None = None
    surge_rate: str | None = None
    overhang: float | None = None
    wind_rate: str | None = None
    platform_pitch: str | None = None
    surge: str | None = None
    gearbox_ratio: float = 1.0
    corrections: tuple[str, ...] = ()
    inertia: float | None = None
    generator_torque: str | None = None
    efficiency: float = 1.0
    memory: Literal["speed", "wind"] = "speed"
    uncertainty: float = 0.0
    induction: Literal["steady", "lag"] = "steady"
    name: str = "rotor"
    kind: Literal["rotor"] = "rotor"

    def __post_init__(self) -> None:
        for key, expected in (
            ("radius", "a positive number of m"),
            ("hub_height", "a positive number of m"),
            ("gearbox_ratio", "a positive number"),
            ("inertia", "a positive number of kg m²"),
        ):
            value = getattr(self, key)
            positive = value is None or (bool(np.isfinite(value)) and value > 0)
            require(positive, f"rotor.{key}", value, expected)
        likely = any(low <= self.density <= high for low, high in (_AIR, _WATER))
        told = f"kg/m³ of air ({_AIR[0]} to {_AIR[1]}) or water ({_WATER[0]:g} to {_WATER[1]:g})"
        require(likely, "rotor.density", self.density, told)
        require(0 < self.efficiency <= 1, "rotor.efficiency", self.efficiency, "0 to 1, not 0")
        known = bool(np.isfinite(self.uncertainty)) and 0 <= self.uncertainty <= 1
        require(known, "rotor.uncertainty", self.uncertainty, "a share from 0 to 1")
        require(bool(self.name), "rotor.name", "empty", "a name for its values")
        self._require_both(
            "hub_height", "pitch_rate", "the platform's motion at the hub is their product"
        )
        self._check_place()
        self._require_both(
            "inertia", "generator_torque", "what a torque does to the speed takes both"
        )
        twice = [n for n in self.inputs if self.inputs.count(n) > 1]
        if twice:
            raise DfsmError(f"rotor: channel '{twice[0]}' is named twice: name it once")

    def _require_both(self, first: str, second: str, why: str) -> None:
        """Of two settings that need each other none may stand alone."""
        if (getattr(self, first) is None) != (getattr(self, second) is None):
            here, lacking = (first, second) if getattr(self, second) is None else (second, first)
            raise DfsmError(
                f"rotor.{here} is {getattr(self, here)} without rotor.{lacking}: {why}, set both "
                "or neither"
            )

    def _check_place(self) -> None:
        """Where the rotor stands takes a distance and a rate, and says what carries it."""
        finite = self.overhang is None or bool(np.isfinite(self.overhang))
        require(finite, "rotor.overhang", self.overhang, "a number of m, 0 for none")
        self._require_both(
            "overhang",
            "wind_rate",
            "what a rotor meets that stands elsewhere follows from both",
        )
        carried = [key for key in ("platform_pitch", "surge") if getattr(self, key) is not None]
        if carried and self.overhang is None:
            raise DfsmError(
                f"rotor.{carried[0]} is '{getattr(self, carried[0])}' without rotor.overhang and "
                "rotor.wind_rate: it moves the place at which the wind is met, set them as well"
            )
        if self.platform_pitch is not None and self.hub_height is None:
            raise DfsmError(
                f"rotor.platform_pitch is '{self.platform_pitch}' without rotor.hub_height: how "
                "far a platform that leans carries the hub follows from both"
            )

    @property
    def winds(self) -> tuple[str, ...]:
        """Channels of wind that act on derivatives through the rotor alone."""
        return (*self.corrections, *(() if self.wind_rate is None else (self.wind_rate,)))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Channels that it takes."""
        place = (self.wind_rate, self.platform_pitch, self.surge)
        motion = (n for n in (self.pitch_rate, self.surge_rate, *place) if n is not None)
        return (self.wind, self.speed, self.pitch, *motion, *self.corrections)

    def term(
        self,
        channels: Mapping[str, Channel],
        columns: Mapping[str, int],
        spreads: Mapping[str, float] | None = None,
    ) -> RotorTerm:
        """The term of a model with these inputs.

        Parameters
        ----------
        channels, columns
            Channel and column in I of every input, by name.
        spreads
            Typical size of every input in its unit: a weight a_k counts as much as makes d_k as
            large as the wind; 1 where it is not known.

        Raises
        ------
        DfsmError
            A channel is no input or in a unit that says something else, or the table cannot be
            read.
        """
        what = f"rotor '{self.name}'"
        _, at = input_columns(what, self.inputs, channels, columns)
        units = dict.fromkeys(("wind", "surge_rate", "corrections"), "m/s")
        for key, unit in (units | {"wind_rate": "m/s^2", "surge": "m"}).items():
            named = getattr(self, key)
            for name in named if isinstance(named, tuple) else (named,):
                if name is not None:
                    _same(what, key, channels[name], unit)
        speed = _factor(what, "speed", channels[self.speed], _SPEEDS) / self.gearbox_ratio
        pitch = _factor(what, "pitch", channels[self.pitch], ("rad", "deg"))
        arm = None
        if self.pitch_rate is not None and self.hub_height is not None:
            rate = _factor(what, "pitch_rate", channels[self.pitch_rate], _SPEEDS[1:])
            arm = self.hub_height * rate
        lean = None
        if self.platform_pitch is not None and self.hub_height is not None:
            angle = _factor(what, "platform_pitch", channels[self.platform_pitch], ("rad", "deg"))
            lean = self.hub_height * angle
        if self.generator_torque is not None:
            braking = input_columns(what, (self.generator_torque,), channels, columns)[0]
            _same(what, "generator_torque", braking[0], "kNm")
        table = self.table
        if not isinstance(table, RotorTable):
            table = read_rotor_table(table)
        weights, grid, error = make_surface(table)
        about = RotorConstants(
            inputs=self.inputs,
            radius=self.radius,
            density=self.density,
            speed_factor=speed,
            pitch_factor=float(np.rad2deg(pitch)),
            arm=arm,
            surges=self.surge_rate is not None,
            overhang=self.overhang,
            lean=lean,
            drifts=self.surge is not None,
            gearbox_ratio=self.gearbox_ratio,
            inertia=self.inertia,
            efficiency=self.efficiency,
            memory=self.memory,
            uncertainty=self.uncertainty,
            ratios=(float(table.tip_speed_ratio[0]), float(table.tip_speed_ratio[-1])),
            angles=(float(table.pitch[0]), float(table.pitch[-1])),
            optimum=table.optimum[0],
            speed_unit=channels[self.speed].unit,
            pitch_unit=channels[self.pitch].unit,
            error=error,
        )
        return RotorTerm(
            columns=at,
            channels=(Channel(f"{self.name}.thrust", "kN"), Channel(f"{self.name}.torque", "kN-m")),
            weights=from_host(weights),
            gains=from_host(np.zeros(len(self.corrections))),
            scale=from_host(self._scale(spreads or {})),
            late=from_host(np.zeros((1, 1))),
            grid_of_late=from_host(np.zeros(1)),
            trim=from_host(np.zeros((2, 6))),
            induction=from_host(np.zeros((2, 0, 0))),
            pace=from_host(np.zeros(2)),
            grid=grid,
            about=about,
        )

    def _scale(self, spreads: Mapping[str, float]) -> Array:
        wind = spreads.get(self.wind, 1.0)
        sizes = [spreads.get(name, wind) for name in self.corrections]
        return np.array([wind / s if s > 0 and wind > 0 else 1.0 for s in sizes])


def _factor(what: str, key: str, channel: Channel, units: Sequence[str]) -> float:
    """What one unit of a channel is in rad or rad/s, of which `units` are the usual ones."""
    size = factor(channel.unit, next(u for u in units if u.startswith("rad")))
    if size is None:
        raise DfsmError(
            f"{what}: its {key} '{channel.name}' is in '{channel.unit}', expected "
            f"{' or '.join(units)}: name another channel or convert it"
        )
    return size


def _same(what: str, key: str, channel: Channel, unit: str) -> None:
    if factor(channel.unit, unit) != 1.0:
        raise DfsmError(
            f"{what}: its {key} '{channel.name}' is in '{channel.unit}', expected {unit}: name "
            "another channel or convert it"
        )
