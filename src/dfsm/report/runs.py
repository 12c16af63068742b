"""Tables of one test run: spectra, ranges, damage-equivalent loads."""

from __future__ import annotations

from dfsm.report.elements import Markup, element, join, number, percent, table
from dfsm.report.figures import bands_of
from dfsm.simulation.simulate import Status
from dfsm.validation.results import ChannelStatistics, RunComparison, Validation


def peaks(name: str, validation: Validation, run: RunComparison) -> Markup:
    """Peak frequencies per band, and band power relative to the recorded signal's."""
    bands = bands_of(validation, run)
    rows = []
    for c in validation.channels:
        recorded = run.statistics[c.name]
        for band in bands:
            row: list[object] = [c.name, band.name, _hertz(recorded, band.name)]
            for model in run.models.values():
                simulated = model.statistics.get(c.name)
                row += [
                    _hertz(simulated, band.name),
                    _ratio(simulated, recorded, band.name),
                ]
            rows.append(row)
    grid = table(
        f"{name}, {run.recorded.name}: peak frequency (Hz) and band power over the recorded one",
        [("", 2), ("recorded", 1), *[(m, 2) for m in run.models]],
        ["Channel", "Band", "peak (Hz)", *["peak (Hz)", "power ratio"] * len(run.models)],
        rows,
    )
    return join(grid, _incomplete(run))


def ranges(name: str, validation: Validation, run: RunComparison) -> Markup:
    """Min, mean, max and standard deviation, recorded and multi-fidelity."""
    shown = "multi-fidelity" if "multi-fidelity" in run.models else next(iter(run.models))
    rows = []
    for c in validation.channels:
        recorded, simulated = run.statistics[c.name], run.models[shown].statistics.get(c.name)
        rows.append([c.name, c.unit or "—", *_four(recorded), *_four(simulated)])
    grid = table(
        f"{name}, {run.recorded.name}: range of every signal",
        [("", 2), ("recorded", 4), (shown, 4)],
        ["Channel", "Unit", *["min", "mean", "max", "std"] * 2],
        rows,
    )
    return join(grid, _incomplete(run, [shown]))


def _four(s: ChannelStatistics | None) -> list[object]:
    if s is None:
        return [None] * 4
    # A fourth digit, because a range is compared with another range.
    return [Markup(number(x, 4)) for x in (s.minimum, s.mean, s.maximum, s.std)]


def damage(name: str, validation: Validation, run: RunComparison) -> Markup:
    """1 Hz damage-equivalent loads of the outputs, and their relative difference."""
    rows = []
    for c in validation.channels:
        for exponent, recorded in run.statistics[c.name].damage.items():
            row: list[object] = [c.name, c.unit or "—", exponent, recorded]
            for model in run.models.values():
                simulated = model.statistics.get(c.name)
                value = simulated.damage[exponent] if simulated else None
                relative = value / recorded - 1 if value is not None and recorded else None
                row += [value, Markup(percent(relative))]
            rows.append(row)
    if not rows:
        return element("p", f"{name}: the model has no outputs, so no loads.", cls="note")
    grid = table(
        f"{name}, {run.recorded.name}: 1 Hz damage-equivalent loads",
        [("", 3), ("recorded", 1), *[(m, 2) for m in run.models]],
        ["Output", "Unit", "Wöhler m", "DEL", *["DEL", "difference"] * len(run.models)],
        rows,
    )
    return join(grid, _incomplete(run))


def _hertz(simulated: ChannelStatistics | None, band: str) -> Markup | None:
    peak = simulated.peaks.get(band) if simulated else None
    # A Welch bin is 0.005 Hz wide: more digits would say nothing.
    return None if peak is None else Markup(f"{peak:.3f}")


def _ratio(
    simulated: ChannelStatistics | None, recorded: ChannelStatistics, band: str
) -> float | None:
    power = recorded.power.get(band)
    if simulated is None or not power:
        return None
    return simulated.power[band] / power


def _incomplete(run: RunComparison, shown: list[str] | None = None) -> Markup:
    missing = [
        f"{m} ended at {r.simulation.ended:.4g} s, {r.simulation.reason}"
        for m, r in run.models.items()
        if r.simulation.status is not Status.COMPLETED and (shown is None or m in shown)
    ]
    if not missing:
        return Markup("")
    text = f"—: no figures for an unfinished rollout; {'; '.join(missing)}."
    return element("p", text, cls="note")
