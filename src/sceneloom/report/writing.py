"""The report of a drive, as a page and as numbers."""

import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import OptionError
from sceneloom.formats.output import check_output, replacing
from sceneloom.redaction import without_folders
from sceneloom.report.collecting import collect
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.page.rendering import check_extra, render_page
from sceneloom.report.settings import ReportSettings
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Progress
from sceneloom.stages import stage


def write_report(
    source: str | Path | Scene,
    output: str | Path | None = None,
    *,
    numbers: str | Path | None = None,
    settings: ReportSettings | None = None,
    overwrite: bool = False,
    made: datetime | None = None,
    progress: Progress | None = None,
    **reading: Any,
) -> DriveReport:
    """Look at a drive, and write a page of HTML that can be sent, and its numbers as JSON.

    The page is one file that asks for nothing from outside. What is broken in the drive is passed over and reported.

    Args:
        source: a file or folder, the URL of a scene file, or a scene that is open.
        output: the page, a name that ends in .html; None for none.
        numbers: the numbers, a name that ends in .json; None for none.
        settings: how the report is made.
        overwrite: whether outputs that exist may be replaced.
        made: when the report is stated to be made; None for now.
        progress: reported how many of the steps are done.
        reading: reading options of the format; `start` and `stop`, seconds between which the drive counts.

    Returns:
        The numbers.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: an option or its value is not known, or a name has another suffix.
        OutputError: an output exists, or cannot be written.
        MissingExtraError: what fills the page is not installed.
        DataError: nothing of the drive can be read.
    """
    wanted = [
        (Path(target), suffix)
        for target, suffix in ((output, ".html"), (numbers, ".json"))
        if target is not None
    ]
    for target, suffix in wanted:
        if target.suffix.lower() != suffix:
            raise OptionError(f"{target}: suffix {target.suffix!r}; expected a name that ends in {suffix}")
        check_output(target, overwrite=overwrite)
    if output is not None:
        check_extra()
    found = collect(source, settings or ReportSettings(), reading=reading, made=made, progress=progress)
    contents: dict[str, Callable[[], bytes]] = {
        # ids may hold halves of characters, which no file of Unicode can
        ".html": lambda: render_page(found.report, found.figures).encode("utf-8", "replace"),
        ".json": lambda: numbers_as_json(found.report),
    }
    for target, suffix in wanted:
        with stage("drawing the page"):
            content = contents[suffix]()
        with replacing(target, overwrite=overwrite) as draft:
            draft.write_bytes(content)
    return found.report


def numbers_as_json(report: DriveReport) -> bytes:
    """The numbers of a report as JSON, for people to read, too; without the folders above the drive."""
    source = report.summary.source
    try:
        text = msgspec.json.format(msgspec.json.encode(report), indent=1).decode()
    except UnicodeEncodeError:
        # ids may hold halves of characters, which this encoder escapes
        text = json.dumps(msgspec.to_builtins(report), indent=1)
    return without_folders(text, source).encode() + b"\n"
