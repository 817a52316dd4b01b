"""Rules about points that belong to objects; frames of the sound scene have 100 points."""

import numpy as np

from sceneloom.scene import LabeledPoints, LabeledPointsAnnotation, PointsSensor

RULES = ("labelled-frame-unknown", "labelled-point-unknown", "labelled-point-twice", "point-in-two-instances")


def marked(point_ids, frame=0, *, name="a", sensor_id="top", instance=True):
    ids = np.asarray(point_ids, np.uint32)
    return LabeledPointsAnnotation(name, (LabeledPoints(sensor_id, ids, frame),), is_instance=instance)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    annotations = (
        marked([0, 99]),
        marked([1, 2], name="b"),
        marked([0, 1], 1, name="c"),
        marked([0, 1, 2], name="class", instance=False),
        marked([599], None, name="whole"),
        marked([4], None, name="map", sensor_id="map"),
    )
    scene = sound.scene(
        sound.lidar(), PointsSensor("map", np.ones((5, 3), np.float32)), annotations=annotations
    )
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


def test_frames_that_the_sensor_does_not_have_are_found(sound, found):
    points_sensor = PointsSensor("map", np.ones((5, 3), np.float32))
    annotations = (marked([1], 6), marked([1], -1, name="b"), marked([1], 0, name="c", sensor_id="map"))
    scene = sound.scene(sound.lidar(), points_sensor, annotations=annotations)
    locations = [path for path, _ in found(scene, "labelled-frame-unknown")]
    assert locations == [f"annotations[{k}].labeled_points[0].sensor_frame" for k in range(3)]


def test_points_beyond_their_frame_their_sensor_and_their_map_are_found(sound, found):
    annotations = (
        marked([5, 100, 101]),
        marked([600], None, name="whole"),
        marked([5], None, name="map", sensor_id="map"),
    )
    scene = sound.scene(
        sound.lidar(), PointsSensor("map", np.ones((5, 3), np.float32)), annotations=annotations
    )
    messages = dict(found(scene, "labelled-point-unknown"))
    assert messages == {
        "annotations[0].labeled_points[0].point_ids": "point 101; frame 0 has 100 points, counted from 0",
        "annotations[1].labeled_points[0].point_ids": "point 600; sensor 'top' has 600 points, counted from 0",
        "annotations[2].labeled_points[0].point_ids": "point 5; sensor 'map' has 5 points, counted from 0",
    }


def test_frames_are_read_only_where_the_caller_wants(sound, found):
    scene = sound.scene(annotations=(marked([100]),))
    assert found(scene, "labelled-point-unknown", frames=False) == []


def test_points_named_twice_are_found_and_named_once_again(sound, found, fixed):
    scene = sound.scene(annotations=(marked([7, 3, 7, 3, 1]),))
    assert found(scene, "labelled-point-twice") == [
        ("annotations[0].labeled_points[0].point_ids", "2 points named twice in one list")
    ]
    [repaired] = fixed(scene, "labelled-point-twice").annotations
    assert repaired.labeled_points[0].point_ids.tolist() == [7, 3, 1]


def test_points_of_two_instances_are_counted_at_the_second_one(sound, found):
    annotations = (marked([1, 2, 3]), marked([9, 3, 2], name="b"), marked([3], name="c", instance=False))
    assert found(sound.scene(annotations=annotations), "point-in-two-instances") == [
        ("annotations[1].labeled_points[0].point_ids", "'b' shares 2 points with 'a'")
    ]


def test_two_instances_that_share_points_of_many_frames_are_reported_once(sound, found):
    def in_frames(name, *ids):
        points = [LabeledPoints("top", np.array([i], np.uint32), k) for k, i in enumerate(ids)]
        return LabeledPointsAnnotation(name, tuple(points), is_instance=True)

    annotations = (in_frames("a", 1, 2, 3), in_frames("b", 1, 9, 3))
    assert found(sound.scene(annotations=annotations), "point-in-two-instances") == [
        (
            "annotations[1].labeled_points[0].point_ids",
            "'b' shares 2 points with 'a' in 2 frames, first here",
        )
    ]


def test_a_point_named_twice_by_one_instance_belongs_to_one(sound, found):
    both = LabeledPointsAnnotation(
        "a",
        (
            LabeledPoints("top", np.array([1], np.uint32), 0),
            LabeledPoints("top", np.array([1], np.uint32), 0),
        ),
        is_instance=True,
    )
    scene = sound.scene(annotations=(both, marked([5], name="b")))
    assert found(scene, "point-in-two-instances") == []
