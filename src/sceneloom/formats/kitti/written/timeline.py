"""Frames of KITTI's synchronised folders: which sweep and which images belong to each, and when it is."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.kitti.written.choice import Choice
from sceneloom.formats.loss import Loss, Support
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor

NONE = -1
_OWN_FRAME = 0.75
"""An image that is this share of a period from every sweep is of a frame without one: a sweep is missing there."""


def check_files(choice: Choice, *, labels: bool) -> None:
    """Refuse a scene of which a folder without OXTS lines would have no files.

    Args:
        choice: what is written.
        labels: whether boxes of a camera without images are files, too.

    Raises:
        DataError: there are neither sweeps nor images, nor such boxes.
    """
    has_sweeps = choice.lidar is not None and len(choice.lidar.frames) > 0
    has_images = any(len(camera.images) for camera in choice.cameras.values())
    if not (has_sweeps or has_images or (labels and choice.reference is not None)):
        problem = "holds neither sweeps nor images, of which the files of such a folder are"
        raise DataError(choice.scene.source, "", problem)


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """The frames, in order.

    Attributes:
        timestamps_ns: (F,) int64 [ns].
        sweeps: (F,) int64, number of the sweep, -1 for none.
        images: by number of the camera, (F,) int64, number of the image, -1 for none.
        losses: images that belong to no frame, and times that are not those of their frames.
    """

    timestamps_ns: Int64Array
    sweeps: Int64Array
    images: Mapping[int, Int64Array]
    losses: tuple[Loss, ...]

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def starts_ns(self, lidar: LidarSensor | None) -> Int64Array:
        """When the sweep of each frame began, (F,) int64 [ns]; the frame's own time where it has none."""
        found = self.timestamps_ns.copy()
        if lidar is not None:
            swept = self.sweeps != NONE
            found[swept] = lidar.frames.timestamps_ns[self.sweeps[swept]]
        return found


def timeline_of(choice: Choice, *, one_time: bool = True) -> Timeline:
    """Put sweeps and images into frames: a frame for each sweep, with the images nearest to its moment.

    Args:
        choice: the sensors.
        one_time: whether a frame has one time for all of its sensors, whose losses are reported.

    Raises:
        DataError: nothing reports any frame.
    """
    lidar = choice.lidar
    starts = np.zeros(0, np.int64) if lidar is None else lidar.frames.timestamps_ns
    offset = 0 if lidar is None or not len(lidar.frames) else moment_offset(lidar)
    moments = starts + offset
    cameras = {number: camera.images.timestamps_ns for number, camera in choice.cameras.items()}
    period = _period(moments if len(moments) > 1 else max(cameras.values(), key=len, default=moments))
    frames = _with_lonely_images(moments, cameras, period)
    if not len(frames):
        frames = _reported_times(choice)
    if not len(frames):
        raise DataError(choice.scene.source, "", "holds nothing that a folder of KITTI's could hold")
    sweeps = np.full(len(frames), NONE, np.int64)
    sweeps[np.searchsorted(frames, moments)] = np.arange(len(moments))
    images, losses = {}, list[Loss]()
    for number, timestamps in cameras.items():
        images[number] = _nearest(frames, timestamps, period)
        unused = len(timestamps) - int((images[number] != NONE).sum())
        if unused:
            what = "left out: nearest to no frame, and a frame has one image of a camera"
            losses.append(Loss(field="sensors.camera.images", what=what, count=unused))
    if one_time:
        losses += _time_losses("sensors.lidar.frames.timestamp_ns", frames, sweeps, starts)
        for number, timestamps in cameras.items():
            losses += _time_losses("sensors.camera.images.timestamp_ns", frames, images[number], timestamps)
    return Timeline(frames, sweeps, images, tuple(losses))


def _reported_times(choice: Choice) -> Int64Array:
    """When anything is reported, where there are neither sweeps nor images: fixes and boxes, else the trajectory."""
    scene = choice.scene
    timestamps = [sensor.timestamps_ns for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    boxes = (a for a in scene.annotations if isinstance(a, CuboidAnnotation | Box2DAnnotation))
    timestamps += [box.path.timestamps_ns for box in boxes]
    if not timestamps and choice.ego_path is not None and not choice.ego_path.static:
        timestamps = [choice.ego_path.timestamps_ns]
    return np.unique(np.concatenate(timestamps)) if timestamps else np.zeros(0, np.int64)


def nearest_frames(frames_ns: Int64Array, timestamps_ns: Int64Array) -> Int64Array:
    """The frame nearest to each time, (M,) int64, -1 where none is within half a period.

    Args:
        frames_ns: times of the frames, (F,) int64 [ns], rising.
        timestamps_ns: (M,) int64 [ns].
    """
    if not len(frames_ns):
        return np.full(len(timestamps_ns), NONE, np.int64)
    right = np.clip(np.searchsorted(frames_ns, timestamps_ns), 0, len(frames_ns) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(
        np.abs(timestamps_ns - frames_ns[left]) <= np.abs(frames_ns[right] - timestamps_ns), left, right
    )
    near = np.abs(frames_ns[nearest] - timestamps_ns) <= _period(frames_ns) // 2
    found: Int64Array = np.where(near, nearest, NONE)
    return found


def moment_offset(lidar: LidarSensor) -> int:
    """How long after its start a sweep's moment is [ns], as the first sweep reports it."""
    first = lidar.frames[0]
    forward_ns = first.extras.get("forward_ns")
    return (forward_ns if isinstance(forward_ns, int) else first.reference_ns) - first.timestamp_ns


def _period(timestamps_ns: Int64Array) -> int:
    return int(np.median(np.diff(timestamps_ns))) if len(timestamps_ns) > 1 else 100_000_000


def _with_lonely_images(
    moments_ns: Int64Array, cameras: Mapping[int, Int64Array], period_ns: int
) -> Int64Array:
    """The moments of sweeps, and those of images that are far from all of them."""
    frames = moments_ns
    for timestamps in cameras.values():
        if not len(frames):
            frames = np.unique(timestamps)
            continue
        near = np.clip(np.searchsorted(frames, timestamps), 1, max(len(frames) - 1, 1))
        after = frames[np.minimum(near, len(frames) - 1)]
        away = np.minimum(np.abs(timestamps - frames[near - 1]), np.abs(timestamps - after))
        frames = np.unique(np.concatenate([frames, timestamps[away > _OWN_FRAME * period_ns]]))
    return frames


def _nearest(frames_ns: Int64Array, timestamps_ns: Int64Array, period_ns: int) -> Int64Array:
    """For each frame the number of its nearest image, each image for its own nearest frame only."""
    found = np.full(len(frames_ns), NONE, np.int64)
    if not len(timestamps_ns) or not len(frames_ns):
        return found
    right = np.clip(np.searchsorted(frames_ns, timestamps_ns), 0, len(frames_ns) - 1)
    left = np.maximum(right - 1, 0)
    owner = np.where(timestamps_ns - frames_ns[left] <= frames_ns[right] - timestamps_ns, left, right)
    owner = np.where(timestamps_ns >= frames_ns[-1], len(frames_ns) - 1, owner)
    away = np.abs(timestamps_ns - frames_ns[owner])
    for k in np.argsort(-away, kind="stable").tolist():
        if away[k] <= period_ns:
            found[owner[k]] = k
    return found


def _time_losses(
    name: str, frames_ns: Int64Array, chosen: Int64Array, timestamps_ns: Int64Array
) -> list[Loss]:
    there = chosen != NONE
    errors = np.abs(frames_ns[there] - timestamps_ns[chosen[there]])
    count = int((errors > 0).sum())
    if not count:
        return []
    what = "the frame's time in its location: a frame has one time for all sensors [s]"
    worst = float(errors.max()) / 1e9
    return [Loss(field=name, what=what, count=count, support=Support.APPROXIMATED, largest_error=worst)]
