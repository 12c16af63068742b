"""A black box from the right-hand side of any ordinary differential equation.

    ẋ = f(x, u, w, p)        y = g(x, u, w, p)

with states x, controls u, disturbances w and parameters p in the order of `DFSM.derivative`. As f
is known, derivatives and poles of a surrogate can be compared with the true ones.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from dfsm.core.progress import track
from dfsm.core.settings import require
from dfsm.core.types import Array, ComplexArray
from dfsm.data.trajectory import Channel, Role, Trajectory
from dfsm.errors import DfsmError
from dfsm.simulators.evaluate import (
    Function,
    jacobian_jax,
    jacobian_numpy,
    rows_jax,
    rows_numpy,
    shape_jax,
    shape_numpy,
    takes_four,
)
from dfsm.simulators.excitation import Excitation, Uniform
from dfsm.simulators.ode_solver import Start, solve_jax, solve_numpy
from dfsm.simulators.start import as_mesh, as_signal, as_vector, draw_signal, draw_vector
from dfsm.simulators.waveforms import Signal

_ROLES: dict[str, Role] = {
    "states": "state",
    "controls": "control",
    "disturbances": "disturbance",
    "parameters": "parameter",
    "outputs": "output",
}


@dataclass(frozen=True)
class ODESystem:
    """A simulator made of the functions f and g.

    Attributes
    ----------
    f
        ``f(states, controls, disturbances, parameters)`` returns the state derivatives per
        second; all are vectors, empty where the system has no such channels. It does not depend
        on time.
    states, controls, disturbances, parameters, outputs
        One `Channel` per element, with units; roles are set here.
    g
        Takes what f takes and returns the outputs; None without outputs.
    name
        For messages.
    backend
        ``"jax"``: f and g are written with jax.numpy, are compiled, and have exact Jacobians.
        ``"numpy"``: they are any Python functions.
    rtol, atol
        Relative and absolute tolerance per step of the solver, an explicit one.

    Raises
    ------
    DfsmError
        No states, a name that occurs twice, g without outputs or outputs without g, a function that
        does not take four arguments, an unknown backend, or a tolerance that is not positive.
    """

    f: Function
    states: tuple[Channel, ...]
    controls: tuple[Channel, ...] = ()
    disturbances: tuple[Channel, ...] = ()
    parameters: tuple[Channel, ...] = ()
    outputs: tuple[Channel, ...] = ()
    g: Function | None = None
    name: str = "system"
    backend: Literal["jax", "numpy"] = "jax"
    rtol: float = 1e-9
    atol: float = 1e-9

    def __post_init__(self) -> None:
        for group, role in _ROLES.items():
            channels = tuple(replace(c, role=role) for c in getattr(self, group))
            object.__setattr__(self, group, channels)
        names = [c.name for c in self._channels]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise DfsmError(f"{self.name}: channel '{name}' was given twice: rename one")
        if not self.states:
            raise DfsmError(f"{self.name}: no states were given, at least one is needed")
        if (self.g is None) != (not self.outputs):
            missing = "g" if self.g is None else "output channels"
            raise DfsmError(f"{self.name}: {missing} missing: give both g and its outputs, or none")
        for what, function in (("f", self.f), ("g", self.g)):
            if function is not None and not takes_four(function):
                raise DfsmError(
                    f"{self.name}: {what} takes {inspect.signature(function)}, expected "
                    "(states, controls, disturbances, parameters)"
                )
        backends = ("jax", "numpy")
        require(self.backend in backends, "backend", self.backend, " or ".join(backends))
        for name in ("rtol", "atol"):
            require(getattr(self, name) > 0, name, getattr(self, name), "more than 0")

    @property
    def _channels(self) -> tuple[Channel, ...]:
        """All channels in the order of a run's columns."""
        return tuple(c for group in _ROLES for c in getattr(self, group))

    # -- simulations ----------------------------------------------------------------------------

    def simulate(
        self,
        time: ArrayLike,
        initial: ArrayLike,
        controls: Signal | Trajectory | ArrayLike | None = None,
        disturbances: Signal | Trajectory | ArrayLike | None = None,
        parameters: ArrayLike = (),
        name: str = "run",
    ) -> Trajectory:
        """Simulate one run.

        Parameters
        ----------
        time
            Samples in s, shape ``(time,)``, increasing.
        initial
            States at the first time, shape ``(state,)``.
        controls, disturbances
            A signal from `excite`; a run that holds the channels, or samples at `time` of shape
            ``(time, channel)``, both joined by cubic splines; or constants, shape ``(channel,)``.
            None where the system has no such channels.
        parameters
            Shape ``(parameter,)``.
        name
            Of the run.

        Returns
        -------
        Trajectory
            States, controls, disturbances, parameters and outputs with their roles. With the
            NumPy backend the run's `wall_time` is set.

        Raises
        ------
        DfsmError
            Shapes that do not fit, inputs shorter than the time, an f that returns the wrong
            shape or is not finite at the start, or a solution that does not reach the last time.
        """
        time = as_mesh(time)
        start = Start(
            as_vector(f"{name}: the initial state", initial, self.states),
            as_signal(f"{name}: the controls", controls, self.controls, time),
            as_signal(f"{name}: the disturbances", disturbances, self.disturbances, time),
            as_vector(f"{name}: the parameters", parameters, self.parameters),
            name,
        )
        return self._solve(time, [start])[0]

    def campaign(
        self,
        runs: int,
        time: ArrayLike,
        initial: Uniform | ArrayLike,
        controls: Excitation | None = None,
        disturbances: Excitation | None = None,
        parameters: Uniform | ArrayLike = (),
        seed: int = 0,
    ) -> list[Trajectory]:
        """Simulate many runs from random initial states with random inputs (Sec. 3.2).

        Parameters
        ----------
        runs
            How many. A run does not depend on how many others there are.
        time
            Samples in s, shape ``(time,)``, increasing, from 0 s or later; inputs begin at 0 s.
        initial, parameters
            `Uniform` draws each run's values; rows of values, shape ``(row, n)`` or a single one
            ``(n,)``, are taken in turn.
        controls, disturbances
            What kind of signal to draw for each run, see `excite`; None where the system has no
            such channels.
        seed
            The same seed gives the same runs.

        Returns
        -------
        list of Trajectory
            Named ``run000``, ``run001``, …, see `simulate`.

        Raises
        ------
        DfsmError
            As for `simulate` and `excite`.
        """
        time = as_mesh(time)
        require(runs >= 1, "runs", runs, "at least 1")
        require(seed >= 0, "seed", seed, "0 or more")
        require(time[0] >= 0, "the first time", f"{time[0]:g} s", "0 s or later")
        stop = float(time[-1])
        starts = []
        for k in range(runs):
            # A stream of random numbers for each choice: drawing one in another way leaves the
            # others as they are.
            x, u, w, p = ((seed, k, stream) for stream in range(4))
            starts.append(
                Start(
                    draw_vector("the initial state", initial, self.states, k, x),
                    draw_signal("controls", controls, self.controls, stop, u),
                    draw_signal("disturbances", disturbances, self.disturbances, stop, w),
                    draw_vector("the parameters", parameters, self.parameters, k, p),
                    f"run{k:03d}",
                )
            )
        return self._solve(time, starts)

    # -- the truth ------------------------------------------------------------------------------

    def derivative(self, run: Trajectory) -> Array:
        """True state derivatives along the states and inputs of a run.

        Parameters
        ----------
        run
            Holds all states, controls, disturbances and parameters.

        Returns
        -------
        ndarray
            Per second, shape ``(time, state)``.

        Raises
        ------
        DfsmError
            A channel is missing.
        """
        groups = ("states", "controls", "disturbances", "parameters")
        parts = [run.select(c.name for c in getattr(self, group)).values for group in groups]
        self._check_shape("f", self.f, [part[0] for part in parts])
        return self._rows(self.f, parts)

    def jacobians(
        self,
        states: ArrayLike,
        controls: ArrayLike = (),
        disturbances: ArrayLike = (),
        parameters: ArrayLike = (),
    ) -> tuple[Array, Array, Array, Array]:
        """Jacobians of f and g at one point; exact for JAX, central differences for NumPy.

        Parameters
        ----------
        states, controls, disturbances, parameters
            Shapes ``(n,)``.

        Returns
        -------
        tuple of ndarray
            A ``(state, state)``, B ``(state, control + disturbance)``, C ``(output, state)``,
            D ``(output, control + disturbance)``, as from `DFSM.jacobians`.

        Raises
        ------
        DfsmError
            Shapes that do not fit.
        """
        x = as_vector("states", states, self.states)
        u = as_vector("controls", controls, self.controls)
        w = as_vector("disturbances", disturbances, self.disturbances)
        point = (x, u, w, as_vector("parameters", parameters, self.parameters))
        self._check_shape("f", self.f, point)
        slopes = jacobian_jax if self.backend == "jax" else jacobian_numpy
        F, G = slopes(self.f, *point), np.empty((0, len(x) + len(u) + len(w)))
        if self.g is not None:
            self._check_shape("g", self.g, point)
            G = slopes(self.g, *point)
        n = len(x)
        return F[:, :n], F[:, n:], G[:, :n], G[:, n:]

    def eigenvalues(
        self,
        states: ArrayLike,
        controls: ArrayLike = (),
        disturbances: ArrayLike = (),
        parameters: ArrayLike = (),
    ) -> ComplexArray:
        """Poles: eigenvalues of ∂f/∂x at one point, in 1/s, most unstable first.

        Parameters
        ----------
        states, controls, disturbances, parameters
            Shapes ``(n,)``.

        Returns
        -------
        ndarray
            Complex, shape ``(state,)``.
        """
        A = self.jacobians(states, controls, disturbances, parameters)[0]
        values = np.linalg.eigvals(A).astype(np.complex128)
        return values[np.argsort(-values.real)]

    # -- solving --------------------------------------------------------------------------------

    def _solve(self, time: Array, starts: Sequence[Start]) -> list[Trajectory]:
        first = starts[0]
        point = (first.initial, *first.at(float(time[0])))
        self._check_shape("f", self.f, point)
        if self.g is not None:
            self._check_shape("g", self.g, point)
        solve = solve_jax if self.backend == "jax" else solve_numpy
        runs = []
        with closing(solve(self.f, time, starts, (self.rtol, self.atol))) as solved:
            tracked = track(solved, "simulating", len(starts))
            for start, (states, seconds) in zip(starts, tracked, strict=True):
                self._check_solved(time, start, states)
                runs.append(self._run(time, start, states, seconds))
        return runs

    def _run(self, time: Array, start: Start, states: Array, seconds: float | None) -> Trajectory:
        parameters = np.broadcast_to(start.parameters, (len(time), len(start.parameters)))
        parts = [states, start.controls(time), start.disturbances(time), parameters]
        if self.g is not None:
            parts.append(self._rows(self.g, parts))
        values = np.concatenate(parts, axis=1)
        return Trajectory(time, values, self._channels, name=start.name, wall_time=seconds)

    def _rows(self, function: Function, parts: Sequence[Array]) -> Array:
        """Evaluate f or g at every row of states, controls, disturbances and parameters."""
        return (rows_jax if self.backend == "jax" else rows_numpy)(function, *parts)

    def _check_shape(self, what: str, function: Function, point: Sequence[Array]) -> None:
        group = "states" if what == "f" else "outputs"
        expected = (len(getattr(self, group)),)
        shape = (shape_jax if self.backend == "jax" else shape_numpy)(function, *point)
        if shape is None:
            raise DfsmError(
                f"{self.name}: JAX cannot follow {what}, which converts its arguments to "
                "numbers: write it with jax.numpy, or set backend to numpy"
            )
        if shape != expected:
            raise DfsmError(
                f"{self.name}: {what} returns shape {shape}, expected {expected}, one value for "
                f"each of the {group}"
            )

    def _check_solved(self, time: Array, start: Start, states: Array) -> None:
        finite = np.isfinite(states).all(axis=1)
        if finite.all():
            return
        point = (start.initial, *start.at(float(time[0])))
        slope = self._rows(self.f, [part[None] for part in point])[0]
        if not np.isfinite(slope).all():
            name = self.states[int(np.argmin(np.isfinite(slope)))].name
            values = ", ".join(
                f"{c.name} = {v:g}"
                for c, v in zip(self._channels, np.concatenate(point), strict=False)
            )
            raise DfsmError(
                f"{start.name}: f gives no finite derivative of '{name}' at the start ({values}): "
                f"correct f of {self.name} or start elsewhere"
            )
        row = int(np.argmin(finite))
        largest = int(np.argmax(np.abs(states[row - 1])))
        channel, value = self.states[largest], states[row - 1, largest]
        raise DfsmError(
            f"{start.name}: the solver gave up between {time[row - 1]:g} s and {time[row]:g} s, "
            f"where {channel.name} was {value:g} {channel.unit}".rstrip()
            + ": simulate less, use smaller inputs or initial states, or raise rtol and atol"
        )
