"""A file of points, a folder of such files of one kind, or a folder of such folders: one for each lidar."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from sceneloom.errors import DataError
from sceneloom.formats.clouds.kinds import KINDS, CloudKind

TIME_FILES = ("timestamps.txt", "times.txt")
"""Files beside the clouds with one time per line, in the order of the names."""

SENSOR_POSES, EGO_POSES = "world_from_sensor.tum", "world_from_ego.tum"
"""Files beside the clouds with the poses of the frame that the points are in."""

_BESIDE = (*TIME_FILES, SENSOR_POSES, EGO_POSES)
_TEXTS = ("readme", "license", "licence")
DEFAULT_ID = "lidar"

_LOOKED_AT = 5
"""Files of one ending that are looked into, where the first of them is torn."""


@dataclass(frozen=True, slots=True)
class CloudFolder:
    """The files of one lidar, in the order of their names.

    Attributes:
        sensor_id: what the lidar is called.
        place: the folder, or the only file.
        files: at least one.
        beside: files that say more about them, by name.
    """

    sensor_id: str
    place: Path
    files: tuple[Path, ...]
    beside: dict[str, Path]


def _entries(folder: Path) -> Iterator["os.DirEntry[str]"]:
    """What is in a folder and counts: hidden files and texts for people do not."""
    with os.scandir(folder) as found:
        for entry in found:
            if not entry.name.startswith(".") and not entry.name.lower().startswith(_TEXTS):
                yield entry


def holds_kind(path: Path, kind: CloudKind) -> bool:
    """Whether a path is a file of a kind, or a folder with files of it, or of folders with such, and nothing else."""
    if path.is_file():
        return kind.recognises(path)
    if not path.is_dir():
        return False
    try:
        folders = [path / entry.name for entry in _entries(path) if entry.is_dir()]
        if not folders:
            return _is_flat(path, kind)
        return all(_is_flat(folder, kind) for folder in folders) and not any(
            entry.is_file() for entry in _entries(path)
        )
    except OSError:
        return False


def _is_flat(folder: Path, kind: CloudKind) -> bool:
    """Whether a folder has at least one file of a kind; of files of other kinds of clouds another format tells."""
    # some names per ending: folders of many thousand files are looked at by every kind, and some may be torn
    samples: dict[str, list[Path]] = {}
    for entry in _entries(folder):
        if entry.is_dir():
            return False
        same = samples.setdefault(_ending(entry.name), [])
        if len(same) < _LOOKED_AT and entry.name not in _BESIDE:
            same.append(folder / entry.name)
    found = [path for same in samples.values() for path in same]
    known = all(any(other.has_name(path.name) for other in KINDS.values()) for path in found)
    return known and any(kind.recognises(path) for path in found if kind.has_name(path.name))


def _ending(name: str) -> str:
    before, _, last = name.lower().rpartition(".")
    return f"{before.rpartition('.')[2]}.{last}" if before.endswith(".pcd") else last


def near_miss(path: Path, kind: CloudKind) -> str | None:
    """Say what keeps a path that has files of a kind from being a folder of clouds."""
    if path.is_file():
        told = kind.has_name(path.name) and not kind.recognises(path)
        return _not_begun(path.name, kind) if told else None
    try:
        names = [(entry.name, entry.is_dir()) for entry in _entries(path)] if path.is_dir() else []
    except OSError:
        return None
    ours = [name for name, is_folder in names if not is_folder and kind.has_name(name)]
    others = sorted(name for name, is_folder in names if is_folder or name not in {*ours, *_BESIDE})
    if not ours or holds_kind(path, kind):
        return None
    if not others:
        return _not_begun(ours[0], kind)
    return (
        f"it has {len(ours)} {kind.told}, but {others[0]!r}, too: read them with `--read-as {kind.name}`, or say "
        "with a rig.toml what is what"
    )


def _not_begun(name: str, kind: CloudKind) -> str:
    return f"{name} ends as {kind.told} do, but does not begin so"


def find_folders(path: Path, kind: CloudKind) -> list[CloudFolder]:
    """Find the files of each lidar.

    Raises:
        DataError: there are none.
    """
    if path.is_file():
        return [CloudFolder(DEFAULT_ID, path, (path,), {})]
    try:
        folders = sorted(path / entry.name for entry in _entries(path) if entry.is_dir())
        own = _files(path, kind)
        found = [] if own is None else [own]
        if own is None:
            found = [one for folder in folders if (one := _files(folder, kind)) is not None]
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    if not found:
        raise DataError(path, "", f"has no files of points; expected {kind.told}")
    if len(found) == 1 and found[0].place == path:
        return found
    return [CloudFolder(unquote(one.place.name), one.place, one.files, one.beside) for one in found]


def _files(folder: Path, kind: CloudKind) -> CloudFolder | None:
    entries = [entry for entry in _entries(folder) if entry.is_file()]
    files = tuple(
        folder / entry.name
        for entry in sorted(entries, key=lambda one: one.name)
        if kind.has_name(entry.name)
    )
    beside = {entry.name: folder / entry.name for entry in entries if entry.name in _BESIDE}
    if folder.name == "data" and not beside:
        # KITTI's raw data have the times beside the folder of the files
        beside = {name: there for name in TIME_FILES if (there := folder.parent / name).is_file()}
    return CloudFolder(DEFAULT_ID, folder, files, beside) if files else None
