"""The check of a drive's calibration by all that the drive has: images, points, and boxes of detectors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.frames import (
    MOST,
    CalibrationFrame,
    calibration_frames,
    chosen_camera,
    chosen_lidar,
)
from sceneloom.calibrate.health.boxes import health_of_boxes, with_boxes
from sceneloom.calibrate.health.check import CalibrationHealth, check_frames
from sceneloom.calibrate.health.coarse import with_coarse
from sceneloom.calibrate.health.motion import MOTION, judge_motion
from sceneloom.calibrate.health.verdicts import Item
from sceneloom.detections.residuals import BoxResiduals, BoxRotation
from sceneloom.errors import OptionError
from sceneloom.formats.kitti.tracking_folder import KittiTracking
from sceneloom.geometry.interpolation import OUT_OF_REACH
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.clock.camera_rotating import camera_rotating
from sceneloom.motion.ego_motion import find_ego_motion
from sceneloom.pipeline.detections.detected import DetectedDrive, kitti_drive, moments
from sceneloom.pipeline.detections.detected_scene import DetectionFiles, scene_drive
from sceneloom.scene.part import cut_scene
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import needs_ego, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Identifier

_MOST_ROTATIONS = 100
"""Images whose rotating is followed, at most."""
_MOST_IMAGES = 200
"""Boxes of more images report hardly more."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedCalibration:
    """What a check gave.

    Attributes:
        health: the verdicts.
        frames: what was looked at.
    """

    health: CalibrationHealth
    frames: Sequence[CalibrationFrame]


def check_drive(
    scene: Scene,
    camera_id: Identifier | None = None,
    lidar_id: Identifier | None = None,
    *,
    most: int = MOST,
    start: float | None = None,
    stop: float | None = None,
    boxes_3d: Sequence[Path] = (),
    boxes_2d: Sequence[Path] = (),
    motion: bool = False,
    lenient: bool = False,
) -> CheckedCalibration:
    """Check a calibration by images and points, and by lists of boxes where there are any.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: images to look at, at most; boxes of more images count.
        start, stop: seconds after the first timestamp between which images count.
        boxes_3d, boxes_2d: lists of boxes, as for `fuse_detections`.
        motion: compare how both rotate, too; it looks at all images, up to 100 in the middle of the part.
        lenient: leave out boxes that are faulty.

    Raises:
        OptionError: there is no such camera or lidar, or boxes of images or sweeps alone.
        PoseError: it is not known how the camera lies to the lidar.
        DataError: an image, a sweep or a list cannot be read.
    """
    if bool(boxes_3d) != bool(boxes_2d):
        raise OptionError(
            f"{scene.source}: boxes of {'sweeps' if boxes_3d else 'images'} alone; a calibration is judged by boxes "
            "of both, --boxes3d and --boxes2d"
        )
    scene = scene.corrected()
    part = cut_scene(scene, start=start, stop=stop)
    frames = calibration_frames(part, camera_id, lidar_id, most)
    camera, lidar = frames[0].camera_id, frames[0].lidar_id
    drive = None
    if boxes_3d:
        named = () if camera_id is None else (camera,)
        files = DetectionFiles(boxes_3d=boxes_3d, boxes_2d=boxes_2d, lidar=lidar, cameras=named)
        drive = _within(scene_drive(scene, files, lenient=lenient), part, camera)
    health = check_frames(frames, source=scene.source)
    if drive is not None:
        health = with_boxes(health, rotation_of_boxes(drive, camera))
    if motion:
        health = with_coarse(health, _judged_motion(part, camera, lidar))
    health = msgspec.structs.replace(health, corrections=scene.correction_warnings)
    return CheckedCalibration(health, frames)


def _judged_motion(part: Scene, camera_id: Identifier, lidar_id: Identifier) -> Item:
    """Compare how a camera rotates from image to image with how the lidar does by the ego trajectory."""
    camera, lidar = chosen_camera(part, camera_id), chosen_lidar(part, lidar_id)
    count = len(camera.images)
    first = max((count - _MOST_ROTATIONS) // 2, 0)
    rotating = camera_rotating(replace(camera, images=camera.images[first : first + _MOST_ROTATIONS]))
    times = rotating.timestamps_ns
    if len(times) < 2:
        return Item.unknown(MOTION, "there are no two images")
    ego = find_ego_motion(part) if needs_ego(part) else None
    reach_ns = scene_period_ns(part)
    trajectories = [
        sensor_source(part, sensor, ego, reach_ns=reach_ns).at(times) for sensor in (camera, lidar)
    ]
    steps = _steps(rotating.quaternions_xyzw)
    steps[np.diff(rotating.chunks) != 0] = np.nan
    given = _steps(trajectories[1].quaternions_xyzw)
    there = (trajectories[0].coverage != OUT_OF_REACH) & (trajectories[1].coverage != OUT_OF_REACH)
    given[~(there[1:] & there[:-1])] = np.nan
    row = int(np.argmax(there))
    stated = multiply_quaternions(
        conjugate_quaternion(trajectories[0].quaternions_xyzw[row]), trajectories[1].quaternions_xyzw[row]
    )
    return judge_motion(steps, given, matrix_from_quaternion(stated))


def _steps(quaternions_xyzw: Float64Array) -> Float64Array:
    """Rotation vectors, (N - 1, 3), from each of (N, 4) orientations to the next, in the body's axes."""
    return rotation_vector_from_quaternion(
        multiply_quaternions(conjugate_quaternion(quaternions_xyzw[:-1]), quaternions_xyzw[1:])
    )


def check_sequences(tracking: KittiTracking, sequences: Sequence[str] = ()) -> list[CalibrationHealth]:
    """Check the calibration of sequences laid out like KITTI's tracking benchmark, by boxes alone.

    Args:
        sequences: which ones; none for all.

    Raises:
        DataError: a file is faulty, or a sequence is not there.
    """
    found = []
    for name in tracking.chosen(sequences):
        drive = kitti_drive(tracking.sequence(name))
        for camera_id, camera in drive.cameras.items():
            rotation = rotation_of_boxes(drive, camera_id)
            found.append(
                health_of_boxes(
                    rotation,
                    source=name,
                    camera_id=camera_id,
                    lidar_id=drive.lidar_id,
                    frames=len(camera.boxes),
                )
            )
    return found


def rotation_of_boxes(drive: DetectedDrive, camera_id: Identifier) -> BoxRotation | None:
    """The rotation about which boxes of a camera's images and of sweeps agree; None where hardly any may be alike."""
    if camera_id not in drive.cameras:
        return None
    pairs = [moment.pairs[camera_id] for moment in moments(drive) if camera_id in moment.pairs]
    residuals = BoxResiduals()
    for pair in pairs[:: -(-len(pairs) // _MOST_IMAGES) or 1]:
        residuals.add(pair)
    return residuals.rotation()


def _within(drive: DetectedDrive, part: Scene, camera_id: Identifier) -> DetectedDrive:
    """The drive with the boxes of those images alone that are in a part of the scene."""
    camera = next(camera for camera in part.cameras if camera.id == camera_id)
    times = camera.images.timestamps_ns
    cameras = {
        known: replace(
            found, boxes=tuple(b for b in found.boxes if times.min() <= b.timestamp_ns <= times.max())
        )
        for known, found in drive.cameras.items()
        if known == camera_id
    }
    return replace(drive, cameras=cameras)
