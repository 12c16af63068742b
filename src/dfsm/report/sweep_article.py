"""A sweep, told: a table per figure, one line per controller, beside the record."""

from __future__ import annotations

from dfsm.loops.sweep import Sweep, Swept
from dfsm.report.article import Article, Section, Table

# What is told of every channel, by its field in `Figures`.
_TOLD = {
    "mean": "Mean",
    "std": "Standard deviation",
    "maximum": "Largest value",
    "travel": "Travel: mean absolute rate, per s",
}


def sweep_article(swept: Sweep, exponent: float = 4.0) -> Article:
    """What a page and the terminal show of a sweep.

    Parameters
    ----------
    swept
        Figures of all controllers and of the record.
    exponent
        Wöhler exponent of the damage-equivalent loads shown.
    """
    lines = (swept.recorded, *swept.controllers)
    sections = [Section("life", "Over all runs with their weights", tables=(_life(lines),))]
    channels = list(dict.fromkeys(n for c in lines for n in c.figures))
    heads = tuple(f"{n} ({swept.units[n]})" for n in channels)
    for field, heading in _TOLD.items():
        rows = [
            (c.name, *(getattr(c.figures[n], field) if n in c.figures else None for n in channels))
            for c in lines
        ]
        table = Table(field, heading, ("controller", *heads), tuple(rows), digits=4)
        sections.append(Section(field, heading, tables=(table,)))
    sections.append(_loads(lines, channels, heads, exponent))
    if any(c.extremes for c in lines):
        sections.append(_extremes(lines, swept))
    endings = tuple(f"{c.name}: {text}" for c in lines for text in c.endings)
    if endings:
        sections.append(Section("endings", "Loops that ended early", endings))
    shares = ", ".join(f"{n} {w:.3g}" for n, w in zip(swept.runs, swept.weights, strict=True))
    lede = f"{len(swept.controllers)} controllers over {len(swept.runs)} runs; weights: {shares}."
    return Article("sweep", "Sweep", lede, tuple(sections))


def _life(lines: tuple[Swept, ...]) -> Table:
    rows = [(c.name, c.energy, c.overshoot) for c in lines]
    return Table(
        "life",
        "Energy of the share of a year that the weights stand for, and overshoot",
        ("controller", "energy (MWh)", "overshoot"),
        tuple(rows),
        note="A dash: not asked for, not recorded, or a loop ended early.",
        digits=4,
    )


def _loads(
    lines: tuple[Swept, ...], channels: list[str], heads: tuple[str, ...], exponent: float
) -> Section:
    key = f"{exponent:g}"
    rows = [
        (c.name, *(c.figures[n].damage.get(key) if n in c.figures else None for n in channels))
        for c in lines
    ]
    table = Table(
        "loads",
        f"Lifetime damage-equivalent load, 1 Hz, m = {exponent:g} (Palmgren-Miner)",
        ("controller", *heads),
        tuple(rows),
        digits=4,
    )
    return Section("loads", "Loads", tables=(table,))


def _extremes(lines: tuple[Swept, ...], swept: Sweep) -> Section:
    rows = [
        (c.name, f"{name} ({swept.units[name]})", e.value, e.error, e.blocks)
        for c in lines
        for name, e in c.extremes.items()
    ]
    table = Table(
        "extremes",
        "Extrapolated largest values",
        ("controller", "channel", "value", "standard error", "blocks"),
        tuple(rows),
        note="Gumbel's distribution of the maxima of blocks, of all runs of a condition together, "
        "over all with weights.",
        digits=4,
    )
    return Section("extremes", "Extremes", tables=(table,))
