"""What a validation finds: models against recorded runs, and the figures of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dfsm.core.drawing import DrawnByRun
from dfsm.core.files import json_value
from dfsm.core.types import Array, ComplexArray
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import printable
from dfsm.models.departures import MUCH_OUTSIDE, told
from dfsm.models.dfsm import DFSM
from dfsm.numerics.spectra import Spectrum
from dfsm.numerics.time_mesh import mean_over, std_over
from dfsm.simulation.outcome import Simulation, Status
from dfsm.validation.intervals import Intervals

if TYPE_CHECKING:
    import pandas as pd

# Share of its training spread below which a signal is at rest: errors have no scale there.
_STILL = 0.01
# The model that prediction intervals belong to, among those compared.
MULTI_FIDELITY = "multi-fidelity"


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
        RMSE divided by the standard deviation of the recorded signal; infinite for a constant,
        NaN where the signal hardly moves, see `unless_still`.
    """

    rmse: float
    nrmse: float
    maximum: float

    @classmethod
    def of(cls, simulated: Array, recorded: Array, weights: Array | None = None) -> ChannelError:
        """Compare samples at the same times; `weights` as of `weights_over_time`."""
        difference, size = simulated - recorded, spread(recorded, weights)
        rmse = float(np.sqrt(mean_over(difference**2, weights)))
        return cls(rmse, rmse / size if size else float("inf"), float(np.abs(difference).max()))

    def unless_still(self, recorded: Array, usual: float) -> ChannelError:
        """The same without an NRMSE where the record moves by less than 1 % of what is usual.

        Parameters
        ----------
        recorded
            The recorded signal.
        usual
            Its standard deviation over the training runs; 0 where that is not known.
        """
        still = spread(recorded) < _STILL * usual
        return replace(self, nrmse=float("nan")) if still else self


def training_spreads(model: DFSM) -> dict[str, float]:
    """Standard deviation over the training runs of states and outputs, by name, where known."""
    names = model.signals.names("states")
    std = np.asarray(model.region.std)[model.signals.state_columns]
    outputs = {row["name"]: row["std"] for row in model.provenance.record.get("rows", ())}
    known = {n: float(outputs[n]) for n in model.signals.names("outputs") if n in outputs}
    return known | dict(zip(names, std.tolist(), strict=True))


def spread(values: Array, weights: Array | None = None) -> float:
    """Standard deviation; 0 for a constant, whose samples differ by rounding errors only."""
    std = float(std_over(values, weights))
    return std if std > 1e-12 * np.abs(values).max() else 0.0


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
    band, coverage
        Lower and upper ends of prediction intervals, and per channel the share of the time that
        the record lies between them; only where there are intervals and the rollout completed.
    """

    simulation: Simulation
    errors: Mapping[str, ChannelError]
    statistics: Mapping[str, ChannelStatistics]
    derivative_errors: Mapping[str, float]
    band: tuple[Trajectory, Trajectory] | None = None
    coverage: Mapping[str, float] = field(default_factory=dict)


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
    parameters
        Values of the models' parameters in this run, in the channels' units.
    """

    recorded: Trajectory
    statistics: Mapping[str, ChannelStatistics]
    models: Mapping[str, ModelRun]
    parameters: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Histogram:
    """Pointwise errors of one channel over all test runs: counts between `edges`."""

    edges: Array
    counts: Mapping[str, Array]


@dataclass(frozen=True)
class Validation(DrawnByRun):
    """Everything that a report shows.

    Attributes
    ----------
    models
        The models compared, by name, in the order shown.
    channels
        States and outputs, in the order shown.
    runs
        Test runs, in the caller's order.
    histograms
        Per channel, over the runs that all models completed which completed any.
    eigenvalues
        Of the linear fit, per schedule point.
    record
        Provenance of the model: settings, data, rows, seconds.
    warnings
        What a reader should know before trusting the figures.
    intervals
        Prediction intervals of the multi-fidelity model, if any.
    """

    models: Mapping[str, DFSM]
    channels: tuple[Channel, ...]
    runs: tuple[RunComparison, ...]
    histograms: Mapping[str, Histogram]
    eigenvalues: Sequence[tuple[float, ComplexArray]]
    record: Mapping[str, Any]
    warnings: tuple[str, ...] = field(default=())
    intervals: Intervals | None = None

    def __repr__(self) -> str:
        runs = f"{len(self.runs)} run{'s' * (len(self.runs) != 1)}"
        lines = [f"<Validation on {runs}, {len(self.channels)} channels"]
        for model in self.models:
            line = f"  {model}: {self.completed(model)} of {len(self.runs)} rollouts completed"
            means = {c.name: self.mean_nrmse(model, c.name) for c in self.channels}
            ranked = [(v, name) for name, v in means.items() if v is not None]
            if ranked:
                (low, best), (high, worst) = min(ranked), max(ranked)
                line += f", mean NRMSE {low:.2f} ({best}) to {high:.2f} ({worst})"
            lines.append(printable(line))
        return "\n".join(lines) + ">"

    def mean_nrmse(self, model: str, channel: str) -> float | None:
        """Mean NRMSE over the test runs in which the channel moves; None if it moves in none.

        Also None if the model did not complete all of the runs.
        """
        return self.mean_error(model, channel, "nrmse")

    def mean_error(self, model: str, channel: str, what: str) -> float | None:
        """Mean of one figure of `ChannelError` over the test runs, as `mean_nrmse`."""
        errors = [r.models[model].errors.get(channel) for r in self.runs]
        values = [getattr(e, what) for e in errors if e is not None]
        known = [v for v in values if not np.isnan(v)]
        return float(np.mean(known)) if known and len(values) == len(self.runs) else None

    def still(self) -> list[str]:
        """One sentence on channels that hardly move in some runs, and have no NRMSE there."""
        still: dict[tuple[str, ...], list[str]] = {}
        for c in self.channels:
            errors = ([m.errors.get(c.name) for m in r.models.values()] for r in self.runs)
            at = [any(e is not None and np.isnan(e.nrmse) for e in run) for run in errors]
            runs = tuple(r.recorded.where for r, rests in zip(self.runs, at, strict=True) if rests)
            still.setdefault(runs, []).append(f"'{c.name}'")
        return [
            f"{', '.join(names)}: less than {_STILL:.0%} of the spread in training in "
            f"{', '.join(runs[:3])}{', …' if len(runs) > 3 else ''}, so no NRMSE there and none "
            "in the mean: see the RMSE"
            for runs, names in still.items()
            if runs
        ]

    def coverage(self, channel: str) -> list[float] | None:
        """Share of the time inside the prediction intervals per run; None as for `mean_nrmse`."""
        if self.intervals is None:
            return None
        coverage = [r.models[MULTI_FIDELITY].coverage.get(channel) for r in self.runs]
        shares = [share for share in coverage if share is not None]
        return shares if len(shares) == len(self.runs) else None

    def endings(self) -> list[str]:
        """One sentence per rollout that ended early."""
        return [
            f"{name} on {r.recorded.name}: {m.simulation.reason}"
            for r in self.runs
            for name, m in r.models.items()
            if m.simulation.status is not Status.COMPLETED
        ]

    def outside(self) -> list[str]:
        """One sentence per model that spent much of its time outside the training range."""
        sentences = []
        for name in self.models:
            worst = max(self.runs, key=lambda r: r.models[name].simulation.outside)
            rollout = worst.models[name].simulation
            if rollout.outside > MUCH_OUTSIDE:
                where = f": {told(rollout.departures)}" if rollout.departures else ""
                sentences.append(
                    f"{name}: up to {rollout.outside:.0%} of a rollout has an input or state "
                    f"outside the training range{where}"
                )
        return sentences

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

    def to_pandas(self) -> pd.DataFrame:
        """Return a table of one line per run, model and channel: errors, and how rollouts ended."""
        import pandas as pd

        lines = []
        for run in self.runs:
            for model, m in run.models.items():
                for c in self.channels:
                    at = {"run": run.recorded.name, "model": model, "channel": c.name}
                    lines.append(at | {"unit": c.unit, "role": c.role} | _line(run, m, c.name))
        return pd.DataFrame(lines)

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
            "intervals": self._intervals_dict(),
        }
        return dict(json_value(values))

    def _intervals_dict(self) -> dict[str, Any] | None:
        if self.intervals is None:
            return None
        shares = {c.name: self.coverage(c.name) for c in self.channels}
        means = {name: float(np.mean(s)) if s else None for name, s in shares.items()}
        level, runs = self.intervals.level, self.intervals.runs
        return {"level": level, "runs": runs, "mean_coverage": means}

    def _model_dict(self, name: str) -> dict[str, Any]:
        return {
            "completed": self.completed(name),
            "of": len(self.runs),
            "mean_nrmse": {c.name: self.mean_nrmse(name, c.name) for c in self.channels},
            "wall_time_s": self.wall_time(name),
            "speed_up": self.speed_up(name),
        }


def _line(run: RunComparison, model: ModelRun, channel: str) -> dict[str, Any]:
    """Figures of one channel; a rollout that ended early has neither errors nor statistics."""
    error = model.errors.get(channel)
    sides = {"recorded": run.statistics, "simulated": model.statistics}
    figures = {side: of.get(channel) for side, of in sides.items()}
    return {
        "status": model.simulation.status.name.lower(),
        "ended": model.simulation.ended,
        **{k: None if error is None else getattr(error, k) for k in ("rmse", "nrmse", "maximum")},
        "coverage": model.coverage.get(channel),
        **{
            f"{what}_{side}": None if figure is None else getattr(figure, what)
            for side, figure in figures.items()
            for what in ("mean", "std")
        },
    }


def _run_dict(run: RunComparison) -> dict[str, Any]:
    def statistics(of: Mapping[str, ChannelStatistics]) -> dict[str, Any]:
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
            for name, s in of.items()
        }

    return {
        "name": run.recorded.name,
        "duration_s": run.recorded.duration,
        "simulator_wall_time_s": run.recorded.wall_time,
        "parameters": dict(run.parameters),
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
                "coverage": dict(m.coverage),
                "statistics": statistics(m.statistics),
            }
            for name, m in run.models.items()
        },
    }
