"""Self-contained HTML pages for people: about validated models, and about optimal controls."""

from dfsm.report.solution_page import write_solution_report
from dfsm.report.validation_page import write_report

__all__ = ["write_report", "write_solution_report"]
