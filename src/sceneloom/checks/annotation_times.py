"""Rules about the times of annotations: in order, within the scene, and those of images where images are meant."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array, read_only
from sceneloom.checks.annotation_table import (
    PartTable,
    camera_rows,
    point_projections,
    projections,
    timed_parts,
)
from sceneloom.checks.repairing import repaired_annotations
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.relations import EventAnnotation
from sceneloom.scene.findings import Severity
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import scene_period_ns, time_span

_LEAST_TOLERANCE_NS = 1_000_000
"""Times are written in microseconds and images are moved by half an exposure: a millisecond is no difference."""

_BESIDE_NS = 1_000_000_000
"""What lies no farther than a second from the scene was cut off with it, or comes after it."""

_SAME_IMAGE = 4
"""A time within this part of an image's interval means that image."""


def _not_increasing(subject: Subject) -> Iterator[Hit]:
    table = timed_parts(subject)
    times = table.timestamps_ns
    bad = np.zeros(len(times), bool)
    bad[1:] = (times[1:] <= times[:-1]) & table.inner

    def state(row: int) -> str:
        return f"{times[row]} ns after {times[row - 1]} ns; expected later times than those before"

    yield from table.hits(subject, bad, state, within=".timestamps")
    for k, attribute in enumerate(subject.scene.attributes):
        own = attribute.timestamps_ns
        rows = [] if own is None else np.flatnonzero(own[1:] <= own[:-1]).tolist()
        if own is not None and rows:
            row = rows[0] + 1
            problem = f"{own[row]} ns after {own[row - 1]} ns; expected later times than those before"
            yield Hit(f"attributes[{k}].timestamps[{row}]", problem, count=len(rows))


def _sorted_times(scene: Scene) -> Scene:
    """Sort paths by time and drop repeated rows; a path with two different rows at one time stays as it is."""
    scene = repaired_annotations(scene, _with_sorted_parts)
    attributes = _ordered(scene.attributes)
    return scene if attributes is scene.attributes else replace(scene, attributes=attributes)


_PARTS = ("path", "paths", "activations", "projections", "attributes")


def _with_sorted_parts(annotation: Any) -> Any:
    changed = {}
    for name in _PARTS:
        part = getattr(annotation, name, None)
        ordered = _ordered(part)
        if ordered is not part:
            changed[name] = ordered
    return replace(annotation, **changed) if changed else annotation


def _ordered(part: Any) -> Any:
    if isinstance(part, tuple):
        inner = tuple(_ordered(item) for item in part)
        return part if all(new is old for new, old in zip(inner, part, strict=True)) else inner
    times = getattr(part, "timestamps_ns", None)
    if times is None or len(times) < 2 or (times[1:] > times[:-1]).all():
        return part
    columns = {name: getattr(part, name) for name in _COLUMNS if getattr(part, name, None) is not None}
    if any(len(column) != len(times) for column in columns.values()):
        return part
    rows = _rows_in_order(times, columns)
    if rows is None:
        return part
    return replace(
        part,
        timestamps_ns=read_only(times[rows]),
        **{name: _taken(column, rows) for name, column in columns.items()},
    )


_COLUMNS = ("values", "vertices", "durations_ns", "cuboids", "boxes", "confirmed", "points", "positions")
"""What parts of annotations hold for each timestamp."""


def _rows_in_order(times: Int64Array, columns: dict[str, Any]) -> list[int] | None:
    """The rows by time, each time once; None where two rows of one time differ."""
    rows: list[int] = []
    for row in np.argsort(times, kind="stable").tolist():
        if not rows or times[row] != times[rows[-1]]:
            rows.append(row)
        elif any(not _alike(column[row], column[rows[-1]]) for column in columns.values()):
            return None
    return rows


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=True)
    return bool(one == other)


def _taken(column: Any, rows: Sequence[int]) -> Any:
    return read_only(column[rows]) if isinstance(column, np.ndarray) else tuple(column[k] for k in rows)


def _empty(subject: Subject) -> Iterator[Hit]:
    table = timed_parts(subject)
    for part in np.flatnonzero(np.diff(table.starts) == 0).tolist():
        if table.suffixes[part].startswith(".path"):
            yield Hit(table.location(subject, part), "no keyframes; expected at least one")
    for path, annotation in subject.annotations():
        if isinstance(annotation, PointsAnnotation) and not annotation.paths:
            yield Hit(f"{path}.paths", "no points; expected at least one")


def _bounds(subject: Subject) -> tuple[int, int] | None:
    """When annotations may begin and end [ns]: within the sensors' times and one sweep more at each end."""
    return subject.table("the scene's time with a sweep around it", _make_bounds)


_LEAST_NS, _MOST_NS = -(2**63), 2**63 - 1


def _make_bounds(subject: Subject) -> tuple[int, int] | None:
    span = time_span(subject.scene)
    if span is None:
        return None
    period_ns = scene_period_ns(subject.scene)
    return max(span[0] - period_ns, _LEAST_NS), min(span[1] + period_ns, _MOST_NS)


def _outside(subject: Subject) -> Iterator[Hit]:
    """Find what lies outside as a whole, and not just beside the scene."""
    bounds, table = _bounds(subject), timed_parts(subject)
    if bounds is None:
        return
    for part in np.flatnonzero(np.diff(table.starts) > 0).tolist() if _may_be_outside(table, bounds) else ():
        times = table.timestamps_ns[table.starts[part] : table.starts[part + 1]]
        if _is_outside(int(times.min()), int(times.max()), bounds) and not _holds_always(
            subject, table, part
        ):
            nearest = int(times.min()) if times.min() > bounds[1] else int(times.max())
            yield Hit(
                f"{table.location(subject, part)}.timestamps", _stated_outside(nearest, bounds), len(times)
            )
    for path, event in _events(subject):
        length_ns = event.duration_ns or 0
        stop_ns = event.start_ns + (int(length_ns) if 0 < length_ns < np.inf else 0)
        if _is_outside(event.start_ns, stop_ns, bounds):
            yield Hit(f"{path}.start", _stated_outside(event.start_ns, bounds))


def _is_outside(first_ns: int, last_ns: int, bounds: tuple[int, int]) -> bool:
    return first_ns > bounds[1] + _BESIDE_NS or last_ns < bounds[0] - _BESIDE_NS


def _may_be_outside(table: PartTable, bounds: tuple[int, int]) -> bool:
    """Whether any time lies that far out; most scenes need no look at each part."""
    times = table.timestamps_ns
    return len(times) > 0 and _is_outside(int(times.max()), int(times.min()), bounds)


def _beyond(subject: Subject) -> Iterator[Hit]:
    """Count the parts that reach beyond the scene, or lie just beside it, and name the one that reaches farthest."""
    bounds, table = _bounds(subject), timed_parts(subject)
    if bounds is None:
        return
    times = table.timestamps_ns
    rows = np.flatnonzero((times < bounds[0]) | (times > bounds[1]))
    parts = np.searchsorted(table.starts, rows, side="right") - 1
    reported = {
        part
        for part in np.unique(parts).tolist()
        if not _holds_always(subject, table, part)
        and not _part_is_outside(table, part, bounds)
        and not isinstance(table.parts[part], Poses)  # corrections have poses around what they correct
    }
    rows = rows[np.isin(parts, list(reported))]
    if len(rows):
        far = times[rows].astype(np.float64)  # differences of int64 may be none of int64
        row = int(rows[np.argmax(np.maximum(bounds[0] - far, far - bounds[1]))])
        part = int(np.searchsorted(table.starts, row, side="right") - 1)
        others = f"; of {len(reported)} that reach beyond, it reaches farthest" if len(reported) > 1 else ""
        location = f"{table.location(subject, part)}.timestamps[{row - int(table.starts[part])}]"
        yield Hit(location, _stated_outside(int(times[row]), bounds) + others, count=len(reported))


def _part_is_outside(table: PartTable, part: int, bounds: tuple[int, int]) -> bool:
    times = table.timestamps_ns[table.starts[part] : table.starts[part + 1]]
    return _is_outside(int(times.min()), int(times.max()), bounds)


def _holds_always(subject: Subject, table: PartTable, part: int) -> bool:
    """Whether a part holds at all times: of something that is stationary, or a static attribute."""
    annotation, found = subject.scene.annotations[int(table.numbers[part])], table.parts[part]
    return bool(getattr(annotation, "stationary", None)) or (
        isinstance(found, AttributePath) and bool(found.static)
    )


def _stated_outside(time_ns: int, bounds: tuple[int, int]) -> str:
    first_ns, last_ns = bounds
    away = (first_ns - time_ns if time_ns < first_ns else time_ns - last_ns) / 1e9
    side = "before the scene begins" if time_ns < first_ns else "after the scene ends"
    return f"{away:.3f} s {side} ({time_ns} ns; the sensors' times are {first_ns} to {last_ns} ns)"


def _events(subject: Subject) -> Iterator[tuple[str, EventAnnotation]]:
    for path, annotation in subject.annotations():
        if isinstance(annotation, EventAnnotation):
            yield path, annotation


def _negative_durations(subject: Subject) -> Iterator[Hit]:
    for path, event in _events(subject):
        if event.duration_ns is not None and not event.duration_ns >= 0:
            yield Hit(f"{path}.duration", f"{event.duration_ns} ns; expected a duration of 0 or more")
    for path, annotation in subject.annotations():
        for k, activation in enumerate(
            annotation.activations if isinstance(annotation, CuboidAnnotation) else ()
        ):
            bad = [row for row, length in enumerate(activation.durations_ns or ()) if not length >= 0]
            if bad:
                length = (activation.durations_ns or ())[bad[0]]
                location = f"{path}.activations[{k}].durations[{bad[0]}]"
                yield Hit(location, f"{length} ns; expected a duration of 0 or more", count=len(bad))


def _without_image(subject: Subject) -> Iterator[Hit]:
    for table in (projections(subject), point_projections(subject)):
        times_ns, bad = table.timestamps_ns, np.zeros(len(table.timestamps_ns), bool)
        for camera, rows in camera_rows(subject, table):
            bad[rows] = _far_from_images(camera.images.timestamps_ns, times_ns[rows])

        def state(row: int, times_ns: Int64Array = times_ns) -> str:
            return f"the camera has no image at {times_ns[row]} ns"

        yield from table.hits(subject, bad, state, within=".timestamps")


def _far_from_images(images_ns: Int64Array, times_ns: Int64Array) -> BoolArray:
    if len(images_ns) == 0:
        return np.zeros(len(times_ns), bool)
    images_ns = np.sort(images_ns)
    interval_ns = int(np.median(np.diff(images_ns))) if len(images_ns) > 1 else 0
    after = np.searchsorted(images_ns, times_ns)
    before_ns = times_ns - images_ns[(after - 1).clip(0)]
    after_ns = images_ns[after.clip(max=len(images_ns) - 1)] - times_ns
    away_ns = np.minimum(np.abs(before_ns), np.abs(after_ns))
    far: BoolArray = away_ns > max(_LEAST_TOLERANCE_NS, interval_ns // _SAME_IMAGE)
    return far


RULES: tuple[Rule, ...] = (
    Rule(
        "annotation-times-increasing",
        Severity.ERROR,
        "The keyframes of a path, and the times of activations, projections and attributes, those of the scene among "
        "them, strictly increase.",
        "Sort them by time; of two at one time, decide which is meant.",
        find=_not_increasing,
        fix=_sorted_times,
    ),
    Rule(
        "annotation-path-empty",
        Severity.WARNING,
        "Every path has at least one keyframe.",
        "Give it keyframes, or take the annotation out.",
        find=_empty,
    ),
    Rule(
        "annotation-outside-scene",
        Severity.WARNING,
        "No annotation lies outside the time of the scene by more than a second.",
        "Look whether the annotations count time in another unit or from another start than the sensors.",
        find=_outside,
    ),
    Rule(
        "annotation-beyond-scene",
        Severity.HINT,
        "Annotations lie within the time of the scene, give or take one sweep.",
        "Cut the scene with its annotations (`sceneloom edit crop`) if the rest is of no use.",
        find=_beyond,
    ),
    Rule(
        "annotation-duration",
        Severity.ERROR,
        "Events and activations end no sooner than they begin.",
        "Set the duration to how long it lasts.",
        find=_negative_durations,
    ),
    Rule(
        "projection-without-image",
        Severity.WARNING,
        "The times of a projection are times of images of its camera.",
        "Project at the times of the images.",
        find=_without_image,
    ),
)
