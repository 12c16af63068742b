"""The method, step by step: runs in, a multi-fidelity DFSM out (Sec. 3.1).

Read `fit` from top to bottom: select the channels, take derivatives, fit linearly, look at what is
left, correct where that is worth it, refine on rollouts if asked for, do the same for the outputs,
check the result.
"""

from __future__ import annotations

import time as clock
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from importlib.metadata import version
from typing import Any

import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from dfsm.core.renamed import renamed
from dfsm.core.types import Array
from dfsm.data.dataset import Dataset
from dfsm.data.derivatives import kinematic_rows
from dfsm.data.readers.rotor_table import RotorTable
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, DfsmWarning, hushed
from dfsm.fitting.contraction import contraction
from dfsm.fitting.corrective import NoCorrection, fit_corrective
from dfsm.fitting.gate import correct
from dfsm.fitting.known import known_coefficients
from dfsm.fitting.linear import LPV, LinearFit, fit_linear, schedule_windows
from dfsm.fitting.passing import fit_passing, unexplained
from dfsm.fitting.region import region_of
from dfsm.fitting.rollout_samples import along_rollouts, with_latents
from dfsm.fitting.samples import Samples, data_warnings, extract, select
from dfsm.fitting.settings import FitSettings
from dfsm.fitting.stabilize import stabilise
from dfsm.models.corrective import Corrective
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region
from dfsm.models.signals import Provenance
from dfsm.models.stability import destabilised
from dfsm.refinement.refine import refine
from dfsm.refinement.settings import RefineSettings
from dfsm.simulation.simulate import Status, simulate

# Training runs that are simulated to check a new model, and those of them along which pairs of
# rollouts from different initial states are followed.
_CHECK_RUNS, _PAIRED_RUNS = 8, 3


@dataclass(frozen=True)
class FitResult:
    """What `fit` returns.

    Attributes
    ----------
    model
        The multi-fidelity model; ``model.linear_fit()`` is its linear part alone.
    nonlinear
        The nonlinear-only model f̂_NL, if asked for.
    seconds
        Wall time per step.
    """

    model: DFSM
    nonlinear: DFSM | None
    seconds: Mapping[str, float]

    def __repr__(self) -> str:
        extra = "" if self.nonlinear is None else ", and a nonlinear-only model"
        return f"<FitResult after {sum(self.seconds.values()):.1f} s: {self.model!r}{extra}>"


# Threads gain next to nothing on matrices this narrow, and where other programs use the machine
# they wait for each other: measured five times slower on two loaded cores.
@renamed(choices="settings")
@threadpool_limits.wrap(limits=1)
def fit(
    runs: Iterable[Trajectory], settings: FitSettings, refinement: RefineSettings | None = None
) -> FitResult:
    """Fit a multi-fidelity derivative function surrogate model.

    Parameters
    ----------
    runs
        Simulations that hold all channels named in `settings`; their order does not matter.
    settings
        Signals and settings.
    refinement
        How the derivative function is refined on rollouts, see `refine`; None leaves it as
        fitted. Outputs are then fitted along the refined model's own rollouts.

    Returns
    -------
    FitResult

    Raises
    ------
    DfsmError
        Bad data or settings, in one sentence.

    Warns
    -----
    DfsmWarning
        Inputs that the data cannot tell apart, an unstable linear fit, a disturbance that holds
        a response, a gap in a record, a parameter with one value in all runs.
    """
    seconds: dict[str, float] = {}
    with _timed(seconds, "select"):
        data = select(runs, settings)
    with _timed(seconds, "derivatives"):
        samples = extract(data, settings)
    with _timed(seconds, "linear fit"):
        f = _fit_derivatives(samples, settings)
    with _timed(seconds, "corrective functions"):
        later = refinement is not None and refinement.network > 0
        e = correct(samples, samples.linear_inputs, samples.derivatives, f, settings, later)
    region = region_of(samples, f.model, data)
    model = DFSM(
        f=f.model,
        e=e.function,
        g=None,
        e_g=None,
        region=region,
        corrected=e.rows,
        corrected_outputs=(),
        signals=samples.signals,
        terms=samples.terms,
    )
    if settings.linear.margin is not None and (harm := destabilised(model)):
        model, e = replace(model, e=None, corrected=()), e.withdrawn(harm)
    recorded = seen = samples
    if refinement is not None:
        with _timed(seconds, "refinement"):
            window = {"start": settings.start, "stop": settings.stop}
            model = refine(model, data, refinement, **window, seed=settings.seed).model
            recorded = with_latents(model, data, samples, settings)
            recorded = replace(recorded, terms=model.terms)
            seen = along_rollouts(model, data, recorded, settings)
    with _timed(seconds, "outputs"):
        g = _fit_outputs(seen, settings)
        e_g = correct(seen, seen.output_inputs, seen.outputs, g, settings) if g else None
    model = replace(
        model,
        g=g.model if g else None,
        e_g=e_g.function if e_g else None,
        corrected_outputs=e_g.rows if e_g else (),
    )
    passing: list[dict[str, Any]] = []
    with _timed(seconds, "blade passing"):
        if model.signals.field:
            model, passing, more = fit_passing(model, seen, data)
        else:
            more = unexplained(model, seen)
    with _timed(seconds, "checks"):
        notes, checks = _check(model, recorded, data, settings)
        notes += more
    notes = [*dict.fromkeys((*f.warnings, *(g.warnings if g else ()))), *notes]
    checks = [*f.notes, *checks]
    nonlinear = None
    if settings.nonlinear_only and not isinstance(settings.corrective, NoCorrection):
        with _timed(seconds, "nonlinear-only"):
            nonlinear = _fit_nonlinear(samples, region, settings)
            if nonlinear.signals.field:
                nonlinear, *_ = fit_passing(nonlinear, samples, data)
    outputs = e_g.decisions if e_g else []
    for row, account in zip(outputs, passing, strict=False):
        row["passing"] = account["explained"]
        row["decision"] += f"; {account['text']}"
    decisions = [*e.decisions, *outputs]
    record = dict(model.provenance.record) | _record(
        data, settings, f, decisions, notes, checks, seconds
    )
    for text in notes:
        warnings.warn(text, DfsmWarning, stacklevel=2)
    model = replace(model, provenance=Provenance(record))
    if nonlinear is not None:
        nonlinear = replace(nonlinear, provenance=Provenance(record))
    return FitResult(model, nonlinear, seconds)


# -- linear fit (Sec. 3.4) ----------------------------------------------------------------------


def _fit_derivatives(samples: Samples, settings: FitSettings) -> LinearFit:
    """Linear fit of ξ̇; kinematic rows d q = q̇ are written down, not fitted."""
    kinematic = kinematic_rows(settings.states)
    fitted = [i for i in range(samples.derivatives.shape[1]) if i not in kinematic]
    known = known_coefficients(samples, settings, fitted)
    inputs, targets = samples.linear_inputs, samples.derivatives[:, fitted]
    result = _linear(samples, inputs, targets, settings, {**known.first, **known.fixed})
    result = replace(result, model=replace(result.model, known=tuple(known.fixed)))
    columns = samples.signals.state_columns
    if settings.linear.margin is not None:
        before = result.residual_rms
        slopes = _slopes(samples, result)
        result, moved = stabilise(
            result, columns, kinematic, settings.linear.margin, settings.linear.affine, slopes
        )
        names = [samples.derivative_names[i][0] for i in fitted]
        result = replace(
            result, notes=_account(settings, moved, names, before, result.residual_rms)
        )
    points, _, n_inputs = result.model.coefficients.shape
    L = np.zeros((points, samples.derivatives.shape[1], n_inputs))
    b = np.zeros(L.shape[:2])
    L[:, fitted], b[:, fitted] = result.model.coefficients, result.model.offsets
    b[:, [fitted[row] for row in known.balances]] = 0.0
    rms, std = np.zeros(L.shape[1]), samples.derivatives.std(axis=0)
    rms[fitted] = result.residual_rms
    for row, rate in kinematic.items():
        L[:, row, columns.start + rate] = 1.0
    model = LinearModel(
        result.model.grid,
        jnp.asarray(L),
        jnp.asarray(b),
        result.model.schedule,
        tuple((fitted[row], column) for row, column in result.model.known),
    )
    return replace(result, model=model, residual_rms=rms, target_std=std)


def _account(
    settings: FitSettings, moved: list[float], names: list[str], before: Array, after: Array
) -> tuple[str, ...]:
    """What making the fit stable cost."""
    if not moved:
        return ("all eigenvalues were left of the margin, none was moved",)
    growth = ", ".join(
        f"{name} {max(a / b - 1, 0.0):+.2%}"
        for name, a, b in zip(names, after, before, strict=True)
    )
    where = ""
    if isinstance(settings.linear, LPV):
        points = ", ".join(f"{p:.4g}" for p in moved)
        where = f" at {settings.linear.schedule} = {points}"
    return (
        f"eigenvalues were moved left of -{settings.linear.margin:g} 1/s{where}; residuals of the "
        f"linear fit change by {growth}",
    )


def _fit_outputs(samples: Samples, settings: FitSettings) -> LinearFit | None:
    if not settings.outputs:
        return None
    return _linear(samples, samples.output_inputs, samples.outputs, settings)


def _slopes(samples: Samples, fit: LinearFit) -> Array:
    """Slopes of the terms in the states at the mean inputs of every schedule point."""
    terms, n = samples.terms, samples.inputs.shape[1]
    if terms is None:
        return np.zeros((len(fit.equations), 0, len(samples.signals.states)))
    middles = np.stack([e.moments(centred=True)[0][:n] for e in fit.equations])
    return terms.slopes(middles)[:, :, samples.signals.state_columns]


def _linear(
    samples: Samples,
    inputs: Array,
    targets: Array,
    settings: FitSettings,
    known: Mapping[tuple[int, int], float] | None = None,
) -> LinearFit:
    names = samples.linear_names
    names += ["cos(blades ψ)", "sin(blades ψ)"][: inputs.shape[1] - len(names)]
    windows = None
    if isinstance(settings.linear, LPV):
        if settings.linear.schedule not in names:
            raise DfsmError(
                f"linear.schedule '{settings.linear.schedule}' is not an input of the model: "
                f"choose one of {', '.join(names)}"
            )
        column = names.index(settings.linear.schedule)
        windows = schedule_windows(inputs[:, column], settings.linear.points)
    return fit_linear(samples.blocks(inputs, targets), names, settings.linear, windows, known)


# -- nonlinear-only, for comparison --------------------------------------------------------------


def _fit_nonlinear(samples: Samples, region: Region, settings: FitSettings) -> DFSM:
    """f̂_NL: the same corrective function for every row, and nothing linear under it."""

    def part(inputs: Array, targets: Array) -> tuple[LinearModel, Corrective | None]:
        mean = targets.mean(axis=0)
        trained = fit_corrective(
            inputs, targets - mean, samples.runs, settings.corrective, settings.seed
        )
        if trained is None:
            raise ValueError("nothing to fit")
        zero = jnp.zeros((1, targets.shape[1], inputs.shape[1]))
        return LinearModel(jnp.zeros(1), zero, jnp.asarray(mean)[None], None), trained.function

    f, e = part(samples.inputs, samples.derivatives)
    inputs = samples.without_terms(samples.output_inputs)
    g, e_g = part(inputs, samples.outputs) if settings.outputs else (None, None)
    return DFSM(
        f=f,
        e=e,
        g=g,
        e_g=e_g,
        region=region,
        corrected=tuple(range(samples.derivatives.shape[1])),
        corrected_outputs=tuple(range(samples.outputs.shape[1])),
        signals=samples.signals,
    )


def _check(
    model: DFSM, samples: Samples, data: Dataset, settings: FitSettings
) -> tuple[list[str], list[str]]:
    """Look for what would surprise a user: non-finite values, instability, leaking disturbances.

    Eigenvalues tell stability with the schedule frozen, pairs of rollouts along recorded paths.
    """
    notes = data_warnings(data, settings, samples)
    x, u, w, p = model.split(samples.inputs)
    values = np.concatenate([model.derivative(x, u, w, p), model.output(x, u, w, p)], axis=1)
    if not np.isfinite(values).all():
        raise DfsmError(
            "the fitted model is not finite on its own training samples: fewer "
            "corrective.samples, or another corrective.kind, may cure it"
        )
    unstable = [(s, v.real.max()) for s, v in model.eigenvalues() if v.real.max() > 0]
    if unstable:
        points = ", ".join(f"{s:.4g}" for s, _ in unstable)
        where = f"{model.schedule} = {points}" if model.schedule else "its only point"
        notes.append(
            f"the linear fit is unstable at {where} (fastest growth "
            f"{max(v for _, v in unstable):.3g} 1/s): right for an unstable system; for any "
            "other set linear.margin, or expect rollouts to drift off"
        )
    some = [data[i] for i in np.unique(np.linspace(0, len(data) - 1, _CHECK_RUNS).astype(int))]
    with hushed():
        rollouts = simulate(model, some, start=settings.start, stop=settings.stop)
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
    return notes, checks


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


def _told(settings: FitSettings) -> list[dict[str, Any]]:
    """Settings of the terms as far as text and numbers can tell them; tables stay in the model."""
    plain = (str, int, float, tuple, type(None))
    return [
        {
            f.name: v if isinstance(v, plain) else str(getattr(v, "__name__", v))
            for f in fields(term)
            if not isinstance(v := getattr(term, f.name), RotorTable)
        }
        for term in settings.terms
    ]


def _record(
    data: Dataset,
    settings: FitSettings,
    f: LinearFit,
    decisions: list[dict[str, Any]],
    notes: list[str],
    checks: list[str],
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    return {
        "settings": {**asdict(replace(settings, terms=())), "terms": _told(settings)},
        "channels": [c.name for c in data[0].channels if not c.computed],
        "data": [
            {"name": r.name, "samples": len(r), "sha256": r.digest, "seconds": r.duration}
            for r in data
        ],
        "rows": decisions,
        "condition": f.condition,
        "schedule_windows": f.windows.tolist(),
        "window_samples": f.samples.tolist(),
        "checks": checks,
        "warnings": notes,
        "versions": {name: version(name) for name in ("dfsm", "jax", "numpy", "scipy")},
        "seconds": dict(seconds),
    }


@contextmanager
def _timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    begin = clock.perf_counter()
    yield
    seconds[step] = clock.perf_counter() - begin
