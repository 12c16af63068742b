"""Open-loop optimal control with a surrogate, or with any model that JAX can follow (Sec. 4).

`problem` says what, `nlp/transcription` and `nlp/shooting` how, `solve` does it: `meshes` goes from
mesh to mesh, and `assembly` makes a solution of where the last one ended.
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
