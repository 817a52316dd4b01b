"""BIN: points one after another without a head, as KITTI and nuScenes have them."""

from pathlib import Path

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.clouds.cloud import Cloud, check_count, columns_of
from sceneloom.formats.clouds.layout import KITTI, NUSCENES, FieldLayout
from sceneloom.formats.files import read_bytes


def default_layout(path: Path) -> FieldLayout:
    """The layout of a file whose manifest names none: nuScenes' for `.pcd.bin`, else KITTI's."""
    return NUSCENES if path.name.lower().endswith(".pcd.bin") else KITTI


def read_bin(path: Path, *, layout: FieldLayout | None = None) -> Cloud:
    """Read a file of packed little-endian points.

    Raises:
        DataError: the file is no whole number of points.
    """
    chosen = layout or default_layout(path)
    content, record = read_bytes(path), chosen.dtype
    count, rest = divmod(len(content), record.itemsize)
    if rest:
        problem = (
            f"{len(content)} bytes are {count} points of {record.itemsize} bytes ({chosen}) and {rest} bytes more; "
            "expected whole points: is the file cut off, or has it other fields?"
        )
        raise DataError(path, f"byte {count * record.itemsize}", problem)
    check_count(path, "", count)
    return Cloud(path, count, columns_of(np.frombuffer(content, record, count)))
