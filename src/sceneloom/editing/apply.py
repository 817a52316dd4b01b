"""Scenes with their corrections applied: localization adjustments and camera calibrations."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.move_points import FrameChange
from sceneloom.editing.move_world import EGO_ID, free_id, moved_trajectory, moved_world, to_world
from sceneloom.editing.references import assumed, ours_of, skipped, with_ours, with_warnings
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    LocalizationAdjustment,
    PointsAnnotation,
    ShapeAnnotation,
    effect_of,
)
from sceneloom.scene.annotations_at import ANNOTATIONS_FRAME
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import Posed
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Coordinates, Identifier, Key, PointsFrame, key_of
from sceneloom.warnings import DataWarning, WarningKind


def _calibrated_camera(sensor: CameraSensor, calibration: CameraCalibration) -> CameraSensor:
    """Give a camera with its calibration applied.

    world_from_camera' = world_from_camera D(t); the camera model is replaced; images were taken `time_offset` later
    than their timestamps state. Poses report where the camera was at a time, so they keep theirs; where the corrected
    images go beyond them by no more than the offset, the last movement goes on.

    Source: "Camera Calibration Annotation" of the SFS description; READING of "camera_calibration" in
    docs/CONVENTIONS.md.
    """
    shift_ns = round(calibration.time_offset_ns or 0)
    rotated = sensor if calibration.poses is None else _rotated(sensor, calibration.poses, shift_ns)
    timestamps_ns = sensor.images.timestamps_ns + shift_ns
    images = LazyFrames(timestamps_ns, partial(_calibrated_image, sensor, calibration, shift_ns))
    poses = None if rotated.poses is None else _reaching(rotated.poses, timestamps_ns, abs(shift_ns))
    return replace(rotated, camera=calibration.intrinsics or sensor.camera, images=images, poses=poses)


def _calibrated_image(sensor: CameraSensor, calibration: CameraCalibration, shift_ns: int, k: int) -> CameraImage:
    """Image `k`, not decoded, with its own mounting and camera model corrected."""
    image = sensor.images[k]
    timestamp_ns, mount, camera = (
        image.timestamp_ns + shift_ns,
        image.mount,
        calibration.intrinsics or image.camera,
    )
    if mount is not None and calibration.poses is not None:
        at = calibration.poses.held(np.array([timestamp_ns], np.int64))
        mount = mount @ RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])
    size = image.camera.width, image.camera.height
    if calibration.intrinsics is not None and size != (sensor.camera.width, sensor.camera.height):
        camera = camera.resized(*size)
    return replace(image, timestamp_ns=timestamp_ns, camera=camera, mount=mount)


def _only_pose(path: Poses) -> RigidTransform | None:
    """The pose that holds at all times; None where there are several."""
    if len(path.timestamps_ns) > 1:
        return None
    return RigidTransform.from_quaternion(path.positions[0], path.quaternions_xyzw[0])


def _rotated(sensor: CameraSensor, correction: Poses, shift_ns: int) -> CameraSensor:
    """Put the correction behind the camera's poses and its mounting."""
    constant = _only_pose(correction)
    timestamps_ns = sensor.images.timestamps_ns + shift_ns
    poses = None if sensor.poses is None else _behind(sensor.poses, correction, timestamps_ns)
    if constant is not None:
        mount = None if sensor.mount is None else sensor.mount @ constant
        return replace(sensor, poses=poses, mount=mount)
    if sensor.mount is None or poses is not None:
        return replace(sensor, poses=poses, mount=None)
    # a mounting that changes with time is stated by poses on the ego
    mounted = Poses(
        np.zeros(1, np.int64),
        sensor.mount.translation[None],
        sensor.mount.quaternion_xyzw[None],
        static=True,
    )
    return replace(sensor, poses=_behind(mounted, correction, timestamps_ns), mount=None, coordinates=Coordinates.EGO)


def _behind(path: Poses, correction: Poses, timestamps_ns: Int64Array) -> Poses:
    """`path ∘ correction` at the times of both and of the images; beyond the correction its end poses hold."""
    constant = len(correction.timestamps_ns) == 1
    times_ns = path.timestamps_ns
    if not constant:
        times_ns = np.concatenate([correction.timestamps_ns, timestamps_ns])
        if not path.static:
            inside = (times_ns >= path.start_ns) & (times_ns <= path.stop_ns)
            times_ns = np.concatenate([path.timestamps_ns, times_ns[inside]])
        times_ns = np.unique(times_ns)
    body = path.interpolate(times_ns)
    diff = correction.held(times_ns)
    return Poses(
        times_ns,
        rotate_vectors(body.quaternions_xyzw, diff.positions) + body.positions,
        multiply_quaternions(body.quaternions_xyzw, diff.quaternions_xyzw),
        static=path.static and constant,
    )


def _reaching(path: Poses, timestamps_ns: Int64Array, reach_ns: int) -> Poses:
    """The path with poses at those timestamps that lie beyond its ends by no more than `reach_ns`."""
    if path.static or len(path.timestamps_ns) < 2:
        return path
    beyond = np.unique(timestamps_ns[(timestamps_ns < path.start_ns) | (timestamps_ns > path.stop_ns)])
    further = path.interpolate(beyond, reach_ns=reach_ns)
    known = further.coverage <= 1
    times = np.concatenate([path.timestamps_ns, beyond[known]])
    order = np.argsort(times)
    return Poses(
        times[order],
        np.concatenate([path.positions, further.positions[known]])[order],
        np.concatenate([path.quaternions_xyzw, further.quaternions_xyzw[known]])[order],
    )


def _shifted_annotation(annotation: Annotation, sensor_id: Identifier, shift_ns: int) -> Annotation:
    """Give an annotation whose times in the images of a camera follow these."""
    key = key_of(sensor_id)
    if isinstance(annotation, Box2DAnnotation | ShapeAnnotation):
        if annotation.sensor_id is None or key_of(annotation.sensor_id) != key:
            return annotation
        if isinstance(annotation, ShapeAnnotation) and annotation.dimensions != 2:
            return annotation
        path: Any = replace(annotation.path, timestamps_ns=annotation.path.timestamps_ns + shift_ns)
        return replace(annotation, path=path)
    if isinstance(annotation, CuboidAnnotation):
        return replace(
            annotation,
            activations=tuple(_shifted(entry, key, shift_ns) for entry in annotation.activations),
            projections=tuple(_shifted(entry, key, shift_ns) for entry in annotation.projections),
        )
    if isinstance(annotation, PointsAnnotation):
        projections = (tuple(_shifted(e, key, shift_ns) for e in entries) for entries in annotation.projections)
        return replace(annotation, projections=tuple(projections))
    return annotation


def _shifted(entry: Any, key: Key, shift_ns: int) -> Any:
    if key_of(entry.sensor_id) != key:
        return entry
    return replace(entry, timestamps_ns=entry.timestamps_ns + shift_ns)


Correction = LocalizationAdjustment | CameraCalibration

APPLIED = "applied"
"""Our entry of the metadata that says which corrections were applied."""


def apply_corrections(
    scene: Scene,
    *,
    corrections: Iterable[Identifier] | None = None,
    annotations_in: Coordinates | str | None = None,
) -> Scene:
    """Apply localization adjustments and camera calibrations, and take them away.

    An adjustment takes locations in the world to where they belong, p' = A(t) p: points and poses at the time of their
    frame, annotations at that of their keyframe; beyond its ends its end poses hold. In a scene in ego coordinates it
    leads from the ego to the world, and reports the ego trajectory from then on. A calibration rotates a camera behind
    its poses, replaces its camera model and moves the times of its images and of what is drawn in them.

    Args:
        scene: as it is.
        corrections: ids of the only annotations to apply; None for all adjustments and calibrations.
        annotations_in: "world" or "ego", where a scene in ego coordinates does not state in which frame its annotations
            are. None: "ego", with a warning.

    Raises:
        OptionError: there is nothing to apply, an id is none of a correction, or sensors are in both frames.
        DataError: a frame that this needs cannot be read.

    Source: "Localization Adjustment Annotation" and "Camera Calibration Annotation" of the SFS description;
        READINGS in docs/CONVENTIONS.md.
    """
    chosen = _chosen(scene, corrections)
    changed = scene
    for correction in chosen:
        if isinstance(correction, CameraCalibration):
            changed = _calibrated(changed, correction)
    for correction in chosen:
        if isinstance(correction, LocalizationAdjustment):
            changed = _adjusted(changed, correction, annotations_in)
    return changed


def corrected_scene(scene: Scene) -> Scene:
    """Give the scene with all that is to be applied applied, and a warning for each; what `Scene.corrected` calls.

    Raises:
        OptionError, DataError: as of `apply_corrections`.
    """
    pending = scene.pending_corrections
    reported = [
        DataWarning(
            kind=WarningKind.REPAIRED,
            code="correction-applied",
            location=f"annotations[{correction.id}]",
            message=f"{correction.type} applied: {effect_of(correction)}",
        )
        for correction in pending
    ]
    return with_warnings(apply_corrections(scene, corrections=[c.id for c in pending]), reported)


def _chosen(scene: Scene, wanted: Iterable[Identifier] | None) -> list[Correction]:
    there = [a for a in scene.annotations if isinstance(a, LocalizationAdjustment | CameraCalibration)]
    if wanted is not None:
        known = {key_of(annotation.id): annotation for annotation in there}
        ids = tuple(wanted)
        unknown = [identifier for identifier in ids if key_of(identifier) not in known]
        if unknown:
            names = ", ".join(repr(annotation.id) for annotation in there)
            raise OptionError(f"{scene.source}: no correction {unknown[0]!r}; there are {names or 'none'}")
        there = [annotation for annotation in there if key_of(annotation.id) in set(map(key_of, ids))]
    if not there:
        raise OptionError(
            f"{scene.source}: nothing to apply; expected an annotation localization_adjustment or camera_calibration"
        )
    return there


def _without(scene: Scene, correction: Correction, **further: Any) -> Scene:
    """The scene without a correction that was applied, which the metadata report."""
    earlier = ours_of(scene).get(APPLIED)
    entry = {"id": correction.id, "type": correction.type, **further}
    left = tuple(a for a in scene.annotations if key_of(a.id) != key_of(correction.id))
    reported = [*(earlier if isinstance(earlier, list) else []), entry]
    return with_ours(replace(scene, annotations=left), **{APPLIED: reported})


def _calibrated(scene: Scene, calibration: CameraCalibration) -> Scene:
    key = key_of(calibration.sensor_id)
    camera = next((s for s in scene.sensors if key_of(s.id) == key), None)
    if not isinstance(camera, CameraSensor):
        what = f"no camera {calibration.sensor_id!r} in it; not applied"
        return with_warnings(scene, [skipped("calibration-without-camera", f"annotations[{calibration.id}]", what)])
    corrected = _calibrated_camera(camera, calibration)
    shift_ns = round(calibration.time_offset_ns or 0)
    changed = replace(
        scene,
        sensors=tuple(corrected if sensor is camera else sensor for sensor in scene.sensors),
        annotations=tuple(_shifted_annotation(a, camera.id, shift_ns) for a in scene.annotations),
    )
    what = "projections into a camera that was corrected stay as they were drawn"
    stale = assumed("projections-kept", f"sensors[{camera.id}]", what, count=_projections(scene, camera.id))
    moved = calibration.poses is not None or calibration.intrinsics is not None
    reported = with_warnings(changed, (stale,) if moved else ())
    return _without(reported, calibration, sensor_id=camera.id)


def _projections(scene: Scene, sensor_id: Identifier) -> int:
    """How many annotations have projections into a camera."""
    key, count = key_of(sensor_id), 0
    for annotation in scene.annotations:
        if isinstance(annotation, CuboidAnnotation):
            count += any(key_of(entry.sensor_id) == key for entry in annotation.projections)
        elif isinstance(annotation, PointsAnnotation):
            seen = (entry for entries in annotation.projections for entry in entries)
            count += any(key_of(entry.sensor_id) == key for entry in seen)
    return count


def _adjusted(scene: Scene, adjustment: LocalizationAdjustment, annotations_in: Coordinates | str | None) -> Scene:
    poses = adjustment.poses
    left = _without(scene, adjustment)
    if _frame(scene) is Coordinates.EGO:
        return _led_to_world(left, poses, annotations_in)
    moved = moved_world(left, FrameChange(PoseSource(poses, RigidTransform.identity()), held=True))
    if len(poses.timestamps_ns) == 1 or not _only_mounted(scene):
        return moved
    # all sensors are on the ego, from which it leads to the world
    trajectory = Trajectory(str(EGO_ID), poses.timestamps_ns, poses.positions, poses.quaternions_xyzw)
    return replace(moved, trajectories={trajectory.name: trajectory})


def _frame(scene: Scene) -> Coordinates:
    """The frame that the sensors of a scene are in.

    Raises:
        OptionError: some are in the world and some on the ego.
    """
    frames: dict[Coordinates, Identifier] = {}
    for sensor in scene.sensors:
        if isinstance(sensor, Posed) and sensor.poses is not None:
            frames[sensor.coordinates] = sensor.id
        if isinstance(sensor, LidarSensor | RadarSensor) and sensor.points_frame is not PointsFrame.SENSOR:
            frames[Coordinates(sensor.points_frame.value)] = sensor.id
    if len(frames) > 1:
        raise OptionError(
            f"{scene.source}: sensor {frames[Coordinates.WORLD]!r} is in the world and {frames[Coordinates.EGO]!r} on "
            "the ego, so it is not clear what an adjustment is of; bring all into the world first: "
            "`sceneloom edit to-world`"
        )
    return next(iter(frames), Coordinates.WORLD)


def _only_mounted(scene: Scene) -> bool:
    """Whether sensors are mounted on the ego, and nothing says where it or any of them was in the world."""
    placed = any(
        isinstance(sensor, OdometrySensor) or getattr(sensor, "poses", None) is not None for sensor in scene.sensors
    )
    clouds = [sensor for sensor in scene.sensors if isinstance(sensor, LidarSensor | RadarSensor)]
    in_world = any(sensor.points_frame is PointsFrame.WORLD for sensor in clouds)
    mounted = any(getattr(sensor, "mount", None) is not None for sensor in scene.sensors)
    return mounted and not (placed or in_world or scene.trajectories)


def _led_to_world(scene: Scene, world_from_ego: Poses, annotations_in: Coordinates | str | None) -> Scene:
    """Bring a scene in ego coordinates into the world that an adjustment leads to."""
    stated = annotations_in or ours_of(scene).get(ANNOTATIONS_FRAME)
    warnings = []
    if stated is None and scene.annotations:
        what = "the frame of the annotations is not stated; taken to be the ego frame, as that of the sensors"
        warnings.append(assumed("annotations-frame", "annotations", what))
    odometries = [sensor for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    identifier = odometries[0].id if odometries else free_id(scene, EGO_ID)
    ego = OdometrySensor(identifier, world_from_ego)
    kept = tuple(sensor for sensor in scene.sensors if not isinstance(sensor, OdometrySensor))
    name = str(identifier)
    times = world_from_ego
    trajectory = Trajectory(name, times.timestamps_ns, times.positions, times.quaternions_xyzw)
    others = _others_in_world(scene, odometries, world_from_ego, name)
    led = replace(scene, sensors=(*kept, ego), trajectories={name: trajectory, **others})
    return to_world(with_warnings(led, warnings), annotations_in=stated or Coordinates.EGO)


def _others_in_world(
    scene: Scene, odometries: list[OdometrySensor], world_from_ego: Poses, name: str
) -> dict[str, Trajectory]:
    """The other ways of the ego, in the world that the adjustment leads to: through the odometry that they join."""
    if not odometries:
        return {}
    reach_ns = scene_period_ns(scene)
    still = RigidTransform.identity()
    onto_ego = FrameChange(None, PoseSource(odometries[0].poses, still, reach_ns))
    into_world = FrameChange(PoseSource(world_from_ego, still, reach_ns))
    moved: dict[str, Trajectory] = {}
    for other, trajectory in scene.trajectories.items():
        on_ego = None if other == name else moved_trajectory(trajectory, onto_ego)
        there = None if on_ego is None else moved_trajectory(on_ego, into_world)
        if there is not None:
            moved[other] = there
    return moved
