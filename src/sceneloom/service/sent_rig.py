"""The sensors of a scene as a session knows them: numbers, calibrations of table 3, and the ego trajectory."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import msgspec
import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.fitting import fit
from sceneloom.cameras.table import MODELS
from sceneloom.editing.frames import to_sensor
from sceneloom.errors import CalibrationError, DataError, PoseError
from sceneloom.fusion.calibration.axes import DeclaredAxes
from sceneloom.fusion.calibration.declared import calibration_data
from sceneloom.fusion.calibration.entries import CalibrationEntry
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_motion import find_ego_motion
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import points_source, sensor_source
from sceneloom.scene.shutter import Shutter
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Identifier, PointsFrame
from sceneloom.scene.warnings import DataWarning, WarningKind

CAMERA_AXES, LIDAR_AXES = "+z,+x,-y", "+x,-y,+z"
"""Where forward, right and up point in the frames of a scene: what a session has to be reported."""

MOST_SENSORS = 256

_HELD_BY_TABLE_3 = ("k1", "k2", "p1", "p2", "k3")
_LOOKED_AT = 9
_LOOSE_M, _LOOSE_RAD = 0.02, 0.005
"""How much a mounting may move before it is stated that it does: more than poses of a rigid one are off."""


@dataclass(frozen=True, slots=True, eq=False)
class SentRig:
    """What a session has to know before the first record.

    Attributes:
        scene: the scene, its points in the frames of their sensors or of the ego.
        numbers: sensor_id of each lidar and camera that is sent, lidars first.
        calibrations: of each camera with each lidar.
        camera_models: those that table 3 cannot state, by camera number.
        sources: takes the points of a lidar into the world; None where that is not known.
        at_once: lidars whose points hold for one time: those that came in the world, where each stands already.
        path: the trajectory of the first lidar; None where it is not known, or it was stationary.
        warnings: what was assumed or does not fit.
    """

    scene: Scene
    numbers: Mapping[Identifier, int]
    calibrations: tuple[CalibrationEntry, ...]
    camera_models: Mapping[int, Camera]
    sources: Mapping[Identifier, PoseSource | None]
    at_once: frozenset[Identifier]
    path: Poses | None
    warnings: tuple[DataWarning, ...]


def sent_rig(scene: Scene, *, trajectory: str | None = None, heading: str | None = None) -> SentRig:
    """Number the sensors of a scene and calibrate each camera with each lidar.

    Args:
        trajectory: the ego trajectory by name, as `fuse` takes it; None for the one that the scene has, if any.
        heading: "motion" to derive orientations where it has positions only.

    Raises:
        DataError: there are no lidars or no cameras, or too many sensors.
        PoseError: it is not known where a sensor is.
    """
    scene = scene.corrected()
    at_once = frozenset(lidar.id for lidar in scene.lidars if lidar.points_frame is PointsFrame.WORLD)
    if at_once:
        scene = to_sensor(scene, trajectory=trajectory, heading=heading)
    lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
    cameras = [camera for camera in scene.cameras if len(camera.images)]
    if not lidars or not cameras:
        problem = (
            f"{len(lidars)} lidars with sweeps, {len(cameras)} cameras with images; expected one of each"
        )
        raise DataError(scene.source, "", problem)
    if len(lidars) + len(cameras) > MOST_SENSORS:
        raise DataError(
            scene.source, "", f"more than {MOST_SENSORS} sensors, as many as a session can number"
        )
    ids = (*(lidar.id for lidar in lidars), *(camera.id for camera in cameras))
    numbers = {sensor_id: number for number, sensor_id in enumerate(ids)}
    ego, warnings = _ego(scene, trajectory, heading)
    reach_ns = scene_period_ns(scene)
    locations = _Locations(scene, ego, reach_ns)
    calibrations: list[CalibrationEntry] = []
    camera_models: dict[int, Camera] = {}
    for camera, lidar in product(cameras, lidars):
        camera_from_points, loose = locations.between(camera, lidar)
        data, camera_model, reported = table_3(camera, camera_from_points)
        calibrations.append(CalibrationEntry(numbers[camera.id], numbers[lidar.id], data))
        if camera_model is not None:
            camera_models[numbers[camera.id]] = camera_model
        warnings += [*loose, *(reported if lidar is lidars[0] else ())]
    sources = {lidar.id: locations.of_points(lidar) for lidar in lidars}
    path = _path(sources[lidars[0].id])
    return SentRig(
        scene, numbers, tuple(calibrations), camera_models, sources, at_once, path, tuple(warnings)
    )


def table_3(
    camera: CameraSensor, camera_from_points: RigidTransform
) -> tuple[CalibrationData, Camera | None, list[DataWarning]]:
    """Give the record of a camera; of a camera model that it cannot hold the one that comes nearest.

    And the camera model itself.
    """
    axes = DeclaredAxes.of_words(CAMERA_AXES), DeclaredAxes.of_words(LIDAR_AXES)
    try:
        return calibration_data(camera.camera, camera_from_points, *axes), None, []
    except CalibrationError:
        pass
    camera_model, message = _nearest(camera.camera)
    location = f"sensors[{camera.id}]"
    warning = DataWarning(
        kind=WarningKind.ASSUMED, code="camera-model-beyond-table-3", location=location, message=message
    )
    return calibration_data(camera_model, camera_from_points, *axes), camera.camera, [warning]


def _nearest(camera_model: Camera) -> tuple[Camera, str]:
    fixed = [name for name in MODELS["brown_conrady"].coefficient_names if name not in _HELD_BY_TABLE_3]
    exactly = "the property `camera_models` says it exactly"
    try:
        found = fit(camera_model, "brown_conrady", fixed=fixed)
    except CalibrationError as error:
        plain = Camera(
            "pinhole",
            camera_model.width,
            camera_model.height,
            camera_model.fx,
            camera_model.fy,
            camera_model.cx,
            camera_model.cy,
        )
        return (
            plain,
            f"a {camera_model.model} camera model, which table 3 cannot hold nearly ({error}); {exactly}",
        )
    held = (*found.camera.coefficients[:5], *[0.0] * (len(found.camera.coefficients) - 5))
    kept = Camera(
        "brown_conrady",
        camera_model.width,
        camera_model.height,
        found.camera.fx,
        found.camera.fy,
        found.camera.cx,
        found.camera.cy,
        held,
    )
    return kept, f"{found.message(camera_model)}, for table 3; {exactly}"


def format_camera_models(camera_models: Mapping[int, Camera]) -> str:
    """Write the value of the property `camera_models`."""
    entries = {
        str(number): {
            "model": camera_model.model,
            "image_size": [camera_model.width, camera_model.height],
            **{name: getattr(camera_model, name) for name in ("fx", "fy", "cx", "cy")},
            "coefficients": list(camera_model.coefficients),
        }
        for number, camera_model in camera_models.items()
    }
    return msgspec.json.encode(entries).decode()


def format_sensors(rig: SentRig) -> str:
    """Write the value of the property `sensors`: what shutters roll; empty where none does, as kinds need no saying."""
    shutters = {
        rig.numbers[camera.id]: Shutter.of(camera) for camera in rig.scene.cameras if camera.id in rig.numbers
    }
    if not any(shutter.seconds for shutter in shutters.values()):
        return ""
    entries: dict[str, dict[str, Any]] = {str(number): {"kind": "lidar"} for number in rig.numbers.values()}
    for number, shutter in shutters.items():
        entries[str(number)] = {
            "kind": "camera",
            "shutter_roll_s": shutter.seconds,
            "shutter_left_to_right": shutter.over_columns,
        }
    return msgspec.json.encode(entries).decode()


def _ego(
    scene: Scene, trajectory: str | None, heading: str | None
) -> tuple[EgoMotion | None, list[DataWarning]]:
    """The ego trajectory as far as it is known without looking for it."""
    if trajectory is not None:
        return find_ego_motion(scene, name=trajectory, heading=heading), []
    if not scene.trajectories:
        return None, []
    try:
        return find_ego_motion(scene, heading=heading), []
    except PoseError as error:
        message = f"sent without motion: {error}"
        return None, [
            DataWarning(
                kind=WarningKind.SKIPPED, code="motion-unknown", location=scene.source, message=message
            )
        ]


def _path(source: PoseSource | None) -> Poses | None:
    if source is None or source.path.static:
        return None
    times = source.path.timestamps_ns
    poses = source.at(times)
    return Poses(times, poses.positions, poses.quaternions_xyzw)


@dataclass(frozen=True, slots=True)
class _Locations:
    """Where cameras and points of lidars are, one from another."""

    scene: Scene
    ego: EgoMotion | None
    reach_ns: int

    def of_points(self, lidar: LidarSensor) -> PoseSource | None:
        """Takes the points of a lidar into the world; None where that is not known."""
        try:
            return points_source(self.scene, lidar, self.ego, reach_ns=self.reach_ns)
        except PoseError:
            return None

    def between(self, camera: CameraSensor, lidar: LidarSensor) -> tuple[RigidTransform, list[DataWarning]]:
        """Give `camera_from_points`, by their mountings, else by where both were at the same times.

        Raises:
            PoseError: neither is known.
        """
        rider_association = lidar.points_frame is PointsFrame.EGO
        ego_from_points = RigidTransform.identity() if rider_association else lidar.mount
        if camera.mount is not None and ego_from_points is not None:
            return camera.mount.inverse() @ ego_from_points, []
        found = list(self._seen(camera, lidar))
        if not found:
            raise PoseError(
                f"{self.scene.source}: camera {camera.id!r} and lidar {lidar.id!r} are at no time where both are known"
            )
        middle = found[len(found) // 2]
        return middle, _loose(camera, lidar, middle, found)

    def _seen(self, camera: CameraSensor, lidar: LidarSensor) -> Iterator[RigidTransform]:
        of_camera = sensor_source(self.scene, camera, self.ego, reach_ns=self.reach_ns)
        of_points = points_source(self.scene, lidar, self.ego, reach_ns=self.reach_ns)
        if of_points is None:
            return
        times = camera.images.timestamps_ns
        times = times[np.unique(np.linspace(0, len(times) - 1, _LOOKED_AT).astype(np.int64))]
        cameras, points = of_camera.at(times), of_points.at(times)
        for k in np.flatnonzero((cameras.coverage < 2) & (points.coverage < 2)):
            world_from_camera = RigidTransform.from_quaternion(
                cameras.positions[k], cameras.quaternions_xyzw[k]
            )
            world_from_points = RigidTransform.from_quaternion(
                points.positions[k], points.quaternions_xyzw[k]
            )
            yield world_from_camera.inverse() @ world_from_points


def _loose(
    camera: CameraSensor, lidar: LidarSensor, middle: RigidTransform, found: list[RigidTransform]
) -> list[DataWarning]:
    """Report where a camera moves against a lidar: a record of table 3 holds one location."""
    shift = max(float(np.linalg.norm(one.translation - middle.translation)) for one in found)
    rotation = max(
        float(np.linalg.norm(one.rotation @ middle.rotation.T - np.eye(3))) / np.sqrt(2) for one in found
    )
    if shift <= _LOOSE_M and rotation <= _LOOSE_RAD:
        return []
    message = (
        f"it moves against lidar {lidar.id!r} by up to {shift:.3f} m and {np.degrees(rotation):.2f}°; the location in "
        f"the "
        "middle of the drive was taken"
    )
    return [
        DataWarning(
            kind=WarningKind.ASSUMED, code="mounting-moves", location=f"sensors[{camera.id}]", message=message
        )
    ]
