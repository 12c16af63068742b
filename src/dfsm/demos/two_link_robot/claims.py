"""What the paper claims about the two-link robot, the same figures here, and whether it holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dfsm.core.types import Array
from dfsm.demos.two_link_robot.assess import Assessed
from dfsm.demos.two_link_robot.multi_fidelity import LINEAR, MULTI, NONLINEAR, MultiFidelity
from dfsm.demos.two_link_robot.study import RobotStudy
from dfsm.report.article import Section, Table, cell_text

# Two RMSE closer than this are the same: twenty runs tell no finer.
_ALIKE = 0.05


def claims_section(study: RobotStudy) -> Section:
    """Claim by claim."""
    m = study.multi_fidelity
    rows = (
        _claim_extraction(study),
        *_claims_linear(study),
        _claim_correction(m),
        _claim_accuracy(m),
        _claim_speed(m),
    )
    table = Table(
        "claims",
        "The paper's claims on the two-link robot",
        ("Claim", "Paper", "Here", "Holds"),
        rows,
    )
    about = (
        "Two robot arms whose equations are known, so that every error is known too. The arm "
        "with gravity is the paper's; it is a double pendulum and chaotic. The arm in a "
        "horizontal plane can be predicted for seconds and serves for long rollouts. Models see "
        "simulations only. Sections, figures and claims are those of Sundarrajan and Herber "
        "(IMECE 2023)."
    )
    return Section("claims", "Do the paper's claims hold?", (about,), (table,))


def verdict(claims: Section) -> str:
    """How many of the claims hold, in part, or not."""
    told = [str(row[-1]) for row in claims.tables[0].rows]
    yes, no = (sum(t.startswith(word) for t in told) for word in ("yes", "no"))
    return (
        f"Of {len(told)} claims of the paper {yes} hold, {len(told) - yes - no} hold in part and "
        f"{no} do not."
    )


def _claim_extraction(study: RobotStudy) -> tuple[str, ...]:
    mean = study.extraction.mean
    return (
        "A cubic spline gives accurate state derivatives (3.3)",
        "mean error of the order 10⁻⁷",
        f"{cell_text(mean, 2)}, set by the simulator's tolerance and not by the spline",
        "yes" if 5e-8 < mean < 1e-6 else "no",
    )


def _claims_linear(study: RobotStudy) -> list[tuple[str, ...]]:
    t = study.taylor
    finest = t.fits[-1]
    agrees = t.distance(t.stationary)[-1] < 5e-4
    linear = [d for d in t.decisions if not d["corrected"]]
    return [
        (
            "The linear fit approximates the Taylor expansion (3.8.1)",
            "poles ±5.2160, ±2.6533",
            f"poles {_signed(finest.poles)} for δ → 0: those at the stationary point with the "
            "torques that hold the arm there. The paper's are those with no torque",
            "yes, with the right poles" if agrees else "no",
        ),
        (
            "Two of the four rows are linear and need no correction (3.8.1)",
            "ξ̇1 and ξ̇3",
            f"{len(linear)} rows, residual at most {_largest_share(linear)} of the signal",
            "yes" if len(linear) == 2 else "no",
        ),
        (
            "A linear fit is cheap (3.8.1)",
            "0.0068 s for nearly a million samples",
            f"{cell_text(t.seconds, 2)} s for {t.samples:,} samples".replace(",", " "),
            "yes" if t.seconds < 1e-6 * t.samples else "no",
        ),
    ]


def _signed(poles: Array) -> str:
    return ", ".join(f"{p:+.4f}" for p in poles).replace("-", "−")


def _largest_share(decisions: Sequence[dict[str, Any]]) -> str:
    return cell_text(max((d["residual_rms"] / d["std"] for d in decisions), default=np.nan), 1)


def _claim_correction(m: MultiFidelity) -> tuple[str, ...]:
    linear, multi = m.assessed[LINEAR].slopes[:2], m.assessed[MULTI].slopes[:2]
    factors = [cell_text(float(f), 2) for f in linear / multi]
    return (
        "The corrective function reduces the derivative error significantly (3.8.2)",
        "Fig. 4",
        f"RMSE of ω̇1 and ω̇2 falls by factors of {' and '.join(factors)} with the paper's recipe",
        "yes" if (linear / multi).min() > 2 else "a little",
    )


def _claim_accuracy(m: MultiFidelity) -> tuple[str, ...]:
    ratios = [
        _overall(b) / _overall(a)
        for a, b in zip(m.sweep.assessed[MULTI], m.sweep.assessed[NONLINEAR], strict=True)
    ]
    good = [r >= 1 - _ALIKE for r in ratios]
    each = ", ".join(
        f"{cell_text(r, 2)} (n_s = {n})" for n, r in zip(m.sweep.samples, ratios, strict=True)
    )
    return (
        "Rollouts of multi-fidelity models are more accurate than nonlinear-only ones (3.8.2)",
        "Figs. 5 and 6, n_s = 500",
        f"RMSE over all states, nonlinear-only over multi-fidelity: {each}",
        "yes" if all(good) else ("in part" if any(good) else "no"),
    )


def _overall(a: Assessed) -> float:
    return float(np.sqrt(np.mean(a.rollouts.rmse**2)))


def _claim_speed(m: MultiFidelity) -> tuple[str, ...]:
    ratio = float(np.mean(m.sweep.speed_ups))
    return (
        "Multi-fidelity is faster to build, having fewer rows to correct (3.8.2)",
        "2 times, average over n_s",
        f"{cell_text(ratio, 2)} times: all rows share one subsample and one set of units, so a row "
        "more costs next to nothing",
        "yes" if ratio > 1.5 else "no",
    )
