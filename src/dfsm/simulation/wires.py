"""Which signals of a model a controller reads and sets, and in which units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.controller import Controller
from dfsm.core.types import Array
from dfsm.core.units import agree, conversion
from dfsm.data.derivatives import per_second
from dfsm.errors import DfsmError, near_matches
from dfsm.models.dfsm import DFSM
from dfsm.simulation.integrate import Stages, stages

_RATE = "_dot"


@dataclass(frozen=True)
class Wires:
    """How a controller is connected to a model.

    Attributes
    ----------
    sources
        Group and column of every measurement; group ``"rates"`` are derivatives of states.
    readings
        Factor and summand from the model's unit to the controller's, per measurement.
    commanded
        Column of the control that each command sets.
    settings
        The same per command.
    held
        Which exogenous inputs keep the value of a sample until the next.
    """

    sources: tuple[tuple[str, int], ...]
    readings: tuple[tuple[float, float], ...]
    commanded: tuple[int, ...]
    settings: tuple[tuple[float, float], ...]
    held: tuple[bool, ...]

    @property
    def reads_outputs(self) -> bool:
        """Whether a measurement is an output of the model."""
        return any(group == "outputs" for group, _ in self.sources)

    def measured(
        self,
        model: DFSM,
        states: jax.Array,
        exogenous: jax.Array,
        blades: tuple[jax.Array, jax.Array],
    ) -> jax.Array:
        """Measurements in the controller's units, ``(measurement,)``.

        Parameters
        ----------
        model
            The surrogate.
        states, exogenous
            At this time, the controls as they were until now, ``(state,)`` and ``(exogenous,)``.
        blades
            Azimuth in rad, and harmonics of the wind field, ``(channel,)``.
        """
        u, w, p = model.signals.order.split_exogenous(exogenous)
        groups = {"states": states, "controls": u, "disturbances": w, "parameters": p}
        if any(group == "rates" for group, _ in self.sources):
            groups["rates"] = model.derivative(states, u, w, p)
        if self.reads_outputs:
            psi = None if model.signals.azimuth is None else blades[0]
            groups["outputs"] = model.output(states, u, w, p, psi, blades[1])
        seen = jnp.stack([groups[group][column] for group, column in self.sources])
        scale, zero = _columns(self.readings)
        return seen * scale + zero

    def commands_of(self, exogenous: jax.Array) -> jax.Array:
        """What the controller would have set, in its units, ``(command,)``."""
        scale, zero = _columns(self.settings)
        return exogenous[np.array(self.commanded, dtype=int)] * scale + zero

    def with_commands(self, exogenous: jax.Array, commands: jax.Array) -> jax.Array:
        """Exogenous inputs ``(..., exogenous)`` with the controls set, in the model's units.

        Controls stand first among them. Put together instead of written over: XLA compiles no loop
        in one piece that holds a scatter.
        """
        commands = jnp.broadcast_to(commands, (*exogenous.shape[:-1], len(self.commanded)))
        last = max(self.commanded, default=-1) + 1
        columns = [
            commands[..., self.commanded.index(i)] if i in self.commanded else exogenous[..., i]
            for i in range(last)
        ]
        return jnp.concatenate([jnp.stack(columns, axis=-1), exogenous[..., last:]], axis=-1)

    def along(self, inputs: jax.Array) -> Stages:
        """Inputs at start, middle and end of every step, see `stages`."""
        return stages(inputs, np.array(self.held) if any(self.held) else None)

    def in_model_units(self, commands: jax.Array) -> jax.Array:
        """Commands ``(..., command)`` of the controller in the model's units."""
        scale, zero = _columns(self.settings)
        return (commands - zero) / scale


def connect(
    model: DFSM, controller: Controller, measurements: Mapping[str, str] | None = None
) -> Wires:
    """Connect a controller to a model by names of channels.

    Parameters
    ----------
    model
        The surrogate.
    controller
        Reads states, their derivatives (``<state>_dot``), controls, disturbances, parameters or
        outputs of the model, and sets controls.
    measurements
        Which signal of the model stands for a measurement that has another name.

    Raises
    ------
    DfsmError
        The model lacks a measurement or command, or its unit is not one that converts.
    """
    measurements = dict(measurements or {})
    for name in measurements:
        if name not in controller.measurements:
            raise DfsmError(
                f"measurements: the controller does not read '{name}'; "
                + near_matches(name, controller.measurements)
            )
    known = _signals(model)
    sources, readings = [], []
    for name, unit in zip(controller.measurements, controller.measurement_units, strict=True):
        signal = measurements.get(name, name)
        if signal not in known:
            raise _not_measured(name, signal, model)
        source, its = known[signal]
        sources.append(source)
        readings.append(_conversion(signal, its, unit))
    controls = model.signals.controls
    names, commanded, settings = model.signals.names("controls"), [], []
    for name, unit in zip(controller.commands, controller.command_units, strict=True):
        if name not in names:
            raise DfsmError(
                f"the controller sets '{name}', which is no control of the model; "
                + near_matches(name, names)
            )
        commanded.append(names.index(name))
        settings.append(_conversion(name, controls[commanded[-1]].unit, unit))
    held = tuple(kind == "hold" for kind in model.signals.between_samples())
    return Wires(tuple(sources), tuple(readings), tuple(commanded), tuple(settings), held)


def not_commanded(model: DFSM, controller: Controller) -> list[str]:
    """Controls that a controller does not set."""
    return [n for n in model.signals.names("controls") if n not in controller.commands]


def _signals(model: DFSM) -> dict[str, tuple[tuple[str, int], str]]:
    """Where every signal stands, and its unit."""
    s = model.signals
    found: dict[str, tuple[tuple[str, int], str]] = {}
    for i, state in enumerate(s.observed):
        found[f"{state.name}{_RATE}"] = (("rates", i), per_second(state.unit))
    for group in ("outputs", "parameters", "disturbances", "controls", "states"):
        channels = s.observed if group == "states" else getattr(s, group)
        found |= {c.name: ((group, i), c.unit) for i, c in enumerate(channels)}
    return found


def _not_measured(name: str, signal: str, model: DFSM) -> DfsmError:
    if signal != name:
        return DfsmError(
            f"measurements: the model has no '{signal}' to stand for '{name}'; "
            + near_matches(signal, _signals(model))
        )
    states = model.signals.names("states")
    second = [s.name for s in model.signals.specs if s.order == 2]
    stand_in = f"{second[0]}{_RATE}{_RATE}" if second else f"{states[0]}{_RATE}"
    close = near_matches(name, _signals(model))
    meant = f"; {close}" if close.startswith("did you mean") else ""
    return DfsmError(
        f"the controller measures '{name}', which the model does not have{meant}: fit it with "
        f"'{name}' among its outputs, or name a signal of the model that stands for it, as in "
        f"measurements={{'{name}': '{stand_in}'}} ({stand_in} is the derivative of the state "
        f"{stand_in.removesuffix(_RATE)})"
    )


def _conversion(name: str, source: str, target: str) -> tuple[float, float]:
    """Factor and summand that take values in `source`, the model's unit, to `target`."""
    if agree(source, target):
        return 1.0, 0.0
    found = conversion(source, target)
    if found is None:
        raise DfsmError(
            f"'{name}' is in '{source}' in the model and in '{target}' in the controller, which do "
            "not convert into each other: change one of them"
        )
    return found


def _columns(pairs: tuple[tuple[float, float], ...]) -> tuple[Array, Array]:
    """Factors and summands of several conversions."""
    scale, zero = np.array(pairs, dtype=float).reshape(-1, 2).T
    return scale, zero
