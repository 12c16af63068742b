"""Beyond the paper: what the defaults of `fit`, and its other kinds, make of the same data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dfsm.core.progress import track
from dfsm.data.trajectory import Trajectory
from dfsm.demos.two_link_robot.assess import Assessed, Rollouts, assess, roll
from dfsm.demos.two_link_robot.multi_fidelity import fit_settings
from dfsm.errors import hushed
from dfsm.fitting.corrective import CorrectiveSettings
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.corrective.perceptron import MLP
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import fit
from dfsm.simulators import two_link_robot

# A published Python program on such simulations: linear fit and Gaussian process, 500 samples,
# 80 of 100 simulations of 3 s with 900 points each. RMSE of the four states, seconds of fitting.
PEER, PEER_SECONDS = (0.073, 0.086, 0.086, 0.055), 49.0

DEFAULT = "default: MLP"
KINDS: Mapping[str, CorrectiveSettings] = {
    DEFAULT: MLP(),
    "GP, 500 samples": GP(samples=500),
    "RBF, 500 samples": RBF(samples=500),
}
QUICK_KINDS: Mapping[str, CorrectiveSettings] = {
    "MLP, small": MLP(hidden=(15, 15), iterations=40, samples=3000)
}


@dataclass(frozen=True, eq=False)
class Fitted:
    """One kind of corrective function on the data of Sec. 3.8.2.

    Attributes
    ----------
    short
        Errors on the twenty test runs of 3 s; its `seconds` are those of the whole fit.
    long
        Rollouts over twenty other runs, of 5 s.
    detail
        Size of what was trained.
    """

    short: Assessed
    long: Rollouts
    detail: str


def fit_kinds(
    kinds: Mapping[str, CorrectiveSettings],
    train: Sequence[Trajectory],
    tests: Sequence[Trajectory],
    long: Sequence[Trajectory],
) -> dict[str, Fitted]:
    """Fit with each kind of corrective function, everything else by default.

    Parameters
    ----------
    kinds
        By name.
    train, tests
        Runs of 3 s.
    long
        Test runs of 5 s.

    Returns
    -------
    dict
        By name.
    """
    robot = two_link_robot()
    fits = {}
    for name, kind in track(kinds.items(), "corrective functions"):
        with hushed():
            result = fit(train, fit_settings(robot, kind))
        seconds = float(sum(result.seconds.values()))
        first = result.model.provenance.record["rows"][0]["decision"]
        fits[name] = Fitted(
            short=assess(result.model, seconds, robot, tests),
            long=roll(result.model, long),
            detail=first[first.rfind("(") + 1 :].rstrip(")"),
        )
    return fits
