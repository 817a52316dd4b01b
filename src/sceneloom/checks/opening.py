"""Opens what is to be checked so far as it is sound, with all that is wrong in it."""

from pathlib import Path
from typing import Any

from sceneloom.checks.subject import Subject
from sceneloom.errors import DataError
from sceneloom.formats.sfs.examination import examine
from sceneloom.formats.sfs.faults import PlacedFault
from sceneloom.formats.sfs.source import ReadingOptions
from sceneloom.formats.table import Format, find_format, format_named
from sceneloom.scene import Scene


def open_subject(path: Path, *, format: str | None = None, **reading: Any) -> Subject:
    """Open a file or folder; what cannot be read is a fault of the subject, not an error.

    Args:
        path: a file or folder.
        format: the format's name, where the content should not decide.
        reading: reading options of the format; `lenient` plays no part.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: an option or its value is not known.
    """
    form = find_format(path) if format is None else format_named(format)
    options = {name: value for name, value in reading.items() if value is not None and name != "lenient"}
    return _examined_scene_file(path, options) if form.name == "sfs" else _opened(form, path, options)


def _examined_scene_file(path: Path, options: dict[str, Any]) -> Subject:
    known = {name: value for name, value in options.items() if name in ReadingOptions.__dataclass_fields__}
    examination = examine(path, ReadingOptions(**known))
    if examination.scene is None:
        return Subject(_nothing(path, "sfs"), faults=examination.faults)
    return Subject(
        examination.scene,
        examination.header,
        examination.faults,
        examination.sensor_paths,
        examination.annotation_paths,
    )


def _opened(form: Format, path: Path, options: dict[str, Any]) -> Subject:
    """Open what another format holds: whole, or without what is broken, or not at all."""
    try:
        return Subject(form.open(path, **options))
    except DataError as error:
        fault = _unreadable(path, error)
    try:
        return Subject(form.open(path, **options, lenient=True), faults=(fault,))
    except DataError as error:
        return Subject(_nothing(path, form.name), faults=(_unreadable(path, error),))


def _unreadable(path: Path, error: DataError) -> PlacedFault:
    place = ": ".join(part for part in (error.file.removeprefix(str(path)).lstrip("/"), error.place) if part)
    return PlacedFault(place, error.problem, "unreadable")


def _nothing(path: Path, format_name: str) -> Scene:
    return Scene((), source=str(path), format=format_name)
