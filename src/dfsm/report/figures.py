"""What the page's script draws: thinned series, spectra, histograms, eigenvalues, as JSON values.

Nothing here is a figure of merit: those are computed from all samples and stand in the tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.numerics.filters import decimated
from dfsm.numerics.spectra import Band, Spectrum
from dfsm.report.blobs import Blobs
from dfsm.report.first_screen import scores
from dfsm.simulation.simulate import Simulation, Status
from dfsm.validation.results import ChannelStatistics, ModelRun, RunComparison, Validation
from dfsm.validation.validate import LOW, frequency_bands

# Seconds between the samples drawn: fine enough for blade passing (about 0.5 Hz) and a file of a
# few megabytes. Longer runs are thinned further.
_STEP = 0.2
_MOST_POINTS = 6000
# What a rollout that ended at once leaves is drawn sample by sample.
_FEW_POINTS = 200
_HIGHEST = 1.0
# Share of its range by which a drawn line may be off: a third of a pixel of 120.
_UNSEEN = 1 / 360


def page_data(validations: Mapping[str, Validation]) -> dict[str, Any]:
    """Return everything that the page's script draws.

    Parameters
    ----------
    validations
        By name of the fitted model.

    Returns
    -------
    dict
        ``blobs``, arrays that the rest refers to by index, and ``models``.
    """
    blobs = Blobs()
    models = [_model(name, v, blobs) for name, v in validations.items()]
    return {"models": models, "blobs": blobs.encoded}


def bands_of(validation: Validation, run: RunComparison) -> tuple[Band, ...]:
    """Frequency bands in which peaks of this run were compared."""
    first = next(iter(validation.models.values()))
    bands = frequency_bands(first, run.recorded)
    # A rotor that stands still or turns backwards has no blade-passing band.
    return tuple(b for b in bands if b is not LOW and b.high > b.low >= 0)


def thin(run: Trajectory) -> tuple[float, float, Array]:
    """Low-pass and decimate a run for drawing.

    Returns
    -------
    tuple[float, float, ndarray]
        First time and step in s, samples of shape ``(time, channel)``.
    """
    time, values = run.time, run.values
    step = run.time_step
    if step is None:
        step = float(np.median(np.diff(time)))
        mesh = np.arange(time[0], time[-1] + step / 2, step)
        values = np.stack([np.interp(mesh, time, v) for v in values.T], axis=1)
    factor = max(round(_STEP / step), -(-len(values) // _MOST_POINTS), 1)
    if len(values) <= _FEW_POINTS:
        factor = 1
    if factor == 1 or not np.isfinite(values).all():
        return float(time[0]), step * factor, values[::factor]
    # A zero-phase low-pass before decimation keeps fast content from showing up as a slow wave;
    # the odd extension keeps the ends where they are.
    return float(time[0]), step * factor, decimated(values, factor)


def _model(name: str, validation: Validation, blobs: Blobs) -> dict[str, Any]:
    first = next(iter(validation.models.values()))
    return {
        "name": name,
        "channels": [{"name": c.name, "unit": c.unit} for c in validation.channels],
        "variants": list(validation.models),
        "runs": [_run(validation, r, blobs) for r in validation.runs],
        "histograms": [_histogram(validation, c.name, blobs) for c in validation.channels],
        "eigenvalues": [
            {"schedule": float(s), "real": v.real.tolist(), "imag": v.imag.tolist()}
            for s, v in validation.eigenvalues
        ],
        "schedule": first.schedule,
        "scores": scores(validation),
    }


def _run(validation: Validation, run: RunComparison, blobs: Blobs) -> dict[str, Any]:
    names = [c.name for c in validation.channels]
    drawn = [m.simulation.trajectory for m in run.models.values() if _completed(m)]
    drawn += [end for m in run.models.values() for end in m.band or ()]
    return {
        "name": run.recorded.name,
        "start": float(run.recorded.time[0]),
        "stop": float(run.recorded.time[-1]),
        "ranges": [_range(name, run, drawn) for name in names],
        "bands": [
            {"name": b.name, "low": b.low, "high": b.high} for b in bands_of(validation, run)
        ],
        "recorded": _series(run.recorded, names, blobs) | _spectra(run.statistics, names, blobs),
        "variants": {
            name: _series(m.simulation.trajectory, names, blobs)
            | _spectra(m.statistics, names, blobs)
            | _ending(m.simulation, names)
            | _band(m, names, blobs)
            for name, m in run.models.items()
        },
    }


def _series(run: Trajectory, names: Sequence[str], blobs: Blobs) -> dict[str, Any]:
    start, step, values = thin(run.select(names))
    every = [coarsest(v) for v in values.T]
    y = [blobs.add_drawn(v[::n]) for v, n in zip(values.T, every, strict=True)]
    return {"t0": start, "dt": step, "every": every, "y": y}


def coarsest(values: Array) -> int:
    """How many samples a drawn line can step over without being seen to differ.

    Parameters
    ----------
    values
        Equidistant samples, shape ``(time,)``.

    Returns
    -------
    int
        A power of two that ends at the last sample. Lines through every so many samples are
        off by less than a third of a pixel where a panel is as high as the range of the values.
    """
    if not np.isfinite(values).all():
        return 1
    allowed = _UNSEEN * float(np.ptp(values))
    factor, places = 1, np.arange(len(values))
    while (len(values) - 1) % (2 * factor) == 0 and 2 * factor < len(values):
        kept = places[:: 2 * factor]
        if np.abs(np.interp(places, kept, values[kept]) - values).max() > allowed:
            break
        factor *= 2
    return factor


def _spectra(
    statistics: Mapping[str, ChannelStatistics], names: Sequence[str], blobs: Blobs
) -> dict[str, Any]:
    """Spectra up to 1 Hz; None where the rollout did not complete."""
    if not statistics:
        return {"psd": None}
    spectra = [_shown(statistics[name].spectrum) for name in names]
    frequency = spectra[0].frequency
    return {
        "psd": [blobs.add_logarithmic(s.density) for s in spectra],
        "df": float(frequency[1] - frequency[0]) if len(frequency) > 1 else 1.0,
    }


def _shown(spectrum: Spectrum) -> Spectrum:
    inside = spectrum.frequency <= _HIGHEST
    # The mean was removed, so the first bin holds nothing that a logarithmic axis could show.
    return Spectrum(
        spectrum.frequency[inside],
        np.where(spectrum.frequency[inside] > 0, spectrum.density[inside], np.nan),
    )


def _band(model: ModelRun, names: Sequence[str], blobs: Blobs) -> dict[str, Any]:
    """Half the height of the prediction intervals around the rollout; without them nothing."""
    if model.band is None:
        return {}
    low, high = model.band
    half = replace(low, values=(high.values - low.values) / 2)
    return {"band": _series(half, names, blobs)}


def _completed(model: ModelRun) -> bool:
    return model.simulation.status is Status.COMPLETED


def _ending(simulation: Simulation, names: Sequence[str]) -> dict[str, Any]:
    if simulation.status is Status.COMPLETED:
        return {"ended": None}
    last = simulation.trajectory.select(names).values[-1]
    return {
        "ended": simulation.ended,
        "message": simulation.reason,
        "last": np.nan_to_num(last).tolist(),
    }


def _range(name: str, run: RunComparison, drawn: Sequence[Trajectory]) -> list[float]:
    return list(within_reason(run.recorded[name], [trajectory[name] for trajectory in drawn]))


def within_reason(recorded: Array, drawn: Sequence[Array]) -> tuple[float, float]:
    """Y-range of a panel: the recorded signal and what is drawn beside it, within reason.

    Parameters
    ----------
    recorded
        Shape ``(time,)``, finite.
    drawn
        Of other signals; one that is not finite has no say.
    """
    low, high = float(recorded.min()), float(recorded.max())
    span = (high - low) or max(abs(high), 1.0)
    reach = 0.6 * span
    least, most = low, high
    for values in drawn:
        if np.isfinite(values).all():
            least = min(least, max(float(values.min()), low - reach))
            most = max(most, min(float(values.max()), high + reach))
    return least - 0.12 * span, most + 0.12 * span


def _histogram(validation: Validation, name: str, blobs: Blobs) -> dict[str, Any] | None:
    """Share of samples per bin in %; None where the variants have no completed run in common."""
    histogram = validation.histograms[name]
    if not histogram.counts or not all(counts.sum() for counts in histogram.counts.values()):
        return None
    centres = (histogram.edges[1:] + histogram.edges[:-1]) / 2
    return {
        "x": blobs.add(centres),
        "share": {m: blobs.add(100 * c / c.sum()) for m, c in histogram.counts.items()},
    }
