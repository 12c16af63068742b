"""ROSCO's filters: of measurements, commands, setpoints and the pitch actuator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dfsm.controllers.rosco_blocks import (
    Coefficients,
    FilterState,
    filtered,
    high_pass,
    low_pass,
    low_pass_2,
    notch,
    settled,
)
from dfsm.controllers.rosco_deck import Modes

# Of the filters on torque and pitch.
_DAMPING = 0.7


class Measured(NamedTuple):
    """What comes from the turbine in SI units; the acceleration that floating feedback takes."""

    speed: jax.Array
    rotor: jax.Array
    wind: jax.Array
    power: jax.Array
    acceleration: jax.Array


class RoscoFilters(NamedTuple):
    """States of filters: of generator and rotor speed, acceleration, wind, commands, setpoints."""

    speed: tuple[FilterState, ...]
    rotor: FilterState
    acceleration: tuple[FilterState, ...]
    wind: FilterState
    torque: FilterState
    pitch: FilterState
    reference: FilterState
    smoothing: FilterState
    actuator: FilterState


class Filtered(NamedTuple):
    """Measurements and last commands behind their filters."""

    speed: jax.Array
    rotor: jax.Array
    acceleration: jax.Array
    wind: jax.Array
    torque: jax.Array
    pitch: jax.Array


class FilterBank(NamedTuple):
    """ROSCO's filters with their parameters, in its modes, at an interval in s."""

    parameters: Mapping[str, jax.Array]
    modes: Modes
    interval: float

    def moved(
        self, old: RoscoFilters, x: Measured, wind: jax.Array, commands: tuple[jax.Array, jax.Array]
    ) -> tuple[RoscoFilters, Filtered]:
        """Filters moved by one step, on measurements, the last estimate and the last commands."""
        speeds, speed = _chained(self.speed_filters, old.speed, x.speed)
        rotor, rotor_speed = filtered(self.speed_filters[0], old.rotor, x.rotor)
        accelerations, acceleration = _chained(
            self.acceleration_filters, old.acceleration, x.acceleration
        )
        winds, wind = filtered(self.wind_filter, old.wind, wind)
        torques, torque = filtered(self.torque_filter, old.torque, commands[0])
        pitches, pitch = filtered(self.pitch_filter, old.pitch, commands[1])
        moved = old._replace(
            speed=speeds,
            rotor=rotor,
            acceleration=accelerations,
            wind=winds,
            torque=torques,
            pitch=pitches,
        )
        return moved, Filtered(speed, rotor_speed, acceleration, wind, torque, pitch)

    def settled(
        self,
        x: Measured,
        torque: jax.Array,
        pitch: jax.Array,
        tracked: jax.Array,
        shift: jax.Array,
    ) -> RoscoFilters:
        """Filters that have seen these values for long, the nacelle at rest."""
        p, m, dt = self.parameters, self.modes, self.interval
        zero = jnp.zeros_like(x.speed)

        def at(filter_: Coefficients, value: jax.Array) -> FilterState:
            return settled(filter_, value, value)

        smoothing = at(low_pass(p["F_SSCornerFreq"], dt), shift) if m.SS_Mode else ()
        return RoscoFilters(
            speed=tuple(at(c, x.speed) for c in self.speed_filters),
            rotor=at(self.speed_filters[0], x.rotor),
            acceleration=tuple(at(c, zero) for c in self.acceleration_filters),
            wind=at(self.wind_filter, x.wind),
            torque=at(self.torque_filter, torque),
            pitch=at(self.pitch_filter, pitch),
            reference=at(self.reference_filter, tracked) if m.VS_ControlMode > 1 else (),
            smoothing=smoothing,
            actuator=at(self.actuator, pitch) if m.PA_Mode else (),
        )

    @property
    def speed_filters(self) -> tuple[Coefficients, ...]:
        """Low-pass and notch filters of the generator's speed; the rotor's has the first."""
        p, dt = self.parameters, self.interval
        corner = p["F_LPFCornerFreq"]
        first = self.modes.F_LPFType == 1
        slow = low_pass(corner, dt) if first else low_pass_2(corner, p["F_LPFDamping"], dt)
        return (slow, *(self._notch(i) for i in self.modes.speed_notches))

    @property
    def acceleration_filters(self) -> tuple[Coefficients, ...]:
        """Low-, high-pass and notch filters of the nacelle's acceleration."""
        p, m, dt = self.parameters, self.modes, self.interval
        if not m.Fl_Mode:
            return ()
        corner, damping = p["F_FlCornerFreq"]
        slow, fast = low_pass_2(corner, damping, dt), high_pass(p["F_FlHighPassFreq"], dt)
        return (slow, fast, *(self._notch(i) for i in m.acceleration_notches))

    def _notch(self, i: int) -> Coefficients:
        p = self.parameters
        dampings = p["F_NotchBetaNum"][i], p["F_NotchBetaDen"][i]
        return notch(p["F_NotchFreqs"][i], *dampings, self.interval)

    @property
    def wind_filter(self) -> Coefficients:
        """Of the estimated wind, for tables."""
        return low_pass(self.parameters["F_WECornerFreq"], self.interval)

    @property
    def torque_filter(self) -> Coefficients:
        """Of the torque, for the wind estimator."""
        return low_pass_2(self.parameters["F_LPFCornerFreq"], jnp.asarray(_DAMPING), self.interval)

    @property
    def pitch_filter(self) -> Coefficients:
        """Of the pitch, for the gain schedule."""
        corner = self.parameters["F_LPFCornerFreq"] * 0.25
        return low_pass_2(corner, jnp.asarray(_DAMPING), self.interval)

    @property
    def reference_filter(self) -> Coefficients:
        """Of the speed that torque tracks."""
        return low_pass(self.parameters["F_VSRefSpdCornerFreq"], self.interval)

    @property
    def actuator(self) -> Coefficients:
        """Of the pitch command."""
        p = self.parameters
        if self.modes.PA_Mode == 1:
            return low_pass(p["PA_CornerFreq"], self.interval)
        return low_pass_2(p["PA_CornerFreq"], p["PA_Damping"], self.interval)


def _chained(
    filters: tuple[Coefficients, ...], states: tuple[FilterState, ...], value: jax.Array
) -> tuple[tuple[FilterState, ...], jax.Array]:
    moved = []
    for coefficients, state in zip(filters, states, strict=True):
        new, value = filtered(coefficients, state, value)
        moved.append(new)
    return tuple(moved), value
