"""A page about a drive that one can send: what is in it, whether it is in order, and what it looks like.

`sceneloom report DRIVE -o report.html` is this.
"""

from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.settings import ReportSettings
from sceneloom.report.writing import numbers_as_json, write_report

__all__ = ["DriveReport", "ReportSettings", "numbers_as_json", "write_report"]
