"""Which folder is a log of Argoverse 2, and the log that is chosen of a folder of several."""

from itertools import islice
from pathlib import Path

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.named_folder import named_folder

POSES = "city_SE3_egovehicle.feather"
MOUNTS = "calibration/egovehicle_SE3_sensor.feather"
LENSES = "calibration/intrinsics.feather"
ANNOTATIONS = "annotations.feather"
LIDAR = "sensors/lidar"
CAMERAS = "sensors/cameras"

_MOST_LOOKED_AT = 50
_MOST_NAMES = 20


def is_log(path: Path) -> bool:
    """Whether a folder is a log, be it half a one: nobody else has files of these names."""
    return path.is_dir() and ((path / POSES).is_file() or (path / MOUNTS).is_file())


def logs_in(path: Path) -> list[Path]:
    """The log that a path is, or the logs in it."""
    if is_log(path):
        return [named_folder(path)]
    if not path.is_dir():
        return []
    return [child for child in sorted(path.iterdir()) if is_log(child)]


def recognises(path: Path) -> bool:
    """Whether the path is a log, or a folder among whose first entries is one."""
    return is_log(path) or (path.is_dir() and any(map(is_log, islice(path.iterdir(), _MOST_LOOKED_AT))))


def find_log(path: Path, sequence: str | None) -> Path:
    """Find the log that is meant.

    Raises:
        DataError: there is none.
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    logs = logs_in(path)
    if not logs:
        raise DataError(path, "", f"no log; expected a folder with {POSES}, calibration/ and sensors/")
    names = [log.name for log in logs]
    more = [f"… ({len(names)} in all)"] if len(names) > _MOST_NAMES else []
    shown = ", ".join([*names[:_MOST_NAMES], *more])
    if sequence is not None:
        if sequence not in names:
            raise OptionError(f"{path}: no log {sequence!r}; it has {shown}")
        return logs[names.index(sequence)]
    if len(logs) > 1:
        raise OptionError(f"{path}: {len(logs)} logs; choose one with `--sequence NAME`: {shown}")
    return logs[0]


def near_miss(path: Path) -> str | None:
    """Say what a folder lacks that has the sensors of a log."""
    if path.is_dir() and (path / LIDAR).is_dir() and any((path / LIDAR).glob("*.feather")):
        return f"it has {LIDAR}/*.feather as Argoverse 2 has, but neither {POSES} nor {MOUNTS}"
    return None


def stamped_files(folder: Path, suffix: str) -> list[tuple[int, Path]]:
    """The files of a folder that are named after their time [ns], in its order.

    Raises:
        DataError: one is named otherwise.
    """
    found = []
    for file in folder.glob(f"*{suffix}"):
        if not (
            file.stem.isascii() and file.stem.isdigit() and len(file.stem) < 20 and int(file.stem) < 1 << 63
        ):
            problem = f"expected files named after their time in nanoseconds, as 315966265259836000{suffix}"
            raise DataError(file, "", problem)
        found.append((int(file.stem), file))
    return sorted(found)
