"""The paper's two-link robot study (Sec. 3.3 and 3.8, Figs. 1 to 6), and what goes beyond it.

`study` runs the parts in order: derivatives from splines, linear fit against Taylor expansion,
multi-fidelity against nonlinear-only models, and the defaults of `fit` on the same simulations.
`dfsm demo two-link-robot` prints and draws what it returns.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from dataclasses import dataclass, field

from dfsm.core.settings import require, settings_class
from dfsm.demos.two_link_robot.defaults import KINDS, QUICK_KINDS, Fitted, fit_kinds
from dfsm.demos.two_link_robot.extraction import Extraction, ExtractionSettings, extraction
from dfsm.demos.two_link_robot.multi_fidelity import (
    TEST_RUNS,
    TRAINING_RUNS,
    MultiFidelity,
    MultiFidelitySettings,
    draw,
    multi_fidelity,
)
from dfsm.demos.two_link_robot.taylor import TaylorComparison, TaylorSettings, compare_with_taylor
from dfsm.fitting.corrective import CorrectiveSettings

LONG_SEED = 1_000_000  # added to the seed for the runs of 5 s


@settings_class
class StudySettings:
    """How much to compute; the defaults make the full study.

    Attributes
    ----------
    extraction, taylor, multi_fidelity
        Sizes of the parts.
    kinds
        Corrective functions to compare, by name.
    """

    extraction: ExtractionSettings = field(default_factory=ExtractionSettings)
    taylor: TaylorSettings = field(default_factory=TaylorSettings)
    multi_fidelity: MultiFidelitySettings = field(default_factory=MultiFidelitySettings)
    kinds: Mapping[str, CorrectiveSettings] = field(default_factory=lambda: KINDS)


# Shows the same in less than a minute.
QUICK = StudySettings(
    extraction=ExtractionSettings(runs=10, longer_runs=4, finest=3200, refined_runs=3),
    taylor=TaylorSettings(runs=20, points=2000, deltas=(0.1, 0.01, 1e-4)),
    multi_fidelity=MultiFidelitySettings(samples=200, sweep=(100, 200), gravity=False),
    kinds=QUICK_KINDS,
)


@dataclass(frozen=True, eq=False)
class RobotStudy:
    """Results of the study.

    Attributes
    ----------
    extraction, taylor, multi_fidelity
        See their classes.
    kinds
        By name of the corrective function.
    seed
        Seed of all simulations and fits.
    seconds
        Wall time of the study.
    """

    extraction: Extraction
    taylor: TaylorComparison
    multi_fidelity: MultiFidelity
    kinds: dict[str, Fitted]
    seed: int
    seconds: float


def study(settings: StudySettings | None = None, seed: int = 0) -> RobotStudy:
    """Run the two-link robot study.

    Parameters
    ----------
    settings
        How much to compute; None makes the full study, `QUICK` a short one.
    seed
        Seed of everything random.

    Returns
    -------
    RobotStudy

    Raises
    ------
    DfsmError
        A negative seed.
    """
    require(seed >= 0, "seed", seed, "0 or more")
    settings = settings or StudySettings()
    begin = clock.perf_counter()
    derivatives = extraction(settings.extraction, seed)
    linear = compare_with_taylor(settings.taylor, seed)
    runs = draw(TRAINING_RUNS + TEST_RUNS, 3.0, seed)
    train, tests = runs[:TRAINING_RUNS], runs[TRAINING_RUNS:]
    long = draw(TEST_RUNS, 5.0, seed + LONG_SEED)
    nonlinear = multi_fidelity(train, tests, settings.multi_fidelity, seed)
    kinds = fit_kinds(settings.kinds, train, tests, long)
    return RobotStudy(
        derivatives, linear, nonlinear, kinds, seed, seconds=clock.perf_counter() - begin
    )
