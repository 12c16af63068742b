"""Spectra and decimation without SciPy's signal package, held against it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import scipy

from dfsm.numerics.filters import decimated
from dfsm.numerics.spectra import spectrum


@pytest.mark.parametrize(("samples", "segment"), [(1201, 20.0), (700, 10.05), (90, 200.0)])
def test_a_spectrum_is_that_of_scipy(samples, segment):
    values = np.random.default_rng(samples).normal(size=samples).cumsum()
    found = spectrum(0.05 * np.arange(samples), values, segment)
    size = min(samples, round(segment / 0.05))
    frequency, density = scipy.signal.welch(values, fs=20.0, window="hann", nperseg=size)
    np.testing.assert_allclose(found.frequency, frequency, rtol=1e-12)
    np.testing.assert_allclose(found.density, density, rtol=1e-9, atol=1e-14 * density.max())


@pytest.mark.parametrize(("samples", "factor"), [(1000, 7), (1201, 2), (30, 5)])
def test_decimation_is_that_of_scipy(samples, factor):
    values = np.random.default_rng(factor).normal(size=(samples, 3)).cumsum(axis=0)
    found = decimated(values, factor)
    expected = scipy.signal.resample_poly(values, 1, factor, axis=0, padtype="antireflect")
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.ptp(values))


def test_a_page_on_a_model_imports_nothing_of_optimal_control_or_signal_processing():
    code = """
import sys
from dfsm.numerics.spectra import spectrum
from dfsm.report import write_report
heavy = ("casadi", "pandas", "plotly", "sklearn", "scipy.signal", "scipy.stats", "dfsm.control")
print([name for name in heavy if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
