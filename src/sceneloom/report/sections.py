"""Sections of the page about the recording: sensors, source, timing, coverage, trajectory."""

from itertools import pairwise

from sceneloom.report.content import (
    MOST_STREAMS,
    NOTHING,
    Block,
    Column,
    Drawing,
    Section,
    Table,
    bars,
    columns,
    count,
    degrees_text,
    draw_around,
    draw_plan,
    draw_streams,
    fixed,
    histogram,
    line_plot,
    megabytes,
    middle_text,
    percent,
    several,
)
from sceneloom.report.coverage import CameraView, CloudCoverage, Coverage
from sceneloom.report.drive_report import DriveReport
from sceneloom.report.timing import StreamTiming, Timing
from sceneloom.report.trajectory import Fixes, Trajectories, TrajectoryMetrics
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


_HASHED = {
    "file": "SHA-256 of the file, as `sha256sum` gives it",
    "folder": "SHA-256 of the names and contents of all files, in order of the names",
    "ends": "SHA-256 of the names, sizes, first and last megabytes of all files: it is too large to read it all",
}

_SOURCE_COLUMNS = (Column("What", numeric=False), Column("Value", numeric=False, wide=True))


def source_section(report: DriveReport) -> Section:
    """Report which data, versions and settings the report stands on."""
    made = report.provenance
    rows = [
        ["Source", report.summary.source],
        ["Format", report.summary.format],
        ["Made", made.made],
        ["sceneloom", made.sceneloom],
        ["Python", f"{made.python} on {made.system}"],
        ["Packages", ", ".join(f"{name} {version}" for name, version in made.packages.items())],
        [
            "Settings",
            ", ".join(f"{name} = {value}" for name, value in made.settings.items()) or "the usual ones",
        ],
    ]
    if made.size_bytes is not None:
        rows.append(["Size", megabytes(made.size_bytes)])
    if made.sha256 is not None:
        rows.append([_HASHED.get(made.hashed or "", "SHA-256"), made.sha256])
    reported = [[name, text] for name, text in made.reported.items()]
    tables = [
        Table("Where this report comes from", _SOURCE_COLUMNS, rows),
        Table(
            f"What the drive reports itself: {len(reported)} entries of its metadata",
            _SOURCE_COLUMNS,
            reported,
            folded=True,
        ),
    ]
    return Section(key="source", name="Provenance", blocks=[Block(tables=tables)])


_MOST_PLOTS = 12

_TIMING_COLUMNS = (
    Column("Stream", numeric=False),
    Column("Rate [Hz]"),
    Column("Interval [ms]"),
    Column("Jitter [ms]"),
    Column("Longest [ms]"),
    Column("Gaps"),
    Column("Missing"),
    Column("Repeated or backwards"),
    Column("Beside the reference [ms]"),
)


def timing_section(report: DriveReport) -> Section:
    """Report how even the streams are, what is missing in them, and how they lie to one another."""
    timing = report.timing
    streams = [stream for stream in timing.streams if stream.count]
    blocks = [
        Block(plots=_overview(timing)),
        Block(
            tables=[
                Table(
                    "Rates, jitter and gaps of the streams",
                    _TIMING_COLUMNS,
                    [_timing_row(s) for s in streams],
                )
            ]
        ),
        Block(lines=_explained(timing), faint=True),
        Block(tables=[_gaps(streams)]),
        Block(heading="Intervals", plots=_intervals(streams)) if _intervals(streams) else Block(),
    ]
    facts = [("All streams together", percent(timing.overlap_share, 0))] if len(streams) > 1 else []
    absent = None if streams else "No stream has a timestamp."
    return Section(key="timing", name="Timing and gaps", absent=absent, facts=facts, blocks=blocks)


def _overview(timing: Timing) -> list[Drawing]:
    svg = draw_streams(timing)
    if svg is None:
        return []
    gaps = sum(stream.gap_count for stream in timing.streams)
    reported = "; ".join(
        f"{s.name} from {s.start:.2f} to {s.stop:.2f} s"
        for s in timing.streams[:MOST_STREAMS]
        if s.start is not None
    )
    caption = "Bars: from the first timestamp to the last. Red: gaps. Green behind: when all give something."
    return [Drawing("Streams over time", f"{several(gaps, 'gap')}. {reported}", svg, caption, kind="wide")]


def _timing_row(stream: StreamTiming) -> list[str]:
    phase = stream.phase
    return [
        stream.name,
        fixed(stream.rate_hz, 2),
        fixed(stream.period_ms, 2),
        fixed(stream.jitter_ms, 3),
        fixed(stream.longest_ms, 1),
        count(stream.gap_count),
        f"{stream.missing:,} ({percent(stream.missing_share)})" if stream.missing else "0",
        f"{stream.repeated:,} / {stream.backwards:,}",
        NOTHING if phase is None else f"{phase.median_ms:+.2f} ± {phase.spread_ms:.2f}",
    ]


def _explained(timing: Timing) -> list[str]:
    references = {stream.phase.reference for stream in timing.streams if stream.phase is not None}
    reported = (
        "Jitter is the standard deviation of the intervals that are no gaps; a gap is longer than 1.5 usual intervals; "
        "missing is how many would fill the gaps."
    )
    if references:
        reported += (
            f" Beside the reference: how much later than the nearest timestamp of {', '.join(map(str, references))} "
            "timestamps are, the middle one and what holds 95 % of them; timestamps of sweeps are their starts."
        )
    return [reported]


def _gaps(streams: list[StreamTiming]) -> Table:
    rows = [
        [stream.name, fixed(gap.start, 3), fixed(gap.stop, 3), fixed(gap.stop - gap.start, 3)]
        for stream in streams
        for gap in stream.gaps
    ]
    untold = sum(max(stream.gap_count - len(stream.gaps), 0) for stream in streams)
    columns = (Column("Stream", numeric=False), Column("From [s]"), Column("To [s]"), Column("Length [s]"))
    more = f"{untold:,} shorter gaps are not listed." if untold else ""
    return Table(f"Gaps: {len(rows)}", columns, rows, folded=len(rows) > 5, more=more)


def _intervals(streams: list[StreamTiming]) -> list[Drawing]:
    found: list[Drawing] = []
    for stream in streams:
        if stream.bins is None or stream.period_ms is None or len(found) >= _MOST_PLOTS or stream.count < 4:
            continue
        svg = histogram(stream.bins.edges_ms, stream.bins.counts, x_name="interval [ms]", y_name="count")
        reported = (
            f"Most intervals are about {stream.period_ms:.2f} ms; the longest is {stream.longest_ms:.1f} ms"
        )
        found.append(Drawing(f"Intervals of {stream.name}", reported, svg))
    return found


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


_TRAJECTORIES = (
    Column("TrajectoryMetrics", numeric=False),
    Column("Poses"),
    Column("Seconds"),
    Column("Length [m]"),
    Column("Mean speed [m/s]"),
    Column("Top speed [m/s]"),
    Column("Stationary"),
    Column("Rotated [deg]"),
    Column("Heights [m]"),
    Column("Up / down [m]"),
)

_FIXES = (
    Column("Receiver", numeric=False),
    Column("Fixes"),
    Column("First", numeric=False),
    Column("Last", numeric=False),
    Column("Height, first and last [m]"),
    Column("Accuracy, middle and worst [m]"),
)


def trajectory_section(report: DriveReport) -> Section:
    """Draw the trajectories, and state how long, fast and high they are."""
    trajectories = report.trajectories
    plots = [*_over_time(trajectories)]
    tables = [
        Table(
            "Ways of the ego",
            _TRAJECTORIES,
            [_trajectory_row(trajectory) for trajectory in trajectories.trajectories],
        ),
        Table("Satellite fixes", _FIXES, [_fixes_row(fixes) for fixes in trajectories.fixes]),
    ]
    missing = report.left_out.get("trajectory")
    return Section(
        key="trajectory",
        name="Trajectory and map",
        missing=missing,
        absent=None
        if trajectories.trajectories or trajectories.fixes
        else "There are neither poses of the ego nor satellite fixes.",
        blocks=[
            Block(plots=_plan(trajectories)),
            Block(plots=plots),
            Block(tables=tables),
            Block(lines=_north(trajectories), faint=True),
        ],
    )


def _plan(trajectories: Trajectories) -> list[Drawing]:
    svg = draw_plan(trajectories)
    if svg is None:
        return []
    reported = "; ".join(
        f"{trajectory.name}: {trajectory.metres:.1f} m in {trajectory.seconds:.1f} s, at most "
        f"{trajectory.farthest:.1f} m from its start"
        for trajectory in trajectories.trajectories
    )
    fixes = "; ".join(f"{each.usable} fixes of {each.sensor}" for each in trajectories.fixes)
    north = (
        "North is up."
        if trajectories.north or not trajectories.trajectories
        else "x of the world to the right, y up; north is not known."
    )
    middle = middle_text(trajectories)
    caption = (
        f"{north} Circle: start; square: end; dots: satellite fixes.{f' Middle: {middle}.' if middle else ''}"
    )
    return [
        Drawing(
            "The drive from above",
            "; ".join(filter(None, (reported, fixes))),
            svg,
            caption,
            "map",
        )
    ]


def _over_time(trajectories: Trajectories) -> list[Drawing]:
    lines = [trajectory.corners for trajectory in trajectories.trajectories if len(trajectory.corners) > 1]
    if not lines:
        return []
    speeds = [[(corner.seconds, corner.speed) for corner in line] for line in lines]
    heights = [[(corner.seconds, corner.z) for corner in line] for line in lines]
    first = trajectories.trajectories[0]
    names = "" if len(lines) < 2 else "Colours as on the map."
    return [
        Drawing(
            "Speed",
            f"{first.name}: {first.mean_speed:.1f} m/s on the average, {first.top_speed:.1f} m/s at the top",
            line_plot(speeds, x_name="time [s]", y_name="speed [m/s]", with_zero=True),
            names,
        ),
        Drawing(
            "Height",
            f"{first.name}: from {first.lowest:.1f} to {first.highest:.1f} m",
            line_plot(heights, x_name="time [s]", y_name="height z [m]"),
            names,
        ),
    ]


def _trajectory_row(trajectory: TrajectoryMetrics) -> list[str]:
    return [
        f"{trajectory.name} (found now)" if trajectory.found_now else trajectory.name,
        count(trajectory.poses),
        fixed(trajectory.seconds, 2),
        fixed(trajectory.metres, 1),
        fixed(trajectory.mean_speed, 2),
        fixed(trajectory.top_speed, 2),
        percent(trajectory.stationary_share, 0),
        NOTHING if trajectory.rotated_deg is None else fixed(trajectory.rotated_deg, 0),
        f"{fixed(trajectory.lowest, 1)} to {fixed(trajectory.highest, 1)}",
        f"{trajectory.climb:.1f} / {trajectory.descent:.1f}",
    ]


def _fixes_row(fixes: Fixes) -> list[str]:
    accuracy = (
        NOTHING if fixes.accuracy_m is None else f"{fixes.accuracy_m:.2f} / {fixes.worst_accuracy_m:.2f}"
    )
    return [
        str(fixes.sensor),
        f"{fixes.count:,}" if fixes.usable == fixes.count else f"{fixes.usable:,} usable of {fixes.count:,}",
        _location_text(fixes.first_lla),
        _location_text(fixes.last_lla),
        f"{fixes.first_lla[2]:.1f} / {fixes.last_lla[2]:.1f}",
        accuracy,
    ]


def _location_text(lla: tuple[float, float, float]) -> str:
    """Latitude and longitude."""
    reported = f"{degrees_text(lla[0], 'NS')}, {degrees_text(lla[1], 'EW')}"
    return reported.replace(" ", "\N{NO-BREAK SPACE}")


def _north(trajectories: Trajectories) -> list[str]:
    if trajectories.north is None or trajectories.north.rms is None:
        return []
    reported = (
        f"North is {trajectories.north.direction_deg:.1f}° counter-clockwise from x of the world: the fixes were laid "
        f"onto "
        f"“{trajectories.north.trajectory}” by a shift and a rotation, and lie {trajectories.north.rms:.2f} m from it "
        f"(root of the mean square)."
    )
    return [reported]
