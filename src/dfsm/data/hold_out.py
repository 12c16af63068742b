"""Which runs are held out: some of them at random, or whole operating points.

A run held out at random has neighbours at its own mean wind among those that train, so that its
error says nothing of winds between them. With whole operating points left out it does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.data.dataset import Dataset
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, near_matches

# Means of runs at one operating point lie closer than this share of the spread within a run.
_APART = 0.5


@settings_class
class HoldOut:
    """How runs are divided into those that train and those that judge.

    Attributes
    ----------
    share
        Of the runs that are held out, at least one.
    by
        Channel or parameter whose means tell operating points apart, e.g. a wind speed: all runs of
        one or more of them are held out, those between others first. None draws single runs.
    splits
        Divisions into two, each with other runs held out as long as there are any.
    """

    share: float = 0.2
    by: str | None = None
    splits: int = 1

    def __post_init__(self) -> None:
        require(0 < self.share < 1, "hold_out.share", self.share, "a share between 0 and 1")
        require(self.splits >= 1, "hold_out.splits", self.splits, "at least 1")


def checked(hold_out: float | HoldOut, name: str) -> HoldOut:
    """A share alone, or all settings, as settings.

    Parameters
    ----------
    hold_out
        As a user writes it.
    name
        Of the key, for errors.
    """
    if isinstance(hold_out, HoldOut):
        return hold_out
    require(0 < hold_out < 1, name, hold_out, "a share between 0 and 1")
    return HoldOut(share=hold_out)


def in_time(
    run: Trajectory, share: float, start: float | None = None, stop: float | None = None
) -> tuple[Dataset, Dataset]:
    """The first and the last part of one record.

    Parameters
    ----------
    run
        The record.
    share
        Of the time between `start` and `stop` that the last part takes.
    start, stop
        Window in s that is used.

    Raises
    ------
    DfsmError
        A record that is too short for the window, or for two parts.
    """
    used = run.window(start, stop)
    at = round((1 - share) * (len(used) - 1))
    if not 2 <= at < len(used) - 2:
        raise DfsmError(
            f"{run.where} has {len(used)} samples, too few to train with the first and judge by "
            f"the last {share:.0%} of them: give more runs, or a longer one"
        )
    cut = float(used.time[at])
    before, after = run.window(None, cut), used.window(float(used.time[at + 1]), None)
    names = f"{run.name} until {cut:g} s", f"{run.name} after {cut:g} s"
    return (
        Dataset([replace(before, name=names[0])]),
        Dataset([replace(after, name=names[1])]),
    )


def divisions(
    data: Dataset,
    hold_out: HoldOut,
    seed: int = 0,
    together: Iterable[str] = (),
    start: float | None = None,
    stop: float | None = None,
) -> list[tuple[Dataset, Dataset]]:
    """Training runs and runs held out, for every split.

    Parameters
    ----------
    data
        All runs.
    hold_out
        How to divide them.
    seed
        Of the draw.
    together
        Channels: runs in which they are the same stay on one side, see `Dataset.matched`. Without
        meaning where whole operating points are held out, to which such runs belong anyway.
    start, stop
        Window in s over which means are taken.

    Raises
    ------
    DfsmError
        Fewer than two runs or operating points, no such channel, or more splits than operating
        points.
    """
    if hold_out.by is None:
        drawn, together = list[str](), tuple(together)
        parts = list[tuple[Dataset, Dataset]]()
        for k in range(hold_out.splits):
            parts.append(data.split(hold_out.share, seed + k, together, drawn))
            drawn += [run.digest for run in parts[-1][1]]
        return parts
    groups = operating_points(data, hold_out.by, hold_out.share, start, stop)
    if hold_out.splits > len(groups):
        raise DfsmError(
            f"hold_out.splits is {hold_out.splits}, but the runs have {len(groups)} operating "
            f"points by '{hold_out.by}': ask for at most so many"
        )
    inner, generator = range(1, len(groups) - 1), np.random.default_rng(seed)
    order = [*generator.permutation(inner), *generator.permutation([0, len(groups) - 1])]
    wanted = hold_out.share * len(data)
    parts = []
    for k in range(hold_out.splits):
        held: set[int] = set()
        # One operating point trains in any case.
        for point in [*order[k:], *order[:k]][:-1]:
            more = held.union(groups[point])
            if held and abs(len(more) - wanted) >= abs(len(held) - wanted):
                break
            held = more
        parts.append(
            (
                Dataset(run for i, run in enumerate(data) if i not in held),
                Dataset(run for i, run in enumerate(data) if i in held),
            )
        )
    return parts


def operating_points(
    data: Dataset,
    by: str,
    share: float = 0.2,
    start: float | None = None,
    stop: float | None = None,
) -> tuple[tuple[int, ...], ...]:
    """Runs by operating point: indices of the runs of each, along the means of a channel.

    Parameters
    ----------
    data
        All runs.
    by
        The channel.
    share
        Where means leave no gaps, as in a series of runs at wind speeds close to one another, every
        group holds about this share of the runs.
    start, stop
        Window in s.

    Raises
    ------
    DfsmError
        A run without the channel, or means that do not differ.
    """
    for run in data:
        if by not in run:
            raise DfsmError(
                f"hold_out.by names '{by}', which {run.where} does not have; "
                + near_matches(by, list(data.names))
            )
    parts = [run.window(start, stop)[by] for run in data]
    means = np.array([part.mean() for part in parts])
    apart = _APART * float(np.median([part.std() for part in parts]))
    order = np.argsort(means, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(means[order]) > apart) + 1)
    if len(groups) == 1 and np.ptp(means) > apart:
        groups = np.array_split(order, min(len(data), max(2, round(1 / share))))
    if len(groups) == 1:
        raise DfsmError(
            f"hold_out.by names '{by}', whose mean is {_range(means)} in all {len(data)} runs: "
            "hold out runs at random (a share alone), or give runs at other operating points"
        )
    return tuple(tuple(int(i) for i in group) for group in groups)


def _range(means: Sequence[float] | Array) -> str:
    low, high = float(np.min(means)), float(np.max(means))
    return f"{low:.4g}" if np.isclose(low, high) else f"{low:.4g} to {high:.4g}"
