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


def swept(s, *counts):
    left = iter(counts)
    return s.lidar(sweep=lambda t: s.sweep(t, positions=locations(next(left)), intensities=None, timestamps_ns=None))


def marked(point_ids, *frames, name="a", sensor_id="top", instance=True):
    """Labelled points, the same in several frames, or of a whole sensor."""
    ids = np.asarray(point_ids, np.uint32)
    points = tuple(LabeledPoints(sensor_id, ids, frame) for frame in frames or (None,))
    return LabeledPointsAnnotation(name, points, is_instance=instance)


MAP = PointsSensor("map", np.ones((5, 3), np.float32))
BROKEN, FAR, NEAR = locations(), locations(), locations()
BROKEN[[3, 7], 1] = np.nan, np.inf
FAR[0, 1] = -10_001
NEAR[:5] = 0
TOO_NEAR = NEAR.copy()
TOO_NEAR[5] = 0
DIRECTIONS = np.eye(4, 3) * 1.009
DIRECTIONS[3] = [0, 0.98, 0]
FRAMES = [f"sensors[0].frames[{k}].points.positions" for k in range(6)]
POSITIONS = ["sensors[1].points.positions", *FRAMES]


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    coloured = lidar_with(sound, colors=np.arange(300).reshape(100, 3) % 250, camera_index=[0] * 50 + [255] * 50)
    far = PointsSensor("map", np.full((5, 3), 9_999.0, np.float32))
    scene = sound.scene(coloured, sound.camera(), radar_with(), far)
    assert keeps(scene, [rule for rule in POINT_RULES if rule.id != "frame-repeated"])
    annotations = (
        marked([0, 99], 0),
        marked([1, 2], 0, name="b"),
        marked([0, 1], 1, name="c"),
        marked([0, 1, 2], 0, name="class", instance=False),
        marked([599], name="whole"),
        marked([4], name="map", sensor_id="map"),
    )
    assert keeps(sound.scene(sound.lidar(), MAP, *annotations), LABELLED_POINT_RULES)


def test_labelled_points(check, sound):
    check(
        "labelled-frame-unknown",
        [f"annotations[{k}].labeled_points[0].sensor_frame" for k in range(3)],
        *(sound.lidar(), MAP, marked([1], 6), marked([1], -1, name="b")),
        marked([1], 0, name="c", sensor_id="map"),
    )
    check(
        "labelled-point-unknown",
        [
            "annotations[2].labeled_points[0].point_ids: point 5; sensor 'map' has 5 points, counted from 0",
            "annotations[0].labeled_points[0].point_ids: point 101; frame 0 has 100 points, counted from 0",
            "annotations[1].labeled_points[0].point_ids: point 600; sensor 'top' has 600 points, counted from 0",
        ],
        *(sound.lidar(), MAP, marked([5, 100, 101], 0), marked([600], name="whole")),
        marked([5], name="map", sensor_id="map"),
    )
    check(
        "point-in-two-instances",
        "annotations[1].labeled_points[0].point_ids: 'b' shares 2 points with 'a'",
        marked([1, 2, 3], 0),
        marked([9, 3, 2], 0, name="b"),
        marked([3], 0, name="c", instance=False),
    )
    check(
        "point-in-two-instances",
        "annotations[1].labeled_points[0].point_ids: 'b' shares 2 points with 'a' in 2 frames, first here",
        marked([1, 3], 0, 1, 2),
        marked([3, 9], 0, 2, name="b"),
    )
    # a point named twice by one instance belongs to one
    check("point-in-two-instances", "", marked([1], 0, 0), marked([5], 0, name="b"))


def test_points(check, sound):
    check(
        "points-not-finite",
        [f"{path}: 2 of 100 points have a location that is not finite" for path in POSITIONS],
        *(lidar_with(sound, positions=BROKEN), PointsSensor("map", BROKEN)),
    )
    check("points-at-origin", "", lidar_with(sound, positions=NEAR))
    check("points-at-origin", FRAMES, lidar_with(sound, positions=TOO_NEAR))
    check(
        "points-far",
        [POSITIONS[0], *(f"{path}: coordinates up to 10001 m, where float32 steps by 0.98 mm" for path in FRAMES)],
        *(lidar_with(sound, positions=FAR), PointsSensor("map", FAR)),
    )
    check(
        "frame-without-points",
        "sensors[0].frames[1]: 2 of 6 frames have no points",
        swept(sound, 100, 0, 9, 0, 11, 100),
    )
    check(
        "point-count-collapses",
        "sensors[0].frames[2].points: 99 points; the sensor's frames have 1000 in the middle",
        swept(sound, 1000, 1000, 99, 1000, 101, 1000),
    )
    check("point-count-collapses", "", swept(sound, 98, 98, 1, 98, 98, 98))
    check(
        "frame-repeated",
        "sensors[0].frames[2]: 2 of 6 frames have the very points of the one before",
        swept(sound, 10, 20, 20, 20, 10, 0),
    )
    check("frame-repeated", "", swept(sound, 10, 0, 0, 10, 20, 10))
    check(
        "radar-direction-norm",
        "sensors[0].frames[0].points.directions[3]: length 0.98; expected 1",
        radar_with(directions=DIRECTIONS),
    )
    check(
        "radar-length-absurd",
        "sensors[0].frames[0].points.lengths[2]: 151 m/s",
        radar_with(lengths=[0, -150, 151, np.nan]),
    )


@pytest.mark.parametrize(
    ("intensities", "message"),
    [
        (np.zeros(100), "all are 0"),
        (np.full(100, 255), "all are 255"),
        (np.arange(100) % 2, "all are 0 or 1: numbers from 0 to 1 were rounded to integers"),
        (np.arange(100) % 4 * 60, "only 4 levels: 0, 60, 120, 180"),
        (np.arange(100) % 3 + 1, "only 3 levels"),
        (np.r_[np.full(51, 255), np.arange(49)], "51% are 255: they were cut off"),
        (np.arange(100) % 5, None),
        (np.r_[np.full(50, 255), np.arange(50)], None),
        (None, None),
    ],
)
def test_intensities_off_their_scale_are_found(check, sound, intensities, message):
    expected = f"sensors[0].frames[].points.intensities: {message}" if message else ""
    check("intensity-scale", expected, lidar_with(sound, intensities=intensities))


@pytest.mark.parametrize(("level", "name"), [(255, "white"), (0, "black")])
def test_points_of_no_colour_are_reported_for_the_sensor(sound, found, level, name):
    colors = np.full((100, 3), level)
    [(_, message)] = found(sound.scene(lidar_with(sound, colors=colors)), "colors-all-alike")
    assert message == f"all 600 points are {name}"
    colors[5, 1] = 100
    assert found(sound.scene(lidar_with(sound, colors=colors)), "colors-all-alike") == []


def test_a_camera_that_is_not_there_is_found(sound, found):
    scene = sound.scene(lidar_with(sound, camera_index=[0] * 98 + [1, 254]), sound.camera())
    assert found(scene, "camera-index-unknown")[0] == (
        "sensors[0].frames[0].points.camera_index",
        "camera 1; the scene has 1 cameras, counted from 0",
    )


def test_points_named_twice_are_found_and_named_once_again(sound, found, fixed):
    scene = sound.scene(marked([7, 3, 7, 3, 1], 0))
    assert found(scene, "labelled-point-twice") == [
        ("annotations[0].labeled_points[0].point_ids", "2 points named twice in one list")
    ]
    [repaired] = fixed(scene, "labelled-point-twice").annotations
    assert repaired.labeled_points[0].point_ids.tolist() == [7, 3, 1]
    # frames are read only where the caller wants it
    assert found(sound.scene(marked([100], 0)), "labelled-point-unknown", frames=False) == []
