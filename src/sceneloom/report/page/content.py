"""What a page consists of, without a word of markup."""

from collections.abc import Sequence
from dataclasses import dataclass

from sceneloom.report.figures import Photo


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
