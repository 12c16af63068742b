"""Controls that go their own way: their distant past tells them, so that nothing fed them back.

A sine or a sum of a few follows from the past of the states that it moves as well as a controller's
output does. What a controller answers to an unknown force cannot be foretold for longer than the
force and the loop remember, though; a sum of sines can, for ever. Its effect is then no matter of
feedback but of how many sines there are: each tells two coefficients of a row, its size and its
phase (persistence of excitation; Ljung 1999, System Identification, Sec. 13.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array
from dfsm.fitting.residuals import Residuals, stacked
from dfsm.numerics.least_squares import correlation_length

# Samples of the past, and how far back the last of them lies, in correlation times.
_PAST, _BACK = 20, 2.0
# Share of a control's variance that they must tell, and of what the fit leaves that they may: in
# simulated loops under unknown forces they tell 67 % of a control at most, of sums of sines 97 %.
_OWN, _FORCE = 0.96, 0.8
# Growth over the longest run, as an exponent, up to which a fit is not unstable.
_GROWS = 1.0
# Share of the largest direction in which the past varies below which there is none: means over
# intervals that are no whole number of samples are a little rough.
_DIRECTION = 1e-2


@dataclass(frozen=True)
class Course:
    """How a control goes on by itself.

    Attributes
    ----------
    directions
        Two for each sine that it is made of.
    """

    directions: int


def own_course(residuals: Residuals, control: int, A: Array) -> Course | None:
    """What a control is made of, if its distant past tells it.

    Where the unknown force is a sine above all, the control that answers it is one, too, and ahead
    of the state by more than a control of an open loop can be: then the fit comes out unstable.

    Parameters
    ----------
    residuals
        Of any row.
    control
        Column of the inputs.
    A
        Of the fit, ``(state, state)``.

    Returns
    -------
    Course or None
        None where it may be an answer to what the row does not hold: its past does not tell it, or
        tells what the fit leaves over, too, or the fit is unstable where it has enough sines.
    """
    centred = residuals.centred()
    course = course_of(residuals, control)
    if course is None or _foretold(centred.left, _far_back(centred, control)) > _FORCE:
        return None
    # What too few sines tell of the states is chance, growth included.
    longest = residuals.step * max(map(len, centred.left))
    grows = float(np.linalg.eigvals(A).real.max()) * longest > _GROWS
    return None if grows and course.directions > len(A) else course


def course_of(residuals: Residuals, column: int) -> Course | None:
    """What an input is made of, if its distant past tells it.

    Parameters
    ----------
    residuals
        Of any row.
    column
        Of the inputs.
    """
    centred = residuals.centred()
    u = [run[:, column] for run in centred.inputs]
    back = _far_back(centred, column)
    if min(map(len, u)) < back + 4 * _PAST or sum(map(len, u)) < 10 * _PAST:
        return None
    if _foretold(u, back) < _OWN:
        return None
    past = stacked([_past(run, len(run) - _PAST + 1) for run in u])
    sizes = np.linalg.svd(past, compute_uv=False) ** 2
    return Course(int(np.sum(sizes > _DIRECTION * sizes[0])))


def _far_back(centred: Residuals, column: int) -> int:
    """Intervals beyond which neither an input nor what the fit leaves remembers anything."""
    u = [run[:, column] for run in centred.inputs]
    memory = max(_memory(u), _memory(centred.left))
    return min(int(np.ceil(_BACK * memory)), min(map(len, u)) // 3)


def poor_note(row: str, name: str, course: Course, coefficients: int, unexplained: float) -> str:
    """That a control has too few frequencies for a row, and what to do."""
    return (
        f"{row}: '{name}' is made of so few sines (about {max(course.directions // 2, 1)}) that it "
        f"cannot tell {coefficients} coefficients apart, and {unexplained:.0%} of the row is "
        "unexplained: what is missing there decides its effect; give runs in which it has more "
        "frequencies, or steps, or set linear.known"
    )


def _memory(series: Sequence[Array]) -> float:
    return float(np.mean([correlation_length(run[:, None])[0] for run in series]))


def _past(run: Array, count: int) -> Array:
    """So many samples in a row, ``(start, sample)``."""
    return np.lib.stride_tricks.sliding_window_view(run, _PAST)[:count]


def _foretold(series: Sequence[Array], back: int) -> float:
    """Share of the variance of some runs that their samples so far back and before tell."""
    counts = [len(run) - _PAST - back + 1 for run in series]
    past = stacked([_past(run, count) for run, count in zip(series, counts, strict=True)])
    now = stacked([run[-count:] for run, count in zip(series, counts, strict=True)])
    past, now = past - past.mean(axis=0), now - now.mean()
    left = now - past @ np.linalg.lstsq(past, now, rcond=1e-6)[0]
    free = len(now) / max(len(now) - _PAST, 1)
    return 1.0 - free * float(np.sum(left**2)) / max(float(np.sum(now**2)), np.finfo(float).tiny)
