"""Where the sensors of a drive lie: folders `cam0`, `imu0`, … in `mav0`, each with a `data.csv`."""

from pathlib import Path

MAV = "mav0"
TABLE, DESCRIPTION = "data.csv", "sensor.yaml"
_SENSORS = ("cam", "imu")


def mav_folder(path: Path) -> Path | None:
    """The folder of the sensors: the path itself, or `mav0` in it; None where there is none."""
    if not path.is_dir():
        return None
    for folder in (path / MAV, path):
        if folder.is_dir() and _holds_sensors(folder):
            return folder
    return None


def _holds_sensors(folder: Path) -> bool:
    return any((folder / f"{kind}{number}" / TABLE).is_file() for kind in _SENSORS for number in (0, 1))


def near_miss(path: Path) -> str | None:
    """Say what keeps a folder with a `mav0` from being a drive."""
    if not (path / MAV).is_dir() or mav_folder(path) is not None:
        return None
    return f"it has a {MAV}/, but neither {MAV}/cam0/{TABLE} nor {MAV}/imu0/{TABLE}"


def sensor_folders(folder: Path, kind: str) -> list[Path]:
    """The folders of the sensors of a kind that have a table, in the order of their numbers."""
    found = [
        one
        for one in folder.iterdir()
        if one.name.startswith(kind) and one.name[len(kind) :].isdigit() and (one / TABLE).is_file()
    ]
    return sorted(found, key=lambda one: int(one.name[len(kind) :]))
