"""DFSM: the surrogate ξ̇ = f̂(ξ, u, w, p) and y = ĝ(ξ, u, w, p) as one immutable JAX pytree.

    f̂(I) = f̂_L(I, φ; s) + e(I)     ĝ(I) = ĝ_L(I, φ; s) + e_g(I)     I = [u, w, ξ, p],  φ = φ(I)

The linear parts are defined for every row, with known terms φ among their inputs where there are
any; the corrective functions only for the rows that need one (Sec. 3.1, 3.4, 3.6, 3.7). To ĝ comes
what blades meet that turn in a wind field, see `passing`. Everything that evaluates a model goes
through `derivative` and `output`, so simulation, Jacobians and optimization see the same function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.drawing import Shown
from dfsm.core.host import from_host
from dfsm.core.settings import require_kind
from dfsm.core.types import Array, ComplexArray
from dfsm.data.trajectory import labels
from dfsm.errors import DfsmError, printable
from dfsm.models.corrective import Corrective
from dfsm.models.linear import LinearModel
from dfsm.models.passing import Passing, field_harmonics, harmonics_of
from dfsm.models.region import Region
from dfsm.models.signals import Provenance, SignalTable, blade_harmonics
from dfsm.models.terms import Terms

if TYPE_CHECKING:
    import control


# Samples evaluated at once.
_BLOCK = 4096
Row = Callable[..., jax.Array]


class DFSM(eqx.Module):
    """A derivative function surrogate model.

    Attributes
    ----------
    f, g
        Linear fits of all state derivatives and of all outputs (None without outputs).
    e, e_g
        Corrective functions of the derivatives `corrected` and the outputs `corrected_outputs`.
    region
        Where the training data lie.
    terms
        Known terms φ, which the linear fits take after I; None without.
    passing
        Blade-passing loads from the harmonics of a wind field; None without.
    corrected, corrected_outputs
        Row indices that the corrective functions add to.
    signals
        Names, units and roles.
    provenance
        Where the model comes from; see `Provenance`.
    """

    f: LinearModel
    e: Corrective | None
    g: LinearModel | None
    e_g: Corrective | None
    region: Region
    corrected: tuple[int, ...] = eqx.field(static=True)
    corrected_outputs: tuple[int, ...] = eqx.field(static=True)
    signals: SignalTable = eqx.field(static=True)
    provenance: Provenance = eqx.field(static=True, default_factory=Provenance)
    terms: Terms | None = None
    passing: Passing | None = None

    def __repr__(self) -> str:
        # Without the arrays, which JAX replaces by other things at times.
        groups = ("states", "controls", "disturbances", "parameters", "outputs")
        told = [f"{g} {labels(c)}" for g in groups if (c := getattr(self.signals, g))]
        kind = "LTI" if self.f.schedule is None else f"LPV in {printable(self.schedule or '')}"
        rows = f"{len(self.corrected)} of {len(self.signals.states)} derivatives"
        if outputs := len(self.signals.outputs):
            rows += f" and {len(self.corrected_outputs)} of {outputs} outputs"
        return f"<DFSM: {kind}, {rows} corrected; {'; '.join(told)}>"

    def __str__(self) -> str:
        from dfsm.models.summary import wrapped

        return wrapped(self)

    def _repr_html_(self) -> str:
        return Shown._repr_html_(self)  # pyright: ignore[reportArgumentType]

    # -- evaluation -----------------------------------------------------------------------------

    def derivative(
        self,
        states: ArrayLike,
        controls: ArrayLike,
        disturbances: ArrayLike,
        parameters: ArrayLike = (),
    ) -> jax.Array:
        """Evaluate f̂.

        Parameters
        ----------
        states, controls, disturbances, parameters
            Shapes ``(..., n)`` in the order and units of `signals`; leading axes broadcast.

        Returns
        -------
        Array
            State derivatives per second, shape ``(..., state)``.
        """
        order = self.signals.order
        groups = order.arrays(states, controls, disturbances, parameters)
        return _evaluate(self, derivative_row, groups, self.f.schedule)

    def output(
        self,
        states: ArrayLike,
        controls: ArrayLike,
        disturbances: ArrayLike,
        parameters: ArrayLike = (),
        azimuth: ArrayLike | None = None,
        field: ArrayLike | None = None,
    ) -> jax.Array:
        """Evaluate ĝ.

        Parameters
        ----------
        states, controls, disturbances, parameters
            As for `derivative`.
        azimuth
            Rotor azimuth ψ in rad, shape ``(...)``, for a model with blade-passing harmonics;
            None takes the average over a revolution.
        field
            Harmonics of the wind field, shape ``(..., channel)`` as `SignalTable.field`, for a
            model that follows them.

        Returns
        -------
        Array
            Outputs, shape ``(..., output)``.

        Raises
        ------
        DfsmError
            A group has the wrong number of elements, or an azimuth comes without the field.
        """
        order = self.signals.order
        groups = order.arrays(states, controls, disturbances, parameters)
        if self.g is None:
            return from_host(np.zeros((*np.broadcast_shapes(*(a.shape[:-1] for a in groups)), 0)))
        return _evaluate(self, output_row, groups, self.g.schedule, self.harmonics(azimuth, field))

    def harmonics(self, psi: ArrayLike | None, field: ArrayLike | None) -> jax.Array:
        """What ĝ takes beside I, shape ``(..., harmonic)``; zero, its mean, without an azimuth."""
        azimuth = self.signals.azimuth
        if azimuth is None or psi is None:
            return from_host(np.zeros(self._count_harmonics()))
        if not azimuth.rings:
            return blade_harmonics(psi, azimuth.blades)
        names = self.signals.names("field")
        field = None if field is None else from_host(field)
        shape = None if field is None else field.shape
        if field is None or not shape or shape[-1] != len(names):
            raise DfsmError(
                f"the wind field has shape {shape}, expected the last axis to hold its "
                f"{len(names)} harmonics ({', '.join(names[:3])}, …): give field with the azimuth, "
                "or neither for the average over a revolution"
            )
        return field_harmonics(psi, field, azimuth)

    def _count_harmonics(self) -> int:
        azimuth = self.signals.azimuth
        if azimuth is None:
            return 0
        return 2 * len(harmonics_of(azimuth)) if azimuth.rings else 2

    @property
    def balances(self) -> tuple[int, ...]:
        """States whose row is known and which latent states reach through a known term alone."""
        if self.terms is None:
            return ()
        first, complete = self.signals.state_columns.start, self.f.complete()
        rows = (part.driven - first for part in self.terms.parts if part.driven is not None)
        return tuple(row for row in rows if row in complete)

    def join(
        self,
        states: ArrayLike,
        controls: ArrayLike,
        disturbances: ArrayLike,
        parameters: ArrayLike = (),
    ) -> jax.Array:
        """Put the groups together as I = [u, w, ξ, p], shape ``(..., input)``.

        Raises
        ------
        DfsmError
            A group has the wrong number of elements.
        """
        order = self.signals.order
        return order.join(*order.arrays(states, controls, disturbances, parameters))

    def split(self, inputs: ArrayLike) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Take I apart: states, controls, disturbances, parameters."""
        return self.signals.order.split(from_host(inputs))

    def prepared(self) -> DFSM:
        """The same model with what does not depend on the inputs computed once, for use in loops.

        It evaluates like the model itself, but cannot be saved.
        """
        e = None if self.e is None else self.e.prepared()
        e_g = None if self.e_g is None else self.e_g.prepared()
        return replace(self, e=e, e_g=e_g)  # pyright: ignore[reportArgumentType]

    # -- derived models -------------------------------------------------------------------------

    def linear_fit(self) -> DFSM:
        """Return the model without its corrective functions: f̂_L and ĝ_L."""
        return replace(self, e=None, e_g=None, corrected=(), corrected_outputs=())

    def jacobians(
        self,
        states: ArrayLike,
        controls: ArrayLike,
        disturbances: ArrayLike,
        parameters: ArrayLike = (),
    ) -> tuple[Array, Array, Array, Array]:
        """Exact Jacobians of f̂ and ĝ at one point, corrective functions included.

        Returns
        -------
        tuple of ndarray
            A ``(state, state)``, B ``(state, control + disturbance)``, C ``(output, state)``,
            D ``(output, control + disturbance)``, in physical units; harmonics at their mean.
        """
        inputs = self.join(states, controls, disturbances, parameters)
        if inputs.ndim != 1:
            raise DfsmError(f"jacobians are taken at one point, got shape {inputs.shape[:-1]}")
        xs, us = self.signals.state_columns, self.signals.order.driving_columns
        J = np.asarray(_jacobian(self, derivative_row, inputs))
        extra = np.zeros(self._count_harmonics())
        G = (
            np.asarray(_jacobian(self, output_row, from_host(np.concatenate([inputs, extra]))))
            if self.g is not None
            else np.empty((0, len(inputs)))
        )
        return J[:, xs], J[:, us], G[:, xs], G[:, us]

    def linearize(
        self,
        states: ArrayLike,
        controls: ArrayLike,
        disturbances: ArrayLike,
        parameters: ArrayLike = (),
    ) -> control.StateSpace:
        """Linearize at a point to a python-control state-space model with named signals.

        Raises
        ------
        DfsmError
            python-control is not installed, or holds no such system, see `control_system`.
        """
        from dfsm.models.control_system import control_system

        matrices = self.jacobians(states, controls, disturbances, parameters)
        names = self.signals.names
        return control_system(matrices, names("states"), self.signals.driving, names("outputs"))

    def linear_state_matrices(self) -> Array:
        """A of the linear fit at every schedule point, ``(point, state, state)``.

        Known terms count with their slopes at the middle of the training data there.
        """
        columns = self.signals.state_columns
        L = np.asarray(self.f.coefficients)
        A = L[:, :, columns]
        if self.terms is None:
            return A
        n, middles = len(self.signals.inputs), self.region.usual(np.asarray(self.f.grid))
        slopes = self.terms.slopes(middles)[:, :, columns]
        return A + L[:, :, n:] @ slopes

    def eigenvalues(self) -> list[tuple[float, ComplexArray]]:
        """Eigenvalues (1/s) of the linear fit's A at every schedule point.

        Returns
        -------
        list
            Pairs of schedule value and complex eigenvalues, most unstable first.
        """
        A = self.linear_state_matrices()
        pairs = []
        for point, matrix in zip(np.asarray(self.f.grid), A, strict=True):
            values = np.linalg.eigvals(matrix).astype(np.complex128)
            pairs.append((float(point), values[np.argsort(-values.real)]))
        return pairs

    def summary(self) -> str:
        """Describe the model: signals, which rows are corrected and why, stability, warnings."""
        from dfsm.models.summary import lines_of

        return "\n".join(lines_of(self))

    @property
    def schedule(self) -> str | None:
        """Name of the scheduling input, None for an LTI model."""
        column = self.f.schedule
        return None if column is None else self.signals.inputs[column].name


def derivative_row(
    model: DFSM,
    inputs: jax.Array,
    value: jax.Array | None = None,
    known: jax.Array | None = None,
) -> jax.Array:
    """f̂ at one input vector, ``(input,)`` to ``(state,)``.

    `value` is the schedule's and `known` what the terms are there; None takes them from the inputs.
    """
    wide = _with_terms(model, inputs, known)
    return _sum((model.f, model.e, model.corrected), (wide, inputs), value)


def output_row(
    model: DFSM,
    inputs: jax.Array,
    value: jax.Array | None = None,
    known: jax.Array | None = None,
) -> jax.Array:
    """ĝ at one input vector with harmonics behind it, to ``(output,)``; see `derivative_row`."""
    if model.g is None:
        return jnp.zeros(0)
    n, azimuth = len(model.signals.inputs), model.signals.azimuth
    harmonics = inputs[n:]
    if azimuth is not None and azimuth.rings:
        inputs = inputs[:n]
    wide = _with_terms(model, inputs, known)
    outputs = _sum((model.g, model.e_g, model.corrected_outputs), (wide, inputs), value)
    if model.passing is None:
        return outputs
    s = inputs[model.g.schedule or 0] if value is None else value
    return outputs + model.passing(inputs, harmonics, s)


def _with_terms(model: DFSM, inputs: jax.Array, known: jax.Array | None) -> jax.Array:
    """What the linear fits take: [I, φ], and blade harmonics last, of one [I, harmonics]."""
    if model.terms is None:
        return inputs
    n = len(model.signals.inputs)
    values = model.terms(inputs[:n]) if known is None else known
    return jnp.concatenate([inputs[:n], values, inputs[n:]])


def _sum(
    parts: tuple[LinearModel, Corrective | None, tuple[int, ...]],
    inputs: tuple[jax.Array, jax.Array],
    value: jax.Array | None,
) -> jax.Array:
    """A linear fit, and its corrective function in some rows, at what each of them takes."""
    linear, corrective, rows = parts
    return corrected(linear(inputs[0], value), (corrective, rows), inputs[1])


def corrected(
    total: jax.Array, by: tuple[Corrective | None, tuple[int, ...]], inputs: jax.Array
) -> jax.Array:
    """Values ``(row,)`` of a linear fit with a corrective function added in some rows."""
    corrective, rows = by
    if corrective is None:
        return total
    # Written out per row: a scatter costs more than all the rest of a small model.
    place = {row: k for k, row in enumerate(rows)}
    extra = corrective(inputs)
    return jnp.stack([v + extra[place[i]] if i in place else v for i, v in enumerate(total)])


def require_model(model: object, name: str = "model") -> None:
    """Refuse what is no model, as the result of a fit, which has one.

    Raises
    ------
    DfsmError
        What came, and what was expected.
    """
    require_kind(
        name, model, DFSM, "a model: dfsm.load reads one, and the result of a fit has one, .model"
    )


@eqx.filter_jit
def _evaluate(
    model: DFSM,
    row: Row,
    groups: Sequence[jax.Array],
    schedule: int | None,
    harmonics: jax.Array | None = None,
) -> jax.Array:
    """`derivative_row` or `output_row` at groups of inputs ``(..., n)``, and ĝ's harmonics.

    All of it in one compiled function: each operation outside would be compiled by itself.
    """
    model, order = model.prepared(), model.signals.order
    inputs, value = order.join(*groups), order.element(schedule, *groups)
    if harmonics is not None:
        shape = jnp.broadcast_shapes(inputs.shape[:-1], harmonics.shape[:-1])
        parts = [jnp.broadcast_to(a, (*shape, a.shape[-1])) for a in (inputs, harmonics)]
        inputs = jnp.concatenate(parts, axis=-1)
    flat = inputs.reshape(-1, inputs.shape[-1])
    values = jnp.broadcast_to(value, inputs.shape[:-1]).ravel()

    def one(at: tuple[jax.Array, jax.Array]) -> jax.Array:
        return row(model, *at)

    # Blocks keep the activations of hundreds of units in the cache instead of in memory.
    samples = (flat, values)
    if flat.shape[0] > 2 * _BLOCK:
        results = jax.lax.map(one, samples, batch_size=_BLOCK)
    else:
        results = jax.vmap(one)(samples)
    return results.reshape(*inputs.shape[:-1], results.shape[-1])


@eqx.filter_jit
def _jacobian(model: DFSM, row: Row, inputs: jax.Array) -> jax.Array:
    return jax.jacfwd(lambda inputs: row(model, inputs))(inputs)
