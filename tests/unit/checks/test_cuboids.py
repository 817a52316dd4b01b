"""Rules about cuboids: sizes, motion, and the reading of their angles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.checks.cuboids import CUBOID_RULES
from sceneloom.scene import (
    CuboidAnnotation,
    CuboidPath,
    DataWarning,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    Scene,
    WarningKind,
)

PERIOD = 100_000_000
TIMES = np.arange(5, dtype=np.int64) * PERIOD


def rows(count=5):
    """A car at 15 m/s that rotations slowly."""
    values = np.tile([4.0, 2, 1.5, 0, 0, 0, 0, 0, 170], (count, 1))
    values[:, 3] = 1.5 * np.arange(count)
    values[:, 8] += 4.0 * np.arange(count)
    return values


def scene_of(sound, values, times=TIMES, **fields):
    """The cuboid, between two others that are sound."""
    middle = CuboidAnnotation("middle", CuboidPath(times, values), **fields)
    around = [
        CuboidAnnotation(k, CuboidPath(TIMES, rows() + np.array([0, 0, 0, 500.0 * k, 0, 0, 0, 0, 90 * k])))
        for k in (1, 2)
    ]
    return sound.scene(annotations=(around[0], middle, around[1]))


def changed(row, column, value):
    values = rows()
    values[row, column] = value
    return values


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    assert keeps(scene_of(sound, rows()), CUBOID_RULES)


@pytest.mark.parametrize(
    ("rule", "column", "value", "near"),
    [
        ("cuboid-not-finite", 8, np.nan, 1e300),
        ("cuboid-not-finite", 3, np.inf, 0.0),
        ("cuboid-negative-size", 0, -4.0, 4.0),
        ("cuboid-no-size", 2, 0.0, 1e-9),
        ("cuboid-size-absurd", 0, 100.1, 100.0),
        ("cuboid-size-absurd", 1, 0.009, 0.01),
        ("cuboid-size-changes", 0, 8.1, 7.9),
        ("cuboid-size-changes", 1, 0.9, 1.1),
        ("cuboid-jump", 4, 2.2, 2.0),
        ("cuboid-rotation", 8, 174.0 + 101, 174.0 + 99),
    ],
)
def test_what_is_beyond_the_limit_is_found_and_what_is_within_is_not(sound, found, rule, column, value, near):
    [(path, _), *_] = found(scene_of(sound, changed(2, column, value)), rule)
    assert path == "annotations[1].path.values[2]"
    assert found(scene_of(sound, changed(2, column, near)), rule) == []


def test_small_things_may_double(sound, found):
    values = rows()
    values[:, 2], values[2:, 2] = 0.2, 0.6
    assert found(scene_of(sound, values), "cuboid-size-changes") == []


def test_a_keyframe_off_the_trajectory_is_known_by_how_far(sound, found):
    values = rows()
    values[2, 4] = 6.0
    [(path, message)] = found(scene_of(sound, values), "cuboid-jump")
    assert path == "annotations[1].path.values[2]"
    assert message == "6.0 m off the trajectory between the keyframes before and after"


def test_a_keyframe_out_of_reach_is_known_by_its_distance_and_time(sound, found):
    values = rows(2)
    values[1, 3] = 12.1
    [(path, message)] = found(scene_of(sound, values, TIMES[:2]), "cuboid-jump")
    assert (path, message) == ("annotations[1].path.values[1]", "12.1 m from the keyframe before, in 0.100 s")
    values[1, 3] = 11.9
    assert found(scene_of(sound, values, TIMES[:2]), "cuboid-jump") == []


def test_keyframes_far_apart_in_time_may_lie_off_a_straight_trajectory(sound, found):
    values = changed(2, 4, 10.0)
    assert found(scene_of(sound, values, TIMES * 10), "cuboid-jump") == []


def test_rotating_through_a_full_circle_of_numbers_is_no_rotation(sound, found):
    values = rows()
    values[:, 8] = [170, 175, -180, -175, 530]
    assert found(scene_of(sound, values), "cuboid-rotation") == []


def test_rotating_slowly_is_no_flip(sound, found):
    assert found(scene_of(sound, changed(2, 8, 350.0), TIMES * 7), "cuboid-rotation") == []


def test_radians_are_rotated_as_radians(sound, found):
    values = rows()
    values[:, 8] = [3.0, 3.1, -3.1, -3.0, 0.0]
    scene = scene_of(sound, values)
    stated = {"sceneloom": {"euler_unit": "radians", "euler_order": "xyz"}}
    [(path, message)] = found(type(scene)(scene.sensors, scene.annotations[1:2], metadata=stated), "cuboid-rotation")
    assert path == "annotations[0].path.values[4]"
    assert message.startswith("rotated by 172°")


def test_a_stationary_object_that_moves_is_found(sound, found):
    assert len(found(scene_of(sound, rows(), stationary=True), "cuboid-stationary-moves")) == 1
    still = rows()
    still[:, 3:6] = np.linspace(0, 0.5, 5)[:, None]
    assert found(scene_of(sound, still, stationary=True), "cuboid-stationary-moves") == []


def test_negative_lengths_become_positive_and_nothing_else_changes(sound, fixed):
    values = rows()
    values[1, :3] *= [-1, 1, -1]
    scene = scene_of(sound, values)
    repaired = fixed(scene, "cuboid-negative-size")
    np.testing.assert_array_equal(repaired.annotations[1].path.values, rows())
    assert repaired.annotations[0] is scene.annotations[0]


def test_a_path_without_keyframes_is_no_trouble(sound, keeps):
    scene = scene_of(sound, np.zeros((0, 9)), TIMES[:0])
    assert keeps(scene, CUBOID_RULES)


TIMES_OF_ANGLES = np.arange(4, dtype=np.int64) * PERIOD
SIZE = np.array([4.5, 1.8, 1.5])
BY_MOTION, BY_POINTS = "cuboid-heading-off-motion", "cuboid-angles-off-points"


def rotations(count=24, *, tilted=False):
    """Orientations as scipy has them: all around, and where asked for up and down and sideways, too."""
    yaw = np.linspace(-170, 175, count)
    tilt = 40 * np.sin(np.arange(count)) if tilted else np.zeros(count)
    return Rotation.from_euler("ZYX", np.column_stack([yaw, tilt, -0.7 * tilt]), degrees=True)


def angles_of(orientation, unit, order):
    """Roll, pitch and yaw of the product of matrices in an order, by scipy's intrinsic rotations."""
    found = orientation.as_euler(order.upper(), degrees=unit == "degrees")
    return np.column_stack([found[:, order.index(axis)] for axis in "xyz"])


def scene_of_of_angles(written, stated, *, tilted=False, speed=10.0, points=True):
    """Objects that move along their x axis; points on their faces, seen by a lidar whose points are in the world."""
    orientation = rotations(tilted=tilted)
    angles, forward = angles_of(orientation, *written), orientation.apply([1.0, 0, 0])
    start = np.column_stack([*np.divmod(np.arange(len(angles)), 6)[::-1], np.zeros(len(angles))]) * 12.0
    annotations = []
    for k in range(len(angles)):
        centers = start[k] + speed * (TIMES_OF_ANGLES / 1e9)[:, None] * forward[k]
        rows = np.hstack([np.tile(SIZE, (4, 1)), centers, np.tile(angles[k], (4, 1))])
        annotations.append(CuboidAnnotation(k, CuboidPath(TIMES_OF_ANGLES, rows), label="car"))
    rng = np.random.default_rng(0)
    frames = []
    for time_ns in TIMES_OF_ANGLES:
        centers = start + speed * time_ns / 1e9 * forward
        inside = rng.uniform(-0.49, 0.49, (len(angles), 60, 3)) * SIZE
        cloud = np.concatenate([o.apply(p) + c for o, p, c in zip(orientation, inside, centers, strict=True)])
        frames.append(LidarFrame(int(time_ns), LidarPoints(cloud[: len(cloud) if points else 0].astype(np.float32))))
    lidar = LidarSensor("top", LazyFrames.of(frames, TIMES_OF_ANGLES), points_frame=PointsFrame.WORLD)
    ours = {"euler_unit": stated[0], "euler_order": stated[1]}
    return Scene((lidar,), tuple(annotations), metadata={"sceneloom": ours})


@pytest.mark.parametrize("reading", [("degrees", "xyz"), ("radians", "xyz"), ("degrees", "zyx"), ("radians", "zxy")])
@pytest.mark.parametrize("tilted", [False, True])
def test_the_right_reading_is_left_alone(found, reading, tilted):
    scene = scene_of_of_angles(reading, reading, tilted=tilted)
    assert found(scene, BY_MOTION) == []
    assert found(scene, BY_POINTS) == []


@pytest.mark.parametrize(
    ("written", "stated"),
    [(("degrees", "xyz"), ("radians", "xyz")), (("radians", "zyx"), ("degrees", "zyx"))],
)
def test_another_unit_is_known_by_motion_and_by_points(found, written, stated):
    scene = scene_of_of_angles(written, stated)
    for rule in (BY_MOTION, BY_POINTS):
        [(path, message)] = found(scene, rule)
        assert path == "annotations"
        assert f"read as {stated[0]} in the order {stated[1]}" in message
        assert f"read as {written[0]} in the order {written[1]}" in message


def test_another_order_is_known_by_points_where_objects_are_tilted(found):
    scene = scene_of_of_angles(("degrees", "zyx"), ("degrees", "xyz"), tilted=True)
    [(_, message)] = found(scene, BY_POINTS)
    assert "read as degrees in the order zyx" in message


def test_the_order_plays_no_part_where_objects_only_rotate(found):
    scene = scene_of_of_angles(("degrees", "zyx"), ("degrees", "xyz"))
    assert found(scene, BY_MOTION) == []
    assert found(scene, BY_POINTS) == []


def test_stationary_objects_are_reported_by_points_alone(found):
    scene = scene_of_of_angles(("degrees", "xyz"), ("radians", "xyz"), speed=0.0)
    assert found(scene, BY_MOTION) == []
    assert len(found(scene, BY_POINTS)) == 1


def test_without_points_motion_reports(found):
    scene = scene_of_of_angles(("degrees", "xyz"), ("radians", "xyz"), points=False)
    assert found(scene, BY_POINTS) == []
    assert len(found(scene, BY_MOTION, frames=False)) == 1


def test_where_nothing_is_stated_the_evidence_is_reported(found):
    assumed = DataWarning(
        kind=WarningKind.ASSUMED, code="euler-unit", location="annotations", message="taken to be degrees"
    )
    scene = scene_of_of_angles(("degrees", "xyz"), ("degrees", "xyz"))
    assert found(scene, "cuboid-angles-unsaid") == []
    [(path, message)] = found(replace(scene, warnings=(assumed,)), "cuboid-angles-unsaid")
    assert path == "annotations"
    assert message.startswith("not stated; taken to be degrees in the order xyz: headings are 0° off the motion")
    blind = replace(
        scene_of_of_angles(("degrees", "xyz"), ("degrees", "xyz"), speed=0.0, points=False),
        warnings=(assumed,),
    )
    [(_, message)] = found(blind, "cuboid-angles-unsaid")
    assert message.endswith("neither motion nor points in the boxes report")


def test_objects_that_drive_backwards_are_along_their_motion(found):
    scene = scene_of_of_angles(("degrees", "xyz"), ("degrees", "xyz"), speed=-10.0)
    assert found(scene, BY_MOTION) == []
