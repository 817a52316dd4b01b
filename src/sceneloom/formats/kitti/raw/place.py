"""Where a drive of KITTI's raw data is: `2011_09_26/2011_09_26_drive_0001_sync`, the day's calibration beside it."""

import re
from dataclasses import dataclass
from pathlib import Path

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.named_folder import named_folder

CALIBRATION_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
"""The day's files: how the cameras lie, where the lidar is among them, and where the OXTS unit is."""

_DRIVE = re.compile(r"(?P<date>\d{4}_\d\d_\d\d)_drive_(?P<number>\d{4})_(?P<kind>sync|extract)")
_DATE = re.compile(r"\d{4}_\d\d_\d\d")


@dataclass(frozen=True, slots=True)
class RawDrive:
    """A drive's folder.

    Attributes:
        folder: of its sensors.
        calibration: the folder of its calibration files.
        kind: "sync" (rectified pictures, one of each sensor in each frame), "extract" (as recorded), or None where the
            folder's name does not say it.
    """

    folder: Path
    calibration: Path
    kind: str | None


def find_drive(path: Path, wanted: str | None = None) -> RawDrive:
    """Find the only drive of a folder, or the wanted one: the drive's own folder, that of its day, or the one above.

    Raises:
        DataError: there is none.
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    found = [named_folder(path)] if is_drive(path) else drives_below(path)
    if wanted is not None:
        chosen = [drive for drive in found if wanted in _names(drive)]
        if len(chosen) != 1:
            names = ", ".join(drive.name for drive in found) or "none"
            raise OptionError(f"drive {wanted!r}: {path} has {len(chosen)} of that name; it has {names}")
        found = chosen
    if not found:
        raise DataError(path, "", "holds no drive; expected folders as 2011_09_26_drive_0001_sync")
    if len(found) > 1:
        names = ", ".join(drive.name for drive in found)
        raise OptionError(f"{path} has several drives: {names}; choose one with `--sequence NAME`")
    return _drive(found[0])


def _names(drive: Path) -> set[str]:
    match = _DRIVE.fullmatch(drive.name)
    if match is None:
        return {drive.name}
    number = match["number"]
    return {drive.name, number, f"{number}_{match['kind']}", f"{match['date']}_drive_{number}"}


def _drive(folder: Path) -> RawDrive:
    match = _DRIVE.fullmatch(folder.resolve().name)
    places = (folder, folder / "calib", folder.resolve().parent)
    calibration = next(
        (place for place in places if any((place / name).is_file() for name in CALIBRATION_FILES)), places[-1]
    )
    return RawDrive(folder, calibration, None if match is None else match["kind"])


def drives_below(path: Path) -> list[Path]:
    """The drives of a day's folder, or of a folder of days, by name."""
    return [child for child in _children(path) if _DRIVE.fullmatch(child.name) and is_drive(child)]


def _children(path: Path) -> list[Path]:
    """The folders in a folder, and those in the days among them."""
    try:
        children = sorted(child for child in path.iterdir() if child.is_dir())
        days = [child for child in children if _DATE.fullmatch(child.name)]
        return [*children, *(child for day in days for child in sorted(day.iterdir()) if child.is_dir())]
    except OSError:
        return []


def is_drive(path: Path) -> bool:
    """Whether a folder has a sensor's folder as drives have them."""
    return any((path / name / "data").is_dir() for name in (*camera_folders(), "velodyne_points", "oxts"))


def camera_folders() -> tuple[str, ...]:
    """What the folders of the four cameras are called, by number."""
    return tuple(f"image_{number:02d}" for number in range(4))


def near_miss(path: Path) -> str | None:
    """Say what keeps a folder from being a drive, where it looks like a half one."""
    if not path.is_dir() or is_drive(path) or drives_below(path):
        return None
    empty = [child.name for child in (path, *_children(path)) if _DRIVE.fullmatch(child.name)]
    if empty:
        return (
            "the folder of a drive of KITTI's without data: expected velodyne_points/data, image_02/data or oxts/data "
            f"in {empty[0]}"
        )
    calibration = [name for name in CALIBRATION_FILES if (path / name).is_file()]
    if calibration:
        return (
            f"{calibration[0]} of KITTI's raw data without drives: expected folders as 2011_09_26_drive_0001_sync "
            "beside it"
        )
    return None
