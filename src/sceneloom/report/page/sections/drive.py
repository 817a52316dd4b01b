"""What is in the drive: its sensors, one row each."""

from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.page.content import Block, Column, Section, Table
from sceneloom.report.page.texts import NOTHING, count, fixed, megabytes
from sceneloom.scene.summary import SensorSummary

_COLUMNS = (
    Column("Sensor", numeric=False),
    Column("Type", numeric=False),
    Column("Frames or samples"),
    Column("Rate"),
    Column("From"),
    Column("To"),
    Column("What it is", numeric=False, wide=True),
)


def drive_section(report: DriveReport) -> Section:
    """Report what is in the drive."""
    summary = report.summary
    trajectory = report.trajectories.trajectories[0] if report.trajectories.trajectories else None
    facts = [
        ("Length", fixed(summary.duration, 1, "s")),
        ("Sensors", count(len(summary.sensors))),
        ("TrajectoryMetrics", NOTHING if trajectory is None else fixed(trajectory.metres, 1, "m")),
        ("Annotations", count(sum(summary.annotations.values()))),
        ("Format", summary.format),
        ("Size", megabytes(summary.size_bytes)),
    ]
    table = Table("Sensors of the drive", _COLUMNS, [_row(sensor) for sensor in summary.sensors])
    empty = [] if summary.sensors else ["There is no sensor in it."]
    return Section(
        key="drive",
        name="What is in the drive",
        missing=report.left_out.get("contents"),
        facts=facts,
        blocks=[Block(lines=empty, tables=[table]), Block(lines=_sampled(report), faint=True)],
    )


def _row(sensor: SensorSummary) -> list[str]:
    details = [
        sensor.camera_model,
        sensor.video,
        None
        if sensor.first_frame_points is None
        else f"{sensor.first_frame_points:,} points in the first frame",
        sensor.coordinates,
        None if sensor.poses is None else f"{sensor.poses:,} poses",
        "mounted on the ego" if sensor.mounted else None,
    ]
    return [
        str(sensor.id),
        sensor.type.replace("_", " "),
        count(sensor.count),
        NOTHING if sensor.rate_hz is None else f"{sensor.rate_hz:.4g} Hz",
        fixed(sensor.start, 3, "s"),
        fixed(sensor.stop, 3, "s"),
        ", ".join(filter(None, details)) or NOTHING,
    ]


def _sampled(report: DriveReport) -> list[str]:
    return [f"Looked at in part: {'; '.join(report.sampling)}."] if report.sampling else []
