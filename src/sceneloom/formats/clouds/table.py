"""The kinds of files that points come in, by suffix."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from sceneloom.errors import DataError
from sceneloom.formats.clouds.bin import read_bin
from sceneloom.formats.clouds.cloud import Cloud
from sceneloom.formats.clouds.las import read_las
from sceneloom.formats.clouds.layout import FieldLayout
from sceneloom.formats.clouds.npz import read_npz
from sceneloom.formats.clouds.pcd import read_pcd
from sceneloom.formats.clouds.ply import read_ply


def _self_described(read: Callable[[Path], Cloud]) -> Callable[[Path, FieldLayout | None], Cloud]:
    return lambda path, _: read(path)


_READERS: Mapping[str, Callable[[Path, FieldLayout | None], Cloud]] = MappingProxyType(
    {
        ".pcd": _self_described(read_pcd),
        ".ply": _self_described(read_ply),
        ".las": _self_described(read_las),
        ".laz": _self_described(read_las),
        ".bin": lambda path, layout: read_bin(path, layout=layout),
        ".npz": lambda path, layout: read_npz(path, layout=layout),
        ".npy": lambda path, layout: read_npz(path, layout=layout),
    }
)

CLOUD_SUFFIXES = tuple(_READERS)
"""Endings of files that hold points."""


def cloud_suffix(path: Path) -> str | None:
    """The ending by which a file is known to hold points, in lower case; None for other files."""
    suffix = path.suffix.lower()
    return suffix if suffix in _READERS else None


def read_cloud(path: Path, *, layout: FieldLayout | None = None) -> Cloud:
    """Read a file of points, column by column.

    Args:
        layout: the columns of files that do not state them (`.bin`, and rows of numbers in `.npz` and `.npy`).

    Raises:
        DataError: the file cannot be read, or its suffix is none of `CLOUD_SUFFIXES`.
    """
    suffix = cloud_suffix(path)
    if suffix is None:
        raise DataError(path, "", f"suffix {path.suffix!r}; expected one of {' '.join(CLOUD_SUFFIXES)}")
    return _READERS[suffix](path, layout)
