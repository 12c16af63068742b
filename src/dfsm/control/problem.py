"""OptimalControlProblem: what to minimise, subject to what, in names and units of a model.

    minimise   M(start, end) + ∫ L(s) dt
    subject to ẋ = f̂(x, u, w, p), path and boundary constraints, bounds and rates

over controls u, states x, free parameters p and a free final time (Sec. 4). How it is solved is
the business of `solve` and its methods.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from dfsm.control import refusals
from dfsm.control.between import kinds_of
from dfsm.control.levels import Constraint, Interval, is_number, level
from dfsm.control.names import Plant, plant_of
from dfsm.core.settings import require
from dfsm.core.types import Array
from dfsm.data.between import Between, Chosen
from dfsm.data.conversion import in_units_of
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.completion import completed
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import latents_at, poles
from dfsm.models.wakes import wakes_where
from dfsm.simulation.hidden import pairs_from_past
from dfsm.simulators import ODESystem


@dataclass(frozen=True, kw_only=True, eq=False)
class OptimalControlProblem:
    """An open-loop optimal control problem.

    Costs and path constraints are functions of one argument `s` with named signals at one time,
    for example ``lambda s: -s.x.GenSpeed * s.u.GenTq``; see `Signals`. Final costs and boundary
    constraints are functions of the two ends, for example ``lambda start, end: end.t``; see `End`.
    All are written with jax.numpy, for exact derivatives.

    Attributes
    ----------
    model
        A surrogate, or a system of known equations: ``ODESystem(f, states=…, controls=…)`` makes
        one of any JAX function f(x, u, w, p).
    horizon
        First and last time in s. A pair in place of the last time makes it free between the two.
    cost
        L, integrated over the horizon.
    final_cost
        M, a function of both ends.
    bounds
        ``name: (low, high)`` for states, controls and outputs, in their units. A limit is a
        number, None, a function of time (array in, array out), or a run that holds the channel.
    rates
        ``name: (low, high)`` for the rates of controls, in their units per second.
    initial, final
        ``name: value`` fixes a state at that end, ``name: (low, high)`` bounds it, and a state
        that is not named is free within its bounds. Latent states that are not named start from
        the inputs recorded up to the first time, where a run holds them.
    constraints
        ``name: (function, low, high)``, path constraints; a function may return a vector.
    boundary
        ``name: (function, low, high)``, constraints on both ends.
    parameters
        ``name: value`` fixes a plant parameter, ``name: (low, high)`` leaves it to the optimizer.
    disturbances
        Known over the whole horizon, between samples as `inputs` say. Several runs are several
        scenarios: each has its own states and controls, all share the free parameters and the
        final time.
    weights
        Of the scenarios in the cost; None weighs all the same. They are scaled to a sum of 1.
    inputs
        What inputs do in between, ``"hold"``, ``"linear"`` or ``"cubic"``, for all or by name.
        Disturbances that are not named do between samples as the model says, or are lines. Controls
        follow the scheme's polynomials, or are held over every interval of the first mesh if this
        says hold. What is held needs the scheme radau.
    name
        For messages.

    Raises
    ------
    DfsmError
        Unknown names, bounds that cross, disturbances shorter than the horizon, and the like.
    """

    model: DFSM | ODESystem
    horizon: tuple[float, float | tuple[float, float]]
    cost: Callable[..., Any] | None = None
    final_cost: Callable[..., Any] | None = None
    bounds: Mapping[str, Interval] = field(default_factory=dict)
    rates: Mapping[str, Interval] = field(default_factory=dict)
    initial: Mapping[str, float | tuple[float | None, float | None]] = field(default_factory=dict)
    final: Mapping[str, float | tuple[float | None, float | None]] = field(default_factory=dict)
    constraints: Mapping[str, Constraint] = field(default_factory=dict)
    boundary: Mapping[str, Constraint] = field(default_factory=dict)
    parameters: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)
    disturbances: Trajectory | Sequence[Trajectory] | None = None
    weights: Sequence[float] | None = None
    inputs: Chosen = None
    name: str = "problem"

    def __post_init__(self) -> None:
        refusals.check_forms(self)
        refusals.check_names(self)
        for place in ("bounds", "rates"):
            object.__setattr__(self, place, self.plant.in_its_units(getattr(self, place), place))
        refusals.check_pairs(self)
        refusals.check_horizon(self)
        refusals.check_disturbances(self)
        refusals.check_limits(self)
        _ = self.between
        if self.cost is None and self.final_cost is None:
            raise DfsmError(f"{self.name}: nothing to minimise: give a cost or a final_cost")
        if self.weights is not None:
            count, weights = len(self.scenarios), np.asarray(self.weights, dtype=float)
            require(
                weights.shape == (count,) and bool((weights > 0).all()),
                f"{self.name}: weights",
                list(self.weights),
                f"{count} positive numbers, one per scenario",
            )

    # -- what follows from the fields -----------------------------------------------------------

    @cached_property
    def plant(self) -> Plant:
        """The model's channels and functions."""
        return plant_of(self.model)

    @property
    def start(self) -> float:
        """First time in s."""
        return float(self.horizon[0])

    @property
    def free_time(self) -> tuple[float, float] | None:
        """Limits of a free last time in s, else None."""
        stop = self.horizon[1]
        return (float(stop[0]), float(stop[1])) if isinstance(stop, tuple) else None

    @property
    def last_time(self) -> float:
        """The last time in s, or the latest one allowed."""
        stop = self.horizon[1]
        return float(stop[1] if isinstance(stop, tuple) else stop)

    @property
    def free_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that are left to the optimizer, in the model's order."""
        names = self.plant.names("parameters")
        return tuple(n for n in names if not is_number(self.parameters[n]))

    @cached_property
    def scenarios(self) -> tuple[Trajectory | None, ...]:
        """Disturbances of every scenario; a single None where there are none."""
        if self.disturbances is None:
            return (None,)
        runs = self.disturbances
        return tuple(map(self._completed, [runs] if isinstance(runs, Trajectory) else runs))

    def _completed(self, run: Trajectory) -> Trajectory:
        """In the model's units, with disturbances computed from others where it lacks any."""
        if isinstance(self.model, DFSM):
            whole = all(n in run for n in self.plant.names("disturbances"))
            return completed(run, self.model.signals, compute=not whole)
        return in_units_of(run, [c for group in self.plant.channels.values() for c in group])

    @cached_property
    def between(self) -> tuple[Between, ...]:
        """What controls and disturbances, in this order, do between nodes and samples."""
        own = self.model.signals.between if isinstance(self.model, DFSM) else ()
        return kinds_of(self.inputs, self.plant, own, self.name)

    @property
    def holds_controls(self) -> bool:
        """Whether controls are held over the intervals of the first mesh."""
        return "hold" in self.between[: len(self.plant.names("controls"))]

    @property
    def latents(self) -> tuple[str, ...]:
        """Names of the states that nobody measures."""
        if not isinstance(self.model, DFSM):
            return ()
        return tuple(c.name for c in self.model.signals.latents)

    @cached_property
    def latent_starts(self) -> dict[str, list[float | None]]:
        """Latent states at the first time by name, one per scenario; None where that is free."""
        if not isinstance(self.model, DFSM) or not self.latents:
            return {}
        known = [self._latents_at_start(self.model, run) for run in self.scenarios]
        return {
            name: [values[k] for values in known]
            for k, name in enumerate(self.latents)
            if name not in self.initial
        }

    def _latents_at_start(self, model: DFSM, run: Trajectory | None) -> list[float | None]:
        """Latent states that what was recorded before the first time has left behind.

        Induced velocities have settled to the recorded state, or to the one that is asked for.
        """
        s = model.signals
        driving = (*s.driving, *(s.measured if s.startup else ()))
        if run is None or not all(n in run for n in driving):
            pairs: list[float | None] = [None] * (len(s.latents) - s.induced)
        else:
            pairs = [float(v) for v in pairs_from_past(model, run, self.start)]
        if not s.induced:
            return pairs
        known = dict[str, float]()
        if run is not None:
            now = int(np.argmin(np.abs(run.time - self.start)))
            known = {c.name: float(run[c.name][now]) for c in s.inputs if c.name in run}
        for name in self.initial:
            low, high = self.end_limits("initial", name)
            known |= {name: low} if low == high else {}
        return [*wakes_where(model, known).tolist(), *pairs]

    def latent_paths(self, time: Array) -> dict[str, Array]:
        """Latent states that disturbances alone drive, at times in s, by name.

        There is nothing to choose about these, so that they need not be solved for.

        Returns
        -------
        dict
            Shapes ``(scenario, time)``. A pair that controls drive, that starts freely, or that the
            problem bounds is missing.
        """
        if not isinstance(self.model, DFSM) or self.free_time is not None:
            return {}
        if self.model.signals.startup:
            return {}
        chosen = np.asarray(poles(self.model).drive)[:, : len(self.plant.names("controls"))]
        asked, pairs = {*self.bounds, *self.final}, [c.name for c in self.model.signals.pairs]
        known = []
        for *pair, drive in zip(pairs[::2], pairs[1::2], chosen, strict=True):
            starts = [v for n in pair for v in self.latent_starts.get(n, [None])]
            if not (drive.any() or None in starts or asked & {*pair}):
                known += pair
        if not known:
            return {}
        runs = [run for run in self.scenarios if run is not None]
        paths = np.stack([latents_at(self.model, run, time) for run in runs])
        return {name: paths[..., pairs.index(name)] for name in known}

    @property
    def scenario_weights(self) -> Array:
        """Weights with a sum of 1, shape ``(scenario,)``."""
        count = len(self.scenarios)
        weights = np.ones(count) if self.weights is None else np.asarray(self.weights, dtype=float)
        return weights / weights.sum()

    def limits(self, name: str, time: Array) -> tuple[Array, Array]:
        """Lower and upper bound of a state, control or output at times in s, infinite if none."""
        low, high = self.bounds.get(name, (None, None))
        return level(low, name, time, -np.inf), level(high, name, time, np.inf)

    def end_limits(self, which: str, name: str) -> tuple[float, float]:
        """Lower and upper bound of a state at the ``"initial"`` or ``"final"`` time."""
        limits = getattr(self, which).get(name, (None, None))
        if is_number(limits):
            return float(limits), float(limits)
        low, high = limits
        return (-np.inf if low is None else float(low), np.inf if high is None else float(high))
