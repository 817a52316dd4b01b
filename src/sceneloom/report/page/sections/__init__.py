"""The sections of a report's page, one module each: numbers in, blocks of texts, tables and drawings out."""

from sceneloom.report.page.sections.annotations import annotations_section
from sceneloom.report.page.sections.calibration import calibration_section
from sceneloom.report.page.sections.coverage import coverage_section
from sceneloom.report.page.sections.drive import drive_section
from sceneloom.report.page.sections.findings import findings_section
from sceneloom.report.page.sections.fusion import fusion_section
from sceneloom.report.page.sections.notices import notices_section
from sceneloom.report.page.sections.source import source_section
from sceneloom.report.page.sections.timing import timing_section
from sceneloom.report.page.sections.trajectory import trajectory_section
from sceneloom.report.page.sections.truth import truth_section

__all__ = [
    "annotations_section",
    "calibration_section",
    "coverage_section",
    "drive_section",
    "findings_section",
    "fusion_section",
    "notices_section",
    "source_section",
    "timing_section",
    "trajectory_section",
    "truth_section",
]
