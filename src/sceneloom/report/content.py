"""What a page consists of: text formatting, tables, embedded images, and plots by matplotlib."""

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.geodesy import geodetic_from_enu
from sceneloom.report.coverage import Coverage
from sceneloom.report.timing import Timing
from sceneloom.report.trajectory import Trajectories
from sceneloom.visualization.canvas import PilImage
from sceneloom.warnings import DataWarning

_WIDTH_PX = 1100
"""Wider images are made smaller."""

_MOST_BYTES = 150_000
"""Of one image; its quality is lowered until it fits."""

_QUALITIES = (82, 74, 66, 56, 46)


@dataclass(frozen=True, slots=True)
class Photo:
    """One image of a report.

    Attributes:
        section: where on the page it stands.
        title: what it is, in a few words.
        text: what it shows, for those who cannot see it.
        width, height: [px].
        jpeg: its file.
    """

    section: str
    title: str
    text: str
    width: int
    height: int
    jpeg: bytes = field(repr=False)


@dataclass(slots=True)
class Figures:
    """Collects images for the sections of a report.

    Attributes:
        most: no more are taken.
        photos: those that were.
        left_out: how many were not.
    """

    most: int
    photos: list[Photo] = field(default_factory=list)
    left_out: int = 0

    def add(self, section: str, title: str, text: str, image: PilImage) -> None:
        """Take an image, made smaller and encoded so that it fits."""
        if len(self.photos) >= self.most:
            self.left_out += 1
            return
        if image.width > _WIDTH_PX:
            image = image.resize(
                (_WIDTH_PX, max(1, round(image.height * _WIDTH_PX / image.width))), reducing_gap=2.0
            )
        self.photos.append(Photo(section, title, text, image.width, image.height, _encoded(image)))

    def of(self, section: str) -> list[Photo]:
        """The images of a section."""
        return [photo for photo in self.photos if photo.section == section]


def _encoded(image: PilImage) -> bytes:
    content = b""
    for quality in _QUALITIES:
        file = BytesIO()
        image.save(file, "JPEG", quality=quality, optimize=True, progressive=True)
        content = file.getvalue()
        if len(content) <= _MOST_BYTES:
            break
    return content


NOTHING = "–"


def count(value: float | None) -> str:
    """A whole number with its thousands apart."""
    return NOTHING if value is None else f"{value:,.0f}"


def several(value: int, noun: str) -> str:
    """A count with its noun."""
    return f"{value:,} {noun}" if value == 1 else f"{value:,} {noun}s"


def fixed(value: float | None, digits: int, unit: str = "") -> str:
    """A number with so many digits behind the point, and its unit."""
    if value is None:
        return NOTHING
    return f"{round(value, digits) + 0.0:,.{digits}f}{f' {unit}' if unit else ''}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share of 1 in per cent."""
    return NOTHING if share is None else f"{100.0 * share:.{digits}f} %"


def megabytes(size_bytes: int | None) -> str:
    """Bytes in a unit that reads well."""
    if size_bytes is None:
        return NOTHING
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size_bytes >= scale:
            return f"{size_bytes / scale:.1f} {unit}"
    return f"{size_bytes} bytes"


def joined(*parts: str | None) -> str:
    """Parts that there are, with colons between."""
    return ": ".join(part for part in parts if part)


def times(value: int) -> str:
    """How often, where that is more than once."""
    return f" ({value:,} times)" if value > 1 else ""


def warning_text(warning: DataWarning) -> str:
    """A warning in one line."""
    return joined(str(warning.kind), warning.location, warning.message) + times(warning.count)


@dataclass(frozen=True, slots=True)
class Drawing:
    """A drawing with its words.

    Attributes:
        title: what it is.
        text: what it shows, for those who cannot see it.
        svg: the file.
        caption: how it is to be read, for all.
        kind: "plot"; "tall" stands beside several plots; "wide" takes the whole width, and on small screens is moved
            sideways; "map" takes it, too.
    """

    title: str
    text: str
    svg: bytes
    caption: str = ""
    kind: str = "plot"


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: numbers stand to the right, long texts get room."""

    name: str
    numeric: bool = True
    wide: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of texts, the first of each its head.

    Attributes:
        caption: what it reports.
        columns: as many as each row has cells.
        rows: the cells.
        folded: whether it is opened only on demand.
        more: what is not in it.
    """

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    folded: bool = False
    more: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """A part of a section, with whatever of this it has, in this order.

    Attributes:
        heading: its own heading.
        badge: a word before it, and how that looks: "error", "warning", "hint" or "good".
        lines: paragraphs.
        plots, photos, tables: what it shows.
        listed: lines that are opened on demand, under the title `list_title`.
        faint: whether the paragraphs are notes.
    """

    heading: str = ""
    badge: tuple[str, str] | None = None
    lines: Sequence[str] = ()
    plots: Sequence[Drawing] = ()
    photos: Sequence[Photo] = ()
    tables: Sequence[Table] = ()
    list_title: str = ""
    listed: Sequence[str] = ()
    faint: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A section of the page.

    Attributes:
        key: its anchor.
        name: its heading.
        missing: why it lacks something that might be there.
        absent: what the drive does not have, so that there is nothing to report; a sentence.
        facts: names and values that come first.
        blocks: what it consists of.
    """

    key: str
    name: str
    missing: str | None = None
    absent: str | None = None
    facts: Sequence[tuple[str, str]] = ()
    blocks: Sequence[Block] = ()


COLOURS = ("#2f6fb3", "#c2570c", "#2b8a57", "#9046a8", "#b3355c", "#7a6a00", "#0f8496", "#5f6773")

MOST_STREAMS = 40

_PLOT_INCHES, _WIDE_INCHES = (5.0, 2.8), 10.0

_MOST_LETTERS = 40

_FARTHEST = 1e12
"""Coordinates beyond this are not drawn [m]: no axis has ticks for them."""

_STYLE = {
    "svg.fonttype": "none",  # text stays text, in a font of the reader
    "svg.hashsalt": "sceneloom",
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dfe3e8",
    "legend.fontsize": 8.0,
}

_NOT_IN_DOCUMENTS = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff\u202a-\u202e\u2066-\u2069]"
)
"""Characters that no document may hold, and those that rotation the direction of what follows."""


def plain(text: object) -> str:
    """A text without characters that no document may hold."""
    return _NOT_IN_DOCUMENTS.sub("\N{REPLACEMENT CHARACTER}", str(text))


def line_plot(
    lines: Sequence[Sequence[tuple[float, float]]], *, x_name: str, y_name: str, with_zero: bool = False
) -> bytes:
    """Draw lines through (x, y)."""

    def draw(axes: Any) -> None:
        for k, line in enumerate(lines):
            axes.plot(*_finite(line).T, color=_colour(k), linewidth=1.5)
        if with_zero:
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.set(xlabel=x_name, ylabel=y_name)

    return _svg(_PLOT_INCHES, draw)


def histogram(edges: Sequence[float], counts: Sequence[float], *, x_name: str, y_name: str) -> bytes:
    """Draw counts between (B + 1) edges."""

    def draw(axes: Any) -> None:
        axes.stairs(counts, edges, fill=True, color=COLOURS[0])
        axes.set(xlabel=x_name, ylabel=y_name)

    return _svg(_PLOT_INCHES, draw)


def columns(names: Sequence[str], counts: Sequence[float], *, x_name: str, y_name: str) -> bytes:
    """Draw columns of one width, each with its name below."""

    def draw(axes: Any) -> None:
        axes.bar(range(len(names)), counts, color=COLOURS[0])
        every = -(-len(names) // 8)
        axes.set_xticks(range(0, len(names), every), [_short(name) for name in names[::every]], fontsize=8)
        axes.grid(visible=False, axis="x")
        axes.set(xlabel=x_name, ylabel=y_name)

    return _svg(_PLOT_INCHES, draw)


def bars(
    names: Sequence[str], values: Sequence[float], *, labels: Sequence[str], most: float | None = None
) -> bytes:
    """Draw bars to the right, each with its name before it and a label behind it."""

    def draw(axes: Any) -> None:
        drawn = axes.barh(range(len(names)), values, color=COLOURS[0])
        axes.bar_label(drawn, [plain(label) for label in labels], padding=3)
        axes.set_yticks(range(len(names)), [_short(name) for name in names])
        axes.set_xlim(0, 1.2 * max([*values, 1e-9]) if most is None else most)
        axes.invert_yaxis()
        axes.grid(visible=False)
        axes.spines["bottom"].set_visible(False)
        axes.tick_params(bottom=False, labelbottom=False)

    return _svg((_PLOT_INCHES[0], 0.4 + 0.3 * len(names)), draw)


def draw_streams(timing: Timing) -> bytes | None:
    """Draw the time that each stream covers, with its gaps; None where none has a timestamp."""
    rows = [stream for stream in timing.streams if stream.start is not None and stream.stop is not None]
    shown = rows[:MOST_STREAMS]
    if not shown:
        return None

    def draw(axes: Any) -> None:
        if timing.overlap is not None and len(shown) > 1:
            axes.axvspan(timing.overlap.start, timing.overlap.stop, color="#17663a", alpha=0.14, linewidth=0)
        for k, stream in enumerate(shown):
            start, stop = stream.start or 0.0, stream.stop or 0.0
            axes.barh(k, max(stop - start, 1e-9), left=start, height=0.4, color=COLOURS[0])
            axes.plot([start], [k], marker="|", color=COLOURS[0])
            for gap in stream.gaps:
                axes.barh(k, gap.stop - gap.start, left=gap.start, height=0.6, color="#c4302b")
        axes.set_yticks(range(len(shown)), [_short(stream.name) for stream in shown])
        axes.set_ylim(len(shown) - 0.4, -0.6)
        axes.set_xlabel("seconds after the first timestamp")

    return _svg((_WIDE_INCHES, 0.8 + 0.3 * len(shown)), draw)


def draw_plan(trajectories: Trajectories) -> bytes | None:
    """Draw trajectories and fixes as a map, with north up where it is known; None where there are none."""
    rotation, shift = _north_up(trajectories)
    lines = [
        (trajectory.name, _finite([(c.x, c.y) for c in trajectory.corners]) @ rotation.T)
        for trajectory in trajectories.trajectories
        if trajectory.corners
    ]
    fixes = [
        (f"fixes of {each.sensor}", _fixes(each.locations, shift, trajectories))
        for each in trajectories.fixes
    ]
    if trajectories.north is None and lines:
        fixes = []
    if not lines and not fixes:
        return None
    names = ("east [m]", "north [m]") if _is_north_up(trajectories) else ("x [m]", "y [m]")

    def draw(axes: Any) -> None:
        for k, (name, dots) in enumerate(fixes, start=len(lines)):
            axes.plot(*dots.T, ".", markersize=3, color=_colour(k), label=_short(name))
        for k, (name, line) in enumerate(lines):
            axes.plot(*line.T, color=_colour(k), label=_short(name))
            axes.plot(*line[0], "o", color=_colour(k), markerfacecolor="white")
            axes.plot(*line[-1], "s", color=_colour(k))
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel=names[0], ylabel=names[1])
        axes.legend(loc="best")

    return _svg((_WIDE_INCHES, 5.5), draw)


def middle_text(trajectories: Trajectories) -> str:
    """Latitude and longitude of the middle of the map; "" where they are not known."""
    if trajectories.origin_lla is None or not _is_north_up(trajectories):
        return ""
    rotation, shift = _north_up(trajectories)
    lines = [
        np.array([(c.x, c.y) for c in trajectory.corners]).reshape(-1, 2) @ rotation.T
        for trajectory in trajectories.trajectories
    ]
    locations = np.concatenate(
        [*lines, *(_fixes(each.locations, shift, trajectories) for each in trajectories.fixes)]
    )
    east, north = (locations.min(axis=0) + locations.max(axis=0)) / 2 - shift
    enu = np.array([[east, north, 0.0]])
    latitude, longitude, _ = geodetic_from_enu(enu, np.array(trajectories.origin_lla))[0].tolist()
    return f"{degrees_text(latitude, 'NS')}, {degrees_text(longitude, 'EW')}"


def degrees_text(value: float, letters: str) -> str:
    """Latitude or longitude to a metre: "49.01126° N"."""
    return f"{abs(value):.5f}° {letters[0] if value >= 0 else letters[1]}"


def _is_north_up(trajectories: Trajectories) -> bool:
    """Whether the map shows east and north, and not x and y of the world."""
    return trajectories.north is not None or (bool(trajectories.fixes) and not trajectories.trajectories)


def draw_around(coverage: Coverage) -> bytes | None:
    """Draw where cameras look and how far lidars and radars reach, ahead up; None where nothing is known."""
    clouds = [cloud for cloud in coverage.clouds if any(cloud.reaches)]
    cameras = [camera for camera in coverage.cameras if camera.left_deg is not None]
    if not clouds and not cameras:
        return None
    far = min(max([max(cloud.reaches) for cloud in clouds], default=50.0), _FARTHEST)

    def draw(axes: Any) -> None:
        axes.set_theta_zero_location("N")
        for k, camera in enumerate(cameras, start=len(clouds)):
            left, right = np.radians([camera.left_deg or 0.0, camera.right_deg or 0.0])
            name = f"{camera.sensor}, {camera.across_deg or 0.0:.0f}° across"
            axes.bar(
                (left + right) / 2, far, width=left - right, color=_colour(k), alpha=0.25, label=_short(name)
            )
        for k, cloud in enumerate(clouds):
            edges = np.linspace(0.0, 2 * np.pi, len(cloud.reaches) + 1)
            angles, reaches = np.repeat(edges, 2)[1:-1], np.repeat(np.minimum(cloud.reaches, far), 2)
            axes.plot(angles, reaches, color=_colour(k), label=_short(f"{cloud.sensor} ({cloud.type}) [m]"))
        axes.set_xticks(np.radians([0, 90, 180, 270]), ["ahead", "left", "back", "right"])
        axes.set_ylim(0, far)
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, -0.3))

    return _svg((5.0, 5.5), draw, projection="polar")


def _svg(inches: tuple[float, float], draw: Callable[[Any], None], **axes: Any) -> bytes:
    """Draw into axes of a figure of its own, which pyplot does not know; equal plots have equal bytes."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    file = BytesIO()
    with rc_context(_STYLE), warnings.catch_warnings():  # type: ignore[arg-type]
        warnings.simplefilter("ignore")  # of letters that its font does not have: the reader's has them
        figure = Figure(figsize=inches, layout="tight")
        draw(figure.add_subplot(**axes))
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


def _short(name: object) -> str:
    text = plain(name)
    return text if len(text) <= _MOST_LETTERS else f"{text[: _MOST_LETTERS - 1]}…"


def _finite(points: Sequence[tuple[float, float]]) -> Float64Array:
    """Points (N, 2), those that cannot be drawn as NaN."""
    found = np.array(points, np.float64).reshape(-1, 2)
    found[~(np.abs(found) < _FARTHEST)] = np.nan
    return found


def _north_up(trajectories: Trajectories) -> tuple[Float64Array, Float64Array]:
    """The rotation (2, 2) of the world that brings north up, and where the fixes' origin lies then (2,) [m]."""
    if trajectories.north is None:
        return np.eye(2), np.zeros(2)
    angle = np.pi / 2 - np.radians(trajectories.north.direction_deg)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rotation, rotation @ np.array(trajectories.north.shift[:2])


def _fixes(
    locations: Sequence[tuple[float, ...]], shift: Float64Array, trajectories: Trajectories
) -> Float64Array:
    return _finite([(location[1], location[2]) for location in locations]) + (
        shift if trajectories.north is not None else 0.0
    )
