"""A log of Argoverse 2 as a scene."""

from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.argoverse2.cuboids import build_cuboids
from sceneloom.formats.argoverse2.feather import POSE_COLUMNS, poses_of, read_columns
from sceneloom.formats.argoverse2.sensors import build_cameras, build_lidars, read_mounts
from sceneloom.formats.argoverse2.spec import POSES, is_log
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.option_values import as_flag
from sceneloom.formats.spec import choose_drive, drives_in
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import WarningKind

TRAJECTORY = "pose"
"""The name of the ego trajectory."""

_ANGLES = MappingProxyType({"euler_unit": "degrees", "euler_order": "xyz"})


def open_argoverse2(
    path: Path,
    *,
    sequence: str | None = None,
    one_lidar: bool | str = False,
    distorted: bool | str = False,
    lenient: bool = False,
) -> Scene:
    """Open a log; images and points are read when asked for, boxes and poses at once.

    Args:
        path: the folder of a log, or one of several logs.
        sequence: name of the log, where there are several.
        one_lidar: give the points of both lidars as those of one, `lidar`.
        distorted: use the coefficients of the camera models, for images that are not those of the data set.
        lenient: leave out what is at fault and count it.

    Raises:
        DataError: a file is missing or wrong.
        OptionError: there is no such log, none was chosen of several, or an option is neither true nor false.
        MissingExtraError: pyarrow is not installed.
    """
    joined, bent = as_flag("one_lidar", one_lidar), as_flag("distorted", distorted)
    log = choose_drive(
        path,
        drives_in(path, is_log),
        sequence,
        called="log",
        expected=f"{POSES}, calibration/ and sensors/",
    )
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        trajectory = _trajectory(log, ledger)
        poses = None if trajectory is None else trajectory.poses
        mounts = read_mounts(log, ledger)
        sensors = (
            *build_lidars(log, mounts, poses, one_lidar=joined, ledger=ledger),
            *build_cameras(log, mounts, poses, distorted=bent, ledger=ledger),
        )
        annotations = build_cuboids(log, poses, ledger)
        if (log / "map").is_dir():
            ledger.note(WarningKind.SKIPPED, "maps-left-out", str(log / "map"), "maps are left out")
    return Scene(
        sensors=sensors,
        annotations=annotations,
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        metadata=MappingProxyType({"argoverse2": {"log": log.name}, "sceneloom": dict(_ANGLES)}),
        source=str(log),
        format="argoverse2",
        warnings=ledger.warnings,
    )


def _trajectory(log: Path, ledger: Ledger) -> Trajectory | None:
    """The ego trajectory in the city; None in a lenient reading of a log without it.

    Raises:
        DataError: the file is missing or wrong.
    """
    file = log / POSES
    if not file.is_file():
        ledger.fault("poses-missing", DataError(file, "", "is not there; expected the poses of the ego"))
        return None
    columns = read_columns(file, {"timestamp_ns": np.int64, **POSE_COLUMNS})
    timestamps_ns: Int64Array = columns["timestamp_ns"]
    if len(timestamps_ns) == 0:
        raise DataError(file, "", "no row; expected one pose at least")
    positions, quaternions = poses_of(file, columns)
    times_ns, first = np.unique(timestamps_ns, return_index=True)
    if len(times_ns) < len(timestamps_ns):
        message = "further poses of a time that has one already are left out"
        ledger.note(
            WarningKind.SKIPPED,
            "poses-repeated",
            str(file),
            message,
            count=len(timestamps_ns) - len(times_ns),
        )
    return Trajectory(TRAJECTORY, times_ns, positions[first], quaternions[first])
