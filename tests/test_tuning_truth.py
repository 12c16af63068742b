"""Tuning confirmed by a truth that no surrogate contains, against a search on the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dfsm
from benchmarks import tuning
from dfsm.data.readers.tables import write_table
from dfsm.errors import DfsmError
from dfsm.loops.trust_region import (
    Confirmation,
    ConfirmedTuning,
    CorrectedFigures,
    Flight,
    TrustSettings,
    tune_with_truth,
)
from dfsm.loops.truth import FlownRuns, SystemTruth, TruthCase, TruthEndedError, exact_model


@pytest.fixture(scope="module")
def task():
    return tuning.task(duration=100.0, seeds=(1, 2))


def test_few_flights_reach_what_a_search_on_the_truth_reaches(task):
    table, confirmed = tuning.compared(task)
    assert confirmed.status in Confirmation
    assert len(confirmed.flights) <= 5
    best = table["pattern search"].objective
    assert table["pattern search"].evaluations > 20
    assert table["trust region"].objective < 1.01 * best
    assert table["trust region"].objective < table["surrogate alone"].objective
    near = table["trust region"].until_near
    assert near is not None
    assert near <= 5
    assert f"{len(confirmed.flights)} flights" in confirmed.summary()


def test_an_equation_as_a_model_is_the_equation():
    system = tuning.turbine()
    model, rng = exact_model(system), np.random.default_rng(2)
    x, u, w = rng.normal(size=(3, 6)), rng.normal(size=(3, 1)), rng.normal(size=(3, 1))
    for k in range(3):
        np.testing.assert_allclose(
            model.derivative(x[k], u[k], w[k])[...],
            system.f(x[k], u[k], w[k], np.zeros(0)),
            atol=1e-12,
        )


def test_corrected_figures_are_those_of_every_flight(task):
    rng, n = np.random.default_rng(0), len(task.problem.measures)
    points = [np.array([-3.0, -0.3]), np.array([-5.0, -0.3]), np.array([-3.0, -1.0])]
    base = [task.evaluator(p).figures for p in points]
    true = [b * rng.uniform(0.8, 1.2, size=(n, 2)) for b in base]
    corrected = CorrectedFigures(task.evaluator, points, true, base, center=1)
    for point, figures in zip(points, true, strict=True):
        np.testing.assert_allclose(corrected(point).figures, figures, rtol=1e-9)
    at, e = np.array([-4.0, -0.6]), 1e-5
    slopes = corrected(at, slopes=True).slopes
    assert slopes is not None
    for i, way in enumerate(e * np.eye(2)):
        ends = [corrected(at + s * way).figures for s in (1, -1)]
        np.testing.assert_allclose(slopes[..., i], (ends[0] - ends[1]) / (2 * e), atol=1e-5)


def test_runs_that_somebody_flies_are_asked_for_and_taken(task, tmp_path):
    flown, system = FlownRuns(tmp_path / "flown"), SystemTruth(tuning.turbine())
    settings = TrustSettings(flights=2)
    for number in (1, 2):
        with pytest.raises(DfsmError, match=f"flight_{number} lacks 2 of 2 runs .*kp = ") as told:
            tune_with_truth(task, flown, settings)
        words = str(told.value).partition("kp = ")[2].partition(")")[0].split(", ki = ")
        law = replace(task.controller, kp=float(words[0]), ki=float(words[1]))
        place = tmp_path / "flown" / f"flight_{number}"
        for run in task.runs:
            done = system.run(TruthCase(number, run, law, {}))
            write_table(done, place / f"{run.name}.csv")
    found = tune_with_truth(task, flown, settings)
    assert len(found.flights) == 2
    first, second = (flight.true for flight in found.flights)
    assert first is not None
    assert second is not None
    assert second < first
    short = Path(tmp_path / "flown" / "flight_1" / "seed1.csv")
    write_table(dfsm.read(short).window(0, 60.0), short)
    with pytest.raises(DfsmError, match=r"lasts from .* to 60 s, and .* are scored: fly it longer"):
        tune_with_truth(task, flown, settings)


class EndsOnce(SystemTruth):
    """Does not come to its end in the second flight."""

    def run(self, case):
        if case.flight == 2:
            raise TruthEndedError("it fell over")
        return super().run(case)


def test_a_flight_that_ends_early_makes_the_region_smaller(task):
    found = tune_with_truth(task, EndsOnce(tuning.turbine()), TrustSettings(flights=3))
    assert [f.true is None for f in found.flights] == [False, True, False]
    assert found.flights[2].radius <= found.flights[1].radius / 2
    assert found.best == 2
    assert "ended early" in found.summary()


def test_a_flight_that_passes_a_limit_in_truth_says_so():
    flights = (
        Flight({"kp": 1.0}, None, 1.0, 1.0, 5e-5, 0.5),
        Flight({"kp": 2.0}, 0.8, 0.9, 0.85, 0.003, 0.5),
    )
    _, first, second = ConfirmedTuning(Confirmation.LIMIT, flights, 1, None).summary().splitlines()
    assert first.endswith("kp = 1: 1")
    assert second.endswith("0.85, predicted 0.8, a limit passed by 0.30% (best)")
