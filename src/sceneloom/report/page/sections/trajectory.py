"""Where the ego went."""

from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.numbers.trajectories import Fixes, Trajectories, TrajectoryMetrics
from sceneloom.report.page.content import Block, Column, Drawing, Section, Table
from sceneloom.report.page.texts import NOTHING, count, fixed, percent
from sceneloom.report.plots import degrees_text, draw_plan, line_plot, middle_text

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
        location_text(fixes.first_lla),
        location_text(fixes.last_lla),
        f"{fixes.first_lla[2]:.1f} / {fixes.last_lla[2]:.1f}",
        accuracy,
    ]


def location_text(lla: tuple[float, float, float]) -> str:
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
