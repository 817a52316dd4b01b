"""Folders in the layout of the EuRoC MAV data sets: folders `cam0`, `imu0`, … in `mav0`, each with a `data.csv`.

Only read.
"""

from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec

_MAV = "mav0"
TABLE, DESCRIPTION = "data.csv", "sensor.yaml"
_SENSORS = ("cam", "imu")


def mav_folder(path: Path) -> Path | None:
    """The folder of the sensors: the path itself, or `mav0` in it; None where there is none."""
    if not path.is_dir():
        return None
    for folder in (path / _MAV, path):
        if any((folder / f"{kind}{number}" / TABLE).is_file() for kind in _SENSORS for number in (0, 1)):
            return folder
    return None


def _near_miss(path: Path) -> str | None:
    """Report what keeps a folder with a `mav0` from being a drive."""
    if not (path / _MAV).is_dir() or mav_folder(path) is not None:
        return None
    return f"it has a {_MAV}/, but neither {_MAV}/cam0/{TABLE} nor {_MAV}/imu0/{TABLE}"


FORMAT = FormatSpec(
    name="euroc-mav",
    title="a EuRoC folder",
    looks_like="a folder with mav0/cam0/data.csv or mav0/imu0/data.csv, as the EuRoC datasets have them",
    suffixes=(".mav0",),
    sniff=lambda path: mav_folder(path) is not None,
    near_miss=_near_miss,
    reader="sceneloom.formats.euroc_mav.reader:read_euroc",
    read_options=("lenient",),
    instead="a EuRoC folder is only read; write a scene file (drive.sfs), a recording (a folder), or its trajectory "
    "(trajectory.csv)",
)
