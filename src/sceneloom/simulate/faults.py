"""Faults injected into a drive: which there are, the frames they make, and a scene with them."""

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.time_range import select_rows
from sceneloom.scene.types import Identifier, SensorType
from sceneloom.simulate.parameters import Stream, check_bounds, generator_for

_Interval = tuple[int, int]  # `[start_ns, stop_ns)` on the true clock [ns]


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


@dataclass(frozen=True, slots=True, eq=False)
class _FramePlan:
    """Which frames come, of what and when."""

    contents: Int64Array  # (F,) int64, number of the true frame that each one shows
    true_ns: Int64Array  # (F,) int64 [ns], when the frame should be of
    stated_ns: Int64Array  # (F,) int64 [ns], the timestamp that it gets
    blind: BoolArray  # (F,) bool, nothing is in it


@dataclass(frozen=True, slots=True, eq=False)
class _Injection:
    """The faults of one sensor, whose first timestamp is `first_ns`, and what its random losses start from."""

    wrong: SensorFaults
    first_ns: int
    seed: int
    sensor_id: Identifier

    def stated(self, timestamps_ns: AnyArray) -> Int64Array:
        """What the sensor's clock says at true times [ns]: an offset, and a drift from the first timestamp on."""
        times = np.asarray(timestamps_ns, np.int64)
        drift = np.rint((times - self.first_ns) * (self.wrong.clock_skew_ppm * 1e-6)).astype(np.int64)
        stated: Int64Array = times + self.wrong.time_offset_ns + drift
        return stated

    def plan(self, timestamps_ns: Int64Array) -> _FramePlan:
        """Work the faults out for true timestamps (N,) int64 [ns]."""
        wrong, count = self.wrong, len(timestamps_ns)
        named = [*wrong.lost_frames, *(number for pair in wrong.swapped for number in pair)]
        beyond = [number for number in named if not 0 <= number < count]
        if beyond:
            raise OptionError(f"faults of sensor {self.sensor_id!r}: frame {beyond[0]}; expected 0 to {count - 1}")
        contents, order = np.arange(count), np.arange(count)
        for interval in wrong.stuck:
            inside = np.flatnonzero(_within(timestamps_ns, (interval,)))
            contents[inside] = contents[inside[:1]]
        for one, other in wrong.swapped:
            order[[one, other]] = other, one
        key = zlib.crc32(repr(self.sensor_id).encode())
        lost = generator_for(self.seed, Stream.FAULTS, key).random(count) < wrong.lost_share
        lost[list(wrong.lost_frames)] = True
        lost |= _within(timestamps_ns, wrong.drop_outs)
        order = order[~lost[order]]
        true_ns = timestamps_ns[order]
        return _FramePlan(contents[order], true_ns, self.stated(true_ns), _within(true_ns, wrong.blind))

    def placement(self, sensor: LidarSensor | RadarSensor | CameraSensor) -> dict[str, Any]:
        """The mounting and the poses that the scene states, where they are wrong."""
        if not self.wrong.named & {"rotation_deg", "shift"}:
            return {}
        poses, error = sensor.poses, self.wrong.error
        if poses is not None:
            stated = PoseSource(poses, error).at(poses.timestamps_ns)
            poses = replace(poses, positions=stated.positions, quaternions_xyzw=stated.quaternions_xyzw)
        return {"poses": poses, "mount": None if sensor.mount is None else sensor.mount @ error}


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


def _faulty_cloud(frames: LazyFrames[Any], plan: _FramePlan, injection: _Injection, index: int) -> Any:
    """Read one of the frames of a lidar or radar that come."""
    wrong, stated_ns = injection.wrong, int(plan.stated_ns[index])
    frame: LidarFrame | RadarFrame = frames[int(plan.contents[index])]
    points: Any = frame.points
    if plan.blind[index]:
        arrays = {f.name: getattr(points, f.name) for f in fields(points) if f.name != "extras"}
        extras = {name: array[:0] if len(array) == len(points) else array for name, array in points.extras.items()}
        empty = {name: None if array is None else array[:0] for name, array in arrays.items()}
        points = replace(points, **empty, extras=extras)
    times = None
    if points.timestamps_ns is not None and wrong.point_times in _POINT_TIMES:
        late_ns = int(plan.true_ns[index]) - frame.timestamp_ns
        within, timestamp, divisor = _POINT_TIMES[wrong.point_times]
        stated = injection.stated(points.timestamps_ns + late_ns) - stated_ns
        times = read_only((within * stated + timestamp * stated_ns) // divisor)
    points = replace(points, timestamps_ns=times)
    if wrong.intensity_scale != 1.0 and points.intensities is not None:
        scaled = np.clip(np.rint(points.intensities * wrong.intensity_scale), 0, 255)
        points = replace(points, intensities=read_only(scaled, np.uint8))
    changed: Any = replace(frame, timestamp_ns=stated_ns, points=points)
    return changed


def _faulty_image(images: LazyFrames[CameraImage], plan: _FramePlan, injection: _Injection, index: int) -> CameraImage:
    """Read one of the images that come."""
    image = images[int(plan.contents[index])]
    camera, mount = _refocused(image.camera, injection.wrong.focal_scale), image.mount
    mount = None if mount is None else mount @ injection.wrong.error
    changed = replace(image, timestamp_ns=int(plan.stated_ns[index]), camera=camera, mount=mount)
    if not plan.blind[index]:
        return changed
    return replace(changed, decode=partial(_black, camera.height, camera.width), encoded=None)


def _black(height: int, width: int) -> UInt8Array:
    return np.zeros((height, width, 3), np.uint8)


def _refocused(camera: Camera, scale: float) -> Camera:
    """The same camera model with its focal lengths scaled."""
    return camera if scale == 1.0 else replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)


def _injected(sensor: Any, injection: _Injection) -> tuple[Any, Int64Array]:
    """Give a sensor with its faults, and which true frame each of its frames shows."""
    wrong = injection.wrong
    match sensor:
        case LidarSensor() | RadarSensor():
            plan = injection.plan(sensor.frames.timestamps_ns)
            frames: Any = LazyFrames(plan.stated_ns, partial(_faulty_cloud, sensor.frames, plan, injection))
            return replace(sensor, frames=frames, **injection.placement(sensor)), plan.contents
        case CameraSensor():
            plan = injection.plan(sensor.images.timestamps_ns)
            images = LazyFrames(plan.stated_ns, partial(_faulty_image, sensor.images, plan, injection))
            camera, placed = _refocused(sensor.camera, wrong.focal_scale), injection.placement(sensor)
            return replace(sensor, camera=camera, images=images, video=None, **placed), plan.contents
        case ImuSensor():
            plans = {name: injection.plan(samples.timestamps_ns) for name, samples in sensor.streams.items()}
            streams = {}
            for name, plan in plans.items():
                # a rotated unit whose frame counts as the ego's; only vectors of space rotate
                values = sensor.streams[name].values[plan.contents]
                rotated = wrong.error.rotate(values) if values.shape[1] == 3 else values
                streams[name] = VectorSamples(plan.stated_ns, rotated)
            contents = max((plan.contents for plan in plans.values()), key=len, default=np.zeros(0, np.int64))
            return replace(sensor, streams=streams), contents
    plan = injection.plan(sensor.timestamps_ns)
    fixes: GnssSensor = replace(select_rows(sensor, plan.contents), timestamps_ns=plan.stated_ns, file_seconds=None)
    return fixes, plan.contents


def inject_into_scene(scene: Scene, faults: Faults) -> tuple[Scene, Mapping[Identifier, Int64Array]]:
    """Make a scene wrong; its frames are still read when asked for, each the same whenever it is.

    Returns:
        The scene, and for each sensor with faults (F,) int64: the number of the true frame that each of its frames
        shows (of an IMU: of its longest stream).

    Raises:
        OptionError: there is no such sensor or frame, or a fault means nothing for that kind of sensor.
    """
    for sensor_id, wrong in faults.sensors.items():
        sensor = scene.sensor(sensor_id)
        possible = _POSSIBLE_FAULTS.get(str(sensor.type), frozenset())
        if strange := sorted(wrong.named - possible):
            raise OptionError(
                f"faults of sensor {sensor.id!r}: {', '.join(strange)}; a sensor of type {sensor.type} can have "
                f"{', '.join(sorted(possible)) or 'none'}"
            )
    sensors: list[Sensor] = []
    true_frames: dict[Identifier, Int64Array] = {}
    for sensor in scene.sensors:
        changed = sensor
        if sensor.id in faults.sensors and str(sensor.type) in _POSSIBLE_FAULTS:
            first_ns = int(frame_times(sensor).min(initial=np.iinfo(np.int64).max))
            injection = _Injection(faults.sensors[sensor.id], first_ns, faults.seed, sensor.id)
            changed, true_frames[sensor.id] = _injected(sensor, injection)
        sensors.append(changed)
    return replace(scene, sensors=tuple(sensors)), true_frames
