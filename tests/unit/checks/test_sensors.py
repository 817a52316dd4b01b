"""Rules about sensors, and about what annotations refer to."""

import numpy as np
import pytest

from sceneloom.checks.sensors import REFERENCE_RULES, SENSOR_RULES
from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    GnssSensor,
    GroupAnnotation,
    ImuSensor,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
    PlainSensor,
    PointPath,
    PointProjection,
    PointsAnnotation,
    PointsSensor,
    Projection,
    Scene,
    ShapeAnnotation,
    ShapeType,
    VectorSamples,
    VertexPath,
)

PERIOD = 100_000_000


def imu(values=None, times=(0, 1, 2)):
    rows = np.zeros((3, 3)) if values is None else values
    return ImuSensor("imu", {"gyroscope": VectorSamples(np.array(times, np.int64), rows)})


def gnss(latitude=48.0, longitude=11.0, times=(0, 1)):
    locations = np.array([[latitude, longitude, 500.0]] * 2)
    unknown = np.full(2, np.nan)
    return GnssSensor("gnss", np.array(times, np.int64), locations, unknown, unknown)


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    scene = sound.scene(sound.lidar(), sound.camera(parent_id="top"), sound.odometry(), imu(), gnss())
    assert keeps(scene, SENSOR_RULES)


def test_an_empty_scene_is_found(found):
    assert found(Scene(()), "scene-not-empty") == [("sensors", "neither a sensor nor an annotation nor a trajectory")]


def test_sensors_without_content_are_found(sound, found):
    empty_map = PointsSensor("map", np.zeros((0, 3), np.float32))
    scene = sound.scene(sound.lidar([]), sound.camera([]), empty_map, ImuSensor("imu", {}), sound.odometry())
    assert found(scene, "sensor-empty") == [
        ("sensors[0]", "lidar 'top' has no measurements"),
        ("sensors[1]", "camera 'front' has no images"),
        ("sensors[2]", "points 'map' has no measurements"),
        ("sensors[3]", "imu 'imu' has no measurements"),
    ]


def test_a_camera_without_images_that_annotations_name_is_used(sound, found):
    box = Box2DAnnotation("box", "front", BoxPath(np.zeros(1, np.int64), np.ones((1, 4))))
    scene = sound.scene(sound.camera([]), sound.lidar([]), annotations=(box,))
    assert [path for path, _ in found(scene, "sensor-empty")] == ["sensors[1]"]


def test_a_type_that_no_format_lists_is_found(sound, found):
    scene = sound.scene(PlainSensor("x", "thermal", {}))
    assert [path for path, _ in found(scene, "sensor-type-known")] == ["sensors[0].type"]


def test_a_number_and_a_text_that_look_alike_are_found(sound, found):
    scene = sound.scene(sound.lidar(id=1), sound.camera(id="1"))
    assert found(scene, "sensor-ids-distinct") == [
        ("sensors[1].id", "'1' beside 1: a number and a text that look alike")
    ]


@pytest.mark.parametrize("parent", ["roof", 7])
def test_a_parent_that_is_not_there_is_found(sound, found, parent):
    [(path, message)] = found(sound.scene(sound.lidar(id="7"), sound.camera(parent_id=parent)), "sensor-parent-known")
    assert path == "sensors[1].parent_id"
    assert repr(parent) in message


def test_cycles_of_parents_are_found_at_each_of_their_sensors(sound, found):
    a, b = sound.lidar(id="a", parent_id="b"), sound.lidar(id="b", parent_id="a")
    outside, own = sound.lidar(id="c", parent_id="a"), sound.lidar(id="d", parent_id="d")
    assert found(sound.scene(a, b, outside, own), "sensor-parent-cycle") == [
        ("sensors[0].parent_id", "a cycle: 'a' in 'b' in 'a'"),
        ("sensors[1].parent_id", "a cycle: 'b' in 'a' in 'b'"),
        ("sensors[3].parent_id", "a cycle: 'd' in 'd'"),
    ]


def test_samples_out_of_order_are_found(sound, found):
    scene = sound.scene(imu(times=(0, PERIOD, PERIOD)), gnss(times=(5, 5)))
    assert [path for path, _ in found(scene, "sample-times-increasing")] == [
        "sensors[0].streams.gyroscope.timestamps_ns[2]",
        "sensors[1].timestamps_ns[1]",
    ]


def test_samples_that_are_no_numbers_are_found(sound, found):
    values = np.zeros((3, 3))
    values[1, 2] = np.inf
    assert [path for path, _ in found(sound.scene(imu(values)), "samples-finite")] == [
        "sensors[0].streams.gyroscope.values[1]"
    ]


@pytest.mark.parametrize(("latitude", "longitude"), [(91.0, 0.0), (0.0, -181.0)])
def test_locations_off_the_earth_are_found(sound, found, latitude, longitude):
    scene = sound.scene(gnss(latitude, longitude))
    assert [path for path, _ in found(scene, "gnss-on-earth")] == ["sensors[0].positions_lla[0]"]


TIMES = np.arange(2, dtype=np.int64) * PERIOD
ROW = [4.0, 2.0, 1.5, 1.0, 2.0, 0.0, 0.0, 0.0, 30.0]


def cuboid(identifier="car", **fields):
    return CuboidAnnotation(identifier, CuboidPath(TIMES, np.array([ROW, ROW])), **fields)


def box(sensor_id="front"):
    return Box2DAnnotation("box", sensor_id, BoxPath(TIMES[:1], np.array([[1.0, 1, 5, 5]])))


def marked(sensor_id="top"):
    return LabeledPointsAnnotation("road", (LabeledPoints(sensor_id, np.arange(3, dtype=np.uint32), 0),))


def keypoints(**fields):
    return PointsAnnotation("hand", (PointPath(TIMES, np.ones((2, 3))),), **fields)


def test_a_sound_scene_keeps_all_rules_about_references(sound, keeps):
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
    assert keeps(scene, REFERENCE_RULES)


def test_a_parent_that_is_not_there_is_found_of_references(sound, found):
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
        ("annotations[0].activations[0].sensor_id", "'ego' is an odometry; expected a lidar, a radar or a camera")
    ]


def test_links_to_nothing_and_to_themselves_are_found(sound, found):
    links = (LinkAnnotation("l", "car", "gone"), LinkAnnotation("m", "car", "car"), LinkAnnotation("n", "n", "car"))
    scene = sound.scene(annotations=(cuboid(), *links))
    assert [path for path, _ in found(scene, "link-end-unknown")] == ["annotations[1].to_id"]
    assert [path for path, _ in found(scene, "link-to-itself")] == ["annotations[2]", "annotations[3]"]


def test_an_attribute_of_a_point_that_is_not_there_is_found(sound, found):
    attribute = AttributePath("seen", (1,), static=True, point_index=1)
    scene = sound.scene(annotations=(keypoints(attributes=(attribute,)),))
    assert [path for path, _ in found(scene, "attribute-point-unknown")] == ["annotations[0].attributes[0].point_index"]


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
