"""Rules about what is drawn into images; those of the sound scene are 32 x 24 px."""

import numpy as np
import pytest

from sceneloom.scene import (
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)

PERIOD = 100_000_000
TIMES = np.arange(2, dtype=np.int64) * PERIOD
NULL = [np.nan] * 4
RULES = (
    "box-not-finite",
    "box-negative-size",
    "box-without-area",
    "box-outside-image",
    "box-beyond-image",
    "null-box-confirmed",
)


def drawn(row, sensor_id="front"):
    return Box2DAnnotation("box", sensor_id, BoxPath(TIMES, np.array([[1.0, 1, 5, 5], row])))


def projected(row, confirmed=None):
    seen = Projection("front", TIMES, np.array([[1.0, 1, 5, 5], row]), confirmed)
    return CuboidAnnotation("car", CuboidPath(TIMES, np.ones((2, 9))), projections=(seen,))


def outlined(*vertices, name="shape"):
    return ShapeAnnotation(
        name, ShapeType.POLYGON_2D, VertexPath(TIMES[:1], (np.array(vertices, float),)), sensor_id="front"
    )


def test_a_sound_scene_keeps_all_of_them(sound, found):
    empty = CuboidAnnotation(
        "other", CuboidPath(TIMES, np.ones((2, 9))), projections=(Projection("front", TIMES),)
    )
    annotations = (
        drawn([0, 0, 32, 24]),
        projected(NULL, (True, False)),
        outlined([0, 0], [32, 0], [16, 24]),
        empty,
    )
    scene = sound.scene(annotations=annotations)
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


@pytest.mark.parametrize(
    ("rule", "row", "near"),
    [
        ("box-not-finite", [np.nan, 1, 2, 2], [0, 1, 2, 2]),
        ("box-not-finite", [np.inf, 1, 2, 2], [0, 1, 2, 2]),
        ("box-negative-size", [5, 5, -1, 2], [5, 5, 0, 2]),
        ("box-without-area", [5, 5, 3, 0], [5, 5, 3, 0.1]),
        ("box-outside-image", [33.5, 5, 4, 4], [32.5, 5, 4, 4]),
        ("box-outside-image", [3, -6, 4, 4.5], [3, -6, 4, 5.5]),
        ("box-beyond-image", [-1.5, 5, 4, 4], [-0.5, 5, 4, 4]),
        ("box-beyond-image", [3, 5, 4, 20.5], [3, 5, 4, 19.5]),
    ],
)
def test_boxes_drawn_and_projected_are_judged_alike(sound, found, rule, row, near):
    scene = sound.scene(annotations=(drawn(row), projected(row)))
    assert [path for path, _ in found(scene, rule)] == [
        "annotations[0].path.values[1]",
        "annotations[1].projections[0].boxes[1]",
    ]
    assert found(sound.scene(annotations=(drawn(near), projected(near))), rule) == []


def test_a_box_drawn_cannot_be_null(sound, found):
    assert len(found(sound.scene(annotations=(drawn(NULL),)), "box-not-finite")) == 1


def test_a_box_outside_is_not_reported_to_reach_beyond_too(sound, found):
    scene = sound.scene(annotations=(drawn([50, 5, 4, 4]),))
    assert found(scene, "box-beyond-image") == []


def test_boxes_of_unknown_cameras_and_of_lidars_are_left_to_other_rules(sound, found):
    for sensor_id in ("gone", "top"):
        scene = sound.scene(annotations=(drawn([90, 5, 4, 4], sensor_id),))
        assert found(scene, "box-outside-image") == []


def test_shapes_and_points_outside_are_found(sound, found):
    point = PointProjection("front", TIMES, np.array([[3.0, 3.0], [60.0, 3.0]]))
    keypoints = PointsAnnotation("hand", (PointPath(TIMES, np.ones((2, 3))),), projections=((point,),))
    annotations = (
        outlined([40, 3], [45, 3], [45, 9]),
        keypoints,
        outlined([30, 3], [40, 3], [40, 9], name=2),
    )
    scene = sound.scene(annotations=annotations)
    assert [path for path, _ in found(scene, "box-outside-image")] == [
        "annotations[0].path.values[0]",
        "annotations[1].projections[0][0].points[1]",
    ]
    assert [path for path, _ in found(scene, "box-beyond-image")] == ["annotations[2].path.values[0]"]


def test_a_null_that_a_person_confirmed_is_found(sound, found):
    scene = sound.scene(annotations=(projected(NULL, (True, True)),))
    assert found(scene, "null-box-confirmed") == [
        ("annotations[0].projections[0].confirmed[1]", "true, yet boxes[1] is null")
    ]
    assert found(sound.scene(annotations=(projected(NULL, (True, None)),)), "null-box-confirmed") == []
