"""Which folder is a drive of PandaSet, and the one that is chosen of a folder of several."""

import re
from itertools import islice
from pathlib import Path

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.named_folder import named_folder

_FRAME = re.compile(r"\d+\.pkl(\.gz)?")
_MOST_LOOKED_AT = 50
_MOST_NAMES = 20


def numbered_files(folder: Path, pattern: str) -> list[Path]:
    """The files of a folder that are named by numbers, in their order.

    Args:
        folder: may be missing.
        pattern: of the whole name, after the number.
    """
    if not folder.is_dir():
        return []
    name = re.compile(rf"\d+{pattern}")
    found = [file for file in folder.iterdir() if name.fullmatch(file.name)]
    return sorted(found, key=lambda file: int(file.name.partition(".")[0]))


def is_drive(path: Path) -> bool:
    """Whether a folder holds a drive, be it half a one: pickled sweeps, or pickled cuboids."""
    return any(
        _FRAME.fullmatch(file.name)
        for folder in (path / "lidar", path / "annotations" / "cuboids")
        if folder.is_dir()
        for file in islice(folder.iterdir(), _MOST_LOOKED_AT)
    )


def recognises(path: Path) -> bool:
    """Whether the path is a drive, or a folder among whose first entries is one."""
    return path.is_dir() and (is_drive(path) or any(map(is_drive, islice(path.iterdir(), _MOST_LOOKED_AT))))


def drives_in(path: Path) -> list[Path]:
    """The drive that a folder is, or the drives in it."""
    if is_drive(path):
        return [named_folder(path)]
    return [child for child in sorted(path.iterdir()) if is_drive(child)]


def find_drive(path: Path, sequence: str | None) -> Path:
    """Find the drive that is meant.

    Raises:
        DataError: there is none.
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    if not path.is_dir():
        raise DataError(
            path, "", "no such folder; expected one with lidar/00.pkl.gz, lidar/poses.json, camera/"
        )
    drives = drives_in(path)
    names = [drive.name for drive in drives]
    more = [f"… ({len(names)} in all)"] if len(names) > _MOST_NAMES else []
    shown = ", ".join([*names[:_MOST_NAMES], *more])
    if not drives:
        raise DataError(
            path, "", "no drive; expected a folder with lidar/00.pkl.gz, lidar/poses.json, camera/"
        )
    if sequence is not None:
        if sequence not in names:
            raise OptionError(f"{path}: no drive {sequence!r}; it has {shown}")
        return drives[names.index(sequence)]
    if len(drives) > 1:
        raise OptionError(f"{path}: {len(drives)} drives; choose one with `--sequence NAME`: {shown}")
    return drives[0]


def near_miss(path: Path) -> str | None:
    """Say what a folder lacks that has the cameras of a drive."""
    if path.is_dir() and (path / "camera" / "front_camera" / "poses.json").is_file():
        return "it has camera/front_camera/ as PandaSet has, but no lidar/00.pkl.gz"
    return None
