"""ROSCO in JAX: NREL's reference controller for wind turbines, differentiable, from a DISCON.IN.

Written from ROSCO's documentation and behaviour (version 2.10.6), and checked signal by signal
against its library. What is implemented, by the keys of the DISCON.IN:

- torque: tracking of the tip speed ratio by the estimated wind (VS_ControlMode 2), by power (3) or
  by torque (4), kω² with PI in the regions 1.5 and 2.5 (1); constant torque or power
  (VS_ConstPower);
- pitch: gain-scheduled PI (PC_GS_…), minimum pitch and peak shaving (PS_Mode), floating feedback on
  the nacelle's velocity (Fl_Mode 1, 2), limits of angle and rate, actuator (PA_Mode 1, 2);
- both: setpoint smoothing (SS_Mode); wind estimators (WE_Mode 0, 1, 2); low-pass filters (F_LPFType
  1, 2), notch filters on speed and acceleration.

Source: N. J. Abbas and others, "A reference open-source controller for fixed and floating offshore
wind turbines", Wind Energ. Sci. 7, 2022.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from dfsm.controllers import rosco_wind as estimators
from dfsm.controllers.controller import INTERVAL
from dfsm.controllers.discon import Discon, read_discon
from dfsm.controllers.rosco_blocks import (
    at_least,
    at_most,
    filtered,
    lookup,
    low_pass,
    proportional_integral,
    rate_limited,
    within,
)
from dfsm.controllers.rosco_deck import Modes, Power, deck_modes, deck_parameters, deck_power
from dfsm.controllers.rosco_filters import FilterBank, Filtered, Measured, RoscoFilters
from dfsm.controllers.signals import BY_ROLE, Signals, signals
from dfsm.core.settings import require, require_kind, require_number
from dfsm.errors import DfsmError, near_matches

# Pitch in rad that shifts the setpoint by SS_VSGain; share of the rated speed from which ROSCO
# starts with rated torque.
_THIRTY_DEGREES, _RATED = 0.524, 0.98
# Margin of the region 2.5, and bounds of the nacelle's velocity in m/s or rad/s.
_REGION, _FASTEST = 1.01, 100.0


class RoscoState(NamedTuple):
    """State of ROSCO.

    Attributes
    ----------
    filters, estimator
        Of filters and the wind estimator.
    torque, torque_integral
        Command in N m, and integral of the PI that tracks a speed.
    above, below
        Integral and torque of the PI of the regions 2.5 and 1.5, for kω².
    pitch, pitch_integral, pitch_limited, pitch_sent
        Angle of the blades, integral of their PI, and the last values of both rate limits, in rad.
    pitch_least
        Minimum pitch in rad.
    velocity
        Of the nacelle, from its acceleration.
    shift
        Of the setpoints in rad/s, positive for the torque's.
    power
        As measured at the last step, in W.
    """

    filters: RoscoFilters
    estimator: estimators.Estimator
    torque: jax.Array
    torque_integral: jax.Array
    above: tuple[jax.Array, jax.Array]
    below: tuple[jax.Array, jax.Array]
    pitch: jax.Array
    pitch_integral: jax.Array
    pitch_limited: jax.Array
    pitch_sent: jax.Array
    pitch_least: jax.Array
    velocity: jax.Array
    shift: jax.Array
    power: jax.Array


class ROSCO(eqx.Module):
    """A `Controller`: ROSCO of one DISCON.IN.

    Attributes
    ----------
    parameters
        Numbers of the DISCON.IN by key, in its units.
    power
        Power coefficients of the rotor, where the wind estimator needs them.
    modes
        What is switched on.
    measurements, measurement_units, commands, command_units
        Channels read and set: speed of the generator, wind, acceleration for floating feedback
        and what else was named; torque and collective pitch.
    interval
        Time between two calls in s.
    as_library
        Whether `start` is ROSCO's own start call, with torque from kω² and PIs that jump by their
        proportional parts; otherwise it takes over the commands without a jump.
    inputs, outputs
        The same channels by role.
    """

    parameters: dict[str, jax.Array]
    power: Power | None
    modes: Modes = eqx.field(static=True)
    measurements: tuple[str, ...] = eqx.field(static=True)
    measurement_units: tuple[str, ...] = eqx.field(static=True)
    commands: tuple[str, ...] = eqx.field(static=True)
    command_units: tuple[str, ...] = eqx.field(static=True)
    interval: float = eqx.field(static=True)
    as_library: bool = eqx.field(static=True)
    inputs: Signals = eqx.field(static=True)
    outputs: Signals = eqx.field(static=True)

    def changed(self, values: Mapping[str, object]) -> ROSCO:
        """The same controller with other parameters, by key.

        Raises
        ------
        DfsmError
            There is no such parameter in the modes of this controller, or its shape differs.
        """
        parameters = dict(self.parameters)
        for key, value in values.items():
            if key not in parameters:
                raise DfsmError(f"ROSCO has no parameter {key}; {near_matches(key, parameters)}")
            new = jnp.asarray(value, dtype=parameters[key].dtype)
            require(
                new.shape == parameters[key].shape,
                f"{key}",
                value,
                f"as many values as the DISCON.IN has, shape {parameters[key].shape}",
            )
            parameters[key] = new
        return replace(self, parameters=parameters)

    @property
    def _bank(self) -> FilterBank:
        return FilterBank(self.parameters, self.modes, self.interval)

    # -- start ------------------------------------------------------------------------------------

    def start(self, measurements: jax.Array, commands: jax.Array) -> RoscoState:
        """State of a turbine that runs at these values.

        Filters and estimator have seen them for long, the nacelle is at rest. Integrals are such
        that the first step continues the commands, as far as limits allow.

        Parameters
        ----------
        measurements
            Shape ``(measurement,)``.
        commands
            Torque and pitch, shape ``(command,)``.
        """
        p, m = self.parameters, self.modes
        factors = self.outputs.factors
        torque, pitch = (commands[i] * factors[i] for i in range(2))
        speed = self._measured(measurements, torque).speed
        if self.as_library:
            optimal = at_most(p["VS_RtTq"], p["VS_Rgn2K"] * speed**2)
            torque = jnp.where(speed > _RATED * p["PC_RefSpd"], p["VS_RtTq"], optimal)
        efficient = torque * speed * p["VS_GenEff"] / 100
        x = self._measured(measurements, torque)._replace(power=efficient)
        seen = estimators.Seen(x.rotor, pitch, torque, torque, x.wind)
        estimator = estimators.started(m.WE_Mode, p, seen, self.power, self.interval)
        least = self._least_pitch(x.wind)
        # ROSCO's start call knows neither the power nor the minimum pitch yet.
        known = (0.0 * least, 0.0 * efficient) if self.as_library else (least, efficient)
        shift = self._shift(pitch, *known) if m.SS_Mode else jnp.zeros_like(speed)
        tracked = self._tracked_speed(estimator.wind, x.power, torque)
        filters = self._bank.settled(x, torque, pitch, tracked, shift)
        torque_integral, pitch_integral = torque, pitch
        gains = (p["VS_KP"], p["VS_KI"])
        above, below = p["VS_Rgn2K"] * p["VS_RefSpd"] ** 2, p["VS_Rgn2K"] * p["VS_MinOMSpd"] ** 2
        highest = self._highest_torque(speed)
        if self.as_library:
            if m.VS_ControlMode == 1:
                rated = highest if m.VS_ConstPower else p["VS_RtTq"]
                optimal = p["VS_Rgn2K"] * speed**2
                torque = jnp.where(pitch >= p["PC_Switch"], rated, optimal)
            torque = within(torque, p["VS_MinTq"], at_most(p["VS_MaxTq"], highest))
        else:
            error = self._torque_setpoint(tracked, shift) - speed
            torque_integral = within(torque - gains[0] * error, p["VS_MinTq"], highest)
            pitch_gain = lookup(p["PC_GS_angles"], p["PC_GS_KP"], pitch)
            error = p["PC_RefSpd"] + at_least(-shift, 0.0) - speed
            pitch_integral = within(pitch - pitch_gain * error, least, p["PC_MaxPit"])
        return RoscoState(
            filters=filters,
            estimator=estimator,
            torque=torque,
            torque_integral=torque_integral,
            above=(above, above),
            below=(below, below),
            pitch=pitch,
            pitch_integral=pitch_integral,
            pitch_limited=pitch,
            pitch_sent=pitch,
            pitch_least=least,
            velocity=jnp.zeros_like(speed),
            shift=shift,
            power=efficient,
        )

    # -- one step ---------------------------------------------------------------------------------

    def step(
        self,
        state: RoscoState,
        measurements: jax.Array,
        time: jax.Array,  # noqa: ARG002  ROSCO's laws do not depend on time
    ) -> tuple[RoscoState, jax.Array]:
        """Next state, and torque and pitch, shape ``(command,)``.

        Parameters
        ----------
        state
            From `start` or the step before.
        measurements
            Shape ``(measurement,)``.
        time
            In s.
        """
        p, m, dt = self.parameters, self.modes, self.interval
        x = self._measured(measurements, state.torque)
        filters, f = self._bank.moved(
            state.filters, x, state.estimator.wind, (state.torque, state.pitch)
        )
        seen = estimators.Seen(f.rotor, state.pitch, state.torque, f.torque, x.wind)
        estimator = estimators.estimated(m.WE_Mode, p, state.estimator, seen, self.power, dt)
        tracked = self._tracked_speed(estimator.wind, x.power, state.torque)
        if m.VS_ControlMode > 1:
            reference, tracked = filtered(self._bank.reference_filter, filters.reference, tracked)
            filters = filters._replace(reference=reference)
        pitch_error = p["PC_RefSpd"] + at_least(-state.shift, 0.0) - f.speed
        torque_error = self._torque_setpoint(tracked, state.shift) - f.speed
        shift = state.shift
        if m.SS_Mode:
            value = self._shift(state.pitch, state.pitch_least, state.power)
            smoothing, shift = filtered(low_pass(p["F_SSCornerFreq"], dt), filters.smoothing, value)
            filters = filters._replace(smoothing=smoothing)
        state = state._replace(filters=filters, estimator=estimator, shift=shift, power=x.power)
        state = self._with_torque(state, torque_error, f)
        state = self._with_pitch(state, pitch_error, f)
        command = jnp.stack([at_least(state.torque, 0.0), state.pitch])
        return state, command / jnp.asarray(self.outputs.factors)

    def _with_torque(self, state: RoscoState, error: jax.Array, f: Filtered) -> RoscoState:
        p, m, dt = self.parameters, self.modes, self.interval
        gains = (p["VS_KP"], p["VS_KI"])
        highest = self._highest_torque(f.speed)
        if m.VS_ControlMode > 1:
            integral, torque = proportional_integral(
                error, state.torque_integral, gains, (p["VS_MinTq"], highest), dt
            )
            state = state._replace(torque_integral=integral)
        else:
            state, torque = self._region_torque(state, error, f)
        torque = within(torque, p["VS_MinTq"], at_most(p["VS_MaxTq"], highest))
        rates = (-p["VS_MaxRat"], p["VS_MaxRat"])
        return state._replace(torque=rate_limited(torque, state.torque, rates, dt))

    def _region_torque(
        self, state: RoscoState, error: jax.Array, f: Filtered
    ) -> tuple[RoscoState, jax.Array]:
        """kω² in region 2, PI below and above it; the region follows from the last step."""
        p, m, dt = self.parameters, self.modes, self.interval
        gains = (p["VS_KP"], p["VS_KI"])
        least, most = (p["VS_Rgn2K"] * p[key] ** 2 for key in ("VS_MinOMSpd", "VS_RefSpd"))
        region_3 = state.pitch >= state.pitch_least + p["PC_Switch"]
        region_25 = state.above[1] >= _REGION * most
        region_15 = state.below[1] < least
        region_2 = (f.speed < p["VS_RefSpd"]) & ~region_15
        above = proportional_integral(error, state.above[0], gains, (most, p["VS_ArSatTq"]), dt)
        slow = p["VS_MinOMSpd"] - f.speed
        below = proportional_integral(slow, state.below[0], gains, (p["VS_MinTq"], least), dt)
        rated = self._constant_power(f.speed) if m.VS_ConstPower else p["VS_RtTq"]
        # Between the regions ROSCO keeps its torque.
        torque = jnp.where(region_15, below[1], state.torque)
        torque = jnp.where(region_2, p["VS_Rgn2K"] * f.speed**2, torque)
        torque = jnp.where(region_25, above[1], torque)
        torque = jnp.where(region_3, rated, torque)
        return state._replace(above=above, below=below), torque

    def _with_pitch(self, state: RoscoState, error: jax.Array, f: Filtered) -> RoscoState:
        p, m, dt = self.parameters, self.modes, self.interval
        angles = p["PC_GS_angles"]
        gains = (lookup(angles, p["PC_GS_KP"], f.pitch), lookup(angles, p["PC_GS_KI"], f.pitch))
        limits = (state.pitch_least, p["PC_MaxPit"])
        integral, pitch = proportional_integral(error, state.pitch_integral, gains, limits, dt)
        least = self._least_pitch(f.wind)
        velocity = state.velocity
        if m.Fl_Mode:
            velocity = within(velocity + dt * f.acceleration, -_FASTEST, _FASTEST)
            pitch = pitch - velocity * lookup(p["Fl_U"], p["Fl_Kp"], f.wind)
        rates = (p["PC_MinRat"], p["PC_MaxRat"])
        pitch = within(pitch, least, p["PC_MaxPit"])
        limited = rate_limited(pitch, state.pitch_limited, rates, dt)
        # The minimum may have risen faster than the rate allows: a second limit, per blade.
        pitch = within(limited, least, p["PC_MaxPit"])
        sent = rate_limited(pitch, state.pitch_sent, rates, dt)
        actuator, pitch = state.filters.actuator, sent
        if m.PA_Mode:
            actuator, pitch = filtered(self._bank.actuator, actuator, sent)
        pitch = within(pitch, p["PC_MinPit"], p["PC_MaxPit"])
        return state._replace(
            filters=state.filters._replace(actuator=actuator),
            pitch=rate_limited(pitch, state.pitch, rates, dt),
            pitch_integral=integral,
            pitch_limited=limited,
            pitch_sent=sent,
            pitch_least=least,
            velocity=velocity,
        )

    # -- setpoints and limits ---------------------------------------------------------------------

    def _tracked_speed(self, wind: jax.Array, power: jax.Array, torque: jax.Array) -> jax.Array:
        """Speed of the generator that tracks the best tip speed ratio."""
        p, mode = self.parameters, self.modes.VS_ControlMode
        if mode == 2:
            return p["VS_TSRopt"] * wind / p["WE_BladeRadius"] * p["WE_GearboxRatio"]
        if mode == 3:
            shaft = power / (p["VS_GenEff"] / 100) / p["VS_Rgn2K"]
            return _root(jnp.cbrt, shaft)
        if mode == 4:
            return _root(jnp.sqrt, torque / p["VS_Rgn2K"])
        return p["VS_RefSpd"] + 0.0 * wind

    def _torque_setpoint(self, tracked: jax.Array, shift: jax.Array) -> jax.Array:
        p = self.parameters
        speed = within(tracked, p["VS_MinOMSpd"], p["VS_RefSpd"])
        return at_least(speed - at_least(shift, 0.0), p["VS_MinOMSpd"])

    def _shift(self, pitch: jax.Array, least: jax.Array, power: jax.Array) -> jax.Array:
        """Setpoint smoothing: less torque above the minimum pitch, less pitch below rated power."""
        p = self.parameters
        above = (pitch - least) / _THIRTY_DEGREES * p["SS_VSGain"]
        lacking = (p["VS_RtPwr"] - power) / p["VS_RtPwr"] * p["SS_PCGain"]
        return (above - lacking) * p["PC_RefSpd"]

    def _constant_power(self, speed: jax.Array) -> jax.Array:
        p = self.parameters
        return p["VS_RtPwr"] / (p["VS_GenEff"] / 100) / speed

    def _highest_torque(self, speed: jax.Array) -> jax.Array:
        p = self.parameters
        if self.modes.VS_ConstPower:
            return at_most(self._constant_power(speed), p["VS_MaxTq"])
        return p["VS_RtTq"]

    def _least_pitch(self, wind: jax.Array) -> jax.Array:
        p = self.parameters
        if not self.modes.PS_Mode:
            return p["PC_FinePit"] + 0.0 * wind
        return at_least(lookup(p["PS_WindSpeeds"], p["PS_BldPitchMin"], wind), p["PC_FinePit"])

    # -- measurements -----------------------------------------------------------------

    def _measured(self, measurements: jax.Array, torque: jax.Array) -> Measured:
        p, known = self.parameters, self.inputs
        found = {r: measurements[i] * known.factors[i] for i, r in enumerate(known.roles)}
        speed = found["generator_speed"]
        feedback = _FEEDBACK.get(self.modes.Fl_Mode, "")
        return Measured(
            speed,
            found.get("rotor_speed", speed / p["WE_GearboxRatio"]),
            found["wind"],
            found.get("power", torque * speed * p["VS_GenEff"] / 100),
            found.get(feedback, jnp.zeros_like(speed)),
        )


_FEEDBACK = {1: "nacelle_acceleration", 2: "nacelle_pitch_acceleration"}


def _root(root: Callable[[jax.Array], jax.Array], value: jax.Array) -> jax.Array:
    """Root of what is positive, else 0; there its slope is 0, not infinite."""
    positive = value > 0
    return jnp.where(positive, root(jnp.where(positive, value, 1.0)), 0.0)


def read_rosco(
    discon: Discon | str | Path,
    *,
    interval: float,
    channels: Mapping[str, str | tuple[str, str]] | None = None,
    as_library: bool = False,
) -> ROSCO:
    """ROSCO as a DISCON.IN tunes it.

    Parameters
    ----------
    discon
        A `Discon` or the path of a file.
    interval
        Time between two calls in s: the DT of ServoDyn's DLL.
    channels
        Channel, or channel and unit, by role, as in `BladedLibrary`.
    as_library
        Whether `start` is ROSCO's own start call; otherwise it continues the commands.

    Raises
    ------
    DfsmError
        What `check_discon` refuses, a mode that is not implemented (by its key), a table that does
        not rise, or a channel that is none.
    """
    deck = discon if isinstance(discon, Discon) else read_discon(discon)
    require_number("interval", interval, INTERVAL, above=0)
    require_kind("channels", channels, Mapping | None, BY_ROLE)
    modes, channels = deck_modes(deck), dict(channels or {})
    roles = ["generator_speed", "wind"]
    if modes.Fl_Mode:
        roles.append(_FEEDBACK[modes.Fl_Mode])
    more = (r for r in channels if r not in (*roles, "torque", "pitch"))
    inputs = signals([*roles, *more], channels)
    outputs = signals(("torque", "pitch"), channels)
    return ROSCO(
        parameters=deck_parameters(deck),
        power=deck_power(deck),
        modes=modes,
        measurements=inputs.names,
        measurement_units=inputs.units,
        commands=outputs.names,
        command_units=outputs.units,
        interval=float(interval),
        as_library=as_library,
        inputs=inputs,
        outputs=outputs,
    )
