"""The closed loop as a pure function: a controller steps, the plant marches until it steps again.

A controller that is an equinox module is compiled with the plant into one loop, which JAX can
follow: gradients with respect to its gains, many controllers at once. Any other runs on the host,
call by call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.controller import Controller
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.errors import DfsmError, printable
from dfsm.models.dfsm import DFSM
from dfsm.simulation.integrate import observe, stepped
from dfsm.simulation.wires import Wires


class Drive(NamedTuple):
    """Where a closed loop starts and what drives it.

    Attributes
    ----------
    x0, psi0
        Initial states ``(state,)`` and azimuth in rad.
    time
        When the controller steps, in s, ``(call,)``.
    h
        Length of the plant's steps until the next call, in s, ``(call,)``; zero changes nothing.
    inputs
        Recorded controls, disturbances and parameters at ends and middles of all plant steps,
        ``(2 step + 1, exogenous)``.
    field
        Harmonics of the wind field at the ends of all plant steps, ``(step + 1, channel)``.
    """

    x0: jax.Array
    psi0: jax.Array
    time: jax.Array
    h: jax.Array
    inputs: jax.Array
    field: jax.Array


class Path(NamedTuple):
    """What a closed loop gives at the ends of all plant steps.

    Attributes
    ----------
    states, controls, outputs
        Shapes ``(step + 1, n)``, in the model's units; controls as they are from then on.
    outside
        Whether any input of the model is outside its training range, ``(step + 1,)``; None where
        it was not checked, see `outside_along`.
    measurements
        What the controller read at its calls, in its units, ``(call, measurement)``.
    """

    states: jax.Array
    controls: jax.Array
    outputs: jax.Array
    outside: jax.Array | None
    measurements: jax.Array


def roll(model: DFSM, wires: Wires, controller: Any, drive: Drive) -> Path:
    """Close the loop over one run; JAX can follow it.

    Parameters
    ----------
    model
        The surrogate, best `prepared`.
    wires
        How the controller is connected.
    controller
        A `Controller` that JAX can follow.
    drive
        Start and inputs.

    Returns
    -------
    Path
        In which the first call of the controller comes at the first time.
    """
    march = March(model, wires, drive)
    call = jax.checkpoint(partial(march.call, controller))
    (last, *_), out = jax.lax.scan(call, march.begin(controller), march.legs)
    return march.path(last, out)


class March:
    """One closed loop in its parts: how it begins, one call of the controller, what comes of it.

    Parameters
    ----------
    model, wires, drive
        As for `roll`.
    """

    def __init__(self, model: DFSM, wires: Wires, drive: Drive) -> None:
        self.model, self.wires, self.drive = model, wires, drive
        self.calls = len(drive.time)
        self.steps = (len(drive.inputs) - 1) // 2
        self.per_call = self.steps // self.calls

        def by_call(values: jax.Array) -> jax.Array:
            return values.reshape(self.calls, self.per_call, -1)

        legs = tuple(by_call(part) for part in wires.along(drive.inputs))
        # What drives every call: its time, step, inputs and field.
        self.legs = (drive.time, drive.h, legs, drive.field[: -1 : self.per_call])

    def begin(self, controller: Any) -> tuple[Any, ...]:
        """What the first call starts from: states, azimuth, controls set, controller's state."""
        wires, drive, v = self.wires, self.drive, self.drive.inputs
        seen = wires.measured(self.model, drive.x0, v[0], (drive.psi0, drive.field[0]))
        with _failing("start"):
            begun = _plain(controller.start(seen, wires.commands_of(v[0])))
        return (drive.x0, drive.psi0, v[0, jnp.array(wires.commanded)], begun)

    def call(self, controller: Any, carry: Any, leg: Any) -> tuple[Any, Any]:
        """One step of the controller, and the plant's until the next; states, commands, reads."""
        model, wires = self.model, self.wires
        x, psi, held, state = carry
        time, h, legs, field = leg
        seen = wires.measured(model, x, wires.with_commands(legs[0][0], held), (psi, field))
        with _failing("step"):
            new, commands = controller.step(state, seen, time)
        state, commands = _like(new, state), wires.in_model_units(_checked(commands, wires))
        path = []
        for step in range(self.per_call):
            path.append(x)
            ends = tuple(wires.with_commands(part[step], commands) for part in legs)
            x, psi = stepped(model, x, psi, h, ends)
        return (x, psi, commands, state), (jnp.stack(path), commands, seen)

    def path(self, last: jax.Array, out: tuple[jax.Array, jax.Array, jax.Array]) -> Path:
        """Put together what all calls gave."""
        xs, commands, seen = out
        model, drive = self.model, self.drive
        states = jnp.concatenate([xs.reshape(self.steps, -1), last[None]])
        commands = jnp.repeat(commands, self.per_call, axis=0)
        inputs = self.wires.with_commands(
            drive.inputs[::2], jnp.concatenate([commands, commands[-1:]])
        )
        h = jnp.repeat(drive.h, self.per_call)
        outputs, outside, _ = observe(model, h, states, (inputs, drive.field), drive.psi0)
        return Path(states, inputs[:, : len(model.signals.controls)], outputs, outside, seen)


def _plain(state: Any) -> Any:
    """A state whose numbers are arrays; a Python number may become a fraction later."""
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, dtype=float) if isinstance(leaf, int | float) else leaf,
        state,
    )


def _like(new: Any, old: Any) -> Any:
    """The next state as the loop carries it.

    Raises
    ------
    DfsmError
        It is made of other parts than the state before.
    """
    same = jax.tree.structure(new) == jax.tree.structure(old)
    shapes = [[np.shape(leaf) for leaf in jax.tree.leaves(state)] for state in (old, new)]
    if not same or shapes[0] != shapes[1]:
        raise DfsmError(
            f"the controller's step turns a state of shapes {shapes[0]} into one of {shapes[1]}: "
            "start and step must return states of the same parts"
        )
    return jax.tree.map(
        lambda a, b: jnp.asarray(a, dtype=b.dtype) if hasattr(b, "dtype") else b, new, old
    )


@contextmanager
def _failing(what: str) -> Iterator[None]:
    """Tell that a controller's own code fails, which is no bug of this package."""
    try:
        yield
    except DfsmError:
        raise
    except Exception as error:
        first = str(error).partition("\n")[0]
        # What JAX follows has no values yet that Python could decide by.
        cure = isinstance(error, jax.errors.JAXTypeError) and (
            ": write it with jax.numpy, and jnp.where in place of if"
        )
        raise DfsmError(
            f"the controller's {what} fails with {type(error).__name__}: {printable(first)}"
            f"{cure or ''}"
        ) from error


def _of_right_shape(commands: Any, wires: Wires) -> Any:
    if commands.shape != (len(wires.commanded),):
        raise DfsmError(
            f"the controller's step returns commands of shape {commands.shape}, expected "
            f"({len(wires.commanded)},): one number per command"
        )
    return commands


def _checked(commands: Any, wires: Wires) -> jax.Array:
    return _of_right_shape(jnp.asarray(commands, dtype=float), wires)


@eqx.filter_jit
def roll_compiled(model: DFSM, wires: Wires, controller: Any, drive: Drive) -> Path:
    """`roll`, compiled; models, controllers and runs of the same shapes share one compilation.

    Fastest with a model that is `staged`. The training range is not
    checked: that takes longer than the controller, and where figures are asked for nobody looks.
    """
    return roll(model.prepared(), wires, controller, drive)._replace(outside=None)


@eqx.filter_jit
def outside_along(model: DFSM, drive: Drive, path: Path) -> jax.Array:
    """Whether any input of a model is outside its training range along a path, ``(step + 1,)``."""
    _, w, p = model.signals.order.split_exogenous(drive.inputs[::2])
    return model.region.outside(model.join(path.states, path.controls, w, p))


# -- on the host --------------------------------------------------------------------------------


class HostLoop:
    """Closed loops with a controller that JAX cannot follow: compiled plant, controller in between.

    Parameters
    ----------
    model
        The surrogate.
    wires
        How the controller is connected.
    """

    def __init__(self, model: DFSM, wires: Wires) -> None:
        self.model, self.wires = model, wires
        arrays, rest = eqx.partition(model.prepared(), eqx.is_array)

        # Not `filter_jit`, whose own work would be most of a call's time.
        @jax.jit
        def seen(arrays: Any, x: Any, v: Any, blades: Any) -> jax.Array:
            return wires.measured(eqx.combine(arrays, rest), x, jnp.asarray(v), blades)

        @jax.jit
        def on(arrays: Any, x: Any, psi: Any, h: Any, legs: Any) -> Any:
            model, v, commands, field = eqx.combine(arrays, rest), *legs
            told, v = wires.in_model_units(commands), jnp.asarray(v)
            path = []
            for parts in zip(*wires.along(v), strict=True):
                ends = tuple(wires.with_commands(part, told) for part in parts)
                x, psi = stepped(model, x, psi, h, ends)
                path.append(x)
            now = wires.measured(model, x, wires.with_commands(v[-1], told), (psi, field))
            return jnp.stack(path), psi, now

        self._seen = partial(seen, arrays)
        self._on = partial(on, arrays)
        self._observed = eqx.filter_jit(observe)

    def roll(self, controller: Controller, drive: Drive, stop: Callable[[Array], bool]) -> Path:
        """Close the loop over one run until it ends, or `stop` says so of the states.

        Parameters
        ----------
        controller
            Steps on the host.
        drive
            Start and inputs.
        stop
            Tells of states ``(state,)`` whether to go no further.

        Returns
        -------
        Path
            Not a number from where the loop was stopped.
        """
        wires, drive = self.wires, jax.tree.map(np.asarray, drive)
        v, field = drive.inputs, drive.field
        calls, steps = len(drive.time), (len(v) - 1) // 2
        per_call = steps // calls
        states = np.full((steps + 1, len(drive.x0)), np.nan)
        commands = np.full((steps + 1, len(wires.commanded)), np.nan)
        read = np.full((calls, len(wires.sources)), np.nan)
        states[0], psi = drive.x0, drive.psi0
        seen = np.asarray(self._seen(states[0], v[0], (psi, field[0])))
        with _failing("start"):
            state = controller.start(seen, np.asarray(wires.commands_of(v[0])))
        try:
            for k, (time, h) in enumerate(zip(drive.time, drive.h, strict=True)):
                row = k * per_call
                read[k] = seen
                if stop(states[row]):
                    break
                with _failing(f"step at {time:g} s"):
                    state, told = controller.step(state, seen, time)
                    told = np.asarray(told, dtype=float)
                rows = slice(row, row + per_call)
                commands[rows] = told = _of_right_shape(told, wires)
                if not np.isfinite(told).all():
                    break
                until = row + per_call
                legs = (v[2 * row : 2 * until + 1], told, field[until])
                path, psi, seen = self._on(states[row], psi, h, legs)
                states[row + 1 : until + 1], seen = path, np.asarray(seen)
        finally:
            close = getattr(state, "close", None)
            if close is not None:
                close()
        inputs = wires.with_commands(from_host(v[::2]), wires.in_model_units(from_host(commands)))
        h = from_host(np.repeat(drive.h, per_call))
        outputs, outside, _ = self._observed(
            self.model, h, from_host(states), (inputs, drive.field), from_host(drive.psi0)
        )
        count = len(self.model.signals.controls)
        return Path(states, inputs[:, :count], outputs, outside, read)  # pyright: ignore[reportArgumentType]
