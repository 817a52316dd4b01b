"""Rules about sensors: content, parents, ids, streams."""

import numpy as np
import pytest

from sceneloom.scene import (
    Box2DAnnotation,
    BoxPath,
    GnssSensor,
    ImuSensor,
    PlainSensor,
    PointsSensor,
    Scene,
    VectorSamples,
)

PERIOD = 100_000_000

RULES = (
    "scene-not-empty",
    "sensor-empty",
    "sensor-type-known",
    "sensor-ids-distinct",
    "sensor-parent-known",
    "sensor-parent-cycle",
    "sample-times-increasing",
    "samples-finite",
    "gnss-on-earth",
)


def imu(values=None, times=(0, 1, 2)):
    rows = np.zeros((3, 3)) if values is None else values
    return ImuSensor("imu", {"gyroscope": VectorSamples(np.array(times, np.int64), rows)})


def gnss(latitude=48.0, longitude=11.0, times=(0, 1)):
    locations = np.array([[latitude, longitude, 500.0]] * 2)
    unknown = np.full(2, np.nan)
    return GnssSensor("gnss", np.array(times, np.int64), locations, unknown, unknown)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    scene = sound.scene(sound.lidar(), sound.camera(parent_id="top"), sound.odometry(), imu(), gnss())
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


def test_an_empty_scene_is_found(found):
    assert found(Scene(()), "scene-not-empty") == [
        ("sensors", "neither a sensor nor an annotation nor a trajectory")
    ]


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
    [(path, message)] = found(
        sound.scene(sound.lidar(id="7"), sound.camera(parent_id=parent)), "sensor-parent-known"
    )
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
