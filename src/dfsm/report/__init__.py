"""Self-contained HTML pages for people: about models, validated or not, and optimal controls.

Each is imported when it is first used: a page about a model needs nothing of optimal control.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dfsm.report.model_card import write_model_card
    from dfsm.report.solution_page import write_solution_report
    from dfsm.report.validation_page import write_report

__all__ = ["write_model_card", "write_report", "write_solution_report"]
_HOME = {
    "write_model_card": "model_card",
    "write_report": "validation_page",
    "write_solution_report": "solution_page",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'dfsm.report' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"dfsm.report.{_HOME[name]}"), name)
    globals()[name] = value
    return value
