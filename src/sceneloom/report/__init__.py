"""Reports on drives: what is in a drive, whether it is usable, and what it looks like, as one HTML page and as JSON.

`sceneloom report DRIVE -o report.html` writes one.
"""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.report.drive_report import DriveReport
    from sceneloom.report.page import ReportSettings, write_report
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__, {"drive_report": "DriveReport", "page": "ReportSettings write_report"}
    )

__all__ = ["DriveReport", "ReportSettings", "write_report"]
