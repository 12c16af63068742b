"""Time marching of a surrogate: fixed-step RK4, or diffrax's adaptive and stiff solvers.

A rollout is driven by controls, disturbances, parameters and the initial state, nothing else.
"""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args, overload

import numpy as np
from numpy.typing import ArrayLike

from dfsm.core.renamed import renamed
from dfsm.core.settings import settings_class
from dfsm.core.types import Array
from dfsm.core.workers import in_threads
from dfsm.data.between import Chosen
from dfsm.data.derivatives import differentiate
from dfsm.data.features import guessed_ends
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.completion import all_completed, completed
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.recorded import recorded_states
from dfsm.models.signals import require_constant, require_field
from dfsm.simulation.fastest import REACH, fastest_rates
from dfsm.simulation.hidden import latents_from_past, told_state
from dfsm.simulation.integrate import Case, Drive, Rollout, adapt, mesh_of, pieces_of
from dfsm.simulation.march import march
from dfsm.simulation.outcome import Simulation, Status, judge, tell

__all__ = [
    "METHODS",
    "Method",
    "Simulation",
    "SimulationSettings",
    "Status",
    "initial_azimuth",
    "initial_state",
    "simulate",
]

# Rates at the start are taken from this much of the record before it (or, where the record starts
# there, just after it): long enough for a derivative, too short to leak a response.
_HISTORY = 5.0
_HISTORY_SAMPLES = 100
_HEAD = 1.0
_HEAD_SAMPLES = 20
# Times as many RK4 steps from which a stiff method takes their place, and beyond which none would
# get anywhere.
_SWITCHED, _HOPELESS = 100, 1e6


Method = Literal["rk4", "tsit5", "kvaerno5"]
METHODS: tuple[str, ...] = get_args(Method)


@settings_class
class SimulationSettings:
    """How to march in time.

    Attributes
    ----------
    method
        ``"rk4"``: classical Runge-Kutta with fixed steps. ``"tsit5"``: adaptive explicit
        (Tsitouras 2011). ``"kvaerno5"``: adaptive, for stiff models (Kværnø 2004).
    step
        Largest step of ``"rk4"`` in s; None takes the run's own samples. Where the model moves too
        fast for it, steps are shorter, or the method is ``"kvaerno5"``, and that is told.
    rtol, atol
        Tolerances of the adaptive methods; `atol` is relative to each state's training spread.
    interpolation
        Inputs between samples: ``"hold"``, ``"linear"`` or ``"cubic"`` spline, for all or by name;
        None does as the model does.
    """

    method: Method = "rk4"
    step: float | None = None
    rtol: float = 1e-6
    atol: float = 1e-8
    interpolation: Chosen = field(default=None, hash=False)

    def __post_init__(self) -> None:
        if self.step is not None and not self.step > 0:
            raise DfsmError(f"the simulation step is {self.step} s, expected more than 0")


@overload
def simulate(
    model: DFSM,
    runs: Trajectory,
    *,
    start: float | None = None,
    stop: float | None = None,
    initial: ArrayLike | None = None,
    settings: SimulationSettings | None = None,
) -> Simulation: ...
@overload
def simulate(
    model: DFSM,
    runs: Sequence[Trajectory],
    *,
    start: float | None = None,
    stop: float | None = None,
    initial: ArrayLike | None = None,
    settings: SimulationSettings | None = None,
) -> list[Simulation]: ...
@renamed(options="settings")
def simulate(
    model: DFSM,
    runs: Trajectory | Sequence[Trajectory],
    *,
    start: float | None = None,
    stop: float | None = None,
    initial: ArrayLike | None = None,
    settings: SimulationSettings | None = None,
) -> Simulation | list[Simulation]:
    """Simulate a surrogate with the inputs of one run, or of many at once.

    Parameters
    ----------
    model
        The surrogate.
    runs
        Trajectories that hold the model's controls, disturbances and parameters, and its measured
        states unless there is `initial`; those of a model with `Azimuth.rings` also the azimuth and
        the harmonics of the wind field. Samples before `start` serve only for the initial rates.
    start, stop
        Time window in s; None leaves that end open.
    initial
        Initial states, shape ``(state,)`` or one row per run, all of them or all but the latent
        ones; None takes the recorded state at `start`. Latent states follow from the inputs
        recorded before `start`.
    settings
        Integration method and steps.

    Returns
    -------
    Simulation or list of Simulation
        In the order of `runs`.

    Raises
    ------
    DfsmError
        A channel is missing, not finite or of another dimension than the model's, a parameter
        varies within a run, the window is too short, or the step too small for it.

    Warns
    -----
    DfsmWarning
        Channels were converted to the model's units, a rollout was outside the training range for
        part of the time, took shorter steps than asked for, or ended early.
    """
    require_model(model)
    settings = settings or SimulationSettings()
    single = isinstance(runs, Trajectory)
    batch = [runs] if isinstance(runs, Trajectory) else list(runs)
    batch = all_completed(batch, model.signals)
    if not batch:
        raise DfsmError("no runs were given to simulate")
    names = model.signals.exogenous
    for run in batch:
        run.columns((*names, *(model.signals.measured if initial is None else ())))
        require_field(run, model.signals.azimuth)
    field = model.signals.names("field")
    fields = [r.select(field).window(start, stop).require_finite() for r in batch if field]
    driven = in_threads(lambda r: r.select(names).window(start, stop).require_finite(), batch)
    for run in driven:
        require_constant(run, model.signals.names("parameters"))
    starts = None if initial is None else _starts(model, initial, len(batch))

    between = model.signals.between_samples(settings.interpolation)

    def case(i: int, drive: Drive) -> Case[Drive]:
        begins = float(driven[i].time[0])
        tell = told_state if model.signals.startup else _observed_state
        x0 = tell(model, batch[i], begins) if starts is None else starts[i]
        if len(x0) < len(model.signals.states):
            x0 = np.concatenate([x0, latents_from_past(model, batch[i], begins, x0)])
        turned = (fields[i] if fields else driven[i].select(())).values
        return Case(drive, x0, initial_azimuth(model, batch[i], begins), turned)

    def judged(i: int, rollout: Rollout) -> Simulation:
        result = judge(model, batch[i], driven[i], rollout)
        time = driven[i].time
        guessed = guessed_ends(batch[i], model.signals.features, (time[0], time[-1]))
        return replace(result, note=steps[i].note, guessed=guessed)

    begin = clock.perf_counter()
    steps = _steppings(model, driven, settings)
    tolerances = (settings.rtol, settings.atol)
    fixed = [i for i, step in enumerate(steps) if step.method == "rk4"]
    meshes = {i: mesh_of(driven[i], steps[i].largest, between) for i in fixed}

    def adapted(i: int) -> Simulation:
        one = case(i, pieces_of(driven[i], between))
        return judged(i, adapt(model, one, steps[i].method, tolerances))

    marched = march(
        model,
        list(meshes.values()),
        lambda k: case(fixed[k], meshes[fixed[k]]),
        lambda k, rollout: judged(fixed[k], rollout),
    )
    found = dict(zip(fixed, marched, strict=True))
    results = [found[i] if i in found else adapted(i) for i in range(len(batch))]
    wall = (clock.perf_counter() - begin) / len(batch)
    results = [replace(r, wall_time=wall) for r in results]
    tell(results)
    return results[0] if single else results


@dataclass(frozen=True)
class _Stepping:
    """How one run is marched: the method, the largest step of RK4 in s, and what is to be told."""

    method: str
    largest: float | None
    note: str = ""


def _steppings(
    model: DFSM, driven: Sequence[Trajectory], settings: SimulationSettings
) -> list[_Stepping]:
    """Steps that RK4 can take with this model; very many of them are left to a stiff method."""
    if settings.method != "rk4":
        return [_Stepping(settings.method, settings.step)] * len(driven)
    asked, own = settings.step, model.signals.step
    if asked is not None and own is not None and asked > own * (1 + 1e-6):
        told = f"integrated in steps of {asked:g} s, but the model was made for steps of {own:g} s"
        note = f"{told}: its errors are not those of the fit"
        return [_Stepping("rk4", asked, note)] * len(driven)
    settings = replace(settings, step=own if asked is None else asked)
    rates = fastest_rates(model, [run.values for run in driven])
    return [_stepping(run, rate, settings) for run, rate in zip(driven, rates, strict=True)]


def _stepping(driven: Trajectory, rate: float, settings: SimulationSettings) -> _Stepping:
    asked = settings.step
    longest = float(np.diff(driven.time).max())
    step = longest if asked is None else min(asked, longest)
    parts = rate * step / REACH
    if not 1 + 1e-9 < parts < _HOPELESS:  # beyond, no method would get anywhere
        return _Stepping("rk4", asked)
    why = f"{step:.3g} s are too long for RK4 with the model's fastest eigenvalue, {rate:.3g} 1/s"
    if parts > _SWITCHED:
        return _Stepping("kvaerno5", asked, f"integrated by kvaerno5: steps of {why}")
    return _Stepping("rk4", step / parts, f"integrated in steps of {step / parts:.3g} s: {why}")


def initial_state(model: DFSM, run: Trajectory, start: float, *, complete: bool = True) -> Array:
    """Recorded state at `start`; rates come from samples up to it, never from the response after.

    Parameters
    ----------
    model
        The surrogate, for its states and its way of taking derivatives.
    run
        Holds the measured states, and for latent states controls and disturbances.
    start
        Time in s. Where the record begins there, the first second of it gives the rates.
    complete
        Whether the run is still to be `completed`.

    Returns
    -------
    ndarray
        Shape ``(state,)``.
    """
    run = completed(run, model.signals) if complete else run
    if model.signals.startup:
        return told_state(model, run, start)
    observed = _observed_state(model, run, start)
    return np.concatenate([observed, latents_from_past(model, run, start, observed)])


def _starts(model: DFSM, initial: ArrayLike, runs: int) -> Array:
    """Initial states of every run, ``(run, state)``, with the latent ones or without."""
    starts, s = np.asarray(initial, dtype=np.float64), model.signals
    lengths = (len(s.states), len(s.observed)) if s.latents else (len(s.states),)
    shapes = [shape for n in lengths for shape in ((n,), (runs, n))]
    if starts.shape not in shapes:
        raise DfsmError(
            f"initial has shape {starts.shape}, expected {' or '.join(map(str, shapes))}"
        )
    return np.broadcast_to(starts, (runs, starts.shape[-1]))


def _observed_state(model: DFSM, run: Trajectory, start: float) -> Array:
    s = model.signals
    measured = [n for spec in s.specs for n in (spec.name, spec.rate) if n is not None]
    specs = [replace(spec, acceleration=None) for spec in s.specs]
    driving = [n for n in s.exogenous if n not in measured and n in run]
    run = run.select(dict.fromkeys((*measured, *driving)))
    if all(spec.order == 1 or spec.rate for spec in specs):
        index = int(np.argmin(np.abs(run.time - start)))
        # Two samples make a trajectory, whose check says which channel is not finite and when.
        near = slice(max(0, index - 1), index + 1) if index else slice(0, 2)
        near_by = replace(run, time=run.time[near], values=run.values[near])
        near_by.select(dict.fromkeys(measured)).require_finite()
        values = dict(zip(run.names, run.values[index], strict=True))
        rates = [values[spec.rate] for spec in specs if spec.rate and spec.order == 2]
        return np.array([values[spec.name] for spec in specs] + rates)
    now = int(np.searchsorted(run.time, start, side="right"))
    if now >= _HEAD_SAMPLES:
        first = min(start - _HISTORY, float(run.time[max(0, now - _HISTORY_SAMPLES)]))
        piece, row = run.window(first, start), -1
    else:
        head = max(start + _HEAD, float(run.time[min(len(run), _HEAD_SAMPLES) - 1]))
        piece, row = run.window(start, head), 0
    piece.select(dict.fromkeys(measured)).require_finite()
    if "hold" in s.between and len(driving) == len(s.exogenous) and not s.latents:
        seen = recorded_states(model, piece)
        return seen.trajectory.select(seen.found.names).values[row]
    extracted = differentiate(piece, specs, s.derivatives)
    return extracted.trajectory.select(extracted.names).values[row]


def initial_azimuth(model: DFSM, run: Trajectory, start: float) -> float:
    """Recorded azimuth at `start` in rad; 0 where no channel holds it."""
    azimuth = model.signals.azimuth
    if azimuth is None or azimuth.angle is None or azimuth.angle not in run:
        return 0.0
    return float(np.deg2rad(run[azimuth.angle][int(np.argmin(np.abs(run.time - start)))]))
