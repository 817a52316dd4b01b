"""Files of point clouds, one per sweep: how they are recognised, their options and supported fields."""

import os
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.losses import KEPT, Supports, approximated, converted, dropped
from sceneloom.formats.base.spec import FormatSpec, as_positive, first_bytes, option
from sceneloom.scene.types import PointsFrame

TIME_FILES = ("timestamps.txt", "times.txt")
"""Files beside the clouds with one time per line, in the order of the names."""

SENSOR_POSES, EGO_POSES = "world_from_sensor.tum", "world_from_ego.tum"
"""Files beside the clouds with the poses of the frame that the points are in."""

BESIDE = (*TIME_FILES, SENSOR_POSES, EGO_POSES)
_TEXTS = ("readme", "license", "licence")
DEFAULT_ID = "lidar"

POSITION_NAMES = ("points", "positions", "xyz", "pos", "pts", "arr_0")
"""Arrays of rows of `.npz` files that hold x, y, z and perhaps more."""

ENCODINGS = ("binary", "ascii", "binary_compressed")
"""How PCD files are written."""

_BEGINNING = 4096
_FEW_POINTS = 64
_FARTHEST_M = 1e4
_BRIGHTEST = 65535.0

_LOOKED_AT = 5  # files of one ending that are looked into, where the first of them is torn


@dataclass(frozen=True, slots=True)
class CloudReading:
    """How clouds are to be read."""

    lenient: bool = option(default=False, help="Leave out files that cannot be read; each is looked into for that.")
    points_frame: str | None = option(
        default=None,
        help="Frame of the points: sensor, ego or world. By default the sensor's, unless poses state the ego's.",
    )
    rate_hz: float | None = option(
        default=None, help="Frames per second of files whose names are plain numbers; 10 by default."
    )

    def __post_init__(self) -> None:
        if self.points_frame is not None and self.points_frame not in tuple(PointsFrame):
            raise OptionError(f"points frame {self.points_frame!r}; expected one of {', '.join(PointsFrame)}")
        if self.rate_hz is not None:
            object.__setattr__(self, "rate_hz", as_positive("rate_hz", self.rate_hz))


@dataclass(frozen=True, slots=True)
class CloudKind:
    """One kind of files.

    Attributes:
        name: by which it is chosen.
        endings: of its files' names, in lower case.
        excluded: longer endings, which belong to another kind.
        begins: whether a file looks like one from its first bytes.
        reported: what a person recognises a file by.
        has_layout: whether the files do not state their columns.
    """

    name: str
    endings: tuple[str, ...]
    begins: Callable[[Path, bytes], bool]
    reported: str
    excluded: tuple[str, ...] = ()
    has_layout: bool = False

    def has_name(self, name: str) -> bool:
        """Whether a file of that name is of this kind."""
        lower = name.lower()
        return lower.endswith(self.endings) and not (self.excluded and lower.endswith(self.excluded))

    def recognises(self, path: Path) -> bool:
        """Whether an existing file is of this kind, by its name and its first bytes."""
        return self.has_name(path.name) and self.begins(path, first_bytes(path, _BEGINNING))


def _is_bin(path: Path, start: bytes) -> bool:
    """Whether the first records hold locations around a sensor and brightness: many files end with `.bin`."""
    columns = 5 if path.name.lower().endswith(".pcd.bin") else 4
    length = 4 * columns
    if not start or path.stat().st_size % length:
        return False
    count = min(len(start) // length, _FEW_POINTS)
    points = np.frombuffer(start, "<f4", count * columns).reshape(count, columns).astype(np.float64)
    locations, bright = points[:, :3], points[:, 3]
    near = bool((np.abs(locations) < _FARTHEST_M).all())
    # the smallest floats are what integers look like
    tiny = bool(((locations != 0) & (np.abs(locations) < 1e-20)).any())
    return near and not tiny and bool(((bright >= 0) & (bright <= _BRIGHTEST)).all())


def _is_npz(path: Path, start: bytes) -> bool:
    if start.startswith(b"\x93NUMPY"):
        head = start[:256].decode("latin-1")
        return "'shape': (" in head and any(f", {columns})" in head for columns in (3, 4))
    if not start.startswith(b"PK"):
        return False
    try:
        with open_file(path) as file, zipfile.ZipFile(file) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except (OSError, zipfile.BadZipFile, ValueError, RuntimeError, NotImplementedError):
        return False
    return bool(names & set(POSITION_NAMES)) or {"x", "y", "z"} <= names


def _is_las(_: Path, start: bytes) -> bool:
    return start.startswith(b"LASF")


_KINDS = (
    CloudKind(
        "pcd",
        (".pcd",),
        lambda _, start: b"FIELDS" in start or b"COLUMNS" in start or (start.startswith(b"#") and b"PCD" in start),
        "`.pcd` files of the Point Cloud Library",
    ),
    CloudKind(
        "ply", (".ply",), lambda _, start: start[:4] in {b"ply\n", b"ply\r", b"ply "}, "`.ply` files with vertices"
    ),
    CloudKind("las", (".las",), _is_las, "`.las` files of laser scanning"),
    CloudKind("laz", (".laz",), _is_las, "`.laz` files, compressed LAS"),
    CloudKind(
        "kitti-bin", (".bin",), _is_bin, "`.bin` files of float32 x y z intensity", (".pcd.bin",), has_layout=True
    ),
    CloudKind(
        "nuscenes-bin", (".pcd.bin",), _is_bin, "`.pcd.bin` files of float32 x y z intensity ring", has_layout=True
    ),
    CloudKind("npz", (".npz", ".npy"), _is_npz, "`.npz` files with x, y, z or rows of points"),
)
KINDS: Mapping[str, CloudKind] = MappingProxyType({kind.name: kind for kind in _KINDS})
"""The kinds by name."""


def entries(folder: Path) -> Iterator["os.DirEntry[str]"]:
    """What is in a folder and counts: hidden files and texts for people do not."""
    with os.scandir(folder) as found:
        for entry in found:
            if not entry.name.startswith(".") and not entry.name.lower().startswith(_TEXTS):
                yield entry


def _holds_kind(path: Path, kind: CloudKind) -> bool:
    """Whether a path is a file of a kind, or a folder with files of it, or of folders with such, and nothing else."""
    if path.is_file():
        return kind.recognises(path)
    if not path.is_dir():
        return False
    try:
        folders = [path / entry.name for entry in entries(path) if entry.is_dir()]
        if not folders:
            return _is_flat(path, kind)
        return all(_is_flat(folder, kind) for folder in folders) and not any(entry.is_file() for entry in entries(path))
    except OSError:
        return False


def _is_flat(folder: Path, kind: CloudKind) -> bool:
    """Whether a folder has at least one file of a kind; of files of other kinds of clouds another format reports."""
    # some names per ending: folders of many thousand files are looked at by every kind, and some may be torn
    samples: dict[str, list[Path]] = {}
    for entry in entries(folder):
        if entry.is_dir():
            return False
        same = samples.setdefault(_ending(entry.name), [])
        if len(same) < _LOOKED_AT and entry.name not in BESIDE:
            same.append(folder / entry.name)
    found = [path for same in samples.values() for path in same]
    known = all(any(other.has_name(path.name) for other in KINDS.values()) for path in found)
    return known and any(kind.recognises(path) for path in found if kind.has_name(path.name))


def _ending(name: str) -> str:
    before, _, last = name.lower().rpartition(".")
    return f"{before.rpartition('.')[2]}.{last}" if before.endswith(".pcd") else last


def _near_miss(path: Path, kind: CloudKind) -> str | None:
    """Report what keeps a path that has files of a kind from being a folder of clouds."""
    if path.is_file():
        reported = kind.has_name(path.name) and not kind.recognises(path)
        return _not_begun(path.name, kind) if reported else None
    try:
        names = [(entry.name, entry.is_dir()) for entry in entries(path)] if path.is_dir() else []
    except OSError:
        return None
    ours = [name for name, is_folder in names if not is_folder and kind.has_name(name)]
    others = sorted(name for name, is_folder in names if is_folder or name not in {*ours, *BESIDE})
    if not ours or _holds_kind(path, kind):
        return None
    if not others:
        return _not_begun(ours[0], kind)
    return (
        f"it has {len(ours)} {kind.reported}, but {others[0]!r}, too: read them with `--input-format {kind.name}`, or "
        "describe the folder with a rig.toml"
    )


def _not_begun(name: str, kind: CloudKind) -> str:
    return f"{name} ends as {kind.reported} do, but does not begin so"


_POINTS_ONLY = dropped("left out: files of points hold the frames of lidars only")

_LIDAR: Supports = {
    "sensors.lidar": KEPT,
    "sensors.lidar.id": converted("the name of the lidar's folder, as text; one lidar alone is read back as 'lidar'"),
    "sensors.lidar.poses": converted("a file of poses beside the clouds, at the times of the frames"),
    "sensors.lidar.mount": converted("part of the poses beside the clouds; without them only the identity is kept"),
    "sensors.lidar.coordinates": converted("the file of poses leads into the world"),
    "sensors.lidar.points_frame": converted("reported by the name of the file of poses beside the clouds, if there is "
    "one"),
    "sensors.lidar.model": dropped("left out: files of points state nothing of the device"),
    "sensors.lidar.parent_id": dropped("left out: files of points state nothing of the device"),
    "sensors.lidar.extras": converted("the scale of the brightness is seen in the files; others are dropped"),
    "sensors.lidar.frames.timestamp_ns": converted("the name of the file, in nanoseconds"),
    "sensors.lidar.frames.extras": converted("names of files are given anew; others are dropped"),
    "sensors.lidar.frames.points.timestamps_ns": converted("a column of nanoseconds from the frame's time on"),
    "sensors.lidar.frames.points.extras": converted("columns, if they are numbers with a row per point"),
}  # fmt: skip

_STEPS = approximated("rounded to steps of 0.01 mm, or 1 mm where points are more than 20 km apart")
_NONE = dropped("left out: such files have x y z and intensity only, nuScenes' the laser, too")

_OF_KIND: Mapping[str, Supports] = {
    "las": {"sensors.lidar.frames.points.positions": _STEPS},
    "laz": {"sensors.lidar.frames.points.positions": _STEPS},
    "kitti-bin": {
        f"sensors.lidar.frames.points.{name}": _NONE
        for name in ("timestamps_ns", "colors", "rings", "camera_index", "extras")
    },
    "nuscenes-bin": {
        f"sensors.lidar.frames.points.{name}": _NONE for name in ("timestamps_ns", "colors", "camera_index", "extras")
    },
}


SUPPORTS: Mapping[str, Supports] = MappingProxyType(
    {kind: MappingProxyType({"": _POINTS_ONLY, **_LIDAR, **_OF_KIND.get(kind, {})}) for kind in KINDS}
)
"""What becomes of each field in files of a kind."""


def _spec_of(kind: CloudKind) -> FormatSpec:
    return FormatSpec(
        name=kind.name,
        title=kind.name,
        looks_like=f"{kind.reported}: one, or a folder of them",
        suffixes=kind.endings[:1],
        sniff=partial(_holds_kind, kind=kind),
        near_miss=partial(_near_miss, kind=kind),
        reader="sceneloom.formats.points.reader:open_clouds",
        read_options=CloudReading,
        writer="sceneloom.formats.points.writer:write_clouds",
        write_options=("frame", *(("encoding",) if kind.name == "pcd" else ()), "lidar", "trajectory"),
        supports=SUPPORTS[kind.name],
        along_trajectory=True,
        given={"kind": kind},
    )


PCD, PLY, LAS, LAZ, KITTI_BIN, NUSCENES_BIN, NPZ = map(_spec_of, KINDS.values())
