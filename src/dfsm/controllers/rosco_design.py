"""ROSCO's tuning parameters instead of its gains: ω and ζ of its loops, and peak shaving.

As ROSCO's toolbox, the rotor's speed is linearized at the operating points of the gain schedule,
with its table of coefficients, Δω̇ = A Δω + B Δu. PI gains that give a second-order loop
s² + 2ζω s + ω² are KI = ω² / B and KP = (2ζω + A) / B. Read backwards they tell ω and ζ of a
DISCON.IN. These are changed by the same factor at all points, so that a schedule that varies with
the wind keeps its shape, and the values at which a deck stands give that deck to the last digit.

Source: N. J. Abbas and others, "A reference open-source controller for fixed and floating offshore
wind turbines", Wind Energ. Sci. 7, 2022, equations 7 to 12 and 26 to 32.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import brentq

from dfsm.controllers.discon import Discon
from dfsm.controllers.rosco import ROSCO
from dfsm.core.types import Array
from dfsm.data.readers.rotor_table import RotorTable, read_rotor_table
from dfsm.errors import DfsmError, printable

# What can be tuned beside the keys themselves, in the toolbox's words, and the keys behind it.
DESIGN_KEYS: dict[str, tuple[str, ...]] = {
    "omega_pc": ("PC_GS_KP", "PC_GS_KI"),
    "zeta_pc": ("PC_GS_KP",),
    "omega_vs": ("VS_KP", "VS_KI"),
    "zeta_vs": ("VS_KP",),
    "ps_percent": ("PS_BldPitchMin",),
    "Kp_float": ("Fl_Kp",),
}
# Winds of a schedule are those of a table of the deck if power differs by no more along it.
_CONSTANT = 0.05
_POINTS = 400


@dataclass(frozen=True)
class Loop:
    """A PI loop of the speed.

    Attributes
    ----------
    kp, ki
        Gains of the deck, shape ``(point,)``.
    slope
        B, shape ``(point,)``.
    omega, zeta
        Of the deck: the medians over the points.
    damping
        2ζω at every point.
    """

    kp: Array
    ki: Array
    slope: Array
    omega: float
    zeta: float
    damping: Array

    def gains(self, omega: Any, zeta: Any) -> tuple[Any, Any]:
        """KP and KI for other values, which may be traced."""
        ratio = omega / self.omega
        more = self.damping * (ratio * zeta / self.zeta - 1)
        return self.kp + more / self.slope, self.ki * ratio**2


@dataclass(frozen=True)
class Shaving:
    """Minimum pitch that keeps the thrust below a share of its largest value.

    Attributes
    ----------
    limits
        Thrust coefficient by wind at a share of 1, shape ``(wind,)``.
    coefficient, pitch
        Falling branches of Ct over the blade pitch in rad, from the smallest coefficient up,
        shape ``(wind, point)``.
    least
        Pitch in rad below which no value falls, shape ``(wind,)``.
    percent
        Share at which the deck stands.
    deck
        Its table in rad.
    """

    limits: Array
    coefficient: Array
    pitch: Array
    least: Array
    percent: float
    deck: Array

    def table(self, percent: Any) -> Any:
        """PS_BldPitchMin for another share, which may be traced."""
        change = self._formula(percent) - self._formula(self.percent)
        table = jnp.asarray(self.deck) + change
        return jnp.where(table < self.least, self.least, table)

    def _formula(self, percent: Any) -> Any:
        found = jax.vmap(jnp.interp)(percent * self.limits, self.coefficient, self.pitch)
        return jnp.where(found < self.least, self.least, found)


@dataclass(frozen=True)
class RoscoDesign:
    """What the tuning parameters of a DISCON.IN are, and the keys that others give.

    Attributes
    ----------
    discon
        The deck.
    controller
        ROSCO in JAX of this deck.
    """

    discon: Discon
    controller: ROSCO

    def start(self, name: str) -> float:
        """Value of a tuning parameter at which the deck stands.

        Raises
        ------
        DfsmError
            The deck does not use it, or its gains do not belong to the rotor's table.
        """
        keys = DESIGN_KEYS[name]
        if lost := [key for key in keys if key not in self.controller.parameters]:
            raise DfsmError(
                f"{name}: {printable(str(self.discon.path))} does not use {', '.join(lost)}: "
                "switch its mode on, or tune something else"
            )
        if name == "Kp_float":
            values = np.atleast_1d(self.controller.parameters["Fl_Kp"])
            if len(values) > 1:
                raise DfsmError(f"Fl_Kp has {len(values)} values: tune Fl_Kp.factor or Fl_Kp[0]")
            return float(values[0])
        if name == "ps_percent":
            return self.shaving.percent
        loop = self.pitch if name.endswith("_pc") else self.torque
        return loop.omega if name.startswith("omega") else loop.zeta

    def keys(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values by key of the DISCON.IN for some tuning parameters, which may be traced."""
        found: dict[str, Any] = {}
        if {"omega_pc", "zeta_pc"} & set(values):
            loop = self.pitch
            found["PC_GS_KP"], found["PC_GS_KI"] = loop.gains(
                values.get("omega_pc", loop.omega), values.get("zeta_pc", loop.zeta)
            )
        if {"omega_vs", "zeta_vs"} & set(values):
            loop = self.torque
            kp, ki = loop.gains(
                values.get("omega_vs", loop.omega), values.get("zeta_vs", loop.zeta)
            )
            found["VS_KP"], found["VS_KI"] = kp[0], ki[0]
        if "ps_percent" in values:
            found["PS_BldPitchMin"] = self.shaving.table(values["ps_percent"])
        if "Kp_float" in values:
            found["Fl_Kp"] = jnp.asarray([values["Kp_float"]])
        return found

    # -- the rotor --------------------------------------------------------------------------------

    @cached_property
    def _table(self) -> RotorTable:
        return read_rotor_table(self.discon.file("PerfFileName"))

    @cached_property
    def _surfaces(self) -> dict[str, RectBivariateSpline]:
        """Cp, Ct and both slopes of Cp over blade pitch in rad and tip speed ratio."""
        pitch, ratio = np.deg2rad(self._table.pitch), self._table.tip_speed_ratio
        by_ratio, by_pitch = np.gradient(self._table.cp, ratio, pitch)
        tables = {"cp": self._table.cp, "ct": self._table.ct}
        tables |= {"cp_pitch": by_pitch, "cp_ratio": by_ratio}
        return {
            name: RectBivariateSpline(pitch, ratio, values.T) for name, values in tables.items()
        }

    def _at(self, surface: str, pitch: Any, ratio: Any) -> Array:
        return np.asarray(self._surfaces[surface](pitch, ratio, grid=False))

    def _key(self, key: str) -> float:
        return float(np.atleast_1d(self.controller.parameters[key])[0])

    @cached_property
    def _rotor(self) -> tuple[float, float, float, float, float]:
        """½ρπR², radius, inertia, gearbox ratio, rated speed of the rotor in rad/s."""
        radius, gear = self._key("WE_BladeRadius"), self._key("WE_GearboxRatio")
        density, inertia = self.discon.number("WE_RhoAir"), self.discon.number("WE_Jtot")
        return (
            0.5 * density * np.pi * radius**2,
            radius,
            inertia,
            gear,
            self._key("PC_RefSpd") / gear,
        )

    # -- loops ------------------------------------------------------------------------------------

    @cached_property
    def _angles(self) -> Array:
        return np.atleast_1d(np.asarray(self.controller.parameters["PC_GS_angles"]))

    @cached_property
    def _toolbox_winds(self) -> Array | None:
        """Winds of the deck's schedules, if these are those of the gain schedule, too."""
        n = len(self._angles)
        area, radius, _, _, speed = self._rotor
        for key in ("PS_WindSpeeds", "WE_FOPoles_v"):
            winds = self.discon.array(key) if key in self.discon else np.zeros(0)
            if len(winds) < n + 2 or winds[-n] <= 0:
                continue
            v = winds[-n:]
            power = area * v**3 * self._at("cp", self._angles, speed * radius / v)
            if np.ptp(power) < _CONSTANT * np.abs(power).mean():
                return winds
        return None

    @cached_property
    def _schedule(self) -> Array:
        """Wind at every angle of the gain schedule, where the rotor takes rated power."""
        n = len(self._angles)
        if self._toolbox_winds is not None:
            return self._toolbox_winds[-n:]
        area, radius, _, _, speed = self._rotor
        rated = self._key("VS_RtPwr") / (self._key("VS_GenEff") / 100)
        ratio = self._table.tip_speed_ratio
        low, high = speed * radius / ratio[-1], speed * radius / max(ratio[0], 1e-3)
        found = []
        for angle in self._angles:

            def lacking(v: Any, angle: float = angle) -> Any:
                return area * v**3 * self._at("cp", angle, speed * radius / v) - rated

            tried = np.linspace(low, high, _POINTS)
            gaps = lacking(tried)
            crossed = np.flatnonzero((gaps[:-1] < 0) & (gaps[1:] >= 0))
            if not len(crossed):
                raise DfsmError(
                    f"{printable(str(self.discon.path))}: at PC_GS_angles of {angle:g} rad the "
                    "rotor's table gives rated power in no wind, so omega_pc and zeta_pc have no "
                    "meaning: check PerfFileName, or tune PC_GS_KP.factor and PC_GS_KI.factor"
                )
            k = int(crossed[0])
            found.append(float(brentq(lacking, tried[k], tried[k + 1])))  # pyright: ignore[reportArgumentType]
        return np.array(found)

    def _pole(self, wind: Array, pitch: Array, ratio: Array) -> Array:
        """A in 1/s: ∂ω̇/∂ω at constant generator torque."""
        area, radius, inertia, _, _ = self._rotor
        cp, by_ratio = self._at("cp", pitch, ratio), self._at("cp_ratio", pitch, ratio)
        return area * radius**2 * wind / ratio**2 * (by_ratio * ratio - cp) / inertia

    @cached_property
    def pitch(self) -> Loop:
        """The loop of pitch and speed."""
        area, radius, inertia, gear, speed = self._rotor
        winds = self._schedule
        ratio = speed * radius / winds
        pole = self._pole(winds, self._angles, ratio)
        if self.controller.modes.VS_ConstPower:
            pole = pole + self._key("VS_RtPwr") / (inertia * speed**2)
        slope = self._at("cp_pitch", self._angles, ratio)
        slope = gear * area * radius * winds**2 / ratio * slope / inertia
        if len(winds) > 1:
            # Straight lines over the wind, as in the toolbox.
            pole, slope = (np.polyval(np.polyfit(winds, y, 1), winds) for y in (pole, slope))
        kp, ki = (
            np.atleast_1d(np.asarray(self.controller.parameters[k]))
            for k in ("PC_GS_KP", "PC_GS_KI")
        )
        return self._loop(kp, ki, pole, slope, "PC_GS")

    @cached_property
    def torque(self) -> Loop:
        """The loop of torque and speed, linearized right below rated wind."""
        _, radius, inertia, gear, speed = self._rotor
        best = self._key("VS_TSRopt") if "VS_TSRopt" in self.controller.parameters else 0.0
        best = best or self._table.optimum[0]
        winds, n = self._toolbox_winds, len(self._angles)
        wind = winds[-n - 2] if winds is not None else speed * radius / best
        ratio = min(best, speed * radius / wind)
        point = (np.array([v]) for v in (wind, self._key("PC_FinePit"), ratio))
        kp, ki = (
            np.atleast_1d(np.asarray(self.controller.parameters[k])) for k in ("VS_KP", "VS_KI")
        )
        return self._loop(kp, ki, self._pole(*point), np.array([-(gear**2) / inertia]), "VS")

    def _loop(self, kp: Array, ki: Array, pole: Array, slope: Array, stem: str) -> Loop:
        square = ki * slope
        if (square <= 0).any():
            raise DfsmError(
                f"{printable(str(self.discon.path))}: {stem}_KI has the sign of a loop that "
                "cannot be stable on the rotor of PerfFileName, so it has no ω and ζ: check both"
            )
        omegas, damping = np.sqrt(square), kp * slope - pole
        omega, zeta = float(np.median(omegas)), float(np.median(damping / (2 * omegas)))
        if zeta <= 0:
            raise DfsmError(
                f"{printable(str(self.discon.path))}: {stem}_KP gives a damping ζ of {zeta:.3g}, "
                f"expected one above 0: check it, or tune {stem}_KP itself"
            )
        return Loop(kp, ki, slope, omega, zeta, damping)

    # -- peak shaving -----------------------------------------------------------------------------

    @cached_property
    def shaving(self) -> Shaving:
        """Minimum pitch by wind for a share of the largest thrust."""
        winds = self.discon.array("PS_WindSpeeds")
        deck = np.asarray(self.controller.parameters["PS_BldPitchMin"])
        area, radius, _, _, speed = self._rotor
        fine, table = self._key("PC_FinePit"), self._table
        best = self._key("VS_TSRopt") if "VS_TSRopt" in self.controller.parameters else 0.0
        ratio = np.minimum(best or table.optimum[0], speed * radius / winds)
        operating = np.interp(winds, self._schedule, self._angles, left=fine)
        operating = np.where(winds < self._schedule[0], fine, operating)
        thrust = area * winds**2 * self._at("ct", operating, ratio)
        shaved = area * winds**2 * self._at("ct", np.maximum(operating, deck), ratio)
        percent = float(min(shaved.max() / thrust.max(), 1.0))
        grid = np.deg2rad(table.pitch)
        curves = np.stack([self._surfaces["ct"](grid, r)[:, 0] for r in ratio])
        branches = [_falling(curve, grid) for curve in curves]
        # What the deck holds back in light winds is there for power, not for thrust.
        calm = (winds < winds[int(np.argmax(thrust))]) & (thrust <= percent * thrust.max())
        least = np.where(calm, np.maximum(deck, fine), fine)
        return Shaving(
            limits=thrust.max() / (area * winds**2),
            coefficient=np.stack([c for c, _ in branches]),
            pitch=np.stack([p for _, p in branches]),
            least=least,
            percent=percent,
            deck=deck,
        )


def _falling(curve: Array, pitch: Array) -> tuple[Array, Array]:
    """Branch on which the thrust falls with the pitch, from its smallest value up, both rising."""
    first = int(np.argmax(curve))
    held = np.concatenate([np.full(first, curve[first]), curve[first:]])
    fallen = np.minimum.accumulate(held)
    # Strictly, for the interpolation: by less than it matters.
    fallen = fallen - 1e-9 * np.arange(len(fallen))
    return fallen[::-1], np.concatenate([np.full(first, pitch[first]), pitch[first:]])[::-1]
