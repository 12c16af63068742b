"""Why a solve did not succeed: worst constraint, bounds that hold it, functions that are NaN."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dfsm.control.nlp.program import Program, Rows
from dfsm.control.nlp.watch import violation
from dfsm.core.types import Array
from dfsm.errors import DfsmError

# A variable within this share of its size from a bound counts as being at it.
_AT_BOUND = 1e-5
# Bounds and constraints listed in a message.
_MOST = 3


def worst_violation(program: Program, z: Array) -> float:
    """Largest violation of a constraint, relative to its size."""
    amounts = violation(program.constraints(z), program.g_lower, program.g_upper)
    return float(amounts.max(initial=0.0))


def conflict(program: Program, z: Array) -> str:
    """Say which constraints are violated most, when, and which bounds are met there.

    Parameters
    ----------
    program, z
        Scaled variables at which the solver stopped.

    Returns
    -------
    str
        The head of a sentence.
    """
    amount = violation(program.constraints(z), program.g_lower, program.g_upper)
    told = []
    for rows in sorted(program.rows, key=lambda r: -amount[r.index].max(initial=0.0))[:_MOST]:
        if not len(rows.index) or amount[rows.index].max() <= 1e-6:
            continue
        k = int(np.argmax(amount[rows.index]))
        size = amount[rows.index][k] * _unit(program, rows)[k]
        told.append(f"{rows.name} misses by {size:.3g}{_when(rows.times[k])}")
    held, limits = _held(program, z), _limiting(program, z)
    text = ", ".join(told) or "all constraints are met"
    text += f"; at their limits are {', '.join(limits)}" if limits else ""
    return text + (f"; at their bounds are {', '.join(held)}" if held else "")


def _unit(program: Program, rows: Rows) -> Array:
    """What scaled values of rows are multiplied by to be in the unit of their name."""
    unit = program.row_scale[rows.index]
    return unit if rows.per is None else unit / rows.per


def _limiting(program: Program, z: Array) -> list[str]:
    """Rates, path and boundary constraints that are at a limit, or beyond."""
    g, by_name = program.constraints(z), {}
    for rows in program.rows:
        value, low, high = (a[rows.index] for a in (g, program.g_lower, program.g_upper))
        for limit, side, beyond in ((low, "lower", low - value), (high, "upper", value - high)):
            met = (low < high) & np.isfinite(limit) & (beyond > -_AT_BOUND)
            if met.any():
                number = (limit * _unit(program, rows))[met][0]
                told = f"{rows.name} ({side} limit {number:.4g})"
                by_name[told] = max(by_name.get(told, 0.0), float(met.mean()))
    ranked = sorted(by_name.items(), key=lambda pair: -pair[1])[:_MOST]
    return [f"{told} for {share:.0%} of the time" for told, share in ranked]


def runaway(program: Program, z: Array) -> str:
    """Say which variable ran away, and in which direction."""
    sizes = [(np.abs(z[r.index]).max(initial=0.0), r) for r in program.variables]
    _, rows = max(sizes, key=lambda pair: pair[0])
    k = rows.index[int(np.argmax(np.abs(z[rows.index])))]
    return f"{rows.name} runs away to {program.physical(z)[k]:.3g}"


def _held(program: Program, z: Array) -> list[str]:
    """Variables that are at a bound, those with the largest share of the horizon first."""
    held = []
    for rows in program.variables:
        value, low, high = (a[rows.index] for a in (z, program.lower, program.upper))
        free = high > low
        for limit, side in ((low, "lower"), (high, "upper")):
            met = free & np.isfinite(limit) & (np.abs(value - limit) < _AT_BOUND)
            if met.any():
                share = met.mean()
                number = (limit * program.scale[rows.index])[met][0]
                always = "" if len(met) == 1 else f" for {share:.0%} of the nodes"
                held.append((share, f"{rows.name} ({side} bound {number:.4g}){always}"))
    return [text for _, text in sorted(held, key=lambda h: -h[0])[:_MOST]]


def _when(time: float) -> str:
    return f" at {time:.4g} s" if np.isfinite(time) else ""


def require_finite(
    program: Program,
    z: Array,
    time: Array,
    names: tuple[Sequence[str], Sequence[str]],
    what: str,
) -> None:
    """Refuse a point at which a function or its slope is not finite.

    Parameters
    ----------
    program, z
        Where.
    time
        Of the rows of the first block, shape ``(row,)``, in s.
    names
        Of the outputs of every block.
    what
        Names the point in the message.

    Raises
    ------
    DfsmError
        Names the function and the first time.
    """
    for values, kind in ((program.outputs(z), ""), (program.slopes(z), "the slope of ")):
        for block, (array, labels) in enumerate(zip(values, names, strict=True)):
            finite = np.isfinite(array.reshape(len(array), len(labels), -1))
            bad = np.logical_not(finite.all(axis=2))
            if bad.any():
                column = int(np.argmax(bad.any(axis=0)))
                row = int(np.argmax(bad[:, column]))
                where = "" if block else f" at {time[row]:.4g} s"
                raise DfsmError(
                    f"{kind}{labels[column]} is not finite{where} for {what}: give a guess or "
                    "bounds where it is, or correct the function"
                )
