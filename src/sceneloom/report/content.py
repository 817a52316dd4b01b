"""What a report page consists of: formatted numbers, tables, sections, embedded images, and plots by matplotlib."""

import re
import warnings
from base64 import b64encode
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.visualization.canvas import PilImage

_WIDTH_PX = 1100  # wider images are made smaller
_MOST_BYTES = 150_000  # of one image; its quality is lowered until it fits
_QUALITIES = (82, 74, 66, 56, 46)


@dataclass(frozen=True, slots=True)
class _Photo:
    """One image of a report."""

    section: str
    title: str
    text: str
    width: int  # [px]
    height: int  # [px]
    jpeg: bytes = field(repr=False)

    @property
    def data_uri(self) -> str:
        """Its file, for the page."""
        return f"data:image/jpeg;base64,{b64encode(self.jpeg).decode('ascii')}"


@dataclass(slots=True)
class Figures:
    """Collects images for the sections of a report.

    Attributes:
        most: no more are taken.
        photos: those that were.
        left_out: how many were not.
    """

    most: int
    photos: list[_Photo] = field(default_factory=list)
    left_out: int = 0

    def add(self, section: str, title: str, text: str, image: PilImage) -> None:
        """Take an image, made smaller and encoded so that it fits."""
        if len(self.photos) >= self.most:
            self.left_out += 1
            return
        if image.width > _WIDTH_PX:
            image = image.resize((_WIDTH_PX, max(1, round(image.height * _WIDTH_PX / image.width))), reducing_gap=2.0)
        self.photos.append(_Photo(section, title, text, image.width, image.height, _encoded(image)))

    def of(self, section: str) -> list[_Photo]:
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


def fixed(value: float | None, digits: int, unit: str = "") -> str:
    """A number with so many digits behind the point, and its unit."""
    if value is None:
        return NOTHING
    return f"{round(value, digits) + 0.0:,.{digits}f}{f' {unit}' if unit else ''}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share of 1 in per cent."""
    return NOTHING if share is None else f"{100.0 * share:.{digits}f} %"


def counted(count: int, *parts: str | None) -> str:
    """The parts that are not empty, separated by colons, and how often, if more than once."""
    return ": ".join(part for part in parts if part) + (f" ({count:,} times)" if count > 1 else "")


@dataclass(frozen=True, slots=True)
class Drawing:
    """A drawing with its words.

    Attributes:
        text: what it shows, for those who cannot see it.
        caption: how it is to be read, for all.
        kind: "plot"; "tall" stands beside several plots; "wide" takes the whole width, and on small screens is moved
            sideways; "map" takes it, too.
    """

    title: str
    text: str
    svg: bytes
    caption: str = ""
    kind: str = "plot"

    @property
    def data_uri(self) -> str:
        """Its file, for the page."""
        return f"data:image/svg+xml;base64,{b64encode(self.svg).decode('ascii')}"


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: what it is called, and the text of its cell for an item.

    Numbers are aligned to the right; wide columns leave room for long texts.
    """

    name: str
    cell: Callable[[Any], str]
    numeric: bool = True
    wide: bool = False


def text_column(name: str, cell: Callable[[Any], object] = str, *, wide: bool = False) -> Column:
    """A column of texts."""
    return Column(name, lambda item: str(cell(item)), numeric=False, wide=wide)


def pair_columns(name: str, value: str, *, numeric: bool = False) -> tuple[Column, Column]:
    """The columns of a table of (name, value)."""
    return text_column(name, lambda pair: pair[0]), Column(
        value, lambda pair: str(pair[1]), numeric=numeric, wide=not numeric
    )


@dataclass(frozen=True, slots=True)
class Table:
    """A table: a row for each item, a column for each of its values; the first column is the row's heading.

    Attributes:
        caption: what it reports.
        columns: how an item is shown.
        items: one for each row.
        folded: whether it is opened only on demand.
        more: what is not in it.
    """

    caption: str
    columns: Sequence[Column]
    items: Iterable[Any]
    folded: bool = False
    more: str = ""

    @property
    def rows(self) -> list[list[str]]:
        """The texts of the cells."""
        return [[column.cell(item) for column in self.columns] for item in self.items]


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """A part of a section, with whatever of this it has, in this order.

    Attributes:
        badge: a word before it, and how that looks: "error", "warning", "hint" or "good".
        plots, photos, tables: what it shows.
        listed: lines that are opened on demand, under the title `list_title`.
        faint: whether the paragraphs are notes.
    """

    heading: str = ""
    badge: tuple[str, str] | None = None
    lines: Sequence[str] = ()
    plots: Sequence[Drawing] = ()
    photos: Sequence[_Photo] = ()
    tables: Sequence[Table] = ()
    list_title: str = ""
    listed: Sequence[str] = ()
    faint: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A section of the page.

    Attributes:
        missing: why something could not be reported.
        absent: a sentence if the drive holds nothing to report here.
        facts: names and values that come first.
    """

    key: str
    name: str
    missing: str | None = None
    absent: str | None = None
    facts: Sequence[tuple[str, str]] = ()
    blocks: Sequence[Block] = ()


COLOURS = ("#2f6fb3", "#c2570c", "#2b8a57", "#9046a8", "#b3355c", "#7a6a00", "#0f8496", "#5f6773")
PLOT_INCHES, WIDE_INCHES = (5.0, 2.8), 10.0
_MOST_LETTERS = 40
FARTHEST = 1e12
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
)  # characters that no document may hold, and those that change the writing direction


def plain(text: object) -> str:
    """A text without characters that no document may hold."""
    return _NOT_IN_DOCUMENTS.sub("\N{REPLACEMENT CHARACTER}", str(text))


def line_plot(
    lines: Sequence[Sequence[tuple[float, float]]], *, x_name: str, y_name: str, with_zero: bool = False
) -> bytes:
    """Draw lines through (x, y)."""

    def draw(axes: Any) -> None:
        for k, line in enumerate(lines):
            axes.plot(*drawable(line).T, color=colour_at(k), linewidth=1.5)
        if with_zero:
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.set(xlabel=x_name, ylabel=y_name)

    return draw_svg(PLOT_INCHES, draw)


def columns(names: Sequence[str], counts: Sequence[float], *, x_name: str, y_name: str) -> bytes:
    """Draw columns of one width, each with its name below."""

    def draw(axes: Any) -> None:
        axes.bar(range(len(names)), counts, color=COLOURS[0])
        every = -(-len(names) // 8)
        axes.set_xticks(range(0, len(names), every), [short(name) for name in names[::every]], fontsize=8)
        axes.grid(visible=False, axis="x")
        axes.set(xlabel=x_name, ylabel=y_name)

    return draw_svg(PLOT_INCHES, draw)


def bars(names: Sequence[str], values: Sequence[float], *, labels: Sequence[str], most: float | None = None) -> bytes:
    """Draw bars to the right, each with its name before it and a label behind it."""

    def draw(axes: Any) -> None:
        drawn = axes.barh(range(len(names)), values, color=COLOURS[0])
        axes.bar_label(drawn, [plain(label) for label in labels], padding=3)
        axes.set_yticks(range(len(names)), [short(name) for name in names])
        axes.set_xlim(0, 1.2 * max([*values, 1e-9]) if most is None else most)
        axes.invert_yaxis()
        axes.grid(visible=False)
        axes.spines["bottom"].set_visible(False)
        axes.tick_params(bottom=False, labelbottom=False)

    return draw_svg((PLOT_INCHES[0], 0.4 + 0.3 * len(names)), draw)


def draw_svg(inches: tuple[float, float], draw: Callable[[Any], None], **axes: Any) -> bytes:
    """Draw into the axes of a new figure that pyplot does not know; equal plots have equal bytes."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    file = BytesIO()
    with rc_context(_STYLE), warnings.catch_warnings():  # type: ignore[arg-type]
        warnings.simplefilter("ignore")  # of letters that its font does not have: the reader's has them
        figure = Figure(figsize=inches, layout="tight")
        draw(figure.add_subplot(**axes))
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def colour_at(number: int) -> str:
    """The colour of a plot's line or bar, by its number."""
    return COLOURS[number % len(COLOURS)]


def short(name: object) -> str:
    """A name as the label of an axis or a legend."""
    text = plain(name)
    return text if len(text) <= _MOST_LETTERS else f"{text[: _MOST_LETTERS - 1]}…"


def drawable(points: Sequence[tuple[float, float]]) -> Float64Array:
    """Points (N, 2), those that cannot be drawn as NaN."""
    found = np.array(points, np.float64).reshape(-1, 2)
    found[~(np.abs(found) < FARTHEST)] = np.nan
    return found
