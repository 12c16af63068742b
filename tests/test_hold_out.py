"""Runs held out at random, by operating point, and several times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import dfsm
from conftest import changed, write_config
from dfsm.config.fit import parse_config
from dfsm.data.dataset import Dataset
from dfsm.data.hold_out import HoldOut, divisions, operating_points
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

TIME = np.arange(0, 50, 0.5)


def run(mean: float, seed: int) -> Trajectory:
    """Wind that varies by 1 m/s around its mean."""
    wind = mean + np.sqrt(2) * np.sin(TIME + seed)
    channels = (Channel("wind", "m/s"), Channel("mass", "t"))
    values = np.stack([wind, np.full_like(wind, np.round(mean))], axis=1)
    return Trajectory(TIME, values, channels, name=f"{mean:g}_{seed}")


def runs(*means: float, seeds: int = 3) -> Dataset:
    return Dataset(run(mean, seed) for mean in means for seed in range(seeds))


def names(part: Dataset) -> set[str]:
    return {r.name for r in part}


def winds(part: Dataset) -> set[str]:
    return {r.name.split("_")[0] for r in part}


def test_the_operating_point_between_others_is_held_out_first():
    data = runs(6, 12, 18)
    ((training, held),) = divisions(data, HoldOut(by="wind"))
    assert winds(held) == {"12"}
    assert winds(training) == {"6", "18"}
    assert names(held) | names(training) == names(data)
    # Each in its turn, and never all of them.
    splits = divisions(data, HoldOut(by="wind", splits=3))
    assert sorted(min(winds(held)) for _, held in splits) == ["12", "18", "6"]
    assert all(len(winds(held)) == 1 for _, held in splits)


def test_several_splits_hold_out_other_runs_each_time():
    """One run alone would decide for all: drawn anew each time, it often is the same again."""
    data = runs(6, 12, 18, seeds=2)
    parts = divisions(data, HoldOut(share=0.34, splits=3), seed=3)
    assert set.union(*(names(held) for _, held in parts)) == names(data)
    assert sum(len(held) for _, held in parts) == len(data)
    # The first is what a single split draws; when all had their turn, some have another.
    ((_, alone),) = divisions(data, HoldOut(share=0.34), seed=3)
    assert names(parts[0][1]) == names(alone)
    assert len(divisions(data, HoldOut(share=0.34, splits=5), seed=3)) == 5


def test_as_many_operating_points_as_come_nearest_to_the_share():
    ((_, held),) = divisions(runs(6, 8, 10, 12, 14, seeds=2), HoldOut(by="wind", share=0.45))
    assert len(winds(held)) == 2
    assert not winds(held) & {"6", "14"}
    # Two points: one trains, one judges, whatever the share.
    ((training, held),) = divisions(runs(6, 12), HoldOut(by="wind", share=0.9))
    assert len(winds(held)) == len(winds(training)) == 1


def test_means_without_gaps_are_cut_into_equal_parts():
    data = Dataset(run(6 + 0.3 * k, k) for k in range(10))
    points = operating_points(data, "wind", share=0.2)
    assert [len(p) for p in points] == [2] * 5
    means = [data[i]["wind"].mean() for p in points for i in p]
    assert (np.diff(means) > 0).all()


def test_a_constant_channel_tells_points_apart_by_its_values():
    points = operating_points(runs(6.1, 6.3, 9, seeds=2), "mass")
    assert sorted(len(p) for p in points) == [2, 4]


def test_random_splits_differ_and_a_single_one_is_that_of_the_dataset():
    data = runs(6, 12, 18)
    (one,) = divisions(data, HoldOut(share=0.3), seed=4)
    assert [names(p) for p in one] == [names(p) for p in data.split(0.3, 4)]
    several = divisions(data, HoldOut(share=0.3, splits=4), seed=4)
    assert len({frozenset(names(held)) for _, held in several}) > 1
    assert all(not names(a) & names(b) for a, b in several)


@pytest.mark.parametrize(
    ("hold_out", "means", "message"),
    [
        (HoldOut(by="wnd"), (6, 12), "hold_out.by names 'wnd', which .* does not have"),
        (HoldOut(by="wind"), (6, 6.1), "whose mean is .* in all 6 runs"),
        (HoldOut(by="wind", splits=3), (6, 12), "hold_out.splits is 3, .* have 2 operating"),
    ],
)
def test_what_cannot_be_divided(hold_out, means, message):
    with pytest.raises(DfsmError, match=message):
        divisions(runs(*means), hold_out)


def test_settings_are_checked_and_read_from_a_configuration(tmp_path: Path):
    with pytest.raises(DfsmError, match=r"hold_out.share is 1.0, expected a share"):
        HoldOut(share=1.0)
    content = changed("refine", value={"hold_out": {"by": "w", "splits": 2}})
    path = write_config(tmp_path / "c.yaml", content)
    refine = parse_config(path).refine
    assert refine is not None
    assert refine.hold_out == dfsm.HoldOut(by="w", splits=2)
