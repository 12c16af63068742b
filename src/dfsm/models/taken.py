"""What a model takes of a run, for whoever calls the model from another program."""

from __future__ import annotations

import warnings

from dfsm.data.features import guessed_ends
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmWarning
from dfsm.models.completion import completed
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.signals import require_constant


def model_inputs(
    model: DFSM, run: Trajectory, *, start: float | None = None, stop: float | None = None
) -> Trajectory:
    """Return the inputs of a model along a run, those that are computed from others among them.

    An exported model is a function of all its inputs: rates, delays and leads of waves, winds over
    rings of the rotor. `simulate` computes them from what was recorded; another program is given
    them by this.

    Parameters
    ----------
    model
        The surrogate.
    run
        The whole record, so that what lies before `start` counts for delays and rates.
    start, stop
        Times in s; None is the run's own.

    Returns
    -------
    Trajectory
        Controls, disturbances, parameters and harmonics of the wind field, in the model's order and
        units; the azimuth in deg behind them where a model of turning blades is given one.

    Raises
    ------
    DfsmError
        The run lacks a channel, holds one of another dimension or one that is not finite, or a
        parameter changes within it.

    Warns
    -----
    DfsmWarning
        Channels were converted, or delayed and leading inputs are not in the record at its ends.
    """
    require_model(model)
    s = model.signals
    names = [*s.exogenous, *s.names("field")]
    whole = completed(run, s)
    whole.columns(names)
    if s.azimuth is not None and s.azimuth.angle is not None and s.azimuth.angle in whole:
        names.append(s.azimuth.angle)
    taken = whole.select(names).window(start, stop).require_finite()
    require_constant(taken, s.names("parameters"))
    first, last = guessed_ends(whole, s.features, (float(taken.time[0]), float(taken.time[-1])))
    held = [f"delayed inputs hold their first value for the first {first:.3g} s"] * bool(first)
    held += [f"leading inputs hold their last value for the last {last:.3g} s"] * bool(last)
    if held:
        warnings.warn(
            f"{run.where}: {'; '.join(held)}: choose another start or stop",
            DfsmWarning,
            stacklevel=2,
        )
    return taken
