"""Closed loops, told: tables and figures for terminal and page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dfsm.data.trajectory import Channel, Trajectory
from dfsm.report.article import Article, Curve, Figure, Panel, Section, Table
from dfsm.report.dots import dots
from dfsm.validation.closed_loop import (
    SHOWN_EXPONENT,
    ClosedLoopComparison,
    ClosedLoopValidation,
)

_RECORDED, _LOOP, _REPLAY = "recorded", "closed loop", "open-loop replay"
# Points of a drawn series at most, and the highest frequency of a drawn spectrum in Hz.
_POINTS = 3000
_HIGHEST = 0.6


def closed_loop_article(validation: ClosedLoopValidation, model: str, controller: str) -> Article:
    """What a page and the terminal show.

    Parameters
    ----------
    validation
        Closed loops against records.
    model, controller
        Names to show.
    """
    about = (
        f"{controller} on {model}, driven by disturbances only from the recorded state at the "
        "start, beside the rollout along the recorded controls."
    )
    sections = [
        Section("ratios", "Closed loop against the record", figures=_ratios(validation)),
        Section(
            "figures",
            "All runs",
            (about, *validation.endings()),
            (over_runs(validation),),
        ),
        Section("runs", "Each run", tables=(_by_run(validation),)),
    ]
    for run in validation.runs:
        if run.loop_statistics:
            sections.append(_drawn(run, validation.channels))
    return Article("closed_loop", "Closed loop", _verdict(validation), tuple(sections))


def _verdict(validation: ClosedLoopValidation) -> str:
    """How many loops came to their end, and how far their motion is from the recorded one."""
    count, ended = len(validation.runs), validation.completed
    told = f"{ended} of {count} closed loop{'s' * (count != 1)} came to their end."
    rows = {c.name: validation.row(c.name) for c in validation.channels}
    stds = {n: r.std_ratio for n, r in rows.items() if r is not None and r.std_ratio is not None}
    if not stds:
        return told
    low, high = min(stds, key=stds.__getitem__), max(stds, key=stds.__getitem__)
    span = " to ".join(f"{stds[n]:.2f} ({n})" for n in dict.fromkeys((low, high)))
    return f"{told} Their standard deviations are {span} times those of the record."


def _ratios(validation: ClosedLoopValidation) -> tuple[Figure, ...]:
    """Standard deviations and damage over the recorded ones, by channel."""
    rows = [(c.name, validation.row(c.name)) for c in validation.channels]
    known = [(name, row) for name, row in rows if row is not None]
    if not known:
        return ()
    return (
        dots(
            "ratios",
            f"Means over the runs; the damage-equivalent load (DEL) with m = {SHOWN_EXPONENT}.",
            "closed loop / record",
            [name for name, _ in known],
            {
                "standard deviation": [row.std_ratio for _, row in known],
                "DEL": [row.damage_ratio for _, row in known],
            },
            {"as recorded": (1.0, 0)},
        ),
    )


def over_runs(validation: ClosedLoopValidation) -> Table:
    """Figures of every channel over all runs, simulated over recorded."""
    rows = []
    for channel in validation.channels:
        row = validation.row(channel.name)
        if row is not None:
            rows.append(
                (
                    channel.label,
                    row.recorded_mean,
                    row.mean,
                    row.std_ratio,
                    row.std_worst,
                    row.replay_std_ratio,
                    row.damage_ratio,
                    row.damage_worst,
                    row.replay_damage_ratio,
                    row.nrmse,
                    row.replay_nrmse,
                )
            )
    table = Table(
        "over_runs",
        "Simulated over recorded",
        (
            *("channel", "mean, recorded", "closed loop"),
            *("std", "std, worst", "std, replay"),
            *("DEL", "DEL, worst", "DEL, replay"),
            *("NRMSE", "NRMSE, replay"),
        ),
        tuple(rows),
        note=(
            "std, DEL: ratio to the record, mean of the runs, that of the run farthest from 1, and "
            f"of the open-loop replay; DEL with m = {SHOWN_EXPONENT}; NRMSE at equal times"
        ),
    )
    return _filled(table)


def _by_run(validation: ClosedLoopValidation) -> Table:
    rows = []
    for run in validation.runs:
        for channel in validation.channels:
            if channel.name not in run.loop_statistics:
                continue
            true, ours = run.statistics[channel.name], run.loop_statistics[channel.name]
            replay = run.replay_statistics.get(channel.name)
            damages = [
                None if s is None else s.damage.get(SHOWN_EXPONENT) for s in (true, ours, replay)
            ]
            rows.append(
                (
                    run.recorded.name,
                    channel.label,
                    *(true.mean, ours.mean, None if replay is None else replay.mean),
                    *(true.std, ours.std, None if replay is None else replay.std),
                    *damages,
                    run.loop_errors[channel.name].nrmse,
                )
            )
    table = Table(
        "by_run",
        "Each run: recorded, closed loop, open-loop replay",
        (
            *("run", "channel"),
            *("mean, recorded", "mean, loop", "mean, replay"),
            *("std, recorded", "std, loop", "std, replay"),
            *("DEL, recorded", "DEL, loop", "DEL, replay"),
            "NRMSE",
        ),
        tuple(rows),
    )
    return _filled(table)


def _filled(table: Table) -> Table:
    """The table without columns that hold nothing, as loads do where no channel is one."""
    kept = [j for j in range(len(table.columns)) if any(r[j] is not None for r in table.rows)]
    return replace(
        table,
        columns=tuple(table.columns[j] for j in kept),
        rows=tuple(tuple(row[j] for j in kept) for row in table.rows),
    )


def _drawn(run: ClosedLoopComparison, channels: tuple[Channel, ...]) -> Section:
    name = run.recorded.name
    parts = [(_RECORDED, run.recorded, 0), (_LOOP, run.loop.trajectory, 1)]
    if run.replay_statistics:
        parts.append((_REPLAY, run.replay.trajectory, 2))
    statistics = (run.statistics, run.loop_statistics, run.replay_statistics)
    series, spectra = [], []
    for channel in channels:
        curves = [_series(n, t, channel.name, k) for n, t, k in parts if channel.name in t]
        series.append(Panel(channel.name, "time (s)", channel.label, tuple(curves)))
        lines = []
        for (label, _, colour), found in zip(parts, statistics, strict=False):
            if channel.name in found:
                spectrum = found[channel.name].spectrum
                kept = (spectrum.frequency > 0) & (spectrum.frequency <= _HIGHEST)
                x, y = spectrum.frequency[kept], spectrum.density[kept]
                lines.append(Curve(label, x, np.maximum(y, np.finfo(float).tiny), colour))
        spectra.append(Panel(channel.name, "frequency (Hz)", "PSD", tuple(lines), log="y"))
    return Section(
        f"run-{name}",
        name,
        (run.loop.message,),
        figures=(
            Figure(f"series-{name}", f"{name}: time series", tuple(series), stacked=True),
            Figure(f"spectra-{name}", f"{name}: power spectral densities", tuple(spectra)),
        ),
    )


def _series(label: str, run: Trajectory, channel: str, colour: int) -> Curve:
    every = max(1, len(run) // _POINTS)
    return Curve(label, run.time[::every], run[channel][::every], colour)
