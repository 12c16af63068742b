"""Self-contained HTML pages for people: about validated models, and about optimal controls."""

from dfsm.report.html import write_report
from dfsm.report.solution import write_solution_report

__all__ = ["write_report", "write_solution_report"]
