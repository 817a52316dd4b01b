"""Rules about the times of annotations."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.scene import (
    Activation,
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    LocalizationAdjustment,
    PointsAnnotation,
    Poses,
    Projection,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)

PERIOD = 100_000_000
TIMES = np.arange(3, dtype=np.int64) * PERIOD
RULES = (
    "annotation-times-increasing",
    "annotation-path-empty",
    "annotation-outside-scene",
    "annotation-beyond-scene",
    "annotation-duration",
    "projection-without-image",
)


def cuboid(times=TIMES, values=None, **fields):
    times = np.asarray(times, np.int64)
    rows = np.tile([4.0, 2, 1.5, 1, 2, 0, 0, 0, 30], (len(times), 1)) if values is None else values
    return CuboidAnnotation("car", CuboidPath(times, rows), **fields)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    projection = Projection("front", TIMES, np.tile([1.0, 1, 5, 5], (3, 1)), (True, None, False))
    annotations = (
        cuboid(projections=(projection,), activations=(Activation("top", TIMES, (0, 5, 1.5)),)),
        EventAnnotation("e", PERIOD, 2 * PERIOD),
        EventAnnotation("moment", 6 * PERIOD),
    )
    scene = sound.scene(annotations=annotations)
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


@pytest.mark.parametrize("times", [[0, 0, PERIOD], [PERIOD, 0, 2 * PERIOD]])
def test_keyframes_that_do_not_increase_are_found(sound, found, times):
    scene = sound.scene(annotations=(cuboid(), replace(cuboid(times), id="b")))
    [(path, message)] = found(scene, "annotation-times-increasing")
    assert path == "annotations[1].path.timestamps[1]"
    assert message.startswith(f"{times[1]} ns after {times[0]} ns")


def test_the_first_time_of_a_path_may_be_before_the_last_of_the_path_before(sound, found):
    scene = sound.scene(annotations=(cuboid([PERIOD, 2 * PERIOD]), replace(cuboid([0, PERIOD]), id="b")))
    assert found(scene, "annotation-times-increasing") == []


def test_an_empty_path_between_two_others_parts_them(sound, found):
    annotations = [replace(cuboid(times), id=k) for k, times in enumerate(([PERIOD], [], [0]))]
    scene = sound.scene(annotations=tuple(annotations))
    assert found(scene, "annotation-times-increasing") == []
    assert [path for path, _ in found(scene, "annotation-path-empty")] == ["annotations[1].path"]


def test_a_points_annotation_without_points_is_reported(sound, found):
    scene = sound.scene(annotations=(PointsAnnotation("hand", ()),))
    assert [path for path, _ in found(scene, "annotation-path-empty")] == ["annotations[0].paths"]


def test_sorting_takes_values_along_and_drops_rows_reported_twice(sound, fixed):
    rows = np.arange(36.0).reshape(4, 9)
    rows[3] = rows[0]
    path = CuboidPath(np.array([PERIOD, 0, 2 * PERIOD, PERIOD]), rows)
    attribute = AttributePath("state", ("b", "a"), np.array([PERIOD, 0]))
    projection = Projection("front", np.array([PERIOD, 0]), np.array([[1.0] * 4, [np.nan] * 4]), (True, None))
    scene = sound.scene(
        annotations=(CuboidAnnotation("c", path, attributes=(attribute,), projections=(projection,)),)
    )
    [repaired] = fixed(scene, "annotation-times-increasing").annotations
    assert repaired.path.timestamps_ns.tolist() == [0, PERIOD, 2 * PERIOD]
    np.testing.assert_array_equal(repaired.path.values, rows[[1, 0, 2]])
    assert repaired.attributes[0].values == ("a", "b")
    assert repaired.projections[0].confirmed == (None, True)
    np.testing.assert_array_equal(repaired.projections[0].boxes[1], [1.0] * 4)


def test_sorting_takes_vertices_along(sound, fixed):
    outlines = (np.full((3, 2), 2.0), np.full((4, 2), 1.0))
    shape = ShapeAnnotation(
        "s", ShapeType.POLYGON_2D, VertexPath(np.array([PERIOD, 0]), outlines), sensor_id="front"
    )
    [repaired] = fixed(sound.scene(annotations=(shape,)), "annotation-times-increasing").annotations
    assert [len(vertices) for vertices in repaired.path.vertices] == [4, 3]


def test_two_different_rows_of_one_time_are_left_to_a_person(sound, fixed):
    scene = sound.scene(annotations=(cuboid([0, 0], np.arange(18.0).reshape(2, 9)),))
    assert fixed(scene, "annotation-times-increasing") is scene


def test_annotations_may_reach_one_sweep_beyond_the_sensors(sound, found):
    within, beyond = 6 * PERIOD, 6 * PERIOD + 1
    assert found(sound.scene(annotations=(cuboid([0, within]),)), "annotation-beyond-scene") == []
    scene = sound.scene(annotations=(cuboid([0, beyond]),))
    [(path, message)] = found(scene, "annotation-beyond-scene")
    assert path == "annotations[0].path.timestamps[1]"
    assert "after the scene ends" in message
    assert found(scene, "annotation-outside-scene") == []


def test_the_poses_of_corrections_may_lie_around_the_scene(sound, found):
    poses = Poses(np.array([-(10**9), 10**9]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    scene = sound.scene(annotations=(LocalizationAdjustment("drift", poses),))
    assert found(scene, "annotation-beyond-scene") == []


def test_what_lies_outside_as_a_whole_by_more_than_a_second_is_found(sound, found):
    for times, outside in (([16 * PERIOD, 20 * PERIOD], False), ([16 * PERIOD + 1, 20 * PERIOD], True)):
        scene = sound.scene(annotations=(cuboid(times),))
        assert bool(found(scene, "annotation-outside-scene")) == outside
        assert bool(found(scene, "annotation-beyond-scene")) != outside


def test_a_path_from_far_before_to_far_after_the_scene_is_in_it(sound, found):
    scene = sound.scene(annotations=(cuboid([-90 * PERIOD, 90 * PERIOD]),))
    assert found(scene, "annotation-outside-scene") == []


def test_what_holds_always_may_lie_outside(sound, found):
    static = AttributePath("colour", ("red",), np.array([90 * PERIOD]), static=True)
    annotations = (cuboid([90 * PERIOD], stationary=True), replace(cuboid(attributes=(static,)), id="b"))
    scene = sound.scene(annotations=annotations)
    assert found(scene, "annotation-outside-scene") == []
    assert found(scene, "annotation-beyond-scene") == []


def test_events_outside_the_scene_and_of_negative_length_are_found(sound, found):
    events = (
        EventAnnotation("early", -19 * PERIOD, 2 * PERIOD),
        EventAnnotation("reaching in", -19 * PERIOD, 19 * PERIOD),
        EventAnnotation("backwards", PERIOD, -1),
    )
    scene = sound.scene(annotations=events)
    assert [path for path, _ in found(scene, "annotation-outside-scene")] == ["annotations[0].start"]
    assert [path for path, _ in found(scene, "annotation-duration")] == ["annotations[2].duration"]


def test_an_activation_of_negative_length_is_found(sound, found):
    scene = sound.scene(annotations=(cuboid(activations=(Activation("top", TIMES, (0, -1, 3)),)),))
    assert [path for path, _ in found(scene, "annotation-duration")] == [
        "annotations[0].activations[0].durations[1]"
    ]


def test_a_projection_between_images_is_found(sound, found):
    times = np.array([0, PERIOD + PERIOD // 4, PERIOD + PERIOD // 4 + 1, 5 * PERIOD])
    scene = sound.scene(annotations=(cuboid(projections=(Projection("front", times),)),))
    assert [path for path, _ in found(scene, "projection-without-image")] == [
        "annotations[0].projections[0].timestamps[2]"
    ]
