"""Signals by name inside costs and constraints: ``s.x.GenSpeed * s.u.GenTq``.

The functions of an optimal control problem see named scalars and never a column number. All of it
can be followed by JAX.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax.numpy as jnp

import dfsm.core.jax_setup  # noqa: F401
from dfsm.data.conversion import in_units_of
from dfsm.data.derivatives import per_second
from dfsm.data.features import acting_late
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, near_matches
from dfsm.models.dfsm import DFSM
from dfsm.models.inputs import InputOrder
from dfsm.models.point import Point
from dfsm.models.region import Region
from dfsm.simulators import ODESystem
from dfsm.simulators.evaluate import Function, as_jax

# Letter of a group in user functions, and what it holds.
GROUPS = {
    "x": "states",
    "u": "controls",
    "w": "disturbances",
    "p": "parameters",
    "y": "outputs",
}


@dataclass(frozen=True, eq=False)
class Plant:
    """What an optimal control problem needs of a model, whichever kind it is.

    Attributes
    ----------
    channels
        Channels by group, ``"states"`` to ``"outputs"``.
    derivative, output
        ``(x, u, w, p)`` to one vector; traceable by JAX.
    at
        ``(x, u, w, p)`` to an object with both vectors as `derivative` and `output`, which computes
        what they share once.
    region
        Where the training data of a surrogate lie, on inputs [u, w, ξ, p]; None for an `ODESystem`.
    """

    channels: Mapping[str, tuple[Channel, ...]]
    derivative: Callable[..., Any]
    output: Callable[..., Any]
    at: Callable[..., Any]
    region: Region | None

    def names(self, group: str) -> tuple[str, ...]:
        """Names of one group, e.g. ``names("states")``."""
        return tuple(c.name for c in self.channels[group])

    def in_its_units(self, limits: Mapping[str, Any], kind: str) -> dict[str, Any]:
        """Pairs of limits by channel, with those that a run holds in this plant's units.

        Parameters
        ----------
        limits
            By name; what is no run passes as it is.
        kind
            ``"bounds"``, or ``"rates"``, which are per second.
        """
        units = {c.name: c.unit for group in self.channels.values() for c in group}

        def taken(name: str, limit: Any) -> Any:
            if not isinstance(limit, Trajectory):
                return limit
            unit = per_second(units[name]) if kind == "rates" else units[name]
            return in_units_of(limit, [Channel(name, unit)])

        return {
            name: tuple(taken(name, limit) for limit in pair) if isinstance(pair, tuple) else pair
            for name, pair in limits.items()
        }

    @property
    def order(self) -> InputOrder:
        """Where everything stands in I = [u, w, ξ, p], which `region` is about."""
        return InputOrder.of(self.names)

    def owner(self, name: str) -> str | None:
        """Letter of the group that holds a channel, None if there is none."""
        return next((k for k, group in GROUPS.items() if name in self.names(group)), None)


def plant_of(model: DFSM | ODESystem) -> Plant:
    """Make a `Plant` of a surrogate or of a system of known equations.

    Raises
    ------
    DfsmError
        The model is something else, JAX cannot follow it, or a control acts late in it.
    """
    if isinstance(model, DFSM):
        require_prompt_controls(model)
        channels = {g: tuple(getattr(model.signals, g)) for g in GROUPS.values()}
        ready = model.prepared()
        point = partial(Point, ready)
        return Plant(channels, ready.derivative, ready.output, point, model.region)
    if not isinstance(model, ODESystem):
        raise DfsmError(
            f"model is a {type(model).__name__}, expected a DFSM or an ODESystem: wrap a function "
            "f(x, u, w, p) as ODESystem(f, states=…, controls=…)"
        )
    if model.backend != "jax":
        raise DfsmError(
            f"{model.name}: optimal control needs derivatives of f, which the numpy backend cannot "
            "give: write f with jax.numpy and set backend to jax"
        )
    channels = {g: tuple(getattr(model, g)) for g in GROUPS.values()}
    f, g = _AsArray(model.f), _AsArray(model.g)
    return Plant(channels, f, g, partial(_SystemPoint, f, g), None)


def require_prompt_controls(model: DFSM) -> None:
    """Refuse a model that takes what a control did some time ago.

    Raises
    ------
    DfsmError
        Which input of which control.
    """
    late = acting_late(model.signals.features, model.signals.names("controls"))
    if late:
        feature, control = next(iter(late.items()))
        raise DfsmError(
            f"'{feature}' is what the control '{control}' did some time ago, which optimal control "
            "cannot follow while it chooses it: fit a model without this feature (states of a "
            "filter stand in for a delay), or one whose delays are of disturbances"
        )


@dataclass(frozen=True)
class _AsArray:
    """What a function of a system returns, as an array; nothing without a function.

    Equal where the functions are, so that problems on one system share compilations.
    """

    function: Function | None

    def __call__(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        return jnp.zeros(0) if self.function is None else as_jax(self.function(x, u, w, p))


class _SystemPoint:
    """A system at one point, see `Plant.at`."""

    def __init__(self, f: _AsArray, g: _AsArray, *groups: Any) -> None:
        self._f, self._g, self._groups = f, g, groups

    @cached_property
    def derivative(self) -> Any:
        """f, shape ``(state,)``."""
        return self._f(*self._groups)

    @cached_property
    def output(self) -> Any:
        """g, shape ``(output,)``."""
        return self._g(*self._groups)


class Group:
    """Scalars by channel name: ``group.GenSpeed``, or ``group["a name with spaces"]``.

    Raises
    ------
    DfsmError
        No such channel in this group; the message says which group has it, or what is near.
    """

    def __init__(self, letter: str, plant: Plant, values: Any) -> None:
        self._letter, self._plant, self._values = letter, plant, values

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self[name]

    def __getitem__(self, name: str) -> Any:
        kind = GROUPS[self._letter]
        known = self._plant.names(kind)
        if name in known:
            return self._values[known.index(name)]
        owner = self._plant.owner(name)
        if owner is not None:
            raise DfsmError(
                f"'{name}' is one of the {GROUPS[owner]}, not of the {kind}: write {owner}.{name}"
            )
        raise DfsmError(f"no channel '{name}' among the {kind}; {near_matches(name, known)}")


class Signals:
    """All signals at one time, as costs and path constraints see them.

    ``s.t`` is the time in s; ``s.x``, ``s.u``, ``s.w``, ``s.p`` and ``s.y`` hold states, controls,
    disturbances, parameters and outputs by name, in the model's units.
    """

    def __init__(self, plant: Plant, t: Any, values: Sequence[Any]) -> None:
        self._plant, self._raw, self.t = plant, tuple(values), t
        self.x, self.u, self.w, self.p = (
            Group(letter, plant, v) for letter, v in zip("xuwp", values, strict=True)
        )

    @property
    def distance(self) -> Any:
        """How far states and controls are from the training data: 1 is as far as is usual.

        See `Region.distance_chosen`; 0 without a surrogate.
        """
        region, order = self._plant.region, self._plant.order
        if region is None:
            return jnp.zeros(())
        groups = [jnp.asarray(g) for g in self._raw]
        return region.distance_chosen(order.join(*groups), order.element(region.schedule, *groups))

    @cached_property
    def _point(self) -> Any:
        return self._plant.at(*map(jnp.asarray, self._raw))

    @property
    def y(self) -> Group:
        """Outputs; they are only evaluated where a function asks for them, and once."""
        return Group("y", self._plant, self._point.output)

    @property
    def derivative(self) -> Any:
        """All state derivatives per second, shape ``(state,)``."""
        return self._point.derivative


class End:
    """One end of the horizon, as final costs and boundary constraints see it.

    ``end.t`` is its time in s; ``end.x`` and ``end.p`` hold states and parameters by name.
    """

    def __init__(self, plant: Plant, t: Any, x: Any, p: Any) -> None:
        self.t, self.x, self.p = t, Group("x", plant, x), Group("p", plant, p)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise DfsmError(
            f"the ends of the horizon have t, x and p, not '{name}': functions of controls, "
            "disturbances and outputs belong in the cost or the path constraints"
        )
