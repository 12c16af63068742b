"""Fixed steps over many runs: one loop along time over a batch, whose arrays lie time first.

Inputs are interpolated and states kept where the loop runs; outputs and the check of the training
region follow in parts that fit the memory. On a processor every run is a batch of its own, one
thread per core; an accelerator takes as many runs at once as its memory holds, while the next are
prepared and the last are judged in threads of the host. For these, every run is one piece of
memory: arrays are turned from run first to time first, and back, where that costs least.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array, IntArray
from dfsm.models.dfsm import DFSM
from dfsm.simulation.integrate import Case, Mesh, Rollout, seen, stepped

# Samples and runs are padded to this many sizes between a power of two and the next, so that runs
# of similar length, and batches of similar number, share a compilation.
_SIZES = 8
_FEWEST_SAMPLES = 1024
# Runs in one batch: beyond, an accelerator gains nothing, and its host waits.
_MOST_RUNS = 4096
# Share of the free memory for one batch; the one before is still there when the next begins. Its
# arrays are there twice, as they come and go and time first.
_SHARE, _COPIES = 0.3, 2
# Where a device does not say how much memory it has, bytes for one batch.
_ASSUMED = 2**30
# Samples whose outputs are computed at once: activations of hundreds of units stay in a core's
# cache, or fill an accelerator.
_SEEN, _SEEN_AT_ONCE = 256, 2**17

Judged = TypeVar("Judged")
Finish = Callable[[int, Rollout], Judged]


class _Batch(NamedTuple):
    """Where some runs start and what drives them, padded.

    Attributes
    ----------
    x0, psi0
        Initial states ``(run, state)`` and azimuths in rad ``(run,)``.
    intervals
        Between samples, in s, ``(run, sample - 1)``; zero changes nothing.
    values
        Inputs at the samples, ``(run, sample, exogenous)``.
    bends
        Coefficients of the powers three to one of the inputs that are splines,
        ``(run, 3, sample - 1, spline)``.
    field
        Harmonics of the wind field at the samples, ``(run, sample, channel)``.
    """

    x0: Array
    psi0: Array
    intervals: Array
    values: Array
    bends: Array
    field: Array


class _Kind(NamedTuple):
    """What is compiled in: which inputs are held, which splines, and whether samples are steps."""

    held: tuple[bool, ...]
    splines: tuple[int, ...]
    one: bool


def march(
    model: DFSM, meshes: Sequence[Mesh], case: Callable[[int], Case[Mesh]], finish: Finish[Judged]
) -> list[Judged]:
    """Classical RK4 along many runs.

    Parameters
    ----------
    model
        The surrogate.
    meshes
        Steps of every run; lengths may differ.
    case
        Prepares the run of an index; called in threads.
    finish
        Takes the index of a run and its rollout; called in threads. The rollout's arrays may be
        parts of larger ones, to be copied.

    Returns
    -------
    list
        What `finish` gave, in the order of the runs.
    """
    if len(meshes) == 1:
        return [finish(0, _one(model, case(0)))]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        if not in_batches():
            return list(pool.map(lambda i: finish(i, _one(model, case(i))), range(len(meshes))))
        found: dict[int, Future[Judged]] = {}
        for rows, results in _ahead(model, meshes, case, pool):
            for k, i in enumerate(rows):
                found[i] = pool.submit(finish, i, _rollout(results, meshes[i], k))
        return [found[i].result() for i in range(len(meshes))]


def in_batches() -> bool:
    """Whether many runs are marched at once.

    On a processor XLA keeps a loop on one core, and a single run stays in its cache where a batch
    does not.
    """
    return _device().platform != "cpu"


def _device() -> Any:
    """Where JAX computes; `jax.default_device` may say so."""
    chosen = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return jax.devices(chosen)[0] if chosen is None or isinstance(chosen, str) else chosen


_Results = tuple[Array, ...]
_Sent = tuple[jax.Array, ...] | Exception


def _one(model: DFSM, case: Case[Mesh]) -> Rollout:
    results = _march_batch(model, [case])
    return _rollout(tuple(map(np.asarray, results)), case.drive, 0)


def _rollout(results: _Results, mesh: Mesh, run: int) -> Rollout:
    return Rollout(*(part[run, : len(mesh.time)] for part in results), solved=True)


def _ahead(
    model: DFSM,
    meshes: Sequence[Mesh],
    case: Callable[[int], Case[Mesh]],
    pool: ThreadPoolExecutor,
) -> Iterator[tuple[list[int], _Results]]:
    """Batches and their results; each is under way before the one before it is read."""
    before: tuple[list[int], _Sent] | None = None
    for rows in [*_batches(model, meshes), None]:
        now = None if rows is None else (rows, _sent(model, case, pool, rows))
        if before is not None:
            yield from _read(model, case, pool, *before)
        before = now


def _sent(
    model: DFSM, case: Callable[[int], Case[Mesh]], pool: ThreadPoolExecutor, rows: list[int]
) -> _Sent:
    """What a batch will give, or why the device does not take it."""
    try:
        return _march_batch(model, list(pool.map(case, rows)), pool)
    except jax.errors.JaxRuntimeError as error:
        return error


def _read(
    model: DFSM,
    case: Callable[[int], Case[Mesh]],
    pool: ThreadPoolExecutor,
    rows: list[int],
    sent: _Sent,
) -> Iterator[tuple[list[int], _Results]]:
    """Results of a batch, or of its halves where the device had no memory for it after all."""
    results = None
    try:
        if isinstance(sent, Exception):
            raise sent
        results = tuple(map(np.asarray, sent))
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error) or len(rows) == 1:
            raise
    if results is not None:
        yield rows, results
        return
    for half in (rows[: len(rows) // 2], rows[len(rows) // 2 :]):
        yield from _read(model, case, pool, half, _sent(model, case, pool, half))


def _batches(model: DFSM, meshes: Sequence[Mesh]) -> Iterator[list[int]]:
    """Runs that are marched together: of one kind, similar length, and no more than fit."""
    kinds: dict[tuple[_Kind, int], list[int]] = {}
    for i, mesh in enumerate(meshes):
        kinds.setdefault((_kind(mesh), mesh.every), []).append(i)
    s = model.signals
    for rows in kinds.values():
        rows.sort(key=lambda i: (len(meshes[i].time), i))
        longest = meshes[rows[-1]]
        splines = 3 * len(_kind(longest).splines)
        wide = 2 + len(s.exogenous) + splines + len(s.states) + len(s.outputs) + len(s.field)
        each = 8 * _COPIES * wide * padded(len(longest.time), _FEWEST_SAMPLES)
        most = min(_MOST_RUNS, max(1, int(_SHARE * _free_memory()) // each))
        parts = -(-len(rows) // most)
        for part in np.array_split(np.array(rows), parts):
            yield part.tolist()


def _free_memory() -> float:
    """Bytes that the device has left."""
    told = _device().memory_stats() or {}
    if "bytes_limit" not in told:
        return _ASSUMED / _SHARE
    return told["bytes_limit"] - told.get("bytes_in_use", 0)


def padded(number: int, least: int = 1) -> int:
    """The next of few sizes, at most an eighth more."""
    number = max(number, least)
    unit = max(1, 2 ** (number.bit_length() - 1) // _SIZES)
    return -(-number // unit) * unit


def _kind(mesh: Mesh) -> _Kind:
    return _Kind(tuple(k == "hold" for k in mesh.kinds), mesh.splines, mesh.every == 1)


def _march_batch(
    model: DFSM, cases: Sequence[Case[Mesh]], pool: ThreadPoolExecutor | None = None
) -> tuple[jax.Array, ...]:
    """States, outputs, what is outside and how far, ``(run, sample, ...)``, padded."""
    longest = max(len(c.drive.time) for c in cases)
    samples, runs = padded(longest, _FEWEST_SAMPLES), padded(len(cases))
    kind, x0 = _kind(cases[0].drive), cases[0].x0
    batch = _Batch(
        x0=np.tile(x0, (runs, 1)),
        psi0=np.zeros(runs),
        intervals=np.zeros((runs, samples - 1)),
        values=np.zeros((runs, samples, cases[0].drive.values.shape[1])),
        bends=np.zeros((runs, 3, samples - 1, len(kind.splines))),
        field=np.zeros((runs, samples, cases[0].field.shape[1])),
    )

    def put(k: int) -> None:
        c, n = cases[k], len(cases[k].drive.time)
        batch.x0[k], batch.psi0[k] = c.x0, c.psi0
        batch.intervals[k, : n - 1] = np.diff(c.drive.time)
        batch.values[k, :n], batch.field[k, :n] = c.drive.values, c.field
        batch.values[k, n:] = c.drive.values[-1]
        if kind.splines:
            batch.bends[k, :, : n - 1] = c.drive.bends()

    for _ in (map if pool is None else pool.map)(put, range(len(cases))):
        pass
    # The runs beside the last are copies of one: what is computed of them goes nowhere.
    batch.values[len(cases) :] = batch.values[0]
    every = np.asarray(cases[0].drive.every)
    if not in_batches():
        rows = min(samples, max(1, _SEEN // runs))
        return _march(model, batch, (np.asarray(longest - 1), every), kind, rows)
    # A loop whose end an accelerator must look up waits for the host after every turn.
    rows = min(samples, max(1, _SEEN_AT_ONCE // runs))
    return _march(model, batch, (samples - 1, every), kind, rows)


@eqx.filter_jit
def _march(
    model: DFSM, batch: _Batch, counts: tuple[int | IntArray, IntArray], kind: _Kind, rows: int
) -> tuple[jax.Array, ...]:
    """All runs along all intervals; `counts` are those and the steps in each, `rows` see `_along`.

    A count that is an array is an argument of the compiled code, not part of it.
    """
    model = model.prepared()
    count, every = counts[0], jnp.asarray(counts[1])
    x0, psi0, intervals, values, bends, field = map(jnp.asarray, batch)
    bends = jnp.moveaxis(bends, 2, 0)
    intervals, values, field = (jnp.swapaxes(part, 0, 1) for part in (intervals, values, field))
    interval = jax.vmap(partial(_interval, model, kind, every))
    xs = jnp.zeros((len(values), *x0.shape)).at[0].set(x0)
    psis = None
    if model.signals.azimuth_rate is not None:
        psis = jnp.zeros((len(values), *psi0.shape)).at[0].set(psi0)

    def on(k: jax.Array, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        x, psi, xs, psis = carry
        x, psi = interval(x, psi, intervals[k], values[k], values[k + 1], bends[k])
        return x, psi, xs.at[k + 1].set(x), None if psis is None else psis.at[k + 1].set(psi)

    _, _, xs, psis = jax.lax.fori_loop(0, count, on, (x0, psi0, xs, psis))
    found = _along(model, (xs, values, field, psis), count, rows)
    return tuple(jnp.swapaxes(part, 0, 1) for part in (xs, *found))


def _interval(
    model: DFSM,
    kind: _Kind,
    every: jax.Array,
    x: jax.Array,
    psi: jax.Array,
    dt: jax.Array,
    begin: jax.Array,
    end: jax.Array,
    bend: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """States ``(state,)`` and azimuth at the next sample."""
    held, splines = np.array(kind.held, dtype=bool), np.array(kind.splines, dtype=int)

    def at(part: jax.Array | float) -> jax.Array:
        v = begin + (end - begin) * part
        if len(splines):
            d, c, b = bend
            t = dt * part
            v = v.at[splines].set(begin[splines] + t * (b + t * (c + t * d)))
        return jnp.where(held, begin, v) if held.any() else v

    last = jnp.where(held, begin, end) if held.any() else end
    if kind.one:
        return stepped(model, x, psi, dt, (begin, at(0.5), last))

    def step(j: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        middle = at((2 * j + 1) / (2 * every))
        after = jnp.where(j + 1 == every, last, at((j + 1) / every))
        return stepped(model, *carry, dt / every, (at(j / every), middle, after))

    return jax.lax.fori_loop(0, every, step, (x, psi))


def _along(
    model: DFSM,
    paths: tuple[jax.Array, jax.Array, jax.Array, jax.Array | None],
    count: int | IntArray,
    rows: int,
) -> tuple[jax.Array, ...]:
    """Outputs and the region's check along paths ``(sample, run, ...)``, `rows` samples at once."""
    see = jax.vmap(jax.vmap(partial(seen, model)))
    places = paths[0].shape[:2]
    outputs = jnp.zeros((*places, len(model.signals.outputs)))

    def on(k: jax.Array, found: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        # The last part begins earlier than its place and does some samples again.
        first = jnp.minimum(k * rows, places[0] - rows)
        part = [None if p is None else jax.lax.dynamic_slice_in_dim(p, first, rows) for p in paths]
        return tuple(
            jax.lax.dynamic_update_slice_in_dim(whole, new, first, 0)
            for whole, new in zip(found, see(*part), strict=True)  # pyright: ignore[reportArgumentType]
        )

    found = outputs, jnp.zeros(places, dtype=bool), jnp.zeros(places)
    return jax.lax.fori_loop(0, (count + rows) // rows, on, found)
