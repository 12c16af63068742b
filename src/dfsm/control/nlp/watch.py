"""What happens during a solve: Ctrl-C, errors in callbacks, and the best iterate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dfsm.control.nlp.program import Program
from dfsm.core.types import Array

# Violations (scaled) up to which an iterate counts as feasible when the best is chosen.
_FEASIBLE = 1e-6


class Watch:
    """What happens during a solve: Ctrl-C, errors in callbacks, and the best iterate."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.stop = False
        self.error: BaseException | None = None
        self.best: tuple[Array, Array, Array] | None = None
        self._merit = (np.inf, np.inf)

    def call(self, function: Callable[..., Any], arg: Any, res: Any) -> int:
        """Evaluate a function on the solver's buffers; 1 if it raised an error."""
        values = [np.empty(0) if a is None else np.frombuffer(a) for a in arg]
        try:
            with np.errstate(all="ignore"):  # the solver steps back from values that are not finite
                results = function(*values)
        except Exception as error:  # it cannot pass through the solver
            self.error, self.stop = error, True
            return 1
        for buffer, value in zip(res, results, strict=True):
            if buffer is not None:
                np.frombuffer(buffer)[:] = value
        return 0

    def step(self, names: list[str]) -> Callable[..., Any]:
        """Function that sees every iterate, as values by name, and says whether to stop."""
        x, g, f, lam_g, lam_x = (names.index(k) for k in ("x", "g", "f", "lam_g", "lam_x"))

        def seen(*values: Array) -> tuple[float]:
            worst = violation(values[g], self.program.g_lower, self.program.g_upper)
            amount = float(worst.max(initial=0.0))
            merit = (amount if amount > _FEASIBLE else 0.0, float(values[f][0]))
            if np.isfinite(merit).all() and merit < self._merit:
                self._merit = merit
                self.best = (values[x].copy(), values[lam_g].copy(), values[lam_x].copy())
            return (float(self.stop),)

        return seen


def violation(g: Array, low: Array, high: Array) -> Array:
    """How far values are beyond their limits, elementwise; infinite where they are NaN."""
    return np.where(np.isfinite(g), np.maximum(0.0, np.maximum(low - g, g - high)), np.inf)
