"""The commented `config.yaml` that `dfsm init` writes, filled with the channels of the runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from dfsm.config.proposal import TOWER_TOPS, Proposal, propose
from dfsm.core.files import check_file, write_file
from dfsm.core.types import Array
from dfsm.data.features import Feature
from dfsm.data.info import ChannelInfo, describe
from dfsm.data.readers import read_all
from dfsm.data.trajectory import Trajectory
from dfsm.errors import printable

# A start-up transient is dropped from runs that are clearly longer than it.
_TRANSIENT = 100.0

_TEXT = """\
# dfsm configuration. Next: dfsm fit {name} -o model/

data:
  train:{train}
  start: {start}      # s; earlier samples (the start-up transient) are not used
  stop: null       # s
  step: {step}       # s; interval between samples of files that hold no time
  slower: null     # hold or linear: channels with fewer samples than their table, or {{cmd: hold}}
{hub_height}
# Channels (unit, range over the first run{constant}; what each is taken for below, and why):
{channels}

signals:
  # order 2: the channel and its rate are both states, ξ = [q, q̇]. A recorded rate is used
  # instead of a derivative with rate: <channel> (and acceleration: <channel>).
  states:{states}
  controls: {controls}        # what an optimizer may choose
  # Known signals that nobody chooses. None of them may hold a response of the system.{wind_note}
  disturbances: {disturbances}
  # Disturbances computed from others: a rate, a first-order lag, a delay or a lead, as
  # in [{{source: {example}, kind: rate}}, {{source: {example}, kind: lag, time_constant: 10}},
  # {{source: {example}, kind: lead, seconds: 4}}]
  features: {features}
  # Plant variables, constant within a run: channels, or values of runs whose files hold none, as
  # {{Ballast: {{run1.outb: 1.0, run2.outb: 1.2}}}} or the name of a CSV table.
  parameters: {parameters}
  outputs: {outputs}

# What controls and disturbances do between samples: hold, linear or cubic, for all or by name.
# Those that stay and jump are recognised as held.
inputs: {inputs}

derivatives:
  method: smoothing_spline     # or cubic_spline, as in the paper
  # filters: {{{state}: {{kind: low_pass, cutoff: 0.5}}}}

linear:
{linear}

# Known physics in the linear fit ({terms}), as in
# [{{kind: product, factors: [{example}, {state}]}}]; in the documentation: Known physics.
terms: []

corrective:
{corrective}

gate: 0.01            # correct a row only if its residual exceeds this share of the signal
azimuth: {azimuth}
nonlinear_only: {nonlinear_only}  # also fit the nonlinear-only model, for comparison in the report
# Refine the derivative fit on rollouts over the training runs (null is a whole run), with latent
# states that remember the inputs. Most accuracy and most time are here, the more the more states,
# linear.points and runs: windows up to 100 s, 10 steps and 8 latent states take 25 s on two
# processors for three states and 24 runs of 600 s, or nine states and seven runs; whole runs and
# a network far longer. No further step is begun after so many seconds:
# refine: {{windows: [20, null], step: 0.5, iterations: 20, latents: 8, network: 16, decay: 3,
#          seconds: 600}}
refine: {refine}
# Hidden states beside the measured ones, learned on rollouts instead of derivatives.
# How many, what corrects them and what inputs do between samples is chosen on data left out:
# hidden: {{count: 2, form: tanh, units: 6, starts: 6, startup: 5, stable: null}}
{hidden}seed: 0

# Structures to try: dfsm compare {name} -o comparison/ ranks them, and the one above, on a share of
# the training runs. Each names the keys that it changes.
# compare:
#   hold_out: 0.2       # or validation: [files], which rank instead
#   candidates:
#     gp: {{corrective: {{kind: gp}}}}
#     linear: {{corrective: {{kind: none}}}}
#     refined: {{refine: {{windows: [20, 100, null], latents: 2}}}}
"""


def write_config(files: Sequence[str], path: Path, step: float | None = None) -> str:
    """Write a configuration for some runs.

    Parameters
    ----------
    files
        Result files or patterns; they become ``data.train``.
    path
        File to write; relative patterns are rewritten to start from its folder.
    step
        Interval between samples in s of files that hold no time.

    Returns
    -------
    str
        What a user should know of the proposal; empty where that is nothing.

    Raises
    ------
    DfsmError
        A file cannot be read, or `path` not written.
    """
    runs = read_all(files, step=step)
    check_file(path, [r.source for r in runs])
    names = _relative([r.source or r.name for r in runs], path.parent)
    text, told = fill(runs, names, path.name, step)
    with write_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return told


def fill(
    runs: Sequence[Trajectory], train: Sequence[str], name: str, step: float | None = None
) -> tuple[str, str]:
    """Fill the template with channels that all runs share; also what there is to tell of it."""
    first = describe(runs[0])
    common = set(runs[0].names).intersection(*(r.names for r in runs))
    shared = {c.name: c for c in first.channels if c.name in common}
    varying = {n: c for n, c in shared.items() if any(_varies(r[n]) for r in runs)}
    parameters = [n for n in shared if n not in varying and _differs(n, runs)]
    listed = [c for n, c in shared.items() if n in varying or n in parameters]
    proposed = propose(runs, list(varying), parameters)
    wind, turbine = proposed.wind, proposed.turbine
    long = min(r.time[-1] for r in runs) > 2 * _TRANSIENT + runs[0].time[0]
    states = [s["name"] for s in proposed.states]
    margin = _TURBINE_MARGIN if turbine else _MARGIN
    linear = "  kind: LTI\n" + margin
    if wind:
        waves = _constant_waves(proposed.features)
        linear = _LPV.format(schedule=_flow(wind), waves=waves, margin=margin)
    driving = [*proposed.disturbances, *proposed.controls]
    advice = _hidden_told(proposed)
    text = _TEXT.format(
        name=printable(name),
        train=_block(train),
        start=_TRANSIENT if long and turbine else "null",
        hub_height=_HUB_HEIGHT if turbine else "",
        step="null" if step is None else f"{step:g}",
        constant="" if len(listed) == len(first.channels) else "; constant ones left out",
        channels="\n".join(_comment(c, proposed.reasons.get(c.name, "")) for c in listed),
        states=_block(proposed.states),
        controls=_flow(proposed.controls),
        wind_note=_WIND_NOTE if wind == "RtVAvgxh" else "",
        disturbances=_flow(proposed.disturbances),
        features=_flow(proposed.features),
        example=printable(driving[0] if driving else "<channel>"),
        state=printable(states[0] if states else "<state>"),
        terms="rotor, quadratic_drag, product" if turbine else "quadratic_drag, product",
        parameters=_flow(proposed.parameters),
        outputs=_flow(proposed.outputs),
        inputs=_flow(dict.fromkeys(proposed.held, "hold")) if proposed.held else "null",
        linear=linear,
        corrective=_NO_CORRECTION if turbine else _CORRECTION,
        azimuth=_azimuth(states, varying, turbine),
        nonlinear_only="false" if turbine else "true",
        hidden=f"# {printable(advice)}\nhidden: {{}}\n" if advice else "",
        refine=_refinement(proposed) if turbine and long and len(runs) > 1 else "null",
    )
    return text, advice if states else _NO_STATE


def _refinement(proposed: Proposal) -> str:
    """Refinement with latent states; what controls drive would learn the controller."""
    driving = [*proposed.disturbances, *(Feature(**f).name for f in proposed.features)]
    # A tower swings several times as fast as a platform.
    step = 0.25 if any(state["name"] in TOWER_TOPS for state in proposed.states) else 0.5
    if not driving:
        return _REFINE.format(latents="", step=step)
    states = sum(state["order"] for state in proposed.states)
    decay = _DECAY if states <= _FEW_STATES else _DECAY_OF_MANY
    inputs = f"latents: 8, latent_inputs: {_flow(driving)}, decay: {decay}, "
    return _REFINE.format(latents=inputs, step=step)


def _hidden_told(proposed: Proposal) -> str:
    """Why derivatives are not to be fitted, where hidden states are proposed."""
    if not proposed.hidden:
        return ""
    left = ", ".join(f"{share:.0%} of that of {n}" for n, share in proposed.unexplained.items())
    told = [f"what is recorded leaves {left}"] if left else []
    told += [
        f"{n} has too few samples per swing for a second derivative, about {per_swing:.0f} once "
        "noise is averaged out"
        for n, per_swing in proposed.coarse.items()
    ]
    why = f" ({'; '.join(told)})" if told else ""
    return (
        f"Derivatives are not to be fitted here{why}: hidden fits rollouts instead, with states "
        "that nobody measures"
    )


_NO_STATE = (
    "No channel looks like a state: neither the others nor their past tell how one changes. "
    "Name in signals.states what the model is to simulate, or add the channels that drive it"
)


def _varies(values: Array) -> bool:
    """Whether a channel moves; one with fewer samples than its table may."""
    finite = values[np.isfinite(values)]
    return len(finite) > 0 and bool(finite.min() < finite.max())


def _constant_waves(features: Sequence[Mapping[str, Any]]) -> str:
    """The line that keeps what waves do the same at all winds, where some of their inputs lead."""
    leading = {f["source"] for f in features if f["kind"] == "lead"}
    names = [Feature(**f).name for f in features if f["source"] in leading]
    if not leading:
        return ""
    return f"  constant: {_flow([*sorted(leading), *names])}  # waves do the same in all winds\n"


def _differs(name: str, runs: Sequence[Trajectory]) -> bool:
    """Whether a channel that is constant in every run is not the same in all of them."""
    starts = [r[name][0] for r in runs]
    return all(r[name].min() == r[name].max() for r in runs) and min(starts) < max(starts)


_WIND_NOTE = """
  # RtVAvgxh is measured on the moving rotor and holds the platform's motion, a response: use the
  # undisturbed rotor average of the wind field if you have it, or set data.hub_height and
  # replace RtVAvgxh by RtVAvgxhCorr here and in linear.schedule."""

_HUB_HEIGHT = """\
  hub_height: null   # m; a number adds the channel RtVAvgxhCorr to every run
"""

_CORRECTION = """\
  kind: mlp           # trains for minutes, rbf for seconds; or rbf_incremental, gp, none
  hidden: [20, 20]    # units per layer"""

_NO_CORRECTION = """\
  kind: none          # what a turbine's residuals hold is mostly what no input tells; mlp, rbf or
                      # gp learn from them, in minutes more"""

_REFINE = "{{windows: [20, 100], step: {step}, iterations: 10, {latents}seconds: 90}}"
# How little coefficients may change: the more states, the more of them chance can use.
_DECAY, _DECAY_OF_MANY, _FEW_STATES = 30, 1000, 5

_LPV = """\
  kind: LPV           # LPV varies with the schedule; LTI does not (remove schedule, points)
  schedule: {schedule}
  points: 5
{waves}{margin}"""

_MARGIN = """\
  margin: null        # 1/s; a number keeps all eigenvalues left of -margin, at the least cost in
                      # fit quality (not for a system that is truly unstable)"""

_TURBINE_MARGIN = """\
  margin: 0.01        # 1/s; keeps all eigenvalues left of -0.01, at the least cost in fit quality,
                      # which the fit tells; without it rollouts of missing damping drift off"""


def _azimuth(states: Sequence[str], varying: dict[str, ChannelInfo], turbine: bool) -> str:
    if not turbine:
        return "null"
    speed = next((s for s in ("RotSpeed", "GenSpeed") if s in states), None)
    if speed is None or "LSSTipPxa" not in varying:
        return "null         # {speed: <state>, angle: <channel>} adds blade-passing (3P) inputs"
    return (
        f"{{speed: {speed}, angle: LSSTipPxa}}  # blade-passing (3P) inputs of the outputs; speed "
        "must be the rotor's"
    )


def _comment(channel: ChannelInfo, reason: str) -> str:
    # A line break in a name must not end the comment.
    name, unit = printable(channel.name), printable(channel.unit)
    line = f"#   {name:<16} {unit:<10} {channel.min:.5g} to {channel.max:.5g}"
    return f"{line:<60}  {printable(reason)}" if reason else line


def _block(items: Sequence[object]) -> str:
    """A YAML list with one item per line, to follow a key and its colon."""
    if not items:
        return " []"
    return "".join(f"\n    - {_flow(item)}" for item in items)


def _flow(value: object) -> str:
    """A value as YAML on one line."""
    yaml = YAML()
    yaml.default_flow_style = True
    yaml.width = 10_000
    stream = StringIO()
    yaml.dump(value, stream)
    return stream.getvalue().removesuffix("...\n").strip()


def _relative(files: Sequence[str], folder: Path) -> list[str]:
    """File names relative to the folder of the configuration, where they lie below it."""
    base = folder.resolve()
    names = []
    for file in files:
        path = Path(file).resolve()
        names.append(str(path.relative_to(base)) if path.is_relative_to(base) else str(path))
    return names
