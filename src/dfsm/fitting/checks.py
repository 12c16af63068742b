"""What `fit` looks at last: finite values, stability, rollouts over training runs, verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dfsm.data.dataset import Dataset
from dfsm.data.rates import wrong_rates
from dfsm.errors import DfsmError
from dfsm.fitting.contraction import contraction
from dfsm.fitting.doubts import Doubts
from dfsm.fitting.records import data_warnings
from dfsm.fitting.rollout_gate import tried_rollouts
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings
from dfsm.fitting.verdicts import Evidence, verdicts
from dfsm.models.dfsm import DFSM
from dfsm.models.stability import Growth, growths, places
from dfsm.simulation.simulate import Status

# Training runs along which pairs of rollouts from different initial states are followed.
_PAIRED_RUNS = 3
# Samples at which a model is evaluated together.
_TOGETHER = 2**16
# A growth is the plant's own where so little of all rows is left over, and where it is so many
# times what that may have made of it.
_NEXT_TO_NOTHING, _OF_ITSELF = 0.05, 5.0


def check(
    model: DFSM, samples: Samples, data: Dataset, settings: FitSettings, doubt: Doubts
) -> tuple[list[str], list[str], dict[str, Any]]:
    """Look for what would surprise a user: non-finite values, instability, leaking disturbances.

    Eigenvalues tell stability with the schedule frozen, pairs of rollouts along recorded paths.
    The last of what is returned are growths and verdicts, for the record.
    """
    held = doubt.held
    windows = [run.window(settings.start, settings.stop) for run in data]
    wrong = wrong_rates(windows, settings.states)
    notes = data_warnings(data, settings, samples) + list(held.values()) + list(wrong.values())
    if not all(map(np.all, _finite(model, samples))):
        raise DfsmError(
            "the fitted model is not finite on its own training samples: fewer "
            "corrective.samples, or another corrective.kind, may cure it"
        )
    # Nothing of what moves the latent states was fitted on derivatives.
    known = doubt.errors[:, samples.signals.observed_columns]
    errors = None if doubt.outdated else np.pad(known, (0, len(samples.signals.latents)))
    longest = max(run.window(settings.start, settings.stop).duration for run in data)
    growing = growths(model, longest, errors)
    grows = None if held else _grows_itself(model, growing, doubt)
    if unstable := [g for g in growing if g.unstable]:
        what = "linear fit" if model.e is None else "model"
        # A margin of the linear fit means nothing to what rollouts taught.
        way = "linear.margin" if settings.hidden is None else "hidden.stable or fewer hidden states"
        cure = (
            f"right for an unstable system; for any other set {way}, or expect rollouts to drift "
            "off"
        )
        if not doubt.cured_by_margin:
            cure = "what is told of its inputs may be why, and is to be mended first"
        if grows is not None:
            cure = (
                f"next to nothing of its rows is left over ({doubt.unexplained:.1%}), so this is "
                "what the plant does without its controller; linear.margin would spoil it"
            )
        notes.append(
            f"the {what} is unstable at {places(unstable, model.schedule)} (fastest growth "
            f"{max(g.rate for g in unstable):.3g} 1/s): {cure}"
        )
    tried = tried_rollouts(model, data, settings)
    some, rollouts = [data[i] for i in tried], list(tried.values())
    done = sum(r.status is Status.COMPLETED for r in rollouts)
    checks = [f"{done} of {len(some)} training runs tried were simulated to their end"]
    if done < len(some):
        worst = min(
            (r for r in rollouts if r.status is not Status.COMPLETED), key=lambda r: r.ended
        )
        notes.append(f"only {checks[0]}; {worst.trajectory.name}: {worst.reason}")
    few = slice(None, None, -(-len(some) // _PAIRED_RUNS))
    outcome = contraction(model, some[few], rollouts[few], settings.start, settings.stop)
    if outcome is not None:
        checks.append(outcome.account)
        if outcome.unexpected:
            notes.append(f"{outcome.account}, although {_unexpected(model)}")
    evidence = Evidence(
        rollouts=tried,
        doubts=None if doubt.outdated else doubt,
        growths=growing,
        refined=doubt.outdated,
        discarded=model.provenance.record.get("refinement", {}).get("improved") is False,
        records={name: f"'{name}' is held between its samples" for name in held}
        | {name: f"the rate that is named with '{name}' is not its own" for name in wrong},
        grows=grows,
    )
    judged = {
        "growth": [asdict(g) for g in growing],
        "verdicts": verdicts(samples, settings, evidence),
    }
    return notes, checks, judged


def _grows_itself(model: DFSM, growing: Sequence[Growth], doubt: Doubts) -> float | None:
    """Growth in 1/s that is the plant's own: told by a fit that leaves next to nothing.

    What a fit leaves of a row may be an error of its eigenvalues of about that share.
    """
    if model.e is not None or doubt.outdated or doubt.reasons:
        return None
    if doubt.unexplained > _NEXT_TO_NOTHING:
        return None
    unstable = [g.rate for g in growing if g.unstable]
    fastest = max(float(np.abs(np.linalg.eigvals(A)).max()) for A in model.linear_state_matrices())
    if not unstable or max(unstable) < _OF_ITSELF * doubt.unexplained * fastest:
        return None
    return max(unstable)


def _finite(model: DFSM, samples: Samples) -> Iterator[NDArray[np.bool_]]:
    """Which derivatives and outputs are finite, part by part to bound memory."""
    for start in range(0, len(samples.inputs), _TOGETHER):
        x, u, w, p = model.split(samples.inputs[start : start + _TOGETHER])
        yield np.isfinite(model.derivative(x, u, w, p))
        yield np.isfinite(model.output(x, u, w, p))


def _unexpected(model: DFSM) -> str:
    """What ought to have made states come together, and what to do where it did not."""
    if model.schedule:
        return (
            f"every linear fit is stable with {model.schedule} frozen: as it moves, the model is "
            "not; use fewer linear.points, a larger linear.margin or another linear.schedule"
        )
    return (
        "the linear fit is stable: right for a system with several equilibria; for any other set "
        "linear.margin, or correct less (gate, corrective)"
    )
