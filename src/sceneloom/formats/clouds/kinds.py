"""The kinds of files that a scene of clouds is read from and written to, and what such a file begins with."""

import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.formats.clouds.bin import default_layout
from sceneloom.formats.clouds.npz import POSITION_NAMES
from sceneloom.formats.files import open_file

_BEGINNING = 4096
_FEW_POINTS = 64
_FARTHEST_M = 1e4
_BRIGHTEST = 65535.0


@dataclass(frozen=True, slots=True)
class CloudKind:
    """One kind of files.

    Attributes:
        name: by which it is chosen.
        endings: of its files' names, in lower case.
        excluded: longer endings, which belong to another kind.
        begins: whether a file looks like one from its first bytes.
        told: what a person recognises a file by.
        layout: names of the columns of files that do not say them, for messages; "" for others.
    """

    name: str
    endings: tuple[str, ...]
    begins: Callable[[Path, bytes], bool]
    told: str
    excluded: tuple[str, ...] = ()
    layout: str = ""

    def has_name(self, name: str) -> bool:
        """Whether a file of that name is of this kind."""
        lower = name.lower()
        return lower.endswith(self.endings) and not (self.excluded and lower.endswith(self.excluded))

    def recognises(self, path: Path) -> bool:
        """Whether an existing file is of this kind, by its name and its first bytes."""
        return self.has_name(path.name) and self.begins(path, _first_bytes(path))


def _first_bytes(path: Path) -> bytes:
    try:
        with open_file(path) as file:
            return file.read(_BEGINNING)
    except OSError:
        return b""


def _is_pcd(path: Path, start: bytes) -> bool:
    del path
    return b"FIELDS" in start or b"COLUMNS" in start or (start.startswith(b"#") and b"PCD" in start)


def _is_ply(path: Path, start: bytes) -> bool:
    del path
    return start[:4] in {b"ply\n", b"ply\r", b"ply "}


def _is_las(path: Path, start: bytes) -> bool:
    del path
    return start.startswith(b"LASF")


def _is_bin(path: Path, start: bytes) -> bool:
    """Whether the first records hold places around a sensor and brightness: many files end with `.bin`."""
    record = default_layout(path).dtype
    size = path.stat().st_size
    if not start or size % record.itemsize:
        return False
    points = np.frombuffer(start, record, min(len(start) // record.itemsize, _FEW_POINTS))
    places = np.stack([points[axis].astype(np.float64) for axis in "xyz"])
    bright = points["intensity"].astype(np.float64)
    near = bool((np.abs(places) < _FARTHEST_M).all())
    # the smallest floats are what integers look like
    tiny = bool(((places != 0) & (np.abs(places) < 1e-20)).any())
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


KINDS: Mapping[str, CloudKind] = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            CloudKind("pcd", (".pcd",), _is_pcd, "`.pcd` files of the Point Cloud Library"),
            CloudKind("ply", (".ply",), _is_ply, "`.ply` files with vertices"),
            CloudKind("las", (".las",), _is_las, "`.las` files of laser scanning"),
            CloudKind("laz", (".laz",), _is_las, "`.laz` files, compressed LAS"),
            CloudKind(
                "kitti-bin",
                (".bin",),
                _is_bin,
                "`.bin` files of float32 x y z intensity",
                excluded=(".pcd.bin",),
                layout="x y z intensity",
            ),
            CloudKind(
                "nuscenes-bin",
                (".pcd.bin",),
                _is_bin,
                "`.pcd.bin` files of float32 x y z intensity ring",
                layout="x y z intensity ring",
            ),
            CloudKind("npz", (".npz", ".npy"), _is_npz, "`.npz` files with x, y, z or rows of points"),
        )
    }
)
"""The kinds by name."""
