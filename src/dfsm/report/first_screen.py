"""What a reader of the page sees first: a verdict in words, one figure, and what to mind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

from dfsm.data.trajectory import Channel
from dfsm.fitting.verdicts import TRENDS, USABLE, grade
from dfsm.report.article import listed
from dfsm.report.elements import Markup, element, join, plural
from dfsm.simulation.simulate import Status
from dfsm.validation.results import MULTI_FIDELITY, Validation

GRADES = ("usable", "for trends only", "not usable")
# More fitted models than this are counted together; more warnings are folded away.
_MOST_SENTENCES = 3
# Share of the time outside the training range above which a reader is told.
_OUTSIDE = 0.05


def main_channels(validation: Validation) -> list[Channel]:
    """Measured states and outputs: what a reader asks for first, rates left out."""
    first = next(iter(validation.models.values()))
    measured = [spec.name for spec in first.signals.specs]
    return [c for c in validation.channels if c.role != "state" or c.name in measured]


def judged(validation: Validation) -> str:
    """The model that verdicts are about: the multi-fidelity one, or else the first."""
    return MULTI_FIDELITY if MULTI_FIDELITY in validation.models else next(iter(validation.models))


def grades(validation: Validation) -> dict[str, str]:
    """Verdict on every main channel, by its mean NRMSE over the test runs.

    A channel that rests in all of them has none. Where its fit has doubts, none is usable.
    """
    model = judged(validation)
    done = validation.completed(model) == len(validation.runs)
    errors = {c.name: validation.mean_nrmse(model, c.name) for c in main_channels(validation)}
    found = {n: grade(e) for n, e in errors.items() if e is not None or not done}
    doubted = {v["name"] for v in validation.record.get("verdicts", ()) if v.get("doubt")}
    return {n: GRADES[1] if n in doubted and g == GRADES[0] else g for n, g in found.items()}


# -- words ----------------------------------------------------------------------------------------


def verdict(validations: Mapping[str, Validation]) -> Markup:
    """What the models are good for, in a sentence for each, or in one for many."""
    if len(validations) <= _MOST_SENTENCES:
        sentences = [_sentence(name, v) for name, v in validations.items()]
        return join(*[element("p", s, cls="verdict") for s in sentences])
    found = [(name, grades(v)) for name, v in validations.items()]
    every = [g for _, of in found for g in of.values()]
    counts = [f"{every.count(g)} {g}" for g in GRADES if g in every]
    best = [name for name, of in found if of and set(of.values()) == {"usable"}]
    told = f"Of {len(every)} signals of {plural(len(found), 'fitted model')}, {listed(counts)}"
    told += f"; every signal of {listed(best)} is usable." if best else "."
    return element("p", told, cls="verdict")


def _sentence(name: str, validation: Validation) -> Markup:
    model, count = judged(validation), len(validation.runs)
    done = validation.completed(model)
    found = grades(validation)
    groups = {g: [n for n, v in found.items() if v == g] for g in GRADES}
    parts = [f"{g}: {', '.join(names)}" for g, names in groups.items() if names]
    ended = f"; {done} of {plural(count, 'rollout')} completed" if done < count else ""
    return join(element("strong", name), f": {'; '.join(parts) or 'every signal rests'}{ended}.")


# -- the figure -----------------------------------------------------------------------------------


def scores(validation: Validation) -> dict[str, Any]:
    """What the verdict figure draws: mean NRMSE per variant and main channel, None without one."""
    v, names = validation, [c.name for c in main_channels(validation)]
    errors = {m: [v.mean_nrmse(m, n) for n in names] for m in v.models}
    return {
        "channels": names,
        "nrmse": {m: [*map(_finite, of)] for m, of in errors.items()},
        "completed": {m: v.completed(m) == len(v.runs) for m in v.models},
        "limits": [USABLE, TRENDS],
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and isfinite(value) else None


# -- what to mind ---------------------------------------------------------------------------------


def cautions(validations: Mapping[str, Validation]) -> Markup:
    """Warnings, rollouts that ended early and time outside the training range, all in one box."""
    whose: dict[str, list[str]] = {}
    for name, v in validations.items():
        for note in _notes(v):
            whose.setdefault(note, []).append(name)
    if not whose:
        return Markup("")
    several = len(validations) > 1
    items = [
        element("li", f"{note} ({', '.join(names)})" if several else note)
        for note, names in whose.items()
    ]
    return element(
        "details",
        element("summary", f"{plural(len(items), 'thing')} to know before trusting these figures"),
        element("ul", *items),
        cls="caution",
    )


def _notes(validation: Validation) -> list[str]:
    notes = [*validation.warnings, *validation.record.get("warnings", ())]
    notes += [_outside(validation, m) for m in validation.models]
    return [*dict.fromkeys(n for n in (*notes, *endings(validation)) if n)]


def endings(validation: Validation, model: str | None = None) -> list[str]:
    """One sentence per rollout that ended early: which, when, and which state went where."""
    return [
        f"{name} on {r.recorded.name} ended at {m.simulation.ended:.4g} s of "
        f"{r.recorded.time[-1]:.4g} s: {m.simulation.reason}"
        for r in validation.runs
        for name, m in r.models.items()
        if m.simulation.status is not Status.COMPLETED and model in (None, name)
    ]


def _outside(validation: Validation, model: str) -> str:
    shares: Sequence[float] = [
        s.outside
        for r in validation.runs
        if (s := r.models[model].simulation).status is Status.COMPLETED
    ]
    if not shares or max(shares) <= _OUTSIDE:
        return ""
    low, high = f"{100 * min(shares):.0f}", f"{100 * max(shares):.0f}"
    share = high if low == high else f"{low} to {high}"
    return (
        f"{model} spent {share} % of the time of its completed rollouts with an input or state "
        "outside the training range"
    )
