"""Trajectory and Dataset: what they refuse, and what they keep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dfsm.data.dataset import Dataset
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, near_matches

A, B, C = Channel("PtfmPitch", "deg", 0.01), Channel("GenSpeed", "rpm"), Channel("GenTq", "kN-m")


def make(seed: int = 0, samples: int = 101, channels=(A, B, C), **more) -> Trajectory:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(samples, len(channels)))
    more = {"name": f"run{seed}", "source": f"runs/run{seed}.outb", **more}
    return Trajectory(0.1 * np.arange(samples), values, channels, **more)


# -- how names are missed, and how runs print --------------------------------------------------


@pytest.mark.parametrize(
    ("name", "known", "hint"),
    [
        ("genspeed", ["RotSpeed", "GenSpeed"], "did you mean 'GenSpeed'?"),
        ("Tq", ["GenTq", "GenPwr"], "did you mean 'GenTq'?"),
        ("RotWind_mean_of_ten_minutes", ["RotWind", "GenTq"], "did you mean 'RotWind'?"),
        ("bld", ["BldPitch1", "Azimuth", "BldPitch2"], "did you mean 'BldPitch1' or 'BldPitch2'?"),
        ("velocity", ["v", "q"], "known are: v, q"),
        ("x", [], "none are known"),
    ],
)
def test_near_matches(name, known, hint):
    assert near_matches(name, known) == hint


def test_all_missing_channels_are_told():
    for lookup in (
        lambda: make().select(["xyz", "gentq", "GenSpeed", "xyz"]),
        lambda: make().with_roles({"xyz": "state", "gentq": "control"}),
    ):
        with pytest.raises(DfsmError) as caught:
            lookup()
        assert str(caught.value) == (
            "runs/run0.outb: no channels 'xyz', 'gentq' (did you mean 'GenTq'?); "
            "known are: PtfmPitch, GenSpeed, GenTq"
        )


def test_runs_print_in_one_line():
    channels = "PtfmPitch (deg), GenSpeed (rpm), GenTq (kN-m)"
    assert repr(make()) == (
        f"<Trajectory run0: 101 samples, 0 to 10 s, every 0.1 s; 3 channels: {channels}>"
    )
    assert repr(Dataset([make(0), make(1, channels=(A, C))])) == (
        "<Dataset: 2 runs, 202 samples, 20 s; 2 channels in every run: "
        "PtfmPitch (deg), GenTq (kN-m)>"
    )
    many = Trajectory(
        np.array([0, 1, 3]), np.zeros((3, 99)), tuple(Channel(f"\x1b{i}") for i in range(99))
    )
    assert "0 to 3 s, irregular; 99 channels: \\x1b0, " in repr(many)
    assert repr(many).endswith(", \\x1b7, …>")


# -- one run ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("time", "match"),
    [
        ([0, 1, 1, 2], r"a\.csv: time repeats at sample 2 \(1 s, then 1 s\)"),
        ([0, 1, 0.5, 2], r"a\.csv: time goes back at sample 2"),
        ([0, np.nan, 2, 3], "time is not a finite number in sample 1"),
        ([0, 1, 2, np.inf], "time is not a finite number in sample 3"),
        ([0, 1, 2], r"time \(3,\) and values \(4, 1\) do not fit"),
        ([[0, 1, 2, 3]], "do not fit"),
    ],
)
def test_bad_time_is_refused(time, match):
    with pytest.raises(DfsmError, match=match):
        Trajectory(np.array(time), np.zeros((4, 1)), (A,), source="a.csv")


def test_bad_channels_are_refused():
    with pytest.raises(DfsmError, match="'GenTq' stands there twice"):
        make(channels=(C, A, C))
    with pytest.raises(DfsmError, match="1 samples, at least 2"):
        make(samples=1)
    with pytest.raises(DfsmError, match="do not fit 1 channels"):
        Trajectory(np.arange(3), np.zeros((3, 2)), (A,))


def test_a_run_cannot_be_changed_from_outside():
    time, values = np.arange(3.0), np.zeros((3, 1))
    run = Trajectory(time, values, (A,))
    values[0] = 5
    time[0] = -1
    assert run.values[0, 0] == 0
    assert run.time[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        run.values[0] = 1


def test_access_and_selection():
    run = make()
    assert len(run) == 101
    assert run.duration == pytest.approx(10)
    assert run.time_step == pytest.approx(0.1)
    assert "GenTq" in run
    assert "Time" not in run
    assert np.array_equal(run["GenSpeed"], run.values[:, 1])
    part = run.select(["GenTq", "PtfmPitch"])
    assert part.channels == (C, A)
    assert np.array_equal(part.values, run.values[:, [2, 0]])
    assert A.label == "PtfmPitch (deg)"
    assert Channel("Cp").label == "Cp"


def test_an_unknown_channel_names_the_file_and_near_names():
    with pytest.raises(
        DfsmError, match=r"runs/run0\.outb: no channel 'ptfmPich'; did you mean 'PtfmPitch'\?"
    ):
        make().select(["ptfmPich"])
    with pytest.raises(DfsmError, match="known are: PtfmPitch, GenSpeed, GenTq"):
        _ = make()["xyz"]
    with pytest.raises(DfsmError, match="no channel 'GenTqq'"):
        make().with_roles({"GenTqq": "control"})


def test_roles():
    run = make().with_roles({"GenTq": "control"}).with_roles({"PtfmPitch": "state"})
    assert [c.role for c in run.channels] == ["state", None, "control"]


@pytest.mark.parametrize(("start", "stop", "n"), [(2, 4, 21), (None, 4, 41), (9.9, None, 2)])
def test_windows_include_both_ends(start, stop, n):
    run = make(wall_time=50.0).window(start, stop)
    assert len(run) == n
    assert run.wall_time == pytest.approx(50 * run.duration / 10)
    if start is not None:
        assert run.time[0] == pytest.approx(start)


def test_most_of_a_run_is_no_copy_and_a_small_part_does_not_keep_it_all():
    run = make()
    most, part = run.window(1.0), run.window(1.0, 1.5)
    assert np.shares_memory(most.values, run.values)
    assert not most.values.flags.writeable
    assert not np.shares_memory(part.values, run.values)
    assert not part.values.flags.writeable
    other = make(seed=1).on_time_of(run)
    assert other.time is run.time
    assert np.array_equal(other.values, make(seed=1).values)
    shorter = make(samples=51)
    assert shorter.on_time_of(run) is shorter


def test_a_run_shorter_than_the_window_is_a_sentence():
    with pytest.raises(
        DfsmError, match=r"runs from 0 s to 10 s, shorter than .* \(100 to … s\).*leave the run out"
    ):
        make().window(100)
    with pytest.raises(DfsmError, match="shorter than the time window"):
        make().window(0.01, 0.05)


def test_time_step_is_none_on_an_irregular_mesh():
    time = np.array([0, 1, 2.01, 3])
    assert Trajectory(time, np.zeros((4, 1)), (A,)).time_step is None
    late = 1e6 + 0.1 * np.arange(1000)
    assert Trajectory(late, np.zeros((1000, 1)), (A,)).time_step == pytest.approx(0.1)


def test_nan_and_inf_are_named_with_channel_and_time():
    run = make()
    assert run.require_finite() is run
    values = run.values.copy()
    values[20:23, 1] = [np.nan, np.inf, np.nan]
    bad = Trajectory(run.time, values, run.channels, source="x.outb")
    with pytest.raises(
        DfsmError, match=r"x\.outb: channel 'GenSpeed' has 3 NaN .* the first at 2 s"
    ):
        bad.require_finite()
    assert bad.select(["GenTq"]).require_finite()


def test_with_channels_appends():
    run = make()
    new = run.with_channels([Channel("Sum", "-")], run["GenTq"] + run["GenSpeed"])
    assert new.names[-1] == "Sum"
    assert np.array_equal(new["Sum"], run["GenTq"] + run["GenSpeed"])
    with pytest.raises(DfsmError, match="stands there twice"):
        run.with_channels([C], run["GenTq"])


def test_resampling_is_linear_and_stays_inside():
    run = make()
    new = run.resample([0, 0.05, 10.0])
    assert np.array_equal(new.values[0], run.values[0])
    np.testing.assert_allclose(new.values[1], run.values[:2].mean(axis=0))
    for time in ([-1, 1], [5, 10.5], [np.nan, 1]):
        with pytest.raises(DfsmError, match="stay inside the run"):
            run.resample(time)


def test_pandas_round_trip():
    run = make()
    frame = run.to_pandas()
    assert frame.index.name == "Time"
    assert frame.attrs["units"]["GenSpeed"] == "rpm"
    back = Trajectory.from_pandas(frame, name="back")
    assert back.digest == run.digest
    assert [c.unit for c in back.channels] == ["deg", "rpm", "kN-m"]
    assert Trajectory.from_pandas(frame, {"GenTq": "Nm"}).channel("GenTq").unit == "Nm"


@pytest.mark.parametrize(
    ("frame", "match"),
    [
        (pd.DataFrame({"a": ["x", "y"]}, index=[0.0, 1.0]), "column 'a' is not numeric"),
        (pd.DataFrame({"a": [1, 2]}, index=["x", "y"]), "the index is not time in s"),
        (pd.DataFrame([[1, 2], [3, 4]], columns=["a", "a"]), "'a' stands there twice"),
        (pd.DataFrame(index=[0.0, 1.0]), "no column besides its index"),
        (pd.DataFrame({"a": [1, 2]}, index=[1.0, 1.0]), "time repeats"),
    ],
)
def test_bad_tables_are_sentences(frame, match):
    with pytest.raises(DfsmError, match=match):
        Trajectory.from_pandas(frame)


def test_the_digest_is_of_the_content():
    run = make()
    same = make(name="other", source="elsewhere.csv", wall_time=3.0)
    assert same.digest == run.digest
    assert make(1).digest != run.digest
    assert make(channels=(A, B, Channel("GenTq", "Nm"))).digest != run.digest


# -- many runs ----------------------------------------------------------------------------------


@settings(max_examples=10, deadline=None)
@given(st.permutations(range(5)))
def test_the_order_of_runs_never_matters(order):
    runs = [make(i, samples=20 + i) for i in range(5)]
    first, second = Dataset(runs), Dataset(runs[i] for i in order)
    assert [r.name for r in first] == [r.name for r in second]
    assert np.array_equal(first.stack(["GenTq"]), second.stack(["GenTq"]))
    for a, b in zip(first.split(0.4, seed=3), second.split(0.4, seed=3), strict=True):
        assert [r.name for r in a] == [r.name for r in b]


def test_split_is_by_run_and_seeded():
    data = Dataset(make(i) for i in range(10))
    train, test = data.split(0.2, seed=1)
    assert (len(train), len(test)) == (8, 2)
    assert {r.name for r in train} | {r.name for r in test} == {r.name for r in data}
    again = data.split(0.2, seed=1)[1]
    assert [r.name for r in again] == [r.name for r in test]
    draws = {tuple(r.name for r in data.split(0.2, seed=s)[1]) for s in range(10)}
    assert len(draws) > 3
    small = Dataset([make(0), make(1)])
    assert [len(part) for part in small.split(0.01)] == [1, 1]
    assert [len(part) for part in small.split(0.99)] == [1, 1]
    with pytest.raises(DfsmError, match="expected between 0 and 1"):
        data.split(1.0)
    with pytest.raises(DfsmError, match="one run cannot be split"):
        Dataset([make()]).split()


def matched_runs() -> list[Trajectory]:
    """Two runs with the same wind up to its rounding, one with another wind."""
    time, rng = 0.1 * np.arange(200), np.random.default_rng(0)
    first, other = rng.normal(8, 1, (2, 200))
    winds = {"a": first, "b": first + 1e-3 * rng.normal(size=200), "c": other, "d": other[::-1]}
    channels = (Channel("wind", "m/s"), Channel("depth", "m"), Channel("torque", "kN-m"))
    return [
        Trajectory(
            time, np.stack([w, np.full(200, 30.0), rng.normal(size=200)], axis=1), channels, name=n
        )
        for n, w in winds.items()
    ]


def test_runs_that_share_channels_are_found():
    data = Dataset(matched_runs())

    def groups(*names: str) -> set[str]:
        return {"".join(sorted(data[k].name for k in g)) for g in data.matched(names)}

    assert groups("wind") == groups("wind", "depth") == {"ab", "c", "d"}
    assert groups("wind", "torque") == groups() == {"a", "b", "c", "d"}
    # A constant says nothing about what the runs have in common.
    assert groups("depth") == {"a", "b", "c", "d"}
    later = Trajectory(data[0].time + 1, data[0].values, data[0].channels, name="later")
    assert len(Dataset([data[0], later]).matched(["wind"])) == 2
    with pytest.raises(DfsmError, match="no channel 'wave'"):
        data.matched(["wave"])


def test_runs_that_share_channels_stay_on_one_side():
    data = Dataset(matched_runs())
    for seed in range(10):
        train, test = ({r.name for r in part} for part in data.split(0.25, seed, together=["wind"]))
        assert train | test == set("abcd")
        assert not train & test
        assert ("a" in train) == ("b" in train)
    same = Dataset(r for r in data if r.name in "ab")
    most = Dataset(r for r in data if r.name in "abc")
    for seed in range(10):
        assert [r.name for r in most.split(0.25, seed, together=["wind"])[1]] == ["c"]
    # Where nothing else can be held out, other controls still tell something.
    assert [len(part) for part in same.split(together=["wind"])] == [1, 1]


def test_a_dataset_refuses_none_and_twice_and_strangers():
    with pytest.raises(DfsmError, match="no runs were given"):
        Dataset([])
    with pytest.raises(DfsmError, match=r"a\.outb and b\.outb hold the same|b\.outb and a\.outb"):
        Dataset([make(source="a.outb"), make(1), make(source="b.outb")])
    with pytest.raises(DfsmError, match="2 runs have no channel in common"):
        Dataset([make(channels=(A, B)), make(1, channels=(C,))])


def test_units_must_agree():
    other = make(1, channels=(A, Channel("GenSpeed", "rad/s"), C))
    data = Dataset([make(0), other])
    with pytest.raises(
        DfsmError, match=r"'GenSpeed' is in '(rpm|rad/s)' in runs/run\d\.outb but in"
    ):
        data.select(["GenTq", "GenSpeed"])
    assert data.select(["GenTq"]).names == ("GenTq",)


def test_channels_over_runs():
    coarse = make(1, channels=(Channel("PtfmPitch", "deg", 0.05), C))
    data = Dataset([make(0), coarse])
    assert set(data.names) == {"PtfmPitch", "GenTq"}
    assert data.channel("PtfmPitch").step == 0.05
    assert data.channel("GenTq").step is None
    with pytest.raises(DfsmError, match=r"runs/run1\.outb: no channel 'GenSpeed'"):
        data.select(["GenSpeed"])


def test_windows_and_stacks_of_unequal_runs():
    data = Dataset([make(0), make(1, samples=61)])
    part = data.window(5)
    assert sorted(len(r) for r in part) == [11, 51]
    stacked = part.stack(["GenTq", "PtfmPitch"])
    assert stacked.shape == (62, 2)
    assert np.array_equal(stacked[: len(part[0])], part[0].select(["GenTq", "PtfmPitch"]).values)
    assert len(part[0:1]) == 1
    with pytest.raises(DfsmError, match=r"run1\.outb: runs from 0 s to 6 s"):
        data.window(7)


def test_bundled_data_in_another_order_is_the_same_dataset():
    from dfsm.data.readers import read_all

    folder = Path(__file__).parents[1] / "examples" / "iea15"
    names = ["iea15_2dof_06mps_s01.parquet", "iea15_2dof_06mps_s09.outb"]
    both = [Dataset(read_all(order, base=folder)) for order in (names, names[::-1])]
    assert [r.digest for r in both[0]] == [r.digest for r in both[1]]
    assert both[0].window(100).stack(["RotWind"]).shape == (2 * 12001, 1)
