"""From runs to training samples: choose the channels, take the derivatives (Sec. 3.2, 3.3)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from dfsm.core.progress import track
from dfsm.core.types import Array, IntArray
from dfsm.data.between import (
    Between,
    events,
    kinks,
    polynomials,
    recognised,
    resolved,
    rough_ones,
)
from dfsm.data.conversion import in_one_unit, in_units_of
from dfsm.data.dataset import Dataset
from dfsm.data.derivatives import (
    differentiate,
    lead_in,
    require_moving,
    state_names,
    state_units,
)
from dfsm.data.rates import with_rates_per_second
from dfsm.data.slower import fill_slower
from dfsm.data.steps import Steps
from dfsm.data.suspects import screened
from dfsm.data.trajectory import Channel, Role, Trajectory
from dfsm.data.wind import CORRECTED_WIND, WIND_SOURCES
from dfsm.errors import DfsmError
from dfsm.fitting.settings import FitSettings
from dfsm.models.inputs import InputOrder
from dfsm.models.signals import (
    Azimuth,
    SignalTable,
    blade_harmonics,
    radians_per_second,
    require_constant,
    require_field,
    with_computed,
)
from dfsm.models.terms import Terms, terms_of
from dfsm.numerics.time_mesh import parts_of, weights_over_time

# Share by which the recorded azimuth may turn faster or slower than the speed says.
_SAME_SPEED = 0.05


@dataclass(frozen=True)
class Samples:
    """All training samples, stacked over runs (Sec. 3.2).

    Attributes
    ----------
    inputs, derivatives, harmonics
        I, Ẋ and the blade-passing harmonics without a field, shapes ``(sample, n)``.
    field
        Harmonics of the wind field, `SignalTable.field`, shape ``(sample, n)``.
    times, recorded
        Times in s and outputs of every run, ``(time,)`` and ``(time, output)``: parts of the data
        where they can be, since many runs would not fit into memory twice.
    psi
        Recorded azimuth in rad, which goes on growing after a turn (zero without), ``(sample,)``.
    signals
        What the columns mean.
    derivative_names
        Name and unit of each state derivative.
    terms
        Known terms of the linear fits.
    weights
        Of the samples by the time that they stand for, 1 on average, shape ``(sample,)``; None
        where all count alike, see `weights_over_time`.
    steps
        Intervals of every run, for those in which inputs jump or are rough.
    rough
        Names of inputs that are joined by lines and turn at nearly every sample: states have a kink
        at each, as under held ones.
    sudden
        Other inputs joined by lines that move suddenly, and how often; see `events`.
    """

    inputs: Array
    derivatives: Array
    harmonics: Array
    field: Array
    times: tuple[Array, ...]
    recorded: tuple[Array, ...]
    psi: Array
    signals: SignalTable
    derivative_names: tuple[tuple[str, str], ...]
    terms: Terms | None = None
    weights: Array | None = None
    steps: tuple[Steps, ...] = ()
    rough: tuple[str, ...] = ()
    sudden: tuple[tuple[str, int], ...] = ()

    @property
    def outputs(self) -> Array:
        """Y, ``(sample, output)``."""
        return np.concatenate(self.recorded)

    @property
    def time(self) -> Array:
        """Time of each sample in its run in s, ``(sample,)``."""
        return np.concatenate(self.times)

    @property
    def runs(self) -> IntArray:
        """Run index of each sample, ``(sample,)``."""
        return np.repeat(np.arange(len(self.times)), [len(time) for time in self.times])

    @property
    def parts(self) -> list[slice]:
        """The samples of every run."""
        return parts_of(self.times)

    @property
    def linear_inputs(self) -> Array:
        """[I, φ], what linear fits of derivatives take, ``(sample, input + term)``."""
        if self.terms is None:
            return self.inputs
        return np.concatenate([self.inputs, self.terms.along(self.inputs)], axis=1)

    @property
    def columns(self) -> dict[str, Array]:
        """Samples of every input by name, each ``(sample,)``."""
        return dict(zip((c.name for c in self.signals.inputs), self.inputs.T, strict=True))

    @property
    def linear_names(self) -> list[str]:
        """Names of their columns."""
        terms = () if self.terms is None else self.terms.channels
        return [c.name for c in (*self.signals.inputs, *terms)]

    @property
    def output_inputs(self) -> Array:
        """[I, φ, harmonics], what linear fits of outputs take."""
        if not self.harmonics.shape[1]:
            return self.linear_inputs
        return np.concatenate([self.linear_inputs, self.harmonics], axis=1)

    def without_terms(self, inputs: Array) -> Array:
        """What corrective functions take of what linear fits do: all but φ."""
        if self.terms is None:
            return inputs
        n = self.inputs.shape[1]
        after = n + len(self.terms.channels)
        return np.concatenate([inputs[:, :n], inputs[:, after:]], axis=1)

    def blocks(self, inputs: Array, targets: Array) -> Iterator[tuple[Array, Array]]:
        """Samples run by run."""
        for inside in self.parts:
            yield inputs[inside], targets[inside]

    def weighted_blocks(
        self, inputs: Array, targets: Array, rows: Sequence[int]
    ) -> Iterator[tuple[Array, Array, Array | None]]:
        """Samples run by run with their weights, and some of the targets."""
        for inside in self.parts:
            weights = None if self.weights is None else self.weights[inside]
            yield inputs[inside], targets[inside][:, rows], weights


def only_read(
    run: Trajectory, settings: FitSettings, elsewhere: Collection[str] = ()
) -> Trajectory:
    """A run without the channels that a fit never reads, so that many fit into memory.

    `elsewhere` are parameters whose values a configuration holds. The run itself where a channel
    that the fit needs is not there, for what else it has is told then, and where channels of two
    rates are filled, which ends the run where the first does.
    """
    names = dict.fromkeys(settings.roles)
    names.update(dict.fromkeys(n for f in settings.features for n in f.sources))
    computed = {f.name for f in settings.features} | set(elsewhere)
    if settings.azimuth is not None:
        angle = settings.azimuth.angle
        names.update(dict.fromkeys((*settings.azimuth.field, *([] if angle is None else [angle]))))
    if settings.hub_height is not None:
        names.update(dict.fromkeys(WIND_SOURCES))
        computed |= {CORRECTED_WIND, *WIND_SOURCES}
    if settings.slower is not None or any(n not in run for n in names if n not in computed):
        return run
    return run.select(n for n in names if n in run)


def select(runs: Iterable[Trajectory], settings: FitSettings) -> Dataset:
    """Keep the channels that the fit reads, check them, and put the runs in their order."""
    roles = settings.roles
    twice = [n for n in settings.outputs if n in state_names(settings.states)]
    if twice:
        raise DfsmError(f"'{twice[0]}' is a state, which models simulate: leave it out of outputs")
    names = dict.fromkeys(roles)
    runs = list(runs)
    if settings.azimuth is not None and settings.azimuth.angle is not None:
        names[settings.azimuth.angle] = None
        angle = [Channel(settings.azimuth.angle, "deg")]
        runs = [in_units_of(run, angle, "azimuth.angle") for run in runs]
    names.update(dict.fromkeys(n for f in settings.features for n in f.sources))
    runs = in_one_unit([fill_slower(r, settings.slower) for r in runs], names)
    runs = with_rates_per_second(runs, settings.states)
    window = settings.start, settings.stop
    for run in runs:
        run.window(*window)
    runs = screened(list(runs), names, settings.outliers, window, settings.derivatives)
    runs = [with_computed(r, settings.hub_height, settings.features) for r in runs]
    if settings.azimuth is not None:
        names.update(dict.fromkeys(settings.azimuth.field))
        for run in runs:
            require_field(run, settings.azimuth)
    picked = [r.select(names).with_roles(roles) for r in runs]
    for run in picked:
        lead_in(run, settings.start, settings.derivatives).require_finite()
    data = Dataset(picked)
    for name in names:
        data.channel(name)
    for name in (*settings.controls, *settings.driving):
        # One after the other: a window holds all channels.
        ends = [(w.min(), w.max()) for r in data for w in [r.window(*window)[name]]]
        low, high = min(least for least, _ in ends), max(most for _, most in ends)
        if low == high:
            raise DfsmError(
                f"{roles[name]} '{name}' is {low:g} throughout all {len(data)} runs, so nothing "
                f"can be learned about its effect: leave it out of {roles[name]}s, or add runs "
                "in which it varies"
            )
    for run in data:
        require_constant(run.window(settings.start, settings.stop), settings.parameters)
    return data


def extract(data: Dataset, settings: FitSettings) -> Samples:
    """Take the state derivatives of every run and stack the samples (Sec. 3.3)."""
    signals = _signals(data, settings)
    steps: list[Steps] = []
    rough = _rough(data, signals, settings)
    # Where the fit is concerned, what is rough jumps at its samples.
    bends: list[Between] = [
        "hold" if n in rough else kind
        for n, kind in zip(signals.driving, signals.between, strict=True)
    ]
    used = [lead_in(run, settings.start, settings.derivatives) for run in data]
    breaks = [kinks(run, signals.driving, bends) for run in used]
    kinked = any(map(len, breaks))
    tables, times, begin = _places(data, settings), list[Array](), 0
    recorded: list[Array] = []
    labels: tuple[tuple[str, str], ...] = ()
    for k, whole_run in enumerate(track(data, "derivatives")):
        run = used[k]
        extracted = differentiate(run, settings.states, settings.derivatives, breaks[k])
        labels = tuple(zip(extracted.derivative_names, extracted.derivative_units, strict=True))
        whole = extracted.trajectory
        inside = whole.window(*settings.window_of(whole_run))
        rows = np.isin(whole.time, inside.time)
        order = InputOrder(
            settings.controls, settings.driving, extracted.names, settings.parameters
        )
        seen = run.window(*settings.window_of(whole_run))
        times.append(seen.time)
        recorded.append(_columns(seen, settings.outputs))
        place = slice(begin, begin := begin + len(times[-1]))
        azimuth = settings.azimuth
        if azimuth is not None:
            psi = _azimuth(whole, azimuth)[rows]
            tables["psi"][place] = psi
            if not azimuth.rings:
                tables["harmonics"][place] = blade_harmonics(psi, azimuth.blades)
        if kinked:
            values = run.select(signals.exogenous).values
            inputs = polynomials(run.time, values, signals.between_samples())
            steps.append(Steps.of(extracted, rows, inputs, settings.states, len(signals.driving)))
        tables["inputs"][place] = inside.select(order.names).values
        tables["derivatives"][place] = extracted.derivatives[rows]
        tables["field"][place] = run.select(azimuth.field if azimuth else ()).values[rows]
    inputs = tables["inputs"]
    require_moving(settings.states, inputs[:, signals.observed_columns])
    return Samples(
        **tables,
        times=tuple(times),
        recorded=tuple(recorded),
        signals=signals,
        derivative_names=labels,
        terms=terms_of(settings.terms, signals.inputs, inputs),
        weights=weights_over_time(times),
        steps=tuple(steps),
        rough=rough,
        sudden=_sudden(used, signals.driving, bends),
    )


def _sudden(
    runs: Sequence[Trajectory], names: Sequence[str], kinds: Sequence[Between]
) -> tuple[tuple[str, int], ...]:
    """Inputs joined by lines that move suddenly, and how often."""
    lines = [name for name, kind in zip(names, kinds, strict=True) if kind == "linear"]
    counts = [(name, sum(len(events(run.time, run[name])) for run in runs)) for name in lines]
    return tuple((name, count) for name, count in counts if count)


def _columns(run: Trajectory, names: Sequence[str]) -> Array:
    """Channels ``(time, channel)`` of a run, a part of it where they lie side by side."""
    columns = run.columns(names)
    first = columns[0] if columns else 0
    if columns == list(range(first, first + len(columns))):
        return run.values[:, first : first + len(columns)]
    return run.values[:, columns]


def _places(data: Dataset, settings: FitSettings) -> dict[str, Array]:
    """Tables for the samples of all runs, zero: many runs would not fit into memory twice."""
    count, azimuth = 0, settings.azimuth
    for run in data:
        used = lead_in(run, settings.start, settings.derivatives)
        count += len(used.window(*settings.window_of(run)))
    driving = len(settings.controls) + len(settings.driving) + len(settings.parameters)
    states = len(state_names(settings.states))
    blades = 0 if azimuth is None or azimuth.rings else 2
    widths = {
        "inputs": driving + states,
        "derivatives": states,
        "harmonics": blades,
        "field": len(azimuth.field) if azimuth else 0,
    }
    tables: dict[str, Array] = {n: np.zeros((count, width)) for n, width in widths.items()}
    tables["psi"] = np.zeros(count)
    return tables


def _rough(data: Dataset, signals: SignalTable, settings: FitSettings) -> tuple[str, ...]:
    """Names of the inputs that are joined by lines and turn at nearly every sample."""
    driving = [run.select(signals.driving) for run in data]
    pairs = zip(data, driving, strict=True)
    runs = [few.window(*settings.window_of(run)) for run, few in pairs]
    return rough_ones(runs, signals.driving, signals.between)


def _signals(data: Dataset, settings: FitSettings) -> SignalTable:
    # `select` has made sure that units agree; a run may leave out what others state.
    first, names = data[0], state_names(settings.states)
    first = replace(first, channels=tuple(data.channel(n) for n in first.names))

    def channels(names: Iterable[str], role: Role) -> tuple[Channel, ...]:
        return tuple(Channel(n, first.channel(n).unit, role=role) for n in names)

    table = SignalTable(
        states=tuple(
            Channel(n, unit, role="state")
            for n, unit in zip(names, state_units(settings.states, first), strict=True)
        ),
        controls=channels(settings.controls, "control"),
        disturbances=channels(settings.driving, "disturbance"),
        parameters=channels(settings.parameters, "parameter"),
        outputs=channels(settings.outputs, "output"),
        specs=tuple(settings.states),
        derivatives=settings.derivatives,
        azimuth=settings.azimuth,
        hub_height=settings.hub_height,
        features=settings.features,
        field=channels(settings.azimuth.field if settings.azimuth else (), "disturbance"),
        between=_between(data, settings),
    )
    _ = table.azimuth_rate  # fails here, not in the middle of a simulation
    return table


def _between(data: Dataset, settings: FitSettings) -> tuple[Between, ...]:
    """What inputs do between samples: as chosen, else as it looks in the training data.

    A held input that acts late is held: by parts of a sample late, it only looks as if it moved on.
    """
    names = (*settings.controls, *settings.driving)
    shifted = {f.name: f.source for f in settings.features if f.kind in ("delay", "lead")}
    looked = list(dict.fromkeys((*names, *shifted.values())))
    windows = (run.window(settings.start, settings.stop) for run in data)
    found = dict(zip(looked, recognised(windows, looked), strict=True))
    chosen = settings.inputs if isinstance(settings.inputs, Mapping) else {}
    for name, source in shifted.items():
        found[name] = chosen.get(source, found[source])
    return resolved(settings.inputs, names, [found[name] for name in names])


def _azimuth(run: Trajectory, azimuth: Azimuth | None) -> Array:
    """Azimuth in rad that goes on growing after a turn, ``(time,)``; zero where nobody asks.

    Raises
    ------
    DfsmError
        With a wind field, in which angle and speed must agree: they do not.
    """
    if azimuth is None:
        return np.zeros(len(run))
    omega = run[azimuth.speed] * radians_per_second(run.channel(azimuth.speed))
    turned = scipy.integrate.cumulative_trapezoid(omega, run.time, initial=0.0)
    if azimuth.angle is None:
        return turned
    angle = np.deg2rad(run[azimuth.angle])
    # Whole turns are those of the speed: several may lie between two samples.
    steps, whole = np.diff(angle), 2 * np.pi
    steps += whole * np.round((np.diff(turned) - steps) / whole)
    psi = angle[0] + np.concatenate([[0.0], np.cumsum(steps)])
    ratio = (psi[-1] - psi[0]) / turned[-1] if turned[-1] else 1.0
    if azimuth.rings and abs(ratio - 1) > _SAME_SPEED and abs(turned[-1]) > whole:
        raise DfsmError(
            f"{run.where}: azimuth.angle '{azimuth.angle}' turns by {ratio:.3g} times what "
            f"azimuth.speed '{azimuth.speed}' says: name the rotor's speed, and its azimuth in deg "
            "that grows with it"
        )
    return psi
