"""What a user should know of the records that a fit rests on."""

from __future__ import annotations

from dfsm.data.dataset import Dataset
from dfsm.data.info import gap_warning
from dfsm.data.signs import held_interval, wrap_notes
from dfsm.data.stuck import stuck_notes
from dfsm.data.wind import wind_warning
from dfsm.fitting.held_inputs import held_note, held_unseen
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings


def data_warnings(data: Dataset, settings: FitSettings, samples: Samples) -> list[str]:
    """What a user should know about the data before trusting a fit, one sentence each."""
    doubts = [] if samples.terms is None else samples.terms.check(samples.columns)
    warnings = doubts + [text for name in settings.disturbances if (text := wind_warning(name))]
    for k, c in enumerate(samples.signals.outputs):
        low = min(values[:, k].min() for values in samples.recorded)
        if low == max(values[:, k].max() for values in samples.recorded):
            warnings.append(
                f"output '{c.name}' is {low:g} throughout all training runs, and so in the "
                "model: leave it out, or add runs in which it varies"
            )
    warnings += wrap_notes(data, (*settings.controls, *settings.driving, *settings.outputs))
    names = data.names
    for run in data:
        window = run.window(settings.start, settings.stop)
        warnings += [f"{run.where}: {text}" for text in stuck_notes(window, names)]
    gaps = [
        f"{run.where}: {text}"
        for run in data
        if (text := gap_warning(run.window(settings.start, settings.stop)))
    ]
    if gaps:
        more = f" ({len(gaps)} of the {len(data)} runs have gaps)" if len(gaps) > 1 else ""
        warnings.append(gaps[0] + more)
    return warnings


def held_records(data: Dataset, settings: FitSettings, samples: Samples) -> dict[str, str]:
    """Channels whose samples stay where the fit takes them for motion, with a sentence each."""
    return _held_states(data, settings) | _held_inputs(data, settings, samples)


def _held_states(data: Dataset, settings: FitSettings) -> dict[str, str]:
    """States whose record is slower than its mesh: steps where there is motion."""
    told = dict[str, str]()
    for name in dict.fromkeys(n for s in settings.states for n in s.channels):
        for run in data:
            if interval := held_interval(run.time, run[name]):
                told[name] = (
                    f"{run.where}: '{name}' changes every {interval:g} s only and stays as it was "
                    "in between, so its derivative is that of steps and its coefficients come out "
                    f"too small: set data.slower: {{{name}: linear}}, or give that record alone"
                )
                break
    return told


def _held_inputs(data: Dataset, settings: FitSettings, samples: Samples) -> dict[str, str]:
    """Inputs that are taken for lines by nobody's choice, and act as held ones.

    With hidden states what is recorded is no whole state; the search finds out what inputs do.
    """
    chosen = settings.inputs or {}
    if isinstance(chosen, str) or samples.weights is not None or settings.hidden is not None:
        return {}
    names = samples.signals.driving
    states = [n for s in settings.states for n in (s.name, s.rate) if n is not None]
    complete = all(s.order == 1 or s.rate is not None for s in settings.states)
    runs = [run.window(*settings.window_of(run)) for run in data]
    kinds = samples.signals.between
    known = [k for k, kind in enumerate(kinds) if kind == "hold"]
    found = held_unseen(
        lambda: ((run.select(states).values, run.select(names).values) for run in runs),
        complete,
        known,
    )
    # A feature is not given out by anybody: it goes between samples as what it is made of lets it.
    named = {*chosen, *(f.name for f in settings.features)}
    lines = [names[k] for k in found if kinds[k] == "linear" and names[k] not in named]
    return {name: held_note(name) for name in lines}
