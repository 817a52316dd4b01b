"""A folder of Scale's lidar toolkit as a scene."""

from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.option_values import as_positive
from sceneloom.formats.scale_toolkit.frame_names import frame_names, times_of
from sceneloom.formats.scale_toolkit.sensors import build_camera, build_lidar, build_radar, read_pose
from sceneloom.formats.scale_toolkit.spec import CLOUDS
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene

TRAJECTORY = "pose"


def open_scale_toolkit(path: Path, *, rate_hz: float | str | None = None, lenient: bool = False) -> Scene:
    """Open a folder; images and points are read when asked for.

    Args:
        path: with `pointcloud/`, `poses/` and `cameras/`.
        rate_hz: frames a second, where the names of the frames are no times; None: 10, which is reported.
        lenient: go without poses and cameras that are missing or wrong, and count them.

    Raises:
        DataError: a file is missing or wrong.
        OptionError: the rate is no number above 0.
    """
    rate = None if rate_hz is None else as_positive("rate_hz", rate_hz)
    if not path.is_dir():
        raise DataError(path, "", "no such folder; expected one with pointcloud/, poses/ and cameras/")
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        clouds = frame_names(path / "pointcloud", CLOUDS)
        if not clouds:
            raise DataError(path / "pointcloud", "", "no cloud; expected files such as 1.ply or 1.pcd")
        timestamps_ns = times_of(list(clouds), rate, path / "pointcloud", ledger)
        trajectory = _trajectory(path, clouds, timestamps_ns, ledger)
        poses = None if trajectory is None else trajectory.poses
        times = dict(zip(clouds, timestamps_ns.tolist(), strict=True))
        sensors = [
            build_lidar(clouds, timestamps_ns, poses),
            *build_radar(path / "radar_points", times, poses, ledger),
        ]
        for folder in sorted(child for child in (path / "cameras").glob("*") if child.is_dir()):
            try:
                sensors.append(build_camera(folder, times, poses, ledger))
            except DataError as error:
                ledger.fault("cameras", error)
    return Scene(
        sensors=tuple(sensors),
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        source=str(path),
        format="scale-toolkit",
        warnings=ledger.warnings,
    )


def _trajectory(
    path: Path, clouds: dict[str, Path], timestamps_ns: Int64Array, ledger: Ledger
) -> Trajectory | None:
    """The ego trajectory: a file for each cloud, world from ego."""
    known, rows = [], []
    for row, name in enumerate(clouds):
        try:
            known.append(read_pose(path / "poses" / f"{name}.json"))
        except DataError as error:
            ledger.fault("poses", error)
        else:
            rows.append(row)
    if not known:
        return None
    return Trajectory(
        TRAJECTORY,
        timestamps_ns[rows],
        np.array([pose.translation for pose in known]),
        np.array([pose.quaternion_xyzw for pose in known]),
    )
