"""Rules about points that belong to objects or classes: they exist, and belong to one object."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import read_only
from sceneloom.checks.repairing import repaired_annotations
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, key_of


class Entry(NamedTuple):
    """Labelled points of one sensor or frame: where they stand, whose they are, and which."""

    path: str
    annotation: LabeledPointsAnnotation
    points: LabeledPoints


FrameKey = tuple[type, Identifier, int | None]


def _entries(subject: Subject) -> dict[FrameKey, list[Entry]]:
    """All labelled points by sensor and frame."""

    def made(inner: Subject) -> dict[FrameKey, list[Entry]]:
        entries: dict[FrameKey, list[Entry]] = defaultdict(list)
        for path, annotation in inner.annotations():
            if isinstance(annotation, LabeledPointsAnnotation):
                for k, points in enumerate(annotation.labeled_points):
                    key = (type(points.sensor_id), points.sensor_id, points.sensor_frame)
                    entries[key].append(Entry(f"{path}.labeled_points[{k}]", annotation, points))
        return entries

    return subject.table("labelled points by frame", made)


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
    if not entries or not isinstance(frame.frame, LidarFrame | RadarFrame):
        return
    key, count = key_of(frame.sensor.id), len(frame.frame.points)
    totals = subject.table("points per sensor", lambda _: defaultdict[tuple[type, Identifier], int](int))
    totals[key] += count
    yield from _beyond(entries.get((*key, frame.number), []), count, f"frame {frame.number}")


def _beyond(entries: list[Entry], count: int, whole: str) -> Iterator[Hit]:
    for entry in entries:
        beyond = entry.points.point_ids[entry.points.point_ids >= count]
        if len(beyond):
            message = f"point {int(beyond.max())}; {whole} has {count} points, counted from 0"
            yield Hit(f"{entry.path}.point_ids", message, count=len(beyond))


def _beyond_sensor(subject: Subject) -> Iterator[Hit]:
    """Judge points that are counted through a whole sensor, when all its frames have been read."""
    totals = subject.table("points per sensor", lambda _: defaultdict[tuple[type, Identifier], int](int))
    for (kind, sensor_id, frame), entries in _entries(subject).items():
        if frame is None and isinstance(subject.sensor(sensor_id), LidarSensor | RadarSensor):
            yield from _beyond(entries, totals[kind, sensor_id], f"sensor {sensor_id!r}")


def _beyond_map(subject: Subject) -> Iterator[Hit]:
    for (_, sensor_id, frame), entries in _entries(subject).items():
        sensor = subject.sensor(sensor_id)
        if frame is None and isinstance(sensor, PointsSensor):
            yield from _beyond(entries, len(sensor.positions), f"sensor {sensor_id!r}")


def _repeated(subject: Subject) -> Iterator[Hit]:
    for entries in _entries(subject).values():
        for entry in entries:
            repeated = len(entry.points.point_ids) - len(np.unique(entry.points.point_ids))
            if repeated:
                yield Hit(
                    f"{entry.path}.point_ids", f"{_points(repeated)} named twice in one list", count=repeated
                )


def _each_once(scene: Scene) -> Scene:
    """Name each point once, at its first location."""
    return repaired_annotations(scene, _with_each_once)


def _with_each_once(annotation: Annotation) -> Annotation:
    if not isinstance(annotation, LabeledPointsAnnotation):
        return annotation
    points = tuple(map(_once, annotation.labeled_points))
    same = all(new is old for new, old in zip(points, annotation.labeled_points, strict=True))
    return annotation if same else replace(annotation, labeled_points=points)


def _once(points: LabeledPoints) -> LabeledPoints:
    firsts = np.sort(np.unique(points.point_ids, return_index=True)[1])
    if len(firsts) == len(points.point_ids):
        return points
    return replace(points, point_ids=read_only(points.point_ids[firsts]))


def _of_two(subject: Subject) -> Iterator[Hit]:
    """Find points that belong to two instances: of one frame's instances, sorted by point, two neighbours."""
    shared: dict[tuple[int, int], list[tuple[Entry, Entry, int]]] = defaultdict(list)
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


RULES: tuple[Rule, ...] = (
    Rule(
        "labelled-frame-unknown",
        Severity.ERROR,
        "The frame of labelled points is a frame of their sensor.",
        "Count frames from 0; leave `sensor_frame` out where the whole sensor is meant.",
        find=_frames_that_are_not,
    ),
    Rule(
        "labelled-point-unknown",
        Severity.ERROR,
        "Labelled points are points of their frame.",
        "Label the points again on the frame as it is: its points were thinned or cut since.",
        find=_beyond_map,
        look=_beyond_frame,
        conclude=_beyond_sensor,
    ),
    Rule(
        "labelled-point-twice",
        Severity.WARNING,
        "Each labelled point is named once.",
        "Leave the repetitions out.",
        find=_repeated,
        fix=_each_once,
    ),
    Rule(
        "point-in-two-instances",
        Severity.WARNING,
        "A point belongs to one instance.",
        "Decide which of the objects it belongs to.",
        find=_of_two,
    ),
)
