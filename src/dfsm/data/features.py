"""Inputs computed from disturbances: a rate, a copy that lags, is late or early, or a difference.

A force often follows from the history of a disturbance: wave forces from the elevation and its
rate, the induced wind from the wind of the last seconds. Declared features are computed from a
run's own channels in one way, for training, simulation and optimization alike.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np
import scipy

from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.core.units import agree
from dfsm.data.derivatives import per_second
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.numerics.smoothing import smoothing_spline

# Rates by a digest of what they are the rates of: a run meets a model several times, and each time
# its features are computed. So many of so many bytes at most.
_slopes: dict[tuple[bytes, float | None], Array] = {}
_MOST_KNOWN, _LARGEST_KNOWN = 32, 1_000_000


@settings_class
class Feature:
    """A disturbance made of others, or a control that acts late.

    Attributes
    ----------
    source
        The disturbance that it is computed from.
    kind
        ``"rate"``: the time derivative, by the same smoothing spline as derivatives of states;
        named ``<source>_dot``; with `seconds` the slope from so many before to so many after, which
        is smoother, named ``<source>_dot<seconds>``. ``"lag"``: a first-order lag,
        ``τ dz/dt = source - z``, at rest when the record starts; named ``<source>_lag<τ>``.
        ``"difference"``: source less another disturbance in the same unit, e.g. the wind over a
        ring of the rotor less that over the disk; named ``<source>-<less>``. ``"delay"``: the
        source so many seconds ago, as it was at first where the record does not go back so far;
        named ``<source>_delay<seconds>``. Only for a delay the source may be a control; a model
        with one cannot be optimized. ``"lead"``: the source in so many seconds, as it is at last
        where the record ends before; named ``<source>_lead<seconds>``. Waves reach a hull before
        they reach the point where their elevation is told, so that their force begins before it
        (Falnes 1995, Applied Ocean Research 17, 379-386).
    time_constant
        τ of a lag in s.
    seconds
        How late a delay is, how early a lead, and what a rate spans on either side.
    less
        What a difference takes off.
    """

    source: str
    kind: Literal["rate", "lag", "difference", "delay", "lead"] = "rate"
    time_constant: float | None = None
    less: str | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        for key, kinds in (("time_constant", ("lag",)), ("seconds", ("delay", "lead", "rate"))):
            value: float | None = getattr(self, key)
            if self.kind in kinds and not (self.kind == "rate" and value is None):
                positive = value is not None and bool(np.isfinite(value)) and value > 0
                require(positive, f"features.{key}", value, "a positive number of seconds")
            else:
                require(value is None, f"features.{key}", value, f"none for a {self.kind}")
        right = (self.less is not None) == (self.kind == "difference")
        expected = "a disturbance" if self.kind == "difference" else f"none for a {self.kind}"
        require(right, "features.less", self.less, expected)

    @property
    def sources(self) -> tuple[str, ...]:
        """Channels that it is made of."""
        return (self.source,) if self.less is None else (self.source, self.less)

    @property
    def name(self) -> str:
        """Name of the channel."""
        if self.kind == "rate":
            return f"{self.source}_dot" + ("" if self.seconds is None else f"{self.seconds:g}")
        if self.kind == "difference":
            return f"{self.source}-{self.less}"
        if self.kind in ("delay", "lead"):
            return f"{self.source}_{self.kind}{self.seconds:g}"
        return f"{self.source}_lag{self.time_constant:g}"


def with_features(run: Trajectory, features: Iterable[Feature]) -> Trajectory:
    """Add features to a run; those that it holds under their names are computed again.

    Parameters
    ----------
    run
        The whole record: what lies before the time window of a fit or a simulation counts.
    features
        A feature may be made of one that stands before it.

    Returns
    -------
    Trajectory
        The run with one channel per feature, of role disturbance.

    Raises
    ------
    DfsmError
        A source is missing or not finite, a lag is asked for on a mesh that is not equidistant,
        or the two of a difference have different units.
    """
    added: dict[str, tuple[Channel, Array]] = {}
    for feature in features:
        made = _made_of(run, feature, added)
        source, *others = made.channels
        if feature.kind == "rate":
            span, unit = feature.seconds, per_second(source.unit)
            values = _rate(made, feature) if span is None else _slope_over(made, source.name, span)
        elif feature.kind == "lag":
            values, unit = _lagged(made, feature), source.unit
        elif feature.seconds is not None:
            later = feature.seconds if feature.kind == "lead" else -feature.seconds
            values = np.interp(made.time + later, made.time, made[source.name])
            unit = source.unit
        else:
            _require_one_unit(made, source, others[0])
            values, unit = made[source.name] - made[others[0].name], source.unit
        added.pop(feature.name, None)
        channel = Channel(feature.name, unit, role="disturbance", computed=True)
        added[feature.name] = channel, values
    if not added:
        return run
    # All at once: each copy of a whole run costs more than most features.
    channels, values = zip(*added.values(), strict=True)
    kept = [n for n in run.names if n not in added]
    return run.select(kept).with_channels(list(channels), np.column_stack(values))


def _made_of(
    run: Trajectory, feature: Feature, added: Mapping[str, tuple[Channel, Array]]
) -> Trajectory:
    """The channels that a feature is made of, finite; those of features before it as they are."""
    made = [added[name] for name in feature.sources if name in added]
    part = run.select([name for name in feature.sources if name not in added])
    if made:
        channels, values = zip(*made, strict=True)
        part = part.with_channels(list(channels), np.column_stack(values))
        part = part.select(feature.sources)
    return part.require_finite()


def unknown_ends(features: Iterable[Feature]) -> tuple[float, float]:
    """Seconds at the start and the end of a record in which features ask for what is not in it."""
    late: dict[str, float] = {}
    early: dict[str, float] = {}
    for feature in features:
        for known, kind in ((late, "delay"), (early, "lead")):
            before = max(known.get(source, 0.0) for source in feature.sources)
            own = feature.seconds if feature.kind in (kind, "rate") else None
            known[feature.name] = before + (own or 0.0)
    return max(late.values(), default=0.0), max(early.values(), default=0.0)


def guessed_ends(
    run: Trajectory, features: Iterable[Feature], window: tuple[float, float]
) -> tuple[float, float]:
    """Seconds at the start and the end of a time window in which features ask for more.

    Parameters
    ----------
    run
        The whole record.
    features
        Of the model.
    window
        First and last time in s.
    """
    late, early = unknown_ends(features)
    first, last = float(run.time[0]) + late - window[0], window[1] - float(run.time[-1]) + early
    return max(first, 0.0) if late else 0.0, max(last, 0.0) if early else 0.0


def known_window(
    run: Trajectory, features: Iterable[Feature], start: float | None, stop: float | None
) -> tuple[float | None, float | None]:
    """Start and stop in s of a fit or a comparison: where features ask for what is in the record.

    Parameters
    ----------
    run
        The whole record.
    features
        Of the model.
    start, stop
        Times in s that are asked for; None for the ends of the run.

    Raises
    ------
    DfsmError
        The run is no longer than what is unknown.
    """
    first, last = unknown_ends(features)
    if not (first or last):
        return start, stop
    begin, end = float(run.time[0]) + first, float(run.time[-1]) - last
    if begin >= end:
        raise DfsmError(
            f"{run.where} lasts {run.duration:g} s, and delayed or leading inputs are not known in "
            f"its first {first:g} s and its last {last:g} s: leave it out, or shorten these times"
        )
    if first:
        start = begin if start is None else max(start, begin)
    if last:
        stop = end if stop is None else min(stop, end)
    return start, stop


def acting_late(features: Iterable[Feature], controls: Iterable[str]) -> dict[str, str]:
    """Features that hold what a control did before, each with that control.

    Parameters
    ----------
    features
        In the order in which they are computed.
    controls
        What an optimizer chooses.
    """
    origin = {name: name for name in controls}
    late: dict[str, str] = {}
    for feature in features:
        for source in feature.sources:
            if source in origin:
                late[feature.name] = origin[feature.name] = origin[source]
    return late


def _require_one_unit(run: Trajectory, source: Channel, other: Channel) -> None:
    if not agree(source.unit, other.unit):
        raise DfsmError(
            f"{run.where}: a feature takes '{other.name}' ({other.unit}) off '{source.name}' "
            f"({source.unit}): name two channels in one unit"
        )


def _rate(run: Trajectory, feature: Feature) -> Array:
    try:
        step = run.channel(feature.source).step
        return _slope(run.time, run[feature.source], step)
    except DfsmError as error:
        raise DfsmError(f"{run.where}: feature '{feature.name}': {error}") from None


def _slope_over(run: Trajectory, source: str, seconds: float) -> Array:
    after, before = (np.interp(run.time + s, run.time, run[source]) for s in (seconds, -seconds))
    return (after - before) / (2 * seconds)


def _slope(time: Array, values: Array, step: float | None) -> Array:
    """First derivative of a smoothing spline; that of the last runs is known already."""
    key = hashlib.sha256(time.tobytes() + values.tobytes()).digest(), step
    slope = _slopes.get(key)
    if slope is None:
        slope = smoothing_spline(time, values, step).first
        if slope.nbytes <= _LARGEST_KNOWN:
            if len(_slopes) >= _MOST_KNOWN:
                _slopes.pop(next(iter(_slopes)), None)
            _slopes[key] = slope
    return slope


def _lagged(run: Trajectory, feature: Feature) -> Array:
    """The lag's exact answer to a source that is linear between samples."""
    if run.time_step is None or feature.time_constant is None:
        raise DfsmError(
            f"{run.where}: feature '{feature.name}' needs an equidistant mesh and this one is "
            "not: resample the run first"
        )
    u, ratio = run[feature.source], run.time_step / feature.time_constant
    decay = float(np.exp(-ratio))
    held = -float(np.expm1(-ratio)) / ratio
    now, before = 1 - held, held - decay
    return scipy.signal.lfilter([now, before], [1.0, -decay], u, zi=[u[0] * (1 - now)])[0]
