"""What is stated about the drive."""

from itertools import pairwise

from sceneloom.report.figures import Figures
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.numbers.labels import ClassNumbers, Labels, Spread
from sceneloom.report.page.content import Block, Column, Drawing, Section, Table
from sceneloom.report.page.texts import NOTHING, count, percent, several
from sceneloom.report.plots import bars, columns, line_plot

MOST_CLASSES = 40
_MOST_BARS = 14
_COLUMNS = (
    Column("Class", numeric=False),
    Column("Objects"),
    Column("Boxes stated"),
    Column("Stationary"),
    Column("Length [m]"),
    Column("Width [m]"),
    Column("Height [m]"),
    Column("There for [s]"),
    Column("Range [m]"),
    Column("Points inside"),
    Column("Without a point"),
    Column("Hidden in images"),
    Column("In an image"),
)


def annotations_section(report: DriveReport, figures: Figures) -> Section:
    """Report how many objects of which class there are, how large, how far, how well seen."""
    labels = report.labels
    missing = report.left_out.get("annotations")
    if labels is None:
        return Section(
            key="annotations", name="Annotations", missing=missing, absent="There are no annotations."
        )
    rows = [_row(numbers) for numbers in labels.classes[:MOST_CLASSES]]
    rest = labels.classes[MOST_CLASSES:]
    more = f"{len(rest)} further classes with {sum(c.objects for c in rest):,} objects." if rest else ""
    tables = [
        Table(
            "Boxes in space by class: the middle value, and what 90 % lie between", _COLUMNS, rows, more=more
        )
    ]
    types = [[kind.replace("_", " "), count(number)] for kind, number in labels.types.items()]
    attributes = [[name, count(number)] for name, number in sorted(labels.attributes.items())[:100]]
    counted = Table("Annotations by type", (Column("Type", numeric=False), Column("Annotations")), types)
    stated = Table(
        f"Attributes of annotations: {len(labels.attributes)}",
        (Column("Attribute", numeric=False), Column("Annotations")),
        attributes,
        folded=True,
    )
    facts = [(kind.replace("_", " ").capitalize(), count(number)) for kind, number in labels.types.items()][
        :8
    ]
    return Section(
        key="annotations",
        name="Annotations",
        missing=missing,
        facts=facts,
        blocks=[
            Block(plots=_plots(labels)),
            Block(photos=figures.of("annotations")),
            Block(tables=[*tables, counted, stated]),
            Block(lines=_explained(labels), faint=True),
            Block(list_title=f"Not reported: {len(labels.skipped)}", listed=labels.skipped),
        ],
    )


def _plots(labels: Labels) -> list[Drawing]:
    found = []
    shown = labels.classes[:_MOST_BARS]
    if shown:
        names, objects = [c.label for c in shown], [c.objects for c in shown]
        text = "; ".join(f"{name} {number:,}" for name, number in zip(names, objects, strict=True))
        svg = bars(names, objects, labels=[f"{number:,}" for number in objects])
        found.append(Drawing("Objects by class", text, svg))
    if len(labels.over_time) > 1:
        svg = line_plot([labels.over_time], x_name="time [s]", y_name="boxes", with_zero=True)
        most = max(number for _, number in labels.over_time)
        found.append(Drawing("Boxes over time", f"At most {most:,} boxes at one time", svg))
    if labels.range_counts:
        svg = columns(_ranges(labels.range_edges), labels.range_counts, x_name="range [m]", y_name="boxes")
        found.append(
            Drawing("Boxes by range", f"Boxes at {several(labels.moments, 'moment')} by distance", svg)
        )
    if labels.point_counts:
        names = [_points(a, b) for a, b in pairwise(labels.point_edges)]
        svg = columns(
            [*names, f"{labels.point_edges[-1]}+"],
            labels.point_counts,
            x_name="points inside",
            y_name="boxes",
        )
        text = f"{labels.point_counts[0]:,} of {sum(labels.point_counts):,} boxes hold no point"
        found.append(Drawing("Boxes by points inside", text, svg))
    return found


def _ranges(edges: tuple[float, ...]) -> list[str]:
    return [*(f"{a:g}–{b:g}" for a, b in pairwise(edges)), f"{edges[-1]:g}+"]


def _points(low: int, high: int) -> str:
    return str(low) if high == low + 1 else f"{low}–{high - 1}"


def _row(numbers: ClassNumbers) -> list[str]:
    return [
        numbers.label,
        count(numbers.objects),
        count(numbers.key_frames),
        count(numbers.stationary),
        _spread(numbers.length, 1),
        _spread(numbers.width, 1),
        _spread(numbers.height, 1),
        _spread(numbers.seconds, 1),
        _spread(numbers.ranges, 0),
        _spread(numbers.points, 0),
        percent(numbers.empty_share, 0),
        NOTHING if numbers.hidden is None else percent(numbers.hidden.median, 0),
        percent(numbers.in_images_share, 0),
    ]


def _spread(spread: Spread | None, digits: int) -> str:
    if spread is None:
        return NOTHING
    middle = f"{spread.median:.{digits}f}"
    if spread.count == 1 or spread.high - spread.low < 0.5 * 10**-digits:
        return middle
    return f"{middle} ({spread.low:.{digits}f}–{spread.high:.{digits}f})"


def _explained(labels: Labels) -> list[str]:
    if not labels.moments:
        return []
    reported = (
        f"Ranges, points and what hides boxes are of {several(labels.moments, 'moment')} out of {labels.of:,}, spread "
        "over the drive. Hidden: the share of a box's area in an image that nearer boxes cover, the middle value."
    )
    return [reported]
