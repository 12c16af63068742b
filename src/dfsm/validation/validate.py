"""Validation on runs that the fit never saw (Sec. 3.8).

Every model is simulated with the recorded inputs of every test run, from the recorded state at
the start of the window. States and outputs are then compared along the model's own rollout.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dfsm.core.progress import track
from dfsm.core.renamed import renamed
from dfsm.core.types import Array
from dfsm.core.units import factor
from dfsm.data.conversion import converted
from dfsm.data.features import known_window
from dfsm.data.suspects import stray_notes
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, hushed
from dfsm.models.completion import all_completed
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.recorded import Recorded, recorded_states
from dfsm.models.signals import Azimuth, radians_per_second
from dfsm.numerics.fatigue import damage_by_exponent
from dfsm.numerics.spectra import Band, spectrum
from dfsm.numerics.time_mesh import mean_over, std_over, weights_over_time
from dfsm.simulation.hidden import latents_along
from dfsm.simulation.simulate import Simulation, SimulationSettings, Status, simulate
from dfsm.validation.intervals import Intervals
from dfsm.validation.results import (
    MULTI_FIDELITY,
    ChannelError,
    ChannelStatistics,
    Histogram,
    ModelRun,
    RunComparison,
    Validation,
    training_spreads,
)

# Frequency ranges in Hz in which peaks are compared; blade passing is added where a rotor speed
# is among the states.
PLATFORM = Band("platform", 0.005, 0.06)
WAVE = Band("wave", 0.06, 0.25)
LOW = Band("0-0.3 Hz", 0.0, 0.3)
_BINS = 60
_EXOGENOUS = ("controls", "disturbances", "parameters")


@renamed(options="settings")
def validate(
    models: DFSM | Mapping[str, DFSM],
    runs: Iterable[Trajectory],
    *,
    start: float | None = None,
    stop: float | None = None,
    settings: SimulationSettings | None = None,
    intervals: Intervals | None = None,
) -> Validation:
    """Compare models with recorded test runs.

    Parameters
    ----------
    models
        One model (its linear fit is compared beside it), or several by name; they share states
        and outputs.
    runs
        Test runs with all channels of the models, outputs included.
    start, stop
        Test window in s. What lies before `start` only serves to find the initial rates.
    settings
        How the models are simulated.
    intervals
        Prediction intervals of the model named ``"multi-fidelity"``, as for one model alone.

    Returns
    -------
    Validation

    Raises
    ------
    DfsmError
        No runs, a channel that a run lacks, or intervals of another model.
    """
    if not isinstance(models, Mapping):
        require_model(models, "models")
        models = compared(models)
    for name, model in models.items():
        require_model(model, f"models['{name}']")
    first = next(iter(models.values()))
    if intervals is not None:
        if MULTI_FIDELITY not in models:
            raise DfsmError(
                f"the intervals are of the model '{MULTI_FIDELITY}', but the models are "
                f"{', '.join(models)}: give it that name, or leave the intervals out"
            )
        intervals.check(models[MULTI_FIDELITY])
    given = list(runs)
    with hushed():  # the result tells
        runs = all_completed(given, first.signals)
    if not runs:
        raise DfsmError("no test runs were given, at least one is needed")
    for run in runs:
        run.columns(first.signals.recorded)
    notes = [*converted(given, runs), *_leaks(first, runs, intervals)]
    for run in runs:
        notes += stray_notes(run.window(start, stop), first.signals.recorded)
    results, late, early = list[RunComparison](), list[str](), list[str]()
    for run in track(runs, "test runs"):
        known, until = known_window(run, first.signals.features, start, stop)
        results.append(_compare(models, run, (known, until), settings, intervals))
        if known != start:
            late.append(
                f"{run.where}: compared from {known:g} s on, for what acts there with a delay was "
                "not recorded before"
            )
        if until != stop:
            early.append(
                f"{run.where}: compared up to {until:g} s, for what acts there ahead of its record "
                "was not recorded after"
            )
    stepped = [
        f"{name} on {r.recorded.name}: {m.simulation.note}"
        for r in results
        for name, m in r.models.items()
        if m.simulation.note
    ]
    if stepped:
        more = f" (and {len(stepped) - 1} more rollouts alike)" if stepped[1:] else ""
        notes.append(stepped[0] + more)
    for told in (late, early):
        if told:
            alike = f" (and {len(told) - 1} more runs alike)" if told[1:] else ""
            notes.append(told[0] + alike)
    channels = (*first.signals.observed, *first.signals.outputs)
    validation = Validation(
        models=dict(models),
        channels=channels,
        runs=tuple(results),
        histograms={c.name: _histogram(results, c.name, list(models)) for c in channels},
        eigenvalues=first.eigenvalues(),
        record=first.provenance.record,
        warnings=tuple(notes),
        intervals=intervals,
    )
    return replace(validation, warnings=(*notes, *validation.still()))


def compared(model: DFSM, nonlinear: DFSM | None = None) -> dict[str, DFSM]:
    """The models that belong side by side (Figs. 5, 6): linear fit, multi-fidelity, nonlinear.

    Parameters
    ----------
    model
        The multi-fidelity model; its linear fit comes first.
    nonlinear
        The nonlinear-only model, if there is one.
    """
    variants = {"linear-fit": model.linear_fit(), MULTI_FIDELITY: model}
    if nonlinear is not None:
        variants["nonlinear-only"] = nonlinear
    return variants


def _compare(
    models: Mapping[str, DFSM],
    run: Trajectory,
    window: tuple[float | None, float | None],
    settings: SimulationSettings | None,
    intervals: Intervals | None,
) -> RunComparison:
    first = next(iter(models.values()))
    s = first.signals
    seen = recorded_states(first, run, window[0])
    inside = seen.trajectory.window(*window)
    recorded = recorded_channels(first, run.window(*window), inside)
    bands = frequency_bands(first, recorded)
    weights = weights_over_time([recorded.time])
    usual = training_spreads(first)
    results = {}
    for name, model in models.items():
        simulation = _simulate_warm(model, run, window, settings)
        errors: dict[str, ChannelError] = {}
        statistics: dict[str, ChannelStatistics] = {}
        band, coverage = None, {}
        if simulation.status is Status.COMPLETED:
            for c in recorded.channels:
                rollout, true = simulation.trajectory[c.name], recorded[c.name]
                error = ChannelError.of(rollout, true, weights)
                errors[c.name] = error.unless_still(true, usual.get(c.name, 0.0))
            statistics = all_statistics(simulation.trajectory, bands, s.names("outputs"))
            if intervals is not None and name == MULTI_FIDELITY:
                band = intervals.around(simulation, run)
                shares = intervals.coverage(simulation, run, recorded)
                coverage = dict(zip(intervals.channels, shares.tolist(), strict=True))
        results[name] = ModelRun(
            simulation=simulation,
            errors=errors,
            statistics=statistics,
            derivative_errors=_derivative_errors(model, run, seen, inside.time),
            band=band,
            coverage=coverage,
        )
    return RunComparison(
        recorded=recorded,
        statistics=all_statistics(recorded, bands, s.names("outputs")),
        models=results,
        parameters={name: float(inside[name][0]) for name in s.names("parameters")},
    )


def _simulate_warm(
    model: DFSM,
    run: Trajectory,
    window: tuple[float | None, float | None],
    settings: SimulationSettings | None,
) -> Simulation:
    """Simulate twice: the first call may compile, the second tells what a simulation costs."""
    with hushed():
        simulate(model, run, start=window[0], stop=window[1], settings=settings)
        return simulate(model, run, start=window[0], stop=window[1], settings=settings)


def recorded_channels(model: DFSM, run: Trajectory, differentiated: Trajectory) -> Trajectory:
    """States and outputs to compare with: measured ones as recorded, rates as extracted."""
    channels = (*model.signals.observed, *model.signals.outputs)
    names = [c.name for c in channels]
    values = [run[n] if n in run else differentiated[n] for n in names]
    return Trajectory(
        run.time,
        np.stack(values, axis=1),
        channels,
        name=run.name,
        source=run.source,
        wall_time=run.wall_time,
    )


def _derivative_errors(
    model: DFSM, run: Trajectory, seen: Recorded, time: Array
) -> dict[str, float]:
    """NRMSE of derivatives along the record: at samples, or over intervals where inputs jump."""
    s, rows = model.signals, np.isin(seen.trajectory.time, time)
    if means := seen.mean_rows(rows):
        inputs, extracted, weights = means
        x, *exogenous = model.split(inputs)
    else:
        inside = seen.trajectory.window(time[0], time[-1])
        states = inside.select(c.name for c in s.observed).values
        x = np.concatenate([states, latents_along(model, run)[np.isin(run.time, time)]], axis=1)
        exogenous = [inside.select(s.names(g)).values for g in _EXOGENOUS]
        extracted = seen.found.derivatives[rows]
        weights = weights_over_time([inside.time])
    predicted = np.asarray(model.derivative(x, *exogenous))[:, : len(s.observed)]
    rms = np.sqrt(mean_over((predicted - extracted) ** 2, weights))
    spread = np.maximum(std_over(extracted, weights), np.finfo(float).tiny)
    names = [c.name for c in s.observed]
    return dict(zip(names, (rms / spread).tolist(), strict=True))


def frequency_bands(model: DFSM, recorded: Trajectory) -> tuple[Band, ...]:
    """Platform and wave bands, and ± 20 % around the mean blade-passing frequency.

    Without `Azimuth` settings a state in rpm is taken for the speed of a three-bladed rotor.
    """
    azimuth = model.signals.azimuth
    if azimuth is None:
        speeds = [c.name for c in model.signals.states if factor(c.unit, "rpm") == 1]
        azimuth = Azimuth(speed=speeds[0]) if speeds else None
    if azimuth is None:
        return PLATFORM, WAVE, LOW
    speed = mean_over(recorded[azimuth.speed], weights_over_time([recorded.time]))
    omega = float(speed) * radians_per_second(recorded.channel(azimuth.speed))
    passing = azimuth.blades * omega / (2 * np.pi)
    return PLATFORM, WAVE, Band(f"{azimuth.blades}P", 0.8 * passing, 1.2 * passing), LOW


def all_statistics(
    run: Trajectory, bands: Sequence[Band], loads: Sequence[str]
) -> dict[str, ChannelStatistics]:
    """Statistics of all channels of a run; damage-equivalent loads of those named in `loads`."""
    if run.time_step is None:
        # Spectra need an equidistant mesh; the median step keeps what the samples resolve, unless
        # most of them stand for next to no time.
        step = max(float(np.median(np.diff(run.time))), run.duration / (len(run) - 1))
        run = run.resample(np.arange(run.time[0], run.time[-1], step))
    return {c.name: _statistics(run, c.name, bands, c.name in loads) for c in run.channels}


def _statistics(
    run: Trajectory, name: str, bands: Sequence[Band], is_load: bool
) -> ChannelStatistics:
    values = run[name]
    psd = spectrum(run.time, values)
    return ChannelStatistics(
        minimum=float(values.min()),
        mean=float(values.mean()),
        maximum=float(values.max()),
        std=float(values.std()),
        peaks={b.name: psd.peak(b) for b in bands if b is not LOW},
        power={b.name: psd.power(b) for b in bands},
        damage=damage_by_exponent(values, run.duration) if is_load else {},
        spectrum=psd,
    )


def _histogram(runs: Sequence[RunComparison], channel: str, models: Sequence[str]) -> Histogram:
    """Errors between common edges that hold 99.5 % of them, over runs that all models completed.

    A model that completed no run has no say in which runs those are, and no counts.
    """
    models = [m for m in models if any(channel in r.models[m].errors for r in runs)]
    common = [r for r in runs if all(channel in r.models[m].errors for m in models)]
    errors = {
        m: np.concatenate(
            [np.empty(0)]
            + [r.models[m].simulation.trajectory[channel] - r.recorded[channel] for r in common]
        )
        for m in models
    }
    pooled = np.concatenate([np.empty(0), *errors.values()])
    limit = float(np.percentile(np.abs(pooled), 99.5)) if len(pooled) else 1.0
    edges = np.linspace(-limit, limit, _BINS + 1) if limit > 0 else np.linspace(-1, 1, _BINS + 1)
    counts = {m: np.histogram(np.clip(e, edges[0], edges[-1]), edges)[0] for m, e in errors.items()}
    return Histogram(edges, counts)


def of_the_fit(model: DFSM, runs: Sequence[Trajectory]) -> list[str]:
    """Where the runs come from that the fit or the refinement knows."""
    record = model.provenance.record
    names, known = record.get("channels", []), {d["sha256"] for d in record.get("data", [])}
    return [r.where for r in runs if all(n in r for n in names) and r.select(names).digest in known]


def listed(names: Sequence[str]) -> str:
    """The first three names, for a sentence."""
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


def _leaks(model: DFSM, runs: Sequence[Trajectory], intervals: Intervals | None) -> list[str]:
    """Test runs that were in the training data, or that intervals were calibrated on."""
    notes = []
    if seen := of_the_fit(model, runs):
        notes.append(
            f"{len(seen)} of the {len(runs)} test runs were used in training ({listed(seen)}): "
            "their errors say little about new runs"
        )
    if intervals is None:
        return notes
    recorded = model.signals.recorded
    used = [r.where for r in runs if r.select(recorded).digest in intervals.digests]
    if used:
        notes.append(
            f"{len(used)} of the {len(runs)} test runs calibrated the intervals ({listed(used)}): "
            "how often they lie inside says little about new runs"
        )
    return [*notes, *(f"intervals: {text}" for text in intervals.warnings)]
