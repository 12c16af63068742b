"""The method, step by step: runs in, a multi-fidelity DFSM out (Sec. 3.1).

Read `fit` from top to bottom: select the channels, take derivatives, fit linearly, look at what is
left, correct where that is worth it, refine on rollouts if asked for, do the same for the outputs,
check the result.
"""

from __future__ import annotations

import time as clock
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from importlib.metadata import version
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from dfsm.core.hand_back import hand_back
from dfsm.core.host import from_host
from dfsm.core.renamed import renamed
from dfsm.core.types import Array
from dfsm.core.version import __version__
from dfsm.data.dataset import Dataset
from dfsm.data.derivatives import kinematic_rows
from dfsm.data.readers.rotor_table import RotorTable
from dfsm.data.steps import Slopes
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, DfsmWarning, hushed
from dfsm.fitting.checks import check
from dfsm.fitting.corrective import NoCorrection, fit_corrective
from dfsm.fitting.doubts import Doubts, doubts, memory_doubt
from dfsm.fitting.gate import correct, left_over, predicted
from dfsm.fitting.hidden.advice import hidden_advice
from dfsm.fitting.hidden.assembled import with_fitted
from dfsm.fitting.hidden.build import fit_hidden, require_hidden
from dfsm.fitting.known import fitted_rows, known_coefficients, wakes_of
from dfsm.fitting.linear import LPV, LinearFit, fit_linear, schedule_windows
from dfsm.fitting.over_intervals import over_intervals
from dfsm.fitting.passing import fit_passing, unexplained
from dfsm.fitting.records import held_records
from dfsm.fitting.region import region_of
from dfsm.fitting.rollout_gate import harm_in_rollouts
from dfsm.fitting.rollout_samples import along_rollouts, with_latents
from dfsm.fitting.rough_inputs import inputs_told
from dfsm.fitting.samples import Samples, extract, select
from dfsm.fitting.schedule_gaps import schedule_gaps
from dfsm.fitting.settings import FitSettings
from dfsm.fitting.stabilize import stabilise
from dfsm.models.corrective import Corrective
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region
from dfsm.models.signals import Provenance
from dfsm.models.stability import destabilised
from dfsm.models.wakes import with_wakes
from dfsm.numerics.time_mesh import mean_over, std_over
from dfsm.refinement.refine import refine
from dfsm.refinement.settings import RefineSettings


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
    hidden = settings.hidden
    if hidden is not None:
        require_hidden(settings, refinement is not None)
    with _timed(seconds, "select"):
        data = select(runs, settings)
    with _timed(seconds, "derivatives"):
        samples = extract(data, settings)
    with _timed(seconds, "linear fit"):
        rows, samples = over_intervals(samples, lambda rows: _fit_slopes(rows, settings))
        f = _fit_derivatives(rows, settings)
    with _timed(seconds, "doubts"):
        fitted = fitted_rows(rows, settings)
        left = left_over(f.model, rows, rows.linear_inputs, rows.derivatives, fitted)
        held = held_records(data, settings, samples)
        doubt = doubts(rows, f, left, settings, held, intervals=rows is not samples)
        del left
    with _timed(seconds, "corrective functions"):
        later = hidden is not None or (refinement is not None and refinement.network > 0)
        e = correct(rows, rows.linear_inputs, rows.derivatives, f, settings, later)
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
    if wakes := wakes_of(settings.terms):
        model = with_wakes(model, wakes, samples.inputs)
        recorded = seen = with_latents(model, data, samples, settings)
    if model.e is not None:
        with _timed(seconds, "rollouts with and without correction"):
            harm = harm_in_rollouts(model, data, recorded, settings)
        if harm:
            model, e = replace(model, e=None, corrected=()), e.withdrawn(harm)
    discarded: list[str] = []
    learned: list[str] = []
    if hidden is not None:
        with _timed(seconds, "hidden states"):
            found = fit_hidden(model, data, settings, hidden)
            model, doubt = found.model, replace(doubt, notes=tuple(found.notes), outdated=True)
            learned = found.checks
            recorded = with_latents(model, data, samples, settings)
            seen = along_rollouts(model, data, recorded, settings)
    if refinement is not None:
        with _timed(seconds, "refinement"):
            window = {"start": settings.start, "stop": settings.stop}
            with hushed():  # told with the other warnings
                refined = refine(model, data, refinement, **window, seed=settings.seed)
            model = refined.model
            if refined.improved:
                doubt = replace(doubt, notes=(), outdated=True)
                learned = memory_doubt(model)
            else:
                discarded.append(refined.message)
                account = {"message": refined.message, "improved": False}
                model = replace(model, provenance=Provenance({"refinement": account}))
            recorded = with_latents(model, data, samples, settings)
            seen = along_rollouts(model, data, recorded, settings)
    with _timed(seconds, "outputs"):
        g = _fit_outputs(seen, settings)
        e_g = correct(seen, seen.output_inputs, seen.outputs, g, settings) if g else None
    model = replace(
        model,
        g=with_fitted(model.g, g.model if g else None),
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
        notes, checks, judged = check(model, recorded, data, settings, doubt)
        notes += more
        if hidden is None and refinement is None:
            notes += hidden_advice(e.decisions, data, settings, doubt)
    gaps = schedule_gaps(samples, f.model)
    known = (*f.warnings, *gaps, *(g.warnings if g else ()), *doubt.notes, *notes)
    notes = list(dict.fromkeys(known))
    checks = [*inputs_told(samples, settings), *f.notes, *learned, *checks]
    nonlinear = None
    if (
        settings.nonlinear_only
        and hidden is None
        and not isinstance(settings.corrective, NoCorrection)
    ):
        with _timed(seconds, "nonlinear-only"):
            nonlinear = _fit_nonlinear(samples, rows, region, settings)
            if nonlinear.signals.field:
                nonlinear, *_ = fit_passing(nonlinear, samples, data)
    outputs = e_g.decisions if e_g else []
    for row, account in zip(outputs, passing, strict=False):
        row["passing"] = account["explained"]
        row["decision"] += f"; {account['text']}"
    decisions = [*_with_coefficients(e.decisions, samples, f, doubt), *outputs]
    record = dict(model.provenance.record) | _record(
        data, settings, f, decisions, notes, checks, seconds
    )
    record |= judged
    for text in (*discarded, *notes):
        warnings.warn(text, DfsmWarning, stacklevel=2)
    model = replace(model, provenance=Provenance(record))
    if nonlinear is not None:
        nonlinear = replace(nonlinear, provenance=Provenance(record))
    return FitResult(model, nonlinear, seconds)


# -- linear fit (Sec. 3.4) ----------------------------------------------------------------------


def _fit_derivatives(samples: Samples, settings: FitSettings) -> LinearFit:
    """Linear fit of ξ̇; kinematic rows d q = q̇ are written down, not fitted."""
    kinematic, fitted = kinematic_rows(settings.states), fitted_rows(samples, settings)
    known = known_coefficients(samples, settings, fitted)
    inputs, first = samples.linear_inputs, {**known.first, **known.fixed}
    result = _linear(samples, inputs, samples.derivatives, settings, fitted, first)
    result = replace(result, model=replace(result.model, known=tuple(known.fixed)))
    columns = samples.signals.state_columns
    if settings.linear.margin is not None:
        before = result.residual_rms
        slopes = _slopes(samples, result)
        result, moved = stabilise(
            result, columns, kinematic, settings.linear.margin, settings.linear.affine, slopes
        )
        names = [samples.derivative_names[i][0] for i in fitted]
        account = _account(settings, moved, names, before, result.residual_rms)
        result = replace(result, notes=account, moved=tuple(moved))
    points, _, n_inputs = result.model.coefficients.shape
    L = np.zeros((points, samples.derivatives.shape[1], n_inputs))
    b = np.zeros(L.shape[:2])
    L[:, fitted], b[:, fitted] = result.model.coefficients, result.model.offsets
    b[:, [fitted[row] for row in known.balances]] = 0.0
    rms, std = np.zeros(L.shape[1]), std_over(samples.derivatives, samples.weights)
    rms[fitted] = result.residual_rms
    for row, rate in kinematic.items():
        L[:, row, columns.start + rate] = 1.0
    model = LinearModel(
        result.model.grid,
        from_host(L),
        from_host(b),
        result.model.schedule,
        tuple((fitted[row], column) for row, column in result.model.known),
    )
    return replace(result, model=model, residual_rms=rms, target_std=std)


def _fit_slopes(rows: Samples, settings: FitSettings) -> Slopes:
    """The linear fit of ξ̇ alone, as a function of I."""
    model = _fit_derivatives(rows, settings).model
    return lambda inputs: predicted(model, replace(rows, inputs=inputs).linear_inputs)


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
    every = range(len(settings.outputs))
    return _linear(samples, samples.output_inputs, samples.outputs, settings, every)


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
    rows: Sequence[int],
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
        windows = schedule_windows(inputs[:, column], settings.linear.points, samples.weights)
    blocks = samples.weighted_blocks(inputs, targets, rows)
    return fit_linear(blocks, names, settings.linear, windows, known)


# -- nonlinear-only, for comparison --------------------------------------------------------------


def _fit_nonlinear(samples: Samples, rows: Samples, region: Region, settings: FitSettings) -> DFSM:
    """f̂_NL: the same corrective function for every row, and nothing linear under it."""

    def part(of: Samples, inputs: Array, targets: Array) -> tuple[LinearModel, Corrective | None]:
        mean = mean_over(targets, of.weights)
        trained = fit_corrective(
            inputs, targets - mean, of.runs, settings.corrective, settings.seed, of.weights
        )
        if trained is None:
            raise ValueError("nothing to fit")
        zero = np.zeros((1, targets.shape[1], inputs.shape[1]))
        grid, L, b = map(from_host, (np.zeros(1), zero, mean[None]))
        return LinearModel(grid, L, b, None), trained.function

    f, e = part(rows, rows.inputs, rows.derivatives)
    inputs = samples.without_terms(samples.output_inputs)
    g, e_g = part(samples, inputs, samples.outputs) if settings.outputs else (None, None)
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


def _with_coefficients(
    decisions: list[dict[str, Any]], samples: Samples, f: LinearFit, doubt: Doubts
) -> list[dict[str, Any]]:
    """The decisions on derivatives with the linear fit's mean coefficients and their errors."""
    if doubt.outdated:
        return decisions
    names = samples.linear_names
    return [
        d
        if np.isnan(errors).all()
        else d
        | {
            "coefficients": [
                (name, float(value), float(error) if np.isfinite(error) else None)
                for name, value, error in zip(names, row, errors, strict=True)
            ]
        }
        for d, row, errors in zip(decisions, f.mean_coefficients, doubt.errors, strict=True)
    ]


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
        "versions": {
            # Not its metadata: dfsm may lie on the path without being installed.
            "dfsm": __version__,
            **{name: version(name) for name in ("jax", "numpy", "scipy")},
        },
        "seconds": dict(seconds),
    }


@contextmanager
def _timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    begin = clock.perf_counter()
    yield
    hand_back()
    seconds[step] = clock.perf_counter() - begin
