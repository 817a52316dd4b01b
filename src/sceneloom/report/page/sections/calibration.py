"""Whether points and images lie to one another as the calibration says."""

from sceneloom.report.figures import Figures
from sceneloom.report.numbers.calibration import CalibrationCheck
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.page.content import Block, Column, Section, Table
from sceneloom.report.page.texts import NOTHING

_COLUMNS = (
    Column("Part", numeric=False),
    Column("Verdict", numeric=False),
    Column("Would have to change by"),
    Column("Why", numeric=False, wide=True),
)
_BADGES = {"good": "good", "wrong": "error", "drifting": "warning", "cannot determine": "hint"}


def calibration_section(report: DriveReport, figures: Figures) -> Section:
    """Show overlays, and what a quick check says."""
    photos = figures.of("calibration")
    blocks = [Block(photos=photos)]
    if photos:
        reported = (
            "Discs: points of the lidar, coloured by depth; grey crosses: points behind something nearer. Where the "
            "calibration is right, jumps in depth follow the edges of things in the image."
        )
        blocks.append(Block(lines=[reported], faint=True))
    blocks += [_check(check) for check in report.calibration]
    if report.calibration:
        frames = max(check.frames for check in report.calibration)
        reported = f"A quick check by {frames} images of each camera; `sceneloom calibrate DRIVE --check` takes more."
        blocks.append(Block(lines=[reported], faint=True))
    missing = report.left_out.get("calibration")
    absent = None if photos or report.calibration else "There are no points in images to judge it by."
    return Section(key="calibration", name="Calibration", missing=missing, absent=absent, blocks=blocks)


def _check(check: CalibrationCheck) -> Block:
    rows = [
        [
            item.name.replace("_", " "),
            str(item.verdict.value),
            ", ".join(f"{v:+.2f} ± {s:.2f}" for v, s in zip(item.values, item.sigmas, strict=True))
            + f" {item.unit}"
            if item.values
            else NOTHING,
            item.reason or NOTHING,
        ]
        for item in check.items
    ]
    title = f"Parts of the calibration of {check.camera}"
    return Block(
        heading=f"{check.camera} against {check.lidar}",
        badge=(_BADGES.get(check.verdict, "hint"), check.verdict),
        lines=[check.reason] if check.reason else [],
        tables=[Table(title, _COLUMNS, rows, folded=True)] if rows else [],
    )
