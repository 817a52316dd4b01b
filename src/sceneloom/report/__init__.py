"""A page about a drive that one can send: what is in it, whether it is in order, and what it looks like.

`sceneloom report DRIVE -o report.html` is this.
"""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.report.numbers.drive import DriveReport
    from sceneloom.report.settings import ReportSettings
    from sceneloom.report.writing import numbers_as_json, write_report
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "DriveReport": "sceneloom.report.numbers.drive:DriveReport",
            "ReportSettings": "sceneloom.report.settings:ReportSettings",
            "numbers_as_json": "sceneloom.report.writing:numbers_as_json",
            "write_report": "sceneloom.report.writing:write_report",
        },
    )

__all__ = [
    "DriveReport",
    "ReportSettings",
    "numbers_as_json",
    "write_report",
]
