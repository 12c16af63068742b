"""A `Program` as the functions that CasADi's interface to IPOPT calls.

With `exports.casadi_model` the only file that imports CasADi; it is imported when the first problem
is solved.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi

from dfsm.control.nlp.program import Program
from dfsm.control.nlp.watch import Watch
from dfsm.core.types import IntArray

# Name and sparsity of an argument or a result.
Port = tuple[str, casadi.Sparsity]


def make_solver(program: Program, watch: Watch, options: Mapping[str, Any]) -> Any:
    """Build a solver of a program; call it with ``x0``, ``lbx``, ``ubx``, ``lbg`` and ``ubg``.

    Parameters
    ----------
    program
        Functions and derivatives.
    watch
        Sees errors and iterates.
    options
        Of CasADi and, with the prefix ``ipopt.``, of IPOPT.
    """
    n, m, p, dense = program.n, program.m, program, casadi.Sparsity.dense
    x, nothing, one = ("x", dense(n, 1)), ("p", casadi.Sparsity(0, 1)), dense(1, 1)
    f, g, gradient = ("f", one), ("g", dense(m, 1)), ("grad_f_x", dense(n, 1))
    jacobian = ("jac_g_x", _sparsity(m, n, p.jacobian_pattern))
    hessian = ("triu_hess_gamma_x_x", _sparsity(n, n, p.hessian_pattern))
    multipliers = [("lam_f", one), ("lam_g", dense(m, 1))]
    names = [casadi.nlpsol_out(i) for i in range(casadi.nlpsol_n_out())]
    shapes = {"f": one, "x": dense(n, 1), "lam_x": dense(n, 1)}
    shapes |= {"g": dense(m, 1), "lam_g": dense(m, 1)}
    step = [(name, shapes.get(name, casadi.Sparsity(0, 0))) for name in names]

    def wrap(name: str, ins: Sequence[Port], outs: Sequence[Port], function: Any) -> _Wrapped:
        return _Wrapped(name, ins, outs, lambda arg, res: watch.call(function, arg, res))

    at = [x, nothing]
    nlp = wrap("nlp", at, [f, g], lambda z, _p: (p.objective(z), p.constraints(z)))
    functions = {
        "grad_f": wrap(
            "nlp_grad_f", at, [f, gradient], lambda z, _p: (p.objective(z), p.gradient(z))
        ),
        "jac_g": wrap(
            "nlp_jac_g", at, [g, jacobian], lambda z, _p: (p.constraints(z), p.jacobian(z))
        ),
        "hess_lag": wrap(
            "nlp_hess_l",
            [*at, *multipliers],
            [hessian],
            lambda z, _p, s, lam: (p.hessian(z, s[0], lam),),
        ),
        "iteration_callback": wrap("step", step, [("stop", one)], watch.step(names)),
    }
    solver: Any = casadi.nlpsol("dfsm", "ipopt", nlp, {**functions, **options})
    # CasADi does not keep the Python side of its callbacks alive.
    solver.kept = (nlp, functions)
    return solver


def _sparsity(height: int, width: int, pattern: tuple[IntArray, IntArray]) -> casadi.Sparsity:
    rows, starts = pattern
    return casadi.Sparsity(height, width, starts.tolist(), rows.tolist())


class _Wrapped(casadi.Callback):
    """A Python function that reads and writes CasADi's buffers."""

    def __init__(
        self,
        name: str,
        ins: Sequence[Port],
        outs: Sequence[Port],
        function: Callable[[Any, Any], int],
    ) -> None:
        casadi.Callback.__init__(self)
        self.ins, self.outs, self.function = ins, outs, function
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self.ins)

    def get_n_out(self) -> int:
        return len(self.outs)

    def get_name_in(self, i: int) -> str:
        return self.ins[i][0]

    def get_name_out(self, i: int) -> str:
        return self.outs[i][0]

    def get_sparsity_in(self, i: int) -> casadi.Sparsity:
        return self.ins[i][1]

    def get_sparsity_out(self, i: int) -> casadi.Sparsity:
        return self.outs[i][1]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arg: Any, res: Any) -> int:
        return self.function(arg, res)
