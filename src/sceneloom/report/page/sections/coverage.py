"""What the sensors see of the surroundings."""

from itertools import pairwise

from sceneloom.report.numbers.clouds import CloudCoverage
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.numbers.surroundings import CameraView, Coverage
from sceneloom.report.page.content import Block, Column, Drawing, Section, Table
from sceneloom.report.page.texts import NOTHING, count, fixed, percent
from sceneloom.report.plots import bars, columns, draw_around

_CLOUDS = (
    Column("Sensor", numeric=False),
    Column("Sweeps looked at"),
    Column("Points of a sweep"),
    Column("Least / most"),
    Column("Range: middle / 95 % / farthest [m]"),
    Column("Elevation [deg]"),
    Column("Horizon"),
    Column("Rings"),
    Column("Nowhere"),
    Column("Points have", numeric=False),
)
_CAMERAS = (
    Column("Camera", numeric=False),
    Column("CameraModel", numeric=False),
    Column("CameraImage [px]"),
    Column("Across / upright [deg]"),
    Column("Looks to [deg]"),
    Column("Up [deg]"),
    Column("Points in the image"),
    Column("Hidden of these"),
)
_AHEAD = {"motion": "by the motion", "camera": "by the first camera", "axes": "by the axes of the sensors"}
_MOST_CLOUDS = 6


def coverage_section(report: DriveReport) -> Section:
    """Report which part of the surroundings each sensor sees, and how densely."""
    coverage = report.coverage
    clouds = [cloud for cloud in coverage.clouds if cloud.sweeps]
    plots = [*_around(coverage), *(plot for cloud in clouds[:_MOST_CLOUDS] for plot in _plots(cloud))]
    plots += _shares(report)
    tables = [
        Table("Lidars and radars", _CLOUDS, [_cloud_row(cloud) for cloud in coverage.clouds]),
        Table("Cameras", _CAMERAS, [_camera_row(camera, report) for camera in coverage.cameras]),
    ]
    missing = report.left_out.get("coverage")
    absent = None if coverage.clouds or coverage.cameras else "There is no lidar, radar or camera."
    facts = [
        ("Horizon seen by lidars", percent(coverage.lidar_share, 0)),
        ("By cameras", percent(coverage.camera_share, 0)),
        ("By both", percent(coverage.both_share, 0)),
    ]
    return Section(
        key="coverage",
        name="Coverage",
        missing=missing,
        absent=absent,
        facts=facts if coverage.clouds or coverage.cameras else [],
        blocks=[
            Block(plots=plots),
            Block(tables=tables),
            Block(list_title=f"Not looked at: {len(coverage.skipped)}", listed=coverage.skipped),
        ],
    )


def _around(coverage: Coverage) -> list[Drawing]:
    svg = draw_around(coverage)
    if svg is None:
        return []
    looks = [
        f"{camera.sensor} from {camera.left_deg:.0f}° to {camera.right_deg:.0f}°"
        for camera in coverage.cameras
        if camera.left_deg is not None
    ]
    reaches = [
        f"{c.sensor} sees {percent(c.horizon_share, 0)} of the horizon" for c in coverage.clouds if c.sweeps
    ]
    caption = (
        f"Ahead, reported {_AHEAD[coverage.ahead_by]}, is up. Outlines: within them lie 95 % of the points of each "
        "direction, from the sensor. Wedges: the middle rows of the images; their length means nothing."
    )
    text = "; ".join([*reaches, *looks])
    return [Drawing("Around the ego", text, svg, caption, kind="tall")]


def _plots(cloud: CloudCoverage) -> list[Drawing]:
    found = []
    if cloud.range_counts:
        edges = [*(f"{edge:g}" for edge in cloud.range_edges)]
        names = [*(f"{a}–{b}" for a, b in pairwise(edges)), f"{edges[-1]}+"]
        svg = columns(names, cloud.range_counts, x_name="range [m]", y_name="points of a sweep")
        reported = (
            f"Half of the points lie within {cloud.range_median:.0f} m, 95 % within {cloud.range_95:.0f} m"
        )
        found.append(Drawing(f"Points of {cloud.sensor} by range", reported, svg))
    if len(cloud.rings) > 1:
        first = next(k for k, number in enumerate(cloud.rings) if number)
        names, rings = [str(k) for k in range(first, len(cloud.rings))], cloud.rings[first:]
        svg = columns(names, rings, x_name="number of the ring", y_name="points of a sweep")
        reported = f"{len(rings)} rings with {min(rings):,.0f} to {max(rings):,.0f} points of a sweep"
        found.append(Drawing(f"Points of {cloud.sensor} by ring", reported, svg))
    return found


def _shares(report: DriveReport) -> list[Drawing]:
    cameras = [] if report.fusion is None else [camera for camera in report.fusion.cameras if camera.paired]
    if not cameras:
        return []
    names = [str(camera.camera) for camera in cameras]
    shares = [camera.in_image_percent for camera in cameras]
    reported = [f"{share:.1f} %" for share in shares]
    text = "; ".join(f"{name} {share}" for name, share in zip(names, reported, strict=True))
    svg = bars(names, shares, labels=reported, most=max(100.0 if max(shares) > 50 else 50.0, *shares))
    return [Drawing("Share of all points in each camera's images", text, svg)]


def _cloud_row(cloud: CloudCoverage) -> list[str]:
    has = [
        name
        for name, there in (
            ("times", cloud.with_times),
            ("intensities", cloud.with_intensities),
            ("colours", cloud.with_colours),
        )
        if there
    ]
    return [
        f"{cloud.sensor} ({cloud.type})",
        f"{cloud.sweeps:,} of {cloud.of:,}",
        count(cloud.points_mean),
        f"{cloud.points_least:,} / {cloud.points_most:,}",
        f"{cloud.range_median:.1f} / {cloud.range_95:.1f} / {cloud.range_max:.1f}",
        f"{cloud.lowest_deg:.1f} to {cloud.highest_deg:.1f}",
        percent(cloud.horizon_share, 0),
        count(sum(number > 0 for number in cloud.rings)) if cloud.rings else NOTHING,
        percent(cloud.non_finite_share),
        ", ".join(has) or NOTHING,
    ]


def _camera_row(camera: CameraView, report: DriveReport) -> list[str]:
    cameras = () if report.fusion is None else report.fusion.cameras
    fused = next((each for each in cameras if each.camera == camera.sensor and each.paired), None)
    return [
        str(camera.sensor),
        camera.model.replace("_", " "),
        f"{camera.width}×{camera.height}",
        NOTHING
        if camera.across_deg is None
        else f"{camera.across_deg:.0f} / {camera.upright_deg or 0.0:.0f}",
        NOTHING if camera.heading_deg is None else _direction(camera.heading_deg),
        fixed(camera.pitch_deg, 1),
        NOTHING if fused is None else f"{fused.in_image_percent:.1f} %",
        NOTHING if fused is None else f"{fused.hidden_percent:.1f} %",
    ]


def _direction(degrees: float) -> str:
    """A direction in words: 0 ahead, left positive."""
    words = ("ahead", "ahead left", "left", "back left", "back", "back right", "right", "ahead right")
    return f"{degrees:+.0f} ({words[round(degrees / 45.0) % 8]})"
