"""All faults of a file at once, with the scene of all that is sound."""

from dataclasses import replace
from pathlib import Path

from sceneloom.errors import DataError
from sceneloom.formats.faults import PlacedFault
from sceneloom.formats.sfs.faults import Examination
from sceneloom.formats.sfs.reading import read_all
from sceneloom.formats.sfs.spec import ReadingOptions


def examine(path: Path | str, options: ReadingOptions | None = None) -> Examination:
    """Read a file as far as it is sound, and give every fault of it with its location; nothing is raised for them.

    Args:
        path: the file, or the URL of one; only its header is read.
        options: what the file does not state itself; `lenient` plays no part.
    """
    try:
        return read_all(path, replace(options or ReadingOptions(), lenient=False), whole=True)
    except DataError as error:
        return Examination(None, (PlacedFault(error.location, error.problem, "unreadable", vital=True),))
