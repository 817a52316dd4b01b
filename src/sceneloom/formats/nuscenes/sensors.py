"""The sensors of a scene of nuScenes, placed by its mountings and by the ego's pose at each frame."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.nuscenes.frames import CycleFiles, FrameFiles, ImageFiles, SweepFiles
from sceneloom.formats.nuscenes.keyframes import KEY_FRAMES
from sceneloom.formats.nuscenes.selection import SceneTables, SensorData, file_of
from sceneloom.formats.nuscenes.tables import CalibratedSensorRow, Quaternion
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.formats.rig.images import image_size
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Sensor
from sceneloom.scene.warnings import WarningKind

MICROSECOND = 1000
"""Nanoseconds in the unit of all times of the tables."""

TRAJECTORY = "pose"
"""The name of the ego trajectory."""


def build_sensors(tables: SceneTables, ledger: Ledger) -> tuple[Sensor, ...]:
    """Build lidars, radars and cameras.

    Raises:
        DataError: a calibration or a pose is wrong.
    """
    sensors = []
    for data in tables.sensors:
        build = _BUILDERS.get(data.sensor.modality)
        if build is None:
            location = str(tables.location.tables / "sensor.json")
            message = f"{data.sensor.channel} is a {data.sensor.modality!r}; of these nothing is read"
            ledger.note(WarningKind.SKIPPED, "unknown-modality", location, message, count=len(data.rows))
        else:
            sensors.append(build(tables, data))
    return tuple(sensors)


def trajectory_of(tables: SceneTables, ledger: Ledger) -> Trajectory | None:
    """The ego trajectory: its poses at all frames of all sensors; None where there are none.

    Raises:
        DataError: a pose is wrong.
    """
    rows = {row.token: row for data in tables.sensors for row in data.poses}
    if not rows:
        return None
    ordered = sorted(rows.values(), key=lambda row: row.timestamp)
    timestamps_ns = np.array([row.timestamp for row in ordered], np.int64) * MICROSECOND
    times_ns, first = np.unique(timestamps_ns, return_index=True)
    positions = np.array([row.translation for row in ordered], np.float64)
    quaternions = _quaternions(tables, "ego_pose", [(row.token, row.rotation) for row in ordered])
    kept = first[np.searchsorted(times_ns, timestamps_ns)]
    differing = int((positions != positions[kept]).any(axis=1).sum())
    if differing:
        message = "poses of another location at a time that has one already; the first one is taken"
        location = str(tables.location.tables / "ego_pose.json")
        ledger.note(WarningKind.SKIPPED, "poses-repeated", location, message, count=differing)
    return Trajectory(TRAJECTORY, times_ns, positions[first], quaternions[first])


def _quaternions(
    tables: SceneTables, table: str, rotations: Sequence[tuple[str, Quaternion]]
) -> Float64Array:
    """Rotate `w x y z` into unit quaternions (N, 4), scalar last.

    Raises:
        DataError: one is far from length 1.
    """
    values = np.array([rotation for _, rotation in rotations], np.float64).reshape(-1, 4)
    norms, is_off = lengths_of(values)
    wrong = np.flatnonzero(is_off)
    if len(wrong):
        token, rotation = rotations[int(wrong[0])]
        problem = (
            f"rotation {list(rotation)} has the length {norms[wrong[0]]:.4f}; expected w, x, y, z of length 1"
        )
        raise DataError(tables.location.tables / f"{table}.json", f"row {token}", problem)
    return normalise_quaternion(values[:, [1, 2, 3, 0]])


def _mount(tables: SceneTables, row: CalibratedSensorRow) -> RigidTransform:
    """`ego_from_sensor`."""
    quaternion = _quaternions(tables, "calibrated_sensor", [(row.token, row.rotation)])[0]
    try:
        return RigidTransform.from_quaternion(np.array(row.translation), quaternion)
    except CalibrationError as error:
        file = tables.location.tables / "calibrated_sensor.json"
        raise DataError(file, f"row {row.token}", str(error)) from error


def _mounts(tables: SceneTables, data: SensorData) -> dict[str, RigidTransform]:
    rows = {row.token: row for row in data.calibrations}
    return {token: _mount(tables, row) for token, row in rows.items()}


def _files(tables: SceneTables, data: SensorData) -> FrameFiles:
    location = tables.location
    return FrameFiles(
        tuple(file_of(location, "sample_data", row.token, row.filename) for row in data.rows),
        _timestamps(data),
        tuple(
            (
                ("file", row.filename),
                ("token", row.token),
                ("sample_token", row.sample_token),
                ("is_key_frame", row.is_key_frame),
            )
            for row in data.rows
        ),
    )


def _timestamps(data: SensorData) -> Int64Array:
    return np.array([row.timestamp for row in data.rows], np.int64) * MICROSECOND


def _poses(tables: SceneTables, data: SensorData, mounts: Mapping[str, RigidTransform]) -> Poses:
    """`world_from_sensor` at each frame: the ego's pose that the frame names, and the mounting."""
    quaternions = _quaternions(tables, "ego_pose", [(row.token, row.rotation) for row in data.poses])
    positions = np.array([row.translation for row in data.poses], np.float64)
    own = [mounts[row.token] for row in data.calibrations]
    shifts = np.array([mount.translation for mount in own])
    rotations = np.array([mount.quaternion_xyzw for mount in own])
    times_ns, first = np.unique(_timestamps(data), return_index=True)
    return Poses(
        times_ns,
        (rotate_vectors(quaternions, shifts) + positions)[first],
        multiply_quaternions(quaternions, rotations)[first],
    )


def _build_lidar(tables: SceneTables, data: SensorData) -> Sensor:
    mounts, files = _mounts(tables, data), _files(tables, data)
    return LidarSensor(
        id=data.sensor.id,
        frames=LazyFrames(files.timestamps_ns, SweepFiles(files)),
        poses=_poses(tables, data, mounts),
        mount=mounts[data.calibrations[0].token],
        extras=_about(data),
    )


def _build_radar(tables: SceneTables, data: SensorData) -> Sensor:
    mounts, files = _mounts(tables, data), _files(tables, data)
    return RadarSensor(
        id=data.sensor.id,
        frames=LazyFrames(files.timestamps_ns, CycleFiles(files)),
        poses=_poses(tables, data, mounts),
        mount=mounts[data.calibrations[0].token],
        extras=_about(data),
    )


def _build_camera(tables: SceneTables, data: SensorData) -> Sensor:
    mounts, files = _mounts(tables, data), _files(tables, data)
    camera_models = _camera_models(tables, data, files)
    common = mounts[data.calibrations[0].token]
    own = [mounts[row.token] for row in data.calibrations]
    reader = ImageFiles(files, camera_models, tuple(None if mount is common else mount for mount in own))
    return CameraSensor(
        id=data.sensor.id,
        camera=camera_models[0],
        images=LazyFrames(files.timestamps_ns, reader),
        poses=_poses(tables, data, mounts),
        mount=common,
        extras=_about(data),
    )


def _about(data: SensorData) -> Mapping[str, Any]:
    """What the tables state about a sensor that the model has no other location for."""
    return MappingProxyType(
        {
            "token": data.sensor.token,
            "calibrated_sensor_token": data.calibrations[0].token,
            KEY_FRAMES: tuple(row.timestamp for row in data.rows if row.is_key_frame),
        }
    )


def _camera_models(tables: SceneTables, data: SensorData, files: FrameFiles) -> tuple[Camera, ...]:
    """The camera model of each image; all images of nuScenes are undistorted."""
    known: dict[tuple[str, int, int], Camera] = {}
    camera_models = []
    for k, row in enumerate(data.rows):
        calibration = data.calibrations[k]
        size = (row.width or 0, row.height or 0)
        if not all(size):
            size = image_size(files.files[k])
        key = (calibration.token, *size)
        if key not in known:
            known[key] = _camera_model(tables, calibration, size)
        camera_models.append(known[key])
    return tuple(camera_models)


def _camera_model(tables: SceneTables, row: CalibratedSensorRow, size: tuple[int, int]) -> Camera:
    matrix = np.array(row.camera_intrinsic, np.float64)
    fault = f"camera_intrinsic {row.camera_intrinsic}; expected rows (fx, 0, cx), (0, fy, cy), (0, 0, 1)"
    if matrix.shape == (3, 3) and np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]):
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        try:
            return Camera("pinhole", *size, fx, fy, cx, cy)
        except CalibrationError as error:
            fault = str(error)
    raise DataError(tables.location.tables / "calibrated_sensor.json", f"row {row.token}", fault)


_BUILDERS: Mapping[str, Callable[[SceneTables, SensorData], Sensor]] = MappingProxyType(
    {"lidar": _build_lidar, "radar": _build_radar, "camera": _build_camera}
)
