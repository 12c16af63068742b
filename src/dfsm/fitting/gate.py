"""Which rows are corrected, by what, and whether that does good (Sec. 3.5, 3.6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array
from dfsm.data.derivatives import kinematic_rows
from dfsm.errors import DfsmError, near_matches
from dfsm.fitting.corrective import CorrectiveFit, fit_corrective
from dfsm.fitting.linear import LinearFit
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings
from dfsm.models.corrective import Corrective
from dfsm.models.linear import LinearModel
from dfsm.numerics.time_mesh import mean_over, rms_over, std_over

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
    settings: FitSettings,
    later: bool = False,
) -> Correction:
    """Train a corrective function for the rows whose residual is large, and say which and why.

    Parameters
    ----------
    samples
        All training samples.
    inputs, targets
        What is fitted on what, shapes ``(sample, input)`` and ``(sample, target)``; the corrective
        function does not take the known terms among the inputs.
    linear
        The linear fit of the targets.
    settings
        Settings.
    later
        Train nothing: refinement is going to add a network.

    Returns
    -------
    Correction
    """
    derivatives = targets is samples.derivatives
    # Outputs of hidden states, which nothing is to correct, come after those that were fitted.
    targets = targets[:, : linear.model.coefficients.shape[1]]
    rms = _rms_left(linear.model, samples, inputs, targets)
    std = std_over(targets, samples.weights)
    ratio = rms / np.maximum(std, np.finfo(float).tiny)
    known = kinematic_rows(settings.states) if derivatives else {}
    mechanics = set(linear.model.complete()) - set(known)
    names = _target_names(samples, derivatives)[: len(ratio)]
    allowed = _allowed(samples, settings)
    chosen = [i for i, (name, _) in enumerate(names) if allowed is None or name in allowed]
    large = [
        i for i in chosen if i not in known and i not in mechanics and ratio[i] > settings.gate
    ]
    hidden, trained = linear.model.hidden_among(samples.inputs.shape[1]), None
    if large and not later:
        residuals = left_over(linear.model, samples, inputs, targets, large)
        inputs = samples.without_terms(inputs)
        trained = _train(inputs, residuals, hidden, samples, settings)
    function, explained, detail = None, dict[int, float](), ""
    if trained is not None:
        explained, detail = dict(zip(large, trained.explained, strict=True)), trained.detail
        # A correction that does no good on runs left out of training would only do harm.
        kept = [k for k, share in enumerate(trained.explained) if share > _WORTHWHILE]
        function = trained.function.select(kept).ignoring(hidden) if kept else None
        large = [large[k] for k in kept]
    else:
        large = []
    decisions = []
    for i, (name, unit) in enumerate(names):
        if i in known:
            text = "kinematic, its rate is a state"
        elif i in mechanics:
            text = f"mechanics, residual {ratio[i]:.1%} of the signal"
        elif ratio[i] <= settings.gate:
            text = f"linear fit, residual {ratio[i]:.1%} of the signal (gate {settings.gate:.1%})"
        elif i not in chosen:
            text = f"linear fit, residual {ratio[i]:.1%} of the signal, not among 'corrected'"
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


def _train(
    inputs: Array,
    residuals: Array,
    hidden: Sequence[int],
    samples: Samples,
    settings: FitSettings,
) -> CorrectiveFit | None:
    """Train on inputs of which some, whose effect physics gave, are held at their mean."""
    seen = inputs
    if hidden:
        columns = list(hidden)
        seen = inputs.copy()
        seen[:, columns] = mean_over(inputs[:, columns], samples.weights)
    runs, weights = samples.runs, samples.weights
    return fit_corrective(seen, residuals, runs, settings.corrective, settings.seed, weights)


def left_over(
    model: LinearModel, samples: Samples, inputs: Array, targets: Array, columns: Sequence[int]
) -> Array:
    """What a linear fit leaves of some of its targets, ``(sample, column)``, run by run."""
    residuals = np.empty((len(targets), len(columns)))
    for rows in samples.parts:
        residuals[rows] = (targets[rows] - predicted(model, inputs[rows]))[:, columns]
    return residuals


def _rms_left(model: LinearModel, samples: Samples, inputs: Array, targets: Array) -> Array:
    """Root mean square of what a linear fit leaves of every target, which is kept nowhere."""
    squares, total = np.zeros(targets.shape[1]), 0.0
    every = range(targets.shape[1])
    for part, wanted, weights in samples.weighted_blocks(inputs, targets, every):
        count = len(part) if weights is None else float(weights.sum())
        left = wanted - predicted(model, part)
        squares += count * rms_over(left, weights) ** 2
        total += count
    return np.sqrt(squares / total)


def predicted(model: LinearModel, inputs: Array) -> Array:
    """A linear fit at what it takes, ``(sample, input)`` to ``(sample, target)``."""
    return np.asarray(_apply(model, inputs))


@eqx.filter_jit
def _apply(model: Any, inputs: Array) -> jax.Array:
    return jax.vmap(model)(jnp.asarray(inputs))


def _allowed(samples: Samples, settings: FitSettings) -> tuple[str, ...] | None:
    """Targets that may be corrected; each must be one."""
    targets = [n for of in (True, False) for n, _ in _target_names(samples, of)]
    for name in settings.corrected or ():
        if name not in targets:
            raise DfsmError(
                f"corrected names '{name}', which is neither a derivative nor an output of the "
                "model; " + near_matches(name, targets)
            )
    return settings.corrected


def _target_names(samples: Samples, derivatives: bool) -> Sequence[tuple[str, str]]:
    if derivatives:
        return samples.derivative_names
    return [(c.name, c.unit) for c in samples.signals.outputs]
