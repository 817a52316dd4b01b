"""A principal point off its location beside a rotated camera: what is alike, against the formulas of a pinhole."""

import numpy as np
import pytest

from sceneloom.calibrate.health import instead_of_rotation, look_alikes, why_untold
from sceneloom.cameras.camera import Camera

PINHOLE = Camera("pinhole", 1242, 375, 720.0, 700.0, 620.5, 187.0)
FISHEYE = Camera("fisheye", 1280, 960, 400.0, 400.0, 639.5, 479.5, (0.03, -0.008, 0.002, -0.0004))


def fitted(shift):
    """Least squares by the derivatives of x/z and y/z by a rotation, in closed form: the rotation.

    And what is left [px].
    """
    u, v = np.meshgrid(np.linspace(-0.5, 1241.5, 41), np.linspace(-0.5, 374.5, 25))
    x, y = (u.ravel() - 620.5) / 720.0, (v.ravel() - 187.0) / 700.0
    pitch = np.column_stack([-720 * x * y, -700 * (1 + y * y)])
    yaw = np.column_stack([720 * (1 + x * x), 700 * x * y])
    roll = np.column_stack([-720 * y, 700 * x])
    focal = np.column_stack([720 * x, 700 * y])
    columns = np.stack([part.ravel() for part in (pitch, yaw, roll, focal)], axis=1)
    wanted = np.tile(shift, len(x))
    found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return found[:3], np.sqrt(((wanted - columns @ found) ** 2).sum() / len(x))


def test_a_pinhole_is_as_its_formulas_state():
    rotations, left = look_alikes(PINHOLE)
    for row, shift in enumerate(([1.0, 0.0], [0.0, 1.0])):
        rotation, rest = fitted(shift)
        np.testing.assert_allclose(rotations[row], rotation, atol=1e-9)
        assert left[row] == pytest.approx(rest, rel=1e-5)
    # A pixel sideways is nearly 1/720 rad about y; tan² θ runs up to 0.74 and leaves a fifth of it.
    assert rotations[0, 1] * 720 == pytest.approx(0.8, abs=0.1)
    assert 0.15 < left[0] < 0.25


def test_a_long_camera_model_reports_less_and_one_that_sees_half_the_world_more():
    long = Camera("pinhole", 1242, 375, 2880.0, 2800.0, 620.5, 187.0)
    assert (look_alikes(long)[1] < 0.1 * look_alikes(PINHOLE)[1]).all()
    assert (look_alikes(FISHEYE)[1] > look_alikes(PINHOLE)[1]).all()


def test_a_rotation_says_which_principal_point_it_may_be_in_truth():
    stated = instead_of_rotation(PINHOLE, np.radians([0.0, 1.0, 0.0]))
    rotations, left = look_alikes(PINHOLE)
    trajectory = np.radians(1.0) / rotations[0, 1]
    assert (
        stated
        == f"its principal point {trajectory:.2g} px off looks the same within {trajectory * left[0]:.2g} px"
    )
    assert instead_of_rotation(PINHOLE, np.radians([0.1, 0.1, 1.0])) == ""
    assert f"by {trajectory:.3g} px to the side" in why_untold(PINHOLE)


def test_a_camera_model_that_sees_nothing_promises_nothing():
    blind = Camera("pinhole", 1, 1, 1e-9, 1e-9, 1e12, 1e12)
    assert why_untold(blind).startswith("moving it")
    assert isinstance(instead_of_rotation(blind, np.ones(3)), str)
