"""What samples show of their making: rows never recorded, slower channels, wraps, holds, starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from conftest import Dfsm
from dfsm.data.derivatives import DerivativeSettings, StateSpec, differentiate
from dfsm.data.info import counted, describe
from dfsm.data.readers import read
from dfsm.data.signs import held_interval, jumps_at_first, transient_end, wrap_notes, wrapping
from dfsm.data.slower import fill_slower
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.samples import extract, select
from dfsm.fitting.settings import FitSettings

T = 0.1 * np.arange(400)
LIVE = np.stack([3 + np.sin(T), 12 + 2 * np.cos(0.7 * T), 8 + np.sin(1.3 * T)], axis=1)


def table(path: Path, values: np.ndarray, time: np.ndarray = T) -> Trajectory:
    lines = np.column_stack([time, values]).tolist()
    rows = "".join(f"{t:.3f},{a:.8g},{b:.8g},{c:.8g}\n" for t, a, b, c in lines)
    path.write_text("Time,a,b,c\n" + rows)
    return read(path)


def test_rows_that_were_not_recorded_are_left_out(tmp_path):
    path, zeros = tmp_path / "a.csv", LIVE.copy()
    zeros[350:] = 0
    run = table(path, zeros)
    assert run.time[-1] == T[349]
    assert "the last 50 rows (35 to 39.9 s) are zero in every channel" in run.notes[0]
    stuck = LIVE.copy()
    stuck[300:] = stuck[300]
    run = table(path, stuck)
    assert run.time[-1] == T[300]
    assert "the last 99 rows (30.1 to 39.9 s) hold the same values" in run.notes[0]
    head = LIVE.copy()
    head[:20] = 0
    assert table(path, head).time[0] == T[20]


def test_rows_filled_up_with_the_first_sample_are_left_out(tmp_path):
    """As loggers do before a trigger: a motion stands still, and goes on at full speed."""
    filled = LIVE.copy()
    filled[:120], filled[120:] = LIVE[7], LIVE[7 : 7 + 280]
    run = table(tmp_path / "a.csv", filled)
    assert run.time[0] == T[119 + 1]
    assert "the first 120 rows (0 to 11.9 s) hold the same values" in run.notes[0]
    # A system at rest that a ramp sets in motion begins slowly.
    u = np.maximum(0.0, T - 12) * 0.1
    x = np.where(T < 12, 0.0, 0.1 * (T - 12 - 1 + np.exp(-(T - 12))))
    at_rest = table(tmp_path / "b.csv", np.stack([u, x, x - 0.5 * u], axis=1))
    assert (len(at_rest), at_rest.notes) == (400, ())


def test_rest_and_what_settles_stay(tmp_path):
    u = np.where(T < 10, 0.0, 1.0)
    x = np.where(T < 10, 0.0, 1 - np.exp(-(T - 10)))
    at_rest = table(tmp_path / "a.csv", np.stack([u, x, 2 * x], axis=1))
    assert (len(at_rest), at_rest.notes) == (400, ())
    decayed = np.exp(-T[:, None]) * LIVE
    decayed = np.round(decayed, 4)
    assert not decayed[-50:].any()
    settled = table(tmp_path / "b.csv", decayed)
    assert (len(settled), settled.notes) == (400, ())


def columns(path: Path, values: np.ndarray) -> Trajectory:
    names = "".join(f",c{i}" for i in range(values.shape[1]))
    rows = [",".join(f"{v:.6g}" for v in row) for row in np.column_stack([T, values]).tolist()]
    path.write_text("\n".join([f"Time{names}", *rows]) + "\n")
    return read(path)


@pytest.mark.parametrize("level", [0.0, 25.0])
@pytest.mark.parametrize("states", [1, 3])
def test_a_system_at_rest_whose_outputs_follow_its_inputs_stays(tmp_path, level, states):
    """Most channels jump with the inputs: what tells rest from nothing is a state."""
    u = np.where(T < 6, 0.0, 2 + 0.2 * np.sin(1.1 * T))
    rates = np.arange(1, states + 1) * 0.3
    x = np.where(T < 6, 0.0, 1.0)[:, None] * (1 - np.exp(-np.outer(T - 6, rates)))
    moved = np.stack([k * u + 0.3 * x[:, 0] for k in range(1, 9)], axis=1)
    run = columns(tmp_path / "a.csv", level + np.column_stack([u, moved, x]))
    assert len(run) == 400
    (told,) = run.notes
    assert "the first 60 rows (0 to 5.9 s)" in told
    assert "some start from where they stood" in told
    assert "kept, set a start behind them if nothing was recorded there" in told


def test_zeros_before_a_record_are_left_out_though_some_channels_cross_zero(tmp_path):
    rng = np.random.default_rng(5)
    lost = 0
    for k in range(20):
        phase, rate = rng.uniform(0, 6.3, 9), rng.uniform(0.3, 1.5, 9)
        values = np.round(rng.uniform(0.5, 2, 9) * np.sin(np.outer(T, rate) + phase), 4)
        values[:, :7] += 3
        values[:40] = 0
        run = columns(tmp_path / f"{k}.csv", values)
        assert run.time[0] == T[40] or "kept" in run.notes[0]
        lost += run.time[0] == T[40]
    assert lost >= 18


def found(run: Trajectory, settings: FitSettings) -> np.ndarray:
    """Effects of the input and of the state on the state's derivative, without an offset."""
    samples = extract(select([run], settings), settings)
    return np.linalg.lstsq(samples.inputs, samples.derivatives[:, 0], rcond=None)[0]


# -- slower channels ----------------------------------------------------------------------------


def two_rates(hold: bool) -> tuple[Trajectory, np.ndarray]:
    """x' = -0.5 x + 0.8 u, u told at every tenth row, held or straight in between."""
    time, every = 0.02 * np.arange(1501), 10
    slow = np.random.default_rng(3).normal(size=151)
    mesh = time[::every]
    u = np.repeat(slow, every)[: len(time)] if hold else np.interp(time, mesh, slow)
    x, decay = np.zeros(len(time)), np.exp(-0.5 * 0.02)
    for k in range(1, len(time)):
        mean = u[k - 1] if hold else (u[k - 1] + u[k]) / 2
        x[k] = decay * x[k - 1] + (1 - decay) * 1.6 * mean
    told = np.full(len(time), np.nan)
    told[::every] = slow
    return Trajectory(time, np.stack([x, told], axis=1), (Channel("x"), Channel("u"))), u


@pytest.mark.parametrize("way", ["hold", "linear"])
def test_slower_channels_are_filled_as_told(way):
    run, u = two_rates(way == "hold")
    filled = fill_slower(run, {"u": way})
    np.testing.assert_allclose(filled["u"], u[: len(filled)], atol=1e-12)
    assert filled.notes[0].startswith("'u' has one sample every 0.2 s, ")
    assert fill_slower(run, way).notes == filled.notes
    assert fill_slower(run, None) is run


def test_a_fit_asks_what_a_slower_channel_does():
    run, _ = two_rates(hold=False)
    settings = {"states": (StateSpec(name="x"),), "controls": ("u",)}
    with pytest.raises(DfsmError, match=r"'u' has one sample every 0.2 s, .* data.slower: \{u: ho"):
        select([run], FitSettings(**settings))
    b, a = found(run, FitSettings(**settings, slower={"u": "linear"}))
    np.testing.assert_allclose([a, b], [-0.5, 0.8], rtol=0.02)
    with pytest.raises(DfsmError, match="slower: no channel 'v'"):
        fill_slower(run, {"v": "hold"})
    values = run.values.copy()
    values[::10, 1] = 0.0
    values[20:400, 1] = np.nan
    with pytest.raises(DfsmError, match="samples are not regular"):
        fill_slower(Trajectory(run.time, values, run.channels), {"u": "hold"})
    assert "has one sample every 0.2 s only" in " ".join(describe(run).warnings)


# -- signs --------------------------------------------------------------------------------------


def test_angles_that_wrap_are_no_states():
    angle = np.cumsum(3 + np.sin(T))
    for period, unit in ((360.0, "deg"), (2 * np.pi, "rad"), (360.0, ""), (1.0, "rev")):
        turning = angle * period / 360 % period
        wrap = wrapping(T, turning, unit)
        assert wrap is not None
        assert wrap.period == period
        assert wrap.times == int(angle[-1] // 360)
        centred = (turning + period / 2) % period - period / 2
        assert wrapping(T, centred, unit) is not None
        assert wrapping(T, angle, unit) is None
    assert wrapping(T, 180 * np.sign(np.sin(T)), "deg") is None
    run = Trajectory(T, (angle % 360)[:, None], (Channel("Azimuth", "deg"),))
    with pytest.raises(DfsmError, match=r"state 'Azimuth' wraps at 360 deg \(3 times, first at"):
        differentiate(run, [StateSpec(name="Azimuth")], DerivativeSettings())
    assert "'Azimuth' wraps at 360 deg, 3 times" in describe(run).warnings[-1]
    # As an input or output of a fit it is told.
    (told,) = wrap_notes([run.with_channels("u", np.sin(T)), run], ["Azimuth"])
    assert told.startswith("run: 'Azimuth' wraps at 360 (3 times, first at ")
    assert wrap_notes([run.with_channels("u", np.sin(T))], ["u"]) == []


def test_held_values_and_bad_starts():
    held = np.repeat(np.random.default_rng(0).normal(size=40), 10)
    assert held_interval(T, held) == pytest.approx(1.0)
    assert held_interval(T, np.sin(T)) is None
    assert held_interval(T, np.round(np.sin(T), 1)) is None
    first = 5 + np.sin(T)
    assert not jumps_at_first(first)
    first[0] = 0
    assert jumps_at_first(first)
    assert transient_end(T, np.sin(T)) is None
    decay = np.exp(-0.15 * T) * np.cos(2 * T)
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(T))
    for free in (decay, decay + noise, np.exp(-T), np.exp(-3 * T) + noise, np.round(decay**3, 4)):
        assert transient_end(T, free) is None
    assert transient_end(T, np.sin(T) + 50 * np.exp(-T)) == pytest.approx(2.2, abs=0.5)


def test_a_bad_sample_before_the_window_spoils_nothing():
    time = 0.1 * np.arange(1200)
    u = np.sin(0.9 * time) + np.sin(0.37 * time)
    x = np.zeros(len(time))
    for k in range(1, len(time)):
        x[k] = np.exp(-0.05) * x[k - 1] + (1 - np.exp(-0.05)) * (u[k] + u[k - 1])
    settings = FitSettings(states=(StateSpec(name="x"),), controls=("u",), start=60.0)
    results = []
    for bad in (x[0], 1e6, np.nan):
        values = np.stack([x, u], axis=1)
        values[0] = bad
        run = Trajectory(time, values, (Channel("x", step=1e-4), Channel("u")))
        results.append(found(run, settings))
    assert np.array_equal(results[0], results[1])
    assert np.array_equal(results[0], results[2])


# -- several runs -------------------------------------------------------------------------------


def test_info_merges_runs_and_counts_what_it_says(tmp_path, dfsm: Dfsm):
    for k in range(3):
        header, last = ("still", "7") if k else ("still,only", "7,1")
        rows = "".join(f"{t:.3f},{(k + 1) * np.sin(t):.3f},{last}\n" for t in T)
        (tmp_path / f"r{k}.csv").write_text(f"Time,a [deg],{header}\n" + rows)
    merged = dfsm("info", tmp_path / "r*.csv").out.splitlines()
    assert merged[0] == "3 runs, 400 samples, 0 to 39.9 s, every 0.1 s"
    rows = {line.split()[0]: line.split() for line in merged}
    assert rows["a"][1] == "deg"
    assert float(rows["a"][2]) == pytest.approx(-3, abs=0.01)
    assert rows["a"][4:] == ["all", "0.001"]
    assert rows["only"][-2] == "1"
    told = [line for line in merged if "'still' is constant (7)" in line]
    assert len(told) == 1
    assert "(and 2 more runs)" in told[0]
    each = dfsm("info", tmp_path / "r*.csv", "--each").out
    assert each.count("warning: 'still' is constant (7)") == 3


def test_sentences_that_differ_in_numbers_are_one():
    said = [[f"'x1' is constant ({k})", f"a jump in 'x{k}' at {k}.5 s"] for k in range(3)]
    told = [(f"r{k}", sentences) for k, sentences in enumerate(said)]
    assert counted(told) == [
        "r0: 'x1' is constant (0) (and 2 more runs)",
        "r0: a jump in 'x0' at 0.5 s (and 2 more runs)",
    ]
    assert counted([("a", ["'x1' is odd"]), ("b", ["'x2' is odd"])]) == [
        "a: 'x1' is odd",
        "b: 'x2' is odd",
    ]
