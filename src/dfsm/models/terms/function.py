"""A user's own function of some inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from dfsm.core.settings import require, settings_class
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError, near_matches
from dfsm.models.terms.form import Term
from dfsm.models.terms.inputs import input_columns

ScalarFunction = Callable[..., jax.Array]


@settings_class
class Function:
    """Any function that JAX can follow, from Python; configuration files cannot hold one.

    Attributes
    ----------
    name
        What the value is called, and by what name `dfsm.load` gets the function again.
    function
        Takes one scalar per input, in the units of their channels, and returns a scalar.
    inputs
        Channel names in the order of the arguments.
    unit
        Of the value.
    """

    name: str
    function: ScalarFunction
    inputs: tuple[str, ...]
    unit: str = ""
    kind: Literal["function"] = "function"

    def __post_init__(self) -> None:
        require(bool(self.name), "function.name", "empty", "a name for its value")
        require(bool(self.inputs), "function.inputs", "empty", "the channels that it takes")
        if not callable(self.function):
            raise DfsmError(
                f"function.function is {type(self.function).__name__}, expected a function of "
                f"{len(self.inputs)} numbers that JAX can follow: pass it from Python"
            )

    def term(
        self,
        channels: Mapping[str, Channel],
        columns: Mapping[str, int],
        spreads: Mapping[str, float] | None = None,  # noqa: ARG002
    ) -> FunctionTerm:
        """The term of a model with these inputs.

        Parameters
        ----------
        channels, columns
            Channel and column in I of every input, by name.
        spreads
            Typical size of every input; not needed here.

        Raises
        ------
        DfsmError
            A channel is no input, or the function does not return one number that JAX follows.
        """
        _, at = input_columns(f"function '{self.name}'", self.inputs, channels, columns)
        _check_traceable(self.name, self.function, len(self.inputs))
        value = Channel(self.name, self.unit)
        return FunctionTerm(columns=at, channels=(value,), function=self.function)


class FunctionTerm(Term):
    """A function of all signals.

    Attributes
    ----------
    function
        Takes one scalar per signal and returns a scalar.
    """

    kind = "function"
    function: ScalarFunction = eqx.field(static=True)

    def values(self, signals: jax.Array) -> jax.Array:
        """The value at one sample, shape ``(signal,)`` to ``(1,)``."""
        value = self.function(*(signals[i] for i in range(len(self.columns))))
        return jnp.reshape(jnp.asarray(value, dtype=signals.dtype), 1)

    def structure(self) -> dict[str, Any]:
        """The name by which the function is passed when the model is read again."""
        return {"function": self.channels[0].name}

    @classmethod
    def restored(
        cls,
        columns: tuple[int, ...],
        channels: tuple[Channel, ...],
        arrays: Mapping[str, jax.Array],  # noqa: ARG003
        structure: Mapping[str, Any],
        functions: Mapping[str, ScalarFunction] | None = None,
    ) -> FunctionTerm:
        """The term of which `structure` came.

        Parameters
        ----------
        columns, channels, arrays, structure
            See `Term.restored`.
        functions
            Functions by name; a folder holds none.

        Raises
        ------
        DfsmError
            It is not among them, or takes another number of arguments.
        """
        name, known = structure["function"], functions or {}
        if name not in known:
            hint = f"; {near_matches(name, known)}" if known else ""
            raise DfsmError(
                f"the model has a term computed by the Python function '{name}', which a folder "
                f"cannot hold: pass functions={{'{name}': f}}{hint}"
            )
        _check_traceable(name, known[name], len(columns))
        return cls(columns=columns, channels=channels, function=known[name])


def _check_traceable(name: str, function: ScalarFunction, count: int) -> None:
    """Refuse what is no function of so many numbers to one, or nothing that JAX can follow."""
    number = jax.ShapeDtypeStruct((), jnp.float64)
    try:
        value = jax.eval_shape(function, *[number] * count)
    except Exception as error:  # whatever a user's function raises
        told = str(error).strip().split("\n")[0][:200]
        raise DfsmError(
            f"function '{name}' cannot be traced by JAX with {count} numbers "
            f"({type(error).__name__}: {told}): write it with jax.numpy, one argument per input"
        ) from None
    if getattr(value, "shape", None) not in ((), (1,)):
        raise DfsmError(
            f"function '{name}' returns {getattr(value, 'shape', type(value).__name__)}, expected "
            "one number: return a scalar, and make one term per value"
        )
