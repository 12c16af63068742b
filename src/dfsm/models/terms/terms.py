"""All known terms of a model, one after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel
from dfsm.models.terms.form import Term


class Terms(eqx.Module):
    """φ(I) of all terms, in the order in which the linear fit takes them behind I.

    Attributes
    ----------
    parts
        The terms.
    mean, std
        Of every value over the training samples, shape ``(value,)``, in its unit.
    """

    parts: tuple[Term, ...]
    mean: jax.Array
    std: jax.Array

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Name and unit of every value."""
        return tuple(channel for part in self.parts for channel in part.channels)

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """The values at one input vector, shape ``(input,)`` to ``(value,)``."""
        return jnp.concatenate([part(inputs) for part in self.parts] or [jnp.zeros(0)])

    def extend(self, inputs: jax.Array) -> jax.Array:
        """[I, φ(I)], shape ``(input,)`` to ``(input + value,)``."""
        return jnp.concatenate([inputs, self(inputs)])

    def with_more_inputs(self, at: int, count: int) -> Terms:
        """The same terms where I has `count` more inputs from column `at` on."""
        return replace(self, parts=tuple(part.with_more_inputs(at, count) for part in self.parts))

    @property
    def parameters(self) -> tuple[jax.Array, ...]:
        """The arrays that refinement on rollouts may change, part by part."""
        return tuple(array for part in self.parts for array in part.parameters)

    def moved(self, deviations: Sequence[jax.Array]) -> Terms:
        """The terms with other parameters; JAX can follow it.

        Parameters
        ----------
        deviations
            Added to `parameters`, shapes as theirs, in units in which 1 is a large change.
        """
        parts, first = list[Term](), 0
        for part in self.parts:
            last = first + len(part.parameters)
            parts.append(part.moved(deviations[first:last]))
            first = last
        return replace(self, parts=tuple(parts))

    def check(self, values: Mapping[str, Array]) -> list[str]:
        """What is doubtful about the signals of the training samples, one sentence each.

        Parameters
        ----------
        values
            Samples by channel name, shape ``(sample,)``; at least those that the terms take.

        Raises
        ------
        DfsmError
            They cannot be what a term takes them for.
        """
        return [doubt for part in self.parts for doubt in part.check(values)]
