"""The functions of a problem as JAX code on small local vectors, compiled once and reused.

A *term* is one function evaluated for many local vectors at once: for all nodes of a mesh, or for
both ends of every scenario. Values, Jacobians and weighted Hessians come from the same definition,
and problems that differ only in numbers (bounds, disturbances, mesh) share the compiled code.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import dfsm.core.jax_setup  # noqa: F401
from dfsm.control.levels import is_number
from dfsm.control.names import End, Signals
from dfsm.control.nlp.structure import curved, dependent, varies
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.host import from_host
from dfsm.core.types import Array, IntArray
from dfsm.errors import DfsmError

# Rows are evaluated in blocks of few lengths: all meshes of a problem share a compilation, and what
# hundreds of units need for derivatives stays in the cache.
_FEW, _SIZES = 8, (128, 256)

# Compiled functions of this many problems are kept.
_MOST = 32
_KNOWN: dict[tuple, Functions] = {}

Local = Callable[[jax.Array, Any, Any], jax.Array]
Elements = tuple[int, ...]


class Term:
    """A function of a local vector, vectorised: ``function(z, data, common)`` to outputs.

    Parameters
    ----------
    function
        Takes a local vector ``(local,)``, data of its row and data common to all rows.
    parts
        Functions of the same arguments that give its objective and its constraints, where they
        can be told apart.
    """

    def __init__(self, function: Local, parts: tuple[Local, Local] | None = None) -> None:
        def weighted(z: jax.Array, data: Any, common: Any, weights: jax.Array) -> jax.Array:
            return weights @ function(z, data, common)

        def jacobian(of: Elements, z: jax.Array, data: Any, common: Any) -> jax.Array:
            chosen, local = _among(of, z)
            outputs = jax.eval_shape(function, z, data, common).shape[0]
            slopes = jax.jacfwd if len(of) <= outputs else jax.jacrev
            return slopes(lambda c: function(local(c), data, common))(chosen)

        def hessian(of: Elements, z: jax.Array, *rest: Any) -> jax.Array:
            chosen, local = _among(of, z)
            return jax.jacfwd(jax.grad(lambda c: weighted(local(c), *rest)))(chosen)

        def rows(part: Callable[..., jax.Array], axes: tuple) -> Callable[..., jax.Array]:
            every = lambda of, *a: jax.vmap(partial(part, of), axes)(*a)  # noqa: E731
            return jax.jit(every, static_argnums=0)

        self.parts = parts
        self._function, self._weighted = function, weighted
        self._values = jax.jit(jax.vmap(function, (0, 0, None)))
        self._jacobian, self._hessian = rows(jacobian, (0, 0, None)), rows(hessian, (0, 0, None, 0))
        # Known of the code, whatever the numbers; asked for on every mesh.
        self._curved: NDArray[np.bool_] | None = None
        self._quadratic: bool | None = None

    def values(self, z: Array, data: Any, common: Any) -> Array:
        """Outputs ``(row, output)`` at local vectors ``(row, local)``."""
        return self._padded(self._values, common, z, data)

    def jacobian(self, z: Array, data: Any, common: Any, of: IntArray | Elements) -> Array:
        """Jacobians with some elements of the local vector, at least one: ``(row, output, of)``."""
        return self._padded(partial(self._jacobian, _elements(of)), common, z, data)

    def hessian(
        self, z: Array, data: Any, common: Any, weights: Array, of: IntArray | Elements
    ) -> Array:
        """Hessians of the outputs times weights ``(row, output)``, ``(row, of, of)``.

        `of` are some elements of the local vector, at least one.
        """
        return self._padded(partial(self._hessian, _elements(of)), common, z, data, weights)

    def curved(self, z: Array, data: Any, common: Any) -> NDArray[np.bool_]:
        """In which elements of the local vector any output is not affine, ``(local,)``.

        With the others all Jacobians are constant. Proved on the traced code; a True may be
        overcautious.
        """
        if self._curved is None:
            row = _row(z, data, common)
            outputs = jax.eval_shape(self._function, *row).shape
            self._curved = curved(self._weighted, *row, from_host(np.ones(outputs)))
        return self._curved

    def is_quadratic(self, z: Array, data: Any, common: Any) -> bool:
        """Whether the objective is at most quadratic and the constraints are affine.

        Proved on the traced code; a False may be overcautious.
        """
        if self.parts is None:
            return False
        if self._quadratic is None:
            row, (objective, constraints) = _row(z, data, common), self.parts
            second, first = jax.jacfwd(jax.jacrev(objective)), jax.jacfwd(constraints)
            self._quadratic = not (varies(second, *row) or varies(first, *row))
        return self._quadratic

    @staticmethod
    def _padded(function: Callable[..., jax.Array], common: Any, z: Array, *rest: Any) -> Array:
        count = len(z)
        size = block_length(count)
        extra = -count % size

        def pad(a: Array) -> Array:
            return np.concatenate([a, np.repeat(a[-1:], extra, axis=0)]) if extra else a

        padded = jax.tree.map(pad, (z, *rest))
        blocks = []
        for first in range(0, count, size):
            part = jax.tree.map(lambda a, k=first: a[k : k + size], padded)
            blocks.append(np.asarray(function(part[0], part[1], common, *part[2:])))
        return (blocks[0] if len(blocks) == 1 else np.concatenate(blocks))[:count]


def _row(z: Array, data: Any, common: Any) -> tuple[Array, Any, Any]:
    """Arguments of a term's function at the first of many rows."""
    return z[0], jax.tree.map(lambda a: a[0], data), common


def _elements(of: IntArray | Elements) -> Elements:
    return tuple(int(i) for i in of)


def _among(of: Elements, z: jax.Array) -> tuple[jax.Array, Callable[[jax.Array], jax.Array]]:
    """Some elements of a vector, and the vector as a function of these."""
    place = {i: k for k, i in enumerate(of)}

    def local(chosen: jax.Array) -> jax.Array:
        return jnp.stack([chosen[place[i]] if i in place else v for i, v in enumerate(z)])

    return jnp.stack([z[i] for i in of]), local


def block_length(count: int) -> int:
    """Number of rows that are evaluated at once, of `count`."""
    return count if count <= _FEW else next((n for n in _SIZES if count <= n), _SIZES[-1])


# -- the functions of a problem -----------------------------------------------------------------


class Functions:
    """Compiled functions of a problem's nodes and ends.

    The local vector of a node is [x, u, q], that of the ends [x start, x end, q], where q holds
    the free parameters and, if free, the last time.

    Attributes
    ----------
    node, ends
        Terms with the outputs [T L, T ẋ, path constraints]; [M, boundary constraints].
    segments
        Terms of shooting, by what a segment consists of.
    path_sizes, boundary_sizes
        Number of values of every constraint by name; bounded outputs are path constraints too.
    path_jumps
        Which values of the path constraints depend on controls, shape ``(value,)``.
    """

    def __init__(self, problem: OptimalControlProblem) -> None:
        # Kept alive, so that its id cannot be another's while this is remembered.
        self.model, self.plant = problem.model, problem.plant
        self.nx, self.nu = (len(self.plant.names(g)) for g in ("states", "controls"))
        # Where a parameter stands among the free ones; None for a fixed one.
        free = problem.free_parameters
        self._free = [free.index(n) if n in free else None for n in self.plant.names("parameters")]
        self._timed = problem.free_time is not None
        self._cost, self._final_cost = problem.cost, problem.final_cost
        self._path = {n: c[0] for n, c in problem.constraints.items()}
        self._boundary = {n: c[0] for n, c in problem.boundary.items()}
        self._outputs = tuple(n for n in self.plant.names("outputs") if n in problem.bounds)
        _check_model(self, problem)
        self.path_sizes, self.boundary_sizes, self.path_jumps = _sizes(self, problem)
        self.node = _joined(self._node_cost, self._node_constraints)
        self.ends = _joined(self._ends_cost, self._ends_constraints)
        self.segments: dict[tuple[int, int], Term] = {}

    def unpack(self, q: jax.Array, common: Any) -> tuple[jax.Array, jax.Array]:
        """Parameters and the last time from free ones and the fixed values."""
        p = jnp.asarray(common["p"])
        if any(k is not None for k in self._free):
            # Put together value by value: one that stays fixed then depends on no free one.
            p = jnp.stack([p[i] if k is None else q[k] for i, k in enumerate(self._free)])
        return p, q[-1] if self._timed else common["stop"]

    def disturbances(self, t: jax.Array, data: Any, common: Any) -> jax.Array:
        """Those of the row, or for a free last time those of the table at time t."""
        if not self._timed:
            return data["w"]
        table = common["table"][data["scenario"]]
        return jax.vmap(lambda v: jnp.interp(t, common["table_time"], v), 1)(table)

    def signals(self, z: jax.Array, data: Any, common: Any) -> tuple[Signals, jax.Array]:
        """Named signals of a node, and the length of the horizon in s."""
        x, u, q = jnp.split(z, [self.nx, self.nx + self.nu])
        p, stop = self.unpack(q, common)
        duration = stop - common["start"]
        t = common["start"] + data["tau"] * duration
        vectors = (x, u, self.disturbances(t, data, common), p)
        return Signals(self.plant, t, vectors), duration

    def integrand(self, s: Signals) -> jax.Array:
        """L at a node, shape ``(1,)``."""
        return scalar(self._cost, "the cost", s) if self._cost else jnp.zeros(1)

    def path(self, s: Signals) -> jax.Array:
        """All path constraints and bounded outputs at a node, in the order of `path_sizes`."""
        parts = [vector(f, f"constraint '{n}'", s) for n, f in self._path.items()]
        parts += [jnp.stack([s.y[n] for n in self._outputs])] if self._outputs else []
        return jnp.concatenate([jnp.zeros(0), *parts])

    def _node_cost(self, z: jax.Array, data: Any, common: Any) -> jax.Array:
        s, duration = self.signals(z, data, common)
        return self.integrand(s) * duration

    def _node_constraints(self, z: jax.Array, data: Any, common: Any) -> jax.Array:
        s, duration = self.signals(z, data, common)
        return jnp.concatenate([s.derivative * duration, self.path(s)])

    def end_pair(self, z: jax.Array, common: Any) -> tuple[End, End]:
        """Named signals of both ends."""
        first, last, q = jnp.split(z, [self.nx, 2 * self.nx])
        p, stop = self.unpack(q, common)
        return End(self.plant, common["start"], first, p), End(self.plant, stop, last, p)

    def final_cost(self, z: jax.Array, common: Any) -> jax.Array:
        """M at both ends, shape ``(1,)``."""
        if self._final_cost is None:
            return jnp.zeros(1)
        return scalar(self._final_cost, "the final cost", *self.end_pair(z, common))

    def _ends_cost(self, z: jax.Array, _data: Any, common: Any) -> jax.Array:
        return self.final_cost(z, common)

    def _ends_constraints(self, z: jax.Array, _data: Any, common: Any) -> jax.Array:
        ends = self.end_pair(z, common)
        parts = [vector(f, f"boundary '{n}'", *ends) for n, f in self._boundary.items()]
        return jnp.concatenate([jnp.zeros(0), *parts])


def _joined(objective: Local, constraints: Local) -> Term:
    """A term whose first output is the objective's."""

    def both(z: jax.Array, data: Any, common: Any) -> jax.Array:
        return jnp.concatenate([f(z, data, common) for f in (objective, constraints)])

    return Term(both, (objective, constraints))


def functions_of(problem: OptimalControlProblem) -> Functions:
    """Compiled functions of a problem, shared with others that differ only in numbers."""
    key = (
        id(problem.model),
        problem.cost,
        problem.final_cost,
        tuple((n, c[0]) for n, c in problem.constraints.items()),
        tuple((n, c[0]) for n, c in problem.boundary.items()),
        tuple(n for n in problem.plant.names("outputs") if n in problem.bounds),
        problem.free_parameters,
        problem.free_time is None,
    )
    if key not in _KNOWN:
        while len(_KNOWN) >= _MOST:
            del _KNOWN[next(iter(_KNOWN))]
        _KNOWN[key] = Functions(problem)
    return _KNOWN[key]


# -- calling what a user wrote ------------------------------------------------------------------


def vector(function: Callable[..., Any], what: str, *arguments: Any) -> jax.Array:
    """Call a user's function; a number or an array becomes a vector.

    Raises
    ------
    DfsmError
        The function names an unknown signal, or is not written with jax.numpy.
    """
    try:
        value = function(*arguments)
        value = jnp.stack(value) if isinstance(value, list | tuple) else jnp.asarray(value)
    except DfsmError as error:
        raise DfsmError(f"{what}: {error}") from None
    except jax.errors.JAXTypeError as error:
        reason = str(error).split("\n")[0]
        raise DfsmError(
            f"{what} cannot be followed by JAX ({reason}): write it with jax.numpy, and jnp.where "
            "in place of if"
        ) from None
    except (TypeError, ValueError) as error:
        reason = str(error).split("\n")[0]
        raise DfsmError(f"{what} cannot be evaluated: {reason}") from None
    return value.astype(jnp.float64).ravel()


def scalar(function: Callable[..., Any], what: str, *arguments: Any) -> jax.Array:
    """Call a user's function that returns one number, shape ``(1,)``."""
    value = vector(function, what, *arguments)
    if value.shape != (1,):
        raise DfsmError(f"{what} returns {value.size} values, expected one number")
    return value


def _check_model(functions: Functions, problem: OptimalControlProblem) -> None:
    """Refuse a model whose functions return other numbers of values than it has channels."""
    plant = functions.plant
    groups = ("states", "controls", "disturbances", "parameters")
    arguments = [from_host(np.ones(len(plant.names(g)))) for g in groups]
    for function, group, what in (
        (plant.derivative, "states", "the model's f"),
        (plant.output, "outputs", "the model's g"),
    ):
        count = len(plant.names(group))
        label = f"{problem.name}: {what}"
        shape = jax.eval_shape(lambda *a, f=function, w=label: vector(f, w, *a), *arguments).shape
        if shape != (count,):
            raise DfsmError(
                f"{label} returns {shape[0]} values for the {count} {group} "
                f"{', '.join(plant.names(group))}: return one number for each"
            )


def _sizes(
    functions: Functions, problem: OptimalControlProblem
) -> tuple[dict[str, int], dict[str, int], NDArray[np.bool_]]:
    """Number of values of every path and boundary constraint; refuse those without an effect.

    And which values of the path constraints depend on controls.
    """
    common = common_of(problem)
    extra = len(problem.free_parameters) + (problem.free_time is not None)
    data = {"tau": from_host(0.5), "scenario": 0}
    data["w"] = from_host(np.ones(len(problem.plant.names("disturbances"))))
    # All that can be chosen at a node, and at the ends.
    z = from_host(np.ones(functions.nx + functions.nu + extra))
    ends = from_host(np.ones(2 * functions.nx + extra))

    def node(function: Callable[..., Any], what: str) -> Callable[[jax.Array], jax.Array]:
        return lambda z: vector(function, what, functions.signals(z, data, common)[0])

    def both(function: Callable[..., Any], what: str) -> Callable[[jax.Array], jax.Array]:
        return lambda z: vector(function, what, *functions.end_pair(z, common))

    path, boundary = {}, {}
    for place, local, at, sizes in (
        ("constraints", node, z, path),
        ("boundary", both, ends, boundary),
    ):
        for name, (function, *_) in getattr(problem, place).items():
            (depends,) = dependent(local(function, f"{place} '{name}'"), at)
            if not (depends.size and depends.all()):
                which = f"value {np.argmin(depends)} of " if depends.size > 1 else ""
                raise DfsmError(
                    f"{problem.name}: {which}{place} '{name}' depends on nothing that can be "
                    "chosen: leave it out, or use a state, control or free parameter in it"
                )
            sizes[name] = depends.size
    path |= {name: 1 for name in functions._outputs}
    if problem.cost:
        jax.eval_shape(lambda z: functions.integrand(functions.signals(z, data, common)[0]), z)
    if problem.final_cost:
        jax.eval_shape(lambda z: functions.final_cost(z, common), ends)

    def by_controls(u: jax.Array) -> jax.Array:
        x, q = from_host(np.ones(functions.nx)), from_host(np.ones(extra))
        return functions.path(functions.signals(jnp.concatenate([x, u, q]), data, common)[0])

    if not path:
        return path, boundary, np.zeros(0, bool)
    (jumps,) = dependent(by_controls, from_host(np.ones(functions.nu)))
    return path, boundary, jumps


def common_of(problem: OptimalControlProblem) -> dict[str, Array]:
    """Numbers that all nodes share: fixed parameters, horizon, table of disturbances."""
    levels = (problem.parameters[n] for n in problem.plant.names("parameters"))
    fixed = [float(v) if is_number(v) else np.nan for v in levels]
    common = {
        "p": np.array(fixed, dtype=np.float64),
        "start": np.float64(problem.start),
        "stop": np.float64(problem.last_time),
    }
    if problem.free_time is not None:
        names = problem.plant.names("disturbances")
        runs = [r for r in problem.scenarios if r is not None and names]
        time = np.unique(np.concatenate([r.time for r in runs])) if runs else np.zeros(2)
        inside = [r.select(names) for r in runs]
        values = [
            np.stack([np.interp(time, r.time, c) for c in r.values.T], axis=1) for r in inside
        ]
        common["table_time"] = time
        common["table"] = np.stack(values) if values else np.zeros((len(problem.scenarios), 2, 0))
    return common
