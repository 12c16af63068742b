"""The size of the objective: a constant in it changes nothing, and small ones are solved too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cart import CART, QUICK, problem, solved
from dfsm.control import DirectTranscription, MultipleShooting
from dfsm.control.guess import start_of
from dfsm.control.nlp.transcription import Transcription
from dfsm.data.trajectory import Channel

NAMES = ("scale", "constant", "end")
# Fixed numbers of the costs below are parameters, so that all problems share their compiled code.
MODEL = replace(CART, parameters=(*CART.parameters, *map(Channel, NAMES)))


def running(s):
    """The farther the cart, the more pushing it costs."""
    return s.p.scale * s.u.force**2 * (1 + s.x.place**2) + s.p.constant


def final(start, end):
    return end.p.scale * end.x.speed + end.p.end


def hard(scale=1.0, constant=0.0, end=0.0):
    numbers = dict(zip(NAMES, (scale, constant, end), strict=True))
    return problem(
        model=MODEL,
        cost=running,
        final_cost=final,
        bounds={"force": (-2.0, 2.0)},
        final={"place": 4.0, "speed": (0.0, 0.5)},
        parameters={"mass": 2.0, **numbers},
    )


def motion(solution):
    return solution.trajectory.select(["place", "speed", "force"]).values


@pytest.mark.parametrize(
    "method",
    [
        QUICK,
        DirectTranscription(scheme="radau", mesh=8, refine=1e-5),
        MultipleShooting(segments=5, pieces=4),
    ],
    ids=["one mesh", "refined", "shooting"],
)
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-6])
def test_a_constant_in_the_cost_changes_nothing_but_the_objective(scale, method):
    plain = solved(hard(scale), method)
    for constant in (1e3, -5.0):
        moved = solved(hard(scale, constant * scale), method)
        assert moved.iterations == plain.iterations
        assert [m["iterations"] for m in moved.meshes] == [m["iterations"] for m in plain.meshes]
        np.testing.assert_allclose(motion(moved), motion(plain), rtol=0, atol=1e-9)
        expected = plain.objective + 5 * constant * scale
        assert moved.objective == pytest.approx(expected, rel=1e-12, abs=1e-9 * scale)


@pytest.mark.parametrize("constant", [1e3, -5.0])
def test_a_large_constant_beside_a_small_cost(constant):
    # Values of the cost are lost to rounding here, its derivatives are not.
    plain, moved = solved(hard(1e-6)), solved(hard(1e-6, constant))
    assert moved.iterations == plain.iterations
    np.testing.assert_allclose(motion(moved), motion(plain), rtol=0, atol=1e-8)


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_a_constant_in_the_final_cost_changes_nothing_but_the_objective(scale):
    plain = solved(hard(scale))
    for constant in (1e3, -5.0):
        moved = solved(hard(scale, end=constant))
        assert moved.iterations == plain.iterations
        assert moved.final_cost == pytest.approx(plain.final_cost + constant)
        np.testing.assert_allclose(motion(moved), motion(plain), rtol=0, atol=1e-8)


@pytest.mark.parametrize("scale", [1e-3, 1e-6])
def test_a_small_cost_has_the_optimum_of_the_same_cost_in_other_units(scale):
    usual, small = solved(hard()), solved(hard(scale, 1e3 * scale))
    assert small.objective - 5e3 * scale == pytest.approx(scale * usual.objective, rel=1e-5)
    np.testing.assert_allclose(
        small.trajectory["force"], usual.trajectory["force"], rtol=0, atol=1e-3
    )


def test_the_variation_of_a_quadratic_cost_is_its_value_without_constants():
    for constant in (0.0, 1e3):
        case = problem(cost=lambda s, c=constant: s.u.force**2 + c)
        grid = QUICK.grid()
        start = start_of(case, None, grid.tau)
        start.U[:] = 0.7
        shot = Transcription(case, grid, start)
        assert shot.program.variation(shot.scaled(start)) == pytest.approx(5 * 0.49)
