"""Differences between two scenes, field by field, with tolerances."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum, StrEnum
from math import prod
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import angle_between, normalise_quaternion, quaternion_from_matrix
from sceneloom.scene.annotations import CuboidAnnotation, CuboidPath, PointPath, locations_of
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_poses, point_at
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, ShootingSensor, shots_of
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Posed, Scene, Sensor, frame_times
from sceneloom.scene.time_range import TIMED_COLUMNS
from sceneloom.scene.types import Progress, key_of


class Change(StrEnum):
    """What happened from the first scene to the second."""

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
        not_compared: what could not be compared, or only by decoding, which was not asked for.
    """

    differences: tuple[Difference, ...]
    not_compared: tuple[str, ...] = ()

    @property
    def equal(self) -> bool:
        """Whether nothing differs beyond the tolerances."""
        return not self.differences


@np.errstate(invalid="ignore", over="ignore")  # files contain non-finite numbers
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

    Sensors and annotations are the same if their ids are, frames if their timestamps are. The source of a scene and
    the warnings about it are not compared. Frames are read in pairs and not kept.

    Args:
        first, second: the scenes.
        tolerance_m: largest distance of positions, sizes and translations that counts as none [m].
        tolerance_deg: largest rotation [deg]; quaternions of one rotation are equal whatever their sign, and so are
            cuboids whose angles are given in another unit or order.
        tolerance_ns: largest difference of timestamps [ns].
        tolerance_px: largest difference of what is drawn into images [px].
        other_timestamps: let a path be sampled at other timestamps, if at those of both it is the same within the
            tolerances.
        pixels: decode images whose bytes differ or are not there, and compare their pixels.
        progress: called after each frame with how many are done, and of how many.

    Raises:
        OptionError: one is no scene, or a tolerance is negative or not a number.
        DataError: a frame cannot be read.
    """
    for scene in (first, second):
        if not isinstance(scene, Scene):
            raise OptionError(f"{scene!r}; expected a scene: `sceneloom.open` gives that of a file")
    tolerances = {_METRES: tolerance_m, _DEGREES: tolerance_deg, _NANOSECONDS: tolerance_ns, _PIXELS: tolerance_px}
    for unit, value in tolerances.items():
        if not 0.0 <= value < math.inf:
            raise OptionError(f"tolerance {value} {unit}; expected a number from 0 on")
    counts = (
        sum(len(frame_times(one)) for one in scene.sensors if isinstance(one, Posed)) for scene in (first, second)
    )
    total, done = max(counts), 0

    def on_frame() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, max(total, done))

    angles = CuboidAngles.of(first), CuboidAngles.of(second)
    comparison = _Comparison(tolerances, other_timestamps, angles, pixels, on_frame)
    for name in ("time_offset_ns", "metadata", "attributes"):
        comparison.values(name, getattr(first, name), getattr(second, name), _unit_of("Scene", name))
    # the unit of times that holds where none is stated
    a, b = ({"time_unit": "microseconds", **scene.extras} for scene in (first, second))
    comparison.values("extras", a, b)
    comparison.values("trajectories", first.trajectories, second.trajectories)
    for name, compare in (("sensors", comparison.sensors), ("annotations", comparison.records)):
        here, there = ({key_of(one.id): one for one in getattr(scene, name)} for scene in (first, second))
        comparison.members(name, here, there, _named, compare)
        if [key for key in here if key in there] != [key for key in there if key in here]:
            comparison.changed(name, "in another order")
    return SceneDifferences(differences=tuple(comparison.found.values()), not_compared=tuple(comparison.not_compared))


def _named(member: Any) -> str:
    label = getattr(member, "label", None)
    return str(member.type) if label is None else f"{member.type} {_shown(label)}"


_METRES, _DEGREES, _NANOSECONDS, _PIXELS = "m", "deg", "ns", "px"
_CUBOIDS, _VERTICES = "cuboids", "vertices"
"""Of rows of cuboids, whose angles are compared as rotations; and of vertices, in pixels or in metres."""

_UNITS: Mapping[str, str] = MappingProxyType(
    {
        "Poses.positions": _METRES,
        "Poses.quaternions_xyzw": _DEGREES,
        "Trajectory.positions": _METRES,
        "Trajectory.quaternions_xyzw": _DEGREES,
        "LidarPoints.positions": _METRES,
        "RadarPoints.positions": _METRES,
        "PointsSensor.positions": _METRES,
        "PointPath.values": _METRES,
        "PointProjection.positions": _METRES,
        "PointProjection.points": _PIXELS,
        "Projection.boxes": _PIXELS,
        "BoxPath.values": _PIXELS,
        "RigidTransform.translation": _METRES,
        "RigidTransform.rotation": _DEGREES,
        "CuboidPath.values": _CUBOIDS,
        "Projection.cuboids": _CUBOIDS,
        "Activation.cuboids": _CUBOIDS,
        "VertexPath.vertices": _VERTICES,
    }
)  # class and field of everything that has a tolerance, besides timestamps (`_ns`)


def _unit_of(owner: str, name: str) -> str:
    """The unit of a field of a class; "" where it has to be equal."""
    return _NANOSECONDS if name.endswith("_ns") else _UNITS.get(f"{owner}.{name}", "")


_KEYS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "AttributePath": ("name", "sensor_id", "point_index"),
        "Activation": ("sensor_id",),
        "Projection": ("sensor_id",),
        "PointProjection": ("sensor_id",),
        "LabeledPoints": ("sensor_id", "sensor_frame"),
    }
)  # by which fields the members of a list are distinguished, instead of their numbers


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """Compares values and collects what differs; differences in the frames of one sensor become one."""

    tolerances: Mapping[str, float]  # that count as none, by unit; frames so near in time are one
    other_timestamps: bool  # whether a path may be sampled at others, if the same within tolerances
    angles: tuple[CuboidAngles, CuboidAngles]  # of the two scenes' cuboids
    pixels: bool  # whether images whose bytes differ or are not there are decoded
    on_frame: Callable[[], None]  # called after each frame
    frame: int | None = None  # the one that is compared
    found: dict[tuple[str, Change], Difference] = field(default_factory=dict)
    not_compared: dict[str, None] = field(default_factory=dict)

    def add(self, path: str, change: Change, message: str, amount: float | None = None, unit: str = "") -> None:
        """Add a difference; of several in frames the largest one is reported."""
        made = Difference(path=path, change=change, message=message, amount=amount, unit=unit, frame=self.frame)
        before = self.found.get((path, change))
        if before is not None:
            largest = made if (amount or 0.0) > (before.amount or 0.0) else before
            made = msgspec.structs.replace(largest, count=before.count + 1)
        self.found[path, change] = made

    def changed(self, path: str, message: str, amount: float | None = None, unit: str = "") -> None:
        """Add a difference of what both scenes have."""
        self.add(path, Change.CHANGED, message, amount, unit)

    def values(self, path: str, a: Any, b: Any, unit: str = "") -> None:
        """Compare two values; functions, which open and decode, are not compared."""

        def both(*kinds: type) -> bool:
            return isinstance(a, kinds) and isinstance(b, kinds)

        if a is b:
            return
        if a is None or b is None:
            self.add(path, Change.ADDED if a is None else Change.REMOVED, _shown(b if a is None else a))
        elif both(np.ndarray):
            self._arrays(path, a, b, unit)
        elif both(str, bytes, bool):
            if a != b:
                self.changed(path, f"{_shown(a)}; then {_shown(b)}")
        elif both(int, float) and not isinstance(a, bool) and not isinstance(b, bool):
            away = abs(a - b)
            if not (a == b or (math.isnan(a) and math.isnan(b)) or away <= self.tolerances.get(unit, 0.0)):
                self.changed(path, f"{a!r}; then {b!r}", float(away), unit)
        elif both(Mapping):
            first, second = ({repr(key): value for key, value in one.items()} for one in (a, b))
            self.members(path, first, second, _shown, self.values)
        elif both(list, tuple):
            self._sequences(path, a, b, unit)
        elif _is_record(a) and _is_record(b):
            self.records(path, a, b)
        elif not (callable(a) and callable(b)):
            self.changed(path, f"{_shown(a)}; then {_shown(b)}")

    def records(self, path: str, a: Any, b: Any, *, skipped: Iterable[str] = ()) -> None:
        """Compare two records field by field."""
        if type(a) is not type(b):
            self.changed(path, f"{type(a).__name__}; then {type(b).__name__}")
            return
        passed = {*skipped, *self._paths(path, a, b)}
        for each in fields(a):
            if each.name not in passed:
                inner = f"{path}.{each.name}" if path else each.name
                unit = _unit_of(type(a).__name__, each.name)
                self.values(inner, getattr(a, each.name), getattr(b, each.name), unit)

    def _paths(self, path: str, a: Any, b: Any) -> tuple[str, ...]:
        """Compare two paths of other timestamps by sampling them; gives the fields that this settles."""
        if not (_is_path(a) and _is_path(b)):
            return ()
        count, other, limits = len(a.timestamps_ns), len(b.timestamps_ns), self.tolerances
        if count == other and np.abs(a.timestamps_ns - b.timestamps_ns).max() <= limits[_NANOSECONDS]:
            return ()
        found = _paths_apart(a, b, self.angles)
        if found is None:
            return ()
        metres, degrees = found
        if not (self.other_timestamps and metres <= limits[_METRES] and degrees <= limits[_DEGREES]):
            reported = f"{count} timestamps; then {other}; as paths up to {metres:.3g} m and {degrees:.3g} deg apart"
            self.changed(path, reported, metres, _METRES)
        return ("timestamps_ns", *TIMED_COLUMNS[type(a)])

    def members(
        self,
        path: str,
        a: Mapping[Any, Any],
        b: Mapping[Any, Any],
        shown: Callable[[Any], str],
        compare: Callable[[str, Any, Any], None],
    ) -> None:
        """Compare what has keys: what only one has, and what both have."""
        texts = {key: f"{path}[{key if isinstance(key, str) else repr(key[1])}]" for key in (*a, *b)}
        for key in (key for key in a if key not in b):
            self.add(texts[key], Change.REMOVED, shown(a[key]))
        for key, value in b.items():
            if key in a:
                compare(texts[key], a[key], value)
            else:
                self.add(texts[key], Change.ADDED, shown(value))

    def _sequences(self, path: str, a: Sequence[Any], b: Sequence[Any], unit: str) -> None:
        """Compare two lists, by the keys of their members or member by member."""
        first, second = _keyed(a), _keyed(b)
        if first is not None and second is not None:
            self.members(path, first, second, _shown, self.values)
            return
        if len(a) != len(b):
            self.changed(path, f"{len(a)} values; then {len(b)}", abs(len(a) - len(b)))
        for k, (one, other) in enumerate(zip(a, b, strict=False)):
            self.values(f"{path}[{k}]", one, other, unit)

    def _arrays(self, path: str, a: AnyArray, b: AnyArray, unit: str) -> None:
        """Compare two arrays: kind and shape, then row by row."""
        if a.dtype != b.dtype or a.shape != b.shape:
            amount = abs(len(a) - len(b)) if a.ndim and b.ndim else None
            self.changed(path, f"{_form(a)}; then {_form(b)}", amount)
        elif unit == _CUBOIDS:
            # sizes and positions in metres, angles as rotations, each in the unit and order of its own scene
            self._rows(f"{path}.size", a[:, :3], b[:, :3], _METRES)
            self._rows(f"{path}.position", a[:, 3:6], b[:, 3:6], _METRES)
            if self.angles[0] != self.angles[1] or not np.array_equal(a[:, 6:], b[:, 6:], equal_nan=True):
                first, second = self.angles[0].quaternions(a[:, 6:]), self.angles[1].quaternions(b[:, 6:])
                self._rows(f"{path}.rotation", first, second, _DEGREES)
        elif unit == _VERTICES:
            self._rows(path, a, b, _METRES if a.shape[-1] == 3 else _PIXELS)
        else:
            self._rows(path, a, b, unit)

    def _rows(self, path: str, a: AnyArray, b: AnyArray, unit: str) -> None:
        away = apart(a, b, unit)
        if away is None:
            if not np.array_equal(a, b):
                self.changed(path, f"{_form(a)} of other values")
            return
        wrong = np.flatnonzero(away > self.tolerances.get(unit, 0.0))
        if len(wrong):
            worst = int(np.argmax(away))
            rows = f"{len(wrong)} of {len(away)} rows" if len(away) > 1 else "the values"
            self.changed(path, f"{rows} differ, row {worst} most", float(away[worst]), unit)

    def sensors(self, path: str, a: Sensor, b: Sensor) -> None:
        """Compare two sensors and their frames, those of the same time in pairs."""
        self.records(path, a, b, skipped=("frames", "images", "video"))
        if type(a) is not type(b):
            return
        if isinstance(a, LidarSensor | RadarSensor):
            self._frames(f"{path}.frames", a.frames, b.frames, _Comparison._clouds)  # type: ignore[union-attr]
        elif isinstance(a, CameraSensor | DepthCameraSensor) and isinstance(b, CameraSensor | DepthCameraSensor):
            inner = f"{path}.images" if isinstance(a, CameraSensor) else f"{path}.frames"
            videos = self._videos(inner, a, b)
            compare: Callable[..., None] = _Comparison._images
            if isinstance(a, DepthCameraSensor):
                compare = _Comparison._depth_images
            self._frames(inner, shots_of(a), shots_of(b), lambda one, *pair: compare(one, *pair, videos))

    def _frames(
        self,
        path: str,
        first: LazyFrames[Any],
        second: LazyFrames[Any],
        compare: Callable[["_Comparison", str, Any, Any], None],
    ) -> None:
        """Compare frames of the same time, read one pair after the other."""
        for k, n in pairs(first.timestamps_ns, second.timestamps_ns, self.tolerances[_NANOSECONDS]):
            inner = replace(self, frame=n if k is None else k)
            if k is None:
                inner.add(f"{path}[]", Change.ADDED, f"at {int(second.timestamps_ns[n or 0])} ns")
            elif n is None:
                inner.add(f"{path}[]", Change.REMOVED, f"at {int(first.timestamps_ns[k])} ns")
            else:
                compare(inner, f"{path}[]", first[k], second[n])
            self.on_frame()

    def _clouds(self, path: str, a: LidarFrame | RadarFrame, b: LidarFrame | RadarFrame) -> None:
        """Compare two sweeps; of different numbers of points only the numbers are reported."""
        count, other = len(a.points), len(b.points)
        self.records(path, a, b, skipped=() if count == other else ("points",))
        if count != other:
            self.changed(f"{path}.points", f"{count} points; then {other}", abs(count - other), "points")

    def _images(self, path: str, a: CameraImage, b: CameraImage, videos: bool | None) -> None:  # noqa: FBT001
        """Compare two images: camera models, then files byte by byte; those of a video by `videos`, or decoded."""
        self.records(path, a, b, skipped=("decode", "encoded"))
        equal = videos
        if a.encoded is not None or b.encoded is not None:
            equal = None if a.encoded is None or b.encoded is None else a.encoded() == b.encoded()
        if equal:
            return
        if self.pixels:
            self._pixels(f"{path}.rgb", a.rgb, b.rgb)
        elif equal is None:
            self.not_compared[f"{path}: images without files of their own; decode them to compare them"] = None
        elif videos is None:
            self.changed(f"{path}.content", "other bytes")

    def _depth_images(self, path: str, a: DepthFrame, b: DepthFrame, videos: bool | None) -> None:  # noqa: FBT001
        """Compare two depth images: camera models, then the videos that they are of, or decoded."""
        self.records(path, a, b, skipped=("decode",))
        if videos and a.scale == b.scale:
            return
        if self.pixels:
            self._pixels(f"{path}.depth", a.depth, b.depth)
        else:
            self.not_compared[f"{path}: depth images; decode them to compare them"] = None

    def _pixels(self, path: str, first: AnyArray, second: AnyArray) -> None:
        if first.shape != second.shape:
            self.changed(path, f"{first.shape[1]}x{first.shape[0]} pixels; then {second.shape[1]}x{second.shape[0]}")
            return
        colours = first.dtype == np.uint8
        away = np.abs(first.astype(np.int16 if colours else np.float64) - second)
        if colours:
            reported, unit = f"the mean difference of a channel, {int(away.max())} at most", "of 255"
        else:
            reported, unit = f"the mean difference of a depth, {float(away.max()):g} m at most", "m"
        if away.any():
            self.changed(path, reported, float(away.mean()), unit)

    def _videos(self, path: str, first: ShootingSensor, second: ShootingSensor) -> bool | None:
        """Whether the videos of two cameras are equal; None where there are not two of the same frames."""
        a, b = first.video, second.video
        if a is None or b is None or a.frame_indices != b.frame_indices:
            return None
        with a.open() as one, b.open() as other:
            chunks = iter(lambda: (one.read(_CHUNK), other.read(_CHUNK)), (b"", b""))
            equal = all(x == y for x, y in chunks)
        if not self.pixels and not equal:
            self.changed(f"{path}.video", f"{a.codec}; then {b.codec} of other bytes")
        return equal


_CHUNK = 1 << 20

_SHOWN = 60  # characters of a value that are reported


def _is_record(value: Any) -> bool:
    return is_dataclass(value) and not isinstance(value, type)


def _keyed(members: Sequence[Any]) -> dict[str, Any] | None:
    """The members by what distinguishes them; None where nothing does, or not all of them."""
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


def pairs(first_ns: Int64Array, second_ns: Int64Array, tolerance_ns: float) -> Iterator[tuple[int | None, int | None]]:
    """Pair frames by their timestamps (N,) and (M,) [ns], each with the first one near enough; None for a lone one."""
    k = n = 0
    while k < len(first_ns) or n < len(second_ns):
        away: float = math.inf if n == len(second_ns) else -math.inf
        if k < len(first_ns) and n < len(second_ns):
            away = int(second_ns[n]) - int(first_ns[k])
        has_first, has_second = away >= -tolerance_ns, away <= tolerance_ns
        yield k if has_first else None, n if has_second else None
        k, n = k + has_first, n + has_second


def _is_path(value: Any) -> bool:
    """Whether a value is a path that can be sampled at any time: with timestamps, in order, and whole points."""
    if not isinstance(value, CuboidPath | Poses | Trajectory | PointPath) or len(value.timestamps_ns) == 0:
        return False
    whole = not isinstance(value, PointPath) or value.values.shape[1] % 3 == 0
    return whole and bool((np.diff(value.timestamps_ns) > 0).all())


def _sampled(path: Any, times_ns: Int64Array, angles: CuboidAngles) -> tuple[Float64Array, Float64Array | None]:
    """A path at some times: positions or sizes (M, G, 3) [m], and quaternions (M, 4) where it has orientations."""
    if isinstance(path, CuboidPath):
        cuboids = cuboid_poses(CuboidAnnotation("", path), times_ns, angles=angles)
        return np.stack([cuboids.centers_world, cuboids.sizes_lwh], axis=1), cuboids.quaternions_xyzw
    if isinstance(path, Trajectory):
        has_orientations = path.quaternions_xyzw is not None
        path = path.poses if has_orientations else PointPath(path.timestamps_ns, path.positions)
    if isinstance(path, Poses):
        poses = path.interpolate(times_ns)
        return poses.positions[:, None], poses.quaternions_xyzw
    return locations_of(point_at(path, times_ns)[0]), None


def _paths_apart(a: Any, b: Any, angles: tuple[CuboidAngles, CuboidAngles]) -> tuple[float, float] | None:
    """Give how far two paths of one class are apart [m] and [deg]; None if they begin or end at other times."""
    # both are straight between timestamps, so that positions are farthest apart at a timestamp of one of them
    first, second = a.timestamps_ns, b.timestamps_ns
    if (first[0], first[-1]) != (second[0], second[-1]) or getattr(a, "static", 0) != getattr(b, "static", 0):
        return None
    times = np.union1d(first, second)
    (here, here_xyzw), (there, there_xyzw) = (
        _sampled(*pair) for pair in ((a, times, angles[0]), (b, times, angles[1]))
    )
    if here.shape != there.shape:
        return None
    metres = float(np.nan_to_num(np.linalg.norm(here - there, axis=2), nan=np.inf).max())
    if here_xyzw is None or there_xyzw is None:
        return metres, 0.0 if here_xyzw is there_xyzw else np.inf
    rotations = np.degrees(angle_between(here_xyzw, there_xyzw))
    return metres, float(np.nan_to_num(rotations, nan=np.inf).max())


def apart(a: AnyArray, b: AnyArray, unit: str) -> Float64Array | None:
    """Give by how much the rows of two arrays of one shape differ; None where that is no number.

    NaN and NaN are equal, NaN and a number infinitely far apart. Rows of positions are apart by their distance, those
    of quaternions and rotation matrices by the angle between them, all others by their largest difference of a number.

    Args:
        a, b: (N, …).
        unit: of their numbers.

    Returns:
        (N,) float64.
    """
    if not (a.dtype.kind in "biuf" and b.dtype.kind in "biuf"):
        return None
    if a.ndim == 0:
        a, b = a[None], b[None]
    if unit == _DEGREES:
        return _rotated(a, b)
    difference = _difference(a, b)
    columns = prod(difference.shape[1:])
    if unit == _METRES and difference.ndim > 1 and difference.shape[-1] % 3 == 0:
        distances = np.linalg.norm(difference.reshape(len(difference), columns // 3, 3), axis=2)
    else:
        distances = np.abs(difference).reshape(len(difference), columns)
    largest: Float64Array = distances.max(axis=1, initial=0.0)
    return largest


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
