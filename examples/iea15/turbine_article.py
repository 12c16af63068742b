"""The optimal control study of the floating turbine, told: results, trends, a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from dfsm.report.article import (
    Article,
    Curve,
    Figure,
    Panel,
    Section,
    Table,
    cell_text,
    listed,
)
from dfsm.report.control_figures import stacked_figure
from turbine_control import ControlStudy, Result
from turbine_problem import (
    BEST_COEFFICIENT,
    BLADE,
    MOMENT,
    PITCH,
    SHEAR,
    SPEED,
    TORQUE,
    WIND,
    mean_power,
    wind_power,
)

KEY = "turbine_control"
# Relative differences below this count as none.
_SAME = 3e-4
# m/s around 11 that count as near.
_NEAR = 1.0
_POWER = "power (MW)"
_FIGURE = (WIND, TORQUE, BLADE, PITCH, SPEED, _POWER, SHEAR, MOMENT)
_HEADS = (
    "case",
    "Θp,max (deg)",
    "power (MW)",
    "max Θp (deg)",
    "ω (rpm)",
    "mean ω",
    "mean β (deg)",
    "dβ/dt (deg/s)",
    "outside (%)",
    "ended",
    "steps",
    "time (s)",
    "replay (deg)",
)
# Share of the power below which a limit of the platform pitch is said to cost nothing.
_LEAST_COST = 5e-4
CLAIMS = (
    "Θp peaks near w = 11 m/s",
    "lower Θp,max: β more active",
    "ω lower",
    "power lower",
    "power ≤ available",
)


def control_article(study: ControlStudy) -> Article:
    """Put the findings of the study into sections, tables and figures.

    Parameters
    ----------
    study
        From `turbine_control.study`.
    """
    groups: dict[str, list[Result]] = {}
    for r in study.results:
        groups.setdefault(r.series, []).append(r)
    return Article(
        key=KEY,
        title="Optimal control of a floating 15 MW turbine",
        lede=(
            "The most power of a surrogate under a limit Θp,max on the platform pitch, with the "
            "wind known over the horizon."
        ),
        sections=(
            answer_section(study),
            asked_section(study),
            trends_section(study),
            *[_series_section(name, results) for name, results in groups.items()],
        ),
    )


# -- the answer ---------------------------------------------------------------------------------


def _beyond_the_wind(study: ControlStudy) -> list[str]:
    """Series whose model has more power than their wind holds, with both powers."""
    told = []
    for (name, key), by_limit in study.series().items():
        solved = [r for r in by_limit.values() if r.solution.solved]
        if not solved:
            continue
        most, available = _most(solved)
        if most > available:
            told.append(f"case {key} of {_short(name)}, {most:.1f} of {available:.1f} MW")
    return told


def answer_section(study: ControlStudy) -> Section:
    """How many problems were solved, and the power at every limit of the platform pitch."""
    solved = [r for r in study.results if r.solution.solved]
    verdict = f"{len(solved)} of {len(study.results)} problems were solved."
    caption = "Mean electrical power of the optimum over the limit of the platform pitch"
    if beyond := _beyond_the_wind(study):
        caption += f"; not to be believed, for the wind holds less: {'; '.join(beyond)}"
    curves: dict[str, list[Curve]] = {}
    for (name, key), by_limit in study.series().items():
        limits, power = _solved(by_limit)
        if not limits:
            continue
        panel = curves.setdefault(key, [])
        panel.append(Curve(_short(name), np.array(limits), np.array(power), len(panel) + 1))
    most = 1.1 * max((r.power for r in solved), default=1.0)
    figure = Figure(
        "control_power",
        caption,
        tuple(
            Panel(f"case {key}", "Θp,max (deg)", "power (MW)", tuple(of), y_range=(0.0, most))
            for key, of in curves.items()
        ),
    )
    figures = (figure,) if curves else ()
    return Section("answer", "What it costs to keep the platform upright", (verdict,), (), figures)


def asked_section(study: ControlStudy) -> Section:
    """What was asked, and what the lowest limit costs in every wind series."""
    sentences = [
        "Torque and blade pitch maximise the power: the study of Sundarrajan and Herber (IMECE "
        "2023, Sec. 4) on other runs of the same turbine. Case a has the paper's bounds and a "
        "model fitted as in the paper; case b has the bounds of the turbine that was simulated, "
        "one model for all winds with the rotor's table inside, and stays where its training data "
        "lie."
    ]
    for (name, key), by_limit in study.series().items():
        limits, power = _solved(by_limit)
        if key == "b" and len(limits) > 1:
            cost = 1 - power[0] / power[-1]
            told = f"{cost:.1%} less" if cost >= _LEAST_COST else "as much"
            sentences.append(
                f"{_short(name)}: {power[-1]:.2f} MW with Θp,max = {limits[-1]:g} deg, and {told} "
                f"with {limits[0]:g} deg."
            )
    return Section("asked", "What was asked, and what it came to", tuple(sentences))


def _solved(by_limit: Mapping[float, Result]) -> tuple[list[float], list[float]]:
    """Limits in deg, lowest first, and powers in MW of the problems that were solved."""
    kept = [by_limit[limit] for limit in sorted(by_limit) if by_limit[limit].solution.solved]
    return [r.most_pitch for r in kept], [r.power for r in kept]


# -- trends -------------------------------------------------------------------------------------


def trends_section(study: ControlStudy) -> Section:
    """What the paper leads one to expect, checked series by series."""
    rows = [
        (f"{_short(name)}, {key}", *trends(by_limit).values())
        for (name, key), by_limit in study.series().items()
    ]
    table = Table(
        "control_trends",
        "Trends over Θp,max in every wind series and case",
        ("wind series, case", *CLAIMS),
        tuple(rows),
        note=(
            "Θp peaks: mean wind while Θp is among its highest 5 %, with the highest Θp,max; near "
            "is within 1 m/s. β: its mean; its rate stands in the tables below. No change: "
            "the optimum does not depend on Θp,max. Power: electrical. Available: mean of c ρ/2 π "
            "R² w³ with the mean wind w over the disk and the best known power coefficient c, "
            f"{BEST_COEFFICIENT} in steady wind or what a training run of the region took, if that "
            "is more: the disk's mean leaves out the turbulence within the disk."
        ),
    )
    gains = Table(
        "control_gains",
        "How the rotor speed of each model settles when a control rises for good, at the mean wind "
        "of the region",
        (
            "region, model",
            "torque (rpm per MN m)",
            "blade pitch (rpm per deg)",
            "signs of a turbine",
        ),
        tuple((name, *gain, _word(max(gain) <= 0)) for name, gain in study.gains.items()),
        note=(
            "Neither is positive for a turbine, and at its best power coefficient blade pitch does "
            "nothing. Where one is, the model has learnt the controller, which raises both when "
            "the rotor is fast; an optimizer makes use of that."
        ),
        digits=2,
    )
    return Section("trends", "Do the trends hold?", tables=(table, gains))


def trends(by_limit: Mapping[float, Result]) -> dict[str, str]:
    """Say of every claim whether it holds, and the figures that say so.

    Parameters
    ----------
    by_limit
        Results of one wind series and case by Θ_p,max.
    """
    solved = [by_limit[limit] for limit in sorted(by_limit) if by_limit[limit].solution.solved]
    if not solved:
        return dict.fromkeys(CLAIMS, "not solved")
    top = solved[-1]
    near = abs(top.peak_wind - 11) <= _NEAR
    told = (
        f"{_word(near)}: {top.peak_wind:.1f} m/s",
        _rising([-r.blade_mean for r in solved]),
        _rising([r.mean_speed for r in solved]),
        _rising([r.power for r in solved]),
        _powers(solved),
    )
    return dict(zip(CLAIMS, told, strict=True))


def _powers(solved: Sequence[Result]) -> str:
    """The highest power and what the wind holds."""
    most, available = _most(solved)
    return f"{_word(most <= available)}: {most:.2f} of {available:.2f} MW"


def _most(solved: Sequence[Result]) -> tuple[float, float]:
    """The highest power of a series, and what its wind holds, in MW."""
    return max(r.power for r in solved), solved[0].available


def _rising(values: Sequence[float]) -> str:
    """Whether values never fall and rise overall; equal ones are told apart."""
    size = _SAME * max(map(abs, values))
    if max(values) - min(values) <= size:
        return "no change"
    return _word(all(after >= before - size for before, after in pairwise(values)))


def _word(holds: bool) -> str:
    return "yes" if holds else "no"


# -- one wind series ----------------------------------------------------------------------------


def _series_section(name: str, results: Sequence[Result]) -> Section:
    first = results[0]
    own = next(r.case for r in results if r.case.key == "b")
    loads = listed([f"|{n}| ≤ {own.bounds[n][1]:.0f}" for n in (SHEAR, MOMENT)])
    table = Table(
        f"control_{_short(name)}",
        f"Optimal controls for the wind of {name}",
        _HEADS,
        tuple(_cells(r) for r in results),
        note=(
            "Power: mean of η τ ω. dβ/dt: RMS. Outside: share of the horizon with an input beyond "
            "its training range, or a combination that did not occur there. Steps: of the solver; "
            "time: with compilation; case b from the optimum on fewer nodes, not counted. Replay: "
            "how far Θp is off at most when an adaptive integrator applies the controls with all "
            "samples of the wind. "
            "Where an optimum keeps a tighter Θp,max by itself, or the solver found none within a "
            "wider one that it does not come to, it stands there, too. "
            f"Recorded in closed loop: {cell_text(mean_power(first.recorded))} MW of mechanical "
            f"power; available to a rotor at its best: {cell_text(first.available)} MW, a power "
            f"coefficient of {cell_text(first.available / wind_power(first.recorded))}. "
            f"Case b: {loads} (kN, kN m)."
        ),
        digits=4,
    )
    return Section(
        _short(name),
        f"{first.region}: {name}",
        paragraphs=tuple(_diagnoses(results)),
        tables=(table,),
        figures=tuple(
            _figure(name, [r for r in results if r.case.key == key])
            for key in dict.fromkeys(r.case.key for r in results)
            if key != "a" or first.region == "12 m/s"
        ),
    )


def _short(name: str) -> str:
    return name.replace("iea15_2dof_", "")


def _cells(r: Result) -> tuple[str | float | None, ...]:
    run, solution = r.run, r.solution
    speed = run[SPEED]
    return (
        r.case.key,
        f"{r.most_pitch:g}",
        r.power if solution.solved else None,
        float(run[PITCH].max()),
        f"{speed.min():.2f} to {speed.max():.2f}",
        r.mean_speed,
        r.blade_mean,
        r.blade_activity,
        100 * (solution.outside or 0.0),
        solution.ending.name.lower().replace("_", " "),
        solution.iterations,
        sum(solution.seconds.values()),
        r.replay,
    )


def _diagnoses(results: Sequence[Result]) -> list[str]:
    """Where a problem has no solution, or leaves the training range."""
    told = []
    for key in dict.fromkeys(r.case.key for r in results):
        alike = [r for r in results if r.case.key == key]
        for r in alike:
            if not r.solution.solved:
                told.append(f"Case {key}, Θp,max = {r.most_pitch:g} deg: {r.solution.message}.")
        shares: dict[str, list[float]] = {}
        for r in alike:
            for name, share in r.outside.items():
                shares.setdefault(name, []).append(100 * share)
        left = [
            f"{name} at {max(values):.0f} % of the nodes"
            for name, values in sorted(shares.items(), key=lambda item: -max(item[1]))
            if max(values) >= 1
        ]
        if left:
            told.append(f"Case {key} leaves the training range in {listed(left)} (the most).")
    return told


def _figure(name: str, results: Sequence[Result]) -> Figure:
    key = results[0].case.key
    return stacked_figure(
        f"control_{_short(name)}_{key}",
        f"Case {key}, wind of {name}: wind, controls, states, power and tower-base loads for "
        "every Θp,max. Dashed: bounds; those of the platform pitch in the colour of their case.",
        {f"Θp,max = {r.most_pitch:g} deg": r.solution for r in results},
        _FIGURE,
        {_POWER: {f"Θp,max = {r.most_pitch:g} deg": r.power_course for r in results}},
    )
