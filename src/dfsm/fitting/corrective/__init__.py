"""The nonlinear error-corrective function e(I): what the linear fit leaves over (Sec. 3.6).

One file per kind of training (`rbf`, `gaussian_process`, `perceptron`); what comes out is one of
the two JAX modules in `functions`. Inputs are standardised inside; the values that go in and come
out are in physical units.
"""

from __future__ import annotations

from typing import Literal

from dfsm.core.settings import settings_class
from dfsm.core.types import Array, IntArray
from dfsm.fitting.corrective.gaussian_process import GP, fit_gp
from dfsm.fitting.corrective.perceptron import MLP, fit_mlp
from dfsm.fitting.corrective.rbf import RBF, IncrementalRBF, fit_rbf
from dfsm.fitting.corrective.training import CorrectiveFit, TrainingSet
from dfsm.models.corrective import Corrective, GaussianUnits, Perceptron, ignoring
from dfsm.numerics.sampling import subsample

__all__ = [
    "GP",
    "MLP",
    "RBF",
    "Corrective",
    "CorrectiveFit",
    "CorrectiveSettings",
    "GaussianUnits",
    "IncrementalRBF",
    "NoCorrection",
    "Perceptron",
    "fit_corrective",
    "ignoring",
]


@settings_class
class NoCorrection:
    """Leave the linear fit as it is."""

    kind: Literal["none"] = "none"


CorrectiveSettings = RBF | IncrementalRBF | GP | MLP | NoCorrection


def fit_corrective(
    inputs: Array,
    residuals: Array,
    runs: IntArray,
    settings: RBF | IncrementalRBF | GP | MLP,
    seed: int = 0,
) -> CorrectiveFit:
    """Train a corrective function on the residuals of the linear fit (Sec. 3.6).

    Parameters
    ----------
    inputs
        Shape ``(sample, input)``, physical units.
    residuals
        Shape ``(sample, target)``, physical units.
    runs
        Run index of each sample from 0, shape ``(sample,)``: cross-validation leaves out whole
        runs, because neighbouring samples of one run are nearly copies.
    settings
        Kind and settings.
    seed
        Seed of subsampling and initial weights.

    Returns
    -------
    CorrectiveFit

    Raises
    ------
    DfsmError
        More units than samples.
    """
    data = TrainingSet.build(inputs, residuals, runs)
    if isinstance(settings, MLP):
        return fit_mlp(data, settings, seed)
    points = subsample(data.z, settings.samples, settings.sampling, seed)
    if isinstance(settings, GP):
        return fit_gp(data, points, settings, seed)
    return fit_rbf(data, points, settings, seed)
