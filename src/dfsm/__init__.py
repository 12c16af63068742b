"""Derivative function surrogate models from time-domain simulations.

The public names; each is imported when it is first used, so that ``import dfsm`` costs nothing.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from dfsm.calibrate import calibrate
    from dfsm.compare import RankedCandidate, Ranking, compare
    from dfsm.config import load_config
    from dfsm.control import (
        AdaptiveResult,
        AdaptiveSettings,
        DirectTranscription,
        MultipleShooting,
        OptimalControlProblem,
        RunCheck,
        SingleShooting,
        Solution,
        check_run,
        load_solution,
        optimise_adaptively,
        save_solution,
        solve,
    )
    from dfsm.corrective import GP, MLP, RBF, IncrementalRBF, NoCorrection
    from dfsm.derivatives import DerivativeSettings, Filter, StateSpec, differentiate
    from dfsm.errors import DfsmError, DfsmWarning
    from dfsm.excitation import Chirp, Multisine, RandomKnots, RandomSteps, Uniform, excite
    from dfsm.export import RoscoInput, write_rosco
    from dfsm.features import Feature
    from dfsm.fit import FitResult, fit
    from dfsm.intervals import Intervals, load_intervals
    from dfsm.linear import LPV, LTI
    from dfsm.model import DFSM
    from dfsm.progress import show_progress
    from dfsm.read import (
        describe,
        read,
        read_all,
        read_turbsim,
        with_field_wind,
        write_table,
    )
    from dfsm.refine import RefineResult, RefineSettings, refine
    from dfsm.report import write_report, write_solution_report
    from dfsm.samples import FitSettings
    from dfsm.signals import Azimuth
    from dfsm.simulate import Simulation, SimulationSettings, Status, simulate
    from dfsm.simulators import (
        ODESystem,
        mass_chain,
        two_link_robot,
        two_link_robot_with_gravity,
    )
    from dfsm.steady import SteadyState, steady_state
    from dfsm.storage import load, load_all, save
    from dfsm.trajectory import Channel, Dataset, Trajectory
    from dfsm.trial import Candidate, Outcome
    from dfsm.validate import Validation, compared, validate

# Where each public name lives, in the order of the data flow.
_HOME = {
    "DfsmError": "errors",
    "DfsmWarning": "errors",
    "show_progress": "progress",
    "Channel": "trajectory",
    "Trajectory": "trajectory",
    "Dataset": "trajectory",
    "read": "read",
    "read_all": "read",
    "write_table": "read",
    "describe": "read",
    "read_turbsim": "read",
    "with_field_wind": "read",
    "RandomKnots": "excitation",
    "RandomSteps": "excitation",
    "Multisine": "excitation",
    "Chirp": "excitation",
    "Uniform": "excitation",
    "excite": "excitation",
    "ODESystem": "simulators",
    "two_link_robot": "simulators",
    "two_link_robot_with_gravity": "simulators",
    "mass_chain": "simulators",
    "StateSpec": "derivatives",
    "Filter": "derivatives",
    "DerivativeSettings": "derivatives",
    "differentiate": "derivatives",
    "Feature": "features",
    "LTI": "linear",
    "LPV": "linear",
    "RBF": "corrective",
    "IncrementalRBF": "corrective",
    "GP": "corrective",
    "MLP": "corrective",
    "NoCorrection": "corrective",
    "Azimuth": "signals",
    "DFSM": "model",
    "SteadyState": "steady",
    "steady_state": "steady",
    "FitSettings": "samples",
    "FitResult": "fit",
    "fit": "fit",
    "RefineSettings": "refine",
    "RefineResult": "refine",
    "refine": "refine",
    "save": "storage",
    "load": "storage",
    "load_all": "storage",
    "Status": "simulate",
    "Simulation": "simulate",
    "SimulationSettings": "simulate",
    "simulate": "simulate",
    "Validation": "validate",
    "compared": "validate",
    "validate": "validate",
    "Candidate": "trial",
    "Outcome": "trial",
    "RankedCandidate": "compare",
    "Ranking": "compare",
    "compare": "compare",
    "calibrate": "calibrate",
    "Intervals": "intervals",
    "load_intervals": "intervals",
    "OptimalControlProblem": "control",
    "DirectTranscription": "control",
    "MultipleShooting": "control",
    "SingleShooting": "control",
    "solve": "control",
    "Solution": "control",
    "save_solution": "control",
    "load_solution": "control",
    "AdaptiveSettings": "control",
    "AdaptiveResult": "control",
    "optimise_adaptively": "control",
    "RunCheck": "control",
    "check_run": "control",
    "RoscoInput": "export",
    "write_rosco": "export",
    "write_report": "report",
    "write_solution_report": "report",
    "load_config": "config",
}

__all__ = [*_HOME, "__version__"]  # pyright: ignore[reportUnsupportedDunderAll]  # noqa: PLE0604


class _Package(ModuleType):
    """A package with lazy names; a function wins over the submodule that bears its name.

    The import system sets ``dfsm.fit`` to the submodule as soon as anything imports it, which
    would hide the function `fit`; such assignments are dropped.
    """

    def __getattr__(self, name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'dfsm' has no attribute '{name}'")
        value = getattr(importlib.import_module(f"dfsm.{_HOME[name]}"), name)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted(__all__)


sys.modules[__name__].__class__ = _Package
