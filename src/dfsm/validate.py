"""Validation on runs that the fit never saw (Sec. 3.8).

Every model is simulated with the recorded inputs of every test run, from the recorded state at
the start of the window. States and outputs are then compared along the model's own rollout.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from dfsm.derivatives import differentiate
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fatigue import WOHLER_EXPONENTS, damage_equivalent_load
from dfsm.model import DFSM
from dfsm.progress import track
from dfsm.signals import Azimuth, radians_per_second, with_corrected_wind
from dfsm.simulate import Simulation, SimulationSettings, Status, simulate
from dfsm.spectra import Band, Spectrum, spectrum
from dfsm.trajectory import Channel, Trajectory
from dfsm.types import Array, ComplexArray

# Frequency ranges in Hz in which peaks are compared; blade passing is added where a rotor speed
# is among the states.
PLATFORM = Band("platform", 0.005, 0.06)
WAVE = Band("wave", 0.06, 0.25)
LOW = Band("0-0.3 Hz", 0.0, 0.3)
_BINS = 60


@dataclass(frozen=True)
class ChannelStatistics:
    """One signal of one run: figures that stand on their own, without a comparison.

    Attributes
    ----------
    minimum, mean, maximum, std
        In the channel's unit.
    peaks
        Peak frequency in Hz per band; None where the band holds no bin.
    power
        Variance per band in the unit squared; band ``0-0.3 Hz`` is always there.
    damage
        1 Hz damage-equivalent load per Wöhler exponent, outputs only.
    spectrum
        Welch's power spectral density.
    """

    minimum: float
    mean: float
    maximum: float
    std: float
    peaks: Mapping[str, float | None]
    power: Mapping[str, float]
    damage: Mapping[str, float]
    spectrum: Spectrum


@dataclass(frozen=True)
class ChannelError:
    """Error of a simulated signal against the recorded one.

    Attributes
    ----------
    rmse, maximum
        In the channel's unit.
    nrmse
        RMSE divided by the standard deviation of the recorded signal; infinite for a constant.
    """

    rmse: float
    nrmse: float
    maximum: float


@dataclass(frozen=True)
class ModelRun:
    """One model on one test run.

    Attributes
    ----------
    simulation
        The rollout.
    errors, statistics
        Per channel; empty for a rollout that ended early, whose figures would flatter it.
    derivative_errors
        NRMSE of each state derivative along the recorded trajectory, by state name.
    """

    simulation: Simulation
    errors: Mapping[str, ChannelError]
    statistics: Mapping[str, ChannelStatistics]
    derivative_errors: Mapping[str, float]


@dataclass(frozen=True)
class RunComparison:
    """A test run and what every model made of it.

    Attributes
    ----------
    recorded
        The recorded states (smoothed as in the fit) and outputs in the test window.
    statistics
        Of the recorded channels.
    models
        By model name.
    """

    recorded: Trajectory
    statistics: Mapping[str, ChannelStatistics]
    models: Mapping[str, ModelRun]


@dataclass(frozen=True)
class Histogram:
    """Pointwise errors of one channel over all test runs: counts between `edges`."""

    edges: Array
    counts: Mapping[str, Array]


@dataclass(frozen=True)
class Validation:
    """Everything that a report shows.

    Attributes
    ----------
    models
        The models compared, by name, in the order shown.
    channels
        States and outputs, in the order shown.
    runs
        Test runs in the order given.
    histograms
        Per channel, over the runs that all models completed which completed any.
    eigenvalues
        Of the linear fit, per schedule point.
    record
        Provenance of the model: settings, data, rows, seconds.
    warnings
        What a reader should know before trusting the figures.
    """

    models: Mapping[str, DFSM]
    channels: tuple[Channel, ...]
    runs: tuple[RunComparison, ...]
    histograms: Mapping[str, Histogram]
    eigenvalues: Sequence[tuple[float, ComplexArray]]
    record: Mapping[str, Any]
    warnings: tuple[str, ...] = field(default=())

    def mean_nrmse(self, model: str, channel: str) -> float | None:
        """Mean NRMSE over the test runs; None if the model did not complete all of them."""
        return self.mean_error(model, channel, "nrmse")

    def mean_error(self, model: str, channel: str, what: str) -> float | None:
        """Mean of one figure of `ChannelError` over the test runs, as `mean_nrmse`."""
        found = [r.models[model].errors.get(channel) for r in self.runs]
        values = [getattr(e, what) for e in found if e is not None]
        return float(np.mean(values)) if len(values) == len(self.runs) else None

    def endings(self) -> list[str]:
        """One sentence per rollout that ended early."""
        return [
            f"{name} on {r.recorded.name}: {m.simulation.reason}"
            for r in self.runs
            for name, m in r.models.items()
            if m.simulation.status is not Status.COMPLETED
        ]

    def completed(self, model: str) -> int:
        """Number of test runs that a model simulated to the end."""
        return sum(r.models[model].simulation.status is Status.COMPLETED for r in self.runs)

    def wall_time(self, model: str) -> float:
        """Mean wall time per rollout in s, compiled; one that ended early costs no less."""
        return float(np.mean([r.models[model].simulation.wall_time for r in self.runs]))

    def speed_up(self, model: str) -> float | None:
        """Recorded wall time of the simulator over that of the model, if the runs carry it."""
        times = [r.recorded.wall_time for r in self.runs]
        known = [t for t in times if t is not None]
        if len(known) < len(times):
            return None
        return float(np.mean(known)) / self.wall_time(model)

    def to_dict(self) -> dict[str, Any]:
        """JSON values: all figures, without time series and spectra; None where not finite."""
        values = {
            "format": 1,
            "channels": [{"name": c.name, "unit": c.unit, "role": c.role} for c in self.channels],
            "models": {name: self._model_dict(name) for name in self.models},
            "runs": [_run_dict(r) for r in self.runs],
            "histograms": {
                name: {
                    "edges": h.edges.tolist(),
                    "counts": {m: c.tolist() for m, c in h.counts.items()},
                }
                for name, h in self.histograms.items()
            },
            "eigenvalues": [
                {"schedule": s, "real": v.real.tolist(), "imag": v.imag.tolist()}
                for s, v in self.eigenvalues
            ],
            "warnings": list(self.warnings),
            "provenance": self.record,
        }
        return _without_infinities(values)

    def _model_dict(self, name: str) -> dict[str, Any]:
        return {
            "completed": self.completed(name),
            "of": len(self.runs),
            "mean_nrmse": {c.name: self.mean_nrmse(name, c.name) for c in self.channels},
            "wall_time_s": self.wall_time(name),
            "speed_up": self.speed_up(name),
        }


def validate(
    models: DFSM | Mapping[str, DFSM],
    runs: Iterable[Trajectory],
    *,
    start: float | None = None,
    stop: float | None = None,
    options: SimulationSettings | None = None,
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
    options
        How the models are simulated.

    Returns
    -------
    Validation

    Raises
    ------
    DfsmError
        No runs, or a channel that a run lacks.
    """
    if isinstance(models, DFSM):
        models = compared(models)
    first = next(iter(models.values()))
    runs = [with_corrected_wind(r, first.signals.hub_height) for r in runs]
    if not runs:
        raise DfsmError("no test runs were given, at least one is needed")
    notes = _leaks(first, runs)
    results = []
    for run in track(runs, "test runs"):
        results.append(_compare(models, run, (start, stop), options))
    channels = (*first.signals.states, *first.signals.outputs)
    return Validation(
        models=dict(models),
        channels=channels,
        runs=tuple(results),
        histograms={c.name: _histogram(results, c.name, list(models)) for c in channels},
        eigenvalues=first.eigenvalues(),
        record=first.provenance.record,
        warnings=tuple(notes),
    )


def compared(model: DFSM, nonlinear: DFSM | None = None) -> dict[str, DFSM]:
    """The models that belong side by side (Figs. 5, 6): linear fit, multi-fidelity, nonlinear.

    Parameters
    ----------
    model
        The multi-fidelity model; its linear fit comes first.
    nonlinear
        The nonlinear-only model, if there is one.
    """
    found = {"linear-fit": model.linear_fit(), "multi-fidelity": model}
    if nonlinear is not None:
        found["nonlinear-only"] = nonlinear
    return found


def _compare(
    models: Mapping[str, DFSM],
    run: Trajectory,
    window: tuple[float | None, float | None],
    options: SimulationSettings | None,
) -> RunComparison:
    first = next(iter(models.values()))
    s = first.signals
    found = differentiate(run, s.specs, s.derivatives)
    inside = found.trajectory.window(*window)
    rows = np.isin(found.trajectory.time, inside.time)
    recorded = _recorded(first, run.window(*window), inside)
    bands = frequency_bands(first, recorded)
    inputs = inside.select([c.name for c in s.inputs]).values
    results = {}
    for name, model in models.items():
        simulation = _simulate_warm(model, run, window, options)
        predicted = np.asarray(model.derivative(*model.split(inputs)))
        errors: dict[str, ChannelError] = {}
        statistics: dict[str, ChannelStatistics] = {}
        if simulation.status is Status.COMPLETED:
            for c in recorded.channels:
                errors[c.name] = _error(simulation.trajectory[c.name], recorded[c.name])
            statistics = _all_statistics(simulation.trajectory, bands, s.names("outputs"))
        results[name] = ModelRun(
            simulation=simulation,
            errors=errors,
            statistics=statistics,
            derivative_errors=_derivative_errors(first, predicted, found.derivatives[rows]),
        )
    return RunComparison(recorded, _all_statistics(recorded, bands, s.names("outputs")), results)


def _simulate_warm(
    model: DFSM,
    run: Trajectory,
    window: tuple[float | None, float | None],
    options: SimulationSettings | None,
) -> Simulation:
    """Simulate twice: the first call may compile, the second tells what a simulation costs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        simulate(model, run, start=window[0], stop=window[1], options=options)
        return simulate(model, run, start=window[0], stop=window[1], options=options)


def _recorded(model: DFSM, run: Trajectory, differentiated: Trajectory) -> Trajectory:
    """States and outputs to compare with: measured ones as recorded, rates as extracted."""
    names = [c.name for c in (*model.signals.states, *model.signals.outputs)]
    values = [run[n] if n in run else differentiated[n] for n in names]
    channels = (*model.signals.states, *model.signals.outputs)
    return Trajectory(
        run.time,
        np.stack(values, axis=1),
        channels,
        name=run.name,
        source=run.source,
        wall_time=run.wall_time,
    )


def _error(simulated: Array, recorded: Array) -> ChannelError:
    difference = simulated - recorded
    rmse = float(np.sqrt(np.mean(difference**2)))
    spread = float(recorded.std())
    return ChannelError(
        rmse=rmse,
        # A constant has a spread of rounding errors.
        nrmse=rmse / spread if spread > 1e-12 * np.abs(recorded).max() else float("inf"),
        maximum=float(np.abs(difference).max()),
    )


def _derivative_errors(model: DFSM, predicted: Array, extracted: Array) -> dict[str, float]:
    rms = np.sqrt(np.mean((predicted - extracted) ** 2, axis=0))
    spread = np.maximum(extracted.std(axis=0), np.finfo(float).tiny)
    return dict(zip(model.signals.names("states"), (rms / spread).tolist(), strict=True))


def frequency_bands(model: DFSM, recorded: Trajectory) -> tuple[Band, ...]:
    """Platform and wave bands, and ± 20 % around the mean blade-passing frequency.

    Without `Azimuth` settings a state in rpm is taken for the speed of a three-bladed rotor.
    """
    azimuth = model.signals.azimuth
    if azimuth is None:
        speeds = [c.name for c in model.signals.states if c.unit == "rpm"]
        azimuth = Azimuth(speed=speeds[0]) if speeds else None
    if azimuth is None:
        return PLATFORM, WAVE, LOW
    omega = recorded[azimuth.speed].mean() * radians_per_second(recorded.channel(azimuth.speed))
    passing = azimuth.blades * omega / (2 * np.pi)
    return PLATFORM, WAVE, Band(f"{azimuth.blades}P", 0.8 * passing, 1.2 * passing), LOW


def _all_statistics(
    run: Trajectory, bands: Sequence[Band], loads: Sequence[str]
) -> dict[str, ChannelStatistics]:
    return {c.name: _statistics(run, c.name, bands, c.name in loads) for c in run.channels}


def _statistics(
    run: Trajectory, name: str, bands: Sequence[Band], is_load: bool
) -> ChannelStatistics:
    values, time = run[name], run.time
    if run.time_step is None:
        # Spectra need an equidistant mesh; the median step keeps what the samples resolve.
        time = np.arange(time[0], time[-1], float(np.median(np.diff(time))))
        values = np.interp(time, run.time, values)
    psd = spectrum(time, values)
    damage = {}
    if is_load:
        damage = {
            f"{m:g}": damage_equivalent_load(values, run.duration, m) for m in WOHLER_EXPONENTS
        }
    return ChannelStatistics(
        minimum=float(values.min()),
        mean=float(values.mean()),
        maximum=float(values.max()),
        std=float(values.std()),
        peaks={b.name: psd.peak(b) for b in bands if b is not LOW},
        power={b.name: psd.power(b) for b in bands},
        damage=damage,
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


def _leaks(model: DFSM, runs: Sequence[Trajectory]) -> list[str]:
    """Test runs that were in the training data."""
    record = model.provenance.record
    names, trained = record.get("channels", []), {d["sha256"] for d in record.get("data", [])}
    seen = [
        r.where for r in runs if all(n in r for n in names) and r.select(names).digest in trained
    ]
    if not seen:
        return []
    return [
        f"{len(seen)} of the {len(runs)} test runs were used in training ({', '.join(seen[:3])}"
        f"{', …' if len(seen) > 3 else ''}): their errors say little about new runs"
    ]


def _without_infinities(value: Any) -> Any:
    """JSON has no word for infinity: a condition number or an NRMSE may be it."""
    if isinstance(value, Mapping):
        return {k: _without_infinities(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_infinities(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _run_dict(run: RunComparison) -> dict[str, Any]:
    def statistics(found: Mapping[str, ChannelStatistics]) -> dict[str, Any]:
        return {
            name: {
                "min": s.minimum,
                "mean": s.mean,
                "max": s.maximum,
                "std": s.std,
                "peaks_hz": dict(s.peaks),
                "band_power": dict(s.power),
                "del_1hz": dict(s.damage),
            }
            for name, s in found.items()
        }

    return {
        "name": run.recorded.name,
        "duration_s": run.recorded.duration,
        "simulator_wall_time_s": run.recorded.wall_time,
        "statistics": statistics(run.statistics),
        "models": {
            name: {
                "status": m.simulation.status.name.lower(),
                "message": m.simulation.message,
                "ended_s": m.simulation.ended,
                "outside": m.simulation.outside,
                "wall_time_s": m.simulation.wall_time,
                "errors": {c: asdict(e) for c, e in m.errors.items()},
                "derivative_nrmse": dict(m.derivative_errors),
                "statistics": statistics(m.statistics),
            }
            for name, m in run.models.items()
        },
    }
