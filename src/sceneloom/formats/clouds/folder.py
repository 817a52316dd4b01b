"""A file of points, a folder of such files of one kind, or a folder of such folders: one for each lidar."""

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from sceneloom.errors import DataError
from sceneloom.formats.clouds.spec import BESIDE, DEFAULT_ID, TIME_FILES, CloudKind, entries


@dataclass(frozen=True, slots=True)
class CloudFolder:
    """The files of one lidar, in the order of their names.

    Attributes:
        sensor_id: what the lidar is called.
        location: the folder, or the only file.
        files: at least one.
        beside: files that state more about them, by name.
    """

    sensor_id: str
    location: Path
    files: tuple[Path, ...]
    beside: dict[str, Path]


def find_folders(path: Path, kind: CloudKind) -> list[CloudFolder]:
    """Find the files of each lidar.

    Raises:
        DataError: there are none.
    """
    if path.is_file():
        return [CloudFolder(DEFAULT_ID, path, (path,), {})]
    try:
        folders = sorted(path / entry.name for entry in entries(path) if entry.is_dir())
        own = _files(path, kind)
        found = [] if own is None else [own]
        if own is None:
            found = [one for folder in folders if (one := _files(folder, kind)) is not None]
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    if not found:
        raise DataError(path, "", f"has no files of points; expected {kind.reported}")
    if len(found) == 1 and found[0].location == path:
        return found
    return [CloudFolder(unquote(one.location.name), one.location, one.files, one.beside) for one in found]


def _files(folder: Path, kind: CloudKind) -> CloudFolder | None:
    found = [entry for entry in entries(folder) if entry.is_file()]
    files = tuple(
        folder / entry.name for entry in sorted(found, key=lambda one: one.name) if kind.has_name(entry.name)
    )
    beside = {entry.name: folder / entry.name for entry in found if entry.name in BESIDE}
    if folder.name == "data" and not beside:
        # KITTI's raw data have the times beside the folder of the files
        beside = {name: there for name in TIME_FILES if (there := folder.parent / name).is_file()}
    return CloudFolder(DEFAULT_ID, folder, files, beside) if files else None
