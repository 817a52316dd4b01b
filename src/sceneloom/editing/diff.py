"""Differences between two scenes, field by field, with tolerances."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum, StrEnum
from io import BytesIO
from math import prod
from types import MappingProxyType
from typing import Any, BinaryIO, NamedTuple

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.geometry.rotations import angle_between, normalise_quaternion, quaternion_from_matrix
from sceneloom.scene.annotations import CuboidAnnotation, CuboidPath, PointPath, locations_of
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_poses, point_at
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, VideoContent
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Key, Progress, key_of


@dataclass(frozen=True, slots=True)
class _Tolerances:
    """Largest differences that count as none.

    Attributes:
        metres: of locations, sizes and translations.
        degrees: of rotations.
        nanoseconds: of timestamps; frames so near in time are the same frame.
        pixels: of what is drawn into images.
        other_timestamps: whether a path may be reported at other timestamps, if it is the same way within the
            tolerances.

    Raises:
        OptionError: one is negative or not a number.
    """

    metres: float = 0.0
    degrees: float = 0.0
    nanoseconds: float = 0.0
    pixels: float = 0.0
    other_timestamps: bool = False

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not 0.0 <= value < float("inf"):
                raise OptionError(f"tolerance {value} {each.name}; expected a number from 0 on")


_METRES, _DEGREES, _NANOSECONDS, _PIXELS, _EXACT = "m", "deg", "ns", "px", ""

_FIELDS: Mapping[tuple[str, str], str] = MappingProxyType(
    {
        ("Poses", "positions"): _METRES,
        ("Poses", "quaternions_xyzw"): _DEGREES,
        ("Trajectory", "positions"): _METRES,
        ("Trajectory", "quaternions_xyzw"): _DEGREES,
        ("LidarPoints", "positions"): _METRES,
        ("RadarPoints", "positions"): _METRES,
        ("PointsSensor", "positions"): _METRES,
        ("PointPath", "values"): _METRES,
        ("PointProjection", "positions"): _METRES,
        ("PointProjection", "points"): _PIXELS,
        ("Projection", "boxes"): _PIXELS,
        ("BoxPath", "values"): _PIXELS,
        ("RigidTransform", "translation"): _METRES,
        ("RigidTransform", "rotation"): _DEGREES,
    }
)
"""Class and field of everything that has a tolerance, besides timestamps (`_ns`), cuboids and vertices."""


def _unit_of(owner: str, name: str) -> str:
    """What a field of a class is counted in; "" where it has to be equal."""
    return _NANOSECONDS if name.endswith("_ns") else _FIELDS.get((owner, name), _EXACT)


def _limit_of(tolerances: _Tolerances, unit: str) -> float:
    """The tolerance of a unit."""
    limits = {
        _METRES: tolerances.metres,
        _DEGREES: tolerances.degrees,
        _NANOSECONDS: tolerances.nanoseconds,
        _PIXELS: tolerances.pixels,
    }
    return limits.get(unit, 0.0)


class Change(StrEnum):
    """What happened on the way from the first scene to the second."""

    ADDED = "added"
    REMOVED = "removed"
    CHANGED = "changed"


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """One field that differs; of frames all of a sensor together.

    Attributes:
        path: where, in the words of the model; sensors and annotations by id (`sensors['lidar'].frames[].points`).
        change: what happened.
        message: how it differs.
        amount: by how much, the largest of all that differ; None where that is no number.
        unit: of the amount.
        count: in how many frames.
        frame: which frame of the first scene differs most, or first; None for what is in no frame.
    """

    path: str
    change: Change
    message: str
    amount: float | None = None
    unit: str = ""
    count: int = 1
    frame: int | None = None


class SceneDifferences(msgspec.Struct, frozen=True, kw_only=True):
    """The differences of two scenes.

    Attributes:
        differences: all of them, in the order of the fields.
        not_compared: what could not be compared, or only at a price that was not asked for.
    """

    differences: tuple[Difference, ...]
    not_compared: tuple[str, ...] = ()

    @property
    def equal(self) -> bool:
        """Whether nothing differs beyond the tolerances."""
        return not self.differences


@dataclass(slots=True)
class _Findings:
    """Gathers differences; those of the frames of one sensor become one."""

    found: dict[tuple[str, Change], Difference] = field(default_factory=dict)
    not_compared: dict[str, None] = field(default_factory=dict)

    def add(
        self,
        path: str,
        change: Change,
        message: str,
        *,
        amount: float | None = None,
        unit: str = "",
        frame: int | None = None,
    ) -> None:
        """Add a difference; of several in frames the largest one is reported."""
        key = (path, change)
        made = Difference(path=path, change=change, message=message, amount=amount, unit=unit, frame=frame)
        before = self.found.get(key)
        if before is not None:
            largest = made if (amount or 0.0) > (before.amount or 0.0) else before
            made = msgspec.structs.replace(largest, count=before.count + 1)
        self.found[key] = made

    def pass_over(self, what: str) -> None:
        """Report that something was not compared."""
        self.not_compared[what] = None

    def reported(self) -> SceneDifferences:
        """All that was found."""
        return SceneDifferences(differences=tuple(self.found.values()), not_compared=tuple(self.not_compared))


class Locations(NamedTuple):
    """A trajectory at some times: locations or sizes (M, G, 3) [m], and quaternions (M, 4) where it rotates."""

    straight: Float64Array
    quaternions_xyzw: Float64Array | None


def _cuboid(path: CuboidPath, times_ns: Int64Array, angles: CuboidAngles) -> Locations:
    poses = cuboid_poses(CuboidAnnotation("", path), times_ns, angles=angles)
    return Locations(np.stack([poses.centers_world, poses.sizes_lwh], axis=1), poses.quaternions_xyzw)


def _poses(path: Poses, times_ns: Int64Array, _: CuboidAngles) -> Locations:
    poses = path.interpolate(times_ns)
    return Locations(poses.positions[:, None], poses.quaternions_xyzw)


def _trajectory(trajectory: Trajectory, times_ns: Int64Array, angles: CuboidAngles) -> Locations:
    if trajectory.quaternions_xyzw is not None:
        return _poses(trajectory.poses, times_ns, angles)
    locations, _ = point_at(PointPath(trajectory.timestamps_ns, trajectory.positions), times_ns)
    return Locations(locations[:, None], None)


def _point(path: PointPath, times_ns: Int64Array, _: CuboidAngles) -> Locations:
    locations, _there = point_at(path, times_ns)
    return Locations(locations_of(locations), None)


_TRAJECTORIES: Mapping[str, tuple[Callable[[Any, Int64Array, CuboidAngles], Locations], tuple[str, ...]]] = (
    MappingProxyType(
        {
            "CuboidPath": (_cuboid, ("timestamps_ns", "values")),
            "Poses": (_poses, ("timestamps_ns", "positions", "quaternions_xyzw")),
            "Trajectory": (
                _trajectory,
                ("timestamps_ns", "positions", "quaternions_xyzw", "file_seconds", "covariances"),
            ),
            "PointPath": (_point, ("timestamps_ns", "values")),
        }
    )
)
"""How a path of each class is asked for times, and the fields that make the trajectory."""


def _is_trajectory(value: Any) -> bool:
    """Whether a value is a path that can be asked for any time: with timestamps, in order, and whole points."""
    if type(value).__name__ not in _TRAJECTORIES or len(value.timestamps_ns) == 0:
        return False
    whole = not isinstance(value, PointPath) or value.values.shape[1] % 3 == 0
    return whole and bool((np.diff(value.timestamps_ns) > 0).all())


def _trajectories_apart(
    a: Any, b: Any, angles: tuple[CuboidAngles, CuboidAngles]
) -> tuple[float, float] | None:
    """Give how far two paths of one class are apart [m] and [deg], at the timestamps of both.

    None if their times differ.

    Between timestamps both go straight, so that locations are farthest apart at a timestamp of one of them.
    """
    first, second = a.timestamps_ns, b.timestamps_ns
    if (first[0], first[-1]) != (second[0], second[-1]) or getattr(a, "static", 0) != getattr(b, "static", 0):
        return None
    times = np.union1d(first, second)
    at = _TRAJECTORIES[type(a).__name__][0]
    here, there = at(a, times, angles[0]), at(b, times, angles[1])
    if here.straight.shape != there.straight.shape:
        return None
    metres = float(np.nan_to_num(np.linalg.norm(here.straight - there.straight, axis=2), nan=np.inf).max())
    if here.quaternions_xyzw is None or there.quaternions_xyzw is None:
        same = here.quaternions_xyzw is there.quaternions_xyzw
        return metres, 0.0 if same else np.inf
    rotations = np.degrees(angle_between(here.quaternions_xyzw, there.quaternions_xyzw))
    return metres, float(np.nan_to_num(rotations, nan=np.inf).max())


def apart(a: AnyArray, b: AnyArray, unit: str) -> Float64Array | None:
    """Give by how much the rows of two arrays of one shape differ; None where that is no number.

    NaN and NaN are equal, NaN and a number infinitely far apart. Rows of locations are apart by their distance, those
    of quaternions and rotation matrices by the angle between them, all others by their largest difference of a number.

    Args:
        a: (N, …).
        b: the same shape.
        unit: what they are counted in.

    Returns:
        (N,) float64.
    """
    if not (_is_number(a) and _is_number(b)):
        return None
    if a.ndim == 0:
        a, b = a[None], b[None]
    if unit == _DEGREES:
        return _rotated(a, b)
    difference = _difference(a, b)
    columns = prod(difference.shape[1:])
    if unit == _METRES and difference.ndim > 1 and difference.shape[-1] % 3 == 0:
        locations = difference.reshape(len(difference), columns // 3, 3)
        distances: Float64Array = np.linalg.norm(locations, axis=2).max(axis=1, initial=0.0)
        return distances
    largest: Float64Array = np.abs(difference).reshape(len(difference), columns).max(axis=1, initial=0.0)
    return largest


def _is_number(array: AnyArray) -> bool:
    return array.dtype.kind in "biuf"


def _difference(a: AnyArray, b: AnyArray) -> Float64Array:
    if a.dtype.kind in "iu" and b.dtype.kind in "iu" and max(a.itemsize, b.itemsize) == 8:
        # differences of timestamps since 1970 are exact in integers, and not in float64
        low, high = np.minimum(a, b), np.maximum(a, b)
        return (high - low).astype(np.float64)
    first, second = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(invalid="ignore"):
        difference = first - second
    difference[(first == second) | (np.isnan(first) & np.isnan(second))] = 0.0
    difference[np.isnan(difference)] = np.inf
    return difference


def _rotated(a: AnyArray, b: AnyArray) -> Float64Array:
    if a.shape[-2:] == (3, 3):
        a, b = quaternion_from_matrix(a)[None], quaternion_from_matrix(b)[None]
    known = np.isfinite(a).all(axis=-1) & np.isfinite(b).all(axis=-1)
    usable = known & (np.abs(a).max(axis=-1) > 0) & (np.abs(b).max(axis=-1) > 0)
    angles = np.where(_difference(a, b).any(axis=-1), np.inf, 0.0)
    rotations = angle_between(normalise_quaternion(a[usable]), normalise_quaternion(b[usable]))
    angles[usable] = np.where(angles[usable] == 0.0, 0.0, np.degrees(rotations))
    return angles


_SHOWN = 60
"""Characters of a value that are reported."""

_CUBOIDS = {("CuboidPath", "values"), ("Projection", "cuboids"), ("Activation", "cuboids")}
"""Class and field of cuboid rows, whose angles are compared as rotates."""

_KEYS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "AttributePath": ("name", "sensor_id", "point_index"),
        "Activation": ("sensor_id",),
        "Projection": ("sensor_id",),
        "PointProjection": ("sensor_id",),
        "LabeledPoints": ("sensor_id", "sensor_frame"),
    }
)
"""By which fields the members of a list are distinguished, instead of their numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """Compares values and reports what it finds.

    Attributes:
        findings: where differences are reported.
        tolerances: how much may differ.
        angles: how the angles of cuboids are meant in the two scenes.
        frame: number of the frame that is compared, or None.
    """

    findings: _Findings
    tolerances: _Tolerances
    angles: tuple[CuboidAngles, CuboidAngles] = (CuboidAngles(), CuboidAngles())
    frame: int | None = None

    def add(
        self, path: str, change: Change, message: str, amount: float | None = None, unit: str = ""
    ) -> None:
        """Report a difference."""
        self.findings.add(path, change, message, amount=amount, unit=unit, frame=self.frame)

    def values(self, path: str, a: Any, b: Any, *, owner: str = "", name: str = "") -> None:
        """Compare two values of the field `name` of a class."""
        if a is b:
            return
        if a is None or b is None:
            change = Change.ADDED if a is None else Change.REMOVED
            self.add(path, change, _shown(b if a is None else a))
            return
        compare = next((compare for fits, compare in _KINDS if fits(a) and fits(b)), None)
        if compare is None:
            self.add(path, Change.CHANGED, f"{_shown(a)}; then {_shown(b)}")
            return
        compare(self, path, a, b, owner, name)

    def records(self, path: str, a: Any, b: Any, *, skipped: Iterable[str] = ()) -> None:
        """Compare two records field by field."""
        if type(a) is not type(b):
            self.add(path, Change.CHANGED, f"{type(a).__name__}; then {type(b).__name__}")
            return
        owner = type(a).__name__
        passed = {*skipped, *self._trajectories(path, a, b)}
        for each in fields(a):
            if each.name not in passed:
                inner = f"{path}.{each.name}" if path else each.name
                self.values(inner, getattr(a, each.name), getattr(b, each.name), owner=owner, name=each.name)

    def _trajectories(self, path: str, a: Any, b: Any) -> tuple[str, ...]:
        """Compare two paths reported at other timestamps as ways; gives the fields that this settles."""
        if not (_is_trajectory(a) and _is_trajectory(b)):
            return ()
        count, other = len(a.timestamps_ns), len(b.timestamps_ns)
        if count == other:
            away = np.abs(a.timestamps_ns - b.timestamps_ns)
            if away.max() <= self.tolerances.nanoseconds:
                return ()
        found = _trajectories_apart(a, b, self.angles)
        if found is None:
            return ()
        metres, degrees = found
        within = metres <= self.tolerances.metres and degrees <= self.tolerances.degrees
        if not (self.tolerances.other_timestamps and within):
            message = (
                f"{count} timestamps; then {other}; as ways up to {metres:.3g} m and {degrees:.3g} deg apart"
            )
            self.add(path, Change.CHANGED, message, metres, _METRES)
        return _TRAJECTORIES[type(a).__name__][1]

    def record(self, path: str, a: Any, b: Any, _owner: str, _name: str) -> None:
        """Compare two records field by field."""
        self.records(path, a, b)

    def mapping(self, path: str, a: Mapping[Any, Any], b: Mapping[Any, Any], _owner: str, _name: str) -> None:
        """Compare two mappings key by key."""
        self._members(
            path,
            {repr(key): value for key, value in a.items()},
            {repr(key): value for key, value in b.items()},
        )

    def _members(self, path: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> None:
        for key, value in a.items():
            if key not in b:
                self.add(f"{path}[{key}]", Change.REMOVED, _shown(value))
        for key, value in b.items():
            if key in a:
                self.values(f"{path}[{key}]", a[key], value)
            else:
                self.add(f"{path}[{key}]", Change.ADDED, _shown(value))

    def sequence(self, path: str, a: Sequence[Any], b: Sequence[Any], owner: str, name: str) -> None:
        """Compare two lists, member by member or by what reports their members apart."""
        keyed = _keyed(a), _keyed(b)
        if keyed[0] is not None and keyed[1] is not None:
            self._members(path, keyed[0], keyed[1])
            return
        if len(a) != len(b):
            self.add(path, Change.CHANGED, f"{len(a)} values; then {len(b)}", abs(len(a) - len(b)))
        for k, (first, second) in enumerate(zip(a, b, strict=False)):
            self.values(f"{path}[{k}]", first, second, owner=owner, name=name)

    def arrays(self, path: str, a: AnyArray, b: AnyArray, owner: str, name: str) -> None:
        """Compare two arrays: kind and shape, then row by row."""
        if a.dtype != b.dtype or a.shape != b.shape:
            self.add(
                path,
                Change.CHANGED,
                f"{_form(a)}; then {_form(b)}",
                abs(len(a) - len(b)) if a.ndim and b.ndim else None,
            )
            return
        if (owner, name) in _CUBOIDS:
            self._cuboids(path, a, b)
            return
        unit = _unit_of(owner, name)
        if owner == "VertexPath" and a.ndim == 2:
            unit = _METRES if a.shape[1] == 3 else _PIXELS
        self._rows(path, a, b, unit)

    def _rows(self, path: str, a: AnyArray, b: AnyArray, unit: str) -> None:
        away = apart(a, b, unit)
        if away is None:
            if not np.array_equal(a, b):
                self.add(path, Change.CHANGED, f"{_form(a)} of other values")
            return
        wrong = np.flatnonzero(away > _limit_of(self.tolerances, unit))
        if len(wrong):
            worst = int(np.argmax(away))
            rows = f"{len(wrong)} of {len(away)} rows" if len(away) > 1 else "the values"
            self.add(path, Change.CHANGED, f"{rows} differ, row {worst} most", float(away[worst]), unit)

    def _cuboids(self, path: str, a: AnyArray, b: AnyArray) -> None:
        """Sizes and locations in metres, angles as rotates, each by the reading of its own scene."""
        self._rows(f"{path}.size", a[:, :3], b[:, :3], _METRES)
        self._rows(f"{path}.position", a[:, 3:6], b[:, 3:6], _METRES)
        if self.angles[0] == self.angles[1] and np.array_equal(a[:, 6:], b[:, 6:], equal_nan=True):
            return
        first, second = self.angles[0].quaternions(a[:, 6:]), self.angles[1].quaternions(b[:, 6:])
        self._rows(f"{path}.rotation", first, second, _DEGREES)

    def number(self, path: str, a: float, b: float, owner: str, name: str) -> None:
        """Compare two numbers."""
        unit = _unit_of(owner, name)
        away = abs(a - b)
        if a == b or (math.isnan(a) and math.isnan(b)) or away <= _limit_of(self.tolerances, unit):
            return
        self.add(path, Change.CHANGED, f"{a!r}; then {b!r}", float(away), unit)

    def plain(self, path: str, a: Any, b: Any, _owner: str, _name: str) -> None:
        """Compare two values that are equal or not."""
        if a != b:
            self.add(path, Change.CHANGED, f"{_shown(a)}; then {_shown(b)}")


def _values_is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_text(value: Any) -> bool:
    return isinstance(value, str | bytes | bool)


def _is_record(value: Any) -> bool:
    return is_dataclass(value) and not isinstance(value, type)


_KINDS: tuple[tuple[Callable[[Any], bool], Callable[..., None]], ...] = (
    (lambda value: isinstance(value, np.ndarray), _Comparison.arrays),
    (_is_text, _Comparison.plain),
    (_values_is_number, _Comparison.number),
    (lambda value: isinstance(value, Mapping), _Comparison.mapping),
    (lambda value: isinstance(value, list | tuple), _Comparison.sequence),
    (_is_record, _Comparison.record),
    (callable, lambda *_: None),
)
"""How two values of one kind are compared; functions, which open and decode, are not."""


def _keyed(members: Sequence[Any]) -> dict[str, Any] | None:
    """The members by what reports them apart; None where nothing does, or not all of them."""
    names = {type(member).__name__ for member in members}
    if not members:
        return {}
    if len(names) != 1 or not names <= _KEYS.keys():
        return None
    keys = _KEYS[names.pop()]
    found = {
        ", ".join(repr(value) for key in keys if (value := getattr(member, key)) is not None): member
        for member in members
    }
    return found if len(found) == len(members) else None


def _form(array: AnyArray) -> str:
    return f"{array.dtype.name} {'x'.join(map(str, array.shape)) or 'number'}"


def _shown(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, np.ndarray):
        return f"an array of {_form(value)}"
    if _is_record(value):
        return type(value).__name__
    if isinstance(value, Mapping):
        return f"a mapping of {len(value)}"
    text = repr(value.value if isinstance(value, Enum) else value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


_PIECE = 1 << 20


def pairs(
    first_ns: Int64Array, second_ns: Int64Array, tolerance_ns: float
) -> Iterator[tuple[int | None, int | None]]:
    """Pair frames by their timestamps (N,) and (M,) [ns], each with the first one near enough.

    None beside a lone one.
    """
    k = n = 0
    while k < len(first_ns) or n < len(second_ns):
        if k == len(first_ns):
            yield None, n
            n += 1
        elif n == len(second_ns):
            yield k, None
            k += 1
        else:
            away = int(second_ns[n]) - int(first_ns[k])
            if abs(away) <= tolerance_ns:
                yield k, n
                k, n = k + 1, n + 1
            elif away > 0:
                yield k, None
                k += 1
            else:
                yield None, n
                n += 1


def _compare_frames(
    comparison: _Comparison,
    path: str,
    first: LazyFrames[Any],
    second: LazyFrames[Any],
    compare: Callable[[_Comparison, str, Any, Any], None],
    on_frame: Callable[[], None],
) -> None:
    """Compare frames of the same time, read one pair after the other.

    Args:
        comparison: compares and reports.
        path: of the frames.
        first, second: the frames.
        compare: compares two of them.
        on_frame: reported after each.
    """
    tolerance_ns = comparison.tolerances.nanoseconds
    for k, n in pairs(first.timestamps_ns, second.timestamps_ns, tolerance_ns):
        if k is None:
            timestamp = int(second.timestamps_ns[n or 0])
            replace(comparison, frame=n).add(f"{path}[]", Change.ADDED, f"at {timestamp} ns")
        elif n is None:
            timestamp = int(first.timestamps_ns[k])
            replace(comparison, frame=k).add(f"{path}[]", Change.REMOVED, f"at {timestamp} ns")
        else:
            compare(replace(comparison, frame=k), f"{path}[]", first[k], second[n])
        on_frame()


def _compare_images(
    comparison: _Comparison,
    path: str,
    first: CameraSensor,
    second: CameraSensor,
    on_frame: Callable[[], None],
    *,
    pixels: bool,
) -> None:
    """Compare images of the same time: their camera models, and their files byte by byte.

    Images without a file of their own are those of a video, which is compared as one, or have to be decoded.

    Args:
        pixels: decode images whose bytes differ or are not there, and report how far their pixels differ.
    """
    videos = _videos(comparison, path, first, second, reported=not pixels)

    def compare(inner: _Comparison, location: str, a: CameraImage, b: CameraImage) -> None:
        inner.records(location, a, b, skipped=("decode", "encoded"))
        equal = videos if a.encoded is None and b.encoded is None else _same_bytes(a, b)
        if equal:
            return
        if pixels:
            _compare_pixels(inner, location, a, b)
        elif equal is None:
            inner.findings.pass_over(
                f"{path}[]: images without files of their own; decode them to compare them"
            )
        elif videos is None:
            inner.add(f"{location}.content", Change.CHANGED, "other bytes")

    _compare_frames(comparison, path, first.images, second.images, compare, on_frame)


def _compare_depth_images(
    comparison: _Comparison,
    path: str,
    first: DepthCameraSensor,
    second: DepthCameraSensor,
    on_frame: Callable[[], None],
    *,
    pixels: bool,
) -> None:
    """Compare depth images of the same time: their camera models, and their videos, else their depths where asked for.

    Args:
        pixels: decode images that no equal videos hold, and report how far their depths differ.
    """
    videos = _videos(comparison, path, first, second, reported=not pixels)

    def compare(inner: _Comparison, location: str, a: DepthFrame, b: DepthFrame) -> None:
        inner.records(location, a, b, skipped=("decode",))
        if videos and a.scale == b.scale:
            return
        if pixels:
            _compare_depths(inner, location, a, b)
        else:
            inner.findings.pass_over(f"{path}[]: depth images; decode them to compare them")

    _compare_frames(comparison, path, first.frames, second.frames, compare, on_frame)


def _compare_depths(comparison: _Comparison, path: str, a: DepthFrame, b: DepthFrame) -> None:
    first, second = a.depth, b.depth
    if first.shape != second.shape:
        message = f"{first.shape[1]}x{first.shape[0]} pixels; then {second.shape[1]}x{second.shape[0]}"
        comparison.add(f"{path}.depth", Change.CHANGED, message)
        return
    away = np.abs(first.astype(np.float64) - second)
    if away.any():
        message = f"the mean difference of a depth, {float(away.max()):g} m at most"
        comparison.add(f"{path}.depth", Change.CHANGED, message, float(away.mean()), "m")


def _same_bytes(a: CameraImage, b: CameraImage) -> bool | None:
    """Whether the files of two images are equal; None where one has none."""
    if a.encoded is None or b.encoded is None:
        return None
    return a.encoded() == b.encoded()


def _videos(
    comparison: _Comparison,
    path: str,
    first: CameraSensor | DepthCameraSensor,
    second: CameraSensor | DepthCameraSensor,
    *,
    reported: bool,
) -> bool | None:
    """Whether the videos behind two cameras are equal, `reported` where they are not; None where there are not two."""
    a, b = first.video, second.video
    if a is None or b is None:
        return None
    if a.frame_indices != b.frame_indices:
        return None
    equal = _same_files(a, b)
    if reported and not equal:
        comparison.add(f"{path}.video", Change.CHANGED, f"{a.codec}; then {b.codec} of other bytes")
    return equal


def _same_files(a: VideoContent, b: VideoContent) -> bool:
    with a.open() as first, b.open() as second:
        return all(piece == other for piece, other in _chunks(first, second))


def _chunks(first: BinaryIO | BytesIO, second: BinaryIO | BytesIO) -> Iterator[tuple[bytes, bytes]]:
    while True:
        piece, other = first.read(_PIECE), second.read(_PIECE)
        yield piece, other
        if not piece or not other:
            return


def _compare_pixels(comparison: _Comparison, path: str, a: CameraImage, b: CameraImage) -> None:
    first, second = a.rgb, b.rgb
    if first.shape != second.shape:
        message = f"{first.shape[1]}x{first.shape[0]} pixels; then {second.shape[1]}x{second.shape[0]}"
        comparison.add(f"{path}.rgb", Change.CHANGED, message)
        return
    away = np.abs(first.astype(np.int16) - second.astype(np.int16))
    if away.any():
        message = f"the mean difference of a channel, {int(away.max())} at most"
        comparison.add(f"{path}.rgb", Change.CHANGED, message, float(away.mean()), "of 255")


_FRAMED = (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def diff_scenes(
    first: Scene,
    second: Scene,
    *,
    tolerance_m: float = 0.0,
    tolerance_deg: float = 0.0,
    tolerance_ns: float = 0.0,
    tolerance_px: float = 0.0,
    other_timestamps: bool = False,
    pixels: bool = False,
    progress: Progress | None = None,
) -> SceneDifferences:
    """Report what differs between two scenes: what was added, removed and changed from the first to the second.

    Sensors and annotations are the same if their ids are, frames if their timestamps are. Where a scene comes from and
    what was remarked on reading it does not count. Frames are read in pairs and not kept.

    Args:
        first, second: the scenes.
        tolerance_m: largest distance of locations, sizes and translations that counts as none [m].
        tolerance_deg: largest rotate [deg]; quaternions of one rotation are equal whatever their sign, and so are
            cuboids whose angles are reported in another unit or order.
        tolerance_ns: largest difference of timestamps [ns].
        tolerance_px: largest difference of what is drawn into images [px].
        other_timestamps: let a path be reported at other timestamps, if at those of both it is the same within the
            tolerances.
        pixels: decode images whose bytes differ or are not there, and compare their pixels.
        progress: reported after each frame how many are done, and of how many.

    Raises:
        OptionError: one is no scene, or a tolerance is negative or not a number.
        DataError: a frame cannot be read.
    """
    for scene in (first, second):
        if not isinstance(scene, Scene):
            raise OptionError(f"{scene!r}; expected a scene: `sceneloom.open` gives that of a file")
    findings = _Findings()
    comparison = _Comparison(
        findings,
        _Tolerances(tolerance_m, tolerance_deg, tolerance_ns, tolerance_px, other_timestamps),
        (CuboidAngles.of(first), CuboidAngles.of(second)),
    )
    steps = _Steps(max(_frames(first), _frames(second)), progress)
    for name in ("time_offset_ns", "metadata", "attributes"):
        comparison.values(name, getattr(first, name), getattr(second, name), owner="Scene", name=name)
    comparison.values("extras", _extras(first), _extras(second), owner="Scene", name="extras")
    comparison.values("trajectories", first.trajectories, second.trajectories)

    def compare_sensors(path: str, a: Sensor, b: Sensor) -> None:
        _compare_sensor(comparison, path, a, b, steps.one, pixels=pixels)

    _compare_members(comparison, "sensors", first.sensors, second.sensors, compare_sensors)
    _compare_members(comparison, "annotations", first.annotations, second.annotations, comparison.records)
    return findings.reported()


def _extras(scene: Scene) -> Mapping[str, Any]:
    """The further fields of a scene, with the unit of times that holds where it is not stated."""
    return {"time_unit": "microseconds", **scene.extras}


@dataclass(slots=True)
class _Steps:
    total: int
    progress: Progress | None
    done: int = 0

    def one(self) -> None:
        """Count a frame."""
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, max(self.total, self.done))


def _frames(scene: Scene) -> int:
    return sum(len(frame_times(sensor)) for sensor in scene.sensors if isinstance(sensor, _FRAMED))


def _compare_members(
    comparison: _Comparison,
    path: str,
    first: Iterable[Any],
    second: Iterable[Any],
    compare: Callable[[str, Any, Any], None],
) -> None:
    """Compare what has ids: what only one has, what both have, and in which order."""
    a: Mapping[Key, Any] = {key_of(member.id): member for member in first}
    b: Mapping[Key, Any] = {key_of(member.id): member for member in second}
    for key, member in a.items():
        if key not in b:
            comparison.add(f"{path}[{member.id!r}]", Change.REMOVED, _named(member))
    for key, member in b.items():
        if key not in a:
            comparison.add(f"{path}[{member.id!r}]", Change.ADDED, _named(member))
        else:
            compare(f"{path}[{member.id!r}]", a[key], member)
    if [key for key in a if key in b] != [key for key in b if key in a]:
        comparison.add(path, Change.CHANGED, "in another order")


def _named(member: Any) -> str:
    label = getattr(member, "label", None)
    return str(member.type) if label is None else f"{member.type} {_shown(label)}"


def _compare_sensor(
    comparison: _Comparison, path: str, a: Sensor, b: Sensor, on_frame: Callable[[], None], *, pixels: bool
) -> None:
    comparison.records(path, a, b, skipped=("frames", "images", "video"))
    if isinstance(a, CameraSensor) and isinstance(b, CameraSensor):
        _compare_images(comparison, f"{path}.images", a, b, on_frame, pixels=pixels)
    elif isinstance(a, DepthCameraSensor) and isinstance(b, DepthCameraSensor):
        _compare_depth_images(comparison, f"{path}.frames", a, b, on_frame, pixels=pixels)
    elif isinstance(a, LidarSensor | RadarSensor) and type(a) is type(b):
        _compare_frames(comparison, f"{path}.frames", a.frames, b.frames, _compare_cloud, on_frame)


def _compare_cloud(
    comparison: _Comparison, path: str, a: LidarFrame | RadarFrame, b: LidarFrame | RadarFrame
) -> None:
    """Compare two frames; of different numbers of points only the numbers are reported."""
    if len(a.points) == len(b.points):
        comparison.records(path, a, b)
        return
    comparison.records(path, a, b, skipped=("points",))
    count, other = len(a.points), len(b.points)
    comparison.add(
        f"{path}.points", Change.CHANGED, f"{count} points; then {other}", abs(count - other), "points"
    )
