"""Which recorded channels are driven by the past of others, and which drive.

Granger 1969, "Investigating causal relations by econometric models and cross-spectral methods": a
channel is driven where the past of the others, beside its own, makes its next sample much better
known. An input of an open loop, however smooth, is not; a hidden state in between does not matter.
What a response tells of an input is more of that input's own past: its own reaches further back.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.numerics.folds import unfolded

# Samples of the past of others and of a channel's own, samples looked at, and channels beyond which
# it is not tried.
_PAST, _OWN, _MOST_SAMPLES, _MOST_CHANNELS = 10, 30, 20_000, 12
# Samples looked at where only the size of a gain counts.
_GAINED = 4000
# Samples looked at where signs are to be found first.
_SIGNED = 2000
# F statistic from which the past of others counts, and the share of what it tells of the channel
# that it tells most of: the past of a response tells a little of a smooth input, too.
_COUNTS, _SHARE = 4.0, 0.25


def driven_by_past(run: Trajectory, names: Sequence[str]) -> list[str]:
    """Channels that others drive; empty where nothing tells them from those that drive.

    Parameters
    ----------
    run
        One record.
    names
        Its channels that may be either.
    """
    if not 2 <= len(names) <= _MOST_CHANNELS:
        return []
    table = np.nan_to_num(run.select(names).values[:_MOST_SAMPLES])
    return _driven(table, names) or _driven(_with_signs(table[:_SIGNED]), names)


def gains_from_past(run: Trajectory, names: Sequence[str]) -> dict[str, float]:
    """By how much its own past alone leaves more of each channel than with that of the others.

    Empty where there are too few channels to ask, too many or too few samples.
    """
    table = np.nan_to_num(run.select(names).values[:_GAINED])
    past = _lags(table)
    if not 2 <= len(names) <= _MOST_CHANNELS or past < 2:
        return {}
    gains, _ = _gains(table, past)
    return dict(zip(names, gains.tolist(), strict=True))


def _with_signs(table: Array) -> Array:
    """The same where channels that an instrument folded have their signs again.

    What drives x as much one way as the other tells nothing of |x|.
    """
    return np.column_stack([_with_sign(table, i) for i in range(table.shape[1])])


def _with_sign(table: Array, column: int) -> Array:
    """One channel with its sign, or as it is."""
    found = unfolded([(np.delete(table, column, axis=1), table[:, column])])
    return found.paths[0] if found is not None and found.clear else table[:, column]


def lost_its_sign(run: Trajectory, name: str, names: Sequence[str]) -> bool:
    """Whether a channel, of some that may drive it, looks like an absolute value."""
    table = np.nan_to_num(run.select(names).values[:_SIGNED])
    return bool((_with_sign(table, names.index(name)) != table[:, names.index(name)]).any())


def _driven(table: Array, names: Sequence[str]) -> list[str]:
    past = _lags(table)
    if past < 2:
        return []
    gains, free = _gains(table, past)
    counted = gains * free / (past * (len(names) - 1)) > _COUNTS
    driven = counted & (gains >= _SHARE * gains.max())
    if not driven.any() or driven.all():
        return []
    return [name for name, is_driven in zip(names, driven, strict=True) if is_driven]


def _lags(table: Array) -> int:
    """Samples of the past of all channels that a table can tell of."""
    return min(_PAST, len(table) // (10 * max(1, table.shape[1])))


def _gains(table: Array, past: int) -> tuple[Array, int]:
    """Gains of all channels, and the degrees of freedom that they are judged with."""
    table = (table - table.mean(axis=0)) / np.maximum(table.std(axis=0), np.finfo(float).tiny)
    others = past * (table.shape[1] - 1)
    own = max(past, min(_OWN, len(table) // 10 - others))
    lags = np.stack([table[own - k - 1 : len(table) - k - 1] for k in range(own)], axis=1)
    gains = [_gain(lags, table[own:], i, past) for i in range(table.shape[1])]
    return np.array(gains), len(lags) - own - others


def _gain(lags: Array, now: Array, column: int, past: int) -> float:
    """By how much its own past alone leaves more of a channel than with the past of the others."""
    own = lags[:, :, column]
    others = np.delete(lags[:, :past], column, axis=2).reshape(len(lags), -1)
    every = np.concatenate([own, others], axis=1)
    return _left(own, now[:, column]) / _left(every, now[:, column]) - 1


def _left(past: Array, now: Array) -> float:
    """Mean square that a linear fit leaves, per degree of freedom; rounding is no gain."""
    coefficients = np.linalg.lstsq(past, now, rcond=1e-10)[0]
    rest = now - past @ coefficients
    return float(rest @ rest) / max(1, len(now) - past.shape[1]) + 1e-14
