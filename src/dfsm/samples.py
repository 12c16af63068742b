"""From runs to training samples: choose the channels, take the derivatives (Sec. 3.2, 3.3)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import cumulative_trapezoid

from dfsm.corrective import MLP, CorrectiveChoice
from dfsm.derivatives import (
    DerivativeSettings,
    StateSpec,
    differentiate,
    state_names,
    state_units,
)
from dfsm.errors import DfsmError
from dfsm.features import Feature
from dfsm.linear import LPV, LTI
from dfsm.progress import track
from dfsm.read import gap_warning, wind_warning
from dfsm.settings import require, settings
from dfsm.signals import (
    Azimuth,
    SignalTable,
    blade_harmonics,
    radians_per_second,
    require_constant,
    with_computed,
)
from dfsm.trajectory import Channel, Dataset, Role, Trajectory
from dfsm.types import Array, IntArray


@settings
class FitSettings:
    """Everything that defines a fit besides the data.

    Attributes
    ----------
    states
        What is a state, and of which order, see `StateSpec`.
    controls, disturbances, parameters, outputs
        Channel names by role. Disturbances are known signals that nobody chooses; none of them
        may hold a response of the system.
    start, stop
        Time window in s used for training; derivatives are taken on the whole run before.
    derivatives
        How derivatives are extracted.
    linear
        `LTI`, or `LPV` in one of the disturbances (or other inputs).
    corrective
        Kind and settings of the corrective functions; None leaves the linear fit alone.
    gate
        A row is corrected only where the RMS of its residual exceeds this share of the signal's
        standard deviation.
    azimuth
        Blade-passing harmonics for the outputs.
    hub_height
        In m; adds the channel ``RtVAvgxhCorr``, the rotor wind without the platform's motion, to
        runs that only have ``RtVAvgxh``.
    features
        Disturbances that are computed from others, see `Feature`; they follow those named.
    nonlinear_only
        Also fit f̂_NL, the same corrective function without a linear part, for comparison.
    seed
        Seed of everything random.
    """

    states: tuple[StateSpec, ...]
    controls: tuple[str, ...] = ()
    disturbances: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    start: float | None = None
    stop: float | None = None
    derivatives: DerivativeSettings = field(default_factory=DerivativeSettings)
    linear: LTI | LPV = field(default_factory=LTI)
    corrective: CorrectiveChoice = field(default_factory=MLP)
    gate: float = 0.01
    azimuth: Azimuth | None = None
    hub_height: float | None = None
    features: tuple[Feature, ...] = ()
    nonlinear_only: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        require(self.gate >= 0, "gate", self.gate, "0 or more")
        require(self.seed >= 0, "seed", self.seed, "0 or more")

    @property
    def driving(self) -> tuple[str, ...]:
        """Names of all disturbances, the computed ones last."""
        return (*self.disturbances, *(f.name for f in self.features))

    @property
    def roles(self) -> dict[str, Role]:
        """Role of every channel that the fit reads.

        Raises
        ------
        DfsmError
            A channel is listed twice, or in two roles that exclude each other.
        """
        roles: dict[str, Role] = {}
        groups: tuple[tuple[Role, Iterable[str]], ...] = (
            ("state", [n for s in self.states for n in s.channels]),
            ("control", self.controls),
            ("disturbance", self.driving),
            ("parameter", self.parameters),
            ("output", self.outputs),
        )
        for role, names in groups:
            for i, name in enumerate(names := list(names)):
                if role != "state" and name in names[:i]:
                    raise DfsmError(f"channel '{name}' is listed twice as {role}: name it once")
                if roles.get(name, role) != role and "output" not in (role, roles[name]):
                    raise DfsmError(
                        f"channel '{name}' is listed as {roles[name]} and as {role}: choose one"
                    )
                roles.setdefault(name, role)
        for feature in self.features:
            role = roles.get(feature.source, "disturbance")
            if role != "disturbance":
                raise DfsmError(
                    f"feature '{feature.name}' is made of the {role} '{feature.source}', but a "
                    "rollout may know no responses and an optimiser must be free to choose "
                    "controls: make features of disturbances only"
                )
        return roles


@dataclass(frozen=True)
class Samples:
    """All training samples, stacked over runs (Sec. 3.2).

    Attributes
    ----------
    inputs, derivatives, outputs, harmonics
        I, Ẋ, Y and the blade-passing harmonics, shapes ``(sample, n)``.
    runs
        Run index of each sample, shape ``(sample,)``.
    signals
        What the columns mean.
    derivative_names
        Name and unit of each state derivative.
    """

    inputs: Array
    derivatives: Array
    outputs: Array
    harmonics: Array
    runs: IntArray
    signals: SignalTable
    derivative_names: tuple[tuple[str, str], ...]

    def blocks(self, inputs: Array, targets: Array) -> Iterator[tuple[Array, Array]]:
        """Samples run by run."""
        ends = np.flatnonzero(np.diff(self.runs, append=-1)) + 1
        for start, stop in zip([0, *ends[:-1]], ends, strict=True):
            yield inputs[start:stop], targets[start:stop]


def select(runs: Iterable[Trajectory], choices: FitSettings) -> Dataset:
    """Keep the channels that the fit reads, check them, and put the runs in their order."""
    roles = choices.roles
    twice = [n for n in choices.outputs if n in state_names(choices.states)]
    if twice:
        raise DfsmError(f"'{twice[0]}' is a state, which models simulate: leave it out of outputs")
    names = dict.fromkeys(roles)
    if choices.azimuth is not None and choices.azimuth.angle is not None:
        names[choices.azimuth.angle] = None
    names.update(dict.fromkeys(f.source for f in choices.features))
    runs = [with_computed(r, choices.hub_height, choices.features) for r in runs]
    picked = [r.select(names).require_finite().with_roles(roles) for r in runs]
    for run in picked:
        run.window(choices.start, choices.stop)
    data = Dataset(picked)
    for name in names:
        data.channel(name)
    for name in (*choices.controls, *choices.driving):
        windows = [r.window(choices.start, choices.stop)[name] for r in data]
        low, high = min(w.min() for w in windows), max(w.max() for w in windows)
        if low == high:
            raise DfsmError(
                f"{roles[name]} '{name}' is {low:g} throughout all {len(data)} runs, so nothing "
                f"can be learned about its effect: leave it out of {roles[name]}s, or add runs "
                "in which it varies"
            )
    for run in data:
        require_constant(run.window(choices.start, choices.stop), choices.parameters)
    return data


def data_warnings(data: Dataset, choices: FitSettings) -> list[str]:
    """What a user should know about the data before trusting a fit, one sentence each."""
    found = [text for name in choices.disturbances if (text := wind_warning(name))]
    gaps = [
        f"{run.where}: {text}"
        for run in data
        if (text := gap_warning(run.window(choices.start, choices.stop)))
    ]
    if gaps:
        more = f" ({len(gaps)} of the {len(data)} runs have gaps)" if len(gaps) > 1 else ""
        found.append(gaps[0] + more)
    return found


def extract(data: Dataset, choices: FitSettings) -> Samples:
    """Take the state derivatives of every run and stack the samples (Sec. 3.3)."""
    parts: list[list[Array]] = []
    labels: tuple[tuple[str, str], ...] = ()
    for run in track(data, "derivatives"):
        found = differentiate(run, choices.states, choices.derivatives)
        labels = tuple(zip(found.derivative_names, found.derivative_units, strict=True))
        whole = found.trajectory
        inside = whole.window(choices.start, choices.stop)
        rows = np.isin(whole.time, inside.time)
        names = (*choices.controls, *choices.driving, *found.names, *choices.parameters)
        parts.append(
            [
                inside.select(names).values,
                found.derivatives[rows],
                run.select(choices.outputs).values[rows],
                _harmonics(run, choices.azimuth)[rows],
            ]
        )
    lengths = [len(p[0]) for p in parts]
    inputs, derivatives, outputs, harmonics = (np.concatenate(c) for c in zip(*parts, strict=True))
    return Samples(
        inputs=inputs,
        derivatives=derivatives,
        outputs=outputs,
        harmonics=harmonics,
        runs=np.repeat(np.arange(len(data)), lengths),
        signals=_signals(data, choices),
        derivative_names=labels,
    )


def _signals(data: Dataset, choices: FitSettings) -> SignalTable:
    # The first run stands for all: `select` has made sure that units agree.
    first, names = data[0], state_names(choices.states)

    def channels(names: Iterable[str], role: Role) -> tuple[Channel, ...]:
        return tuple(Channel(n, first.channel(n).unit, role=role) for n in names)

    table = SignalTable(
        states=tuple(
            Channel(n, unit, role="state")
            for n, unit in zip(names, state_units(choices.states, first), strict=True)
        ),
        controls=channels(choices.controls, "control"),
        disturbances=channels(choices.driving, "disturbance"),
        parameters=channels(choices.parameters, "parameter"),
        outputs=channels(choices.outputs, "output"),
        specs=tuple(choices.states),
        derivatives=choices.derivatives,
        azimuth=choices.azimuth,
        hub_height=choices.hub_height,
        features=choices.features,
    )
    _ = table.azimuth_rate  # fails here, not in the middle of a simulation
    return table


def _harmonics(run: Trajectory, azimuth: Azimuth | None) -> Array:
    if azimuth is None:
        return np.empty((len(run), 0))
    if azimuth.angle is not None:
        psi = np.deg2rad(run[azimuth.angle])
    else:
        omega = run[azimuth.speed] * radians_per_second(run.channel(azimuth.speed))
        psi = cumulative_trapezoid(omega, run.time, initial=0.0)
    return np.asarray(blade_harmonics(psi, azimuth.blades))
