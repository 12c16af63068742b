"""The file of `dfsm optimize`: an optimal control problem in names, numbers and lists."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from dfsm.config.parse import Strict, parse_file
from dfsm.control import DirectTranscription, OptimalControlProblem
from dfsm.control.mesh.schemes import Kind
from dfsm.control.names import GROUPS, Plant, plant_of
from dfsm.data.between import Between
from dfsm.data.readers import read_all
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, near_matches
from dfsm.models.dfsm import DFSM
from dfsm.models.model_folder import load
from dfsm.simulation.simulate import initial_state

_ADVICE = "write one as the documentation shows under 'Optimal control from a file'"

Pair = tuple[float | None, float | None]


class CostTerm(Strict):
    """A weight times one of four forms of named signals, integrated over the horizon.

    Attributes
    ----------
    weight
        Negative to maximise.
    value, square
        A signal, or its square.
    product
        Two signals or more, multiplied.
    track, reference
        The square of a signal's distance to a number.
    """

    weight: float
    value: str | None = None
    square: str | None = None
    product: list[str] | None = None
    track: str | None = None
    reference: float | None = None


class ControlConfig(Strict):
    """A whole file of `dfsm optimize`.

    Attributes
    ----------
    model
        Folder that `dfsm fit` made; files are relative to the configuration.
    disturbances
        Run with the disturbances, or several, which are scenarios.
    horizon
        First and last time in s.
    cost
        Terms, added up.
    units
        By signal: what it is divided by in costs, so that weights can be those of other units.
    bounds, rates
        Of states, controls and outputs; of the rates of controls per second. null is no limit.
    parameters
        Value of a plant parameter, or its two limits to optimize it.
    initial
        ``free`` within the bounds, or ``recorded`` in the run.
    scheme, nodes, refine, tolerance, most_iterations, most_seconds, stay_inside
        See `DirectTranscription`; `nodes` are those of the first mesh, intervals plus one.
    inputs
        What inputs do between nodes and samples, see `OptimalControlProblem`.
    name
        For messages.
    """

    model: str
    horizon: tuple[float, float]
    cost: list[CostTerm]
    disturbances: str | list[str] | None = None
    units: dict[str, float] = Field(default_factory=dict)
    bounds: dict[str, Pair] = Field(default_factory=dict)
    rates: dict[str, Pair] = Field(default_factory=dict)
    parameters: dict[str, float | tuple[float, float]] = Field(default_factory=dict)
    initial: Literal["free", "recorded"] = "free"
    scheme: Kind = DirectTranscription.scheme
    nodes: int = 101
    refine: float | None = None
    tolerance: float = DirectTranscription.tolerance
    most_iterations: int = DirectTranscription.most_iterations
    most_seconds: float | None = None
    stay_inside: bool = False
    inputs: Between | dict[str, Between] | None = None
    name: str | None = None


def load_problem(
    path: str | Path,
) -> tuple[OptimalControlProblem, DirectTranscription, Trajectory | None]:
    """Read a problem, the method to solve it with, and the run to start from.

    Parameters
    ----------
    path
        YAML file, see `ControlConfig`.

    Raises
    ------
    DfsmError
        The file is missing or not YAML, or a key or a signal is unknown, missing or wrong.
    """
    path = Path(path)
    config = parse_file(path, ControlConfig, _ADVICE)
    model = load(path.parent / config.model)
    runs = _runs(config, path)
    try:
        method = DirectTranscription(
            scheme=config.scheme,
            mesh=_intervals(config.nodes),
            refine=config.refine,
            tolerance=config.tolerance,
            most_iterations=config.most_iterations,
            most_seconds=config.most_seconds,
            stay_inside=config.stay_inside,
        )
        problem = OptimalControlProblem(
            model=model,
            horizon=config.horizon,
            cost=cost_of(config.cost, plant_of(model), config.units),
            bounds=config.bounds,
            rates=config.rates,
            parameters=config.parameters,
            initial=_initial(config, model, runs),
            disturbances=runs or None,
            inputs=config.inputs,
            name=config.name or path.stem,
        )
    except DfsmError as error:
        raise DfsmError(f"{path}: {error}") from None
    return problem, method, _guess(problem, runs)


def cost_of(
    terms: Sequence[CostTerm], plant: Plant, units: dict[str, float] | None = None
) -> Callable[..., Any]:
    """Make the integrand of a list of terms.

    Parameters
    ----------
    terms
        At least one.
    plant
        Says which signals there are.
    units
        See `ControlConfig`.

    Raises
    ------
    DfsmError
        A signal is unknown, or a term has not exactly one form.
    """
    divisors = units or {}
    if not terms:
        raise DfsmError("'cost' has no terms: list what to minimise")
    for name, divisor in divisors.items():
        _owner(plant, name, "units")
        if not (np.isfinite(divisor) and divisor != 0):
            raise DfsmError(f"'units.{name}' is {divisor:g}, expected a number that is not 0")
        if divisor < 0:
            raise DfsmError(
                f"'units.{name}' is {divisor:g}, expected a number above 0: a negative one turns "
                "the sign of costs, which is what 'weight' is for"
            )
    parts = [_factors(term, f"cost[{k}]", plant) for k, term in enumerate(terms)]

    def cost(s: Any) -> Any:
        total = 0.0
        for weight, factors in parts:
            made = weight
            for letter, name, reference in factors:
                made = made * (getattr(s, letter)[name] - reference) / divisors.get(name, 1.0)
            total = total + made
        return total

    return cost


# Letter of the signal's group, its name, and what is subtracted from it.
_Factor = tuple[str, str, float]


def _factors(term: CostTerm, where: str, plant: Plant) -> tuple[float, list[_Factor]]:
    forms = [f for f in ("value", "square", "product", "track") if getattr(term, f) is not None]
    if len(forms) != 1:
        told = " and ".join(f"'{f}'" for f in forms) or "none"
        raise DfsmError(f"'{where}' has {told}, expected one of value, square, product or track")
    form = forms[0]
    if (term.reference is None) == (form == "track"):
        wanted = "needs a key 'reference'" if form == "track" else "takes no key 'reference'"
        raise DfsmError(f"'{where}' {wanted}: the number that 'track' holds its signal at")
    if form == "product" and len(term.product or []) < 2:
        raise DfsmError(f"'{where}.product' names fewer than two signals: use value instead")
    named = getattr(term, form)
    names = list(named) if form == "product" else [named] * (1 if form == "value" else 2)
    reference = term.reference or 0.0
    return term.weight, [(_owner(plant, n, f"{where}.{form}"), n, reference) for n in names]


def _owner(plant: Plant, name: str, where: str) -> str:
    letter = plant.owner(name)
    if letter is None:
        known = [n for group in GROUPS.values() for n in plant.names(group)]
        raise DfsmError(f"'{where}': no channel '{name}'; {near_matches(name, known)}")
    return letter


def _runs(config: ControlConfig, path: Path) -> list[Trajectory]:
    files = [config.disturbances] if isinstance(config.disturbances, str) else config.disturbances
    return read_all(files, path.parent) if files else []


def _intervals(nodes: int) -> int:
    if nodes < 2:
        raise DfsmError(f"'nodes' is {nodes}, expected at least 2")
    return nodes - 1


def _initial(config: ControlConfig, model: DFSM, runs: Sequence[Trajectory]) -> dict[str, float]:
    if config.initial == "free":
        return {}
    if len(runs) != 1:
        raise DfsmError(
            f"'initial' is recorded, which needs one run in 'disturbances', not {len(runs)}: name "
            "one, or use free"
        )
    names = plant_of(model).names("states")
    states = initial_state(model, runs[0], config.horizon[0])
    return dict(zip(names, map(float, states), strict=True))


def _guess(problem: OptimalControlProblem, runs: Sequence[Trajectory]) -> Trajectory | None:
    """The recorded run is a good place to start, where it holds states or controls."""
    names = (*problem.plant.names("states"), *problem.plant.names("controls"))
    if len(runs) != 1 or not any(n in runs[0] for n in names):
        return None
    run = runs[0].select([n for n in names if n in runs[0]])
    return run.window(problem.start, problem.last_time)
