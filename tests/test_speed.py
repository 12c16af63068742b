"""The references that speed is measured against, and the rows that tell it; nothing is timed."""

from __future__ import annotations

import numpy as np

from benchmarks import fit_tables, speed


def test_the_normal_equations_have_the_coefficients_of_least_squares():
    rng = np.random.default_rng(0)
    inputs = np.column_stack([rng.normal(size=(500, 3)) + 2, np.ones(500)])
    targets = rng.normal(size=(500, 2))
    expected = np.linalg.lstsq(inputs, targets, rcond=None)[0]
    np.testing.assert_allclose(speed.normal_equations(inputs, targets), expected, rtol=1e-10)


def test_the_table_tells_both_ratios_whichever_is_larger():
    figures = {
        "linear_fit": {
            "dfsm_s": 0.0204,
            "times_faster": 5.31,
            "times_faster_than_normal_equations": 0.82,
            "difference": 7e-15,
        },
        "corrective": {"both_functions_s": 1.0},
        "simulate": {
            "one_run_s": 0.03,
            "times_faster_than_solve_ivp": 90.0,
            "times_faster_than_openfast": 9000.0,
            "hundred_runs_s": 1.0,
        },
        "start": {"import_s": 0.1, "help_s": 0.2},
    }
    line = fit_tables.speed_table(figures)[2]
    assert line.split(" | ")[1] == (
        "0.020 s; `numpy.linalg.lstsq` takes 5.3 × as long, NumPy's Cholesky of the normal "
        "equations 0.8 × (coefficients agree to 7e-15) |"
    )
