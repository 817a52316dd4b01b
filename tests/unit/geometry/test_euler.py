"""Roll, pitch and yaw of cuboids against scipy in every unit and order."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import OptionError
from sceneloom.geometry.euler import ORDERS, cuboid_angles_from_rotation, rotation_from_cuboid_angles

ROUNDING = 1e-14


@pytest.mark.parametrize("order", ORDERS)
def test_rotations_are_those_of_scipy_in_every_order(order):
    angles = np.random.default_rng(0).uniform(-200, 200, (50, 3))
    in_order = angles[:, ["xyz".index(axis) for axis in order]]
    expected = Rotation.from_euler(order.upper(), in_order, degrees=True).as_matrix()  # capitals: about moved axes
    assert np.abs(rotation_from_cuboid_angles(angles, order=order) - expected).max() < ROUNDING


def test_the_default_is_roll_times_pitch_times_yaw_in_degrees_and_yaw_alone_the_same_in_every_order():
    rx, ry, rz = (Rotation.from_euler(a, v, degrees=True).as_matrix() for a, v in (("x", 10), ("y", 20), ("z", 30)))
    assert np.allclose(rotation_from_cuboid_angles((10.0, 20.0, 30.0)), rx @ ry @ rz, atol=ROUNDING)
    for order in ORDERS:
        found = rotation_from_cuboid_angles((0, 0, 0.7), unit="radians", order=order)
        assert np.allclose(found, Rotation.from_euler("z", 0.7).as_matrix(), atol=ROUNDING)


@pytest.mark.parametrize("unit", ["degrees", "radians"])
@pytest.mark.parametrize("order", ORDERS)
def test_angles_come_back(order, unit):
    rotations = Rotation.random(200, np.random.default_rng(1)).as_matrix()
    angles = cuboid_angles_from_rotation(rotations, unit=unit, order=order)
    middle = angles[:, "xyz".index(order[1])]
    assert np.abs(rotation_from_cuboid_angles(angles, unit=unit, order=order) - rotations).max() < ROUNDING
    assert np.abs(middle).max() <= (90 if unit == "degrees" else np.pi / 2)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("short_of", [0.0, 1e-15, 1e-9, 1e-5])
@pytest.mark.parametrize("side", [1, -1])
def test_near_a_quarter_rotation_of_the_middle_axis_the_rotation_still_comes_back(order, short_of, side):
    angles = np.array([0.4, -1.1, 2.3])
    angles["xyz".index(order[1])] = side * (np.pi / 2 - short_of)
    rotation = rotation_from_cuboid_angles(angles, unit="radians", order=order)
    found = cuboid_angles_from_rotation(rotation, unit="radians", order=order)
    assert np.abs(rotation_from_cuboid_angles(found, unit="radians", order=order) - rotation).max() < ROUNDING


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rotation_from_cuboid_angles((0, 0, 0), unit="grad"), "'grad'; expected one of degrees, radians"),
        *(
            (lambda order=order: cuboid_angles_from_rotation(np.eye(3), order=order), "expected one of xyz, xzy")
            for order in ("xyx", "XYZ", "", "rpy")
        ),
    ],
)
def test_a_unit_or_an_order_that_nobody_knows_is_refused_with_those_known(call, message):
    with pytest.raises(OptionError, match=message):
        call()
