"""Signatures that state shapes, checked as the functions are called."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("beartype")

BEGIN = """
from jaxtyping import TypeCheckError, install_import_hook
with install_import_hook("dfsm.numerics", "beartype.beartype"):
    from dfsm.numerics import fatigue, filters, sampling, smoothing, spectra, time_mesh
import numpy as np
t = np.linspace(0, 10, 101)
y, x = np.sin(t), np.random.default_rng(0).normal(size=(101, 3))
"""
RIGHT = """
smoothing.smoothing_spline(t, y)
smoothing.cubic_spline(list(t), list(y))
smoothing.interpolate(t, y)
filters.filtered(t, y, filters.Filter(kind="low_pass", cutoff=1.0))
filters.filtered(t, y, filters.Filter(kind="moving_average", window=1.0))
spectra.spectrum(t, y).peak(spectra.Band("all", 0.0, 5.0))
fatigue.damage_equivalent_load(y, 10.0, 4.0)
time_mesh.time_step(t)
for method in ("kmeans", "maxmin", "random"):
    sampling.subsample(x, 7, method).means(x[:, :2])
"""
WRONG = [
    "smoothing.interpolate(t, x)",
    "smoothing.interpolate(t, y[1:])",
    "filters.filtered(t, x, None)",
    "spectra.spectrum(t, y[1:])",
    "spectra.Spectrum(t, y[1:])",
    "fatigue.damage_equivalent_load(x, 10.0, 4.0)",
    "time_mesh.time_step(x)",
    "sampling.subsample(y, 7)",
    "sampling.nearest(x, x[:5, :2])",
    "sampling.Subsample(x, t)",
]
CHECK = """
for call in {wrong!r}:
    try:
        eval(call)
    except TypeCheckError:
        continue
    print("not refused:", call)
"""


def test_right_shapes_pass_and_wrong_ones_are_refused():
    code = BEGIN + RIGHT + CHECK.format(wrong=WRONG)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


def test_without_the_checks_they_cost_no_import():
    code = """
import sys
from dfsm.numerics import fatigue, filters, sampling, smoothing, spectra
print([m for m in ("jaxtyping", "beartype", "jax") if m in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
