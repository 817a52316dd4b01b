"""The frames of a sensor with injected faults: which come, when they are stated to be of, and what is left in them."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.types import Identifier
from sceneloom.simulate.faults import Interval, PointTimes, SensorFaults
from sceneloom.simulate.randomness import Stream, generator_for


@dataclass(frozen=True, slots=True)
class Clock:
    """A sensor's clock against the true one: offset, and a drift from the sensor's first timestamp on."""

    first_ns: int
    offset_ns: int
    skew_ppm: float

    def stated(self, timestamps_ns: AnyArray) -> Int64Array:
        """What the clock says at true times [ns]."""
        times = np.asarray(timestamps_ns, np.int64)
        drift = np.rint((times - self.first_ns) * (self.skew_ppm * 1e-6)).astype(np.int64)
        stated: Int64Array = times + self.offset_ns + drift
        return stated


@dataclass(frozen=True, slots=True, eq=False)
class FramePlan:
    """Which frames come, of what and when.

    Attributes:
        contents: (F,) int64, number of the true frame that each one shows.
        true_ns: (F,) int64 [ns], when the frame should be of.
        stated_ns: (F,) int64 [ns], the timestamp that it gets.
        blind: (F,) bool, nothing is in it.
    """

    contents: Int64Array
    true_ns: Int64Array
    stated_ns: Int64Array
    blind: BoolArray

    @classmethod
    def of(
        cls, wrong: SensorFaults, timestamps_ns: Int64Array, clock: Clock, *, seed: int, sensor_id: Identifier
    ) -> "FramePlan":
        """Work the faults of a sensor out for its true timestamps (N,) int64 [ns].

        Raises:
            OptionError: a frame number is beyond the last frame.
        """
        count = len(timestamps_ns)
        named = [*wrong.lost_frames, *(number for pair in wrong.swapped for number in pair)]
        beyond = [number for number in named if not 0 <= number < count]
        if beyond:
            raise OptionError(f"faults of sensor {sensor_id!r}: frame {beyond[0]}; expected 0 to {count - 1}")
        contents = np.arange(count)
        for interval in wrong.stuck:
            inside = np.flatnonzero(_within(timestamps_ns, (interval,)))
            contents[inside] = contents[inside[:1]]
        order = np.arange(count)
        for one, other in wrong.swapped:
            order[[one, other]] = other, one
        key = zlib.crc32(repr(sensor_id).encode())
        lost = generator_for(seed, Stream.FAULTS, key).random(count) < wrong.lost_share
        lost[list(wrong.lost_frames)] = True
        lost |= _within(timestamps_ns, wrong.drop_outs)
        order = order[~lost[order]]
        true_ns = timestamps_ns[order]
        return cls(contents[order], true_ns, clock.stated(true_ns), _within(true_ns, wrong.blind))


def _within(timestamps_ns: Int64Array, intervals: tuple[Interval, ...]) -> BoolArray:
    """Which times lie in one of the intervals."""
    inside = np.zeros(len(timestamps_ns), np.bool_)
    for start, stop in intervals:
        inside |= (timestamps_ns >= start) & (timestamps_ns < stop)
    return inside


_POINT_TIMES: Mapping[PointTimes, tuple[int, int, int]] = MappingProxyType(
    {
        PointTimes.RIGHT: (1, 1, 1),
        PointTimes.ZERO: (0, 0, 1),
        PointTimes.FRAME: (0, 1, 1),
        PointTimes.RELATIVE: (1, 0, 1),
        PointTimes.MICROSECONDS: (1, 1, 1000),
        PointTimes.RELATIVE_MICROSECONDS: (1, 0, 1000),
        PointTimes.STRETCHED: (1000, 1, 1),
    }
)
"""Factor on the time within the frame, factor on the frame's timestamp, divisor of their sum; others have no times."""


@dataclass(frozen=True, slots=True, eq=False)
class FaultyClouds:
    """Reads the frames of a lidar or radar and plants its faults in them."""

    frames: LazyFrames[Any]
    plan: FramePlan
    clock: Clock
    wrong: SensorFaults

    def __call__(self, index: int) -> Any:
        """Read one of the frames that come."""
        frame: LidarFrame | RadarFrame = self.frames[int(self.plan.contents[index])]
        stated_ns = int(self.plan.stated_ns[index])
        points: Any = _emptied(frame.points) if self.plan.blind[index] else frame.points
        late_ns = int(self.plan.true_ns[index]) - frame.timestamp_ns
        points = replace(points, timestamps_ns=self._times(points.timestamps_ns, late_ns, stated_ns))
        if self.wrong.intensity_scale != 1.0:
            points = replace(points, intensities=_scaled(points.intensities, self.wrong.intensity_scale))
        changed: Any = replace(frame, timestamp_ns=stated_ns, points=points)
        return changed

    def _times(self, times: Int64Array | None, late_ns: int, stated_ns: int) -> Int64Array | None:
        if times is None or self.wrong.point_times not in _POINT_TIMES:
            return None
        within, timestamp, divisor = _POINT_TIMES[self.wrong.point_times]
        stated = self.clock.stated(times + late_ns) - stated_ns
        return read_only((within * stated + timestamp * stated_ns) // divisor)


def _emptied(points: Any) -> Any:
    """The same arrays of a lidar's or a radar's points, without rows."""
    arrays = {f.name: getattr(points, f.name) for f in fields(points) if f.name != "extras"}
    empty = {name: None if array is None else array[:0] for name, array in arrays.items()}
    extras = {
        name: array[:0] if len(array) == len(points) else array for name, array in points.extras.items()
    }
    return replace(points, **empty, extras=extras)


def _scaled(intensities: UInt8Array | None, factor: float) -> UInt8Array | None:
    if intensities is None:
        return None
    return read_only(np.clip(np.rint(intensities * factor), 0, 255), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class FaultyImages:
    """Reads the images of a camera and plants its faults in them."""

    images: LazyFrames[CameraImage]
    plan: FramePlan
    error: RigidTransform
    focal_scale: float

    def __call__(self, index: int) -> CameraImage:
        """Read one of the images that come."""
        image = self.images[int(self.plan.contents[index])]
        camera = refocused(image.camera, self.focal_scale)
        changed = replace(
            image,
            timestamp_ns=int(self.plan.stated_ns[index]),
            camera=camera,
            mount=None if image.mount is None else image.mount @ self.error,
        )
        if not self.plan.blind[index]:
            return changed
        return replace(changed, decode=_Black(camera.width, camera.height), encoded=None)


@dataclass(frozen=True, slots=True)
class _Black:
    """Makes a black image."""

    width: int
    height: int

    def __call__(self) -> UInt8Array:
        return np.zeros((self.height, self.width, 3), np.uint8)


def refocused(camera: Camera, scale: float) -> Camera:
    """The same camera model with its focal lengths scaled."""
    return camera if scale == 1.0 else replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)
