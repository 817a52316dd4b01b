"""Annotations between their timestamps, against scipy and against rules written out one by one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.scene import (
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
    PointPath,
    PointsAnnotation,
    Scene,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.scene.annotations_at import (
    BoxTable,
    CuboidAngles,
    attribute_at,
    box_2d_at,
    cuboid_at,
    cuboid_poses,
    point_at,
    points_at,
    shape_at,
)

READINGS = [("degrees", "xyz"), ("radians", "zyx"), ("degrees", "yxz")]

CLOSE = 1e-9
"""Of rotations: what two ways of computing the same sines and cosines may differ by."""


def a_cuboid(seed=0, *, count=6, unit="degrees", stationary=None):
    generator = np.random.default_rng(seed)
    values = generator.uniform(-3.0, 3.0, (count, 9))
    values[:, :3] = generator.uniform(0.5, 5.0, (count, 3))
    if unit == "degrees":
        values[:, 6:] = generator.uniform(-360.0, 360.0, (count, 3))
    timestamps = np.cumsum(generator.integers(1, 400_000_000, count)).astype(np.int64)
    return CuboidAnnotation("a", CuboidPath(timestamps, values), stationary=stationary)


def scipy_rotations(angles_rpy, unit, order):
    """scipy's upper case is the intrinsic order, which multiplies the matrices from the left to the right."""
    columns = ["xyz".index(axis) for axis in order]
    return Rotation.from_euler(order.upper(), angles_rpy[:, columns], degrees=unit == "degrees")


def times_of(cuboid, count=50):
    timestamps = cuboid.path.timestamps_ns
    return np.random.default_rng(9).integers(timestamps[0], timestamps[-1] + 1, count)


@pytest.mark.parametrize(("unit", "order"), READINGS)
def test_a_cuboid_rotates_as_scipys_slerp_does(unit, order):
    cuboid = a_cuboid(unit=unit)
    times, timestamps, values = times_of(cuboid), cuboid.path.timestamps_ns, cuboid.path.values
    expected = Slerp(timestamps.astype(float), scipy_rotations(values[:, 6:], unit, order))(
        times.astype(float)
    )
    poses = cuboid_poses(cuboid, times, angles=CuboidAngles(unit, order))
    away = (expected.inv() * Rotation.from_quat(poses.quaternions_xyzw)).magnitude()
    assert away.max() < CLOSE
    rows, there = cuboid_at(cuboid, times, angles=CuboidAngles(unit, order))
    assert there.all()
    assert (expected.inv() * scipy_rotations(rows[:, 6:], unit, order)).magnitude().max() < CLOSE


def test_size_and_location_of_a_cuboid_go_straight():
    cuboid = a_cuboid(1)
    times, timestamps, values = times_of(cuboid), cuboid.path.timestamps_ns, cuboid.path.values
    rows, _ = cuboid_at(cuboid, times)
    poses = cuboid_poses(cuboid, times)
    for column in range(6):
        straight = np.interp(times.astype(float), timestamps.astype(float), values[:, column])
        np.testing.assert_allclose(rows[:, column], straight, rtol=0, atol=CLOSE)
    np.testing.assert_array_equal(poses.sizes_lwh, rows[:, :3])
    np.testing.assert_array_equal(poses.centers_world, rows[:, 3:6])


def test_at_its_timestamps_a_cuboid_has_the_very_numbers_of_its_path():
    cuboid = a_cuboid(2)
    rows, there = cuboid_at(cuboid, cuboid.path.timestamps_ns)
    assert there.all()
    np.testing.assert_array_equal(rows, cuboid.path.values)


def test_three_quarters_of_a_rotation_do_not_come_back_as_minus_one_quarter():
    values = np.array([[4, 2, 1, 0, 0, 0, 0, 0, 270.0], [4, 2, 1, 0, 0, 0, 0, 0, 280.0]])
    cuboid = CuboidAnnotation("a", CuboidPath(np.array([0, 100]), values))
    rows, _ = cuboid_at(cuboid, [0, 50, 100])
    np.testing.assert_allclose(rows[:, 8], [270.0, 275.0, 280.0], atol=CLOSE)


def test_a_cuboid_rotates_the_shorter_arc_over_the_end_of_the_circle():
    values = np.array([[4, 2, 1, 0, 0, 0, 0, 0, 170.0], [4, 2, 1, 0, 0, 0, 0, 0, -170.0]])
    cuboid = CuboidAnnotation("a", CuboidPath(np.array([0, 100]), values))
    rows, _ = cuboid_at(cuboid, [75])
    np.testing.assert_allclose(rows[0, 8], 185.0, atol=CLOSE)


def test_a_cuboid_is_there_from_its_first_timestamp_to_its_last():
    cuboid = a_cuboid(3)
    first, last = cuboid.path.timestamps_ns[[0, -1]]
    rows, there = cuboid_at(cuboid, [first - 1, first, last, last + 1])
    assert there.tolist() == [False, True, True, False]
    assert np.isnan(rows[[0, 3]]).all()
    assert np.isnan(cuboid_poses(cuboid, [first - 1]).quaternions_xyzw).all()


def test_a_stationary_cuboid_is_there_at_all_times():
    cuboid = a_cuboid(3, stationary=True)
    rows, there = cuboid_at(cuboid, [-(10**18), 10**18])
    assert there.all()
    np.testing.assert_array_equal(rows, cuboid.path.values[[0, -1]])


def test_a_cuboid_without_timestamps_is_nowhere():
    empty = CuboidAnnotation("a", CuboidPath(np.zeros(0, np.int64), np.zeros((0, 9))), stationary=True)
    rows, _ = cuboid_at(empty, [0, 1])
    assert np.isnan(rows).all()
    assert not cuboid_poses(empty, [0]).there.any()


@pytest.mark.parametrize(("unit", "order"), READINGS)
def test_the_boxes_of_a_moment_are_those_of_each_cuboid(unit, order):
    cuboids = [a_cuboid(seed, count=3 + seed % 4, unit=unit, stationary=seed % 5 == 0) for seed in range(20)]
    named = tuple(
        CuboidAnnotation(k, cuboid.path, stationary=cuboid.stationary) for k, cuboid in enumerate(cuboids)
    )
    scene = Scene((), named, metadata={"sceneloom": {"euler_unit": unit, "euler_order": order}})
    time_ns = 450_000_000
    rows, boxes = BoxTable(scene).find(time_ns)
    each = [cuboid_poses(cuboid, [time_ns], angles=CuboidAngles(unit, order)) for cuboid in named]
    assert rows.tolist() == [k for k, poses in enumerate(each) if poses.there[0]]
    assert list(boxes.ids) == rows.tolist()
    np.testing.assert_allclose(boxes.centers_world, [each[k].centers_world[0] for k in rows], atol=1e-12)
    np.testing.assert_allclose(
        boxes.quaternions_xyzw, [each[k].quaternions_xyzw[0] for k in rows], atol=1e-12
    )


def test_a_box_in_images_goes_straight_and_ends():
    path = BoxPath(np.array([10, 20]), np.array([[0.0, 0.0, 10.0, 4.0], [10.0, 20.0, 30.0, 8.0]]))
    rows, there = box_2d_at(Box2DAnnotation("a", "camera", path), [10, 15, 20, 21])
    assert there.tolist() == [True, True, True, False]
    np.testing.assert_array_equal(rows[:3], [[0, 0, 10, 4], [5, 10, 20, 6], [10, 20, 30, 8]])
    assert np.isnan(rows[3]).all()


def test_points_with_names_go_straight_each_on_its_own_way():
    left = PointPath(np.array([0, 10]), np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]))
    right = PointPath(np.array([5, 10]), np.array([[1.0, 1.0, 1.0], [1.0, 3.0, 1.0]]))
    found = points_at(PointsAnnotation("a", (left, right)), [2, 6])
    np.testing.assert_array_equal(found[0][0], [[2, 0, 0], [6, 0, 0]])
    assert np.isnan(found[1][0][0]).all()
    np.testing.assert_allclose(found[1][0][1], [1.0, 1.4, 1.0])
    held, there = point_at(right, [0, 99], stationary=True)
    assert there.all()
    np.testing.assert_array_equal(held, right.values)


def test_vertices_go_straight_only_where_there_are_as_many_before_and_after():
    three, four = np.zeros((3, 2)), np.ones((4, 2))
    path = VertexPath(np.array([0, 10, 20]), (three, three + 10.0, four))
    line = ShapeAnnotation("a", ShapeType.POLYLINE_2D, path, sensor_id="camera")
    before, between, held, last, after = shape_at(line, [-1, 5, 15, 20, 21])
    assert before is None
    assert after is None
    np.testing.assert_array_equal(between, three + 5.0)
    np.testing.assert_array_equal(held, three + 10.0)
    np.testing.assert_array_equal(last, four)


def test_an_attribute_holds_until_the_next():
    attribute = AttributePath("colour", ("red", ("green", "blue"), 7), np.array([10, 20, 30]))
    assert attribute_at(attribute, [9, 10, 19, 20, 99]) == [None, "red", "red", ("green", "blue"), 7]


def test_a_static_attribute_holds_at_all_times():
    assert attribute_at(AttributePath("colour", ("red",), np.array([10]), static=True), [0]) == ["red"]
    assert attribute_at(AttributePath("colour", ("red",)), [0, 5]) == ["red", "red"]
    assert attribute_at(AttributePath("colour", ()), [0]) == [None]


def test_a_timestamp_without_a_value_says_nothing():
    attribute = AttributePath("colour", ("red",), np.array([10, 20]))
    assert attribute_at(attribute, [10, 19, 20, 30]) == ["red", "red", None, None]
