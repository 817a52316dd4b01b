"""The sensors of a drive: two lidars whose points stand in one file, cameras, a satellite receiver."""

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.pandaset.pickled_frames import PickledFrame, read_pickled_frame
from sceneloom.formats.pandaset.spec import numbered_files
from sceneloom.formats.pandaset.text_files import (
    LATEST_SECONDS,
    NANOSECONDS,
    CameraModel,
    Fix,
    as_dict,
    read_json,
    read_poses,
    read_times,
)
from sceneloom.formats.rig.images import ImageReader, image_size
from sceneloom.formats.rig.lidars import FARTHEST_WORLD
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.scene.warnings import WarningKind

LIDARS = ("main_pandar64", "front_gt")
"""The lidars by their number in the column `d`; the names are those of the published static calibration."""

TRAJECTORY = "pose"
"""The name of the ego trajectory."""

LIDAR_FROM_EGO = RigidTransform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""PandaSet's own frame has x right and y forward; an ego here has x forward and y left."""

_LARGEST_BYTE = 255


@dataclass(frozen=True, slots=True, eq=False)
class Sweeps:
    """The files with the points of both lidars.

    Attributes:
        folder: `lidar` of the drive.
        files: of each sweep.
        timestamps_ns: (N,) int64 [ns].
        poses: world from main lidar, at each sweep.
    """

    folder: Path
    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    poses: Poses


def read_sweeps(drive: Path) -> Sweeps:
    """Find the sweeps of a drive, their times and poses; no point is read.

    Raises:
        DataError: there is none, or times or poses are missing or wrong.
    """
    folder = drive / "lidar"
    files = tuple(numbered_files(folder, r"\.pkl(\.gz)?"))
    if not files:
        raise DataError(folder, "", "no sweep; expected files such as 00.pkl.gz")
    timestamps_ns = read_times(folder / "timestamps.json", len(files))
    positions, quaternions = read_poses(folder / "poses.json", len(files))
    return Sweeps(folder, files, timestamps_ns, Poses(timestamps_ns, positions, quaternions))


def trajectory_of(sweeps: Sweeps) -> Trajectory:
    """The ego trajectory: where the main lidar was, with x forward."""
    rotation = LIDAR_FROM_EGO.quaternion_xyzw
    quaternions = multiply_quaternions(sweeps.poses.quaternions_xyzw, rotation)
    return Trajectory(TRAJECTORY, sweeps.timestamps_ns, sweeps.poses.positions, quaternions)


def rows_of_lidar(frame: PickledFrame, number: int) -> BoolArray:
    """(N,) bool: which rows of a sweep are points of a lidar; without a column `d` all are the main lidar's."""
    if "d" not in frame.columns:
        return np.full(frame.count, number == 0)
    chosen: BoolArray = frame.numbers("d") == number
    return chosen


@dataclass(frozen=True, slots=True, eq=False)
class SweepFiles:
    """Reads the sweeps of one lidar out of files that hold those of both.

    Attributes:
        files: of each sweep.
        timestamps_ns: (N,) int64 [ns].
        number: of the lidar in the column `d`.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    number: int

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing, cut off, or no frame of points.
        """
        frame = read_pickled_frame(self.files[k])
        chosen = rows_of_lidar(frame, self.number)
        positions = np.stack([frame.numbers(axis)[chosen] for axis in "xyz"], axis=1)
        if len(positions) and np.abs(positions).max() > FARTHEST_WORLD:
            problem = f"points {np.abs(positions).max():.0f} m from the world's origin; expected {FARTHEST_WORLD:g} m"
            raise DataError(self.files[k], "", f"{problem} at most")
        extras: dict[str, AnyArray] = {}
        points = LidarPoints(
            positions=read_only(positions, np.float32),
            intensities=self._intensities(frame, chosen, extras),
            timestamps_ns=self._times(frame, chosen),
            extras=MappingProxyType(extras),
        )
        timestamp_ns = int(self.timestamps_ns[k])
        return LidarFrame(timestamp_ns, points, MappingProxyType({"file": f"lidar/{self.files[k].name}"}))

    @staticmethod
    def _intensities(frame: PickledFrame, chosen: BoolArray, extras: dict[str, AnyArray]) -> AnyArray:
        """Brightness from 0 to 255; what rounding changes of it is kept beside it."""
        given = frame.numbers("i")[chosen]
        rounded = np.clip(np.rint(given), 0, _LARGEST_BYTE)
        if not np.array_equal(rounded, given):
            extras["i"] = read_only(given)
        return read_only(rounded, np.uint8)

    @staticmethod
    def _times(frame: PickledFrame, chosen: BoolArray) -> AnyArray:
        seconds = frame.numbers("t")[chosen]
        if len(seconds) and np.abs(seconds).max() > LATEST_SECONDS:
            raise DataError(frame.file, "t", f"{seconds.max():g}; expected seconds")
        return read_only(np.rint(seconds * NANOSECONDS), np.int64)


def build_lidars(sweeps: Sweeps) -> list[Sensor]:
    """Build the lidar that rotations and the one that looks ahead; of the latter the location is not reported."""
    main, front = (
        LazyFrames(sweeps.timestamps_ns, SweepFiles(sweeps.files, sweeps.timestamps_ns, number))
        for number in range(len(LIDARS))
    )
    mount = LIDAR_FROM_EGO.inverse()
    return [
        LidarSensor(LIDARS[0], main, sweeps.poses, mount, points_frame=PointsFrame.WORLD, model="Pandar64"),
        LidarSensor(LIDARS[1], front, points_frame=PointsFrame.WORLD, model="PandarGT"),
    ]


def build_cameras(drive: Path, ledger: Ledger) -> list[Sensor]:
    """Build the cameras, each with its own poses at its own times.

    Raises:
        DataError: a file is missing or wrong.
    """
    folders = sorted(child for child in (drive / "camera").glob("*") if child.is_dir())
    if not folders:
        message = "no camera; only sweeps are read"
        ledger.note(WarningKind.SKIPPED, "cameras-missing", str(drive / "camera"), message)
    return [_camera(folder) for folder in folders]


def _camera(folder: Path) -> CameraSensor:
    files = tuple(numbered_files(folder, r"\.jpg"))
    if not files:
        raise DataError(folder, "", "no image; expected files such as 00.jpg")
    timestamps_ns = read_times(folder / "timestamps.json", len(files))
    positions, quaternions = read_poses(folder / "poses.json", len(files))
    camera_model = read_json(folder / "intrinsics.json", CameraModel)
    try:
        camera = Camera(
            "pinhole",
            *image_size(files[0]),
            camera_model.fx,
            camera_model.fy,
            camera_model.cx,
            camera_model.cy,
        )
    except CalibrationError as error:
        raise DataError(folder / "intrinsics.json", "", str(error)) from error
    names = tuple(f"camera/{folder.name}/{file.name}" for file in files)
    return CameraSensor(
        id=folder.name,
        camera=camera,
        images=LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera)),
        poses=Poses(timestamps_ns, positions, quaternions),
    )


def build_receiver(drive: Path) -> list[Sensor]:
    """Build the satellite receiver; [] where the drive has no fixes.

    Raises:
        DataError: a file is missing or wrong.
    """
    file = drive / "meta" / "gps.json"
    if not file.is_file():
        return []
    fixes = read_json(file, list[Fix])
    timestamps_ns = read_times(drive / "meta" / "timestamps.json", len(fixes))
    locations = np.array([[fix.lat, fix.long, fix.height] for fix in fixes]).reshape(-1, 3)
    unknown = np.full(len(fixes), np.nan)
    velocities = {
        name: tuple(as_dict(fix)[name] for fix in fixes)
        for name in ("xvel", "yvel")
        if any(as_dict(fix)[name] is not None for fix in fixes)
    }
    return [
        GnssSensor("gps", timestamps_ns, locations, unknown, unknown, extras=MappingProxyType(velocities))
    ]
