"""f̂ and ĝ of a model as programs, and what there is to say about their vectors."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array
from dfsm.core.version import __version__
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.exports.program import Program
from dfsm.exports.translate import UntranslatableError, translated
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.inputs import GROUPS as INPUTS
from dfsm.models.latents import at_rest
from dfsm.models.point import functions_of_points
from dfsm.simulation.fastest import REACH, fastest_rates

# The arguments of f and g, in this order.
GROUPS = ("states", "controls", "disturbances", "parameters")
# What a model with blade-passing harmonics takes in addition.
TURNING = ("azimuth", "field")
# What the program of each name gives.
RESULTS = {
    "f": "derivatives",
    "g": "outputs",
    "g_at_azimuth": "outputs",
    "d": "distance",
}


def programs(model: DFSM) -> dict[str, Program]:
    """Programs of ``f``, ``g`` and ``d``, and of ``g_at_azimuth`` where blades pass.

    They take states, controls, disturbances and parameters; ``g_at_azimuth`` takes in addition the
    azimuth in rad and the harmonics of the wind field (none in a model that follows none). ``g``
    of such a model is the average over a revolution. ``d`` is `training_distance`.

    Raises
    ------
    DfsmError
        A term is a function with something in it that no program can have; names both.
    """
    require_model(model)
    inputs = [(group, len(getattr(model.signals, group))) for group in GROUPS]
    turning = [(TURNING[0], 1), (TURNING[1], len(model.signals.field))]
    f, g = functions_of_points(model)
    functions: dict[str, Any] = {"f": (f, inputs), "g": (g, inputs)}
    if model.signals.azimuth is not None:

        def at_azimuth(*vectors: Any) -> Any:
            *groups, psi, field = vectors
            return g(*groups, psi[0], field)

        functions["g_at_azimuth"] = (at_azimuth, [*inputs, *turning])
    functions["d"] = (partial(training_distance, model), inputs)
    try:
        return {name: translated(*function) for name, function in functions.items()}
    except UntranslatableError as error:
        raise DfsmError(_refusal(model, str(error))) from None


def training_distance(model: DFSM, *groups: Any) -> Any:
    """How far a point is from the training data, ``(1,)``: more than 1 is outside them.

    The larger of two: the signal that is farthest from the middle of its training range, of which
    both ends are 1, and `Region.distance` of all together, the root of it, as a rollout tells it.

    Parameters
    ----------
    model
        The model.
    *groups
        Vectors of states, controls, disturbances and parameters.
    """
    region = model.region
    low, high = np.asarray(region.low), np.asarray(region.high)
    middle, half = (low + high) / 2, (high - low) / 2
    # Of what never moved in training a billionth is as far as any other signal may be.
    half = np.maximum(half, 1e-9 * np.where(middle != 0, np.abs(middle), 1.0))
    inputs = model.signals.order.join(*groups)
    alone = jnp.max(jnp.abs(inputs - middle) / half, initial=0.0)
    together = jnp.sqrt(jnp.maximum(region.distance(inputs), 0.0))
    return jnp.maximum(alone, together)[None]


def _refusal(model: DFSM, primitive: str) -> str:
    """The sentence about a primitive, which names the term that it is in."""
    for part in () if model.terms is None else model.terms.parts:
        try:
            translated(part.values, [("signals", len(part.columns))])
        except UntranslatableError:
            return (
                f"the term '{part.channels[0].name}' cannot be exported: its function uses JAX's "
                f"'{primitive}', which has no counterpart in other programs; write it with sums, "
                "products, elementary functions, jnp.where and jnp.interp, or leave the term out"
            )
    return (
        f"the model cannot be exported: it uses JAX's '{primitive}', which has no counterpart in "
        "other programs; fit it with another kind of terms or corrective function"
    )


# -- what the vectors are -----------------------------------------------------------------------


def description(model: DFSM) -> dict[str, Any]:
    """Names and units of all vectors, start values, and what must be known to use the model."""
    require_model(model)
    s, start = model.signals, starting_values(model)
    groups = (*GROUPS, "outputs", "field")
    told: dict[str, Any] = {"dfsm": __version__}
    for group in groups:
        channels: tuple[Channel, ...] = getattr(s, group)
        told[group] = [{"name": c.name, "unit": c.unit} for c in channels]
        for entry, value in zip(told[group], start.get(group, ()), strict=False):
            entry["start"] = float(value)
    ranges = np.stack([model.region.low, model.region.high], axis=1).tolist()
    order = [entry for group in INPUTS for entry in told[group]]
    for entry, trained in zip(order, ranges, strict=True):
        entry["trained"] = trained
    kinds = s.between_samples()
    for entry, kind in zip([*told["controls"], *told["disturbances"]], kinds, strict=False):
        entry["between_samples"] = kind
    told["latent_states"] = [c.name for c in s.latents]
    told["latent_starts"] = _latent_starts(model)
    told["step"] = longest_step(model)
    computed = computed_inputs(model)
    for entry in (*told["controls"], *told["disturbances"], *told["parameters"]):
        if entry["name"] in computed:
            entry["computed"] = computed[entry["name"]]
    told["computed_inputs"] = list(computed.values())
    told["notes"] = [*told["computed_inputs"]]
    if s.latents:
        names = ", ".join(told["latent_states"])
        starts = f"{'at ' if s.startup else ''}{told['latent_starts']}"
        told["notes"].append(f"{names}, which nobody measures, start {starts}")
    rate = s.azimuth_rate
    if rate is not None:
        told["azimuth"] = {"unit": "rad", "speed": s.states[rate[0]].name, "rad/s": rate[1]}
    return told


def starting_values(model: DFSM) -> Mapping[str, Array]:
    """The middle of the training data by group; latent states that inputs drive are at rest."""
    order = model.signals.order
    middle = at_rest(model, model.region.mean)
    groups = order.split(middle)
    return {g: np.asarray(v) for g, v in zip(GROUPS, groups, strict=True)}


def _latent_starts(model: DFSM) -> str:
    """What the start values of states are that nobody measures."""
    s = model.signals
    if not s.latents:
        return ""
    if s.startup:
        return (
            "their mean over the training runs; dfsm.simulate tells them from "
            f"{s.startup:g} s of recorded inputs and measured states before the start"
        )
    return "at rest under the start values of the inputs"


def longest_step(model: DFSM) -> float | None:
    """Longest step of RK4 in s: the one that the model was made for, or what is stable.

    `simulate` looks at the run for the second, here the operating points stand for it. None where
    nothing limits the step.
    """
    s, operating = model.signals, np.asarray(model.region.operating)
    columns = [s.order.column(name) for name in s.exogenous]
    (rate,) = fastest_rates(model, [operating[:, columns]])
    limits = [] if s.step is None else [s.step]
    return min([*limits, REACH / rate] if rate > 0 else limits, default=None)


def computed_inputs(model: DFSM) -> dict[str, str]:
    """What inputs must be supplied that dfsm would compute from others, a sentence each by name."""
    s, sentences = model.signals, dict[str, str]()
    used = set(s.order.exogenous)
    units = {c.name: c.unit for c in (*s.controls, *s.disturbances)}
    for feature in s.features:
        if feature.name not in used:
            continue
        source = feature.source
        if feature.kind == "rate":
            over = (
                "" if feature.seconds is None else f", from {feature.seconds:g} s before to after"
            )
            how = f"the time derivative of {source}{over}"
        elif feature.kind == "lag":
            how = f"{source} after a first-order lag of {feature.time_constant:g} s"
        elif feature.kind == "delay":
            how = f"{source} as it was {feature.seconds:g} s ago"
        elif feature.kind == "lead":
            how = f"{source} as it will be in {feature.seconds:g} s"
        else:
            how = f"{source} less {feature.less}"
        unit = units.get(feature.name, "")
        named = f"{feature.name}{f' ({unit})' if unit else ''}"
        sentences[feature.name] = f"{named} is {how}: supply it"
    if s.hub_height is not None:
        from dfsm.data.wind import CORRECTED_WIND

        if CORRECTED_WIND in used:
            sentences[CORRECTED_WIND] = (
                f"{CORRECTED_WIND} is the rotor-averaged wind without what the platform's motion "
                f"adds at a hub {s.hub_height:g} m above it: supply it"
            )
    return sentences
