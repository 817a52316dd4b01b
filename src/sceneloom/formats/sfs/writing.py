"""Writing a whole scene."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.loss import LossReport
from sceneloom.formats.sfs.times import READABLE_TICKS_NS, TICKS_NS, UINT32_MAX
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.relations import EventAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.scene import Scene

_LATEST_START_NS = {"sfs": None, "scale": 90_000_000_000}


def write_scene(
    scene: Scene,
    path: str | Path,
    *,
    overwrite: bool = False,
    profile: str = "sfs",
    time_unit: str | None = None,
    time_offset_ns: int | None = None,
) -> LossReport:
    """Write a scene to a file.

    Args:
        scene: any scene; one that was read from a file of this format keeps its unit, offset and timestamps.
        path: the file to be made.
        overwrite: whether a file there may be replaced.
        profile: "sfs", or "scale" for a file that Scale's own library loads and validates.
        time_unit: "microseconds" or "nanoseconds"; None for the scene's own, else microseconds.
        time_offset_ns: the absolute time of the file's zero [ns]; None to choose it.

    Returns:
        What the file cannot hold.

    Raises:
        OptionError: a value is not one that can be followed, or something cannot be held by the format.
        DataError: a frame or image cannot be read.
        OutputError: the file exists, or cannot be written.
    """
    times_ns = list(_known_times(scene))
    unit = time_unit or _own_unit(scene, profile)
    from_sfs = scene.format == "sfs"
    own_spelling = (
        scene.extras.get("time_unit") if from_sfs and time_unit is None and profile == "sfs" else None
    )
    keeps_offset = from_sfs and time_offset_ns is None and _offset_serves(scene, times_ns, unit, profile)
    with SceneWriter(
        path,
        overwrite=overwrite,
        profile=profile,
        time_unit=unit,
        time_offset_ns=time_offset_ns,
        usual_offset_ns=scene.time_offset_ns if keeps_offset else None,
        first_ns=min(times_ns, default=None),
        frame_count=sum(len(s.frames) for s in scene.sensors if isinstance(s, LidarSensor | RadarSensor)),
        verbatim=from_sfs,
    ) as writer:
        writer.add_scene(scene)
        if isinstance(own_spelling, str) and READABLE_TICKS_NS.get(own_spelling) == TICKS_NS[unit]:
            writer.spell_time_unit(own_spelling)
    return writer.losses


def _own_unit(scene: Scene, profile: str) -> str:
    own = scene.extras.get("time_unit")
    if profile == "scale" or not isinstance(own, str) or own not in READABLE_TICKS_NS:
        return "microseconds"
    return next(unit for unit, tick_ns in TICKS_NS.items() if tick_ns == READABLE_TICKS_NS[own])


def _offset_serves(scene: Scene, times_ns: list[int], unit: str, profile: str) -> bool:
    """Whether the offset of the file that the scene comes from can stay."""
    offset_ns, tick_ns = scene.time_offset_ns, TICKS_NS[unit]
    if offset_ns % tick_ns or not times_ns:
        return offset_ns % tick_ns == 0
    latest_start_ns = _LATEST_START_NS.get(profile)
    starts_late = latest_start_ns is not None and min(times_ns) - offset_ns > latest_start_ns
    wraps = tick_ns > 1 and (max(times_ns) - offset_ns) // tick_ns > UINT32_MAX
    return offset_ns <= min(times_ns) and not starts_late and not wraps


def _known_times(scene: Scene) -> Iterator[int]:
    """First and last of all times that are known without reading a frame [ns]."""
    for sensor in scene.sensors:
        if isinstance(sensor, LidarSensor | RadarSensor) and len(sensor.frames):
            times = sensor.frames.timestamps_ns
            yield from (int(times.min()), int(times.max()))
        if isinstance(sensor, CameraSensor) and len(sensor.images):
            times = sensor.images.timestamps_ns
            yield from (int(times.min()), int(times.max()))
        if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | OdometrySensor):
            poses = sensor.poses
            if poses is not None and not poses.static:
                yield from (poses.start_ns, poses.stop_ns)
    for annotation in scene.annotations:
        for times in _times_of(annotation):
            if len(times):
                yield from (int(times.min()), int(times.max()))


def _times_of(annotation: Annotation) -> list[Int64Array]:
    """The times of an annotation's paths, or of its beginning."""
    if isinstance(annotation, CuboidAnnotation | Box2DAnnotation | ShapeAnnotation):
        return [annotation.path.timestamps_ns]
    if isinstance(annotation, PointsAnnotation):
        return [path.timestamps_ns for path in annotation.paths]
    if isinstance(annotation, EventAnnotation):
        return [np.array([annotation.start_ns], np.int64)]
    if isinstance(annotation, LocalizationAdjustment | CameraCalibration):
        poses = annotation.poses
        return [] if poses is None or poses.static else [poses.timestamps_ns]
    return []
