"""How far what was found is from the truth."""

from sceneloom.evaluate.report import TrajectoryReport
from sceneloom.evaluate.tracking.comparison import TrackingReport
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.page.content import Block, Column, Section, Table
from sceneloom.report.page.texts import NOTHING, count, fixed, percent, warning_text

_TRAJECTORIES = (
    Column("TrajectoryMetrics", numeric=False),
    Column("Against", numeric=False),
    Column("Pairs"),
    Column("Covered"),
    Column("Away, rms / largest [m]"),
    Column("Level / upright rms [m]"),
    Column("Rotated, rms [deg]"),
    Column("Drift over 10 m [%]"),
    Column("KITTI [%]"),
)
_TRACKS = (
    Column("Class", numeric=False),
    Column("HOTA"),
    Column("DetA"),
    Column("AssA"),
    Column("MOTA"),
    Column("IDF1"),
    Column("Switches"),
    Column("True objects"),
    Column("Found objects"),
)


def truth_section(report: DriveReport) -> Section | None:
    """Show errors of trajectories and figures of tracks; None where nothing was compared."""
    metrics = report.metrics
    missing = report.left_out.get("truth")
    if not metrics.trajectories and metrics.tracks is None and not metrics.skipped and missing is None:
        return None
    trajectories = Table(
        "Ways against their reference, aligned by shift and rotate",
        _TRAJECTORIES,
        [_trajectory(w) for w in metrics.trajectories],
    )
    notes = [warning_text(warning) for trajectory in metrics.trajectories for warning in trajectory.warnings]
    tracks = [] if metrics.tracks is None else [_tracks(metrics.tracks)]
    return Section(
        key="truth",
        name="Against the truth",
        missing=missing,
        blocks=[
            Block(tables=[trajectories] if metrics.trajectories else []),
            Block(tables=tracks),
            Block(list_title=f"Notes: {len(notes)}", listed=notes),
            Block(list_title=f"Could not be compared: {len(metrics.skipped)}", listed=metrics.skipped),
        ],
    )


def _trajectory(trajectory: TrajectoryReport) -> list[str]:
    away = trajectory.absolute
    ten = next((step for step in trajectory.relative if step.delta == "10m"), None)
    rotated = away.rotation_deg
    return [
        trajectory.estimate,
        trajectory.reference,
        count(trajectory.pairs),
        percent(trajectory.coverage, 0),
        f"{away.translation.rms:.3f} / {away.translation.max:.3f}",
        f"{away.horizontal.rms:.3f} / {away.vertical.rms:.3f}",
        NOTHING if rotated is None else fixed(rotated.rms, 3),
        NOTHING if ten is None else fixed(ten.translation_percent, 2),
        NOTHING if trajectory.kitti is None else fixed(trajectory.kitti.overall.translation_percent, 2),
    ]


def _tracks(tracks: TrackingReport) -> Table:
    rows = []
    for label, numbers in tracks.classes.items():
        one = numbers.combined
        shares = (one.hota.hota, one.hota.deta, one.hota.assa, one.clear.mota, one.identity.idf1)
        rows.append(
            [
                label,
                *(f"{100 * share:.1f}" for share in shares),
                count(one.clear.idsw),
                count(one.true_objects),
                count(one.found_objects),
            ]
        )
    return Table(
        f"Objects against {tracks.truth}, by boxes of the kind {tracks.similarity} [%]", _TRACKS, rows
    )
