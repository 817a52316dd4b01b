"""A sample as plain arrays, for programs that know nothing of scenes."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.sample import Sample
from sceneloom.scene.types import Identifier

Named = tuple[str, np.ndarray[Any, Any]]

_LIDAR_ARRAYS = ("positions", "intensities", "colors", "timestamps_ns", "rings", "camera_index")
_RADAR_ARRAYS = ("positions", "directions", "lengths", "timestamps_ns")


def arrays_of(sample: Sample) -> dict[str, np.ndarray[Any, Any]]:
    """Give all arrays of a sample by name.

    Raises:
        DataError: an image or depth image cannot be decoded.
    """
    arrays = {"index": np.array(sample.index), "timestamp_ns": np.array(sample.timestamp_ns)}
    for lidar_id, sweep in sample.sweeps.items():
        arrays.update(_cloud(lidar_id, sweep, _LIDAR_ARRAYS))
    for radar_id, frame in sample.radar_frames.items():
        arrays.update(_cloud(radar_id, frame, _RADAR_ARRAYS))
    for camera_id, camera_model in sample.cameras.items():
        arrays.update(_camera(sample, camera_id, camera_model))
    for sensor_id, world_from_sensor in sample.poses.world_from_sensor.items():
        arrays[f"{sensor_id}.found"] = np.array(sensor_id in sample.times_ns)
        arrays[f"{sensor_id}.time_ns"] = np.array(sample.times_ns.get(sensor_id, sample.timestamp_ns))
        arrays[f"{sensor_id}.world_from_sensor"] = _matrix(world_from_sensor)
    if sample.lidar_id is not None:
        arrays[f"{sample.lidar_id}.world_from_points"] = _matrix(sample.poses.world_from_points)
        for camera_id, transform in sample.camera_from_lidar.items():
            arrays[f"{camera_id}.camera_from_lidar"] = _matrix(transform)
        for camera_id, transform in sample.camera_from_points.items():
            arrays[f"{camera_id}.camera_from_points"] = _matrix(transform)
    return {**arrays, **dict(_boxes(sample))}


def _cloud(
    sensor_id: Identifier, frame: LidarFrame | RadarFrame | None, names: tuple[str, ...]
) -> Iterator[Named]:
    """The arrays that the points have; of a frame that is not there no points."""
    if frame is None:
        yield f"{sensor_id}.positions", np.zeros((0, 3), np.float32)
        return
    for name in names:
        array: AnyArray | None = getattr(frame.points, name)
        if array is not None:
            yield f"{sensor_id}.{name}", array.copy()


def _camera(sample: Sample, camera_id: Identifier, camera_model: Camera) -> Iterator[Named]:
    """Pixels or depths, and the camera model; of an image that is not there black ones, of a depth image no depths."""
    size = (camera_model.height, camera_model.width)
    if camera_id in sample.images:
        image = sample.images[camera_id]
        yield f"{camera_id}.rgb", _own(image.rgb) if image else np.zeros((*size, 3), np.uint8)
    else:
        frame = sample.depth_frames[camera_id]
        yield f"{camera_id}.depth", _own(frame.depth) if frame else np.zeros(size, np.float32)
    yield f"{camera_id}.matrix", camera_model.matrix
    yield f"{camera_id}.coefficients", np.array(camera_model.coefficients, np.float64)


def _own(image: AnyArray) -> AnyArray:
    return image if image.flags.writeable else image.copy()


def _matrix(transform: RigidTransform | None) -> Float64Array:
    return np.full((4, 4), np.nan) if transform is None else transform.matrix


def _boxes(sample: Sample) -> Iterator[Named]:
    boxes = sample.boxes
    yield "boxes.centers_world", boxes.centers_world
    yield "boxes.sizes_lwh", boxes.sizes_lwh
    yield "boxes.rotations_world", boxes.rotations_world
    numbers = np.arange(len(boxes), dtype=np.int64) if boxes.numbers is None else boxes.numbers.copy()
    yield "boxes.track_numbers", numbers
    yield "boxes.track_ids", _texts([str(identifier) for identifier in boxes.ids])
    yield "boxes.labels", _texts(["" if label is None else label for label in boxes.labels])


def _texts(texts: list[str]) -> np.ndarray[Any, Any]:
    """Texts of 64 characters, so that all samples have one dtype; wider only where one is longer."""
    return np.array(texts, f"<U{max([64, *map(len, texts)])}")
