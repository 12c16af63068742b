"""All known terms of a model, one after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.models.terms.form import Term
from dfsm.models.terms.function import Function
from dfsm.models.terms.product import Product
from dfsm.models.terms.quadratic_drag import QuadraticDrag
from dfsm.models.terms.rotor import Rotor

# What a term is made of; `kind` tells them apart.
TermSettings = Rotor | QuadraticDrag | Product | Function


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

    @property
    def scale(self) -> jax.Array:
        """`std`, and 1 where a value never changes, shape ``(value,)``."""
        return jnp.where(self.std > 0, self.std, 1.0)

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """The values at one input vector, shape ``(input,)`` to ``(value,)``."""
        return jnp.concatenate([part(inputs) for part in self.parts] or [jnp.zeros(0)])

    def apart(self, number: Callable[[int], jax.Array]) -> jax.Array:
        """The values where `number` gives single inputs by column, see `Term.of_numbers`."""
        parts = [part.of_numbers([number(i) for i in part.columns]) for part in self.parts]
        return jnp.concatenate(parts or [jnp.zeros(0)])

    def staged(self) -> Terms:
        """The same terms as loops take them; they cannot be saved."""
        return replace(self, parts=tuple(part.staged() for part in self.parts))

    def extend(self, inputs: jax.Array) -> jax.Array:
        """[I, φ(I)], shape ``(input,)`` to ``(input + value,)``."""
        return jnp.concatenate([inputs, self(inputs)])

    def along(self, inputs: Array) -> Array:
        """Values at many input vectors, shape ``(sample, input)`` to ``(sample, value)``."""
        return np.asarray(_along(self, from_host(inputs)))

    def slopes_at(self, inputs: jax.Array) -> jax.Array:
        """∂φ/∂I at one input vector, ``(input,)`` to ``(value, input)``; JAX can follow it."""
        none = jnp.zeros((0, inputs.shape[0]))
        return jnp.concatenate([none, *(part.slopes(inputs) for part in self.parts)])

    def parameter_slopes(self, deviations: Sequence[jax.Array], inputs: jax.Array) -> jax.Array:
        """∂φ/∂θ at one input vector, ``(value, parameter)``, see `moved`."""
        rows, first = list[jax.Array](), 0
        for part in self.parts:
            last = first + len(part.parameters)
            rows.append(part.parameter_slopes(deviations[first:last], inputs))
            first = last
        return jax.scipy.linalg.block_diag(*rows)

    def slopes(self, inputs: Array) -> Array:
        """∂φ/∂I at many input vectors, ``(sample, input)`` to ``(sample, value, input)``."""
        return np.asarray(_slopes(self, from_host(inputs)))

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


def terms_of(
    settings: Sequence[TermSettings], channels: Sequence[Channel], inputs: Array
) -> Terms | None:
    """The terms of a model, None without any.

    Parameters
    ----------
    settings
        One per term.
    channels
        Of I, in order.
    inputs
        Training samples of I, shape ``(sample, input)``: spreads, and mean and std of the values.

    Raises
    ------
    DfsmError
        A channel is no input or has a unit that a term cannot take, a file cannot be read, two
        values have one name, or a value is not finite somewhere.
    """
    if not settings:
        return None
    by_name = {c.name: c for c in channels}
    columns = {c.name: i for i, c in enumerate(channels)}
    spreads = dict(zip(by_name, np.std(inputs, axis=0).tolist(), strict=True))
    parts = tuple(s.term(by_name, columns, spreads) for s in settings)
    terms = Terms(parts, from_host(np.zeros(0)), from_host(np.ones(0)))
    _check_names(terms, columns)
    values = terms.along(inputs)
    for channel, column in zip(terms.channels, values.T, strict=True):
        if bad := int((~np.isfinite(column)).sum()):
            raise DfsmError(
                f"the term '{channel.name}' is not finite at {bad} of {len(column)} training "
                "samples: change its function so that it is defined there"
            )
    mean, std = values.mean(axis=0), values.std(axis=0)
    return replace(terms, mean=from_host(mean), std=from_host(std))


def _check_names(terms: Terms, columns: Mapping[str, int]) -> None:
    taken = set(columns)
    for channel in terms.channels:
        if channel.name in taken:
            raise DfsmError(
                f"two inputs of the linear fit are called '{channel.name}': give the term "
                "another 'name'"
            )
        taken.add(channel.name)


@eqx.filter_jit
def _along(terms: Terms, inputs: jax.Array) -> jax.Array:
    return jax.vmap(terms)(inputs)


@eqx.filter_jit
def _slopes(terms: Terms, inputs: jax.Array) -> jax.Array:
    return jax.vmap(terms.slopes_at)(inputs)
