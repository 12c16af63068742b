"""The validation report: one self-contained HTML page for people."""

from dfsm.report.html import write_report

__all__ = ["write_report"]
