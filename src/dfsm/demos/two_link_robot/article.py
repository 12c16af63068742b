"""The two-link robot study, told: its figures beside those of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dfsm.demos.two_link_robot import figures
from dfsm.demos.two_link_robot.assess import Assessed
from dfsm.demos.two_link_robot.claims import claims_section, verdict
from dfsm.demos.two_link_robot.defaults import PEER, PEER_SECONDS, Fitted
from dfsm.demos.two_link_robot.extraction import Extraction
from dfsm.demos.two_link_robot.multi_fidelity import MULTI, NONLINEAR, Chaos, MultiFidelity
from dfsm.demos.two_link_robot.study import RobotStudy
from dfsm.demos.two_link_robot.taylor import TaylorComparison
from dfsm.report.article import Article, Section, Table, cell_text, listed

KEY = "two_link_robot"
HORIZONTAL, GRAVITY = ("ω1", "ω2", "θ2", "θ1"), ("θ1", "θ̇1", "θ2", "θ̇2")
HORIZONTAL_RATES, GRAVITY_RATES = ("ω̇1", "ω̇2", "θ̇2", "θ̇1"), ("θ̇1", "θ̈1", "θ̇2", "θ̈2")


def robot_article(study: RobotStudy) -> Article:
    """Put the findings of the study into sections, tables and figures.

    Parameters
    ----------
    study
        From `dfsm.demos.two_link_robot.study.study`.
    """
    claims = claims_section(study)
    return Article(
        key=KEY,
        title="Two-link robots: the paper's study, and beyond",
        lede=verdict(claims),
        sections=(
            Section(
                "rollouts",
                "One run, by every model",
                figures=(figures.rollouts(study.multi_fidelity),),
            ),
            claims,
            extraction_section(study.extraction),
            taylor_section(study.taylor),
            multi_fidelity_section(study.multi_fidelity),
            *([_chaos(study.multi_fidelity.chaos)] if study.multi_fidelity.chaos else []),
            beyond_section(study.kinds, study.multi_fidelity.assessed[MULTI]),
        ),
    )


def extraction_section(e: Extraction) -> Section:
    """Sec. 3.3 and Fig. 1."""
    at, between = e.refinement.orders
    each = [
        f"{n} {cell_text(v, 2)}" for n, v in zip(GRAVITY_RATES, e.of_states.tolist(), strict=True)
    ]
    durations = Table(
        "extraction",
        "Mean absolute error of extracted derivatives by length of the simulations and tolerance "
        "of the simulator",
        ("Duration (s)", "tolerance 10⁻⁹", "tolerance 10⁻¹²"),
        e.durations,
        note=(
            f"{e.points} samples per simulation whatever its length. Within half a second the arm "
            "stays near its stationary point; after some seconds it whirls, with accelerations of "
            "thousands of rad/s², and the samples are too few."
        ),
    )
    orders = Table(
        "orders",
        "Order of the spline's own error in the sampling step",
        ("Where", "expected", "measured"),
        (
            ("interior samples", 4.0, at),
            ("a quarter of the way between samples", 3.0, between),
        ),
        digits=2,
    )
    return Section(
        "extraction",
        "Derivatives from splines (Sec. 3.3, Fig. 1)",
        paragraphs=(
            f"{e.runs} simulations of the arm with gravity from random states and with random "
            f"torques near its stationary point, {e.points} samples over 0.3 s each. Mean absolute "
            f"error of the derivative of a cubic spline: {cell_text(e.mean, 2)} ("
            f"{listed(each)}, in rad/s and rad/s²). A tighter tolerance of the "
            "simulator lowers it; more samples do not.",
        ),
        tables=(durations, orders),
        figures=(figures.extraction(e),),
    )


def taylor_section(t: TaylorComparison) -> Section:
    """Sec. 3.8.1, Figs. 2 and 3."""
    poles = Table(
        "poles",
        "Eigenvalues of the linear fit (1/s) as simulations stay closer to the stationary point",
        ("Model", "1", "2", "3", "4", "without offset: largest error"),
        (
            *[
                (f"linear fit, δ = {f.delta:g}", *f.poles.tolist(), float(error))
                for f, error in zip(t.fits, t.distance(t.stationary, False), strict=True)
            ],
            ("Taylor, at rest with the torques that hold the arm", *t.stationary.tolist(), None),
            ("Taylor, same states without torques: the paper's", *t.unforced.tolist(), None),
        ),
        digits=5,
        note=(
            "The last column is the paper's formula L·I, without a constant term: away from the "
            "origin it does not converge to the poles, however small δ. The regression here is "
            "affine by default."
        ),
    )
    rows = Table(
        "gate",
        f"What the fit decides for each row at δ = {t.fits[0].delta:g}",
        ("Row", "residual RMS / signal", "decision"),
        tuple(
            (n, d["residual_rms"] / d["std"], _decision(d))
            for n, d in zip(GRAVITY_RATES, t.decisions, strict=True)
        ),
        digits=2,
    )
    return Section(
        "taylor",
        "Linear fit against Taylor expansion (Sec. 3.8.1, Figs. 2 and 3)",
        paragraphs=(
            "Simulations of 0.3 s that start within δ of the stationary point, with torques within "
            "δ of those that hold the arm there. As δ shrinks, the eigenvalues of the fit go to "
            "the poles of the Taylor expansion at that point.",
        ),
        tables=(poles, rows),
        figures=(figures.linear_rows(t), figures.poles(t)),
    )


def _decision(row: dict[str, Any]) -> str:
    return "corrected" if row["corrected"] else "linear fit alone"


def multi_fidelity_section(m: MultiFidelity) -> Section:
    """Sec. 3.8.2, Figs. 4 to 6."""
    accuracy = Table(
        "recipe",
        "The paper's recipe on the arm without gravity: RMSE over twenty test runs of 3 s",
        ("Model", "build (s)", *HORIZONTAL_RATES, *HORIZONTAL),
        tuple(
            (name, a.seconds, *a.slopes.tolist(), *a.rollouts.rmse.tolist())
            for name, a in (m.assessed | {f"MF, {n}": a for n, a in m.changed.items()}).items()
        ),
        note=(
            "Derivatives along the recorded runs, against the true ones; states along the model's "
            "own rollout. MF: multi-fidelity with a part of the recipe changed."
        ),
    )
    sweep = Table(
        "sweep",
        "Build times and RMSE of rollouts by size of the subsample n_s",
        (
            "n_s",
            *[f"{n}: build (s)" for n in ("MF", "NL")],
            "times faster",
            *[f"{n}: {s}" for s in HORIZONTAL for n in ("MF", "NL")],
        ),
        tuple(
            (n, a.seconds, b.seconds, float(r), *_pairs(a, b))
            for n, a, b, r in zip(
                m.sweep.samples,
                m.sweep.assessed[MULTI],
                m.sweep.assessed[NONLINEAR],
                m.sweep.speed_ups,
                strict=True,
            )
        ),
        note="MF: multi-fidelity, NL: nonlinear-only.",
        digits=2,
    )
    return Section(
        "multi-fidelity",
        "Multi-fidelity against nonlinear-only (Sec. 3.8.2, Figs. 4 and 6)",
        paragraphs=(
            "A hundred simulations of 3 s from states in (−1, 1)⁴ with torques through 90 random "
            "knots in (−1, 1), 900 samples each; eighty train, twenty test. The paper's recipe: "
            "k-means, mean residual of each cluster, Gaussian units of one width.",
        ),
        tables=(accuracy, sweep),
        figures=(
            figures.corrected_rows(m),
            figures.histograms(m),
            figures.sweep(m),
        ),
    )


def _pairs(a: Assessed, b: Assessed) -> list[float]:
    return [float(x.rollouts.rmse[k]) for k in range(4) for x in (a, b)]


def _chaos(c: Chaos) -> Section:
    of_slopes, of_states = c.spread
    rows = []
    for name, a in c.assessed.items():
        short, count = c.short[name], len(c.short[name].errors)
        rows.append((f"{name}: derivative", *(a.slopes / of_slopes).tolist(), ""))
        rows.append(
            (
                f"{name}: 0.5 s",
                *(short.typical / of_states).tolist(),
                f"{short.completed} of {count}",
            )
        )
        rows.append(
            (
                f"{name}: 5 s",
                *(a.rollouts.typical / of_states).tolist(),
                f"{a.rollouts.completed} of {len(a.rollouts.errors)}",
            )
        )
    table = Table(
        "gravity",
        "RMSE over the standard deviation of the signal: derivatives along test runs, and the "
        "median rollout",
        ("Model", *GRAVITY, "rollouts completed"),
        tuple(rows),
        digits=2,
        note="– : more than half of the rollouts ended early, out of the training range.",
    )
    return Section(
        "gravity",
        "The paper's arm for 5 s",
        paragraphs=(
            "Simulations begin near the stationary point, with random torques in (−1, 1) N m; the "
            "arm falls and swings. Its motion is chaotic: two states that differ by little part "
            "exponentially, so no model follows it for 5 s, and a run that looks well shows luck. "
            "Derivatives and rollouts of half a second can be compared.",
        ),
        tables=(table,),
        figures=(figures.chaos(c),),
    )


def beyond_section(kinds: Mapping[str, Fitted], recipe: Assessed) -> Section:
    """The defaults, beside the published program and the paper's recipe."""
    rows: list[tuple[str | float | None, ...]] = [
        ("published Python program (LTI + GP)", PEER_SECONDS, *PEER, None, None, None, None)
    ]
    medians: list[tuple[str | float | None, ...]] = []
    rows.append(
        ("the paper's recipe, above", recipe.seconds, *recipe.rollouts.rmse.tolist(), *[None] * 4)
    )
    for name, f in kinds.items():
        three, five = f.short.rollouts, f.long
        rows.append((name, f.short.seconds, *three.rmse.tolist(), *five.rmse.tolist()))
        medians.append((name, *three.typical.tolist(), *five.typical.tolist(), f.detail))
    states = (*[f"{n}, 3 s" for n in HORIZONTAL], *[f"{n}, 5 s" for n in HORIZONTAL])
    accuracy = Table(
        "beyond",
        "RMSE of rollouts over all twenty test runs of 3 s, and over twenty others of 5 s",
        ("Model", "fit (s)", *states),
        tuple(rows),
        digits=2,
    )
    typical = Table(
        "typical",
        "RMSE of the median run: a few runs that meet states unlike those trained on make up most "
        "of the figures above",
        ("Model", *states, "trained"),
        tuple(medians),
        digits=2,
    )
    return Section(
        "beyond",
        "Beyond the paper: the defaults on the same simulations",
        paragraphs=(
            "The same eighty training runs, nothing tuned for this system. All rows are LTI fits "
            "with a corrective function for ω̇1 and ω̇2. Models are trained on runs of 3 s; those of "
            "5 s go further.",
        ),
        tables=(accuracy, typical),
        figures=(figures.growth(kinds),),
    )
