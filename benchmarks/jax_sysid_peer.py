"""A recurrent model of the floating turbine by jax-sysid, in an environment of its own.

python -I jax_sysid_peer.py inputs.npz predictions.npz

Needs only jax-sysid, whose JAX is older than dfsm's; `benchmarks.peer` writes the first file, runs
this and reads the second. Structure, scaling and solvers are those of jax-sysid's documentation.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax_sysid.models import Model  # pyright: ignore[reportMissingImports]

UNITS = 16
SEEDS = (0, 1)
# Chosen on the runs held out; the documentation has 0.001 and 1000.
RATE = 0.01  # Adam's, for 1000 steps
LBFGS = 2000  # evaluations
RHO = 1e-4  # weight of the squared parameters and initial states


def step(x: Any, u: Any, params: Sequence[Any]) -> Any:
    """Next states (..., state) from a linear part and tanh units."""
    linear, hidden, weights, bias, offset, _, _ = params
    z = jnp.concatenate([x, u], axis=-1)
    return z @ linear.T + jnp.tanh(z @ hidden.T + bias) @ weights.T + offset


def output(x: Any, u: Any, params: Sequence[Any]) -> Any:  # noqa: ARG001
    """Outputs (..., output)."""
    return x @ params[5].T + params[6]


def first_guess(states: int, inputs: int, outputs: int, seed: int) -> list[np.ndarray]:
    """Random parameters, of the sizes that the documentation has."""
    draw = np.random.default_rng(seed).standard_normal
    return [
        np.hstack([0.5 * np.eye(states), 0.1 * draw((states, inputs))]),
        np.hstack([0.1 * draw((UNITS, states)), 0.5 * draw((UNITS, inputs))]),
        0.5 * draw((states, UNITS)),
        np.zeros(UNITS),
        np.zeros(states),
        0.1 * draw((outputs, states)),
        np.zeros(outputs),
    ]


def fit(u: np.ndarray, y: np.ndarray, states: int, seed: int) -> Any:
    """Model trained on runs (run, time, channel) of standardised signals.

    The runs are simulated side by side, as one system whose state holds theirs: the sum of errors
    that jax-sysid minimises for a list of runs, in one loop over time instead of one per run.
    """
    runs, _, inputs = u.shape
    outputs = y.shape[2]

    def split(v: Any) -> Any:
        return v.reshape(runs, -1)

    together = Model(
        runs * states,
        runs * outputs,
        runs * inputs,
        state_fcn=lambda x, u, th: step(split(x), split(u), th).reshape(-1),
        output_fcn=lambda x, u, th: output(split(x), split(u), th).reshape(-1),
    )
    together.init(params=first_guess(states, inputs, outputs, seed))
    together.loss(rho_x0=RHO, rho_th=RHO)
    together.optimization(adam_eta=RATE, adam_epochs=1000, lbfgs_epochs=LBFGS, iprint=-1)
    together.fit(*(v.swapaxes(0, 1).reshape(v.shape[1], -1) for v in (y, u)))
    model = Model(states, outputs, inputs, state_fcn=step, output_fcn=output)
    model.init(params=together.params)
    model.loss(rho_x0=RHO, rho_th=RHO)
    return model


def predict(model: Any, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Outputs (time, output) from the start on, of a run whose record `y` ends there.

    `y` has the records of a while before the start, and the one at the start; `u` goes on.
    """
    before = len(y)
    x0 = model.learn_x0(u[:before], y, verbosity=False, LBFGS_refinement=True)
    return np.asarray(model.predict(x0, u)[0])[before - 1 :]


def main() -> None:
    """Fit every size from every seed; the model best on the runs held out predicts the tests."""
    data = np.load(sys.argv[1])
    begin = time.perf_counter()
    # jax-sysid would switch these on with the first model, after the first arrays.
    jax.config.update("jax_enable_x64", True)
    u, y = data["training_inputs"], data["training_outputs"]
    u_held, y_held, known = data["held_inputs"], data["held_outputs"], data["test_outputs"]
    middle, size = ([f(v, axis=(0, 1)) for v in (u, y)] for f in (np.mean, np.std))
    u, u_held, u_test = ((v - middle[0]) / size[0] for v in (u, u_held, data["test_inputs"]))
    y, y_held, known = ((v - middle[1]) / size[1] for v in (y, y_held, known))
    start = known.shape[1] - 1
    errors, models = [], []
    for states, seed in product(data["states"].tolist(), SEEDS):
        model = fit(u[:, start:], y[:, start:], states, seed)
        predicted = [
            predict(model, *run) for run in zip(u_held, y_held[:, : start + 1], strict=True)
        ]
        models.append(model)
        truth = y_held[:, start:]
        rms = np.sqrt(np.mean((predicted - truth) ** 2, axis=1))
        errors.append(np.mean(rms / np.std(truth, axis=1)))
        print(
            f"{states} states, seed {seed}: {errors[-1]:.3f} on the runs held out", file=sys.stderr
        )
    best = models[int(np.nanargmin(errors))]
    seconds = time.perf_counter() - begin
    predicted = [predict(best, *run) for run in zip(u_test, known, strict=True)]
    np.savez(sys.argv[2], outputs=np.array(predicted) * size[1] + middle[1], fit_s=seconds)


if __name__ == "__main__":
    main()
