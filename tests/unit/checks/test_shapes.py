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


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    annotations = [
        shape(ShapeType.POLYGON_2D, SQUARE, SQUARE + 1),
        lifted(SQUARE),
        shape(ShapeType.POINT, [[1, 2, 3]]),
        shape(ShapeType.POLYLINE, [[0, 0, 0], [1, 1, 1]]),
        points(labels=("tip", "root"), projections=((), ())),
    ]
    scenes = [sound.scene(annotations=(annotation,)) for annotation in annotations]
    assert all(keeps(scene, SHAPE_RULES) for scene in scenes)


@pytest.mark.parametrize(
    ("kind", "least"),
    [
        (ShapeType.POLYGON, 3),
        (ShapeType.POLYGON_2D, 3),
        (ShapeType.POLYGON_TOPDOWN, 3),
        (ShapeType.POLYLINE, 2),
        (ShapeType.POLYLINE_2D, 2),
        (ShapeType.POINT, 1),
        (ShapeType.POINT_2D, 1),
        (ShapeType.POINT_TOPDOWN, 1),
    ],
)
def test_a_shape_of_too_few_vertices_is_found(sound, found, kind, least):
    vertices = np.random.default_rng(0).normal(size=(least, 2 if kind in FLAT_TYPES else 3))
    few = sound.scene(annotations=(shape(kind, vertices[:-1]),))
    assert [path for path, _ in found(few, "shape-vertices")] == ["annotations[0].path.values[0]"]
    assert found(sound.scene(annotations=(shape(kind, vertices),)), "shape-vertices") == []


def test_a_point_of_two_vertices_is_reported(sound, found):
    scene = sound.scene(annotations=(shape(ShapeType.POINT, np.eye(3)[:2]),))
    assert [message for _, message in found(scene, "point-of-several")] == ["2 vertices; a point has one"]


def test_numbers_that_are_not_finite_are_found(sound, found):
    broken = np.array([[0.0, 0], [4, np.nan], [4, 4]])
    lost = points(paths=(PointPath(TIMES, np.array([[1.0, 1, 1], [np.inf, 1, 1]])),))
    scene = sound.scene(
        annotations=(shape(ShapeType.POLYGON_2D, SQUARE, broken), PointsAnnotation("other", lost.paths))
    )
    assert [path for path, _ in found(scene, "shape-not-finite")] == [
        "annotations[0].path.values[1]",
        "annotations[1].paths[0].values[1]",
    ]


@pytest.mark.parametrize(("size", "limit"), [(1.0, 0.02), (10.0, 0.1)])
def test_a_polygon_is_flat_within_its_tolerance(sound, found, size, limit):
    """Of a square whose corners go up and down alternately, the plane goes through the middle: each is off by h.

    The polygon is as large as its diagonal, `size`.
    """
    outline = (SQUARE - 2) / 4 * size / np.sqrt(2)
    up_and_down = np.array([1, -1, 1, -1])
    bent = sound.scene(annotations=(lifted(outline, up_and_down * limit * 1.05),))
    assert [path for path, _ in found(bent, "polygon-not-flat")] == ["annotations[0].path.values[0]"]
    flat = sound.scene(annotations=(lifted(outline, up_and_down * limit * 0.95),))
    assert found(flat, "polygon-not-flat") == []


def test_only_plain_polygons_in_space_have_to_be_flat(sound, found):
    area = lifted(SQUARE, [0, 3, 0, 3], ShapeType.POLYGON_TOPDOWN)
    assert found(sound.scene(annotations=(area,)), "polygon-not-flat") == []


@pytest.mark.parametrize("kind", [ShapeType.POLYGON, ShapeType.POLYGON_2D, ShapeType.POLYGON_TOPDOWN])
def test_edges_that_cross_are_found_and_a_notch_is_not(sound, found, kind):
    notched = np.array([[0.0, 0], [4, 0], [2, 1.9], [4, 4], [0, 4]])

    def made(outline):
        if kind == ShapeType.POLYGON:
            return lifted(outline)
        flat = outline if kind == ShapeType.POLYGON_2D else np.column_stack([outline, np.arange(len(outline))])
        return shape(kind, flat)

    assert len(found(sound.scene(annotations=(made(BOW_TIE),)), "polygon-crosses-itself")) == 1
    for outline in (notched, notched[::-1], np.vstack([notched, notched[:1]])):
        assert found(sound.scene(annotations=(made(outline),)), "polygon-crosses-itself") == []


def test_crossings_are_those_of_a_slow_search(sound, found):
    """Twenty outlines of random vertices, against every pair of edges by the parameters of their meeting point."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        outline = rng.uniform(0, 10, (5, 2))
        scene = sound.scene(annotations=(shape(ShapeType.POLYGON_2D, outline),))
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


def test_outlines_of_other_lengths_are_reported(sound, found):
    scene = sound.scene(annotations=(shape(ShapeType.POLYGON_2D, SQUARE, SQUARE[:3]),))
    [(path, message)] = found(scene, "vertex-count-changes")
    assert path == "annotations[0].path.values[1]"
    assert message.startswith("3 vertices after 4")


def test_points_need_labels_projections_and_rows_of_their_own(sound, found):
    wide = PointPath(TIMES, np.ones((2, 6)), id=9)
    scene = sound.scene(annotations=(points(labels=("tip",), projections=((),), paths=(wide, *points().paths)),))
    assert [path for path, _ in found(scene, "points-annotation-counts")] == [
        "annotations[0].labels",
        "annotations[0].projections",
        "annotations[0].paths[0].values",
    ]


def test_points_of_one_id_are_found_and_those_without_are_not(sound, found):
    named = [PointPath(TIMES, np.ones((2, 3)), id=name) for name in ("a", 1, "1", "a")]
    nameless = PointPath(TIMES, np.ones((2, 3)))
    scene = sound.scene(annotations=(points(paths=(*named, nameless, nameless)),))
    assert found(scene, "points-annotation-ids") == [("annotations[0].paths[3].id", "'a' is the id of paths[0], too")]


def holder(*attributes):
    return ObjectAnnotation("o", attributes=attributes)


def test_a_sound_scene_keeps_all_rules_about_attributes(sound, keeps):
    attributes = (
        AttributePath("colour", ("red",), static=True),
        AttributePath("state", ("parked", "moving"), TIMES),
        AttributePath("speed", (1, 2.5), TIMES),
        AttributePath("lights", (("left", "brake"), ()), TIMES),
    )
    scene = sound.scene(annotations=(holder(*attributes),), attributes=attributes)
    assert keeps(scene, ATTRIBUTE_RULES)


@pytest.mark.parametrize("value", [True, None, {"a": 1}, ("a", 1)])
def test_values_that_the_format_does_not_have_are_found(sound, found, value):
    attribute = AttributePath("state", ("parked", value), TIMES)
    scene = sound.scene(annotations=(holder(attribute),), attributes=(attribute,))
    assert [path for path, _ in found(scene, "attribute-value-type")] == [
        "attributes[0].values[1]",
        "annotations[0].attributes[0].values[1]",
    ]


def test_text_and_numbers_alternately_are_reported(sound, found):
    scene = sound.scene(annotations=(holder(AttributePath("lane", (1, "2"), TIMES)),))
    assert [message for _, message in found(scene, "attribute-kinds-mixed")] == [
        "'lane' is a number and text alternately"
    ]


def test_static_values_that_differ_are_found_and_equal_ones_reported_once(sound, found, fixed):
    changing = AttributePath("colour", ("red", "blue"), TIMES, static=True)
    repeated = AttributePath("make", ("vw", "vw"), TIMES, static=True)
    scene = sound.scene(annotations=(holder(changing, repeated),))
    assert [path for path, _ in found(scene, "attribute-static-changes")] == ["annotations[0].attributes[0].values[1]"]
    assert [path for path, _ in found(scene, "attribute-static-repeats")] == ["annotations[0].attributes[1]"]
    [repaired] = fixed(scene, "attribute-static-repeats").annotations
    assert repaired.attributes[0] is changing
    assert (repaired.attributes[1].values, repaired.attributes[1].timestamps_ns.tolist()) == (("vw",), [0])


def test_values_that_change_need_times(sound, found):
    unequal = AttributePath("state", ("parked",), TIMES)
    scene = sound.scene(annotations=(holder(AttributePath("state", ("parked", "moving")), unequal),))
    assert found(scene, "attribute-times") == [
        ("annotations[0].attributes[0]", "'state' has 2 values and no timestamps"),
        ("annotations[0].attributes[1]", "'state' has 2 timestamps and 1 values"),
    ]
