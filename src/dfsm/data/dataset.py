"""Dataset: many runs, in an order that their content decides."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import overload

import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import agree, known
from dfsm.data.trajectory import Channel, Trajectory, labels
from dfsm.errors import DfsmError

# Share of its standard deviation within which a channel is the same in two runs.
_SAME = 0.01


class Dataset(Sequence[Trajectory]):
    """Runs in an order that their content decides, so that the order of files never matters.

    Meshes and lengths may differ from run to run. The runs share at least one channel.

    Raises
    ------
    DfsmError
        No runs; the same run twice; no common channel.
    """

    def __init__(self, runs: Iterable[Trajectory]) -> None:
        self.runs: tuple[Trajectory, ...] = tuple(sorted(runs, key=lambda r: r.digest))
        if not self.runs:
            raise DfsmError("no runs were given, at least one is needed")
        for a, b in zip(self.runs, self.runs[1:], strict=False):
            if a.digest == b.digest:
                raise DfsmError(
                    f"{a.where} and {b.where} hold the same data: give each run once, "
                    "a repeated one would count twice"
                )
        if not self.names and any(r.names for r in self.runs):
            raise DfsmError(
                f"the {len(self.runs)} runs have no channel in common ({self.runs[0].where} has "
                f"{', '.join(self.runs[0].names[:6]) or 'none'}): check that they belong together"
            )

    def __len__(self) -> int:
        return len(self.runs)

    def __repr__(self) -> str:
        shared = [self.runs[0].channel(n) for n in self.names]
        return (
            f"<Dataset: {len(self)} runs, {sum(map(len, self.runs))} samples, "
            f"{sum(r.duration for r in self.runs):g} s; {len(shared)} channels in every run: "
            f"{labels(shared)}>"
        )

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Trajectory, ...]: ...
    def __getitem__(self, index: int | slice) -> Trajectory | tuple[Trajectory, ...]:
        """Return one run, or a tuple of runs for a slice."""
        return self.runs[index]

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.runs)

    @property
    def names(self) -> tuple[str, ...]:
        """Channels that every run has, in the first run's order."""
        common = set(self.runs[0].names).intersection(*(r.names for r in self.runs))
        return tuple(n for n in self.runs[0].names if n in common)

    def channel(self, name: str) -> Channel:
        """Describe a channel over all runs: its unit, and the coarsest quantisation step.

        The unit is as the first run that states one spells it.

        Raises
        ------
        DfsmError
            A run lacks the channel, or two runs give it different units.
        """
        channels = [run.channel(name) for run in self.runs]
        stated = next((k for k, c in enumerate(channels) if known(c.unit)), 0)
        first = channels[stated]
        for run, channel in zip(self.runs, channels, strict=True):
            if not agree(channel.unit, first.unit):
                raise DfsmError(
                    f"channel '{name}' is in '{first.unit}' in {self.runs[stated].where} but in "
                    f"'{channel.unit}' in {run.where}: convert one of them"
                )
        steps = [c.step for c in channels if c.step is not None]
        return replace(channels[0], unit=first.unit, step=max(steps) if steps else None)

    def select(self, names: Iterable[str]) -> Dataset:
        """Keep the named channels of every run; units must agree between runs."""
        names = tuple(names)
        selected = [r.select(names) for r in self.runs]
        for name in names:
            self.channel(name)
        return Dataset(selected)

    def window(self, start: float | None = None, stop: float | None = None) -> Dataset:
        """Keep a time window (s) of every run, see `Trajectory.window`."""
        return Dataset(r.window(start, stop) for r in self.runs)

    def matched(self, names: Iterable[str]) -> tuple[tuple[int, ...], ...]:
        """Group the runs by whether some channels are the same in them, at the same times.

        Parameters
        ----------
        names
            Disturbances, say: a simulation that was repeated with other controls matches the first.

        Returns
        -------
        tuple of tuple of int
            Indices of the runs of every group. Channels are the same where they are less than one
            hundredth of their standard deviation apart (RMS), which leaves room for rounding; those
            that are constant in a run do not make it match another.
        """
        names = tuple(names)
        if not names:
            return tuple((k,) for k in range(len(self.runs)))
        parts = [run.select(names) for run in self.runs]
        means = np.array([p.values.mean(axis=0) for p in parts])
        limits = np.array([_SAME * p.values.std(axis=0) for p in parts])
        groups: list[list[int]] = []
        for k, part in enumerate(parts):
            for group in groups:
                first = group[0]
                # Signals that are close in the mean square have means that are close, too.
                near = (np.abs(means[k] - means[first]) <= limits[first]).all()
                if near and limits[first].any() and _same(parts[first], part, limits[first]):
                    group.append(k)
                    break
            else:
                groups.append([k])
        return tuple(tuple(group) for group in groups)

    def split(
        self,
        test_fraction: float = 0.2,
        seed: int = 0,
        together: Iterable[str] = (),
        drawn: Sequence[str] = (),
    ) -> tuple[Dataset, Dataset]:
        """Split by run, never within one: neighbouring samples are not independent.

        Parameters
        ----------
        test_fraction
            Share of the runs for the second part, rounded to at least one run.
        seed
            Seed of the draw.
        together
            Channels: runs in which they are the same stay on one side, see `matched`, unless that
            is all runs.
        drawn
            Digests of runs that were test runs before, once for each time: the others come first.

        Returns
        -------
        tuple[Dataset, Dataset]
            Training and test runs.

        Raises
        ------
        DfsmError
            Fewer than two runs, or a fraction outside (0, 1).
        """
        if not 0 < test_fraction < 1:
            raise DfsmError(f"test_fraction is {test_fraction}, expected between 0 and 1")
        if len(self) < 2:
            raise DfsmError("one run cannot be split into training and test: give more runs")
        groups = self.matched(together)
        if len(groups) == 1:
            groups = self.matched(())
        n_test = min(len(self) - 1, max(1, round(test_fraction * len(self))))
        # A large group must not leave next to nothing to train with.
        most = max(n_test, len(self) // 2)
        test: set[int] = set()
        often = [max(drawn.count(self.runs[i].digest) for i in group) for group in groups]
        order = np.random.default_rng(seed).permutation(len(groups))
        for k in sorted(order, key=lambda k: often[k]):
            if len(test) < n_test and len(test) + len(groups[k]) <= most:
                test.update(groups[k])
        return (
            Dataset(r for i, r in enumerate(self.runs) if i not in test),
            Dataset(r for i, r in enumerate(self.runs) if i in test),
        )

    def stack(self, names: Iterable[str]) -> Array:
        """Lay the samples of all runs below each other, shape ``(sample, channel)``."""
        names = tuple(names)
        return np.concatenate([r.select(names).values for r in self.runs])


def _same(first: Trajectory, other: Trajectory, limits: Array) -> bool:
    """Whether all channels are at most so far apart, in the mean square and at the same times."""
    if first.time.shape != other.time.shape or not np.allclose(first.time, other.time):
        return False
    return bool((np.mean((first.values - other.values) ** 2, axis=0) <= limits**2).all())
