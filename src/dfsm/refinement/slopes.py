"""Slopes of rollouts in a model's parameters: of a sum exactly, of every state nearly.

What decides where refinement ends is the slope of the error, and that is exact: backwards through
the Runge-Kutta steps, with λ the slope of the sum in the states,

    λ ← Φᵀ λ + e ,    d/dθ = Σ (∂f̂/∂θ)ᵀ μ ,

where μ is what λ makes of each stage. How long the steps are is decided by JᵀJ, for which forward
sensitivities, Ṡ = (∂f̂/∂ξ) S + ∂f̂/∂θ, are taken with the slopes in the middle of every step: they
err with the square of the step, and need a quarter of the evaluations.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

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
_BLOCK = 24
# Of the four stages of a step, the better one in its middle.
_MIDDLE = 2


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


class Path(NamedTuple):
    """A rollout with what happens at the four stages of each step.

    Attributes
    ----------
    free
        1 where a state was not held at the end of its range after a step, else 0,
        ``(step, state)``.
    inputs
        I at the stages, ``(step, stage, input)``.
    slopes
        ∂f̂/∂ξ there of the marched states, ``(step, stage, marched state, state)``.
    """

    free: jax.Array
    inputs: jax.Array
    slopes: jax.Array


def path_of(model: DFSM, step: float, x0: jax.Array, drive: Stages) -> Path:
    """Follow a rollout as `rk4` does.

    Parameters
    ----------
    model
        The surrogate, `prepared`.
    step
        In s.
    x0
        States at the start, shape ``(state,)``.
    drive
        Exogenous inputs along the steps, see `integrate.stages`.
    """
    low, high = clip_range(model, FAR)
    split = model.signals.order.split_exogenous

    def advance(
        x: jax.Array, drive: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        v0, vm, v1 = drive
        x, at = rk4_step(partial(rate, model), x, step, drive)
        seen = [model.join(x, *split(v)) for x, v in zip(at, (v0, vm, vm, v1), strict=True)]
        held = jnp.clip(x, low, high)
        return held, (jnp.where(held == x, 1.0, 0.0), jnp.stack(seen))

    _, (free, inputs) = jax.lax.scan(advance, x0, drive)
    matrix = jax.vmap(jax.vmap(partial(state_matrix, model)))
    return Path(free, inputs, _by_block(matrix, inputs))


def state_matrix(model: DFSM, inputs: jax.Array) -> jax.Array:
    """∂f̂/∂ξ of the marched states at one input vector, ``(marched state, state)``.

    Written out: most signals reach a term through few numbers, see `Term.effective`.
    """
    s, f, terms = model.signals, model.f, model.terms
    columns, value = s.state_columns, inputs[model.f.schedule or 0]
    L = f.at(value)[0][: s.marched]
    A = L[:, columns]
    if terms is not None:
        A = A + L[:, len(s.inputs) :] @ terms.slopes_at(inputs)[:, columns]
    if f.schedule is not None and columns.start <= f.schedule < columns.stop:
        wide = inputs if terms is None else terms.extend(inputs)
        by_schedule = jax.jacfwd(lambda value: f(wide, value))(value)[: s.marched]
        A = A.at[:, f.schedule - columns.start].add(by_schedule)
    if model.e is not None:
        rows = np.array(model.corrected, dtype=int)
        A = A.at[rows].add(jax.jacrev(model.e)(inputs)[:, columns])
    return A


def _by_block(function: Callable[[jax.Array], jax.Array], inputs: jax.Array) -> jax.Array:
    """A function of steps, block by block, so that what lies between stays in the cache."""
    steps = len(inputs)
    each = jax.lax.map(function, _blocks(inputs, min(_BLOCK, steps), "edge"))
    return each.reshape(-1, *each.shape[2:])[:steps]


def _blocks(a: jax.Array, size: int, mode: str) -> jax.Array:
    """Steps in blocks, ``(block, size, ...)``; beyond the end the last or zeros follow."""
    count = -(-len(a) // size)
    end = [(0, count * size - len(a))] + [(0, 0)] * (a.ndim - 1)
    return jnp.pad(a, end, mode=mode).reshape(count, size, *a.shape[1:])


# -- backwards ----------------------------------------------------------------------------------


def slope_of_sum(
    parameters: Parametrization, w: jax.Array, step: float, path: Path, errors: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Slope of Σ eᵀ ξ over the ends of the steps, exactly that of what `rk4` does.

    Parameters
    ----------
    parameters, w
        The model.
    step
        In s.
    path
        The rollout.
    errors
        e of the observed states, ``(step, observed state)``.

    Returns
    -------
    tuple of Array
        In the states at the start, ``(state,)``, and in the parameters from there on,
        ``(parameter,)``.
    """
    model = parameters.at(w)
    marched, M = model.signals.marched, _pair_matrices(model)
    e = jnp.pad(errors, ((0, 0), (0, path.free.shape[1] - errors.shape[1])))

    def back(A: jax.Array, mu: jax.Array) -> jax.Array:
        by_pair = jnp.einsum("kab,ka->kb", M, mu[marched:].reshape(-1, 2))
        return (mu[:marched] @ A).at[marched:].add(by_pair.ravel())

    def step_back(
        slope: jax.Array, along: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        free, A, e = along
        end = (slope + e) * free
        mu4 = step / 6 * end
        by4 = back(A[3], mu4)
        mu3 = step / 3 * end + step * by4
        by3 = back(A[2], mu3)
        mu2 = step / 3 * end + step / 2 * by3
        by2 = back(A[1], mu2)
        mu1 = step / 6 * end + step / 2 * by2
        return end + back(A[0], mu1) + by2 + by3 + by4, jnp.stack([mu1, mu2, mu3, mu4])

    along = path.free, path.slopes, e
    start, mu = jax.lax.scan(step_back, jnp.zeros(e.shape[1]), along, reverse=True)

    def derivatives(w: jax.Array, inputs: jax.Array) -> jax.Array:
        model = parameters.at(w).prepared()
        return jax.vmap(jax.vmap(lambda at: model.derivative(*model.split(at))))(inputs)

    def add(total: jax.Array, block: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        inputs, mu = block
        return total + jax.grad(lambda w: jnp.vdot(mu, derivatives(w, inputs)))(w), None

    size = min(_BLOCK, len(mu))
    blocks = _blocks(path.inputs, size, "edge"), _blocks(mu, size, "constant")
    return start, jax.lax.scan(add, jnp.zeros(w.size), blocks)[0]


def _pair_matrices(model: DFSM) -> jax.Array:
    """What the latent pairs do by themselves, ``(pair, 2, 2)``."""
    own = poles(model)
    M = jnp.stack([-own.decay, own.frequency, -own.frequency, -own.decay])
    return M.T.reshape(-1, 2, 2)


# -- forwards -----------------------------------------------------------------------------------


def sensitivities(
    parameters: Parametrization,
    w: jax.Array,
    step: float,
    path: Path,
    slopes0: tuple[jax.Array, jax.Array],
    every: int,
) -> jax.Array:
    """Slopes of the observed states along a rollout, those in the middle of a step for all of it.

    Once the path is known, what each step does to the slopes, S ← Φ S + G, follows for all steps
    at once; only that recursion is left to march. A latent pair depends on its own parameters
    alone, so that its slopes are few and are marched first.

    Parameters
    ----------
    parameters, w
        The model.
    step
        In s.
    path
        The rollout.
    slopes0
        Slopes at the start of the latent pairs, ``(pair, 2, own)``, and of the states that are
        marched, ``(marched state, parameter)``.
    every
        Steps of which one keeps its slopes, see `spread_steps`.

    Returns
    -------
    Array
        S after the steps kept, ``(block, observed state, parameter)``.
    """
    model = parameters.at(w)
    observed, steps = len(model.signals.observed), len(path.inputs)
    inputs, A = path.inputs[:, _MIDDLE], path.slopes[:, _MIDDLE]
    pairs = pairs_along(parameters, model, step, slopes0[0], inputs, path.free)

    def along(S: jax.Array, block: tuple[Any, jax.Array]) -> tuple[jax.Array, jax.Array]:
        part, keep = block
        S, each = jax.lax.scan(_advance, S, _transitions(parameters, w, model, step, *part))
        return S, each[:, :observed][keep]

    size = -(-min(_BLOCK, steps) // every) * every
    parts = [_blocks(a, size, "edge") for a in (path.free, inputs, A, (pairs[1:] + pairs[:-1]) / 2)]
    kept, _ = spread_steps(steps, every)
    keep = np.zeros(len(parts[0]) * size // every, dtype=int)
    keep[: len(kept)] = kept % size
    chosen = jnp.asarray(keep.reshape(len(parts[0]), -1))
    _, S = jax.lax.scan(along, slopes0[1], (tuple(parts), chosen))
    return S.reshape(-1, observed, w.size)[: len(kept)]


def _advance(S: jax.Array, transition: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    S = transition[0] @ S + transition[1]
    return S, S


def _transitions(
    parameters: Parametrization,
    w: jax.Array,
    model: DFSM,
    step: float,
    free: jax.Array,
    inputs: jax.Array,
    A: jax.Array,
    pairs: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Φ and G of every step, S ← Φ S + G.

    Parameters
    ----------
    parameters, w, model
        What may change, how much it has changed, and the model that makes.
    step
        In s.
    free, inputs, A, pairs
        See `Path`, in the middles of steps, and slopes of the latent pairs there.

    Returns
    -------
    tuple of Array
        Shapes ``(step, marched state, marched state)`` and ``(step, marched state, parameter)``.
    """
    marched, columns = model.signals.marched, parameters.latent_columns
    own, free = A[..., :marched], free[:, :marched, None]
    gain = _gain(own, step) * free
    grown = parameters.slopes(w, model, inputs[:, None], gain[:, None])
    if columns.size:
        coupling = A[..., marched:].reshape(*A.shape[:2], -1, 2)
        grown = grown.at[..., columns].add(jnp.einsum("tab,tbkc,tkcq->takq", gain, coupling, pairs))
    return free * jnp.eye(marched) + gain @ own, grown


def _gain(A: jax.Array, h: float) -> jax.Array:
    """∫ exp(A t) dt over a step to the order of RK4, ``(..., state, state)``."""
    one, x = jnp.eye(A.shape[-1]), h * A
    return h * (one + x / 2 @ (one + x / 3 @ (one + x / 4)))


def pairs_along(
    parameters: Parametrization,
    model: DFSM,
    step: float,
    start: jax.Array,
    inputs: jax.Array,
    free: jax.Array | None = None,
) -> jax.Array:
    """Slopes of the latent pairs in their own parameters at the ends of steps.

    Parameters
    ----------
    parameters, model
        What may change, and what some deviations make.
    step
        In s.
    start
        Slopes at first, ``(pair, 2, own)``.
    inputs
        I in the middles of steps, of which only what drives the pairs and they themselves count,
        ``(step, input)``.
    free
        As in `Path`; None where no state was held.

    Returns
    -------
    Array
        Shape ``(step + 1, pair, 2, own)``.
    """
    if not start.size:
        return jnp.zeros((len(inputs) + 1, *start.shape))
    M = _pair_matrices(model)
    gain = _gain(M, step)
    growth = jnp.eye(2) + gain @ M
    added = gain @ jax.vmap(partial(parameters.latent_slopes, model))(inputs)
    if free is not None:
        free = free[:, model.signals.marched :].reshape(len(inputs), -1, 2, 1)

    def advance(
        P: jax.Array, along: tuple[jax.Array, jax.Array | None]
    ) -> tuple[jax.Array, jax.Array]:
        added, free = along
        P = growth @ P + added
        P = P if free is None else P * free
        return P, P

    return jnp.concatenate([start[None], jax.lax.scan(advance, start, (added, free))[1]])


def pairs_at_rest(parameters: Parametrization, model: DFSM, inputs: jax.Array) -> jax.Array:
    """These slopes where the pairs are at rest under their inputs I, ``(pair, 2, own)``."""
    return -jnp.linalg.solve(_pair_matrices(model), parameters.latent_slopes(model, inputs))
