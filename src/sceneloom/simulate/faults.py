"""Faults injected into a drive: which there are, the frames they make, and a scene with them."""

import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import partial
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.time_range import select_rows
from sceneloom.scene.types import Identifier, SensorType
from sceneloom.simulate.parameters import Stream, check_bounds, generator_for

_Interval = tuple[int, int]
"""`[start_ns, stop_ns)` on the true clock [ns]."""


class PointTimes(StrEnum):
    """What a driver can make of the times of a lidar's or a radar's points."""

    RIGHT = "right"
    """They are what they should be."""
    MISSING = "missing"
    """The points have no times at all."""
    ZERO = "zero"
    """All are 0."""
    FRAME = "frame"
    """All are the timestamp of their frame."""
    RELATIVE = "relative"
    """They count from the timestamp of their frame [ns]."""
    MICROSECONDS = "microseconds"
    """They are the right times in microseconds, handed on as nanoseconds."""
    RELATIVE_MICROSECONDS = "relative_microseconds"
    """They count from the timestamp of their frame in microseconds, handed on as nanoseconds."""
    STRETCHED = "stretched"
    """Their distance from the timestamp of their frame is 1000 times too long: nanoseconds read as microseconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFaults:
    """What is wrong with one sensor. Frame numbers count its true frames (samples of an IMU or a GNSS) from 0.

    Attributes:
        rotation_deg: rotation vector [deg] in the sensor's axes by which the stated mounting is rotated from the true
            one: `ego_from_stated = ego_from_true @ error`.
        shift: the error's translation [m] in the sensor's axes.
        time_offset_ns: added to all its timestamps [ns].
        clock_skew_ppm: its clock runs so much too fast, from the first timestamp on.
        lost_share: share of frames that are lost at random.
        lost_frames: numbers of frames that are lost.
        drop_outs: intervals from which no frame comes.
        blind: intervals whose frames are there but empty; images are black.
        stuck: intervals whose frames repeat the content of the first one in them.
        swapped: pairs of frame numbers that come in each other's place, timestamps included.
        point_times: what the times of the points are.
        intensity_scale: factor on the intensities, which stay within 0 to 255.
        focal_scale: factor on the focal lengths that the scene states.

    Raises:
        OptionError: a number is out of bounds.
    """

    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset_ns: int = 0
    clock_skew_ppm: float = 0.0
    lost_share: float = 0.0
    lost_frames: tuple[int, ...] = ()
    drop_outs: tuple[_Interval, ...] = ()
    blind: tuple[_Interval, ...] = ()
    stuck: tuple[_Interval, ...] = ()
    swapped: tuple[tuple[int, int], ...] = ()
    point_times: PointTimes = PointTimes.RIGHT
    intensity_scale: float = 1.0
    focal_scale: float = 1.0

    def __post_init__(self) -> None:
        check_bounds(
            "faults",
            self,
            rotation_deg=(-180.0, 180.0),
            shift=(-1e3, 1e3),
            time_offset_ns=(-(10**15), 10**15),
            clock_skew_ppm=(-1e5, 1e5),
            lost_share=(0.0, 1.0),
            intensity_scale=(0.0, 1e3),
            focal_scale=(0.1, 10.0),
        )
        for name in ("drop_outs", "blind", "stuck"):
            for interval in getattr(self, name):
                if len(interval) != 2 or interval[0] >= interval[1]:
                    raise OptionError(f"faults.{name}: {interval}; expected (start_ns, stop_ns), start first")
        numbers = [number for pair in self.swapped for number in pair]
        if any(len(pair) != 2 for pair in self.swapped) or len(set(numbers)) != len(numbers):
            raise OptionError(f"faults.swapped: {self.swapped}; expected pairs, each frame in one of them")

    @property
    def error(self) -> RigidTransform:
        """`true_from_stated` of the mounting, in the sensor's axes."""
        vector = np.radians(np.array(self.rotation_deg, np.float64))
        half = float(np.linalg.norm(vector)) / 2
        scale = 0.5 * np.sinc(half / np.pi)  # sin(half) / (2 half), also for no rotation
        quaternion_xyzw = np.array([*(scale * vector), math.cos(half)])
        return RigidTransform.from_quaternion(np.array(self.shift, np.float64), quaternion_xyzw)

    @property
    def named(self) -> frozenset[str]:
        """Names of the faults that are there, as those of the fields."""
        return frozenset(
            name for name in self.__dataclass_fields__ if getattr(self, name) != getattr(_NOTHING_WRONG, name)
        )


_NOTHING_WRONG = SensorFaults()

_STREAM_FAULTS = frozenset(
    {"time_offset_ns", "clock_skew_ppm", "lost_share", "lost_frames", "drop_outs", "stuck", "swapped"}
)

_CLOUD_FAULTS = _STREAM_FAULTS | {"rotation_deg", "shift", "blind", "point_times"}

_POSSIBLE_FAULTS: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        SensorType.LIDAR: _CLOUD_FAULTS | {"intensity_scale"},
        SensorType.RADAR: _CLOUD_FAULTS,
        SensorType.CAMERA: _STREAM_FAULTS | {"rotation_deg", "shift", "blind", "focal_scale"},
        SensorType.IMU: _STREAM_FAULTS | {"rotation_deg"},
        SensorType.GNSS: _STREAM_FAULTS,
    }
)
"""Which faults mean something for which sensors."""


@dataclass(frozen=True, slots=True)
class Faults:
    """What is wrong with a drive.

    Attributes:
        sensors: faults by the id of the sensor.
        seed: another number loses other frames.
    """

    sensors: Mapping[Identifier, SensorFaults] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise OptionError(f"faults.seed: {self.seed}; expected a number that is not negative")


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


def _within(timestamps_ns: Int64Array, intervals: tuple[_Interval, ...]) -> BoolArray:
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
    """Reads the frames of a lidar or radar and injects its faults."""

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
            scaled = None if points.intensities is None else np.rint(points.intensities * self.wrong.intensity_scale)
            clipped = None if scaled is None else read_only(np.clip(scaled, 0, 255), np.uint8)
            points = replace(points, intensities=clipped)
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
    extras = {name: array[:0] if len(array) == len(points) else array for name, array in points.extras.items()}
    return replace(points, **empty, extras=extras)


@dataclass(frozen=True, slots=True, eq=False)
class _FaultyImages:
    """Reads the images of a camera and injects its faults."""

    images: LazyFrames[CameraImage]
    plan: FramePlan
    error: RigidTransform
    focal_scale: float

    def __call__(self, index: int) -> CameraImage:
        """Read one of the images that come."""
        image = self.images[int(self.plan.contents[index])]
        camera = _refocused(image.camera, self.focal_scale)
        changed = replace(
            image,
            timestamp_ns=int(self.plan.stated_ns[index]),
            camera=camera,
            mount=None if image.mount is None else image.mount @ self.error,
        )
        if not self.plan.blind[index]:
            return changed
        return replace(changed, decode=partial(_black, camera.height, camera.width), encoded=None)


def _black(height: int, width: int) -> UInt8Array:
    return np.zeros((height, width, 3), np.uint8)


def _refocused(camera: Camera, scale: float) -> Camera:
    """The same camera model with its focal lengths scaled."""
    return camera if scale == 1.0 else replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)


_Cloud = TypeVar("_Cloud", LidarSensor, RadarSensor)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """The faults of one sensor, and what its random losses start from."""

    wrong: SensorFaults
    clock: Clock
    seed: int
    sensor_id: Identifier

    @classmethod
    def of(cls, sensor: Sensor, wrong: SensorFaults, seed: int) -> "_Job":
        times = frame_times(sensor)
        first_ns = int(times.min()) if len(times) else 0
        clock = Clock(first_ns, wrong.time_offset_ns, wrong.clock_skew_ppm)
        return cls(wrong, clock, seed, sensor.id)

    def plan(self, timestamps_ns: Int64Array) -> FramePlan:
        return FramePlan.of(self.wrong, timestamps_ns, self.clock, seed=self.seed, sensor_id=self.sensor_id)


def _inject_into_cloud(sensor: _Cloud, job: _Job) -> tuple[_Cloud, Int64Array]:
    plan = job.plan(sensor.frames.timestamps_ns)
    frames = LazyFrames(plan.stated_ns, FaultyClouds(sensor.frames, plan, job.clock, job.wrong))
    return replace(sensor, frames=frames, **_placement(sensor, job.wrong)), plan.contents


def _inject_into_camera(sensor: CameraSensor, job: _Job) -> tuple[CameraSensor, Int64Array]:
    plan, scale = job.plan(sensor.images.timestamps_ns), job.wrong.focal_scale
    images = LazyFrames(plan.stated_ns, _FaultyImages(sensor.images, plan, job.wrong.error, scale))
    camera = _refocused(sensor.camera, scale)
    placed = _placement(sensor, job.wrong)
    return replace(sensor, camera=camera, images=images, video=None, **placed), plan.contents


def _placement(sensor: LidarSensor | RadarSensor | CameraSensor, wrong: SensorFaults) -> dict[str, Any]:
    """The mounting and the poses that the scene states, where they are wrong."""
    if not wrong.named & {"rotation_deg", "shift"}:
        return {}
    poses: Poses | None = sensor.poses
    if poses is not None:
        stated = PoseSource(poses, wrong.error).at(poses.timestamps_ns)
        poses = replace(poses, positions=stated.positions, quaternions_xyzw=stated.quaternions_xyzw)
    return {"poses": poses, "mount": None if sensor.mount is None else sensor.mount @ wrong.error}


def _inject_into_imu(sensor: ImuSensor, job: _Job) -> tuple[ImuSensor, Int64Array]:
    plans = {name: job.plan(samples.timestamps_ns) for name, samples in sensor.streams.items()}
    streams = {
        # a rotated unit whose frame counts as the ego's; only vectors of space rotate
        name: VectorSamples(plan.stated_ns, job.wrong.error.rotate(values) if values.shape[1] == 3 else values)
        for name, plan in plans.items()
        for values in [sensor.streams[name].values[plan.contents]]
    }
    contents = max((plan.contents for plan in plans.values()), key=len, default=np.zeros(0, np.int64))
    return replace(sensor, streams=streams), contents


def _inject_into_gnss(sensor: GnssSensor, job: _Job) -> tuple[GnssSensor, Int64Array]:
    plan = job.plan(sensor.timestamps_ns)
    chosen = select_rows(sensor, plan.contents)
    return replace(chosen, timestamps_ns=plan.stated_ns, file_seconds=None), plan.contents


_INJECTORS: Mapping[str, Callable[[Any, _Job], tuple[Any, Int64Array]]] = MappingProxyType(
    {
        SensorType.LIDAR: _inject_into_cloud,
        SensorType.RADAR: _inject_into_cloud,
        SensorType.CAMERA: _inject_into_camera,
        SensorType.IMU: _inject_into_imu,
        SensorType.GNSS: _inject_into_gnss,
    }
)


def inject_into_scene(scene: Scene, faults: Faults) -> tuple[Scene, Mapping[Identifier, Int64Array]]:
    """Make a scene wrong; its frames are still read when asked for, each the same whenever it is.

    Returns:
        The scene, and for each sensor with faults (F,) int64: the number of the true frame that each of its frames
        shows (of an IMU: of its longest stream).

    Raises:
        OptionError: there is no such sensor or frame, or a fault means nothing for that kind of sensor.
    """
    for sensor_id, wrong in faults.sensors.items():
        _check_possible(scene.sensor(sensor_id), wrong)
    sensors: list[Sensor] = []
    true_frames: dict[Identifier, Int64Array] = {}
    for sensor in scene.sensors:
        changed = sensor
        if sensor.id in faults.sensors:
            job = _Job.of(sensor, faults.sensors[sensor.id], faults.seed)
            changed, true_frames[sensor.id] = _INJECTORS[str(sensor.type)](sensor, job)
        sensors.append(changed)
    return replace(scene, sensors=tuple(sensors)), true_frames


def _check_possible(sensor: Sensor, wrong: SensorFaults) -> None:
    possible = _POSSIBLE_FAULTS.get(str(sensor.type), frozenset())
    strange = sorted(wrong.named - possible)
    if strange:
        raise OptionError(
            f"faults of sensor {sensor.id!r}: {', '.join(strange)}; a sensor of type {sensor.type} can have "
            f"{', '.join(sorted(possible)) or 'none'}"
        )
