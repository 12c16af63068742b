"""Self-contained HTML pages for people: about models, validated or not, and optimal controls."""

from dfsm.report.model_card import write_model_card
from dfsm.report.solution_page import write_solution_report
from dfsm.report.validation_page import write_report

__all__ = ["write_model_card", "write_report", "write_solution_report"]
