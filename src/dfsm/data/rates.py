"""Which channel is the rate of which, judged over windows of time and in one unit.

A rate's mean over a window is what the other channel gains there, divided by its length. That
holds for coarse and noisy records, too, where no derivative is like a recorded rate: noise of the
position counts the less the longer the window, while what is not the rate stays off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import factor, known
from dfsm.data.conversion import in_units_of, tell_converted
from dfsm.data.derivatives import StateSpec, per_second
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.windows import Windows

# Lengths of windows in samples; RMS of what a channel gains that its rate may leave, relative to
# its standard deviation; channels up to which all pairs are looked at.
_SPANS, _LEFT, _MOST_CHANNELS = (1, 4, 16, 64, 256), 0.3, 600
_FEWEST = 8
# Of two states, the one of which a rate leaves less than this share of what it leaves of the other
# is its own, unless it leaves next to nothing of both.
_CLEARLY, _EXACT = 0.5, 0.002


def matched_rates(runs: Sequence[Trajectory], names: Sequence[str]) -> dict[str, str]:
    """Channels that are the rate of another, each with that one.

    One to one, the best match first: rates of parts that move nearly alike are nearly alike, too.

    Parameters
    ----------
    runs
        Runs that share the channels.
    names
        Channels; where both units are known, only such are compared as one can be the rate of.
    """
    if not 2 <= len(names) <= _MOST_CHANNELS or max(map(len, runs)) < 10:
        return {}
    left = rates_left(runs, names)
    found: dict[str, str] = {}
    for flat in np.argsort(left, axis=None).tolist():
        i, j = divmod(flat, len(names))
        if not left[i, j] < _LEFT:
            break
        if names[j] not in found and names[i] not in found.values():
            found[str(names[j])] = str(names[i])
    # A chain of rates has an end: what turns in a circle, as sine and cosine do, has none.
    for name in list(found):
        seen, base = {name}, found.get(name)
        while base is not None and base not in seen:
            seen.add(base)
            base = found.get(base)
        if base is not None:
            del found[name]
    return found


def rates_left(runs: Sequence[Trajectory], names: Sequence[str]) -> Array:
    """RMS that each channel, as the rate of each other, leaves of what that one gains.

    Returns
    -------
    ndarray
        Relative to the standard deviation, over windows of the length at which it is least,
        ``(channel, rate)``; infinite where the units forbid it.
    """
    windows, channels = Windows(runs, names), [runs[0].channel(n) for n in names]
    best = np.full((len(names), len(names)), np.inf)
    for span in _SPANS:
        rows = windows.rows(1, span)
        if len(rows.change) < _FEWEST:
            break
        gain, rate = (v - v.mean(axis=0) for v in (rows.change, rows.mean))
        products, squares = gain.T @ rate / len(gain), rate.var(axis=0)
        own = np.maximum(gain.var(axis=0), np.finfo(float).tiny)[:, None]
        alike = products > 0.5 * np.sqrt(own * squares)
        for i, j in np.argwhere(alike).tolist():
            scale = rate_factor(channels[i], channels[j]) if i != j else None
            if scale is not None:
                share = (
                    1 - 2 * scale * products[i, j] / own[i, 0] + scale**2 * squares[j] / own[i, 0]
                )
                best[i, j] = min(best[i, j], max(float(share), 0.0) ** 0.5)
    return best


def rate_factor(base: Channel, rate: Channel) -> float | None:
    """What one of a rate's unit is in the other channel's unit per s.

    One where a unit is unknown; None between dimensions.
    """
    if not (known(base.unit) and known(rate.unit)):
        return 1.0
    return factor(rate.unit, per_second(base.unit))


def with_rates_per_second(
    runs: Sequence[Trajectory], states: Sequence[StateSpec]
) -> list[Trajectory]:
    """Runs with recorded rates and accelerations in the units of their states per s and per s².

    What is converted is told. Units of another dimension stay, for `differentiate` to refuse.
    """
    wanted = list[Channel]()
    for spec in states:
        unit = next((r.channel(spec.name).unit for r in runs if spec.name in r), "")
        for name in (spec.rate, spec.acceleration):
            unit = per_second(unit)
            its = [r.channel(name).unit for r in runs if name is not None and name in r]
            if (
                name is not None
                and its
                and all(factor(u, unit) is not None for u in its if known(u))
            ):
                wanted.append(Channel(name, unit))
    converted = [in_units_of(run, wanted, "its state, per s") for run in runs]
    tell_converted(runs, converted)
    return converted


def wrong_rates(runs: Sequence[Trajectory], states: Sequence[StateSpec]) -> dict[str, str]:
    """States of whose recorded rate another is the position, or none, with a sentence each.

    Parameters
    ----------
    runs
        Samples that count, with the channels of the states.
    states
        States; those of order 1, which may be filtered, too.
    """
    spans = {s.name: s.rate for s in states if s.rate is not None}
    names = list(dict.fromkeys(n for s in states for n in (s.name, s.rate) if n is not None))
    if not spans or len(names) > _MOST_CHANNELS:
        return {}
    left, told = rates_left(runs, names), dict[str, str]()
    for name, rate in spans.items():
        own, column = left[names.index(name), names.index(rate)], left[:, names.index(rate)]
        best = names[int(np.argmin(column))]
        other = best != name and column.min() < _CLEARLY * own and column.min() < _LEFT
        if other and own > _EXACT:
            told[name] = (
                f"'{rate}' is named as the rate of '{name}', but is that of '{best}': over windows "
                f"of some samples it leaves {own:.1%} of what '{name}' gains and "
                f"{column.min():.1%} of what '{best}' does; name each rate with its own state"
            )
        elif not own < _LEFT:
            much = f"{own:.0%}" if np.isfinite(own) else "all"
            told[name] = (
                f"'{rate}' is named as the rate of '{name}', but is not its derivative: over "
                f"windows of some samples it leaves {much} of what '{name}' gains; name its own "
                "rate, or leave the rate out, and '" + name + "' is differentiated"
            )
    return told
