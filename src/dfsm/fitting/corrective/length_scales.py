"""How far a function varies in the direction of each input: hyper-parameters of a Gaussian process.

An input that does not matter gets a length scale far beyond its range.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import scipy

from dfsm.core.types import Array


def hyper_parameters(z: Array, targets: Array, seed: int) -> tuple[float, float, Array]:
    """Maximise the marginal likelihood (Rasmussen & Williams 2006, Sec. 5.4).

    Parameters
    ----------
    z
        Standardised points, shape ``(point, input)``.
    targets
        Shape ``(point, target)``; they share the hyper-parameters.
    seed
        Of the optimizer.

    Returns
    -------
    tuple
        Signal variance, noise variance, and length scale of every input, shape ``(input,)``.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor, kernels

    d = z.shape[1]
    lengths: Any = np.full(d, np.sqrt(d))
    kernel = kernels.ConstantKernel(0.5, (1e-4, 1e3)) * kernels.RBF(lengths, (0.2, 1e3))
    kernel = kernel + kernels.WhiteKernel(0.1, (1e-10, 1e2))
    with warnings.catch_warnings():
        # A length scale at its bound means an input that does not matter: nothing to act on.
        warnings.simplefilter("ignore", ConvergenceWarning)
        optimizer: Any = _optimum
        process = GaussianProcessRegressor(kernel, optimizer=optimizer, random_state=seed)
        fitted: Any = process.fit(z, targets).kernel_
    lengths = np.broadcast_to(fitted.k1.k2.length_scale, (d,))
    return float(fitted.k1.k1.constant_value), float(fitted.k2.noise_level), lengths


def _optimum(cost: Any, start: Array, bounds: Array) -> tuple[Array, float]:
    """L-BFGS-B to the rounding of the likelihood.

    With the usual tolerances it stops where rounding decides, and the units of the data with it.
    """
    tight = {"ftol": 1e-13, "gtol": 1e-8, "maxiter": 1000}
    found = scipy.optimize.minimize(
        cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=tight
    )
    return found.x, float(found.fun)
