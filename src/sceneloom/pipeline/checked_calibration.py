"""The check of a drive's calibration by all that the drive has: pictures, points, and boxes of detectors."""

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
from sceneloom.detections.residuals import BoxResiduals, BoxTurn
from sceneloom.errors import OptionError
from sceneloom.formats.kitti.tracking_folder import KittiTracking
from sceneloom.geometry.interpolation import OUT_OF_REACH
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.clock.camera_turning import camera_turning
from sceneloom.motion.ego_motion import find_ego_motion
from sceneloom.pipeline.detections.detected import DetectedDrive, kitti_drive, moments
from sceneloom.pipeline.detections.detected_scene import DetectionFiles, scene_drive
from sceneloom.scene.part import cut_scene
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import needs_ego, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Identifier

_MOST_TURNS = 100
"""Pictures whose turning is followed, at most."""
_MOST_PICTURES = 200
"""Boxes of more pictures tell hardly more."""


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
    """Check a calibration by pictures and points, and by lists of boxes where there are any.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: pictures to look at, at most; boxes of more pictures count.
        start, stop: seconds after the first time stamp between which pictures count.
        boxes_3d, boxes_2d: lists of boxes, as for `fuse_detections`.
        motion: compare how both turn, too; it looks at all pictures, up to 100 in the middle of the part.
        lenient: leave out boxes that are faulty.

    Raises:
        OptionError: there is no such camera or lidar, or boxes of pictures or sweeps alone.
        PoseError: it is not known how the camera lies to the lidar.
        DataError: a picture, a sweep or a list cannot be read.
    """
    if bool(boxes_3d) != bool(boxes_2d):
        raise OptionError(
            f"{scene.source}: boxes of {'sweeps' if boxes_3d else 'pictures'} alone; a calibration is judged by boxes "
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
        health = with_boxes(health, turn_of_boxes(drive, camera))
    if motion:
        health = with_coarse(health, _judged_motion(part, camera, lidar))
    health = msgspec.structs.replace(health, corrections=scene.correction_notices)
    return CheckedCalibration(health, frames)


def _judged_motion(part: Scene, camera_id: Identifier, lidar_id: Identifier) -> Item:
    """Compare how a camera turns from picture to picture with how the lidar does by the ego's way."""
    camera, lidar = chosen_camera(part, camera_id), chosen_lidar(part, lidar_id)
    count = len(camera.pictures)
    first = max((count - _MOST_TURNS) // 2, 0)
    turning = camera_turning(replace(camera, pictures=camera.pictures[first : first + _MOST_TURNS]))
    times = turning.timestamps_ns
    if len(times) < 2:
        return Item.unknown(MOTION, "there are no two pictures")
    ego = find_ego_motion(part) if needs_ego(part) else None
    reach_ns = scene_period_ns(part)
    ways = [sensor_source(part, sensor, ego, reach_ns=reach_ns).at(times) for sensor in (camera, lidar)]
    steps = _steps(turning.quaternions_xyzw)
    steps[np.diff(turning.pieces) != 0] = np.nan
    said = _steps(ways[1].quaternions_xyzw)
    there = (ways[0].coverage != OUT_OF_REACH) & (ways[1].coverage != OUT_OF_REACH)
    said[~(there[1:] & there[:-1])] = np.nan
    row = int(np.argmax(there))
    stated = multiply_quaternions(
        conjugate_quaternion(ways[0].quaternions_xyzw[row]), ways[1].quaternions_xyzw[row]
    )
    return judge_motion(steps, said, matrix_from_quaternion(stated))


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
            turn = turn_of_boxes(drive, camera_id)
            found.append(
                health_of_boxes(
                    turn, source=name, camera_id=camera_id, lidar_id=drive.lidar_id, frames=len(camera.boxes)
                )
            )
    return found


def turn_of_boxes(drive: DetectedDrive, camera_id: Identifier) -> BoxTurn | None:
    """The turn about which boxes of a camera's pictures and of sweeps agree; None where hardly any may be alike."""
    if camera_id not in drive.cameras:
        return None
    pairs = [moment.pairs[camera_id] for moment in moments(drive) if camera_id in moment.pairs]
    residuals = BoxResiduals()
    for pair in pairs[:: -(-len(pairs) // _MOST_PICTURES) or 1]:
        residuals.add(pair)
    return residuals.turn()


def _within(drive: DetectedDrive, part: Scene, camera_id: Identifier) -> DetectedDrive:
    """The drive with the boxes of those pictures alone that are in a part of the scene."""
    camera = next(camera for camera in part.cameras if camera.id == camera_id)
    times = camera.pictures.timestamps_ns
    cameras = {
        known: replace(
            found, boxes=tuple(b for b in found.boxes if times.min() <= b.timestamp_ns <= times.max())
        )
        for known, found in drive.cameras.items()
        if known == camera_id
    }
    return replace(drive, cameras=cameras)
