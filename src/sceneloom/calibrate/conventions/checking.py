"""The conventions of a calibration file, or of a drive, judged by the drive's own points and pictures."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.calibrate.conventions.alignment import edges_meeting
from sceneloom.calibrate.conventions.deciding import Decision, decide
from sceneloom.calibrate.conventions.point_frames import possible_frames
from sceneloom.calibrate.conventions.reading import Extrinsic, read_extrinsics
from sceneloom.calibrate.conventions.report import (
    ConventionsReport,
    ExtrinsicFound,
    PointsFound,
    TimesFound,
    extrinsic_found,
)
from sceneloom.calibrate.conventions.time_units import RATES_HZ, time_units
from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames
from sceneloom.errors import PoseError
from sceneloom.scene import (
    CameraSensor,
    GnssSensor,
    Identifier,
    ImuSensor,
    LidarSensor,
    RadarSensor,
    Scene,
    Sensor,
)
from sceneloom.scene.types import Progress

MOST_FRAMES = 8
"""Pictures by which each extrinsic is judged."""

_AS_READ = {
    "layout": "rows",
    "direction": "camera from lidar",
    "camera axes": "x right, y down, z forward",
    "lidar axes": "those of the points",
}


def check_file(
    path: Path,
    scene: Scene | None = None,
    *,
    camera_id: Identifier | None = None,
    lidar_id: Identifier | None = None,
    progress: Progress | None = None,
) -> ConventionsReport:
    """Tell what the extrinsics of a file mean.

    Args:
        path: any JSON, TOML or text file with extrinsics of a camera and a lidar.
        scene: a drive of these sensors; without one, only what no vehicle has is ruled out.
        camera_id, lidar_id: the sensors that the file relates; None for the scene's first ones.
        progress: told after each extrinsic.

    Raises:
        DataError: the file has no extrinsic, or the drive cannot be read.
        OptionError: the scene has no such sensor.
        PoseError: the scene's points cannot be brought to the time of its pictures.
    """
    extrinsics = read_extrinsics(path)
    scene = None if scene is None else scene.corrected()
    frames = () if scene is None else calibration_frames(scene, camera_id, lidar_id, MOST_FRAMES)
    found = []
    for number, extrinsic in enumerate(extrinsics, start=1):
        found.append(_judged(extrinsic, frames))
        if progress is not None:
            progress(number, len(extrinsics))
    told = () if scene is None else scene.correction_notices
    return ConventionsReport(source=str(path), extrinsics=tuple(found), corrections=told)


def check_drive(scene: Scene, *, progress: Progress | None = None) -> ConventionsReport:
    """Tell whether a drive's extrinsics, the frame of its points and its stamps are what it was read with.

    Raises:
        DataError: a picture or a sweep cannot be read.
    """
    scene = scene.corrected()
    lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
    cameras = [camera for camera in scene.cameras if len(camera.pictures)]
    pairs = [(camera, lidar) for lidar in lidars[:1] for camera in cameras]
    found = []
    for number, (camera, lidar) in enumerate(pairs, start=1):
        found.append(_own(scene, camera, lidar))
        if progress is not None:
            progress(number, len(pairs))
    return ConventionsReport(
        source=scene.source,
        extrinsics=tuple(found),
        points=tuple(
            PointsFound(
                lidar=lidar.id,
                stated=lidar.points_frame.value,
                possible=tuple(frame.value for frame in possible_frames(scene, lidar)),
            )
            for lidar in lidars
        ),
        times=tuple(_times(scene)),
        corrections=scene.correction_notices,
    )


def _judged(extrinsic: Extrinsic, frames: tuple[CalibrationFrame, ...]) -> ExtrinsicFound:
    if not frames:
        return extrinsic_found(decide(extrinsic))
    decision = decide(extrinsic, frames, edges_meeting(frames))
    return extrinsic_found(decision, camera=frames[0].camera_id, lidar=frames[0].lidar_id)


def _own(scene: Scene, camera: CameraSensor, lidar: LidarSensor) -> ExtrinsicFound:
    """Judge what the drive itself says of a camera and a lidar."""
    place = f"camera {camera.id}, lidar {lidar.id}"
    try:
        frames = calibration_frames(scene, camera.id, lidar.id, MOST_FRAMES)
    except PoseError as error:
        unplaced = Decision(place, {}, {}, None, str(error), by_drive=False)
        return extrinsic_found(unplaced, camera=camera.id, lidar=lidar.id)
    numbers = tuple(frames[0].camera_from_lidar.matrix.reshape(-1).tolist())
    decision = decide(Extrinsic(place, numbers), frames, edges_meeting(frames))
    return extrinsic_found(decision, camera=camera.id, lidar=lidar.id, as_read=_is_as_read(decision))


def _is_as_read(decision: Decision) -> bool | None:
    """Say whether the reading in use is the right one; None where it is one of several."""
    possible = all(_AS_READ[name] in values for name, values in decision.possible.items())
    if not possible or not decision.possible:
        return False if decision.possible else None
    return True if decision.decided else None


def _times(scene: Scene) -> Iterator[TimesFound]:
    for sensor in scene.sensors:
        kind = str(sensor.type)
        stamps = _stamps(sensor)
        if kind in RATES_HZ and len(stamps) > 1:
            yield TimesFound(sensor=sensor.id, kind=kind, possible=time_units((stamps * 1e-9).tolist(), kind))


def _stamps(sensor: Sensor) -> Int64Array:
    """When a sensor measured, (N,) int64 [ns]; of an IMU its stream of the most samples."""
    match sensor:
        case CameraSensor():
            return sensor.pictures.timestamps_ns
        case LidarSensor() | RadarSensor():
            return sensor.frames.timestamps_ns
        case GnssSensor():
            return sensor.timestamps_ns
        case ImuSensor():
            return max(
                (stream.timestamps_ns for stream in sensor.streams.values()), key=len, default=_NO_STAMPS
            )
    return _NO_STAMPS


_NO_STAMPS: Int64Array = np.zeros(0, np.int64)
