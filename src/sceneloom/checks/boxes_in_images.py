"""Rules about what is drawn into images: boxes and shapes with a size, inside the image."""

from collections.abc import Callable, Iterator

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.checks.annotation_table import (
    PartTable,
    box_paths,
    camera_rows,
    point_projections,
    projections,
    shape_paths,
)
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene.findings import Severity

_SLACK_PX = 1.0
"""A box may end this far outside the image: some count pixels from 1, or to the last one's centre."""


def _boxes(subject: Subject) -> Iterator[tuple[PartTable, Float64Array, str]]:
    """All boxes in images, (R, 4) `left top width height` [px], each with its table and its name there."""

    def made(_: Subject) -> list[tuple[PartTable, Float64Array, str]]:
        paths, seen = box_paths(subject), projections(subject)
        return [
            (paths, paths.rows(lambda path: path.values, 4), ".values"),
            (seen, seen.rows(lambda part: _or_nan(part.boxes, len(part.timestamps_ns), 4), 4), ".boxes"),
        ]

    yield from subject.table("boxes in images", made)


def _or_nan(values: Float64Array | None, count: int, columns: int) -> Float64Array:
    return np.full((count, columns), np.nan) if values is None else values


def _box_hits(subject: Subject, judge: Callable[[Float64Array], BoolArray], expected: str) -> Iterator[Hit]:
    for table, boxes, name in _boxes(subject):
        bad = judge(boxes)

        def state(row: int, boxes: Float64Array = boxes) -> str:
            return f"{_reported(boxes[row])}; expected {expected}"

        yield from table.hits(subject, bad, state, within=name)


def _reported(box: Float64Array) -> str:
    left, top, width, height = box.tolist()
    return f"{width:g} x {height:g} px at ({left:g}, {top:g})"


def _null(boxes: Float64Array) -> BoolArray:
    return np.asarray(np.isnan(boxes).all(axis=1))


def _negative(subject: Subject) -> Iterator[Hit]:
    return _box_hits(
        subject, lambda boxes: np.asarray((boxes[:, 2:] < 0).any(axis=1)), "no negative width or height"
    )


def _without_area(subject: Subject) -> Iterator[Hit]:
    def judge(boxes: Float64Array) -> BoolArray:
        return np.asarray((boxes[:, 2:] == 0).any(axis=1) & (boxes[:, 2:] >= 0).all(axis=1))

    return _box_hits(subject, judge, "a width and a height")


def _partly_finite(subject: Subject) -> Iterator[Hit]:
    for table, boxes, name in _boxes(subject):
        bad = ~np.isfinite(boxes).all(axis=1)
        if name == ".boxes":
            bad &= ~_null(boxes)

        def state(row: int, boxes: Float64Array = boxes) -> str:
            return f"{boxes[row].tolist()}; expected finite numbers"

        yield from table.hits(subject, np.asarray(bad), state, within=name)
    points = point_projections(subject)
    spots = points.rows(lambda part: _or_nan(part.points, len(part.timestamps_ns), 2), 2)
    bad = ~np.isfinite(spots).all(axis=1) & ~_null(spots)
    yield from points.hits(
        subject,
        np.asarray(bad),
        lambda row: f"{spots[row].tolist()}; expected finite numbers",
        within=".points",
    )


def _null_confirmed(subject: Subject) -> Iterator[Hit]:
    named = ((projections(subject), "boxes", 4), (point_projections(subject), "points", 2))
    for table, name, columns in named:
        for number, part in enumerate(table.parts):
            values = _or_nan(getattr(part, name), len(part.timestamps_ns), columns)
            if part.confirmed is None or getattr(part, name) is None:
                continue
            rows = np.flatnonzero(_null(values) & np.array([flag is True for flag in part.confirmed], bool))
            if len(rows):
                location = f"{table.location(subject, number)}.confirmed[{rows[0]}]"
                yield Hit(location, f"true, yet {name}[{rows[0]}] is null", count=len(rows))


def _extents(subject: Subject) -> Iterator[tuple[PartTable, Float64Array, str]]:
    """What is drawn into images, as (R, 4) `left top right bottom` [px]; NaN where there is nothing to judge."""
    for table, boxes, name in _boxes(subject):
        corners = boxes.copy()
        corners[:, 2:] += boxes[:, :2]
        yield table, corners, name
    shapes = shape_paths(subject)
    if len(shapes.timestamps_ns):
        yield shapes, np.array([_around(v) for path in shapes.parts for v in path.vertices]), ".values"
    points = point_projections(subject)
    spots = points.rows(lambda part: _or_nan(part.points, len(part.timestamps_ns), 2), 2)
    yield points, np.hstack([spots, spots]), ".points"


def _around(vertices: Float64Array) -> list[float]:
    if vertices.shape[1] != 2 or len(vertices) == 0:
        return [np.nan] * 4
    return [*vertices.min(axis=0).tolist(), *vertices.max(axis=0).tolist()]


def _outside(subject: Subject, *, wholly: bool) -> Iterator[Hit]:
    for table, extents, name in _extents(subject):
        bad = np.zeros(len(extents), bool)
        sizes = np.zeros((len(extents), 2))
        for camera, rows in camera_rows(subject, table):
            sizes[rows] = camera.camera.width, camera.camera.height
            bad[rows] = True
        gone = ((extents[:, 2:] < -_SLACK_PX) | (extents[:, :2] > sizes + _SLACK_PX)).any(axis=1)
        beyond = ((extents[:, :2] < -_SLACK_PX) | (extents[:, 2:] > sizes + _SLACK_PX)).any(axis=1)
        bad &= gone if wholly else beyond & ~gone

        def state(row: int, extents: Float64Array = extents, sizes: Float64Array = sizes) -> str:
            left, top, right, bottom = extents[row].tolist()
            width, height = sizes[row].tolist()
            reach = f"from ({left:g}, {top:g}) to ({right:g}, {bottom:g})"
            return f"{reach}, of an image of {width:g} x {height:g} px"

        yield from table.hits(subject, bad, state, within=name)


def _outside_image(subject: Subject) -> Iterator[Hit]:
    return _outside(subject, wholly=True)


def _beyond_image(subject: Subject) -> Iterator[Hit]:
    return _outside(subject, wholly=False)


RULES: tuple[Rule, ...] = (
    Rule(
        "box-not-finite",
        Severity.ERROR,
        "All numbers of a box in an image are finite; a projection that is not there is null as a whole.",
        "Write null for a box that is not there.",
        find=_partly_finite,
    ),
    Rule(
        "box-negative-size",
        Severity.ERROR,
        "Width and height of a box in an image are not negative.",
        "Look whether the numbers are left, top, width, height, or two corners.",
        find=_negative,
    ),
    Rule(
        "box-without-area",
        Severity.WARNING,
        "Boxes in images have a width and a height.",
        "Write null for a projection that is not there, and leave keyframes without a box out.",
        find=_without_area,
    ),
    Rule(
        "box-outside-image",
        Severity.WARNING,
        "What is drawn into an image overlaps it.",
        "Look whether it counts pixels of an image of another size, or belongs to another camera.",
        find=_outside_image,
    ),
    Rule(
        "box-beyond-image",
        Severity.HINT,
        f"What is drawn into an image ends at its edges, give or take {_SLACK_PX:g} px.",
        "Clip it to the image if it means what is seen, and keep it if it means the whole object.",
        find=_beyond_image,
    ),
    Rule(
        "null-box-confirmed",
        Severity.WARNING,
        "A projection that a person confirmed is there.",
        "Take the confirmation out, or draw what is missing.",
        find=_null_confirmed,
    ),
)
