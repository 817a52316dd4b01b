"""Which folder is a data set of nuScenes, and where its tables are."""

from dataclasses import dataclass
from pathlib import Path

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.nuscenes.tables import NEEDED

_MARKS = ("sample_data", "ego_pose", "calibrated_sensor")
"""Tables that nobody else has; a folder with one of them is nuScenes', be it half a one."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a data set is.

    Attributes:
        root: the folder that the names of files begin at.
        tables: the folder of the tables, `v1.0-mini` of the root.
    """

    root: Path
    tables: Path


def table_folders(path: Path) -> list[Path]:
    """The folders with tables: those of a data set, or the path itself."""
    if not path.is_dir():
        return []
    if _has_tables(path):
        return [path]
    return [child for child in sorted(path.glob("v[0-9]*")) if child.is_dir() and _has_tables(child)]


def _has_tables(folder: Path) -> bool:
    return any((folder / f"{name}.json").is_file() for name in _MARKS)


def find_place(path: Path) -> Place:
    """Find the tables of a data set.

    Raises:
        DataError: there are none, or one of those that are needed is missing.
        OptionError: there are several sets of tables.
    """
    folders = table_folders(path)
    if not folders:
        raise DataError(path, "", "no tables; expected a folder v1.0-mini or the like with sample_data.json")
    if len(folders) > 1:
        names = ", ".join(folder.name for folder in folders)
        raise OptionError(f"{path}: several sets of tables ({names}); open one of these folders itself")
    missing = [f"{name}.json" for name in NEEDED if not (folders[0] / f"{name}.json").is_file()]
    if missing:
        expected = ", ".join(f"{name}.json" for name in NEEDED)
        raise DataError(folders[0], ", ".join(missing), f"missing; expected the tables {expected}")
    return Place(folders[0].parent, folders[0])


def near_miss(path: Path) -> str | None:
    """Say what a folder lacks that has the sensors' files and no tables."""
    if path.is_dir() and (path / "samples").is_dir() and not table_folders(path):
        return "it has samples/ as nuScenes has, but no folder of tables (v1.0-mini/sample_data.json …)"
    return None
