"""A controller with some of its numbers free: from a vector of parameters to its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.discon import Discon, Value
from dfsm.controllers.gains import Gain, find_gain, numbers_of, with_numbers
from dfsm.controllers.rosco import ROSCO
from dfsm.controllers.rosco_design import DESIGN_KEYS, RoscoDesign
from dfsm.core.types import Array
from dfsm.errors import DfsmError, near_matches


@dataclass(frozen=True)
class Tunable:
    """A controller as a function of named parameters.

    Attributes
    ----------
    controller
        What is tuned.
    names
        Of the parameters.
    gains
        Those that are numbers of the controller.
    design
        What the others mean, for ROSCO.
    start
        Values of the parameters in the controller, shape ``(parameter,)``.
    """

    controller: Any
    names: tuple[str, ...]
    gains: tuple[Gain, ...]
    design: RoscoDesign | None
    start: Array

    def numbers(self, theta: Any) -> dict[str, jax.Array]:
        """Numbers of the controller that the parameters change, by name; JAX can follow it."""
        values = dict(zip(self.names, theta, strict=True))
        told = {n: v for n, v in values.items() if n in DESIGN_KEYS and self.design is not None}
        own = numbers_of(self.controller)
        changed: dict[str, Any] = {}
        if self.design is not None and told:
            changed |= self.design.keys(told)
        for gain in self.gains:
            before = changed.get(gain.leaf, own[gain.leaf])
            changed[gain.leaf] = gain.replaced(before, values[gain.name])
        return {
            n: jnp.asarray(v, dtype=float).reshape(np.shape(own[n])) for n, v in changed.items()
        }

    def directions(self, theta: Array) -> list[dict[str, jax.Array]]:
        """Slopes of `numbers` with each parameter."""
        slopes = jax.jacfwd(lambda t: self.numbers(list(t)))(jnp.asarray(theta))
        return [{n: s[..., i] for n, s in slopes.items()} for i in range(len(self.names))]

    def at(self, theta: Array) -> Any:
        """The controller at some values."""
        return with_numbers(self.controller, self.numbers(list(jnp.asarray(theta))))

    def changes(self, theta: Array) -> dict[str, Value]:
        """Values by key of the DISCON.IN, of those that differ from the deck's."""
        own, found = numbers_of(self.controller), dict[str, Value]()
        for name, new in self.numbers(list(jnp.asarray(theta))).items():
            values, before = np.atleast_1d(np.asarray(new)), np.atleast_1d(np.asarray(own[name]))
            if (values != before).any():
                found[name] = values.ravel()
        return found


def tunable(
    controller: Any, names: Sequence[str] | Mapping[str, Any], discon: Discon | None = None
) -> Tunable:
    """Free some numbers of a controller.

    Parameters
    ----------
    controller
        ROSCO in JAX, or an equinox module.
    names
        Numbers of the controller, see `find_gain`; for ROSCO also omega_pc, zeta_pc, omega_vs,
        zeta_vs, Kp_float and ps_percent.
    discon
        The DISCON.IN of ROSCO, for these.

    Raises
    ------
    DfsmError
        There is no such parameter, two change the same number, or a tuning parameter without the
        deck behind it.
    """
    rosco = isinstance(controller, ROSCO)
    design = RoscoDesign(discon, controller) if rosco and discon is not None else None
    gains, start = [], []
    for name in names:
        if rosco and name in DESIGN_KEYS:
            if design is None:
                raise DfsmError(
                    f"{name} follows from the DISCON.IN and the rotor's table: give discon=, "
                    "the deck that ROSCO was read from"
                )
            start.append(design.start(name))
            continue
        try:
            gains.append(find_gain(controller, name))
        except DfsmError as error:
            known = [*(DESIGN_KEYS if rosco else ()), *numbers_of(controller)]
            if "no gain" in str(error):
                raise DfsmError(
                    f"the controller has no gain '{name}'; {near_matches(name, known)}"
                ) from None
            raise
        start.append(gains[-1].start)
    _require_apart(list(names), gains)
    return Tunable(controller, tuple(names), tuple(gains), design, np.array(start))


def _require_apart(names: list[str], gains: list[Gain]) -> None:
    """Refuse two parameters of which one would overwrite the other."""
    taken: dict[tuple[str, Any], str] = {}
    for gain in gains:
        key = (gain.leaf, gain.index)
        behind = [n for n, keys in DESIGN_KEYS.items() if n in names and gain.leaf in keys]
        # A factor goes on top of what the tuning parameters give; a value would replace it.
        clash = taken.get(key) or (behind[0] if behind and not gain.factor else None)
        if clash:
            raise DfsmError(f"{clash} and {gain.name} both set {gain.leaf}: tune one of them")
        taken[key] = gain.name
