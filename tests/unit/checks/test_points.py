"""Rules about points of lidars and radars, and about labelled points."""

import numpy as np
import pytest

from sceneloom.checks.points import LABELLED_POINT_RULES, POINT_RULES
from sceneloom.scene import (
    LabeledPoints,
    LabeledPointsAnnotation,
    LazyFrames,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)


def locations(count=100):
    """Points around the sensor, none of them at it."""
    angles = np.linspace(0, 6, count)
    return np.column_stack([10 * np.cos(angles), 10 * np.sin(angles), angles]).astype(np.float32)


def lidar_with(sound, **fields):
    """Every sweep has these fields, or what the field's function gives for its time."""

    def sweep(timestamp_ns):
        count = len(fields.get("positions", locations()))
        given = {"positions": locations(), "intensities": np.arange(count) % 256, "timestamps_ns": None, **fields}
        dtypes = {"positions": np.float32, "intensities": np.uint8, "colors": np.uint8, "camera_index": np.uint8}
        made = {k: v if v is None else np.asarray(v, dtypes.get(k)) for k, v in given.items()}
        return sound.sweep(timestamp_ns, **made)

    return sound.lidar(sweep=sweep)


def radar_with(**fields):
    positions = locations(4)
    given = {"directions": positions / np.linalg.norm(positions, axis=1, keepdims=True), "lengths": np.full(4, 150.0)}
    arrays = {name: np.asarray(value, np.float32) for name, value in {**given, **fields}.items()}
    return RadarSensor("radar", LazyFrames.of([RadarFrame(0, RadarPoints(positions, **arrays))], [0]))


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    map_sensor = PointsSensor("map", np.full((5, 3), 9_999.0, np.float32))
    coloured = lidar_with(sound, colors=np.arange(300).reshape(100, 3) % 250, camera_index=[0] * 50 + [255] * 50)
    scene = sound.scene(coloured, sound.camera(), radar_with(), map_sensor)
    assert keeps(scene, [rule for rule in POINT_RULES if rule.id != "frame-repeated"])


def test_locations_that_are_not_finite_are_counted(sound, found):
    broken = locations()
    broken[[3, 7], 1] = np.nan, np.inf
    scene = sound.scene(lidar_with(sound, positions=broken), PointsSensor("map", broken))
    hits = found(scene, "points-not-finite")
    assert ("sensors[0].frames[0].points.positions", "2 of 100 points have a location that is not finite") in hits
    assert ("sensors[1].points.positions", "2 of 100 points have a location that is not finite") in hits
    assert len(hits) == 7


@pytest.mark.parametrize(("count", "hits"), [(5, 0), (6, 6)])
def test_too_many_points_at_the_origin_are_found(sound, found, count, hits):
    positions = locations()
    positions[:count] = 0
    assert len(found(sound.scene(lidar_with(sound, positions=positions)), "points-at-origin")) == hits


def test_points_beyond_ten_kilometres_are_found(sound, found):
    far = locations()
    far[0, 1] = -10_001
    scene = sound.scene(lidar_with(sound, positions=far), PointsSensor("map", far))
    hits = dict(found(scene, "points-far"))
    assert hits["sensors[0].frames[0].points.positions"] == "coordinates up to 10001 m, where float32 steps by 0.98 mm"
    assert "sensors[1].points.positions" in hits


def swept(sound, *counts):
    """A lidar whose sweeps have so many points."""
    left = iter(counts)

    def sweep(timestamp_ns):
        return sound.sweep(timestamp_ns, positions=locations(next(left)), intensities=None, timestamps_ns=None)

    return sound.scene(sound.lidar(sweep=sweep))


def test_frames_without_points_are_counted(sound, found):
    scene = swept(sound, 100, 0, 9, 0, 11, 100)
    assert found(scene, "frame-without-points") == [("sensors[0].frames[1]", "2 of 6 frames have no points")]


def test_a_frame_of_less_than_a_tenth_of_the_usual_points_is_found(sound, found):
    scene = swept(sound, 1000, 1000, 99, 1000, 101, 1000)
    assert found(scene, "point-count-collapses") == [
        ("sensors[0].frames[2].points", "99 points; the sensor's frames have 1000 in the middle")
    ]
    assert found(swept(sound, 98, 98, 1, 98, 98, 98), "point-count-collapses") == []


def test_frames_with_the_very_points_of_the_one_before_are_counted(sound, found):
    scene = swept(sound, 10, 20, 20, 20, 10, 0)
    assert found(scene, "frame-repeated") == [
        ("sensors[0].frames[2]", "2 of 6 frames have the very points of the one before")
    ]
    assert found(swept(sound, 10, 0, 0, 10, 20, 10), "frame-repeated") == []


@pytest.mark.parametrize(
    ("intensities", "stated"),
    [
        (np.zeros(100), "all are 0"),
        (np.full(100, 255), "all are 255"),
        (np.arange(100) % 2, "all are 0 or 1: numbers from 0 to 1 were rounded to integers"),
        (np.arange(100) % 4 * 60, "only 4 levels: 0, 60, 120, 180"),
        (np.r_[np.full(51, 255), np.arange(49)], "51% are 255: they were cut off"),
    ],
)
def test_intensities_off_their_scale_are_reported(sound, found, intensities, stated):
    [(path, message)] = found(sound.scene(lidar_with(sound, intensities=intensities)), "intensity-scale")
    assert (path, message) == ("sensors[0].frames[].points.intensities", stated)


@pytest.mark.parametrize(
    "intensities", [np.arange(100) % 5, np.arange(100) % 3 + 1, np.r_[np.full(50, 255), np.arange(50)], None]
)
def test_few_levels_are_distinguished_from_five_on_no_more(sound, found, intensities):
    hits = found(sound.scene(lidar_with(sound, intensities=intensities)), "intensity-scale")
    expected = intensities is not None and len(np.unique(intensities)) < 5
    assert bool(hits) == expected


@pytest.mark.parametrize(("level", "name"), [(255, "white"), (0, "black")])
def test_points_of_no_colour_are_reported_for_the_sensor(sound, found, level, name):
    colors = np.full((100, 3), level)
    [(_, message)] = found(sound.scene(lidar_with(sound, colors=colors)), "colors-all-alike")
    assert message == f"all 600 points are {name}"
    colors[5, 1] = 100
    assert found(sound.scene(lidar_with(sound, colors=colors)), "colors-all-alike") == []


def test_a_camera_that_is_not_there_is_found(sound, found):
    indices = [0] * 98 + [1, 254]
    scene = sound.scene(lidar_with(sound, camera_index=indices), sound.camera())
    [(path, message), *_] = found(scene, "camera-index-unknown")
    assert path == "sensors[0].frames[0].points.camera_index"
    assert message == "camera 1; the scene has 1 cameras, counted from 0"


def test_radar_directions_and_speeds_are_judged(sound, found):
    directions = np.eye(4, 3) * 1.009
    directions[3] = [0, 0.98, 0]
    scene = sound.scene(radar_with(directions=directions, lengths=[0, -150, 151, np.nan]))
    assert found(scene, "radar-direction-norm") == [
        ("sensors[0].frames[0].points.directions[3]", "length 0.98; expected 1")
    ]
    [(path, message)] = found(scene, "radar-length-absurd")
    assert path == "sensors[0].frames[0].points.lengths[2]"
    assert message.startswith("151 m/s")


def marked(point_ids, frame=0, *, name="a", sensor_id="top", instance=True):
    ids = np.asarray(point_ids, np.uint32)
    return LabeledPointsAnnotation(name, (LabeledPoints(sensor_id, ids, frame),), is_instance=instance)


def test_a_sound_scene_keeps_all_rules_about_labelled_points(sound, keeps):
    annotations = (
        marked([0, 99]),
        marked([1, 2], name="b"),
        marked([0, 1], 1, name="c"),
        marked([0, 1, 2], name="class", instance=False),
        marked([599], None, name="whole"),
        marked([4], None, name="map", sensor_id="map"),
    )
    scene = sound.scene(sound.lidar(), PointsSensor("map", np.ones((5, 3), np.float32)), annotations=annotations)
    assert keeps(scene, LABELLED_POINT_RULES)


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
    scene = sound.scene(sound.lidar(), PointsSensor("map", np.ones((5, 3), np.float32)), annotations=annotations)
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
        ("annotations[1].labeled_points[0].point_ids", "'b' shares 2 points with 'a' in 2 frames, first here")
    ]


def test_a_point_named_twice_by_one_instance_belongs_to_one(sound, found):
    both = LabeledPointsAnnotation(
        "a",
        (LabeledPoints("top", np.array([1], np.uint32), 0), LabeledPoints("top", np.array([1], np.uint32), 0)),
        is_instance=True,
    )
    scene = sound.scene(annotations=(both, marked([5], name="b")))
    assert found(scene, "point-in-two-instances") == []
