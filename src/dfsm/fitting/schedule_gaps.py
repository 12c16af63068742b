"""Stretches of the schedule at which no training run operates.

The coefficients of a fit along a schedule are interpolated there. Rollouts over training runs, on
which verdicts rest, never go there for long and cannot tell how good they are.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dfsm.fitting.samples import Samples
from dfsm.models.linear import LinearModel
from dfsm.numerics.time_mesh import mean_over, std_over

# Standard deviations to either side of its mean at which a run is said to operate: 95 % of the
# time where a signal is normally distributed.
_AROUND = 2.0


def schedule_gaps(samples: Samples, model: LinearModel) -> list[str]:
    """Tell stretches between operating points of runs that are wider than the schedule's spacing.

    Parameters
    ----------
    samples
        All training samples.
    model
        Linear fit of the derivatives.

    Returns
    -------
    list of str
        One sentence per gap; none without a schedule, or if one run sweeps it, or where it is a
        parameter, whose values are the user's choice.
    """
    column, parameters = model.schedule, samples.signals.order.columns("parameters")
    if column is None or column >= parameters.start or len(model.grid) < 2:
        return []
    spacing = float(np.diff(np.asarray(model.grid)).mean())
    values, operating = samples.inputs[:, column], list[tuple[float, float]]()
    for rows in samples.parts:
        weights = None if samples.weights is None else samples.weights[rows]
        middle, reach = mean_over(values[rows], weights), _AROUND * std_over(values[rows], weights)
        operating.append((float(middle - reach), float(middle + reach)))
    channel, notes, reached = samples.signals.inputs[column], list[str](), -np.inf
    unit = f" {channel.unit}" if channel.unit else ""
    for (_, high), (low, _) in pairwise(sorted(operating)):
        reached = max(reached, high)
        if low - reached > spacing:
            notes.append(
                f"no training run operates between {channel.name} = {reached:.3g} and "
                f"{low:.3g}{unit}: coefficients there are interpolated, and nothing tells how good "
                f"they are; add a run at about {(low + reached) / 2:.3g}{unit}"
            )
    return notes
