"""What every form of a corrective function e(I) offers to the rest of the package."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar, Protocol, Self

import equinox as eqx
import jax
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.host import from_host


class Evaluated(Protocol):
    """What is evaluated again and again, see `Corrective.prepared`."""

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""
        ...

    def prepared(self) -> Evaluated:
        """Itself."""
        ...

    def stripped(self) -> Evaluated:
        """Itself."""
        ...


class Corrective(eqx.Module):
    """A function of ``z = (I - shift) / scale`` that adds to some rows of a linear fit.

    Attributes
    ----------
    kind
        What the form is called in the manifest of a model folder.
    shift, scale
        Per input, shape ``(input,)``.
    """

    kind: ClassVar[str]
    shift: jax.Array
    scale: jax.Array

    # -- evaluation -----------------------------------------------------------------------------

    @abstractmethod
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""

    def prepared(self) -> Evaluated:
        """The same function in the form that is fastest to evaluate again and again."""
        return self

    def stripped(self) -> Evaluated:
        """The prepared function without what has no effect; the last digit may be another.

        Its numbers must be known, not traced by JAX.
        """
        return self.prepared()

    # -- other functions made of it -------------------------------------------------------------

    @abstractmethod
    def select(self, rows: Sequence[int]) -> Self:
        """Keep some of the targets."""

    def ignoring(self, columns: Sequence[int]) -> Self:
        """Hold some inputs at the middle of their range, whatever they are."""
        scale = np.array(self.scale)
        scale[np.array(columns, dtype=int)] = np.inf
        return replace(self, scale=from_host(scale))

    @abstractmethod
    def with_more_inputs(self, at: int, count: int) -> Self:
        """The same function of `count` more inputs from column `at` on, which have no effect."""

    # -- refinement -----------------------------------------------------------------------------

    @property
    @abstractmethod
    def parameters(self) -> tuple[jax.Array, ...]:
        """The arrays that refinement on rollouts may change."""

    @abstractmethod
    def moved(self, deviations: Sequence[jax.Array], spread: jax.Array) -> Self:
        """The function with other parameters; JAX can follow it.

        Parameters
        ----------
        deviations
            Added to `parameters`, shapes as theirs; those in the unit of a target count in its
            spread.
        spread
            Typical size of every target, shape ``(target,)``.
        """

    # -- model folders --------------------------------------------------------------------------

    def structure(self) -> dict[str, Any]:
        """What a manifest keeps: JSON values, `kind` among them."""
        return {"kind": self.kind}

    def arrays(self) -> dict[str, jax.Array]:
        """What is kept in arrays, by name; every field is one unless a form says otherwise."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def restored(cls, arrays: Mapping[str, jax.Array], structure: Mapping[str, Any]) -> Self:  # noqa: ARG003
        """The function of which `arrays` and `structure` came.

        Raises
        ------
        KeyError
            One of them is missing.
        """
        return cls(**{field.name: arrays[field.name] for field in fields(cls)})
