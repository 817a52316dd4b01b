"""A scene and lists of boxes as a drive that detectors looked at."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_motion import find_ego_motion
from sceneloom.pipeline.detections.detected import DetectedCamera, DetectedDrive, poses_at
from sceneloom.pipeline.detections.lists.context import ListContext
from sceneloom.pipeline.detections.lists.table import read_boxes_2d, read_boxes_3d
from sceneloom.pipeline.detections.sweep_points import SweepPoints
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import needs_ego, sensor_source
from sceneloom.scene.span import scene_period_ns, sweep_period_ns
from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionFiles:
    """Which files of boxes belong to which sensors of a scene.

    Attributes:
        boxes_3d: of the detector of sweeps; several are put together.
        boxes_2d: of detectors of images.
        lidar: whose boxes they are; None for the only one.
        cameras: whose boxes each file of `boxes_2d` has, in the same order; one for all; empty for the only camera, or
            for those that the records of the files name.
        trajectory, heading: the ego trajectory, as for `fuse`.
        whole: the drive that the scene is a part of, where it is one: lists number its frames.
    """

    boxes_3d: Sequence[Path] = ()
    boxes_2d: Sequence[Path] = ()
    lidar: Identifier | None = None
    cameras: Sequence[Identifier] = ()
    trajectory: str | None = None
    heading: str | None = None
    whole: Scene | None = None


def scene_drive(scene: Scene, files: DetectionFiles, *, lenient: bool = False) -> DetectedDrive:
    """Read the boxes of a scene's detectors; of a part of a drive those of its time.

    Without boxes of sweeps, the sweeps of the lidar are those in which nothing was looked for; without a lidar, the
    images of the first camera take their location.

    Args:
        scene: the drive.
        files: which boxes.
        lenient: leave out what is faulty, and count it.

    Raises:
        OptionError: there are no files, or several sensors and none was chosen, or a chosen one is not there.
        DataError: a file is faulty.
        PoseError: it is not known where a sensor was.
    """
    if not files.boxes_3d and not files.boxes_2d:
        raise OptionError(f"{scene.source}: no boxes; name files of them with --boxes3d, --boxes2d or both")
    scene = scene.corrected()
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        lidar = _chosen(scene, files.lidar)
        ego = None
        if needs_ego(scene):
            ego = find_ego_motion(scene, name=files.trajectory, heading=files.heading, lenient=lenient)
        cameras = _cameras(scene, files, ego, ledger)
        source = sensor_source(scene, lidar, ego, reach_ns=scene_period_ns(scene))
        sweeps = _reference_times(lidar)
        context = ListContext(
            lidar.id,
            sweeps if files.whole is None else _reference_times(_chosen(files.whole, lidar.id)),
            source=source,
            sensor_from_camera=_sensor_from_camera(scene, lidar, ego, files),
        )
        lists = [read_boxes_3d(path, context, ledger) for path in files.boxes_3d]
        boxes = (
            _together_3d(lists) if lists else [Boxes3D.empty(t, sensor_id=lidar.id) for t in sweeps.tolist()]
        )
        drive = DetectedDrive(
            name=Path(scene.source).stem or "drive",
            lidar_id=lidar.id,
            source=source,
            boxes=tuple(boxes),
            cameras=cameras,
            classes=None if files.boxes_3d else frozenset(),
            period_ns=sweep_period_ns(lidar),
            points=SweepPoints.of(scene, lidar.id, source),
            warnings=(*scene.warnings, *ledger.warnings),
        )
    if files.whole is None or not len(sweeps):
        return drive
    margin_ns = drive.period_ns // 2  # detectors timestamp what they find at any time of a sweep
    return drive.between((int(sweeps[0]) - margin_ns, int(sweeps[-1]) + margin_ns))


def _chosen(scene: Scene, chosen: Identifier | None) -> LidarSensor:
    listed = ", ".join(repr(lidar.id) for lidar in scene.lidars)
    if not listed:
        raise OptionError(f"{scene.source}: it has no lidar, by whose sweeps objects are found")
    if chosen is None and len(scene.lidars) == 1:
        return scene.lidars[0]
    for lidar in scene.lidars:
        if lidar.id == chosen:
            return lidar
    if chosen is not None:
        raise OptionError(f"{scene.source}: lidar {chosen!r}; it has {listed}")
    raise OptionError(f"{scene.source}: it has {listed} as lidars; choose one with `--lidar ID`")


def _reference_times(lidar: LidarSensor) -> Int64Array:
    """When the boxes of each sweep hold: at the middle of its points.

    As far after its timestamp as in the first sweep.
    """
    times = lidar.frames.timestamps_ns
    if not len(times):
        return times
    first = lidar.frames[0]
    return times + (first.reference_ns - first.timestamp_ns)


def _camera(scene: Scene, camera_id: Identifier) -> CameraSensor:
    for camera in scene.cameras:
        if camera.id == camera_id:
            return camera
    listed = ", ".join(repr(camera.id) for camera in scene.cameras) or "none"
    raise OptionError(f"{scene.source}: camera {camera_id!r}; it has {listed}")


def _cameras(
    scene: Scene, files: DetectionFiles, ego: EgoMotion | None, ledger: Ledger
) -> Mapping[Identifier, DetectedCamera]:
    """The cameras that are looked at, with their boxes."""
    if not files.boxes_2d:
        chosen = [_camera(scene, camera_id) for camera_id in files.cameras] or [*scene.cameras]
        return {camera.id: _detected(scene, camera, None, ego) for camera in chosen}
    lists: dict[Identifier, list[Sequence[Boxes2D]]] = {}
    for path, camera, number in _assigned(scene, files):
        whole = camera if files.whole is None else _camera(files.whole, camera.id)
        context = ListContext(camera.id, whole.images.timestamps_ns, number=number, others=_numbers(scene))
        lists.setdefault(camera.id, []).append(read_boxes_2d(path, context, ledger))
    return {
        camera_id: _detected(scene, _camera(scene, camera_id), _together_2d(found), ego)
        for camera_id, found in lists.items()
    }


def _assigned(scene: Scene, files: DetectionFiles) -> list[tuple[Path, CameraSensor, int | None]]:
    """Each file with the camera whose boxes it has, and the number by which its records name that camera.

    Records number the sensors of a scene as `send` does: lidars first, then cameras, from 0.
    """
    named = [_camera(scene, camera_id) for camera_id in files.cameras]
    if len(named) == len(files.boxes_2d):
        return [(path, camera, None) for path, camera in zip(files.boxes_2d, named, strict=True)]
    if len(named) == 1 or (not named and len(scene.cameras) == 1):
        only = named[0] if named else scene.cameras[0]
        return [(path, only, None) for path in files.boxes_2d]
    if named:
        raise OptionError(
            f"{len(files.boxes_2d)} files of boxes in images and {len(named)} cameras; expected one for each file"
        )
    if not scene.cameras:
        raise OptionError(f"{scene.source}: boxes in images, and no camera in it")
    first = len(scene.lidars)
    return [(path, camera, first + k) for path in files.boxes_2d for k, camera in enumerate(scene.cameras)]


def _numbers(scene: Scene) -> frozenset[int]:
    """How records name the cameras of a scene."""
    first = len(scene.lidars)
    return frozenset(range(first, first + len(scene.cameras)))


def _detected(
    scene: Scene, camera: CameraSensor, boxes: Sequence[Boxes2D] | None, ego: EgoMotion | None
) -> DetectedCamera:
    source = sensor_source(scene, camera, ego, reach_ns=scene_period_ns(scene))
    if boxes is None:
        none = tuple(Boxes2D.empty(t, sensor_id=camera.id) for t in camera.images.timestamps_ns.tolist())
        return DetectedCamera(camera.camera, source, none, frozenset())
    return DetectedCamera(camera.camera, source, tuple(boxes))


def _sensor_from_camera(
    scene: Scene, lidar: LidarSensor, ego: EgoMotion | None, files: DetectionFiles
) -> RigidTransform | None:
    """Takes the frame of the first chosen camera, else of the only one, into the lidar's, at the first sweep."""
    cameras = [_camera(scene, camera_id) for camera_id in files.cameras[:1]] or list(scene.cameras)
    if len(cameras) != 1 or not len(lidar.frames):
        return None
    reach_ns = scene_period_ns(scene)
    time_ns = lidar.frames.timestamps_ns[:1]
    (world_from_camera,) = poses_at(sensor_source(scene, cameras[0], ego, reach_ns=reach_ns), time_ns)
    (world_from_lidar,) = poses_at(sensor_source(scene, lidar, ego, reach_ns=reach_ns), time_ns)
    return world_from_lidar.inverse() @ world_from_camera


def _together_3d(lists: Sequence[Sequence[Boxes3D]]) -> list[Boxes3D]:
    """The boxes of several files by time."""
    by_time: dict[int, list[Boxes3D]] = {}
    for found in lists:
        for boxes in found:
            by_time.setdefault(boxes.timestamp_ns, []).append(boxes)
    return [joined_3d(by_time[t]) for t in sorted(by_time)]


def joined_3d(parts: Sequence[Boxes3D]) -> Boxes3D:
    """Boxes of one time put together; what only some of them have is left out."""
    if len(parts) == 1:
        return parts[0]
    parts = [boxes for boxes in parts if len(boxes)] or parts[:1]
    if len({boxes.score_form for boxes in parts}) > 1:
        raise DataError(
            "boxes",
            "",
            f"scores of several forms at {parts[0].timestamp_ns} ns; expected logits or probabilities",
        )
    velocities = [boxes.velocities for boxes in parts if boxes.velocities is not None]
    first = parts[0]
    return Boxes3D(
        first.timestamp_ns,
        np.concatenate([boxes.centers for boxes in parts]),
        np.concatenate([boxes.sizes_lwh for boxes in parts]),
        np.concatenate([boxes.yaws for boxes in parts]),
        np.concatenate([boxes.scores for boxes in parts]),
        tuple(label for boxes in parts for label in boxes.labels),
        velocities=np.concatenate(velocities) if len(velocities) == len(parts) else None,
        frame=first.frame,
        score_form=first.score_form,
        sensor_id=first.sensor_id,
    )


def _together_2d(lists: Sequence[Sequence[Boxes2D]]) -> list[Boxes2D]:
    by_time: dict[int, list[Boxes2D]] = {}
    for found in lists:
        for boxes in found:
            by_time.setdefault(boxes.timestamp_ns, []).append(boxes)
    return [joined_2d(by_time[t]) for t in sorted(by_time)]


def joined_2d(parts: Sequence[Boxes2D]) -> Boxes2D:
    """Boxes of one image put together."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    return Boxes2D(
        first.timestamp_ns,
        np.concatenate([boxes.corners_xyxy for boxes in parts]),
        np.concatenate([boxes.scores for boxes in parts]),
        tuple(label for boxes in parts for label in boxes.labels),
        score_form=first.score_form,
        sensor_id=first.sensor_id,
    )
