"""Inputs computed from disturbances: a rate, or a copy that lags behind.

A force often follows from the history of a disturbance: wave forces from the elevation and its
rate, the induced wind from the wind of the last seconds. Declared features are computed from a
run's own channels in one way, for training, simulation and optimization alike.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
from scipy.signal import lfilter

from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.data.derivatives import per_second
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.numerics.smoothing import smoothing_spline


@settings_class
class Feature:
    """A disturbance made of another one.

    Attributes
    ----------
    source
        The disturbance that it is computed from.
    kind
        ``"rate"``: the time derivative, by the same smoothing spline as derivatives of states;
        named ``<source>_dot``. ``"lag"``: a first-order lag, ``τ dz/dt = source - z``, at rest when
        the record starts; named ``<source>_lag<τ>``.
    time_constant
        τ of a lag in s.
    """

    source: str
    kind: Literal["rate", "lag"] = "rate"
    time_constant: float | None = None

    def __post_init__(self) -> None:
        if self.kind == "lag":
            seconds = self.time_constant
            positive = seconds is not None and bool(np.isfinite(seconds)) and seconds > 0
            require(positive, "features.time_constant", seconds, "a positive number of seconds")
        else:
            require(
                self.time_constant is None,
                "features.time_constant",
                self.time_constant,
                "none for a rate",
            )

    @property
    def name(self) -> str:
        """Name of the channel."""
        if self.kind == "rate":
            return f"{self.source}_dot"
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
        The source is missing or not finite, or a lag is asked for on a mesh that is not
        equidistant.
    """
    for feature in features:
        run.columns([feature.source])
        source = run.select([feature.source]).require_finite().channels[0]
        if feature.kind == "rate":
            values, unit = _rate(run, feature), per_second(source.unit)
        else:
            values, unit = _lagged(run, feature), source.unit
        channel = Channel(feature.name, unit, role="disturbance", computed=True)
        run = run.select(n for n in run.names if n != feature.name)
        run = run.with_channels([channel], values)
    return run


def _rate(run: Trajectory, feature: Feature) -> Array:
    try:
        step = run.channel(feature.source).step
        return smoothing_spline(run.time, run[feature.source], step).first
    except DfsmError as error:
        raise DfsmError(f"{run.where}: feature '{feature.name}': {error}") from None


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
    return lfilter([now, before], [1.0, -decay], u, zi=[u[0] * (1 - now)])[0]
