"""Scenes with their corrections applied: localization adjustments and camera calibrations."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.move_world import EGO_ID, FrameChange, moved_world, to_world, with_odometry
from sceneloom.editing.references import ours_of, with_ours, with_warnings
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, rotate_vectors
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
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory
from sceneloom.scene.scene import Posed, Scene, scene_period_ns
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, key_of
from sceneloom.warnings import assumed, repaired, skipped

_Correction = LocalizationAdjustment | CameraCalibration


def apply_corrections(
    scene: Scene, *, corrections: Iterable[Identifier] | None = None, annotations_in: Coordinates | str | None = None
) -> Scene:
    """Apply localization adjustments and camera calibrations, and remove them.

    An adjustment takes positions in the world to the corrected ones, p' = A(t) p: points and poses at the time of their
    frame, annotations at that of their keyframe; beyond its ends its end poses hold. In a scene in ego coordinates it
    leads from the ego to the world, and reports the ego trajectory from then on. A calibration composes with the
    camera's poses, replaces its camera model and moves the times of its images and of what is drawn in them.

    Args:
        scene: the scene.
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
    """Give the scene with all pending corrections applied, and a warning for each; what `Scene.corrected` calls.

    Raises:
        OptionError, DataError: as of `apply_corrections`.
    """
    pending = scene.pending_corrections
    reported = [
        repaired("correction-applied", f"annotations[{c.id}]", f"{c.type} applied: {effect_of(c)}") for c in pending
    ]
    return with_warnings(apply_corrections(scene, corrections=[c.id for c in pending]), reported)


def _chosen(scene: Scene, wanted: Iterable[Identifier] | None) -> list[_Correction]:
    there = [a for a in scene.annotations if isinstance(a, LocalizationAdjustment | CameraCalibration)]
    if wanted is not None:
        ids = {key_of(identifier): identifier for identifier in wanted}
        if unknown := ids.keys() - {key_of(annotation.id) for annotation in there}:
            name = next(identifier for key, identifier in ids.items() if key in unknown)
            names = ", ".join(repr(annotation.id) for annotation in there)
            raise OptionError(f"{scene.source}: no correction {name!r}; there are {names or 'none'}")
        there = [annotation for annotation in there if key_of(annotation.id) in ids]
    if not there:
        raise OptionError(
            f"{scene.source}: nothing to apply; expected an annotation localization_adjustment or camera_calibration"
        )
    return there


def _without(scene: Scene, correction: _Correction, **further: Any) -> Scene:
    """The scene without a correction that was applied, which the metadata list."""
    earlier = ours_of(scene).get("applied")
    entry = {"id": correction.id, "type": correction.type, **further}
    left = tuple(a for a in scene.annotations if key_of(a.id) != key_of(correction.id))
    reported = [*(earlier if isinstance(earlier, list) else []), entry]
    return with_ours(replace(scene, annotations=left), applied=reported)


# Camera calibrations.


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
    if calibration.poses is not None or calibration.intrinsics is not None:
        what, count = "projections into a corrected camera are kept as they are", _projections(scene, camera.id)
        changed = with_warnings(changed, [assumed("projections-kept", f"sensors[{camera.id}]", what, count=count)])
    return _without(changed, calibration, sensor_id=camera.id)


def _calibrated_camera(sensor: CameraSensor, calibration: CameraCalibration) -> CameraSensor:
    """A camera with its calibration applied: world_from_camera' = world_from_camera D(t), camera model, time offset."""
    # images were taken `time_offset` later than stated; poses report where the camera was at a time, so they keep
    # theirs; where the corrected images go beyond them by no more than the offset, they are extrapolated
    # Source: "Camera Calibration Annotation" of SFS; READING of "camera_calibration" in docs/CONVENTIONS.md
    shift_ns = round(calibration.time_offset_ns or 0)
    timestamps_ns = sensor.images.timestamps_ns + shift_ns
    rotated = sensor if calibration.poses is None else _rotated(sensor, calibration.poses, timestamps_ns)
    size = sensor.camera.width, sensor.camera.height
    images = sensor.images.mapped(partial(_calibrated_image, calibration, size), timestamps_ns=timestamps_ns)
    poses = None if rotated.poses is None else _extrapolated(rotated.poses, timestamps_ns, abs(shift_ns))
    return replace(rotated, camera=calibration.intrinsics or sensor.camera, images=images, poses=poses)


def _calibrated_image(calibration: CameraCalibration, sensor_size: tuple[int, int], image: CameraImage) -> CameraImage:
    """An image, not decoded, with its own mounting and camera model corrected."""
    timestamp_ns = image.timestamp_ns + round(calibration.time_offset_ns or 0)
    mount, camera = image.mount, calibration.intrinsics or image.camera
    if mount is not None and calibration.poses is not None:
        at = calibration.poses.held(np.array([timestamp_ns], np.int64))
        mount = mount @ RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])
    size = image.camera.width, image.camera.height
    if calibration.intrinsics is not None and size != sensor_size:
        camera = camera.resized(*size)
    return replace(image, timestamp_ns=timestamp_ns, camera=camera, mount=mount)


def _rotated(sensor: CameraSensor, correction: Poses, timestamps_ns: Int64Array) -> CameraSensor:
    """Compose the camera's poses and its mounting with the correction."""
    mount, poses = sensor.mount, sensor.poses
    if poses is not None:
        poses = _composed(poses, correction, timestamps_ns)
    if len(correction.timestamps_ns) == 1:
        constant = RigidTransform.from_quaternion(correction.positions[0], correction.quaternions_xyzw[0])
        return replace(sensor, poses=poses, mount=None if mount is None else mount @ constant)
    if mount is None or poses is not None:
        return replace(sensor, poses=poses, mount=None)
    # a mounting that changes with time is stated by poses on the ego
    mounted = Poses(np.zeros(1, np.int64), mount.translation[None], mount.quaternion_xyzw[None], static=True)
    poses = _composed(mounted, correction, timestamps_ns)
    return replace(sensor, poses=poses, mount=None, coordinates=Coordinates.EGO)


def _composed(path: Poses, correction: Poses, timestamps_ns: Int64Array) -> Poses:
    """`path ∘ correction` at the times of both and of the images; beyond the correction its end poses hold."""
    constant = len(correction.timestamps_ns) == 1
    times_ns = path.timestamps_ns
    if not constant:
        times_ns = np.concatenate([correction.timestamps_ns, timestamps_ns])
        if not path.static:
            inside = (times_ns >= path.start_ns) & (times_ns <= path.stop_ns)
            times_ns = np.concatenate([path.timestamps_ns, times_ns[inside]])
        times_ns = np.unique(times_ns)
    body, offset = path.interpolate(times_ns), correction.held(times_ns)
    return Poses(
        times_ns,
        rotate_vectors(body.quaternions_xyzw, offset.positions) + body.positions,
        multiply_quaternions(body.quaternions_xyzw, offset.quaternions_xyzw),
        static=path.static and constant,
    )


def _extrapolated(path: Poses, timestamps_ns: Int64Array, reach_ns: int) -> Poses:
    """The path with poses at those timestamps that lie beyond its ends by no more than `reach_ns`."""
    if path.static or len(path.timestamps_ns) < 2:
        return path
    beyond = np.unique(timestamps_ns[(timestamps_ns < path.start_ns) | (timestamps_ns > path.stop_ns)])
    times_ns = np.union1d(path.timestamps_ns, beyond[path.interpolate(beyond, reach_ns=reach_ns).coverage <= 1])
    if len(times_ns) == len(path.timestamps_ns):
        return path
    rows = np.searchsorted(times_ns, path.timestamps_ns)
    poses = path.interpolate(times_ns, reach_ns=reach_ns)
    positions, quaternions = poses.positions.copy(), poses.quaternions_xyzw.copy()
    positions[rows], quaternions[rows] = path.positions, path.quaternions_xyzw
    return Poses(times_ns, positions, quaternions)


def _shifted_annotation(annotation: Annotation, sensor_id: Identifier, shift_ns: int) -> Annotation:
    """Give an annotation whose times in the images of a camera follow these."""
    key = key_of(sensor_id)

    def shifted(entry: Any) -> Any:
        if isinstance(entry, tuple):
            return tuple(map(shifted, entry))
        return replace(entry, timestamps_ns=entry.timestamps_ns + shift_ns) if key_of(entry.sensor_id) == key else entry

    match annotation:
        case Box2DAnnotation(path=path) | ShapeAnnotation(path=path, dimensions=2):
            if annotation.sensor_id is not None and key_of(annotation.sensor_id) == key:
                moved: Any = replace(path, timestamps_ns=path.timestamps_ns + shift_ns)
                return replace(annotation, path=moved)
        case CuboidAnnotation():
            activations, projections = shifted(annotation.activations), shifted(annotation.projections)
            return replace(annotation, activations=activations, projections=projections)
        case PointsAnnotation():
            return replace(annotation, projections=shifted(annotation.projections))
    return annotation


def _projections(scene: Scene, sensor_id: Identifier) -> int:
    """How many annotations have projections into a camera."""
    key, count = key_of(sensor_id), 0
    for annotation in scene.annotations:
        seen: Iterable[Any] = ()
        if isinstance(annotation, CuboidAnnotation):
            seen = annotation.projections
        elif isinstance(annotation, PointsAnnotation):
            seen = (entry for entries in annotation.projections for entry in entries)
        count += any(key_of(entry.sensor_id) == key for entry in seen)
    return count


# Localization adjustments.


def _adjusted(scene: Scene, adjustment: LocalizationAdjustment, annotations_in: Coordinates | str | None) -> Scene:
    poses = adjustment.poses
    left = _without(scene, adjustment)
    if _frame(scene) is Coordinates.EGO:
        return _led_to_world(left, poses, annotations_in)
    moved = moved_world(left, FrameChange.along(poses, held=True))
    if len(poses.timestamps_ns) == 1 or not _only_mounted(scene):
        return moved
    # all sensors are on the ego, from which it leads to the world
    trajectory = Trajectory(EGO_ID, poses.timestamps_ns, poses.positions, poses.quaternions_xyzw)
    return replace(moved, trajectories={trajectory.name: trajectory})


def _frame(scene: Scene) -> Coordinates:
    """The frame that the sensors of a scene are in."""
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
    """Whether sensors are mounted on the ego, and it is not stated where it or any of them was in the world."""
    placed = any(
        isinstance(sensor, OdometrySensor)
        or getattr(sensor, "poses", None) is not None
        or getattr(sensor, "points_frame", None) is PointsFrame.WORLD
        for sensor in scene.sensors
    )
    mounted = any(getattr(sensor, "mount", None) is not None for sensor in scene.sensors)
    return mounted and not placed and not scene.trajectories


def _led_to_world(scene: Scene, world_from_ego: Poses, annotations_in: Coordinates | str | None) -> Scene:
    """Bring a scene in ego coordinates into the world that an adjustment leads to."""
    stated = annotations_in or ours_of(scene).get(ANNOTATIONS_FRAME)
    warnings = []
    if stated is None and scene.annotations:
        what = "the frame of the annotations is not stated; taken to be the ego frame, as that of the sensors"
        warnings.append(assumed("annotations-frame", "annotations", what))
    odometries = [sensor for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    bare = replace(scene, sensors=tuple(s for s in scene.sensors if not isinstance(s, OdometrySensor)))
    led, identifier = with_odometry(bare, world_from_ego, wanted=odometries[0].id if odometries else EGO_ID)
    name = str(identifier)
    trajectories = {
        name: Trajectory(name, world_from_ego.timestamps_ns, world_from_ego.positions, world_from_ego.quaternions_xyzw)
    }
    if odometries:
        # other trajectories of the ego go through the odometry that it had
        identity, reach_ns = RigidTransform.identity(), scene_period_ns(scene)
        onto_ego = FrameChange(None, PoseSource(odometries[0].poses, identity, reach_ns))
        into_world = FrameChange(PoseSource(world_from_ego, identity, reach_ns))
        for other, trajectory in scene.trajectories.items():
            on_ego = None if other == name else onto_ego.trajectory(trajectory)
            there = None if on_ego is None else into_world.trajectory(on_ego)
            if there is not None:
                trajectories[other] = there
    led = with_warnings(replace(led, trajectories=trajectories), warnings)
    return to_world(led, annotations_in=stated or Coordinates.EGO)
