"""What can be injected in a drive so that its scene is wrong while its truth stays right."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.types import Identifier, SensorType

Interval = tuple[int, int]
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
        swapped: pairs of frame numbers that come in each other's location, timestamps included.
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
    drop_outs: tuple[Interval, ...] = ()
    blind: tuple[Interval, ...] = ()
    stuck: tuple[Interval, ...] = ()
    swapped: tuple[tuple[int, int], ...] = ()
    point_times: PointTimes = PointTimes.RIGHT
    intensity_scale: float = 1.0
    focal_scale: float = 1.0

    def __post_init__(self) -> None:
        for name, low, high in _BOUNDS:
            values = np.atleast_1d(getattr(self, name))
            if not ((values >= low) & (values <= high)).all():
                raise OptionError(f"faults.{name}: {getattr(self, name)}; expected {low:g} to {high:g}")
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
        return RigidTransform.from_quaternion(
            np.array(self.shift, np.float64), _quaternion(self.rotation_deg)
        )

    @property
    def named(self) -> frozenset[str]:
        """Names of the faults that are there, as those of the fields."""
        return frozenset(
            name for name in self.__dataclass_fields__ if getattr(self, name) != getattr(_NOTHING_WRONG, name)
        )


_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("rotation_deg", -180.0, 180.0),
    ("shift", -1e3, 1e3),
    ("time_offset_ns", -(10**15), 10**15),
    ("clock_skew_ppm", -1e5, 1e5),
    ("lost_share", 0.0, 1.0),
    ("intensity_scale", 0.0, 1e3),
    ("focal_scale", 0.1, 10.0),
)
_NOTHING_WRONG = SensorFaults()


def _quaternion(rotation_deg: tuple[float, float, float]) -> Float64Array:
    """The unit quaternion, scalar last, of a rotation vector [deg]."""
    vector = np.radians(np.array(rotation_deg, np.float64))
    half = float(np.linalg.norm(vector)) / 2
    scale = 0.5 * np.sinc(half / np.pi)  # sin(half) / (2 half), also for no rotation
    return np.array([*(scale * vector), math.cos(half)])


_STREAM_FAULTS = frozenset(
    {
        "time_offset_ns",
        "clock_skew_ppm",
        "lost_share",
        "lost_frames",
        "drop_outs",
        "stuck",
        "swapped",
    }
)
_CLOUD_FAULTS = _STREAM_FAULTS | {"rotation_deg", "shift", "blind", "point_times"}

POSSIBLE_FAULTS: Mapping[str, frozenset[str]] = MappingProxyType(
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
