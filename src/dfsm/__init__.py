"""Derivative function surrogate models from time-domain simulations.

The public names; each is imported when it is first used, so that ``import dfsm`` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dfsm.core.version import __version__

if TYPE_CHECKING:
    from dfsm.config.fit import load_config
    from dfsm.control import (
        DirectTranscription,
        MultipleShooting,
        OptimalControlProblem,
        RunCheck,
        SingleShooting,
        Solution,
        check_run,
        load_solution,
        save_solution,
        solve,
    )
    from dfsm.controllers.actuator import Actuator
    from dfsm.controllers.bladed import BladedLibrary
    from dfsm.controllers.discon import Discon, read_discon, write_discon
    from dfsm.controllers.pid import PID
    from dfsm.controllers.rosco import ROSCO, read_rosco
    from dfsm.controllers.sensor import Sensor
    from dfsm.controllers.state_space import StateFeedback, StateSpace
    from dfsm.core.progress import show_progress
    from dfsm.data.dataset import Dataset
    from dfsm.data.derivatives import DerivativeSettings, Filter, StateSpec, differentiate
    from dfsm.data.features import Feature
    from dfsm.data.hold_out import HoldOut
    from dfsm.data.info import describe
    from dfsm.data.readers import read, read_all
    from dfsm.data.readers.mann import BoxSettings, read_mann
    from dfsm.data.readers.rotor_table import RotorTable, read_rotor_table
    from dfsm.data.readers.tables import write_table
    from dfsm.data.readers.turbsim import read_turbsim
    from dfsm.data.readers.uniform import UniformSettings, read_uniform
    from dfsm.data.trajectory import Channel, Trajectory
    from dfsm.data.wind_field import with_field_wind, with_harmonics
    from dfsm.errors import DfsmError, DfsmWarning
    from dfsm.exports.c_code import write_c
    from dfsm.exports.casadi_model import CasadiModel, to_casadi
    from dfsm.exports.fmu import write_fmu
    from dfsm.exports.python_model import write_python
    from dfsm.exports.rosco import RoscoInput, write_rosco
    from dfsm.exports.state_space import Linearization, StateSpaceModels, to_state_space
    from dfsm.fitting.corrective import NoCorrection
    from dfsm.fitting.corrective.gaussian_process import GP
    from dfsm.fitting.corrective.perceptron import MLP
    from dfsm.fitting.corrective.rbf import RBF, IncrementalRBF
    from dfsm.fitting.fit import FitResult, fit
    from dfsm.fitting.hidden.settings import HiddenSettings
    from dfsm.fitting.linear import LPV, LTI
    from dfsm.fitting.settings import FitSettings
    from dfsm.loops.adaptive import AdaptiveResult, AdaptiveSettings, optimize_adaptively
    from dfsm.loops.load_cases import weibull_weights
    from dfsm.loops.regulator import linear_quadratic
    from dfsm.loops.sweep import Sweep, SweepSettings, sweep
    from dfsm.loops.trust_region import ConfirmedTuning, TrustSettings, tune_with_truth
    from dfsm.loops.truth import FlownRuns, SystemTruth
    from dfsm.loops.tuning import TuningTask, tune
    from dfsm.loops.tuning_problem import Goal, Limit, TuneSettings, TuningProblem
    from dfsm.loops.tuning_result import TuneStatus, TuningResult
    from dfsm.models.dfsm import DFSM
    from dfsm.models.model_folder import load, load_all, save
    from dfsm.models.signals import Azimuth
    from dfsm.models.steady import SteadyState, steady_state
    from dfsm.models.taken import model_inputs
    from dfsm.models.terms import Function, Product, QuadraticDrag, Rotor
    from dfsm.refinement.refine import RefineResult, refine
    from dfsm.refinement.settings import RefineSettings
    from dfsm.report import write_model_card, write_report, write_solution_report
    from dfsm.selection.compare import RankedCandidate, Ranking, compare
    from dfsm.selection.left_out import cross_calibrate
    from dfsm.selection.trial import Candidate, Outcome
    from dfsm.simulation.closed_loop import ClosedLoopRun, LoopStatus, closed_loop
    from dfsm.simulation.loop_cases import ClosedLoopSettings
    from dfsm.simulation.prepared_loop import ClosedLoop, prepare_loop
    from dfsm.simulation.simulate import Simulation, SimulationSettings, Status, simulate
    from dfsm.simulators import ODESystem, mass_chain, two_link_robot, two_link_robot_with_gravity
    from dfsm.simulators.excitation import (
        Chirp,
        Multisine,
        RandomKnots,
        RandomSteps,
        Uniform,
        excite,
    )
    from dfsm.validation.calibrate import calibrate
    from dfsm.validation.closed_loop import ClosedLoopValidation, validate_closed_loop
    from dfsm.validation.intervals import Intervals, load_intervals
    from dfsm.validation.results import Validation
    from dfsm.validation.validate import compared, validate

# Where each public name lives, in the order of the data flow.
_HOME = {
    "DfsmError": "errors",
    "DfsmWarning": "errors",
    "show_progress": "core.progress",
    "Channel": "data.trajectory",
    "Trajectory": "data.trajectory",
    "Dataset": "data.dataset",
    "read": "data.readers",
    "read_all": "data.readers",
    "write_table": "data.readers.tables",
    "describe": "data.info",
    "read_turbsim": "data.readers.turbsim",
    "read_mann": "data.readers.mann",
    "BoxSettings": "data.readers.mann",
    "read_uniform": "data.readers.uniform",
    "UniformSettings": "data.readers.uniform",
    "with_field_wind": "data.wind_field",
    "with_harmonics": "data.wind_field",
    "RotorTable": "data.readers.rotor_table",
    "read_rotor_table": "data.readers.rotor_table",
    "RandomKnots": "simulators.excitation",
    "RandomSteps": "simulators.excitation",
    "Multisine": "simulators.excitation",
    "Chirp": "simulators.excitation",
    "Uniform": "simulators.excitation",
    "excite": "simulators.excitation",
    "ODESystem": "simulators",
    "two_link_robot": "simulators",
    "two_link_robot_with_gravity": "simulators",
    "mass_chain": "simulators",
    "StateSpec": "data.derivatives",
    "Filter": "data.derivatives",
    "DerivativeSettings": "data.derivatives",
    "differentiate": "data.derivatives",
    "Feature": "data.features",
    "HoldOut": "data.hold_out",
    "LTI": "fitting.linear",
    "LPV": "fitting.linear",
    "RBF": "fitting.corrective.rbf",
    "IncrementalRBF": "fitting.corrective.rbf",
    "GP": "fitting.corrective.gaussian_process",
    "MLP": "fitting.corrective.perceptron",
    "NoCorrection": "fitting.corrective",
    "Rotor": "models.terms",
    "QuadraticDrag": "models.terms",
    "Product": "models.terms",
    "Function": "models.terms",
    "Azimuth": "models.signals",
    "DFSM": "models.dfsm",
    "model_inputs": "models.taken",
    "SteadyState": "models.steady",
    "steady_state": "models.steady",
    "Discon": "controllers.discon",
    "read_discon": "controllers.discon",
    "write_discon": "controllers.discon",
    "ROSCO": "controllers.rosco",
    "read_rosco": "controllers.rosco",
    "BladedLibrary": "controllers.bladed",
    "PID": "controllers.pid",
    "StateFeedback": "controllers.state_space",
    "StateSpace": "controllers.state_space",
    "Actuator": "controllers.actuator",
    "Sensor": "controllers.sensor",
    "FitSettings": "fitting.settings",
    "FitResult": "fitting.fit",
    "fit": "fitting.fit",
    "HiddenSettings": "fitting.hidden.settings",
    "RefineSettings": "refinement.settings",
    "RefineResult": "refinement.refine",
    "refine": "refinement.refine",
    "save": "models.model_folder",
    "load": "models.model_folder",
    "load_all": "models.model_folder",
    "Status": "simulation.simulate",
    "Simulation": "simulation.simulate",
    "SimulationSettings": "simulation.simulate",
    "simulate": "simulation.simulate",
    "closed_loop": "simulation.closed_loop",
    "ClosedLoopRun": "simulation.closed_loop",
    "LoopStatus": "simulation.closed_loop",
    "ClosedLoopSettings": "simulation.loop_cases",
    "prepare_loop": "simulation.prepared_loop",
    "ClosedLoop": "simulation.prepared_loop",
    "Validation": "validation.results",
    "compared": "validation.validate",
    "validate": "validation.validate",
    "validate_closed_loop": "validation.closed_loop",
    "ClosedLoopValidation": "validation.closed_loop",
    "Candidate": "selection.trial",
    "Outcome": "selection.trial",
    "RankedCandidate": "selection.compare",
    "Ranking": "selection.compare",
    "compare": "selection.compare",
    "calibrate": "validation.calibrate",
    "cross_calibrate": "selection.left_out",
    "Intervals": "validation.intervals",
    "load_intervals": "validation.intervals",
    "OptimalControlProblem": "control",
    "DirectTranscription": "control",
    "MultipleShooting": "control",
    "SingleShooting": "control",
    "solve": "control",
    "Solution": "control",
    "save_solution": "control",
    "load_solution": "control",
    "AdaptiveSettings": "loops.adaptive",
    "AdaptiveResult": "loops.adaptive",
    "optimize_adaptively": "loops.adaptive",
    "linear_quadratic": "loops.regulator",
    "sweep": "loops.sweep",
    "Sweep": "loops.sweep",
    "SweepSettings": "loops.sweep",
    "weibull_weights": "loops.load_cases",
    "tune": "loops.tuning",
    "TuningTask": "loops.tuning",
    "tune_with_truth": "loops.trust_region",
    "TrustSettings": "loops.trust_region",
    "ConfirmedTuning": "loops.trust_region",
    "SystemTruth": "loops.truth",
    "FlownRuns": "loops.truth",
    "TuningProblem": "loops.tuning_problem",
    "Goal": "loops.tuning_problem",
    "Limit": "loops.tuning_problem",
    "TuneSettings": "loops.tuning_problem",
    "TuneStatus": "loops.tuning_result",
    "TuningResult": "loops.tuning_result",
    "RunCheck": "control",
    "check_run": "control",
    "CasadiModel": "exports.casadi_model",
    "to_casadi": "exports.casadi_model",
    "write_c": "exports.c_code",
    "write_fmu": "exports.fmu",
    "write_python": "exports.python_model",
    "RoscoInput": "exports.rosco",
    "write_rosco": "exports.rosco",
    "to_state_space": "exports.state_space",
    "StateSpaceModels": "exports.state_space",
    "Linearization": "exports.state_space",
    "write_report": "report",
    "write_model_card": "report",
    "write_solution_report": "report",
    "load_config": "config.fit",
}

__all__ = [*_HOME, "__version__"]  # pyright: ignore[reportUnsupportedDunderAll]  # noqa: PLE0604


# Public names of an earlier version, for programs written for it.
_EARLIER = {"optimise_adaptively": "optimize_adaptively"}


def __getattr__(name: str) -> Any:
    name = _EARLIER.get(name, name)
    if name not in _HOME:
        raise AttributeError(f"module 'dfsm' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"dfsm.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
