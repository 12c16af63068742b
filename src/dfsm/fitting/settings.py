"""FitSettings: everything that defines a fit besides the data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import field

from dfsm.core.settings import require, settings_class
from dfsm.data.between import Chosen, resolved
from dfsm.data.derivatives import DerivativeSettings, StateSpec
from dfsm.data.features import Feature, known_window
from dfsm.data.slower import Slower
from dfsm.data.suspects import SUSPECTS, Suspects
from dfsm.data.trajectory import Role, Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.corrective import CorrectiveSettings
from dfsm.fitting.corrective.perceptron import MLP
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.linear import LPV, LTI
from dfsm.models.signals import Azimuth
from dfsm.models.terms import TermSettings

_DISTURBANCE: Role = "disturbance"


@settings_class
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
        Time window in s used for training; derivatives are taken on a little more, see `lead_in`.
    derivatives
        How derivatives are extracted.
    linear
        `LTI`, or `LPV` in one of the disturbances (or other inputs).
    terms
        Known physics inside the linear fits, see `models.terms`: their values are inputs of these
        like any other, and may be named in ``linear.constant`` and ``linear.known``.
    corrective
        Kind and settings of the corrective functions; None leaves the linear fit alone.
    gate
        A row is corrected only where the RMS of its residual exceeds this share of the signal's
        standard deviation.
    corrected
        Names of the derivatives and outputs that may be corrected, as a summary names them; None
        for all. A correction is as good as its data are near: what is flown far from them, with
        other gains or along an optimum, is safer in the linear fit and its known terms.
    azimuth
        Blade-passing harmonics for the outputs.
    hub_height
        In m; adds the channel ``RtVAvgxhCorr``, the rotor wind without the platform's motion, to
        runs that only have ``RtVAvgxh``.
    slower
        What channels with fewer samples than their table do in between, see `fill_slower`.
    features
        Disturbances that are computed from others, see `Feature`; they follow those named.
    inputs
        What controls and disturbances do between samples: ``"hold"``, ``"linear"`` or ``"cubic"``,
        for all or by name. Those not named are held where they stay and jump in the training data,
        else joined by lines.
    nonlinear_only
        Also fit f̂_NL, the same corrective function without a linear part, for comparison.
    seed
        Seed of everything random.
    outliers
        What to do with stray samples and runs in another unit: ``"refuse"``, ``"drop"`` or
        ``"keep"``, see `dfsm.data.suspects.screened`.
    hidden
        Hidden states beside the measured ones, all of them learned on rollouts; None for none.
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
    corrective: CorrectiveSettings = field(default_factory=MLP)
    gate: float = 0.01
    corrected: tuple[str, ...] | None = None
    azimuth: Azimuth | None = None
    hub_height: float | None = None
    features: tuple[Feature, ...] = ()
    slower: Slower = None
    terms: tuple[TermSettings, ...] = ()
    inputs: Chosen = field(default=None, hash=False)
    nonlinear_only: bool = True
    seed: int = 0
    outliers: Suspects = "refuse"
    hidden: HiddenSettings | None = None

    def __post_init__(self) -> None:
        known = f"one of {', '.join(SUSPECTS)}"
        require(self.outliers in SUSPECTS, "outliers", self.outliers, known)
        require(self.gate >= 0, "gate", self.gate, "0 or more")
        require(self.seed >= 0, "seed", self.seed, "0 or more")

    @property
    def driving(self) -> tuple[str, ...]:
        """Names of all disturbances, the computed ones last."""
        return (*self.disturbances, *(f.name for f in self.features))

    def window_of(self, run: Trajectory) -> tuple[float | None, float | None]:
        """Start and stop in s of what a whole record teaches, see `known_window`."""
        return known_window(run, self.features, self.start, self.stop)

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
        _ = resolved(self.inputs, (*self.controls, *self.driving))
        for feature in self.features:
            # What acted before now is known; optimal control refuses it, see `acting_late`.
            free: tuple[Role, ...] = (_DISTURBANCE,)
            if feature.kind == "delay":
                free = (_DISTURBANCE, "control")
            source = next(
                (n for n in feature.sources if roles.get(n, _DISTURBANCE) not in free), None
            )
            if source is not None:
                raise DfsmError(
                    f"feature '{feature.name}' is made of the {roles[source]} '{source}', but a "
                    "rollout may know no responses and an optimizer must be free to choose "
                    "controls: make features of disturbances only"
                )
        return roles
