"""The trajectories of a recording: the ego trajectory under each name, and where sensors were along the default one."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.poses import GREATEST_NORM_ERROR
from sceneloom.formats.recording.column_arrays import SortedColumns, by_time
from sceneloom.formats.recording.columns import PoseColumns
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.warnings import WarningKind

RANKS: Mapping[str, int] = {"groundTruth": 0, "pose": 1, "externalPose": 1}
"""Which root keys are taken for the default trajectory before others."""

RESERVED_NAMES = {"gnss", "lidar", "identity"}
"""Names that stand for ways which are computed."""


def build_trajectories(
    poses: Mapping[tuple[str, str], PoseColumns], path: Path, ledger: Ledger
) -> dict[tuple[str, str], Trajectory]:
    """Build the trajectories, the default one first.

    Args:
        poses: by root key and name.
        path: `data.jsonl`, for messages.

    Returns:
        The trajectories by root key and name as in `poses`; their own names differ from each other.

    Raises:
        DataError: an orientation is not of length 1, and the reading is not lenient.
    """
    trajectories: dict[tuple[str, str], Trajectory] = {}
    names = set(RESERVED_NAMES)
    for origin in sorted(poses, key=lambda origin: RANKS.get(origin[0], 2)):
        root, name = origin
        free = name if name not in names else f"{root or 'root'}:{name}"
        trajectory = _trajectory(free, poses[origin], path, ledger)
        if trajectory is not None:
            trajectories[origin] = trajectory
            names.add(free)
    return trajectories


def _trajectory(name: str, columns: PoseColumns, path: Path, ledger: Ledger) -> Trajectory | None:
    samples = by_time(columns.samples)
    lines = np.asarray(columns.lines)[samples.order]
    quaternions = samples.values[:, 3:]
    missing = np.isnan(quaternions[:, 0])
    oriented = not missing.all()
    usable = np.ones(len(lines), np.bool_)
    if oriented:
        usable = _check_orientations(name, samples, lines, path, ledger)
        _note_missing(name, missing, lines, path, ledger)
    usable = _first_of_each_time(name, samples, usable, lines, path, ledger)
    if not usable.any():
        return None
    return Trajectory(
        name,
        read_only(samples.timestamps_ns[usable]),
        read_only(samples.values[usable, :3]),
        read_only(quaternions[usable]) if oriented else None,
        read_only(samples.seconds[usable]),
    )


def _check_orientations(
    name: str, samples: SortedColumns, lines: Int64Array, path: Path, ledger: Ledger
) -> BoolArray:
    quaternions = samples.values[:, 3:]
    with np.errstate(over="ignore"):
        error = np.abs(np.sqrt((quaternions * quaternions).sum(axis=1)) - 1.0)
    usable: BoolArray = error <= GREATEST_NORM_ERROR
    for row in np.flatnonzero(~usable & ~np.isnan(error)):
        shown = ", ".join(f"{number:.6g}" for number in quaternions[row].tolist())
        problem = f"{name}.orientation: {shown} (x, y, z, w); expected length 1 within 0.01"
        ledger.fault("unusable-orientations", DataError(path, f"line {lines[row]}", problem))
    return usable


def _note_missing(name: str, missing: BoolArray, lines: Int64Array, path: Path, ledger: Ledger) -> None:
    """Report how many poses lack the orientation that others have: nothing is made up for them."""
    count = int(missing.sum())
    if count:
        message = (
            f"{count} of {len(missing)} poses of {name!r} have no orientation, while others have one; they are left "
            "out of the trajectory"
        )
        location = f"{path}: line {lines[np.flatnonzero(missing)[0]]}"
        ledger.note(WarningKind.SKIPPED, "poses-without-orientation", location, message, count=count)


def _first_of_each_time(
    name: str, samples: SortedColumns, usable: BoolArray, lines: Int64Array, path: Path, ledger: Ledger
) -> BoolArray:
    """Keep one pose per time: a body is in one location."""
    kept = usable.copy()
    rows = np.flatnonzero(usable)
    repeated = rows[1:][np.diff(samples.timestamps_ns[rows]) == 0]
    if len(repeated):
        kept[repeated] = False
        message = f"{name!r} has several poses at {samples.seconds[repeated[0]]} s; the first was kept"
        location = f"{path}: line {lines[repeated[0]]}"
        ledger.note(WarningKind.SKIPPED, "repeated-poses", location, message, count=len(repeated))
    return kept
