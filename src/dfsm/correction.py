"""Which rows are corrected, by what, and whether that does good (Sec. 3.5, 3.6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.corrective import Corrective, NoCorrection, fit_corrective, ignoring
from dfsm.derivatives import kinematic_rows
from dfsm.latents import at_rest
from dfsm.linear import LinearFit, LinearModel
from dfsm.model import DFSM
from dfsm.samples import FitSettings, Samples
from dfsm.types import Array

# Stability is looked at in so many places from one operating point to the next.
_BETWEEN = 4
# A correction is kept if it explains at least this share of the residual's variance on runs left
# out of training. Less than that is within what cross-validation finds in noise, and may undo what
# a stable linear fit has gained.
_WORTHWHILE = 0.01


@dataclass(frozen=True)
class Correction:
    """A corrective function and why it is there, or not.

    Attributes
    ----------
    function
        None where no row is corrected.
    rows
        Targets that it adds to.
    decisions
        For every target its figures and the decision in words; JSON values.
    """

    function: Corrective | None
    rows: tuple[int, ...]
    decisions: list[dict[str, Any]]

    def withdrawn(self, reason: str) -> Correction:
        """No correction after all, with the reason in the decisions."""
        decisions = [
            d | {"corrected": False, "decision": f"linear fit: {reason}"} if d["corrected"] else d
            for d in self.decisions
        ]
        return Correction(None, (), decisions)


def correct(
    samples: Samples,
    inputs: Array,
    targets: Array,
    linear: LinearFit,
    choices: FitSettings,
    later: bool = False,
) -> Correction:
    """Train a corrective function for the rows whose residual is large, and say which and why.

    Parameters
    ----------
    samples
        All training samples.
    inputs, targets
        What is fitted on what, shapes ``(sample, input)`` and ``(sample, target)``.
    linear
        The linear fit of the targets.
    choices
        Settings.
    later
        Train nothing: refinement is going to add a network.

    Returns
    -------
    Correction
    """
    residuals = targets - _predict(linear.model, samples, inputs, targets)
    rms, std = np.sqrt(np.mean(residuals**2, axis=0)), targets.std(axis=0)
    ratio = rms / np.maximum(std, np.finfo(float).tiny)
    derivatives = targets is samples.derivatives
    known = kinematic_rows(choices.states) if derivatives else {}
    large = [i for i in range(targets.shape[1]) if i not in known and ratio[i] > choices.gate]
    function, explained, detail = None, dict[int, float](), ""
    if large and not later and not isinstance(choices.corrective, NoCorrection):
        hidden, seen = list(linear.model.known_inputs), inputs
        if hidden:
            seen = inputs.copy()
            seen[:, hidden] = inputs[:, hidden].mean(axis=0)
        trained = fit_corrective(
            seen, residuals[:, large], samples.runs, choices.corrective, choices.seed
        )
        explained, detail = dict(zip(large, trained.explained, strict=True)), trained.detail
        # A correction that does no good on runs left out of training would only do harm.
        kept = [k for k, share in enumerate(trained.explained) if share > _WORTHWHILE]
        function = ignoring(trained.function.select(kept), hidden) if kept else None
        large = [large[k] for k in kept]
    else:
        large = []
    decisions = []
    for i, (name, unit) in enumerate(_target_names(samples, derivatives)):
        if i in known:
            text = "kinematic, its rate is a state"
        elif ratio[i] <= choices.gate:
            text = f"linear fit, residual {ratio[i]:.1%} of the signal (gate {choices.gate:.1%})"
        elif i in large:
            text = (
                f"corrected, residual {ratio[i]:.1%} of the signal, of whose variance "
                f"{explained[i]:.1%} is explained in cross-validation ({detail})"
            )
        elif i in explained:
            text = f"linear fit, residual {ratio[i]:.1%} of the signal: a correction explains "
            if explained[i] < 0.001:  # negative where it would do harm
                text += "nothing on data left out of its training"
            else:
                text += f"only {explained[i]:.1%} of its variance in cross-validation"
        else:
            text = f"linear fit, residual {ratio[i]:.1%} of the signal, "
            text += "rollouts teach a network the rest" if later else "corrections switched off"
        decisions.append(
            {
                "name": name,
                "unit": unit,
                "std": float(std[i]),
                "residual_rms": float(rms[i]),
                "explained": float(explained[i]) if i in explained else None,
                "corrected": i in large,
                "decision": text,
            }
        )
    return Correction(function, tuple(large), decisions)


def _predict(model: LinearModel, samples: Samples, inputs: Array, targets: Array) -> Array:
    """Evaluate the linear fit run by run, so that memory stays bounded."""
    parts = [_apply(model, block) for block, _ in samples.blocks(inputs, targets)]
    return np.concatenate([np.asarray(p) for p in parts])


@eqx.filter_jit
def _apply(model: Any, inputs: Array) -> jax.Array:
    return jax.vmap(model)(jnp.asarray(inputs))


def _target_names(samples: Samples, derivatives: bool) -> Sequence[tuple[str, str]]:
    if derivatives:
        return samples.derivative_names
    return [(c.name, c.unit) for c in samples.signals.outputs]


def destabilised(model: DFSM) -> str | None:
    """Tell whether the corrective function makes an operating point, or one between two, unstable.

    Parameters
    ----------
    model
        Its linear fit is stable.

    Returns
    -------
    str or None
        What would go wrong, for the user; None where nothing does.
    """
    if model.e is None:
        return None
    grid, points = operating_points(model)
    growth = np.linalg.eigvals(state_matrices(model, points)).real.max(axis=1)
    worst = int(np.argmax(growth))
    if growth[worst] <= 0:
        return None
    place = f" at {model.schedule} = {grid[worst]:.4g}" if model.schedule else ""
    return f"with a correction the model would be unstable{place} (growth {growth[worst]:.2g} 1/s)"


def state_matrices(model: DFSM, points: Array) -> Array:
    """A at inputs ``(point, input)`` with latent states at rest, ``(point, state, state)``."""
    return np.asarray(_state_matrices(model, jnp.asarray(points)))


@eqx.filter_jit
def _state_matrices(model: DFSM, points: jax.Array) -> jax.Array:
    def at_point(inputs: jax.Array) -> jax.Array:
        x, *others = model.split(at_rest(model, inputs))
        return jax.jacfwd(lambda x: model.derivative(x, *others))(x)

    return jax.vmap(at_point)(points)


def operating_points(model: DFSM) -> tuple[Array, Array]:
    """Schedule values ``(point,)`` and inputs ``(point, input)`` where stability is looked at."""
    grid, operating = np.asarray(model.region.grid), np.asarray(model.region.operating)
    places = np.arange((len(grid) - 1) * _BETWEEN + 1) / _BETWEEN
    table = np.column_stack([grid, operating]).T
    found = np.stack([np.interp(places, np.arange(len(grid)), row) for row in table], axis=1)
    return found[:, 0], found[:, 1:]
