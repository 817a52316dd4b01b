"""The boxes of a log as cuboids: one for each track, brought from the ego's frame into the world."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.argoverse2.feather import POSE_COLUMNS, Columns, poses_of, read_columns
from sceneloom.formats.argoverse2.spec import ANNOTATIONS
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.poses import Poses

_SIZES = ("length_m", "width_m", "height_m")
_COLUMNS: Columns = {
    "timestamp_ns": np.int64,
    "track_uuid": str,
    "category": str,
    **dict.fromkeys(_SIZES, np.float64),
    **POSE_COLUMNS,
    "num_interior_pts": np.int64,
}


def build_cuboids(log: Path, path: Poses | None, ledger: Ledger) -> tuple[CuboidAnnotation, ...]:
    """Build a cuboid for each track, in the order in which they come up; () where the log has no annotations.

    Args:
        log: the folder.
        path: `world_from_ego`.
        ledger: takes what a lenient reading leaves out.

    Raises:
        DataError: the file is wrong, or a box is at a time of which no pose is known.
    """
    file = log / ANNOTATIONS
    if not file.is_file():
        return ()
    columns = read_columns(file, _COLUMNS)
    sizes = np.stack([columns[name] for name in _SIZES], axis=1)
    _check_sizes(file, sizes)
    timestamps_ns = columns["timestamp_ns"]
    values, known = _values(file, sizes, poses_of(file, columns), timestamps_ns, path)
    if not known.all():
        k = int(np.argmin(known))
        problem = f"row {k} is at {timestamps_ns[k]} ns; expected a time of which the ego's pose is known"
        ledger.fault(
            "boxes-without-pose", DataError(file, "timestamp_ns", problem), count=int((~known).sum())
        )
    tracks: dict[str, list[int]] = {}
    for row in np.flatnonzero(known).tolist():
        tracks.setdefault(columns["track_uuid"][row], []).append(row)
    return tuple(_cuboid(file, name, rows, columns, values) for name, rows in tracks.items())


def _check_sizes(file: Path, sizes: Float64Array) -> None:
    wrong = (sizes <= 0).any(axis=1)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(file, f"row {k}: {', '.join(_SIZES)}", f"{sizes[k].tolist()}; expected sizes above 0")


def _values(
    file: Path,
    sizes: Float64Array,
    ego_from_box: tuple[Float64Array, Float64Array],
    timestamps_ns: Int64Array,
    path: Poses | None,
) -> tuple[Float64Array, BoolArray]:
    """Rows `dx dy dz px py pz roll pitch yaw` in the world, and which of them are known."""
    if path is None:
        raise DataError(file, "", "boxes are in the ego's frame, whose trajectory is not known")
    ego = path.interpolate(timestamps_ns)
    known = ego.coverage == 0
    positions, quaternions = ego_from_box
    values = np.full((len(sizes), 9), np.nan)
    values[:, :3] = sizes
    rotations = ego.quaternions_xyzw[known]
    values[known, 3:6] = rotate_vectors(rotations, positions[known]) + ego.positions[known]
    values[known, 6:] = CuboidAngles().from_quaternions(multiply_quaternions(rotations, quaternions[known]))
    return values, known


def _cuboid(
    file: Path, name: str, rows: Sequence[int], columns: dict[str, Any], values: Float64Array
) -> CuboidAnnotation:
    order = sorted(rows, key=lambda row: columns["timestamp_ns"][row])
    timestamps_ns = np.array(columns["timestamp_ns"][order], np.int64)
    repeated = np.flatnonzero(timestamps_ns[1:] == timestamps_ns[:-1])
    if len(repeated):
        problem = f"track {name!r} has two boxes at {timestamps_ns[repeated[0]]} ns; expected one"
        raise DataError(file, f"row {order[int(repeated[0]) + 1]}", problem)
    counts = tuple(columns["num_interior_pts"][order].tolist())
    labels = list(dict.fromkeys(columns["category"][order].tolist()))
    classes = (AttributePath("category", tuple(columns["category"][order].tolist()), timestamps_ns),)
    return CuboidAnnotation(
        id=name,
        path=CuboidPath(timestamps_ns, values[order]),
        label=labels[0],
        attributes=(
            AttributePath("num_interior_pts", counts, timestamps_ns),
            *(classes if len(labels) > 1 else ()),
        ),
    )
