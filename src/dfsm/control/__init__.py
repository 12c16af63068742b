"""Open-loop optimal control with a surrogate, or with any model that JAX can follow (Sec. 4).

`problem` says what, `transcription` and `shooting` how; behind them `program` assembles sparse
nonlinear programs and `nlp` gives them to IPOPT.
"""

from dfsm.control.check import RunCheck, check_run
from dfsm.control.names import End, Signals
from dfsm.control.nlp.shooting import MultipleShooting, SingleShooting
from dfsm.control.nlp.transcription import DirectTranscription
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.solution import Ending, Replay, Solution
from dfsm.control.solution_folder import load_solution, save_solution
from dfsm.control.solve import solve

__all__ = [
    "DirectTranscription",
    "End",
    "Ending",
    "MultipleShooting",
    "OptimalControlProblem",
    "Replay",
    "RunCheck",
    "Signals",
    "SingleShooting",
    "Solution",
    "check_run",
    "load_solution",
    "save_solution",
    "solve",
]
