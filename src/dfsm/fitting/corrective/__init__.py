"""The nonlinear error-corrective function e(I): what the linear fit leaves over (Sec. 3.6).

One file per kind of training. A new kind is a file like `gaussian_process.py`, a settings class
with a method `train`, and its name in `CorrectiveSettings`: from there configuration files know it.
What comes out of training is one of the forms in `models.corrective`. Inputs are standardised
inside; the values that go in and come out are in physical units.
"""

from __future__ import annotations

import numpy as np

from dfsm.core.types import Array, IntArray
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.corrective.none import NoCorrection
from dfsm.fitting.corrective.perceptron import MLP
from dfsm.fitting.corrective.rbf import RBF, IncrementalRBF
from dfsm.fitting.corrective.training import CorrectiveFit, CorrectiveKind, TrainingSet

__all__ = [
    "GP",
    "MLP",
    "RBF",
    "CorrectiveFit",
    "CorrectiveKind",
    "CorrectiveSettings",
    "IncrementalRBF",
    "NoCorrection",
    "fit_corrective",
]

# Every kind that there is, told apart by its `kind`.
CorrectiveSettings = RBF | IncrementalRBF | GP | MLP | NoCorrection


def fit_corrective(
    inputs: Array,
    residuals: Array,
    runs: IntArray,
    settings: CorrectiveKind,
    seed: int = 0,
    weights: Array | None = None,
) -> CorrectiveFit | None:
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
    weights
        Of the samples by the time that they stand for, ``(sample,)``; None takes all alike.

    Returns
    -------
    CorrectiveFit or None
        None where the settings say that nothing is to be corrected.

    Raises
    ------
    DfsmError
        More units than samples.
    """
    if weights is not None:
        # Samples that stand for equal times: every kind of training then weighs them alike.
        ends = np.cumsum(weights)
        places = (np.arange(len(weights)) + 0.5) / len(weights) * ends[-1]
        kept = np.unique(np.searchsorted(ends, places))
        inputs, residuals, runs = inputs[kept], residuals[kept], runs[kept]
    return settings.train(TrainingSet.build(inputs, residuals, runs), seed)
