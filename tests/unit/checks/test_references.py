"""Rules about ids of annotations and what they name."""

import numpy as np
import pytest

from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
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
ROW = [4.0, 2.0, 1.5, 1.0, 2.0, 0.0, 0.0, 0.0, 30.0]
RULES = (
    "annotation-parent-unknown",
    "annotation-parent-cycle",
    "annotation-sensor-unknown",
    "annotation-sensor-type",
    "link-end-unknown",
    "link-to-itself",
    "attribute-point-unknown",
    "annotation-unused",
    "label-spellings",
)


def cuboid(identifier="car", **fields):
    return CuboidAnnotation(identifier, CuboidPath(TIMES, np.array([ROW, ROW])), **fields)


def box(sensor_id="front"):
    return Box2DAnnotation("box", sensor_id, BoxPath(TIMES[:1], np.array([[1.0, 1, 5, 5]])))


def marked(sensor_id="top"):
    return LabeledPointsAnnotation("road", (LabeledPoints(sensor_id, np.arange(3, dtype=np.uint32), 0),))


def keypoints(**fields):
    return PointsAnnotation("hand", (PointPath(TIMES, np.ones((2, 3))),), **fields)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    attribute = AttributePath("seen", (1, 2), TIMES, sensor_id="top", point_index=0)
    annotations = (
        cuboid(parent_id="o", label="Car", activations=(Activation("top", TIMES),)),
        cuboid("second", label="van", projections=(Projection("front", TIMES[:1]),)),
        box(),
        marked(),
        keypoints(attributes=(attribute,)),
        ObjectAnnotation("o"),
        GroupAnnotation("g"),
        LinkAnnotation("l", "car", "g"),
        ObjectAnnotation("reported", attributes=(AttributePath("colour", ("red",), static=True),)),
        CameraCalibration("c", "front", time_offset_ns=5),
    )
    scene = sound.scene(annotations=annotations)
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


def test_a_parent_that_is_not_there_is_found(sound, found):
    scene = sound.scene(annotations=(cuboid(parent_id="gone"),))
    assert found(scene, "annotation-parent-unknown") == [
        ("annotations[0].parent_id", "'gone' is no annotation of the scene")
    ]


def test_ids_are_compared_with_their_types(sound, found):
    scene = sound.scene(annotations=(cuboid("7"), cuboid("b", parent_id=7)))
    [(path, message)] = found(scene, "annotation-parent-unknown")
    assert path == "annotations[1].parent_id"
    assert "there is one '7', which is another id" in message


def test_a_cycle_of_parents_is_found_once(sound, found):
    names = ["a", "b", "c"]
    ring = [cuboid(name, parent_id=names[(k + 1) % 3]) for k, name in enumerate(names)]
    scene = sound.scene(annotations=(cuboid("outside", parent_id="a"), *ring))
    [(path, message)] = found(scene, "annotation-parent-cycle")
    assert path == "annotations[1].parent_id"
    assert message == "'a' in 'b' in 'c' in 'a'; expected no cycle"


def test_an_annotation_that_is_its_own_parent_is_a_cycle(sound, found):
    scene = sound.scene(annotations=(cuboid("a", parent_id="a"),))
    assert len(found(scene, "annotation-parent-cycle")) == 1


def test_two_ways_to_one_parent_are_no_cycle(sound, found):
    scene = sound.scene(annotations=(cuboid("a", parent_id="c"), cuboid("b", parent_id="c"), cuboid("c")))
    assert found(scene, "annotation-parent-cycle") == []


@pytest.mark.parametrize(
    ("annotation", "location"),
    [
        (box("gone"), "annotations[0].sensor_id"),
        (marked("gone"), "annotations[0].labeled_points[0].sensor_id"),
        (cuboid(activations=(Activation("gone", TIMES),)), "annotations[0].activations[0].sensor_id"),
        (cuboid(projections=(Projection("gone", TIMES),)), "annotations[0].projections[0].sensor_id"),
        (
            cuboid(attributes=(AttributePath("a", (1,), static=True, sensor_id="gone"),)),
            "annotations[0].attributes[0].sensor_id",
        ),
        (
            keypoints(projections=((PointProjection("front", TIMES), PointProjection("gone", TIMES)),)),
            "annotations[0].projections[0][1].sensor_id",
        ),
    ],
)
def test_a_sensor_that_is_not_there_is_found_wherever_it_is_named(sound, found, annotation, location):
    scene = sound.scene(annotations=(annotation,))
    assert [path for path, _ in found(scene, "annotation-sensor-unknown")] == [location]


@pytest.mark.parametrize(
    "annotation",
    [
        box("top"),
        marked("front"),
        cuboid(projections=(Projection("top", TIMES),)),
        CameraCalibration("c", "top", time_offset_ns=3),
        ShapeAnnotation("s", ShapeType.POINT_2D, VertexPath(TIMES[:1], (np.ones((1, 2)),)), sensor_id="top"),
        keypoints(projections=((PointProjection("top", TIMES),),)),
    ],
)
def test_a_sensor_of_another_type_is_found(sound, found, annotation):
    scene = sound.scene(annotations=(annotation,))
    assert len(found(scene, "annotation-sensor-type")) == 1


def test_activations_and_shapes_in_space_may_be_of_any_sensor(sound, found):
    line = ShapeAnnotation("s", ShapeType.POLYLINE, VertexPath(TIMES[:1], (np.eye(3),)), sensor_id="top")
    seen = cuboid(activations=(Activation("front", TIMES), Activation("top", TIMES)))
    assert found(sound.scene(annotations=(line, seen)), "annotation-sensor-type") == []


def test_an_activation_of_an_odometry_is_found(sound, found):
    seen = cuboid(activations=(Activation("ego", TIMES),))
    scene = sound.scene(sound.lidar(), sound.odometry(), annotations=(seen,))
    assert found(scene, "annotation-sensor-type") == [
        (
            "annotations[0].activations[0].sensor_id",
            "'ego' is an odometry; expected a lidar, a radar or a camera",
        )
    ]


def test_links_to_nothing_and_to_themselves_are_found(sound, found):
    links = (
        LinkAnnotation("l", "car", "gone"),
        LinkAnnotation("m", "car", "car"),
        LinkAnnotation("n", "n", "car"),
    )
    scene = sound.scene(annotations=(cuboid(), *links))
    assert [path for path, _ in found(scene, "link-end-unknown")] == ["annotations[1].to_id"]
    assert [path for path, _ in found(scene, "link-to-itself")] == ["annotations[2]", "annotations[3]"]


def test_an_attribute_of_a_point_that_is_not_there_is_found(sound, found):
    attribute = AttributePath("seen", (1,), static=True, point_index=1)
    scene = sound.scene(annotations=(keypoints(attributes=(attribute,)),))
    assert [path for path, _ in found(scene, "attribute-point-unknown")] == [
        "annotations[0].attributes[0].point_index"
    ]


def test_an_object_without_anything_is_reported(sound, found):
    scene = sound.scene(annotations=(ObjectAnnotation("o"), GroupAnnotation("g"), cuboid(parent_id="g")))
    assert [path for path, _ in found(scene, "annotation-unused")] == ["annotations[0]"]


def test_one_label_in_two_spellings_is_reported_with_the_rarer_one_counted(sound, found):
    labels = ("Traffic Cone", "Traffic Cone", "traffic_cone", "traffic light")
    scene = sound.scene(annotations=tuple(cuboid(k, label=label) for k, label in enumerate(labels)))
    [(path, message)] = found(scene, "label-spellings")
    assert path == "annotations"
    reported = "labels 'Traffic Cone' (2 times), 'traffic_cone' (1 times)"
    assert message == f"{reported}; expected one spelling, as 'Traffic Cone'"
