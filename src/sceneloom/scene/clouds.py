"""Lidar, radar and point-map sensors and their frames.

Points are unpacked when first used and stay in their file between processes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, cast

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array, UInt8Array, UInt16Array, hold_arrays, hold_timestamp
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS, Coordinates, Identifier, PointsFrame, SensorType


class Packed(Protocol):
    """Records that hold what the fields of an object state."""

    def __len__(self) -> int:
        """Count the records."""
        ...

    def unpacked(self) -> Any:
        """Give an object of the same class that has all its fields."""
        ...


class _UnpackedWhenAsked:
    """Base of frozen dataclasses that may be made of packed records, unpacked all at once when a field is asked for."""

    # of a base class, since a dataclass with slots has none beside its fields
    __slots__ = ("_packed",)

    @classmethod
    def of_packed(cls, packed: Packed) -> Self:
        """Make an object whose fields are still packed."""
        made = object.__new__(cls)
        object.__setattr__(made, "_packed", packed)
        return made

    def packed_count(self) -> int | None:
        """Count the records of an object whose fields nobody has asked for yet; None for any other."""
        packed: Packed | None = getattr(self, "_packed", None)
        return None if packed is None else len(packed)

    def packed_records(self) -> Packed | None:
        """Give the records of an object whose fields nobody has asked for yet, to copy them; None for any other."""
        packed: Packed | None = getattr(self, "_packed", None)
        return packed

    # type checkers would take any name for a field
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Fill the fields; Python asks here only for what is not there."""
            if name not in type(self).__dataclass_fields__:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            packed = self._packed
            if packed is not None:
                made = packed.unpacked()
                for field in type(self).__dataclass_fields__:
                    object.__setattr__(self, field, getattr(made, field))
                # last: two threads may both fill the fields, but none may find them empty
                object.__setattr__(self, "_packed", None)
            return object.__getattribute__(self, name)


_Parcel = AnyArray | Callable[[], AnyArray] | None  # an array, or what gives it, or nothing


def _packed(array: AnyArray | None) -> _Parcel:
    """What to pickle for an array: the `reference(array)` of its memory, which gives it again, else the array."""
    memory: Any = array
    while isinstance(memory, np.ndarray):
        memory = memory.base
    if isinstance(memory, memoryview):
        memory = memory.obj
    reference = getattr(memory, "reference", None)
    if array is None or reference is None or array.size == 0 or not array.flags.c_contiguous:
        return array
    parcel: _Parcel = reference(array)
    return parcel


def _unpacked(parcel: _Parcel) -> AnyArray | None:
    """Give the array back; a `DataError` where its file was changed, replaced or removed."""
    return parcel() if callable(parcel) else parcel


_UNSEEN = 255  # in `camera_index`: no camera saw the point
_WHITE, _GREY = 255, 128


def grey_where_unseen(colors: UInt8Array, camera_index: UInt8Array | None) -> UInt8Array:
    """Give (N, 3) colours as clouds are written: what no camera saw is 128, 128, 128 and not white, as in the model.

    Source: DB34/T 4101-2022, table 9, as read in docs/CONVENTIONS.md, "colour of unseen points".
    """
    return _recoloured(colors, camera_index, _WHITE, _GREY)


def white_where_unseen(colors: UInt8Array, camera_index: UInt8Array | None) -> UInt8Array:
    """Give (N, 3) colours of a cloud that was written by `grey_where_unseen` as the model has them."""
    return _recoloured(colors, camera_index, _GREY, _WHITE)


def _recoloured(colors: UInt8Array, camera_index: UInt8Array | None, old: int, new: int) -> UInt8Array:
    """Replace one level of grey where no camera saw the point; another colour there comes from elsewhere."""
    if camera_index is None:
        return colors
    unseen = (camera_index == _UNSEEN) & (colors == old).all(axis=1)
    if not unseen.any():
        return colors
    replaced = colors.copy()
    replaced[unseen] = new
    return replaced


@dataclass(frozen=True, slots=True, eq=False)
class LidarPoints(_UnpackedWhenAsked):
    """The returns of one lidar frame.

    A reader may make them by `of_packed`: their number is known at once, their arrays are made at the first use.

    Attributes:
        positions: (N, 3) float32 [m], in the sensor's `points_frame`.
        intensities: (N,) uint8, or None where the sensor gives none.
        colors: (N, 3) uint8, red green blue, or None; 255, 255, 255 for a point that no camera saw.
        timestamps_ns: (N,) int64 [ns], time of each return on the scene's clock, or None.
        rings: (N,) uint16, index of the laser, or None.
        camera_index: (N,) uint8, which camera coloured the point (index among the scene's cameras), 255 for none.
        extras: further arrays of the file, by name.
    """

    positions: Float32Array
    intensities: UInt8Array | None = None
    colors: UInt8Array | None = None
    timestamps_ns: Int64Array | None = None
    rings: UInt16Array | None = None
    camera_index: UInt8Array | None = None
    extras: Mapping[str, AnyArray] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(
            self,
            "points",
            {
                "positions": (np.float32, "N", 3),
                "intensities?": (np.uint8, "N"),
                "colors?": (np.uint8, "N", 3),
                "timestamps_ns?": (np.int64, "N"),
                "rings?": (np.uint16, "N"),
                "camera_index?": (np.uint8, "N"),
            },
        )

    def __len__(self) -> int:
        packed_count = self.packed_count()
        return len(self.positions) if packed_count is None else packed_count


@dataclass(frozen=True, slots=True, eq=False)
class LidarFrame:
    """One sweep of a lidar.

    Attributes:
        timestamp_ns: start of the sweep [ns].
        points: the returns.
        extras: further fields of the file, by name.
    """

    timestamp_ns: int
    points: LidarPoints
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        if type(self.timestamp_ns) is not int or self.timestamp_ns.bit_length() > 63:
            hold_timestamp(self, "frame.timestamp_ns")

    @property
    def point_times_ns(self) -> Int64Array:
        """Times of the points, (N,) int64 [ns]: the sweep's start of those without times of their own."""
        times = self.points.timestamps_ns
        return np.full(len(self.points), self.timestamp_ns, np.int64) if times is None else times

    @property
    def reference_ns(self) -> int:
        """The time by which the sweep is paired with images: the median of its point times.

        It is the sweep's start where the points have no times, or all the same one, which does not say when
        they were measured.
        """
        times = self.points.timestamps_ns
        if times is None or len(times) == 0 or times.min() == times.max():
            return self.timestamp_ns
        middle = len(times) // 2
        return int(np.partition(times, middle)[middle])


@dataclass(frozen=True, slots=True, eq=False)
class LidarSensor:
    """A sensor that measures points in space.

    Attributes:
        id: unique among the scene's sensors.
        frames: the sweeps in time order, read when asked for.
        poses: sensor to `coordinates` frame, or None where no trajectory is known.
        mount: `ego_from_sensor`, where the source knows a rigid mounting.
        coordinates: the frame that `poses` lead into.
        points_frame: the frame of the points' positions.
        model: the maker's name for the device or its data, or None.
        parent_id: id of the parent sensor, or None.
        extras: further fields of the file, by name.
    """

    id: Identifier
    frames: LazyFrames[LidarFrame]
    poses: Poses | None = None
    mount: RigidTransform | None = None
    coordinates: Coordinates = Coordinates.WORLD
    points_frame: PointsFrame = PointsFrame.SENSOR
    model: str | None = None
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[SensorType] = SensorType.LIDAR


@dataclass(frozen=True, slots=True, eq=False)
class RadarPoints:
    """The returns of one radar frame.

    Attributes:
        positions: (N, 3) float32 [m].
        directions: (N, 3) float32 unit vectors, or None.
        lengths: (N,) float32 [m/s] along `directions`, NaN where they are not known, or None.
        timestamps_ns: (N,) int64 [ns], or None.
        extras: further arrays of the file, by name.
    """

    positions: Float32Array
    directions: Float32Array | None = None
    lengths: Float32Array | None = None
    timestamps_ns: Int64Array | None = None
    extras: Mapping[str, AnyArray] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(
            self,
            "points",
            {
                "positions": (np.float32, "N", 3),
                "directions?": (np.float32, "N", 3),
                "lengths?": (np.float32, "N"),
                "timestamps_ns?": (np.int64, "N"),
            },
        )

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, slots=True, eq=False)
class RadarFrame:
    """One measurement cycle of a radar; fields as in `LidarFrame`."""

    timestamp_ns: int
    points: RadarPoints
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_timestamp(self, "frame.timestamp_ns")


@dataclass(frozen=True, slots=True, eq=False)
class RadarSensor:
    """A sensor that measures points with radial speeds; fields as in `LidarSensor`."""

    id: Identifier
    frames: LazyFrames[RadarFrame]
    poses: Poses | None = None
    mount: RigidTransform | None = None
    coordinates: Coordinates = Coordinates.WORLD
    points_frame: PointsFrame = PointsFrame.SENSOR
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[SensorType] = SensorType.RADAR


@dataclass(frozen=True, slots=True, eq=False)
class PointsSensor:
    """A cloud without time, such as a map.

    Attributes:
        id: unique among the scene's sensors.
        positions: (N, 3) float32 [m], world frame.
        colors: (N, 3) uint8, or None.
        parent_id: id of the parent sensor, or None.
        extras: further fields of the file, by name.
    """

    id: Identifier
    positions: Float32Array
    colors: UInt8Array | None = None
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(self, "points", {"positions": (np.float32, "N", 3), "colors?": (np.uint8, "N", 3)})

    def __reduce__(self) -> tuple[Any, ...]:
        arrays = _packed(self.positions), _packed(self.colors)
        return _restored_map, (self.id, *arrays, self.parent_id, self.extras)

    type: ClassVar[SensorType] = SensorType.POINTS


def _restored_map(
    sensor_id: Identifier, positions: _Parcel, colors: _Parcel, parent_id: Identifier | None, extras: Mapping[str, Any]
) -> PointsSensor:
    return PointsSensor(sensor_id, cast("Float32Array", _unpacked(positions)), _unpacked(colors), parent_id, extras)
