"""Where the ego went."""

from sceneloom.report.drawings import degrees_text, draw_plan, line_plot, middle_text
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.numbers.ways import Fixes, Way, Ways
from sceneloom.report.page.content import Block, Column, Drawing, Section, Table
from sceneloom.report.page.texts import NOTHING, count, fixed, percent

_WAYS = (
    Column("Way", numeric=False),
    Column("Poses"),
    Column("Seconds"),
    Column("Length [m]"),
    Column("Mean speed [m/s]"),
    Column("Top speed [m/s]"),
    Column("Standing"),
    Column("Turned [deg]"),
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
    """Draw the ways, and say how long, fast and high they are."""
    ways = report.ways
    plots = [*_over_time(ways)]
    tables = [
        Table("Ways of the ego", _WAYS, [_way_row(way) for way in ways.ways]),
        Table("Satellite fixes", _FIXES, [_fixes_row(fixes) for fixes in ways.fixes]),
    ]
    missing = report.left_out.get("trajectory")
    return Section(
        key="trajectory",
        name="Trajectory and map",
        missing=missing,
        absent=None if ways.ways or ways.fixes else "There are neither poses of the ego nor satellite fixes.",
        blocks=[
            Block(drawings=_plan(ways)),
            Block(drawings=plots),
            Block(tables=tables),
            Block(lines=_north(ways), faint=True),
        ],
    )


def _plan(ways: Ways) -> list[Drawing]:
    svg = draw_plan(ways)
    if svg is None:
        return []
    told = "; ".join(
        f"{way.name}: {way.metres:.1f} m in {way.seconds:.1f} s, at most {way.farthest:.1f} m from its start"
        for way in ways.ways
    )
    fixes = "; ".join(f"{each.usable} fixes of {each.sensor}" for each in ways.fixes)
    north = (
        "North is up."
        if ways.north or not ways.ways
        else "x of the world to the right, y up; north is not known."
    )
    middle = middle_text(ways)
    caption = (
        f"{north} Circle: start; square: end; dots: satellite fixes.{f' Middle: {middle}.' if middle else ''}"
    )
    return [
        Drawing(
            "The drive from above",
            "; ".join(filter(None, (told, fixes))),
            svg,
            caption,
            "map",
        )
    ]


def _over_time(ways: Ways) -> list[Drawing]:
    lines = [way.corners for way in ways.ways if len(way.corners) > 1]
    if not lines:
        return []
    speeds = [[(corner.seconds, corner.speed) for corner in line] for line in lines]
    heights = [[(corner.seconds, corner.z) for corner in line] for line in lines]
    first = ways.ways[0]
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


def _way_row(way: Way) -> list[str]:
    return [
        f"{way.name} (found now)" if way.found_now else way.name,
        count(way.poses),
        fixed(way.seconds, 2),
        fixed(way.metres, 1),
        fixed(way.mean_speed, 2),
        fixed(way.top_speed, 2),
        percent(way.standing_share, 0),
        NOTHING if way.turned_deg is None else fixed(way.turned_deg, 0),
        f"{fixed(way.lowest, 1)} to {fixed(way.highest, 1)}",
        f"{way.climb:.1f} / {way.descent:.1f}",
    ]


def _fixes_row(fixes: Fixes) -> list[str]:
    accuracy = (
        NOTHING if fixes.accuracy_m is None else f"{fixes.accuracy_m:.2f} / {fixes.worst_accuracy_m:.2f}"
    )
    return [
        str(fixes.sensor),
        f"{fixes.count:,}" if fixes.usable == fixes.count else f"{fixes.usable:,} usable of {fixes.count:,}",
        place_text(fixes.first_lla),
        place_text(fixes.last_lla),
        f"{fixes.first_lla[2]:.1f} / {fixes.last_lla[2]:.1f}",
        accuracy,
    ]


def place_text(lla: tuple[float, float, float]) -> str:
    """Latitude and longitude."""
    told = f"{degrees_text(lla[0], 'NS')}, {degrees_text(lla[1], 'EW')}"
    return told.replace(" ", "\N{NO-BREAK SPACE}")


def _north(ways: Ways) -> list[str]:
    if ways.north is None or ways.north.rms is None:
        return []
    told = (
        f"North is {ways.north.direction_deg:.1f}° counter-clockwise from x of the world: the fixes were laid onto "
        f"“{ways.north.way}” by a shift and a turn, and lie {ways.north.rms:.2f} m from it (root of the mean square)."
    )
    return [told]
