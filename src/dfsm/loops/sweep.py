"""Many controllers on many runs: what each would do to energy, loads and travel."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from dfsm.controllers.controller import Controller, require_controller, require_texts
from dfsm.controllers.discon import Discon
from dfsm.controllers.tunable import tunable
from dfsm.core.drawing import Drawn
from dfsm.core.files import json_value
from dfsm.core.settings import (
    require,
    require_kind,
    require_list,
    require_number,
    settings_class,
    shown,
)
from dfsm.core.types import Array
from dfsm.core.units import factor
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, hushed, missing
from dfsm.loops.extremes import Extreme, channel_maxima, long_term_extremes
from dfsm.loops.load_cases import (
    HOURS_PER_YEAR,
    Figures,
    LoadCases,
    case_figures,
    require_counted,
    require_shares,
    require_weights,
)
from dfsm.loops.sweep_journal import SweptLoop
from dfsm.loops.sweep_loops import SweepLoops
from dfsm.models.completion import completed
from dfsm.models.dfsm import DFSM
from dfsm.simulation.loop_cases import ClosedLoopSettings, checked_loops

if TYPE_CHECKING:
    import pandas as pd

# The record's own line among those of controllers.
RECORDED = "recorded"
AS_IT_IS = "as it is"


@settings_class
class SweepSettings:
    """What a sweep is about.

    Attributes
    ----------
    start, stop
        Time window in s that is scored.
    loop
        How loops are closed.
    power
        Output that is the electrical power, for the annual energy; None for none.
    speed, rated_speed
        State or output, and the value in its unit over which its maximum is the overshoot.
    extremes
        Channels whose largest value is extrapolated from the maxima of blocks.
    block
        Length of a block in s.
    years
        Time in which the extrapolated value is exceeded once, of which the weights are shares.
    """

    start: float | None = None
    stop: float | None = None
    loop: ClosedLoopSettings = ClosedLoopSettings()
    power: str | None = None
    speed: str | None = None
    rated_speed: float | None = None
    extremes: tuple[str, ...] = ()
    block: float = 60.0
    years: float = 50.0

    def __post_init__(self) -> None:
        for name in ("start", "stop"):
            require_number(name, getattr(self, name), "seconds, or None", optional=True)
        for name in ("power", "speed"):
            require_kind(name, getattr(self, name), str | None, "the name of a signal, or None")
        require_kind("loop", self.loop, ClosedLoopSettings, "dfsm.ClosedLoopSettings(…)")
        require_number("block", self.block, "seconds, more than 0", above=0)
        require_number("years", self.years, "more than 0", above=0)
        both = (self.speed is None) == (self.rated_speed is None)
        require(both, "rated_speed", self.rated_speed, "a value where speed is set, else none")
        require_number("rated_speed", self.rated_speed, "more than 0", above=0, optional=True)
        require_texts("extremes", self.extremes)


@dataclass(frozen=True)
class Swept:
    """One controller over all runs.

    Attributes
    ----------
    name
        Of the controller.
    runs
        Figures by channel of every run; None for a loop that ended early.
    endings
        One sentence per loop that ended early.
    figures
        Of all runs with their weights, by channel; empty if one ended early: what is left out
        would flatter it.
    energy
        Annual energy in MWh, of the share of the time that the weights stand for.
    overshoot
        Largest speed over the rated one, less 1.
    extremes
        Extrapolated largest values by channel.
    """

    name: str
    runs: tuple[Mapping[str, Figures] | None, ...]
    endings: tuple[str, ...]
    figures: Mapping[str, Figures]
    energy: float | None
    overshoot: float | None
    extremes: Mapping[str, Extreme] = field(default_factory=dict)


@dataclass(frozen=True)
class Sweep(Drawn):
    """Result of `sweep`.

    Attributes
    ----------
    controllers
        In the caller's order.
    recorded
        The same figures of the records, of channels that all of them hold.
    runs, weights
        Names of the runs and what each stands for.
    units
        By channel.
    """

    controllers: tuple[Swept, ...]
    recorded: Swept
    runs: tuple[str, ...]
    weights: tuple[float, ...]
    units: Mapping[str, str]

    def __repr__(self) -> str:
        made = f"{len(self.controllers)} controller{'s' * (len(self.controllers) != 1)}"
        runs = f"{len(self.runs)} run{'s' * (len(self.runs) != 1)}"
        return f"<Sweep: {made} over {runs}; table() has their figures>"

    def to_dict(self) -> dict[str, Any]:
        """JSON values: all figures."""
        values = {
            "format": 1,
            "runs": [
                {"name": n, "weight": w} for n, w in zip(self.runs, self.weights, strict=True)
            ],
            "units": dict(self.units),
            "controllers": [asdict(c) for c in self.controllers],
            "recorded": asdict(self.recorded),
        }
        return dict(json_value(values))

    def table(self, exponent: float = 4.0) -> pd.DataFrame:
        """One line per controller, and the record's: mean, std, travel and DEL of every channel.

        Parameters
        ----------
        exponent
            Wöhler exponent of the damage-equivalent loads.

        Raises
        ------
        DfsmError
            One for which no loads were counted.
        """
        import pandas as pd

        require_counted(exponent)
        lines = {}
        for swept in (self.recorded, *self.controllers):
            line: dict[str, float | None] = {
                "AEP (MWh)": swept.energy,
                "overshoot": swept.overshoot,
            }
            for name, f in swept.figures.items():
                line |= {f"{name} mean": f.mean, f"{name} std": f.std, f"{name} max": f.maximum}
                line |= {f"{name} travel": f.travel, f"{name} DEL": f.damage[f"{exponent:g}"]}
            for name, e in swept.extremes.items():
                line |= {f"{name} extreme": e.value, f"{name} extreme error": e.error}
            lines[swept.name] = line
        return pd.DataFrame.from_dict(lines, orient="index").dropna(axis=1, how="all")


def sweep(
    model: DFSM,
    runs: Sequence[Trajectory],
    controllers: Mapping[str, Controller],
    *,
    weights: Sequence[float] | None = None,
    conditions: Sequence[Hashable] | None = None,
    measurements: Mapping[str, str] | None = None,
    settings: SweepSettings | None = None,
    journal: str | PathLike[str] | None = None,
) -> Sweep:
    """Close the loop with every controller over every run.

    Controllers that differ in numbers only, a `ROSCO` with other gains say, share one compilation.

    Parameters
    ----------
    model, runs, measurements
        As for `closed_loop`.
    controllers
        By the name under which each is shown.
    weights
        Share of the time that each run stands for, see `weibull_weights`; equal by default.
    conditions
        What each run is a case of, its mean wind say: maxima of runs of one condition, which differ
        in their seeds, are those of one distribution. By default every run is a condition of its
        own, and the more there are, the further the luckiest fit carries the extremes.
    settings
        Time window, and which signals are power and speed.
    journal
        File that keeps what each loop gave as soon as it is closed. A later sweep with it closes
        only the loops that it lacks: a sweep that was ended goes on, and one with other runs or
        controllers takes over those that are the same. What belongs to another model, controller,
        run, time window or block is closed again. None keeps nothing.

    Returns
    -------
    Sweep

    Raises
    ------
    DfsmError
        As `closed_loop`; or weights that are not one positive number per run, or not shares of the
        time where energy or extremes are asked for, conditions that are not one per run, no
        controllers, one without a name or with the record's, a power or speed that the model does
        not have, or a journal that is something else.
    """
    require_kind("settings", settings, SweepSettings | None, "dfsm.SweepSettings(…)")
    settings = settings or SweepSettings()
    require_kind("controllers", controllers, Mapping, "controllers by name, {'as it is': …}")
    if not controllers:
        raise DfsmError("no controllers were given to sweep over, at least one is needed")
    for name in controllers:
        named = isinstance(name, str) and name not in ("", RECORDED)
        require(named, "the name of a controller", shown(name), f"a text, and not '{RECORDED}'")
    runs = checked_loops(model, runs, controllers, measurements)
    weights = [1 / len(runs)] * len(runs) if weights is None else weights
    require_weights(weights, len(runs))
    weights = [float(w) for w in weights]
    if settings.power is not None or settings.extremes:
        require_shares(weights)
    cases = LoadCases.of(weights, conditions)
    s = model.signals
    units = {c.name: c.unit for c in (*s.observed, *s.controls, *s.outputs)}
    named = [n for n in (settings.power, settings.speed, *settings.extremes) if n is not None]
    if lost := [n for n in named if n not in units]:
        raise DfsmError(f"settings: the model has {missing(lost, units)}")
    runs = [completed(run, s) for run in runs]
    asked = SweepLoops(model, runs, list(controllers.values()), measurements, settings)
    with hushed():
        rolled = asked.closed(journal)
    loops = dict(zip(controllers, rolled, strict=True))
    swept = tuple(_swept(n, loops[n], cases, settings, units) for n in controllers)
    recorded = _recorded(runs, rolled, cases, settings, units)
    return Sweep(swept, recorded, tuple(r.name for r in runs), tuple(weights), units)


def gain_grid(
    controller: Any, gains: Mapping[str, Sequence[float]], discon: Discon | None = None
) -> dict[str, Any]:
    """A controller as it is, and with every combination of some gains.

    Parameters
    ----------
    controller
        ROSCO in JAX, or an equinox module.
    gains
        Values by name, see `dfsm.controllers.tunable`.
    discon
        The DISCON.IN of ROSCO, where a name is one of its tuning parameters.

    Returns
    -------
    dict
        Controllers by what tells them apart: ``"omega_pc 0.2, zeta_pc 1"``.

    Raises
    ------
    DfsmError
        There is no such gain, or one without values, with one twice or that is no number.
    """
    require_controller(controller)
    require_kind("gains", gains, Mapping, "values by the name of a gain, {'kp': [1.0, 2.0]}")
    require_texts("names of gains", list(gains))
    texts = {name: _told_apart(name, values) for name, values in gains.items()}
    tuned, found = tunable(controller, gains, discon), {AS_IT_IS: controller}
    for values in product(*(by_text.items() for by_text in texts.values())) if gains else ():
        label = ", ".join(f"{n} {text}" for n, (text, _) in zip(gains, values, strict=True))
        found[label] = tuned.at(np.array([value for _, value in values]))
    return found


def _told_apart(name: str, values: Any) -> dict[str, float]:
    """Values of a gain by what tells them apart: six digits, or all where six are too few."""
    expected = f"a list of numbers, each once, as in {name}: [1.0, 2.0]"
    require_list(f"values of {name}", values, expected)
    require(len(values) > 0, f"values of {name}", "none", "at least one")
    for value in values:
        require_number(f"a value of {name}", value, expected)
    numbers = [float(value) for value in values]
    require(len(set(numbers)) == len(numbers), f"values of {name}", shown(values), expected)
    short = {f"{value:.6g}": value for value in numbers}
    return short if len(short) == len(numbers) else {f"{value!r}": value for value in numbers}


def _swept(
    name: str,
    loops: Sequence[SweptLoop],
    cases: LoadCases,
    settings: SweepSettings,
    units: Mapping[str, str],
) -> Swept:
    figures = tuple(loop.figures for loop in loops)
    endings = tuple(loop.ending for loop in loops if loop.ending is not None)
    swept = _over_all(name, figures, endings, cases.weights, settings, units)
    if endings:
        return swept
    return replace(swept, extremes=_extremes([lp.maxima for lp in loops], cases, settings))


def _extremes(
    maxima: Sequence[Mapping[str, Array]], cases: LoadCases, settings: SweepSettings
) -> dict[str, Extreme]:
    blocks = settings.years * HOURS_PER_YEAR * 3600 / settings.block
    return long_term_extremes(settings.extremes, maxima, cases, blocks)


def _recorded(
    runs: Sequence[Trajectory],
    rolled: Sequence[Sequence[SweptLoop]],
    cases: LoadCases,
    settings: SweepSettings,
    units: Mapping[str, str],
) -> Swept:
    """The record over the time that is scored."""
    names = [n for n in units if all(n in run for run in runs)]
    figures, maxima = [], []
    for i, run in enumerate(runs):
        done = [loops[i].span for loops in rolled if loops[i].ending is None]
        part = run.window(*(done[0] if done else _scored(run, settings))).select(names)
        figures.append(case_figures(part))
        maxima.append(channel_maxima(part, settings.extremes, settings.block))
    swept = _over_all(RECORDED, tuple(figures), (), cases.weights, settings, units)
    return replace(swept, extremes=_extremes(maxima, cases, settings))


def _scored(run: Trajectory, settings: SweepSettings) -> tuple[float, float | None]:
    """What would have been scored of a run whose loops all ended early."""
    begins, start_up = float(run.time[0]), settings.loop.start_up
    if settings.start is not None:
        begins = max(begins, settings.start - start_up)
    return begins + start_up, settings.stop


def _over_all(
    name: str,
    runs: tuple[Mapping[str, Figures] | None, ...],
    endings: tuple[str, ...],
    weights: Sequence[float],
    settings: SweepSettings,
    units: Mapping[str, str],
) -> Swept:
    whole = [run for run in runs if run is not None]
    figures: dict[str, Figures] = {}
    if len(whole) == len(runs):
        figures = {n: Figures.over([run[n] for run in whole], weights) for n in whole[0]}
    energy = overshoot = None
    if settings.power in figures:
        kilowatts = factor(units[settings.power], "kW")
        if kilowatts is None:
            raise DfsmError(
                f"power: '{settings.power}' is in '{units[settings.power]}', expected a power "
                "(W, kW or MW): name another channel"
            )
        mean = figures[settings.power].mean * kilowatts
        energy = mean * sum(weights) * HOURS_PER_YEAR / 1e3
    if settings.speed in figures and settings.rated_speed is not None:
        overshoot = figures[settings.speed].maximum / settings.rated_speed - 1
    return Swept(name, runs, endings, figures, energy, overshoot)
