"""Rules about points of lidars and radars, and about points that belong to objects or classes."""

import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array, read_only
from sceneloom.checks.rule import ERROR, HINT, WARNING, Find, FrameInHand, Hit, Rule, Subject, with_each
from sceneloom.scene.annotations import Annotation, LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.clouds import (
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, key_of

_FAR_M = 10_000.0  # beyond it float32 is coarser than a millimetre
_ENOUGH_POINTS = 100  # of fewer points nothing is stated
_ORIGIN_SHARE, _COLLAPSED_SHARE, _CLIPPED_SHARE, _FEW_LEVELS = 0.05, 0.1, 0.5, 4
_NO_CAMERA, _NORM_TOLERANCE = 255, 0.01
_FASTEST = 150.0  # relative to the sensor: two vehicles that meet on a motorway [m/s]

Key = tuple[type, Identifier]


@dataclass(frozen=True, slots=True, eq=False)
class _CloudFacts:
    """Statistics of the points of one frame."""

    count: int
    not_finite: int
    at_origin: int
    far: int  # beyond `_FAR_M`
    farthest: float  # the largest coordinate [m], 0 without points
    levels: Int64Array | None  # (256,), how many have each intensity
    colours: Int64Array  # (3,), how many have a colour, are white, are black
    digest: int  # of the positions

    @classmethod
    def of(cls, points: LidarPoints | RadarPoints) -> "_CloudFacts":
        positions = points.positions
        x, y, z = np.abs(positions).T
        largest = np.maximum(np.maximum(x, y), z)
        finite = np.isfinite(largest)
        colors = points.colors if isinstance(points, LidarPoints) else None
        intensities = points.intensities if isinstance(points, LidarPoints) else None
        colours = (0, 0, 0) if colors is None else (len(colors), _count_of(colors, 255), _count_of(colors, 0))
        return cls(
            count=len(positions),
            not_finite=int(len(positions) - np.count_nonzero(finite)),
            at_origin=int(np.count_nonzero(largest == 0)),
            far=int(np.count_nonzero(finite & (largest > _FAR_M))),
            farthest=float(largest[finite].max(initial=0.0)),
            levels=None if intensities is None else np.bincount(intensities, minlength=256),
            colours=np.array(colours, np.int64),
            digest=zlib.crc32(np.ascontiguousarray(positions).data),
        )


def _count_of(colors: UInt8Array, level: int) -> int:
    """How many points have this level in red, green and blue."""
    red, green, blue = colors.T
    return int(np.count_nonzero((red == level) & (green == level) & (blue == level)))


@dataclass(slots=True, eq=False)
class _SensorFacts:
    """The frames of one sensor, one after the other."""

    path: str  # of the sensor
    counts: dict[int, int] = field(default_factory=dict)  # points of each frame that could be read, by its number
    levels: Int64Array | None = None  # summed over frames
    colours: Int64Array = field(default_factory=lambda: np.zeros(3, np.int64))
    digest: int | None = None  # of the latest frame
    repeated: list[int] = field(default_factory=list)  # numbers of frames with the very points of the one before

    def add(self, number: int, facts: _CloudFacts) -> None:
        """Take in one more frame."""
        self.counts[number] = facts.count
        if facts.levels is not None:
            self.levels = facts.levels if self.levels is None else self.levels + facts.levels
        self.colours = self.colours + facts.colours
        if facts.count and facts.digest == self.digest:
            self.repeated.append(number)
        self.digest = facts.digest


def _sensor_facts(subject: Subject) -> dict[Key, _SensorFacts]:
    """The statistics of each sensor with points, by the frames read so far."""
    return subject.table("facts of sensors", lambda _: {})


def _cloud_facts(subject: Subject, frame: FrameInHand) -> _CloudFacts | None:
    """The statistics of a frame in hand, computed once; None for images and what cannot be read."""
    if not isinstance(frame.frame, LidarFrame | RadarFrame):
        return None
    latest = subject.table("facts of the frame in hand", lambda _: dict[str, _CloudFacts]())
    if frame.path not in latest:
        latest.clear()
        latest[frame.path] = facts = _CloudFacts.of(frame.frame.points)
        known, key = _sensor_facts(subject), key_of(frame.sensor.id)
        known.setdefault(key, _SensorFacts(frame.sensor_path)).add(frame.number, facts)
    return latest[frame.path]


def _positions(judge: Callable[[_CloudFacts], tuple[int, str]]) -> Callable[[Subject, FrameInHand], Iterator[Hit]]:
    """Report positions of a frame that are wrong: how many, and what."""

    def look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
        facts = _cloud_facts(subject, frame)
        count, message = (0, "") if facts is None else judge(facts)
        if count:
            yield Hit(f"{frame.path}.points.positions", message, count=count)

    return look


def _not_finite(facts: _CloudFacts) -> tuple[int, str]:
    return facts.not_finite, f"{facts.not_finite} of {facts.count} points have a location that is not finite"


def _at_origin(facts: _CloudFacts) -> tuple[int, str]:
    message = f"{facts.at_origin} of {facts.count} points lie at 0, 0, 0"
    return facts.at_origin if facts.at_origin > max(1, _ORIGIN_SHARE * facts.count) else 0, message


def _far(facts: _CloudFacts) -> tuple[int, str]:
    step_mm = float(np.spacing(np.float32(facts.farthest))) * 1e3
    return facts.far, f"coordinates up to {facts.farthest:.0f} m, where float32 steps by {step_mm:.2g} mm"


def _map_not_finite(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors_of(PointsSensor):
        bad = int(np.count_nonzero(~np.isfinite(sensor.positions).all(axis=1)))
        if bad:
            message = f"{bad} of {len(sensor.positions)} points have a location that is not finite"
            yield Hit(f"{path}.points.positions", message, count=bad)


def _map_far(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors_of(PointsSensor):
        positions = sensor.positions
        far = positions[np.isfinite(positions) & (np.abs(positions) > _FAR_M)]
        if len(far):
            yield Hit(f"{path}.points.positions", f"coordinates up to {np.abs(far).max():.0f} m, too far for float32")


def _seen(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Take the frame in; what it shows together with the others is reported at the end."""
    _cloud_facts(subject, frame)
    return iter(())


_Odd = tuple[str, str, int]  # where in a sensor something is odd, the message, and in how many frames


def _of_sensors(judge: Callable[[_SensorFacts], Iterator[_Odd]]) -> Find:
    def conclude(subject: Subject) -> Iterator[Hit]:
        for facts in _sensor_facts(subject).values():
            for where, message, count in judge(facts):
                yield Hit(f"{facts.path}.frames[{where}", message, count=count)

    return conclude


def _without_points(facts: _SensorFacts) -> Iterator[_Odd]:
    empty = [number for number, count in facts.counts.items() if count == 0]
    if empty:
        yield f"{empty[0]}]", f"{len(empty)} of {len(facts.counts)} frames have no points", len(empty)


def _collapsed(facts: _SensorFacts) -> Iterator[_Odd]:
    usual = float(np.median(list(facts.counts.values())))
    few = [(number, count) for number, count in facts.counts.items() if 0 < count < _COLLAPSED_SHARE * usual]
    if few and usual >= _ENOUGH_POINTS:
        number, count = few[0]
        yield f"{number}].points", f"{count} points; the sensor's frames have {usual:.0f} in the middle", len(few)


def _repeated(facts: _SensorFacts) -> Iterator[_Odd]:
    count = len(facts.repeated)
    if count:
        message = f"{count} of {len(facts.counts)} frames have the very points of the one before"
        yield f"{facts.repeated[0]}]", message, count


def _odd_intensities(facts: _SensorFacts) -> Iterator[_Odd]:
    levels = facts.levels
    if levels is None or levels.sum() < _ENOUGH_POINTS:
        return
    used, clipped = np.flatnonzero(levels), levels[255] / levels.sum()
    if len(used) == 1:
        message = f"all are {used[0]}"
    elif used[-1] <= 1:
        message = "all are 0 or 1: numbers from 0 to 1 were rounded to integers"
    elif len(used) <= _FEW_LEVELS:
        message = f"only {len(used)} levels: {', '.join(map(str, used.tolist()))}"
    elif clipped > _CLIPPED_SHARE:
        message = f"{clipped:.0%} are 255: they were cut off"
    else:
        return
    yield "].points.intensities", message, len(facts.counts)


def _all_one_colour(facts: _SensorFacts) -> Iterator[_Odd]:
    coloured, white, black = facts.colours.tolist()
    for name, count in (("white", white), ("black", black)):
        if coloured >= _ENOUGH_POINTS and count == coloured:
            yield "].points.colors", f"all {count} points are {name}", 1


def _unknown_camera(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    points = frame.frame.points if isinstance(frame.frame, LidarFrame) else None
    if points is None or points.camera_index is None:
        return
    cameras = len(subject.scene.cameras)
    unknown = points.camera_index[(points.camera_index >= cameras) & (points.camera_index != _NO_CAMERA)]
    if len(unknown):
        message = f"camera {unknown[0]}; the scene has {cameras} cameras, counted from 0"
        yield Hit(f"{frame.path}.points.camera_index", message, count=len(unknown))


def _no_unit_vectors(_: Subject, frame: FrameInHand) -> Iterator[Hit]:
    points = frame.frame.points if isinstance(frame.frame, RadarFrame) else None
    if points is None or points.directions is None:
        return
    norms = np.linalg.norm(points.directions, axis=1)
    off = np.flatnonzero(~(np.abs(norms - 1.0) <= _NORM_TOLERANCE))
    if len(off):
        yield Hit(f"{frame.path}.points.directions[{off[0]}]", f"length {norms[off[0]]:.4g}; expected 1", len(off))


def _absurd_speeds(_: Subject, frame: FrameInHand) -> Iterator[Hit]:
    points = frame.frame.points if isinstance(frame.frame, RadarFrame) else None
    if points is None or points.lengths is None:
        return
    off = np.flatnonzero(np.abs(points.lengths) > _FASTEST)  # NaN is not known
    if len(off):
        message = f"{points.lengths[off[0]]:g} m/s; expected at most {_FASTEST:g} either way"
        yield Hit(f"{frame.path}.points.lengths[{off[0]}]", message, count=len(off))


class _Entry(NamedTuple):
    """Labelled points of one sensor or frame: where they stand, whose they are, and which."""

    path: str
    annotation: LabeledPointsAnnotation
    points: LabeledPoints


_FrameKey = tuple[type, Identifier, int | None]


def _entries(subject: Subject) -> dict[_FrameKey, list[_Entry]]:
    """All labelled points by sensor and frame."""
    return subject.table("labelled points by frame", _made_entries)


def _made_entries(subject: Subject) -> dict[_FrameKey, list[_Entry]]:
    entries: dict[_FrameKey, list[_Entry]] = defaultdict(list)
    for path, annotation in subject.annotations_of(LabeledPointsAnnotation):
        for k, points in enumerate(annotation.labeled_points):
            key = (type(points.sensor_id), points.sensor_id, points.sensor_frame)
            entries[key].append(_Entry(f"{path}.labeled_points[{k}]", annotation, points))
    return entries


def _totals(subject: Subject) -> defaultdict[Key, int]:
    """How many points all frames of each sensor have that were read so far."""
    return subject.table("points per sensor", lambda _: defaultdict[Key, int](int))


def _frames_that_are_not(subject: Subject) -> Iterator[Hit]:
    for (_, sensor_id, frame), entries in _entries(subject).items():
        sensor = subject.sensor(sensor_id)
        if frame is None or sensor is None:
            continue
        if isinstance(sensor, PointsSensor):
            message = f"{frame}; a points sensor has no frames"
        elif isinstance(sensor, LidarSensor | RadarSensor) and not 0 <= frame < len(sensor.frames):
            message = f"{frame}; sensor {sensor_id!r} has {len(sensor.frames)} frames, counted from 0"
        else:
            continue
        for entry in entries:
            yield Hit(f"{entry.path}.sensor_frame", message)


def _beyond_frame(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    entries = _entries(subject)
    if entries and isinstance(frame.frame, LidarFrame | RadarFrame):
        key, count = key_of(frame.sensor.id), len(frame.frame.points)
        _totals(subject)[key] += count
        yield from _beyond(entries.get((*key, frame.number), []), count, f"frame {frame.number}")


def _beyond(entries: list[_Entry], count: int, whole: str) -> Iterator[Hit]:
    for entry in entries:
        beyond = entry.points.point_ids[entry.points.point_ids >= count]
        if len(beyond):
            message = f"point {int(beyond.max())}; {whole} has {count} points, counted from 0"
            yield Hit(f"{entry.path}.point_ids", message, count=len(beyond))


def _beyond_sensor(subject: Subject) -> Iterator[Hit]:
    """Judge points that are counted through a whole sensor, when all its frames have been read."""
    for (kind, sensor_id, frame), entries in _entries(subject).items():
        if frame is None and isinstance(subject.sensor(sensor_id), LidarSensor | RadarSensor):
            yield from _beyond(entries, _totals(subject)[kind, sensor_id], f"sensor {sensor_id!r}")


def _beyond_map(subject: Subject) -> Iterator[Hit]:
    for (_, sensor_id, frame), entries in _entries(subject).items():
        sensor = subject.sensor(sensor_id)
        if frame is None and isinstance(sensor, PointsSensor):
            yield from _beyond(entries, len(sensor.positions), f"sensor {sensor_id!r}")


def _labelled_points_repeated(subject: Subject) -> Iterator[Hit]:
    for entries in _entries(subject).values():
        for entry in entries:
            repeated = len(entry.points.point_ids) - len(np.unique(entry.points.point_ids))
            if repeated:
                yield Hit(f"{entry.path}.point_ids", f"{_points(repeated)} named twice in one list", count=repeated)


def _each_once(scene: Scene) -> Scene:
    """Name each point once, at its first location."""

    def once(points: LabeledPoints) -> LabeledPoints:
        firsts = np.sort(np.unique(points.point_ids, return_index=True)[1])
        whole = len(firsts) == len(points.point_ids)
        return points if whole else replace(points, point_ids=read_only(points.point_ids[firsts]))

    def repaired(annotation: Annotation) -> Annotation:
        labelled = isinstance(annotation, LabeledPointsAnnotation)
        return with_each(annotation, "labeled_points", once) if labelled else annotation

    return with_each(scene, "annotations", repaired)


def _of_two(subject: Subject) -> Iterator[Hit]:
    """Find points that belong to two instances: of one frame's instances, sorted by point, two neighbours."""
    shared: dict[tuple[int, int], list[tuple[_Entry, _Entry, int]]] = defaultdict(list)
    for entries in _entries(subject).values():
        instances = [entry for entry in entries if entry.annotation.is_instance]
        if len({id(entry.annotation) for entry in instances}) < 2:
            continue
        ids = np.concatenate([entry.points.point_ids for entry in instances])
        owners = np.repeat(np.arange(len(instances)), [len(entry.points.point_ids) for entry in instances])
        order = np.lexsort((owners, ids))
        ids, owners = ids[order], owners[order]
        pairs = np.stack([owners[:-1], owners[1:]], axis=1)[(ids[:-1] == ids[1:])]
        for (one, other), count in zip(*np.unique(pairs, axis=0, return_counts=True), strict=True):
            first, second = instances[one], instances[other]
            if first.annotation is not second.annotation:
                shared[id(second.annotation), id(first.annotation)].append((second, first, int(count)))
    for locations in shared.values():
        second, first, _ = locations[0]
        total = sum(count for *_, count in locations)
        where = f" in {len(locations)} frames, first here" if len(locations) > 1 else ""
        message = f"{second.annotation.id!r} shares {_points(total)} with {first.annotation.id!r}{where}"
        yield Hit(f"{second.path}.point_ids", message)


def _points(count: int) -> str:
    return "1 point" if count == 1 else f"{count} points"


# fmt: off
POINT_RULES: tuple[Rule, ...] = (
    Rule("points-not-finite", WARNING, "The location of every point is finite.",
         "Leave points without a location out.", find=_map_not_finite, look=_positions(_not_finite)),
    Rule("points-at-origin", WARNING,
         f"No more than {_ORIGIN_SHARE:.0%} of a frame's points lie exactly at the origin.",
         "Leave out the beams that did not return.", look=_positions(_at_origin)),
    Rule("points-far", WARNING,
         f"Points lie within {_FAR_M / 1000:g} km of the origin, where float32 resolves millimetres.",
         "Choose an origin near the drive, as `sceneloom fuse` does, and keep the transform to it in the metadata.",
         find=_map_far, look=_positions(_far)),
    Rule("frame-without-points", HINT, "Every frame has points.",
         "Check whether the sensor was off, or its packets were lost.", look=_seen,
         conclude=_of_sensors(_without_points)),
    Rule("frame-repeated", HINT, "No frame has the very points of the frame before it.",
         "Check whether the sensor hung, or frames were filled in.", look=_seen, conclude=_of_sensors(_repeated)),
    Rule("point-count-collapses", WARNING,
         f"No frame has fewer points than {_COLLAPSED_SHARE:.0%} of the sensor's usual number.",
         "Check whether packets were lost.", look=_seen, conclude=_of_sensors(_collapsed)),
    Rule("intensity-scale", WARNING, "Intensities use the range from 0 to 255.",
         "Scale them to 0 to 255 before they become integers.", look=_seen, conclude=_of_sensors(_odd_intensities)),
    Rule("colors-all-alike", WARNING, "The points of a sensor are not all white, and not all black.",
         "Leave `colors` out where no camera coloured the points, or check why none did.", look=_seen,
         conclude=_of_sensors(_all_one_colour)),
    Rule("camera-index-unknown", ERROR,
         "The camera that coloured a point is a camera of the scene; 255 stands for none.",
         "Colour the points again: cameras were added or removed since.", look=_unknown_camera),
    Rule("radar-direction-norm", WARNING, "The directions of radar points are unit vectors.",
         "Divide each by its length.", look=_no_unit_vectors),
    Rule("radar-length-absurd", WARNING, f"The lengths of radar points are speeds up to {_FASTEST:g} m/s.",
         "Give metres per second along `directions`.", look=_absurd_speeds),
)

LABELLED_POINT_RULES: tuple[Rule, ...] = (
    Rule("labelled-frame-unknown", ERROR, "The frame of labelled points is a frame of their sensor.",
         "Count frames from 0; leave `sensor_frame` out where the whole sensor is meant.", find=_frames_that_are_not),
    Rule("labelled-point-unknown", ERROR, "Labelled points are points of their frame.",
         "Label the points again on the frame as it is: its points were thinned or cut since.",
         find=_beyond_map, look=_beyond_frame, conclude=_beyond_sensor),
    Rule("labelled-point-twice", WARNING, "Each labelled point is named once.", "Leave the repetitions out.",
         find=_labelled_points_repeated, fix=_each_once),
    Rule("point-in-two-instances", WARNING, "A point belongs to one instance.",
         "Decide which of the objects it belongs to.", find=_of_two),
)
# fmt: on
