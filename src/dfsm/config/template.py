"""The commented `config.yaml` that `dfsm init` writes, filled with the channels of the runs."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

from dfsm.core.files import check_file, write_file
from dfsm.core.types import Array
from dfsm.data.info import ChannelInfo, describe
from dfsm.data.readers import read_all
from dfsm.data.trajectory import Trajectory
from dfsm.errors import printable

# What wind engineers usually choose, in order of preference; only names that exist are proposed.
_STATES = ("PtfmPitch", "GenSpeed", "RotSpeed")
_CONTROLS = ("GenTq", "BldPitch1")
_OUTPUTS = ("TwrBsFxt", "TwrBsMyt", "GenPwr")
_WINDS = ("RotWind", "RtVAvgxh", "Wind1VelX")
_WITH_WIND = ("RotShearV", "RotShearH", "Wave1Elev")
# A start-up transient is dropped from runs that are clearly longer than it.
_TRANSIENT = 100.0
_HUB_HEIGHT = 150.0

_TEXT = """\
# dfsm configuration. Next: dfsm fit {name} -o model/

data:
  train:{train}
  start: {start}      # s; earlier samples (the start-up transient) are not used
  stop: null       # s
  hub_height: {hub_height}   # m; a number adds the channel RtVAvgxhCorr to every run
  step: {step}       # s; interval between samples of files that hold no time
  slower: null     # hold or linear: channels with fewer samples than their table, or {{cmd: hold}}

# Channels (unit, range over the first run{constant}):
{channels}

signals:
  # order 2: the channel and its rate are both states, ξ = [q, q̇]. A recorded rate is used
  # instead of a derivative with rate: <channel> (and acceleration: <channel>).
  states:{states}
  controls: {controls}        # what an optimizer may choose
  # Known signals that nobody chooses. None of them may hold a response of the turbine.{wind_note}
  disturbances: {disturbances}
  # Disturbances computed from others: a rate, or a first-order lag of so many seconds, as in
  # [{{source: Wave1Elev, kind: rate}}, {{source: RotWind, kind: lag, time_constant: 10}}]
  features: []
  # Plant variables, constant within a run: channels, or values of runs whose files hold none, as
  # {{Ballast: {{run1.outb: 1.0, run2.outb: 1.2}}}} or the name of a CSV table.
  parameters: {parameters}
  outputs: {outputs}

derivatives:
  method: smoothing_spline     # or cubic_spline, as in the paper
  # filters: {{GenSpeed: {{kind: low_pass, cutoff: 0.5}}}}

linear:
{linear}

# Known physics in the linear fit: rotor, quadratic_drag, product; docs/method.md has an example.
terms: []

corrective:
  kind: mlp           # or rbf, rbf_incremental, gp, none; docs/method.md lists their keys
  hidden: [20, 20]    # units per layer

gate: 0.01            # correct a row only if its residual exceeds this share of the signal
azimuth: {azimuth}
nonlinear_only: true  # also fit the nonlinear-only model, for the comparison in the report
# Refine the derivative fit on rollouts over the training runs (null is a whole run), with latent
# states that remember the inputs, for instance
# refine: {{windows: [20, null], step: 0.5, iterations: 20, latents: 8, network: 16, decay: 3}}
refine: null
seed: 0

# Structures to try: dfsm compare {name} -o comparison/ ranks them, and the one above, on a share of
# the training runs. Each names the keys that it changes.
# compare:
#   hold_out: 0.2       # or validation: [files], which rank instead
#   candidates:
#     gp: {{corrective: {{kind: gp}}}}
#     linear: {{corrective: {{kind: none}}}}
#     refined: {{refine: {{windows: [20, 100, null], latents: 2}}}}
"""


def write_config(files: Sequence[str], path: Path, step: float | None = None) -> None:
    """Write a configuration for some runs.

    Parameters
    ----------
    files
        Result files or patterns; they become ``data.train``.
    path
        File to write; relative patterns are rewritten to start from its folder.
    step
        Interval between samples in s of files that hold no time.

    Raises
    ------
    DfsmError
        A file cannot be read, or `path` not written.
    """
    runs = read_all(files, step=step)
    check_file(path, [r.source for r in runs])
    names = _relative([r.source or r.name for r in runs], path.parent)
    text = fill(runs, names, path.name, step)
    with write_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def fill(
    runs: Sequence[Trajectory], train: Sequence[str], name: str, step: float | None = None
) -> str:
    """Fill the template with channels that all runs share."""
    first = describe(runs[0])
    common = set(runs[0].names).intersection(*(r.names for r in runs))
    shared = {c.name: c for c in first.channels if c.name in common}
    varying = {n: c for n, c in shared.items() if any(_varies(r[n]) for r in runs)}
    parameters = [n for n in shared if n not in varying and _differs(n, runs)]
    listed = [c for n, c in shared.items() if n in varying or n in parameters]
    wind = next((w for w in _WINDS if w in varying), None)
    states = [s for s in _STATES if s in varying]
    states = states[:-1] if {"GenSpeed", "RotSpeed"} <= set(states) else states
    disturbances = ([wind] if wind else []) + [d for d in _WITH_WIND if d in varying]
    long = min(r.time[-1] for r in runs) > 2 * _TRANSIENT + runs[0].time[0]
    relative = wind == "RtVAvgxh"
    return _TEXT.format(
        name=printable(name),
        train=_block(train),
        start=_TRANSIENT if long else "null",
        hub_height="null",
        step="null" if step is None else f"{step:g}",
        constant="" if len(listed) == len(first.channels) else "; constant ones left out",
        channels="\n".join(_comment(c) for c in listed),
        states=_block([{"name": s, "order": 2} for s in states]),
        controls=_flow([c for c in _CONTROLS if c in varying]),
        wind_note=_WIND_NOTE if relative else "",
        disturbances=_flow(disturbances),
        parameters=_flow(parameters),
        outputs=_flow([o for o in _OUTPUTS if o in varying]),
        linear=(
            _LPV.format(schedule=_flow(wind), margin=_MARGIN) if wind else "  kind: LTI\n" + _MARGIN
        ),
        azimuth=_azimuth(states, varying),
    )


def _varies(values: Array) -> bool:
    """Whether a channel moves; one with fewer samples than its table may."""
    finite = values[np.isfinite(values)]
    return len(finite) > 0 and bool(finite.min() < finite.max())


def _differs(name: str, runs: Sequence[Trajectory]) -> bool:
    """Whether a channel that is constant in every run is not the same in all of them."""
    starts = [r[name][0] for r in runs]
    return all(r[name].min() == r[name].max() for r in runs) and min(starts) < max(starts)


_WIND_NOTE = """
  # RtVAvgxh is measured on the moving rotor and holds the platform's motion, a response: use the
  # undisturbed rotor average of the wind field if you have it, or set data.hub_height and
  # replace RtVAvgxh by RtVAvgxhCorr here and in linear.schedule."""

_LPV = """\
  kind: LPV           # LPV varies with the schedule; LTI does not (remove schedule, points)
  schedule: {schedule}
  points: 5
{margin}"""

_MARGIN = """\
  margin: null        # 1/s; a number keeps all eigenvalues left of -margin, at the least cost in
                      # fit quality (not for a system that is truly unstable)"""


def _azimuth(states: Sequence[str], varying: dict[str, ChannelInfo]) -> str:
    speed = next((s for s in ("RotSpeed", "GenSpeed") if s in states), None)
    if speed is None or "LSSTipPxa" not in varying:
        return "null         # {speed: <state>, angle: <channel>} adds blade-passing (3P) inputs"
    return (
        f"{{speed: {speed}, angle: LSSTipPxa}}  # blade-passing (3P) inputs of the outputs; speed "
        "must be the rotor's"
    )


def _comment(channel: ChannelInfo) -> str:
    # A line break in a name must not end the comment.
    name, unit = printable(channel.name), printable(channel.unit)
    return f"#   {name:<16} {unit:<10} {channel.min:.5g} to {channel.max:.5g}"


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
