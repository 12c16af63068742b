"""What every known term φ(u, w, ξ, p) of a linear fit offers to the rest of the package."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel


class Schedule(NamedTuple):
    """What coefficients vary along.

    Attributes
    ----------
    column
        In I; None where nothing varies.
    grid
        Its points, shape ``(point,)``.
    """

    column: int | None
    grid: Array


class Term(eqx.Module):
    """Some smooth functions of some of the inputs, all in the units of their channels.

    Attributes
    ----------
    kind
        What the form is called in the manifest of a model folder.
    columns
        Where the signals that it takes stand in I.
    channels
        Name and unit of every value.
    """

    kind: ClassVar[str]
    columns: tuple[int, ...] = eqx.field(static=True)
    channels: tuple[Channel, ...] = eqx.field(static=True)

    # -- evaluation -----------------------------------------------------------------------------

    @abstractmethod
    def values(self, signals: jax.Array) -> jax.Array:
        """The values at one sample of the signals, shape ``(signal,)`` to ``(value,)``."""

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """The values at one input vector, shape ``(input,)`` to ``(value,)``."""
        return self.values(self._signals(inputs))

    def _signals(self, inputs: jax.Array) -> jax.Array:
        """What it takes of one input vector, ``(input,)`` to ``(signal,)``."""
        # One by one: of a gather nobody can tell on which inputs its values depend.
        return jnp.stack([inputs[column] for column in self.columns])

    def of_numbers(self, signals: Sequence[jax.Array]) -> jax.Array:
        """The values of single numbers, one per signal; `values` but for the last digits.

        What follows from some of them alone is computed from these alone: a compiler then does it
        once where the others change.
        """
        return self.values(jnp.stack(signals))

    def staged(self) -> Term:
        """The term in the form in which `of_numbers` is fastest; it cannot be saved."""
        return self

    def effective(self, signals: jax.Array) -> jax.Array:
        """The numbers through which alone the signals act, ``(signal,)`` to ``(number,)``.

        The signals themselves, unless a term knows fewer: its slopes then cost less.
        """
        return signals

    def of_effective(self, numbers: jax.Array) -> jax.Array:
        """The values at what `effective` gives, ``(number,)`` to ``(value,)``."""
        return self.values(numbers)

    def slopes(self, inputs: jax.Array) -> jax.Array:
        """∂φ/∂I at one input vector, ``(input,)`` to ``(value, input)``."""
        signals = self._signals(inputs)
        by_number = jax.jacrev(self.of_effective)(self.effective(signals))
        by_signal = by_number @ jax.jacrev(self.effective)(signals)
        none = jnp.zeros((len(self.channels), inputs.shape[0]))
        return none.at[:, np.array(self.columns, dtype=int)].add(by_signal)

    def parameter_slopes(self, deviations: Sequence[jax.Array], inputs: jax.Array) -> jax.Array:
        """∂φ/∂θ at one input vector.

        Parameters
        ----------
        deviations
            Of the term's `parameters`, as `moved` takes them.
        inputs
            I, ``(input,)``.

        Returns
        -------
        Array
            Shape ``(value, parameter)``, parameters in the order of `parameters`.
        """
        if not deviations:
            return jnp.zeros((len(self.channels), 0))
        signals = self._signals(inputs)

        def effective(theta: list[jax.Array]) -> jax.Array:
            return self.moved(theta).effective(signals)

        def values(numbers: jax.Array, theta: list[jax.Array]) -> jax.Array:
            return self.moved(theta).of_effective(numbers)

        theta = list(deviations)
        # Backwards: a term has few values and dozens of parameters.
        by_number, direct = jax.jacrev(values, (0, 1))(effective(theta), theta)
        through = jax.jacrev(effective)(theta)
        parts = zip(direct, through, strict=True)
        flat = [a.reshape(len(a), -1) + by_number @ b.reshape(len(b), -1) for a, b in parts]
        return jnp.concatenate(flat, axis=1)

    # -- other terms made of it -----------------------------------------------------------------

    def with_more_inputs(self, at: int, count: int) -> Self:
        """The same term where I has `count` more inputs from column `at` on."""
        return replace(self, columns=tuple(c + count if c >= at else c for c in self.columns))

    @property
    def driven(self) -> int | None:
        """Column in I of a state whose row of the linear fit is known because of this term."""
        return None

    def with_latents(
        self,
        names: Sequence[str],  # noqa: ARG002
        first: int,  # noqa: ARG002
        gains: Array,  # noqa: ARG002
        schedule: Schedule,  # noqa: ARG002
    ) -> Self:
        """The same term where latent states reach the state that it drives through it alone.

        Parameters
        ----------
        names
            Of the latent states.
        first
            Column in I of the first of them.
        gains
            Their effect at first, in the unit of the term's first signal, shape ``(latent,)``.
        schedule
            Along which that may vary.
        """
        return self

    # -- data -----------------------------------------------------------------------------------

    def check(self, values: Mapping[str, Array]) -> list[str]:  # noqa: ARG002
        """What is doubtful about the signals of the training samples, one sentence each.

        Parameters
        ----------
        values
            Samples by channel name, shape ``(sample,)``; at least those that it takes.

        Raises
        ------
        DfsmError
            They cannot be what the term takes them for.
        """
        return []

    # -- refinement -----------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[jax.Array, ...]:
        """The arrays that refinement on rollouts may change; none unless a term says so."""
        return ()

    def moved(self, deviations: Sequence[jax.Array]) -> Self:  # noqa: ARG002
        """The term with other parameters; JAX can follow it.

        Parameters
        ----------
        deviations
            Added to `parameters`, shapes as theirs, in units in which 1 is a large change.
        """
        return self

    # -- model folders --------------------------------------------------------------------------

    @abstractmethod
    def structure(self) -> dict[str, Any]:
        """What a manifest keeps besides `kind`, `columns` and `channels`: JSON values."""

    def arrays(self) -> dict[str, jax.Array]:
        """What is kept in arrays, by name; nothing unless a term says otherwise."""
        return {}

    @classmethod
    @abstractmethod
    def restored(
        cls,
        columns: tuple[int, ...],
        channels: tuple[Channel, ...],
        arrays: Mapping[str, jax.Array],
        structure: Mapping[str, Any],
    ) -> Self:
        """The term of which `arrays` and `structure` came.

        Raises
        ------
        KeyError
            One of them is missing.
        """
