"""Extremes beyond what was simulated, and the command that sweeps gains over load cases."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from conftest import write_config
from dfsm.errors import DfsmError
from dfsm.numerics.extremes import Gumbel, block_maxima, extrapolated, fit_gumbel

OWN = """
import dfsm
mine = dfsm.PID(
    kp=-0.5, ki=-0.1, setpoint=0.0, measurements=["q"], measurement_units=["m"],
    commands=["u"], command_units=["N"], interval=0.05,
)
"""


def test_extremes_are_those_of_the_distribution_that_maxima_come_from():
    rng = np.random.default_rng(4)
    found, told = [], []
    for _ in range(60):
        # A block's largest value stands somewhere in it, the rest is lower.
        maxima = rng.gumbel(10.0, 2.0, 40)
        values = np.repeat(maxima, 5) - rng.uniform(5, 9, 200)
        values[5 * np.arange(40) + rng.integers(0, 5, 40)] = maxima
        blocks = block_maxima(np.arange(201) * 2.0, np.append(values, 0.0), 10.0)
        np.testing.assert_array_equal(blocks, maxima)
        value, error = extrapolated([fit_gumbel(blocks)], [1.0], 1e4)
        found.append(value)
        told.append(error)
    exact = 10.0 - 2.0 * math.log(-math.log(1 - 1e-4))
    assert np.mean(found) == pytest.approx(exact, rel=0.03)
    # The standard error is the spread of what other samples give.
    assert np.mean(told) == pytest.approx(np.std(found), rel=0.25)
    calm, storm = Gumbel(1.0, 0.1, 20), Gumbel(5.0, 0.5, 20)
    both, _ = extrapolated([calm, storm], [0.9, 0.1], 1e4)
    assert both == pytest.approx(5.0 - 0.5 * math.log(-math.log(1 - 1e-3)), rel=1e-6)
    with pytest.raises(DfsmError, match="20 s hold 2 whole blocks of 10 s"):
        block_maxima(np.arange(21.0), np.zeros(21), 10.0)


def test_the_command_sweeps_gains_over_load_cases(here, dfsm, fitted):
    Path("control.py").write_text(OWN)
    config = {
        "model": str(fitted), "controller": "control.py:mine", "runs": ["test/d.outb"],
        "start_up": 2.0, "gains": {"kp": [-0.5, -1.0], "ki": [-0.1, -0.3]}, "weights": [0.4],
        "speed": "q", "rated_speed": 1.0, "extremes": ["y", "u"], "block": 2.0, "years": 1.0,
    }  # fmt: skip
    write_config(Path("sweep.yaml"), config)
    shown = dfsm("sweep", "sweep.yaml", "-o", "out")
    assert (shown.code, shown.err) == (0, "")
    said = json.loads(Path("out/sweep.json").read_text())
    names = [c["name"] for c in said["controllers"]]
    assert names[:2] == ["as it is", "kp -0.5, ki -0.1"]
    assert len(names) == 5
    first, same = said["controllers"][:2]
    for figure in ("std", "travel", "maximum"):
        assert first["figures"]["q"][figure] == pytest.approx(same["figures"]["q"][figure])
    assert first["extremes"]["y"]["value"] > first["figures"]["y"]["maximum"]
    assert said["recorded"]["extremes"]["y"]["blocks"] == 6
    assert len(Path("out/sweep.csv").read_text().splitlines()) == 7
    assert "standard error" in Path("out/sweep.html").read_text(encoding="utf-8")
    for change, sentence in (
        ({"gains": {"kpp": [1.0]}}, "no gain 'kpp'; did you mean 'kp'"),
        ({"gains": {"kp": []}}, "values of kp is none"),
        ({"extremes": ["yy"]}, "the model has no channel 'yy'"),
        ({"block": 9.0}, "extremes of y: 13 s hold 1 whole blocks of 9 s"),
        ({"exponent": 6.0}, "exponent is 6.0, expected one of 3, 4, 5, 10"),
    ):
        write_config(Path("bad.yaml"), config | change)
        assert sentence in dfsm("sweep", "bad.yaml", "-o", "out").sentence


def test_a_condition_in_which_hardly_anything_moves_changes_nothing_far_above_it():
    wide = Gumbel(location=1.0, scale=0.1, maxima=9)
    still = Gumbel(location=-4.0, scale=1e-13, maxima=9)
    alone, _ = extrapolated([wide], [0.5], 1e6)
    found, error = extrapolated([still, wide], [0.5, 0.5], 1e6)
    assert found == pytest.approx(alone, rel=1e-9)
    assert 0 < error < 1
