"""What refinement adds to a model, and where the learning of it starts.

Latent states: poles over a range. What a linear fit of the derivatives leaves over is regressed on
the inputs filtered by each pole; the best single drive per pole is the leading singular pair of
those coefficients. A network: directions drawn at random, and nothing added to the derivatives yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.derivatives import kinematic_rows
from dfsm.models.corrective import Perceptron
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import Poles, add_latents, as_states
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.record import Record

# Poles lie between a thirtieth of the records and some steps of the refinement.
_SLOWEST, _FASTEST = 30.0, 7.0
_RIDGE = 1e-2


def start_latents(
    model: DFSM,
    records: Sequence[Record],
    count: int,
    spread: Array,
    drivers: Sequence[str] | None = None,
) -> DFSM:
    """Add latent states that explain some of what the model's derivatives leave over.

    Parameters
    ----------
    model
        Has none but perhaps induced velocities.
    records
        Training runs.
    count
        How many, an even number: they come in damped pairs.
    spread
        Typical size of the observed states' derivatives, shape ``(state,)``.
    drivers
        Controls and disturbances that drive them; None takes all.

    Returns
    -------
    DFSM
        Each pair moves by about one standard deviation.
    """
    s, region = model.signals, model.region
    pairs, driving = count // 2, s.order.driving_columns
    longest = max((len(r.states) - 1) * r.step for r in records)
    decay = np.geomspace(_SLOWEST / longest, 1 / (_FASTEST * records[0].step), pairs)
    kinematic = kinematic_rows(s.specs)
    rows = [i for i in range(len(s.observed)) if i not in kinematic]
    left = np.concatenate([r.left_over(model)[:, rows] / spread[rows] for r in records])

    std = np.asarray(region.scale)[driving]
    columns = [i for i, n in enumerate(s.driving) if drivers is None or n in drivers]
    each = np.repeat(decay, len(columns))
    drive = np.tile(np.diag(1 / std)[columns], (pairs, 1)) * each[:, None]
    middle = np.asarray(region.mean)[driving]
    filters = _poles(each, drive, middle)
    filtered = np.concatenate([r.follow(filters)[r.before :] for r in records])
    coefficients = _regress(filtered, left).reshape(len(rows), pairs, len(columns))
    drives = np.zeros((pairs, len(s.driving)), dtype=complex)
    for k in range(pairs):
        best = np.linalg.svd(coefficients[:, k], full_matrices=False)[2][0]
        drives[k, columns] = best * decay[k] / std[columns]
    paths = np.concatenate([r.follow(_poles(decay, drives, middle)) for r in records])
    drives /= np.sqrt(np.mean(np.abs(paths) ** 2, axis=0) / 2)[:, None]
    dynamics = _poles(decay, drives, middle)
    pairs_along = [r.follow(dynamics)[r.before :] for r in records]
    c = _regress(np.concatenate(pairs_along), left)
    coupling = np.zeros((len(s.states), count))
    # Re(c ζ) in terms of the real states Re ζ and Im ζ.
    both = np.stack([c.real, -c.imag], axis=2).reshape(len(rows), count)
    coupling[rows] = both * spread[rows, None]
    gains = _through_terms(model, records, coupling)
    along = [np.asarray(as_states(from_host(z))) for z in pairs_along]
    return add_latents(model, dynamics, coupling, along, gains)


def start_network(model: DFSM, hidden: int, spread: Array, seed: int) -> DFSM:
    """Add a tanh network to a derivative function that nothing corrects.

    Parameters
    ----------
    model
        Has no corrective function.
    hidden
        Number of units.
    spread
        Typical size of the observed states' derivatives, shape ``(state,)``.
    seed
        Draws the directions.

    Returns
    -------
    DFSM
        Predicts what it did before. Inputs whose effect is known from physics are
        hidden from the network.
    """
    known = model.f.complete(model.signals.latent_columns)
    rows = tuple(r for r in Parametrization.of(model, spread).rows if r not in known)
    rng, inputs, region = np.random.default_rng(seed), len(model.signals.inputs), model.region
    directions = rng.standard_normal((hidden, inputs)) / np.sqrt(inputs)
    network = Perceptron(
        shift=region.mean,
        scale=region.scale,
        weights=(from_host(directions), from_host(np.zeros((len(rows), hidden)))),
        biases=(from_host(rng.uniform(-1, 1, hidden)), from_host(np.zeros(len(rows)))),
    )
    unseen = model.f.hidden_among(inputs, model.signals.latent_columns)
    return replace(model, e=network.ignoring(unseen), corrected=rows)


def _through_terms(model: DFSM, records: Sequence[Record], coupling: Array) -> dict[int, Array]:
    """Effects of latent states on rows that are known, as effects on the first signal of a term.

    Parameters
    ----------
    model
        Without latent states.
    records
        Training runs.
    coupling
        What one unit of each latent state adds to the derivatives, shape ``(state, latent)``; rows
        that are known become zero, and what reaches others through a term is taken from them.

    Returns
    -------
    dict
        By place of the term, shape ``(latent,)``.
    """
    if model.terms is None:
        return {}
    first, inputs = len(model.signals.inputs), model.signals.state_columns.start
    wakes = range(len(model.signals.observed), model.signals.marched)
    at = np.concatenate([r.inputs_at(model) for r in records])
    slopes = model.terms.slopes(at).mean(axis=0)
    L, gains, value = np.asarray(model.f.coefficients).mean(axis=0), {}, first
    for place, term in enumerate(model.terms.parts):
        columns = slice(value, value + len(term.channels))
        value = columns.stop
        if term.driven is None or (row := term.driven - inputs) not in model.balances:
            continue
        # Per unit of the signal, in every row.
        effect = L[:, columns] @ slopes[columns.start - first : columns.stop - first]
        effect = effect[:, term.columns[0]]
        gains[place] = coupling[row] / effect[row]
        coupling -= np.outer(effect, gains[place])
        coupling[[row, *wakes]] = 0.0
    return gains


def _poles(decay: Array, drive: Array, middle: Array) -> Poles:
    """Poles at 45 degrees, at rest under the mean inputs."""
    b = jnp.asarray(drive, dtype=complex)
    return Poles(jnp.asarray(decay), jnp.asarray(decay), b, -b @ middle)


def _regress(paths: Array, targets: Array) -> Array:
    """Complex m with targets = Re(paths mᵀ), ridge regression; shape ``(target, path)``."""
    X = np.concatenate([paths.real, -paths.imag], axis=1)
    scale = np.sqrt(np.mean(X**2, axis=0))
    Z = X / scale
    Q = Z.T @ Z / len(Z) + _RIDGE * np.eye(Z.shape[1])
    c = np.linalg.solve(Q, Z.T @ targets / len(Z)) / scale[:, None]
    n = paths.shape[1]
    return (c[:n] + 1j * c[n:]).T
