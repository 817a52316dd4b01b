"""Rules about shapes, points annotations and attributes."""

import numpy as np
import pytest

from sceneloom.checks.shapes import ATTRIBUTE_RULES, SHAPE_RULES
from sceneloom.geometry.rigid import matrix_from_quaternion
from sceneloom.scene import (
    AttributePath,
    ObjectAnnotation,
    PointPath,
    PointsAnnotation,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)

TIMES = np.arange(2, dtype=np.int64) * 100_000_000
SQUARE = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
BOW_TIE = SQUARE[[0, 2, 1, 3]]
TILT = matrix_from_quaternion(np.array([0.3, -0.5, 0.2, 0.8]) / np.linalg.norm([0.3, -0.5, 0.2, 0.8]))
FLAT_TYPES = [kind for kind in ShapeType if kind.value.endswith("_2d")]


def shape(kind, *outlines):
    path = VertexPath(TIMES[: len(outlines)], tuple(np.asarray(outline, float) for outline in outlines))
    return ShapeAnnotation("s", kind, path, sensor_id="front" if kind in FLAT_TYPES else None)


def lifted(outline, heights=0.0, kind=ShapeType.POLYGON):
    """An outline in a tilted plane far from the origin, its vertices that far off the plane [m]."""
    flat = np.column_stack([outline, np.broadcast_to(heights, len(outline))])
    return shape(kind, flat @ TILT.T + [100.0, 50.0, 7.0])


def points(**fields):
    paths = tuple(PointPath(TIMES, np.ones((2, 3)), id=k) for k in range(2))
    return PointsAnnotation("hand", **{"paths": paths, **fields})


def flat_or_lifted(kind, outline):
    if kind == ShapeType.POLYGON:
        return lifted(outline)
    heights = [] if kind == ShapeType.POLYGON_2D else [np.arange(len(outline))]
    return shape(kind, np.column_stack([outline, *heights]))


def holder(*attributes):
    return ObjectAnnotation("o", attributes=attributes)


NOTCHED = np.array([[0.0, 0], [4, 0], [2, 1.9], [4, 4], [0, 4]])
UP_AND_DOWN = np.array([1, -1, 1, -1])
WIDE = PointPath(TIMES, np.ones((2, 6)), id=9)
LOST = PointsAnnotation("other", (PointPath(TIMES, np.array([[1.0, 1, 1], [np.inf, 1, 1]])),))
NAMED = tuple(PointPath(TIMES, np.ones((2, 3)), id=name) for name in ("a", 1, "1", "a", None, None))


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    annotations = [
        shape(ShapeType.POLYGON_2D, SQUARE, SQUARE + 1),
        lifted(SQUARE),
        shape(ShapeType.POINT, [[1, 2, 3]]),
        shape(ShapeType.POLYLINE, [[0, 0, 0], [1, 1, 1]]),
        points(labels=("tip", "root"), projections=((), ())),
    ]
    assert all(keeps(sound.scene(annotation), SHAPE_RULES) for annotation in annotations)
    attributes = (
        AttributePath("colour", ("red",), static=True),
        AttributePath("state", ("parked", "moving"), TIMES),
        AttributePath("speed", (1, 2.5), TIMES),
        AttributePath("lights", (("left", "brake"), ()), TIMES),
    )
    assert keeps(sound.scene(holder(*attributes), attributes=attributes), ATTRIBUTE_RULES)


def test_shapes_and_attributes(check, sound):
    check(
        "point-of-several",
        "annotations[0].path.values[0]: 2 vertices; a point has one",
        shape(ShapeType.POINT, np.eye(3)[:2]),
    )
    check(
        "shape-not-finite",
        ["annotations[0].path.values[1]", "annotations[1].paths[0].values[1]"],
        shape(ShapeType.POLYGON_2D, SQUARE, [[0, 0], [4, np.nan], [4, 4]]),
        LOST,
    )
    # only plain polygons in space have to be flat
    check("polygon-not-flat", "", lifted(SQUARE, [0, 3, 0, 3], ShapeType.POLYGON_TOPDOWN))
    check(
        "vertex-count-changes",
        "annotations[0].path.values[1]: 3 vertices after 4",
        shape(ShapeType.POLYGON_2D, SQUARE, SQUARE[:3]),
    )
    check(
        "points-annotation-counts",
        ["annotations[0].labels", "annotations[0].projections", "annotations[0].paths[0].values"],
        points(labels=("tip",), projections=((),), paths=(WIDE, *points().paths)),
    )
    check("points-annotation-ids", "annotations[0].paths[3].id: 'a' is the id of paths[0], too", points(paths=NAMED))
    check(
        "attribute-kinds-mixed",
        "annotations[0].attributes[0].values: 'lane' is a number and text alternately",
        holder(AttributePath("lane", (1, "2"), TIMES)),
    )
    check(
        "attribute-times",
        [
            "annotations[0].attributes[0]: 'state' has 2 values and no timestamps",
            "annotations[0].attributes[1]: 'state' has 2 timestamps and 1 values",
        ],
        holder(AttributePath("state", ("parked", "moving")), AttributePath("state", ("parked",), TIMES)),
    )


@pytest.mark.parametrize("kind", ShapeType)
def test_a_shape_of_too_few_vertices_is_found(check, kind):
    least = {"polygon": 3, "polyline": 2, "point": 1}[kind.value.split("_")[0]]
    vertices = np.random.default_rng(0).normal(size=(least, 2 if kind in FLAT_TYPES else 3))
    check("shape-vertices", "annotations[0].path.values[0]", shape(kind, vertices[:-1]))
    check("shape-vertices", "", shape(kind, vertices))


@pytest.mark.parametrize(("size", "limit"), [(1.0, 0.02), (10.0, 0.1)])
def test_a_polygon_is_flat_within_its_tolerance(check, size, limit):
    """Of a square whose corners go up and down alternately, the plane goes through the middle: each is off by h.

    The polygon is as large as its diagonal, `size`.
    """
    outline = (SQUARE - 2) / 4 * size / np.sqrt(2)
    check("polygon-not-flat", "annotations[0].path.values[0]", lifted(outline, UP_AND_DOWN * limit * 1.05))
    check("polygon-not-flat", "", lifted(outline, UP_AND_DOWN * limit * 0.95))


@pytest.mark.parametrize("kind", [ShapeType.POLYGON, ShapeType.POLYGON_2D, ShapeType.POLYGON_TOPDOWN])
def test_edges_that_cross_are_found_and_a_notch_is_not(check, kind):
    check("polygon-crosses-itself", "annotations[0].path.values[0]", flat_or_lifted(kind, BOW_TIE))
    for outline in (NOTCHED, NOTCHED[::-1], np.vstack([NOTCHED, NOTCHED[:1]])):
        check("polygon-crosses-itself", "", flat_or_lifted(kind, outline))


def test_crossings_are_those_of_a_slow_search(sound, found):
    """Twenty outlines of random vertices, against every pair of edges by the parameters of their meeting point."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        outline = rng.uniform(0, 10, (5, 2))
        scene = sound.scene(shape(ShapeType.POLYGON_2D, outline))
        assert bool(found(scene, "polygon-crosses-itself")) == crosses(outline)


def crosses(outline):
    count = len(outline)
    for i in range(count):
        for j in range(i + 2, count - (i == 0)):
            a, b = outline[i], outline[(i + 1) % count]
            c, d = outline[j], outline[(j + 1) % count]
            s, t = np.linalg.solve(np.column_stack([b - a, c - d]), c - a)
            if 0 < s < 1 and 0 < t < 1:
                return True
    return False


@pytest.mark.parametrize("value", [True, None, {"a": 1}, ("a", 1)])
def test_values_that_the_format_does_not_have_are_found(check, sound, value):
    attribute = AttributePath("state", ("parked", value), TIMES)
    check(
        "attribute-value-type",
        ["attributes[0].values[1]", "annotations[0].attributes[0].values[1]"],
        sound.scene(holder(attribute), attributes=(attribute,)),
    )


def test_static_values_that_differ_are_found_and_equal_ones_reported_once(sound, found, fixed):
    changing = AttributePath("colour", ("red", "blue"), TIMES, static=True)
    repeated = AttributePath("make", ("vw", "vw"), TIMES, static=True)
    scene = sound.scene(holder(changing, repeated))
    assert [path for path, _ in found(scene, "attribute-static-changes")] == ["annotations[0].attributes[0].values[1]"]
    assert [path for path, _ in found(scene, "attribute-static-repeats")] == ["annotations[0].attributes[1]"]
    [repaired] = fixed(scene, "attribute-static-repeats").annotations
    assert repaired.attributes[0] is changing
    assert (repaired.attributes[1].values, repaired.attributes[1].timestamps_ns.tolist()) == (("vw",), [0])
