"""What KITTI's raw folders offer to the table of formats."""

from pathlib import Path

from sceneloom.formats.folder_form import FolderFormat
from sceneloom.formats.kitti.raw import place
from sceneloom.formats.kitti.raw.reading import open_raw
from sceneloom.formats.kitti.raw.writing import write_raw
from sceneloom.formats.kitti.written.holdings import RAW


def _is_raw(path: Path) -> bool:
    """Whether a path is a drive, or a folder of drives."""
    return path.is_dir() and (place.is_drive(path) or bool(place.drives_below(path)))


FORMAT = FolderFormat(
    name="kitti-raw",
    called="KITTI's raw data",
    looks_like="a drive of KITTI's raw data (2011_09_26_drive_0001_sync), or the folder of its day",
    recogniser=_is_raw,
    missing=place.near_miss,
    reader=open_raw,
    drives=place.drives_below,
    reading_options=("sequence", "lenient"),
    writer=write_raw,
    writing_options=("kind", "sequence"),
    holds=RAW,
)
