"""Open-loop optimal control with a surrogate, or with any model that JAX can follow (Sec. 4).

`problem` says what, `transcription` and `shooting` how; behind them `program` assembles sparse
nonlinear programs and `nlp` gives them to IPOPT.
"""

from dfsm.control.adaptive import (
    AdaptiveResult,
    AdaptiveSettings,
    Agreement,
    Realised,
    Round,
    optimise_adaptively,
    realised,
)
from dfsm.control.check import RunCheck, check_run
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.shooting import MultipleShooting, SingleShooting
from dfsm.control.signals import End, Signals
from dfsm.control.solution import Ending, Replay, Solution
from dfsm.control.solve import solve
from dfsm.control.storage import load_solution, save_solution
from dfsm.control.transcription import DirectTranscription

__all__ = [
    "AdaptiveResult",
    "AdaptiveSettings",
    "Agreement",
    "DirectTranscription",
    "End",
    "Ending",
    "MultipleShooting",
    "OptimalControlProblem",
    "Realised",
    "Replay",
    "Round",
    "RunCheck",
    "Signals",
    "SingleShooting",
    "Solution",
    "check_run",
    "load_solution",
    "optimise_adaptively",
    "realised",
    "save_solution",
    "solve",
]
