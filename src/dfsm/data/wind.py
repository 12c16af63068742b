"""Wind signals: OpenFAST's relative rotor wind, and the platform's motion taken out of it."""

from __future__ import annotations

import math
import re

from dfsm.core.units import factor
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

CORRECTED_WIND = "RtVAvgxhCorr"
# What it is computed from: the wind that the rotor meets, and the platform's pitching.
WIND_SOURCES = ("RtVAvgxh", "PtfmRVyt")
_RELATIVE_WIND = re.compile(r"RtVAvg[xyz]h|A?B\dN\d+VRel", re.IGNORECASE)


def undisturbed_rotor_wind(
    trajectory: Trajectory,
    hub_height: float,
    wind: str = WIND_SOURCES[0],
    rate: str = WIND_SOURCES[1],
    name: str = CORRECTED_WIND,
) -> Trajectory:
    """Add the rotor-averaged wind with the platform's pitching taken out again.

    OpenFAST's `RtVAvgxh` is relative to the moving rotor: a hub at height h on a platform that
    pitches at the rate q sees about h q less wind. Adding h q back removes most of the response
    from the signal, ``corrected = wind + hub_height * rate``.

    Parameters
    ----------
    trajectory
        A run with both channels.
    hub_height
        Height of the hub above the centre of pitching, in m.
    wind
        Relative wind channel, in m/s or another unit of a speed.
    rate
        Platform pitch rate channel, in deg/s, rad/s or the like.
    name
        Name of the new channel, in the wind's unit.

    Returns
    -------
    Trajectory
        The same run with the new channel appended. Its step is the one whose variance is the sum
        of both channels' rounding errors, None where either is unknown.

    Raises
    ------
    DfsmError
        A channel is missing or in another unit, `name` exists already, or `hub_height` is not
        positive.
    """
    if not (math.isfinite(hub_height) and hub_height > 0):
        raise DfsmError(f"hub_height is {hub_height}, expected a positive height in m")
    if name in trajectory:
        raise DfsmError(f"{trajectory.where}: channel '{name}' exists already: give another name")
    source, motion = (trajectory.channels[i] for i in trajectory.columns((wind, rate)))
    metres = factor(source.unit, "m/s")
    if metres is None:
        raise DfsmError(
            f"{trajectory.where}: '{wind}' is in '{source.unit}', expected m/s: convert it first"
        )
    radians = factor(motion.unit, "rad/s")
    if radians is None:
        raise DfsmError(
            f"{trajectory.where}: '{rate}' is in '{motion.unit}', expected deg/s or rad/s: "
            "convert it first"
        )
    arm = hub_height * radians / metres
    step = None
    if source.step is not None and motion.step is not None:
        step = math.hypot(source.step, arm * motion.step)
    corrected = trajectory[wind] + arm * trajectory[rate]
    return trajectory.with_channels([Channel(name, source.unit, step, computed=True)], corrected)


def wind_warning(name: str) -> str | None:
    """Say why a channel should not be a disturbance, if it is a relative wind speed.

    Parameters
    ----------
    name
        Name of a channel chosen as a disturbance.

    Returns
    -------
    str | None
        One sentence for relative-wind channels such as `RtVAvgxh`, None for all others.
    """
    if not _RELATIVE_WIND.fullmatch(name):
        return None
    return (
        f"'{name}' is the wind relative to the moving rotor, so it contains the platform's own "
        "motion, which is a response and no disturbance: use the undisturbed disk average "
        f"(RotWind), or set hub_height and use the corrected channel {CORRECTED_WIND}, which adds "
        "hub height times pitch rate back"
    )
