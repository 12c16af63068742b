"""A model as a component of OpenMDAO, and as the equations of a dymos phase (`dfsm[openmdao]`).

The component evaluates `DFSM.derivative` and `DFSM.output` at all nodes at once and hands over
exact partial derivatives from JAX, sparse: a node depends on its own inputs only. Differences,
which OpenMDAO takes by default, would be nearly a per cent off for a torque of 2e7 N m.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.control.names import require_prompt_controls
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.core.units import conversion, listed, powers
from dfsm.data.channel import Channel
from dfsm.errors import DfsmError
from dfsm.exports.functions import computed_inputs, starting_values
from dfsm.models.dfsm import DFSM

try:
    import openmdao.api as om  # pyright: ignore[reportMissingImports]
    from openmdao.utils.units import (  # pyright: ignore[reportMissingImports]
        unit_conversion,
        valid_units,
    )
except ImportError:
    raise DfsmError("this needs OpenMDAO: pip install 'dfsm[openmdao]'") from None

_GROUPS = ("states", "controls", "disturbances", "parameters")
# What dymos connects to its own clock wherever an input bears the name, or keeps for itself.
_OF_DYMOS = ("t", "time", "t_phase", "time_phase", "t_initial", "t_duration")


class DFSMComp(om.ExplicitComponent):
    """The derivatives and outputs of a model at many nodes.

    Options: ``model``, a `DFSM`, and ``num_nodes``. Inputs are the states, controls and
    disturbances, of shape ``(num_nodes,)``, and the parameters, of shape ``(1,)``, which start in
    the middle of the training data; an input that dfsm would compute from others says so in its
    description, and `dfsm.model_inputs` computes it. Outputs are
    ``d_NAME_dt`` for every state and the model's outputs. Units are those of the model where
    OpenMDAO knows them, and none elsewhere. Characters that OpenMDAO does not take in names become
    ``_``; `variables` tells what each signal is called. Harmonics of a rotor's azimuth are at their
    mean.
    """

    def initialize(self) -> None:
        """Declare the options."""
        self.options.declare("model", types=DFSM, desc="derivative function surrogate model")
        self.options.declare("num_nodes", types=int, default=1, lower=1, desc="points in time")

    @cached_property
    def variables(self) -> Mapping[str, str]:
        """Names of the variables by name of the signal, and by ``d NAME/dt`` for the states."""
        return variables_of(self.options["model"])

    def setup(self) -> None:
        """Declare variables and the sparsity of their partial derivatives."""
        model, nodes = self.options["model"], self.options["num_nodes"]
        s, named, at = model.signals, self.variables, _at_start(model)
        for group in _GROUPS:
            shape = (1,) if group == "parameters" else (nodes,)
            for c in getattr(s, group):
                self.add_input(named[c.name], shape=shape, units=unit_of(c.unit), **at[c.name])
        rows = [*((f"d {c.name}/dt", _rate(c.unit)) for c in s.states)]
        rows += [(c.name, unit_of(c.unit)) for c in s.outputs]
        for key, units in rows:
            self.add_output(named[key], shape=(nodes,), units=units)
        every = np.arange(nodes)
        self._wrt = [c for group in _GROUPS for c in getattr(s, group)]
        depends = dependence(model)
        self._pairs = []
        for i, (key, _) in enumerate(rows):
            for j, c in enumerate(self._wrt):
                if depends[i, j]:
                    columns = 0 * every if c in s.parameters else every
                    of, wrt = named[key], named[c.name]
                    self.declare_partials(of, wrt, rows=every, cols=columns)
                    self._pairs.append((i, j, of, wrt))
        self._of = [named[key] for key, _ in rows]

    def compute(self, inputs: Any, outputs: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Evaluate f̂ and ĝ at all nodes."""
        values = np.asarray(_values(self.options["model"], from_host(self._points(inputs))))
        for name, column in zip(self._of, values.T, strict=True):
            outputs[name] = column

    def compute_partials(self, inputs: Any, partials: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Evaluate the exact Jacobians at all nodes."""
        slopes = np.asarray(_slopes(self.options["model"], from_host(self._points(inputs))))
        for i, j, of, wrt in self._pairs:
            partials[of, wrt] = slopes[:, i, j]

    def _points(self, inputs: Any) -> Array:
        """States, controls, disturbances and parameters side by side, ``(node, signal)``."""
        nodes = self.options["num_nodes"]
        columns = [np.asarray(inputs[self.variables[c.name]]).ravel() for c in self._wrt]
        return np.stack([np.broadcast_to(c, (nodes,)) for c in columns], axis=1)


def variables_of(model: DFSM) -> dict[str, str]:
    """Names that OpenMDAO takes, by name of the signal and by ``d NAME/dt`` for the states."""
    s = model.signals
    wanted = {c.name: _plain(c.name) for c in (*_all(model), *s.outputs)}
    wanted |= {f"d {c.name}/dt": f"d_{_plain(c.name)}_dt" for c in s.states}
    taken: set[str] = set(_OF_DYMOS)
    for key, name in wanted.items():
        while name in taken:
            name += "_"
        taken.add(name)
        wanted[key] = name
    return wanted


def unit_of(unit: str) -> str | None:
    """A unit as OpenMDAO spells it; None for one that it does not know, or means otherwise by it.

    To OpenMDAO ``C`` is a charge and ``kN m`` an error: what it is given means what dfsm reads.
    """
    plain = re.sub(r"^[(\[](.*)[)\]]$", r"\1", unit.strip())
    if not listed(unit):
        return plain if plain and _is_unit(plain) else None
    made_of = powers(unit)
    if not made_of:
        return None
    word = re.sub("[·⋅∙•×.]", "*", plain.replace("^", "**").replace("²", "**2").replace("³", "**3"))
    joined = re.sub(r"(?<=[A-Za-z\d])[-\s]+(?=[A-Za-z])", "*", word)
    raised = re.sub(r"(?<=[A-Za-z])(-?\d+)", r"**\1", joined)
    # Nothing else than powers of base units is left where no spelling means the same.
    base = "*".join(f"{name}**{power:g}" for name, power in made_of.items())
    tried = [word, joined, raised, re.sub(r"N[Mm]\b", "N*m", raised), *_SPELLINGS, base]
    return next((s for s in tried if _is_unit(s) and _means(s, unit, base)), None)


# Of single units that the field spells in ways of its own.
_SPELLINGS = ("deg", "degC", "degF", "rpm")


def _is_unit(spelled: str) -> bool:
    """Whether OpenMDAO knows a unit; it evaluates the text, which may raise anything."""
    try:
        return valid_units(spelled)
    except Exception:
        return False


def _means(spelled: str, unit: str, base: str) -> bool:
    """Whether OpenMDAO takes values of `spelled` to base units as dfsm does those of `unit`."""
    ours = conversion(unit, base)
    try:
        scale, shift = unit_conversion(spelled, base)
    except Exception:
        return False
    return ours is not None and np.allclose([scale, scale * shift], ours, rtol=1e-9, atol=0)


def dependence(model: DFSM) -> Array:
    """Which derivative or output can depend on which state, control, disturbance and parameter.

    Returns
    -------
    ndarray
        Of bool, ``(state + output, signal)``; columns in the order of the component's inputs.
    """
    s = model.signals
    places = {c.name: k for k, c in enumerate(s.inputs)}
    columns = [places[c.name] for c in _all(model)]
    parts = [(model.f, model.e, model.corrected), (model.g, model.e_g, model.corrected_outputs)]
    blocks = []
    for linear, corrective, corrected in parts:
        if linear is None:
            continue
        L = np.asarray(linear.coefficients)
        used = (L != 0).any(axis=0)
        depends = used[:, : len(s.inputs)].copy()
        last = len(s.inputs)
        for part in () if model.terms is None else model.terms.parts:
            first, last = last, last + len(part.channels)
            depends[:, list(part.columns)] |= used[:, first:last].any(axis=1, keepdims=True)
        if corrective is not None:
            depends[list(corrected)] = True
        if linear.schedule is not None:
            offsets = np.asarray(linear.offsets)
            varies = (np.ptp(L, axis=0) != 0).any(axis=1) | (np.ptp(offsets, axis=0) != 0)
            depends[:, linear.schedule] |= varies
        blocks.append(depends)
    if model.passing is not None:
        blocks[-1][:] = True
    return np.concatenate(blocks)[:, columns]


def dymos_phase(model: DFSM, transcription: Any) -> Any:
    """Return a dymos phase whose equations are the model.

    States, controls and disturbances (as controls that nobody optimizes) and parameters are
    declared with their units and values in the middle of the training data; give bounds, scales
    and what is optimized with the phase's ``set_state_options`` and ``set_control_options``, and
    the course of the disturbances with ``set_control_val``, from `dfsm.model_inputs` over the times
    of the phase: dymos stretches the times that it is given to the phase, whatever they are. A
    bound on a control holds at the nodes: the polynomial between them may pass it, so look at a
    fine mesh or use more segments.

    Parameters
    ----------
    model
        The surrogate.
    transcription
        Of dymos, e.g. ``dymos.Radau(num_segments=20)``.

    Raises
    ------
    DfsmError
        dymos is not installed, or an input of the model is what a control did some time ago.
    """
    try:
        import dymos  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DfsmError("this needs dymos: pip install 'dfsm[openmdao]'") from None
    require_prompt_controls(model)
    phase = dymos.Phase(
        ode_class=DFSMComp, ode_init_kwargs={"model": model}, transcription=transcription
    )
    s, named, at = model.signals, variables_of(model), _at_start(model)
    for c in s.states:
        name, rate = named[c.name], named[f"d {c.name}/dt"]
        phase.add_state(
            name, rate_source=rate, targets=[name], units=unit_of(c.unit), val=at[c.name]["val"]
        )
    for c in (*s.controls, *s.disturbances):
        name, chosen = named[c.name], c in s.controls
        units = unit_of(c.unit)
        phase.add_control(name, targets=[name], units=units, opt=chosen, **at[c.name])
    for c in s.parameters:
        name, units = named[c.name], unit_of(c.unit)
        phase.add_parameter(name, targets=[name], units=units, static_target=True, **at[c.name])
    for c in s.outputs:
        phase.add_timeseries_output(named[c.name], units=unit_of(c.unit))
    return phase


@eqx.filter_jit
def _values(model: DFSM, points: jax.Array) -> jax.Array:
    return jax.vmap(lambda at: _row(model, at))(points)


@eqx.filter_jit
def _slopes(model: DFSM, points: jax.Array) -> jax.Array:
    return jax.vmap(jax.jacfwd(lambda at: _row(model, at)))(points)


def _row(model: DFSM, at: jax.Array) -> jax.Array:
    """Derivatives and outputs at one node, from states, controls, disturbances, parameters."""
    ends = np.cumsum([len(getattr(model.signals, group)) for group in _GROUPS])[:-1]
    groups = jnp.split(at, ends)
    return jnp.concatenate([model.derivative(*groups), model.output(*groups)])


def _all(model: DFSM) -> list[Channel]:
    return [c for group in _GROUPS for c in getattr(model.signals, group)]


def _at_start(model: DFSM) -> dict[str, dict[str, Any]]:
    """Start values and descriptions by signal, as OpenMDAO and dymos take them."""
    starts, computed = starting_values(model), computed_inputs(model)
    return {
        c.name: {"val": float(value), "desc": computed.get(c.name, c.label)}
        for group in _GROUPS
        for c, value in zip(getattr(model.signals, group), starts[group], strict=True)
    }


def _plain(name: str) -> str:
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    return plain if plain[:1].isalpha() else f"s_{plain}"


def _rate(unit: str) -> str | None:
    known = unit_of(unit)
    if known is None:
        # Of a number that has no unit; nothing is said of a unit that OpenMDAO does not know.
        return "1/s" if listed(unit) and not powers(unit) else None
    return unit_of(f"{known}/s")
