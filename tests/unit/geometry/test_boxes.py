"""Corners of boxes and the points inside them; roll, pitch and yaw of cuboids against scipy in every unit and order."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import OptionError
from sceneloom.geometry.boxes import EDGES, box_corners, points_in_box
from sceneloom.geometry.euler import ORDERS, cuboid_angles_from_rotation, rotation_from_cuboid_angles

NO_ROTATION, ROUNDING = (0.0, 0.0, 0.0, 1.0), 1e-14


def test_corners_come_bottom_first_counter_clockwise_and_points_inside_lie_between_all_six_faces():
    corners = box_corners((10, 20, 30), (4, 2, 1.5), NO_ROTATION)
    bottom = [(12, 21, 29.25), (8, 21, 29.25), (8, 19, 29.25), (12, 19, 29.25)]
    assert np.allclose(corners, [*bottom, *np.add(bottom, (0, 0, 1.5))])
    corners = box_corners((0, 0, 0), (4, 2, 1), Rotation.from_euler("z", 90, degrees=True).as_quat())
    assert np.allclose(corners[[0, 3], 1], 2.0)  # rotated left, the front corners lie 2 m to the left
    corners = box_corners((1, 2, 3), (4, 2, 1), Rotation.from_rotvec([0.3, 0.2, 1]).as_quat())
    lengths = [np.linalg.norm(corners[a] - corners[b]) for a, b in EDGES]
    assert np.allclose(sorted(lengths), [1] * 4 + [2] * 4 + [4] * 4)
    assert len({frozenset(edge) for edge in EDGES}) == 12
    # many at once give what each gives alone
    rng = np.random.default_rng(0)
    centers, sizes, rotations = rng.normal(size=(5, 3)), rng.uniform(1, 5, (5, 3)), rng.normal(size=(5, 4))
    alone = [box_corners(*one) for one in zip(centers, sizes, rotations, strict=True)]
    np.testing.assert_allclose(box_corners(centers, sizes, rotations), alone)
    rng = np.random.default_rng(1)
    rotation, center, size = (Rotation.from_rotvec([0.2, -0.5, 2]), np.array([5.0, -3, 1]), np.array([4.0, 2, 1.5]))
    points = center + rng.uniform(-3, 3, (2000, 3))
    rows = rotation.as_matrix().T  # each row is one of the box's axes
    expected = [
        all(abs(sum(a * d for a, d in zip(rows[k], point - center, strict=True))) <= size[k] / 2 for k in range(3))
        for point in points
    ]
    found = points_in_box(points, center, size, rotation.as_quat())
    assert found.tolist() == expected
    assert 50 < found.sum() < 1950
    # faces belong to the box, and missing coordinates lie in none
    points = [(2, 0, 0), (2.0001, 0, 0), (0, 0, -0.5), (2.1, 0, 0), (np.nan, 0, 0), (0, np.nan, 0), (0, 0, np.nan)]
    for margin, inside in ((0.0, [True, False, True]), (0.05, [True, True, True])):
        found = points_in_box(points, (0, 0, 0), (4, 2, 1), NO_ROTATION, margin=margin)
        assert found.tolist() == [*inside, False, False, False, False]


@pytest.mark.parametrize("order", ORDERS)
def test_cuboid_rotations_are_those_of_scipy_in_every_order_and_their_angles_come_back(order):
    angles = np.random.default_rng(0).uniform(-200, 200, (50, 3))
    in_order = angles[:, ["xyz".index(axis) for axis in order]]
    expected = Rotation.from_euler(order.upper(), in_order, degrees=True).as_matrix()  # capitals: about moved axes
    assert np.abs(rotation_from_cuboid_angles(angles, order=order) - expected).max() < ROUNDING
    found = rotation_from_cuboid_angles((0, 0, 0.7), unit="radians", order=order)
    assert np.allclose(found, Rotation.from_euler("z", 0.7).as_matrix(), atol=ROUNDING)

    def assert_comes_back(rotations, unit):
        angles = cuboid_angles_from_rotation(rotations, unit=unit, order=order)
        again = rotation_from_cuboid_angles(angles, unit=unit, order=order)
        assert np.abs(again - rotations).max() < ROUNDING
        assert np.abs(angles[..., "xyz".index(order[1])]).max() <= (90 if unit == "degrees" else np.pi / 2)

    for unit in ("degrees", "radians"):
        assert_comes_back(Rotation.random(200, np.random.default_rng(1)).as_matrix(), unit)
    # near a quarter rotation of the middle axis too
    for middle in (side * (np.pi / 2 - short_of) for side in (1, -1) for short_of in (0.0, 1e-15, 1e-9, 1e-5)):
        angles = np.array([0.4, -1.1, 2.3])
        angles["xyz".index(order[1])] = middle
        assert_comes_back(rotation_from_cuboid_angles(angles, unit="radians", order=order), "radians")


def test_the_default_is_roll_times_pitch_times_yaw_in_degrees_and_other_units_and_orders_are_refused():
    rx, ry, rz = (Rotation.from_euler(a, v, degrees=True).as_matrix() for a, v in (("x", 10), ("y", 20), ("z", 30)))
    assert np.allclose(rotation_from_cuboid_angles((10.0, 20.0, 30.0)), rx @ ry @ rz, atol=ROUNDING)
    with pytest.raises(OptionError, match="'grad'; expected one of degrees, radians"):
        rotation_from_cuboid_angles((0, 0, 0), unit="grad")
    for order in ("xyx", "XYZ", "", "rpy"):
        with pytest.raises(OptionError, match="expected one of xyz, xzy"):
            cuboid_angles_from_rotation(np.eye(3), order=order)
