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

TIMES = np.arange(5, dtype=np.int64) * 100_000_000
RADIANS = {"sceneloom": {"euler_unit": "radians", "euler_order": "xyz"}}


def rows(count=5, **columns):
    """A car at 15 m/s that rotates slowly."""
    values = np.tile([4.0, 2, 1.5, 0, 0, 0, 0, 0, 170], (count, 1))
    values[:, 3] = 1.5 * np.arange(count)
    values[:, 8] += 4.0 * np.arange(count)
    for name, column in columns.items():
        values[:, {"height": 2, "yaw": 8}[name]] = column
    return values


def scene_of(sound, values, times=TIMES, metadata=None, **fields):
    shift = np.array([0, 0, 0, 500.0, 0, 0, 0, 0, 90])
    around = [CuboidAnnotation(k, CuboidPath(TIMES, rows() + k * shift)) for k in (1, 2)]
    middle = CuboidAnnotation("middle", CuboidPath(times, values), **fields)
    return sound.scene(around[0], middle, around[1], metadata=metadata or {})


def changed(row, column, value, count=5):
    values = rows(count)
    values[row, column] = value
    return values


def test_a_sound_scene_and_a_path_without_keyframes_pass(sound, keeps):
    rules = [rule for rule in CUBOID_RULES if "angles" not in rule.id and "heading" not in rule.id]
    assert keeps(scene_of(sound, rows()), rules)
    assert keeps(scene_of(sound, np.zeros((0, 9)), TIMES[:0]), rules)


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
def test_values_beyond_the_limit_are_found_and_values_within_are_not(sound, found, rule, column, value, near):
    [(path, _), *_] = found(scene_of(sound, changed(2, column, value)), rule)
    assert path == "annotations[1].path.values[2]"
    assert found(scene_of(sound, changed(2, column, near)), rule) == []


@pytest.mark.parametrize(
    ("rule", "values", "times", "expected"),
    [
        ("cuboid-size-changes", rows(height=[0.2, 0.2, 0.6, 0.6, 0.6]), TIMES, ""),  # small things double
        ("cuboid-jump", changed(2, 4, 10.0), TIMES * 10, ""),  # far apart in time
        ("cuboid-jump", changed(1, 3, 11.9, count=2), TIMES[:2], ""),  # within reach
        ("cuboid-jump", changed(2, 4, 6.0), TIMES, "2]: 6.0 m off the trajectory between the keyframes before and"),
        ("cuboid-jump", changed(1, 3, 12.1, count=2), TIMES[:2], "1]: 12.1 m from the keyframe before, in 0.100 s"),
        ("cuboid-rotation", rows(yaw=[170, 175, -180, -175, 530]), TIMES, ""),  # full circle of numbers
        ("cuboid-rotation", changed(2, 8, 350.0), TIMES * 7, ""),  # slow rotation
    ],
)
def test_motion_that_objects_can_have_is_not_found_and_jumps_are(check, sound, rule, values, times, expected):
    check(rule, expected and f"annotations[1].path.values[{expected}", scene_of(sound, values, times))


def test_radians_are_rotated_as_radians_and_a_stationary_object_that_moves_is_found(sound, found):
    scene = scene_of(sound, rows(yaw=[3.0, 3.1, -3.1, -3.0, 0.0]), metadata=RADIANS)
    [(path, message)] = found(replace(scene, annotations=scene.annotations[1:2]), "cuboid-rotation")
    assert path == "annotations[0].path.values[4]"
    assert message.startswith("rotated by 172°")
    still = rows()
    still[:, 3:6] = np.linspace(0, 0.5, 5)[:, None]
    moving = [len(found(scene_of(sound, v, stationary=True), "cuboid-stationary-moves")) for v in (rows(), still)]
    assert moving == [1, 0]


def test_negative_lengths_become_positive_and_nothing_else_changes(sound, fixed):
    values = rows()
    values[1, :3] *= [-1, 1, -1]
    scene = scene_of(sound, values)
    repaired = fixed(scene, "cuboid-negative-size")
    np.testing.assert_array_equal(repaired.annotations[1].path.values, rows())
    assert repaired.annotations[0] is scene.annotations[0]


SIZE = np.array([4.5, 1.8, 1.5])
BY_MOTION, BY_POINTS, UNSAID = "cuboid-heading-off-motion", "cuboid-angles-off-points", "cuboid-angles-unsaid"
DEGREES = ("degrees", "xyz")


def drive(written=DEGREES, stated=DEGREES, *, tilted=False, speed=10.0, points=True):
    """Objects that move along their x axis; points on their faces, seen by a lidar whose points are in the world."""
    count, (unit, order) = 24, written
    tilt = 40 * np.sin(np.arange(count)) if tilted else np.zeros(count)
    yaw = np.linspace(-170, 175, count)
    orientation = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt, -0.7 * tilt]), degrees=True)
    # roll, pitch and yaw of the product of matrices in an order, by scipy's intrinsic rotations
    in_order = orientation.as_euler(order.upper(), degrees=unit == "degrees")
    angles = np.column_stack([in_order[:, order.index(axis)] for axis in "xyz"])
    forward, times = orientation.apply([1.0, 0, 0]), TIMES[:4]
    start = np.column_stack([*np.divmod(np.arange(count), 6)[::-1], np.zeros(count)]) * 12.0
    annotations = []
    for k in range(count):
        centers = start[k] + speed * (times / 1e9)[:, None] * forward[k]
        values = np.hstack([np.tile(SIZE, (4, 1)), centers, np.tile(angles[k], (4, 1))])
        annotations.append(CuboidAnnotation(k, CuboidPath(times, values), label="car"))
    rng = np.random.default_rng(0)
    frames = []
    for time_ns in times:
        centers = start + speed * time_ns / 1e9 * forward
        inside = rng.uniform(-0.49, 0.49, (count, 60, 3)) * SIZE
        cloud = np.concatenate([o.apply(p) + c for o, p, c in zip(orientation, inside, centers, strict=True)])
        frames.append(LidarFrame(int(time_ns), LidarPoints(cloud[: len(cloud) if points else 0].astype(np.float32))))
    lidar = LidarSensor("top", LazyFrames.of(frames, times), points_frame=PointsFrame.WORLD)
    ours = {"euler_unit": stated[0], "euler_order": stated[1]}
    return Scene((lidar,), tuple(annotations), metadata={"sceneloom": ours})


@pytest.mark.parametrize("reading", [DEGREES, ("radians", "xyz"), ("degrees", "zyx"), ("radians", "zxy")])
@pytest.mark.parametrize("tilted", [False, True])
def test_the_right_reading_is_left_alone(found, reading, tilted):
    scene = drive(reading, reading, tilted=tilted)
    assert (found(scene, BY_MOTION), found(scene, BY_POINTS)) == ([], [])


@pytest.mark.parametrize(
    ("written", "stated"), [(DEGREES, ("radians", "xyz")), (("radians", "zyx"), ("degrees", "zyx"))]
)
@pytest.mark.parametrize("rule", [BY_MOTION, BY_POINTS])
def test_another_unit_is_known_by_motion_and_by_points(found, rule, written, stated):
    [(path, message)] = found(drive(written, stated), rule)
    assert path == "annotations"
    assert f"read as {stated[0]} in the order {stated[1]}" in message
    assert f"read as {written[0]} in the order {written[1]}" in message


@pytest.mark.parametrize(
    ("options", "by_motion", "by_points"),
    [
        ({"written": ("degrees", "zyx"), "tilted": True}, None, "read as degrees in the order zyx"),
        ({"written": ("degrees", "zyx")}, "", ""),
        ({"stated": ("radians", "xyz"), "speed": 0.0}, "", "read as degrees in the order xyz"),
        ({"stated": ("radians", "xyz"), "points": False}, "read as degrees in the order xyz", ""),
        ({"speed": -10.0}, "", ""),
    ],
)
def test_what_motion_and_points_show(found, options, by_motion, by_points):
    scene = drive(**options)
    for rule, expected in ((BY_MOTION, by_motion), (BY_POINTS, by_points)):
        messages = [message for _, message in found(scene, rule)]
        if expected is not None:
            assert len(messages) == bool(expected)
            assert all(expected in message for message in messages)


def test_where_nothing_is_stated_the_evidence_is_reported(found):
    message = "taken to be degrees"
    assumed = DataWarning(kind=WarningKind.ASSUMED, code="euler-unit", location="annotations", message=message)
    assert found(drive(), UNSAID) == []
    [(path, message)] = found(replace(drive(), warnings=(assumed,)), UNSAID)
    assert path == "annotations"
    assert message.startswith("not stated; taken to be degrees in the order xyz: headings are 0° off the motion")
    [(_, message)] = found(replace(drive(speed=0.0, points=False), warnings=(assumed,)), UNSAID)
    assert message.endswith("neither motion nor points in the boxes show it")
