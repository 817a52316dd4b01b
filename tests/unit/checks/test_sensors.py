"""Rules about sensors, and about what annotations refer to."""

import numpy as np

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

TIMES = np.arange(2, dtype=np.int64) * 100_000_000
ROW = [4.0, 2.0, 1.5, 1.0, 2.0, 0.0, 0.0, 0.0, 30.0]
LABELS = ("Traffic Cone", "Traffic Cone", "traffic_cone", "traffic light")
LINKS = (LinkAnnotation("l", "car", "gone"), LinkAnnotation("m", "car", "car"), LinkAnnotation("n", "n", "car"))


def imu(*last, times=(0, 1, 2)):
    rows = np.zeros((3, 3))
    rows[1, 2:] = last or 0.0
    return ImuSensor("imu", {"gyroscope": VectorSamples(np.array(times, np.int64), rows)})


def gnss(latitude=48.0, longitude=11.0, times=(0, 1)):
    unknown = np.full(2, np.nan)
    return GnssSensor("gnss", np.array(times, np.int64), np.array([[latitude, longitude, 500.0]] * 2), unknown, unknown)


def cuboid(identifier="car", **fields):
    return CuboidAnnotation(identifier, CuboidPath(TIMES, np.array([ROW, ROW])), **fields)


def box(sensor_id="front"):
    return Box2DAnnotation("box", sensor_id, BoxPath(TIMES[:1], np.array([[1.0, 1, 5, 5]])))


def marked(sensor_id="top"):
    return LabeledPointsAnnotation("road", (LabeledPoints(sensor_id, np.arange(3, dtype=np.uint32), 0),))


def keypoints(*sensors, **fields):
    seen = {"projections": (tuple(PointProjection(name, TIMES) for name in sensors),)} if sensors else {}
    return PointsAnnotation("hand", (PointPath(TIMES, np.ones((2, 3))),), **seen, **fields)


def activated(*sensors):
    return cuboid(activations=tuple(Activation(name, TIMES) for name in sensors))


def projected(sensor):
    return cuboid(projections=(Projection(sensor, TIMES),))


def attributed(**fields):
    return keypoints(attributes=(AttributePath("seen", (1,), static=True, **fields),))


def shape(kind, vertices):
    return ShapeAnnotation("s", kind, VertexPath(TIMES[:1], (vertices,)), sensor_id="top")


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    scene = sound.scene(sound.lidar(), sound.camera(parent_id="top"), sound.odometry(), imu(), gnss())
    assert keeps(scene, SENSOR_RULES)
    attribute = AttributePath("seen", (1, 2), TIMES, sensor_id="top", point_index=0)
    annotations = (
        cuboid(parent_id="o", label="Car", activations=(Activation("top", TIMES),)),
        cuboid("second", label="van", projections=(Projection("front", TIMES[:1]),)),
        *(box(), marked(), keypoints(attributes=(attribute,)), ObjectAnnotation("o"), GroupAnnotation("g")),
        LinkAnnotation("l", "car", "g"),
        ObjectAnnotation("reported", attributes=(AttributePath("colour", ("red",), static=True),)),
        CameraCalibration("c", "front", time_offset_ns=5),
    )
    assert keeps(sound.scene(*annotations), REFERENCE_RULES)


def test_sensors(check, sound):
    check("scene-not-empty", "sensors: neither a sensor nor an annotation nor a trajectory", Scene(()))
    check(
        "sensor-empty",
        [
            "sensors[0]: lidar 'top' has no measurements",
            "sensors[1]: camera 'front' has no images",
            "sensors[2]: points 'map' has no measurements",
            "sensors[3]: imu 'imu' has no measurements",
        ],
        *(sound.lidar([]), sound.camera([]), PointsSensor("map", np.zeros((0, 3), np.float32))),
        *(ImuSensor("imu", {}), sound.odometry()),
    )
    # a camera without images that annotations name is used
    check("sensor-empty", "sensors[1]", sound.camera([]), sound.lidar([]), box())
    check("sensor-type-known", "sensors[0].type", PlainSensor("x", "thermal", {}))
    check(
        "sensor-ids-distinct",
        "sensors[1].id: '1' beside 1: a number and a text that look alike",
        sound.lidar(id=1),
        sound.camera(id="1"),
    )
    check("sensor-parent-known", "sensors[0].parent_id: 'roof'", sound.camera(parent_id="roof"))
    check("sensor-parent-known", "sensors[1].parent_id: 7", sound.lidar(id="7"), sound.camera(parent_id=7))
    check(
        "sensor-parent-cycle",
        [
            "sensors[0].parent_id: a cycle: 'a' in 'b' in 'a'",
            "sensors[1].parent_id: a cycle: 'b' in 'a' in 'b'",
            "sensors[3].parent_id: a cycle: 'd' in 'd'",
        ],
        *(sound.lidar(id=a, parent_id=b) for a, b in ("ab", "ba", "ca", "dd")),
    )
    check(
        "sample-times-increasing",
        ["sensors[0].streams.gyroscope.timestamps_ns[2]", "sensors[1].timestamps_ns[1]"],
        imu(times=(0, 5, 5)),
        gnss(times=(5, 5)),
    )
    check("samples-finite", "sensors[0].streams.gyroscope.values[1]", imu(np.inf))
    check("gnss-on-earth", "sensors[0].positions_lla[0]", gnss(91.0, 0.0))
    check("gnss-on-earth", "sensors[0].positions_lla[0]", gnss(0.0, -181.0))


def test_parents_and_links(check, sound):
    check(
        "annotation-parent-unknown",
        "annotations[0].parent_id: 'gone' is no annotation of the scene",
        cuboid(parent_id="gone"),
    )
    check(
        "annotation-parent-unknown",
        "annotations[1].parent_id: there is one '7', which is another id",
        cuboid("7"),
        cuboid("b", parent_id=7),
    )
    check(
        "annotation-parent-cycle",
        "annotations[1].parent_id: 'a' in 'b' in 'c' in 'a'; expected no cycle",
        *(cuboid(name, parent_id=parent) for name, parent in ("xa", "ab", "bc", "ca")),
    )
    check("annotation-parent-cycle", "annotations[0].parent_id", cuboid("a", parent_id="a"))
    # two ways to one parent
    check("annotation-parent-cycle", "", cuboid("a", parent_id="c"), cuboid("b", parent_id="c"), cuboid("c"))
    check("link-end-unknown", "annotations[1].to_id", cuboid(), *LINKS)
    check("link-to-itself", ["annotations[2]", "annotations[3]"], cuboid(), *LINKS)
    check("attribute-point-unknown", "annotations[0].attributes[0].point_index", attributed(point_index=1))
    check("annotation-unused", "annotations[0]", ObjectAnnotation("o"), GroupAnnotation("g"), cuboid(parent_id="g"))
    check(
        "label-spellings",
        "annotations: labels 'Traffic Cone' (2 times), 'traffic_cone' (1 times); expected one spelling, as 'Traffic C",
        *(cuboid(k, label=label) for k, label in enumerate(LABELS)),
    )


def test_sensors_that_annotations_name(check, sound):
    check("annotation-sensor-unknown", "annotations[0].sensor_id", box("gone"))
    check("annotation-sensor-unknown", "annotations[0].labeled_points[0].sensor_id", marked("gone"))
    check("annotation-sensor-unknown", "annotations[0].activations[0].sensor_id", activated("gone"))
    check("annotation-sensor-unknown", "annotations[0].projections[0].sensor_id", projected("gone"))
    check("annotation-sensor-unknown", "annotations[0].attributes[0].sensor_id", attributed(sensor_id="gone"))
    check("annotation-sensor-unknown", "annotations[0].projections[0][1].sensor_id", keypoints("front", "gone"))
    check("annotation-sensor-type", "annotations[0].sensor_id", box("top"))
    check("annotation-sensor-type", "annotations[0].labeled_points[0].sensor_id", marked("front"))
    check("annotation-sensor-type", "annotations[0].projections[0].sensor_id", projected("top"))
    check("annotation-sensor-type", "annotations[0].sensor_id", CameraCalibration("c", "top", time_offset_ns=3))
    check("annotation-sensor-type", "annotations[0].sensor_id", shape(ShapeType.POINT_2D, np.ones((1, 2))))
    check("annotation-sensor-type", "annotations[0].projections[0][0].sensor_id", keypoints("top"))
    # activations and shapes in space may be of any sensor that sees
    check("annotation-sensor-type", "", shape(ShapeType.POLYLINE, np.eye(3)), activated("front", "top"))
    check(
        "annotation-sensor-type",
        "annotations[0].activations[0].sensor_id: 'ego' is an odometry; expected a lidar, a radar or a camera",
        sound.lidar(),
        sound.odometry(),
        activated("ego"),
    )
