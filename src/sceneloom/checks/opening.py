"""Opens what is to be checked so far as it is sound, with all that is wrong in it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from sceneloom.checks.recordings.faults import FAULT_CODES, UNREADABLE
from sceneloom.checks.subject import Subject
from sceneloom.errors import DataError
from sceneloom.formats.faults import PlacedFault
from sceneloom.formats.recording.examination import RecordingExamination
from sceneloom.formats.sfs.faults import Examination
from sceneloom.formats.spec import FormatSpec
from sceneloom.formats.table import chosen_corrections, format_and_location, opened_by, part_of
from sceneloom.redaction import redacted
from sceneloom.scene.scene import Corrections, Scene


def open_subject(
    path: str | Path,
    *,
    format: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    corrections: str = Corrections.APPLY,
    **reading: Any,
) -> Subject:
    """Open a file or folder; what cannot be read is a fault of the subject, not an error.

    Args:
        path: a file or folder, or the URL of a scene file.
        format: the format's name, where the content should not decide.
        start, stop: seconds after the first timestamp: the part between them is a scene of its own, without the texts
            of its file, with the faults of all of it.
        corrections: as of `open_scene`.
        reading: reading options of the format; `lenient` plays no part.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: an option or its value is not known, or there is nothing between `start` and `stop`.
    """
    chosen = chosen_corrections(corrections)
    subject = _whole_subject(path, format, reading)
    if chosen is not subject.scene.corrections:
        subject = replace(subject, scene=replace(subject.scene, corrections=chosen))
    if start is None and stop is None:
        return subject
    part = part_of(subject.scene, start=start, stop=stop)
    return Subject(part, faults=subject.faults, warnings=subject.notes)


def _whole_subject(path: str | Path, format: str | None, reading: dict[str, Any]) -> Subject:
    form, where = format_and_location(path, format=format)
    options = {name: value for name, value in reading.items() if value is not None and name != "lenient"}
    if not form.examiner:
        return _opened(form, where, options)
    found = form.examine(where, **options)
    if isinstance(found, RecordingExamination):
        return _examined_recording(found, where)
    return _examined(found, where)


def _examined(examination: Examination, path: str | Path) -> Subject:
    if examination.scene is None:
        return Subject(_nothing(path, "sfs"), faults=examination.faults)
    return Subject(
        examination.scene,
        examination.header,
        examination.faults,
        examination.sensor_paths,
        examination.annotation_paths,
        examination.warnings,
        fetch=examination.fetch,
        frame_numbers=examination.frame_numbers,
    )


def _examined_recording(examination: RecordingExamination, path: Path) -> Subject:
    scene = examination.scene or _nothing(path, "recording")
    faults = tuple(
        fault if fault.code in FAULT_CODES else replace(fault, code=UNREADABLE)
        for fault in examination.faults
    )
    return Subject(scene, faults=faults, recording=examination.contents)


def _opened(form: FormatSpec, path: Path, options: dict[str, Any]) -> Subject:
    """Open what another format holds: whole, or without what is broken, or not at all."""
    try:
        return Subject(opened_by(form, path, **options))
    except DataError as error:
        fault = _unreadable(path, error)
    try:
        return Subject(opened_by(form, path, **options, lenient=True), faults=(fault,))
    except DataError as error:
        return Subject(_nothing(path, form.name), faults=(_unreadable(path, error),))


def _unreadable(path: Path, error: DataError) -> PlacedFault:
    location = ": ".join(
        part for part in (error.file.removeprefix(str(path)).lstrip("/"), error.location) if part
    )
    return PlacedFault(location, error.problem, "unreadable")


def _nothing(path: str | Path, format_name: str) -> Scene:
    return Scene((), source=redacted(path), format=format_name)
