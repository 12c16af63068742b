"""The order of I = [u, w, ξ, p]: the one place that knows where groups and channels stand in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dfsm.core.host import from_host, traced
from dfsm.errors import DfsmError, near_matches

# Controls and disturbances stand first and together: they are what B acts on.
GROUPS = ("controls", "disturbances", "states", "parameters")
_DRIVING = GROUPS[:2]
_EXOGENOUS = tuple(g for g in GROUPS if g != "states")
# How functions take them, f(ξ, u, w, p).
_ARGUMENTS = ("states", *_EXOGENOUS)


@dataclass(frozen=True)
class InputOrder:
    """Names of the elements of I by group.

    Values go in and come out as functions of a model take them: states, controls, disturbances,
    parameters, each an array ``(..., n)``.

    Attributes
    ----------
    controls, disturbances, states, parameters
        u, w, ξ and p.
    """

    controls: tuple[str, ...]
    disturbances: tuple[str, ...]
    states: tuple[str, ...]
    parameters: tuple[str, ...]

    @classmethod
    def of(cls, names: Callable[[str], Iterable[str]]) -> InputOrder:
        """The order of what has names by group, ``names("states")``."""
        return cls(**{group: tuple(names(group)) for group in GROUPS})

    # -- where something stands -----------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """All elements of I."""
        return self._of(GROUPS)

    @property
    def driving(self) -> tuple[str, ...]:
        """Controls and disturbances, the columns of B."""
        return self._of(_DRIVING)

    @property
    def exogenous(self) -> tuple[str, ...]:
        """What drives a simulation: controls, disturbances, parameters."""
        return self._of(_EXOGENOUS)

    @property
    def driving_columns(self) -> slice:
        """Where controls and disturbances stand."""
        return slice(0, len(self.driving))

    def columns(self, group: str) -> slice:
        """Where a group stands, e.g. ``columns("states")``."""
        return _slices(GROUPS, self)[group]

    def column(self, name: str) -> int:
        """Where a channel stands.

        Raises
        ------
        DfsmError
            It is no input; names those that are near.
        """
        if name not in self.names:
            raise DfsmError(f"'{name}' is no input; {near_matches(name, self.names)}")
        return self.names.index(name)

    def _of(self, groups: Sequence[str]) -> tuple[str, ...]:
        return tuple(name for group in groups for name in getattr(self, group))

    # -- values ---------------------------------------------------------------------------------

    def arrays(self, *values: ArrayLike) -> list[jax.Array]:
        """States, controls, disturbances and parameters as arrays.

        Raises
        ------
        DfsmError
            One has a wrong number of elements.
        """
        arrays = []
        for group, value in zip(_ARGUMENTS, values, strict=True):
            array, names = _numbers(value), getattr(self, group)
            if array.ndim == 0 or array.shape[-1] != len(names):
                raise DfsmError(
                    f"{group} have shape {array.shape}, expected the last axis to hold "
                    f"{len(names)}: {', '.join(names) or 'none'}"
                )
            arrays.append(array)
        return arrays

    def join(self, *arrays: jax.Array) -> jax.Array:
        """I, shape ``(..., input)``, of states, controls, disturbances and parameters."""
        shape = np.broadcast_shapes(*(a.shape[:-1] for a in arrays))
        if not traced(*arrays):
            wide = [np.broadcast_to(a, (*shape, a.shape[-1])) for a in _in_order(arrays)]
            return from_host(np.concatenate(wide, axis=-1))
        wide = [jnp.broadcast_to(a, (*shape, a.shape[-1])) for a in _in_order(arrays)]
        return jnp.concatenate(wide, axis=-1)

    def split(self, inputs: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """States, controls, disturbances and parameters of I, ``(..., input)``."""
        at = _slices(GROUPS, self)
        x, u, w, p = (_part(inputs, at[group]) for group in _ARGUMENTS)
        return x, u, w, p

    def split_exogenous(self, values: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Controls, disturbances and parameters of ``(..., exogenous)``."""
        at = _slices(_EXOGENOUS, self)
        u, w, p = (_part(values, at[group]) for group in _EXOGENOUS)
        return u, w, p

    def element(self, column: int | None, *arrays: jax.Array) -> jax.Array:
        """One element of I, shape ``(...)``, from its own group; 0 without a column.

        Not from I: JAX then sees that it does not change with the other groups, and second
        derivatives in states and controls take a fraction of the time.

        Parameters
        ----------
        column
            Where it stands; that of the schedule is None in an LTI model.
        arrays
            States, controls, disturbances and parameters.
        """
        first = 0
        for array in _in_order(arrays):
            if column is not None and column < first + array.shape[-1]:
                return _part(array, column - first)
            first += array.shape[-1]
        return jnp.zeros(()) if traced(*arrays) else from_host(0.0)


def _numbers(value: ArrayLike) -> jax.Array:
    """An array of 64-bit numbers."""
    if isinstance(value, jax.Array) or traced(*jax.tree.leaves(value)):
        return jnp.asarray(value, dtype=jnp.float64)
    return from_host(np.asarray(value, dtype=np.float64))


def _part(values: jax.Array, at: slice | int) -> jax.Array:
    """Some of the last axis."""
    return values[..., at] if traced(values) else from_host(np.asarray(values)[..., at])


def _in_order(arrays: Sequence[jax.Array]) -> list[jax.Array]:
    by_group = dict(zip(_ARGUMENTS, arrays, strict=True))
    return [by_group[group] for group in GROUPS]


def _slices(groups: Sequence[str], order: InputOrder) -> dict[str, slice]:
    """Where groups stand one after another."""
    slices, first = dict[str, slice](), 0
    for group in groups:
        last = first + len(getattr(order, group))
        slices[group], first = slice(first, last), last
    return slices
