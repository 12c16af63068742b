"""Damage-equivalent loads by rainflow counting (ASTM E1049, Palmgren-Miner)."""

from __future__ import annotations

from collections.abc import Sequence

import fatpack
import numpy as np

from dfsm.core.shapes import Series
from dfsm.core.types import Array
from dfsm.errors import DfsmError
from dfsm.numerics.rainflow import four_point_cycles

WOHLER_EXPONENTS = (3.0, 4.0, 5.0, 10.0)


def damage_equivalent_load(
    values: Series, duration: float, exponent: float, frequency: float = 1.0
) -> float:
    """Amplitude range of a constant-amplitude load that does the same damage.

    Parameters
    ----------
    values
        Load history, shape ``(time,)``.
    duration
        Its length in s.
    exponent
        Wöhler exponent m: about 3 to 5 for welded steel, 10 for composites.
    frequency
        Cycles per second of the equivalent load; 1 Hz is customary in wind energy.

    Returns
    -------
    float
        ``(Σ n_i S_i^m / (frequency duration))^(1/m)`` in the unit of the load; cycles are those
        of the history repeated end to end, so that no half cycles remain.

    Raises
    ------
    DfsmError
        A sample is NaN or infinite, there are none, or no time has passed.
    """
    return _damage_equivalent_loads(values, duration, [exponent], frequency)[0]


def damage_by_exponent(
    values: Series, duration: float, exponents: Sequence[float] = WOHLER_EXPONENTS
) -> dict[str, float]:
    """`damage_equivalent_load` by exponent as it is written; cycles are counted once."""
    loads = _damage_equivalent_loads(values, duration, exponents, 1.0)
    return {f"{m:g}": load for m, load in zip(exponents, loads, strict=True)}


def _damage_equivalent_loads(
    values: Series, duration: float, exponents: Sequence[float], frequency: float
) -> list[float]:
    values = np.asarray(values, dtype=np.float64)
    if not len(values):
        raise DfsmError("the load history has no samples, so no cycles: give a longer part")
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise DfsmError(
            f"the load history has {len(bad)} NaN or infinite samples, the first is number "
            f"{bad[0] + 1}, so its cycles cannot be counted: leave that part of the run out"
        )
    if not duration > 0:
        raise DfsmError(
            f"the load history lasts {duration:g} s, expected more than 0 s: give its length"
        )
    if np.ptp(values) == 0:
        return [0.0] * len(exponents)
    # From its maximum to its maximum nothing remains open after counting (ASTM E1049, 5.4.5);
    # fatpack alone loses the largest cycle of a history that begins or ends at an extreme.
    peak = int(np.argmax(values))
    closed = np.concatenate([values[peak:], values[: peak + 1]])
    ranges = _ranges(fatpack.find_reversals(closed, k=256)[0])
    # Divided by the largest range before the power, or m = 10 overflows in N m.
    largest = ranges.max()
    cycles = frequency * duration
    damages = [(m, np.sum((ranges / largest) ** m) / cycles) for m in exponents]
    return [float(largest * damage ** (1 / m)) for m, damage in damages]


def _ranges(reversals: Array) -> Array:
    """Ranges of all cycles of a history, those that remain open closed by its repetition.

    As `fatpack.find_rainflow_ranges` has them and in its order, several times faster.
    """
    pairs, kept = four_point_cycles(reversals.tolist())
    rest = np.asarray(fatpack.concatenate_reversals(reversals[kept], reversals[kept]))
    again, _ = four_point_cycles(rest.tolist())
    parts = [(reversals, pairs), (rest, again)]
    ends = [values[np.array(found, dtype=np.int64).reshape(-1, 2)] for values, found in parts]
    return np.abs(np.diff(np.concatenate(ends), axis=1))[:, 0]
