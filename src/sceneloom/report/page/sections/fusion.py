"""What fusing some sweeps gives."""

from sceneloom.pipeline.fusing.report import CameraReport
from sceneloom.report.figures import Figures
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.numbers.fusing import Fusion
from sceneloom.report.page.content import Block, Column, Section, Table
from sceneloom.report.page.texts import NOTHING, count, several

_COLUMNS = (
    Column("Camera", numeric=False),
    Column("Sweeps with an image"),
    Column("Without one in time"),
    Column("Beyond the trajectory"),
    Column("Later than its sweep [ms]"),
    Column("Points in the image"),
    Column("Hidden of these"),
    Column("Points coloured"),
)


def fusion_section(report: DriveReport, figures: Figures) -> Section:
    """Show coloured clouds and depth images, with the counts behind them."""
    fusion = report.fusion
    missing = report.left_out.get("fusion")
    if fusion is None:
        return Section(
            key="fusion",
            name="Fusion",
            missing=missing,
            absent="There is no lidar whose points could be fused.",
        )
    rows = [_row(camera, fusion) for camera in fusion.cameras]
    facts = [
        ("Sweeps fused", f"{fusion.sweeps:,} of {fusion.of:,}"),
        ("Points coloured", f"{fusion.coloured_percent:.1f} %"),
        ("Trajectory of the ego", fusion.trajectory or "sensors' own poses"),
    ]
    unfused = [f"{several(number, 'sweep')}: {reason}" for reason, number in fusion.unfused.items()]
    left = f"{several(figures.left_out, 'image')} more had no room on the page." if figures.left_out else ""
    return Section(
        key="fusion",
        name="Fusion",
        missing=missing,
        facts=facts,
        blocks=[
            Block(photos=figures.of("fusion")),
            Block(tables=[Table("Images and points of the fused sweeps", _COLUMNS, rows)] if rows else []),
            Block(lines=[left] if left else [], faint=True),
            Block(list_title="Sweeps that could not be fused", listed=unfused),
            Block(list_title=f"Could not be read: {len(fusion.skipped)}", listed=fusion.skipped[:50]),
        ],
    )


def _row(camera: CameraReport, fusion: Fusion) -> list[str]:
    later = fusion.time_differences_ms.get(str(camera.camera))
    return [
        str(camera.camera),
        count(camera.paired),
        count(camera.unpaired),
        count(camera.unposed),
        NOTHING if later is None else f"{later:+.1f}",
        f"{camera.in_image_percent:.1f} %",
        f"{camera.hidden_percent:.1f} %",
        count(camera.coloured),
    ]
