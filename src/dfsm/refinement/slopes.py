"""Rollouts with their exact slopes in a model's parameters.

Forward sensitivities, S = dξ/dθ, taken through the same Runge-Kutta steps as the states,

    Ṡ = (∂f̂/∂ξ) S + ∂f̂/∂θ .
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array, IntArray
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import poles
from dfsm.numerics.runge_kutta import rk4_step
from dfsm.refinement.parameters import Parametrization
from dfsm.simulation.integrate import Stages, clip_range, rate

# A rollout that leaves the training range this many half-ranges from its middle is cut off there:
# the error stays finite and still has a slope.
FAR = 30.0
# Steps whose slopes are computed at once.
_BLOCK = 48

# States, and slopes of the latent pairs.
_At = tuple[jax.Array, jax.Array]


def spread_steps(steps: int, every: int) -> tuple[IntArray, Array]:
    """Steps that stand for all in a sum over a window, and how many each stands for.

    Slopes grow along a window, so that each stands in the middle of its block, where a linear
    function has its mean; an even block has two middles, which are taken in turns. The last block
    may be shorter.

    Parameters
    ----------
    steps
        Number of steps.
    every
        Steps per block.

    Returns
    -------
    tuple of ndarray
        Places, counted from 0, and counts, shape ``(block,)`` with ``steps`` over `every` blocks,
        rounded up.
    """
    first = np.arange(0, steps, every)
    count = np.minimum(every, steps - first)
    return first + (count - 1 + np.arange(len(first)) % 2) // 2, count.astype(float)


def sensitivities(
    parameters: Parametrization,
    w: jax.Array,
    step: float,
    x0: jax.Array,
    slopes0: tuple[jax.Array, jax.Array],
    drive: Stages,
    errors: jax.Array,
    every: int,
) -> tuple[jax.Array, jax.Array]:
    """Slopes of the observed states along a rollout, those of what `rk4` does.

    Once the path is known, what each step does to the slopes, S ← Φ S + G, follows for all steps
    at once; only that recursion is left to march. A latent pair depends on its own parameters
    alone, so that its slopes are few and travel with the states.

    Parameters
    ----------
    parameters, w
        The model.
    step
        In s.
    x0
        States at the start, shape ``(state,)``.
    slopes0
        Slopes there of the latent pairs, ``(pair, 2, own)``, and of the states that are marched,
        ``(marched state, parameter)``.
    drive
        Exogenous inputs along the steps, see `integrate.stages`.
    errors
        Factors e of the slopes in a sum, ``(step, observed state)``.
    every
        Steps of which one keeps its slopes, see `spread_steps`; the sum is over all.

    Returns
    -------
    tuple of Array
        S after the steps kept, ``(block, observed state, parameter)``, and Σ Sᵀ e,
        ``(parameter,)``.
    """
    model = parameters.at(w)
    path = _path(parameters, model, step, x0, slopes0[0], drive)
    observed, steps = len(model.signals.observed), len(path.states)

    def along(
        at: tuple[jax.Array, jax.Array], block: tuple[_Path, jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        S, total = at
        part, e, keep = block
        S, each = jax.lax.scan(_advance, S, _transitions(parameters, w, model, step, part))
        seen = each[:, :observed]
        return (S, total + jnp.einsum("tap,ta->p", seen, e)), seen[keep]

    # Blocks stay in the cache; beyond the end the last step is repeated, and does not count.
    size = -(-min(_BLOCK, steps) // every) * every
    count = -(-steps // size)

    def blocks(a: jax.Array, mode: str) -> jax.Array:
        end = [(0, count * size - steps)] + [(0, 0)] * (a.ndim - 1)
        return jnp.pad(a, end, mode=mode).reshape(count, size, *a.shape[1:])

    kept, _ = spread_steps(steps, every)
    keep = np.zeros(count * size // every, dtype=int)
    keep[: len(kept)] = kept % size
    along_path = jax.tree.map(partial(blocks, mode="edge"), path)
    start = slopes0[1], jnp.zeros(w.size)
    each = along_path, blocks(errors, "constant"), jnp.asarray(keep).reshape(count, -1)
    (_, total), S = jax.lax.scan(along, start, each)
    return S.reshape(-1, observed, w.size)[: len(kept)], total


def _advance(S: jax.Array, transition: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    S = transition[0] @ S + transition[1]
    return S, S


def _transitions(
    parameters: Parametrization, w: jax.Array, model: DFSM, step: float, path: _Path
) -> tuple[jax.Array, jax.Array]:
    """Φ and G of every step, S ← Φ S + G.

    Parameters
    ----------
    parameters, w, model
        What may change, how much it has changed, and the model that makes.
    step
        In s.
    path
        Some steps of the rollout.

    Returns
    -------
    tuple of Array
        Shapes ``(step, marched state, marched state)`` and ``(step, marched state, parameter)``.
    """
    marched, columns = model.signals.marched, parameters.latent_columns
    A = jax.vmap(jax.vmap(partial(_state_matrix, model.prepared())))(path.inputs)
    own = A[..., :marched]
    free = path.free[:, :marched]
    weights = _stage_weights(own, step) * free[:, None, :, None]
    through = jnp.einsum("tiab,tibc->tac", weights, own)
    grown = parameters.slopes(w, model, path.inputs, weights)
    if columns.size:
        coupling = A[..., marched:].reshape(*A.shape[:3], -1, 2)
        by_pair = jnp.einsum("tiab,tibkc,tikcq->takq", weights, coupling, path.pairs)
        grown = grown.at[..., columns].add(by_pair)
    return free[..., None] * jnp.eye(marched) + through, grown


class _Path(NamedTuple):
    """A rollout with what happens at the four stages of each step.

    Attributes
    ----------
    states
        At the ends of the steps, ``(step, state)``.
    free
        1 where a state was not held at the end of its range there, else 0; same shape.
    inputs
        I at the stages, ``(step, stage, input)``.
    pairs
        Slopes of the latent pairs at the stages, ``(step, stage, pair, 2, own)``.
    """

    states: jax.Array
    free: jax.Array
    inputs: jax.Array
    pairs: jax.Array


def _path(
    parameters: Parametrization,
    plain: DFSM,
    step: float,
    x0: jax.Array,
    pairs0: jax.Array,
    drive: Stages,
) -> _Path:
    """March states and latent slopes; arguments as for `sensitivities`, `plain` is the model."""
    model, dynamics = plain.prepared(), poles(plain)
    low, high = clip_range(model, FAR)
    marched = plain.signals.marched
    M = jnp.stack([-dynamics.decay, dynamics.frequency, -dynamics.frequency, -dynamics.decay])
    M = M.T.reshape(-1, 2, 2)

    def inputs(x: jax.Array, v: jax.Array) -> jax.Array:
        return model.join(x, *model.signals.order.split_exogenous(v))

    def slope(at: _At, v: jax.Array) -> _At:
        x, P = at
        grown = M @ P + parameters.latent_slopes(plain, inputs(x, v)) if P.size else P
        return rate(model, x, v), grown

    def advance(at: _At, drive: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[_At, _Path]:
        (x, P), stages = rk4_step(slope, at, step, drive)
        held = jnp.clip(x, low, high)
        free = jnp.where(held == x, 1.0, 0.0)
        P = P * free[marched:].reshape(-1, 2)[..., None]
        v0, vm, v1 = drive
        seen = [inputs(x, v) for (x, _), v in zip(stages, (v0, vm, vm, v1), strict=True)]
        pairs = jnp.stack([pair for _, pair in stages])
        return (held, P), _Path(held, free, jnp.stack(seen), pairs)

    return jax.lax.scan(advance, (x0, pairs0), drive)[1]


def _state_matrix(model: DFSM, inputs: jax.Array) -> jax.Array:
    """∂f̂/∂ξ of the marched states at one input vector, ``(marched state, state)``."""
    x, *others = model.split(inputs)
    marched = model.signals.marched
    return jax.jacrev(lambda x: model.derivative(x, *others)[:marched])(x)


def _stage_weights(A: jax.Array, h: float) -> jax.Array:
    """How what is added to dS/dt at each of the four stages of a step enters S at its end.

    Parameters
    ----------
    A
        ∂f̂/∂ξ at the stages, ``(step, stage, state, state)``.
    h
        Length of the steps in s.

    Returns
    -------
    Array
        Matrices of the same shape; from unrolling the classical Runge-Kutta step.
    """
    _, A2, A3, A4 = (A[:, i] for i in range(4))
    one = jnp.broadcast_to(jnp.eye(A.shape[-1]), A2.shape)
    w3 = 2 * one + h * A4
    w2 = 2 * one + h / 2 * w3 @ A3
    w1 = one + h / 2 * w2 @ A2
    return h / 6 * jnp.stack([w1, w2, w3, one], axis=1)
