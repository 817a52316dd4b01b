"""Where a recording is: a folder, the `data.jsonl` in one, or a zip archive that is unpacked while it is open."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sceneloom.formats.recording.picture_files import OpenPictures
from sceneloom.formats.recording.zipped import is_zip, unpack

DATA_FILE = "data.jsonl"


def _nothing() -> None:
    pass


@dataclass(frozen=True, slots=True)
class RecordingPlace:
    """A recording's folder.

    Attributes:
        folder: where its files are.
        source: what messages call it.
        remove: takes away what was made for it.
    """

    folder: Path
    source: str
    remove: Callable[[], None] = _nothing


@dataclass(frozen=True, slots=True, eq=False)
class Closing:
    """Closes what a scene holds open, then takes away what was made for it."""

    pictures: OpenPictures
    remove: Callable[[], None]

    def __call__(self) -> None:
        """Close everything."""
        self.pictures.close()
        self.remove()


def find_place(path: Path) -> RecordingPlace:
    """Find the folder of a recording that is named by its folder, its `data.jsonl` or a zip archive of it.

    Raises:
        DataError: the archive is damaged, or holds something else or too much.
    """
    if path.is_dir():
        return RecordingPlace(path, str(path))
    if is_zip(path):
        unpacked = unpack(path, DATA_FILE)
        return RecordingPlace(unpacked.folder, str(path), unpacked.remove)
    folder = path.parent if path.name == DATA_FILE else path
    return RecordingPlace(folder, str(folder))
