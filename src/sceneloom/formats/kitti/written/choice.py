"""Which sensors of a scene go into a folder of KITTI's, under which numbers, and where they sit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import degrees

import numpy as np

from sceneloom.editing.undistortion import undistort_scene
from sceneloom.formats.default_poses import stationary_ego
from sceneloom.formats.kitti.scenes.sensors import LIDAR_ID, camera_id
from sceneloom.formats.kitti.written.target import kept_of
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.written_mounts import each_mounted, mounting
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations_frame import annotations_frame
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.contents import KINDS
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import check_one_ego
from sceneloom.scene.types import Coordinates

PARALLEL_WITHIN = 1e-6
"""How far a camera may be rotated against the first one and be of the same rectified frame [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What is written.

    Attributes:
        scene: all of it; camera models that the target cannot hold are pinholes already.
        lidar: the one that is written, or None.
        cameras: by KITTI's number.
        ego_path: `world_from_ego`, or None where it is not known.
        ego_from_lidar: identity where there is no lidar.
        ego_from_camera: by number.
        reference: number of the camera in whose frame labels are; None without cameras.
        losses: what is known to be lost before anything is written.
    """

    scene: Scene
    lidar: LidarSensor | None
    cameras: Mapping[int, CameraSensor]
    ego_path: Poses | None
    ego_from_lidar: RigidTransform
    ego_from_camera: Mapping[int, RigidTransform]
    reference: int | None
    losses: list[Loss] = field(default_factory=list)


def choose(
    scene: Scene, slots: Sequence[int], *, rectified: bool, models: frozenset[str], rigid: bool = True
) -> Choice:
    """Choose the first lidar, and cameras for the numbers that the target has.

    Args:
        scene: to be written.
        slots: the numbers of cameras, the preferred one first.
        rectified: whether all cameras must look the same way.
        rigid: whether one mounting of each sensor holds for all frames; what it does not state is then a loss.
        models: camera models that the target holds; images of others are resampled to a pinhole's.

    Raises:
        CalibrationError: a camera model cannot be computed with.
    """
    losses: list[Loss] = []
    path = ego_trajectory(scene)
    check_one_ego(scene, path)
    scene = scene if rigid else each_mounted(scene, path)
    lidar, ego_from_lidar = _lidar(scene, path, losses)
    named = _numbered(scene, slots, losses)
    mounts: dict[int, RigidTransform] = {}
    for number, camera in list(named.items()):
        mount, lost = mounting(camera, path, each=not rigid)
        losses += lost if rigid else []
        if mount is None:
            _drop(camera, "left out: neither its mounting nor its poses against the ego are known", losses)
            del named[number]
        else:
            mounts[number] = mount
    reference = next((number for number in slots if number in named), None)
    if rectified and reference is not None:
        _keep_parallel(named, mounts, reference, losses)
    scene, named = _with_pinholes(scene, named, models, losses)
    return Choice(scene, lidar, named, path, ego_from_lidar, mounts, reference, losses)


def ego_trajectory(scene: Scene) -> Poses | None:
    """The ego trajectory: the first trajectory with orientations, else by odometry, else by a sensor's own poses."""
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None:
            return trajectory.poses
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor):
            return sensor.poses
    posed_sensors: list[LidarSensor | CameraSensor] = [*scene.lidars, *scene.cameras]
    for posed in posed_sensors:
        if posed.poses is None or posed.coordinates is not Coordinates.WORLD:
            continue
        if posed.mount is None:
            return posed.poses
        egos = PoseSource(posed.poses, posed.mount.inverse()).at(posed.poses.timestamps_ns)
        return replace(posed.poses, positions=egos.positions, quaternions_xyzw=egos.quaternions_xyzw)
    return None


def _lidar(scene: Scene, path: Poses | None, losses: list[Loss]) -> tuple[LidarSensor | None, RigidTransform]:
    if not scene.lidars:
        return None, RigidTransform.identity()
    first, *others = scene.lidars
    for other in others:
        _drop(other, "left out: the folder has one lidar", losses)
    if first.id != LIDAR_ID:
        losses.append(_renamed("sensors.lidar.id", first.id, LIDAR_ID))
    mount, lost = mounting(first, path)
    losses += lost
    return first, RigidTransform.identity() if mount is None else mount


def _numbered(scene: Scene, slots: Sequence[int], losses: list[Loss]) -> dict[int, CameraSensor]:
    """Give cameras their numbers: of a scene that was read from KITTI's those of their ids, then the free ones."""
    named = {
        number: camera
        for camera in scene.cameras
        for number in slots
        if camera.id == camera_id(number) and kept_of(scene)
    }
    free = [number for number in slots if number not in named]
    for camera in scene.cameras:
        if camera in named.values():
            continue
        if not free:
            _drop(camera, f"left out: the folder has {len(slots)} cameras", losses)
            continue
        number = free.pop(0)
        named[number] = camera
        if camera.id != camera_id(number):
            losses.append(_renamed("sensors.camera.id", camera.id, camera_id(number)))
    return named


def _keep_parallel(
    cameras: dict[int, CameraSensor], mounts: dict[int, RigidTransform], reference: int, losses: list[Loss]
) -> None:
    """Leave out cameras that are rotated against the reference: rectified ones look the same way."""
    for number, camera in list(cameras.items()):
        rotation = float(angle_between(mounts[number].quaternion_xyzw, mounts[reference].quaternion_xyzw))
        if rotation > PARALLEL_WITHIN:
            what = (
                f"left out: rotated by {degrees(rotation):.3g}° against camera {cameras[reference].id!r}, and the "
                "cameras of rectified folders look the same way"
            )
            _drop(camera, what, losses)
            del cameras[number], mounts[number]


def _with_pinholes(
    scene: Scene, cameras: dict[int, CameraSensor], models: frozenset[str], losses: list[Loss]
) -> tuple[Scene, dict[int, CameraSensor]]:
    """Resample the images of camera models that the target does not hold."""
    bent = {number: camera for number, camera in cameras.items() if not holds_camera_model(camera, models)}
    if not bent:
        return scene, cameras
    changed = undistort_scene(scene, cameras=[camera.id for camera in bent.values()])
    new = {type_and_id(sensor.id): sensor for sensor in changed.cameras}
    for camera in bent.values():
        what = f"a {camera.camera.model} camera model replaced by a pinhole, and its images resampled for it"
        losses += [
            Loss(field=name, what=f"{camera.id!r}: {what}", support=Support.APPROXIMATED)
            for name in ("sensors.camera.camera", "sensors.camera.images.rgb")
        ]
    return changed, {number: new[type_and_id(camera.id)] for number, camera in cameras.items()}


def holds_camera_model(camera: CameraSensor, models: frozenset[str]) -> bool:
    """Whether a target that holds these models holds a camera model: OpenCV's five coefficients are all it has."""
    camera_model = camera.camera
    if camera_model.model not in models:
        return False
    further = np.array(camera_model.coefficients[5:])
    return camera_model.model == "pinhole" or not further.any()


def type_and_id(identifier: object) -> tuple[type, object]:
    """An id with its type, to be looked up."""
    return type(identifier), identifier


def dropped_parts(scene: Scene, kept: frozenset[type]) -> list[Loss]:
    """Losses of sensors and annotations of the kinds that the target has no field for.

    Args:
        kept: the classes that have one.
    """
    losses = [
        Loss(field=KINDS[type(part)], what="left out: the folder has no field for it")
        for part in (*scene.sensors, *scene.annotations)
        if type(part) not in kept
    ]
    boxes = CuboidAnnotation in kept and any(isinstance(one, CuboidAnnotation) for one in scene.annotations)
    if boxes and annotations_frame(scene) is Coordinates.WORLD and ego_trajectory(scene) is None:
        losses.append(stationary_ego())
    if len(scene.trajectories) > 1:
        count = len(scene.trajectories) - 1
        what = "left out: the folder holds the trajectory that is the default one"
        losses.append(Loss(field="trajectories", what=what, count=count))
    if scene.attributes:
        losses.append(
            Loss(
                field="attributes",
                what="left out: the folder has no field for it",
                count=len(scene.attributes),
            )
        )
    return losses


def _renamed(name: str, identifier: object, new: str) -> Loss:
    return Loss(field=name, what=f"{identifier!r} is called {new!r} there", support=Support.CONVERTED)


def _drop(sensor: CameraSensor | LidarSensor, what: str, losses: list[Loss]) -> None:
    losses.append(Loss(field=KINDS[type(sensor)], what=f"{sensor.id!r} {what}"))
