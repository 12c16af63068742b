"""Prediction intervals: coverage on new runs, their file, and what they refuse."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV, LTI
from dfsm.fitting.settings import FitSettings
from dfsm.models.signals import Provenance
from dfsm.selection.left_out import _pieces, cross_calibrate
from dfsm.simulation.simulate import simulate
from dfsm.validation.calibrate import calibrate
from dfsm.validation.intervals import load_intervals
from dfsm.validation.validate import validate
from systems import wander

# That a force is hidden is told, and is the point here.
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*rollouts spend:dfsm.errors.DfsmWarning"),
    pytest.mark.filterwarnings("ignore:derivatives are not to be fitted:dfsm.errors.DfsmWarning"),
]

TIME = np.arange(0, 40.01, 0.1)
SETTINGS = FitSettings(
    states=(StateSpec(name="q"),),
    disturbances=("w",),
    outputs=("y",),
    linear=LPV(schedule="w", points=3, margin=0.1),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


def run(seed: int) -> Trajectory:
    """q' = -q + w + a force that no channel holds, twice as strong in high winds; y = 2 q."""
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-2, 2)
    w, hidden = (wander(rng, m, 1.0)(TIME) for m in (mean, 0.0))
    hidden = hidden * np.where(w > 0, 2.0, 1.0)
    q = np.zeros(len(TIME))
    for k in range(len(TIME) - 1):
        q[k + 1] = q[k] + 0.1 * (-q[k] + w[k] + hidden[k])
    channels = (Channel("q", "m"), Channel("w", "m/s"), Channel("y", "m"))
    return Trajectory(TIME, np.stack([q, w, 2 * q], axis=1), channels, name=f"run{seed}")


@pytest.fixture(scope="module")
def model():
    return fit([run(seed) for seed in range(8)], SETTINGS).model


@pytest.fixture(scope="module")
def intervals(model):
    return calibrate(model, [run(seed) for seed in range(100, 104)])


@pytest.mark.parametrize("level", [0.7, 0.9])
def test_new_runs_lie_inside_as_often_as_promised(model, level):
    found = calibrate(model, [run(seed) for seed in range(100, 160)], level=level)
    assert found.channels == ("q", "y")
    new = [run(seed) for seed in range(200, 260)]
    shares = [found.coverage(simulate(model, r), r, r) for r in new]
    np.testing.assert_allclose(np.mean(shares, axis=0), level, atol=0.05)
    # y = 2 q, and the hidden force is stronger where the wind is.
    np.testing.assert_allclose(found.half_width[:, 1], 2 * found.half_width[:, 0], rtol=0.05)
    assert found.half_width[-1, 0] > 1.3 * found.half_width[0, 0]


def test_few_runs_do_not_make_them_narrow(model):
    """With three calibration runs the mean over many draws still covers about what it says."""
    shares = []
    for draw in range(12):
        found = calibrate(model, [run(1000 + 3 * draw + k) for k in range(3)], level=0.8)
        new = run(2000 + draw)
        shares.append(found.coverage(simulate(model, new), new, new)[0])
    assert np.mean(shares) > 0.7


def test_ends_lie_around_the_rollout(model, intervals):
    found = intervals
    new = run(300)
    rollout = simulate(model, new)
    low, high = found.around(rollout, new)
    middle = rollout.trajectory.select(found.channels).values
    np.testing.assert_allclose((low.values + high.values) / 2, middle, atol=1e-12)
    assert (high.values > low.values).all()
    assert found.runs == tuple(f"run{k}" for k in range(100, 104))
    beside = found.beside(rollout, new)
    assert beside.names == ("q", "y", "q_low", "q_high", "y_low", "y_high")
    assert beside.channel("y_high").unit == "m"
    np.testing.assert_array_equal(beside["y_high"], high["y"])
    np.testing.assert_array_equal(beside["q_low"], low["q"])


def test_a_model_without_a_schedule():
    choices = replace(SETTINGS, linear=LTI(margin=0.1))
    model = fit([run(seed) for seed in range(8)], choices).model
    found = calibrate(model, [run(seed) for seed in range(100, 110)])
    assert found.schedule is None
    new = run(300)
    assert 0.5 < found.coverage(simulate(model, new), new, new)[0] <= 1


def test_a_channel_that_is_always_zero(tmp_path):
    silent = [replace(r, values=r.values * [1, 1, 0]) for r in map(run, range(12))]
    with pytest.warns(DfsmWarning, match="output 'y' is 0 throughout"):
        model = fit(silent[:8], SETTINGS).model
    found = calibrate(model, silent[8:])
    assert found.half_width[:, 1].max() < 1e-12
    found.save(tmp_path / "i.json")
    assert (load_intervals(tmp_path / "i.json").half_width == found.half_width).all()


def test_a_validation_tells_the_coverage(model, intervals):
    new = [run(300), run(301)]
    found = validate(model, new, intervals=intervals)
    expected = [intervals.coverage(simulate(model, r), r, r) for r in new]
    assert found.coverage("q") == [share[0] for share in expected]
    values = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert values["intervals"]["level"] == 0.9
    assert values["intervals"]["mean_coverage"]["y"] == np.mean(expected, axis=0)[1]
    own = [r["models"] for r in values["runs"]]
    assert [m["multi-fidelity"]["coverage"]["y"] for m in own] == [s[1] for s in expected]
    assert own[0]["linear-fit"]["coverage"] == {}
    assert found.warnings == ()
    without = validate(model, new)
    assert without.coverage("q") is None
    assert without.to_dict()["intervals"] is None


def test_runs_that_are_not_new_are_told(model, intervals):
    found = calibrate(model, [run(0), run(100), run(101)])
    (told,) = found.warnings
    assert "1 of the 3 calibration runs were used in training (run0)" in told
    notes = validate(model, [run(101), run(300)], intervals=found).warnings
    assert "1 of the 2 test runs calibrated the intervals (run101)" in notes[0]
    assert notes[1] == f"intervals: {told}"
    # So are runs that a refinement held out at first: it learns from them in the end.
    groups = {"training": [f"run{k}" for k in range(1, 8)], "validation": ["run0"]}
    record = {**model.provenance.record, "refinement": groups}
    refined = replace(model, provenance=Provenance(record))
    assert calibrate(refined, [run(0), run(100), run(101)]).warnings == (told,)
    assert "used in training (run0)" in validate(refined, [run(0)]).warnings[0]
    assert intervals.warnings == ()


# -- the file ---------------------------------------------------------------------------------


def test_a_file_holds_all_of_it(intervals, tmp_path):
    path = tmp_path / "i.json"
    path.write_text("what was there before")
    given = replace(intervals, warnings=("mind the gap",))
    given.save(path)
    found = load_intervals(path)
    for field in fields(given):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(given, field.name))
    assert [p.name for p in tmp_path.iterdir()] == ["i.json"]
    kept = json.loads(path.read_text())["channels"][0]
    assert (kept["name"], kept["unit"]) == ("q", "m")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (None, "not JSON"),
        ([], "all of it: "),
        ({"level": 90}, "level: input should be less than 1"),
        ({"grid": []}, "grid: "),
        ({"grid": [2.0, 1.0, 0.0]}, "its grid does not increase"),
        ({"grid": [0.0, 1.0]}, "has not one half-width for each of 2 grid points"),
        ({"channels": [{"name": "q", "unit": "m"}]}, "channels.0.half_width: field required"),
        ({"channels": [{"name": "q", "unit": "m", "half_width": [-1.0] * 3}]}, "greater than or"),
        ({"channels": [{"name": "q", "unit": "m", "half_width": [None] * 3}]}, "valid number"),
    ],
)
def test_foreign_files_are_refused(intervals, tmp_path, change, match):
    path = tmp_path / "i.json"
    intervals.save(path)
    content = json.loads(path.read_text())
    content = content | change if isinstance(change, dict) else change
    path.write_text("{" if content is None else json.dumps(content))
    with pytest.raises(DfsmError, match="is no file of prediction intervals") as error:
        load_intervals(path)
    assert match in str(error.value)
    assert str(error.value).endswith("make it again with dfsm calibrate")


def test_missing_and_newer_files_are_refused(intervals, tmp_path):
    with pytest.raises(DfsmError, match="no such file"):
        load_intervals(tmp_path / "i.json")
    (tmp_path / "i.json").write_text('{"format": 3}')
    with pytest.raises(DfsmError, match=r"has format 3, this dfsm .* reads up to 2"):
        load_intervals(tmp_path / "i.json")
    with pytest.raises(DfsmError, match="could not be written"):
        intervals.save(tmp_path / "missing" / "i.json")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"channels": ("q", "z")}, r"channels are q \(m\), z \(m\), the model's q \(m\), y \(m\)"),
        ({"units": ("m", "km")}, r"channels are q \(m\), y \(km\)"),
        ({"schedule": None}, "schedule is none, the model's w"),
        ({"grid": np.array([0.0, 1.0, 2.0])}, "schedule points are 0, 1, 2, the model's "),
    ],
)
def test_intervals_of_another_model_are_refused(model, intervals, change, match):
    with pytest.raises(DfsmError, match=f"of another model: their {match}"):
        validate(model, [run(300)], intervals=replace(intervals, **change))


# -- refusals ---------------------------------------------------------------------------------


def test_bad_input(model, intervals):
    with pytest.raises(DfsmError, match=r"run1 and run1 hold the same data"):
        calibrate(model, [run(1), run(1), run(2)])
    with pytest.raises(DfsmError, match="the model 'multi-fidelity', but the models are mine"):
        validate({"mine": model}, [run(300)], intervals=intervals)
    with pytest.raises(DfsmError, match="at least 3 runs, 2 were given"):
        calibrate(model, [run(1), run(2)])
    with pytest.raises(DfsmError, match=r"level is 1.5, expected a share between 0 and 1"):
        calibrate(model, [run(1), run(2), run(3)], level=1.5)


# -- from the training runs alone -------------------------------------------------------------


@pytest.fixture(scope="module")
def crossed(model):
    return cross_calibrate(model, [run(seed) for seed in range(8)], SETTINGS)


@pytest.mark.slow
def test_training_runs_that_are_left_out_in_turn_calibrate_too(model, crossed):
    """No run beside those of the fit is asked for, and new runs lie inside about as promised."""
    new = [run(seed) for seed in range(200, 240)]
    shares = [crossed.coverage(simulate(model, r), r, r) for r in new]
    np.testing.assert_allclose(np.mean(shares, axis=0), 0.9, atol=0.08)
    assert crossed.runs == tuple(f"run{k}" for k in range(8))
    # Errors begin at the record: an interval is narrow there.
    assert (crossed.growth.along[0] < 0.5).all()
    assert "test runs calibrated the intervals" in "".join(
        validate(model, [run(0)], intervals=crossed).warnings
    )


def test_the_law_grows_with_the_distance_of_runs_far_from_all_others(model):
    """A rollout far outside has wider intervals than one inside, at every time alike."""
    growth = replace(
        calibrate(model, [run(seed) for seed in range(100, 104)]).growth, power=np.ones(2), knee=1.0
    )
    near, far = (growth.factor(TIME, np.full(len(TIME), d)) for d in (1.0, 7.0))
    np.testing.assert_allclose(far / near, 5.0)


def test_one_record_is_cut_into_pieces():
    with pytest.raises(DfsmError, match="1 runs of 401 samples are too few to leave some out"):
        _pieces([run(0)], SETTINGS)
    long = Trajectory(
        np.arange(4010) * 0.1,
        np.tile(run(0).values, (10, 1)),
        run(0).channels,
        name="long",
    )
    pieces, settings = _pieces([long], replace(SETTINGS, start=0.0))
    assert settings.start is None
    assert [p.name for p in pieces] == [f"long, part {k}" for k in range(1, 7)]
    assert sum(map(len, pieces)) == 4010
