"""Headings and motion."""

import numpy as np
import pytest

from sceneloom.detections.projection import orient_by_motion


@pytest.mark.parametrize(
    ("speed", "off_deg", "rotated"),
    [(8.0, 180.0, True), (8.0, 150.0, True), (8.0, 90.0, False), (8.0, 0.0, False), (2.0, 180.0, False)],
)
def test_what_drives_backwards_fast_is_reversed(speed, off_deg, rotated):
    yaw = 2.5
    trajectory = yaw + np.radians(off_deg)
    velocities = np.array([[speed * np.cos(trajectory), speed * np.sin(trajectory), 0.0]])
    found = orient_by_motion(np.array([yaw]), velocities)[0]
    assert np.cos(found - yaw) == pytest.approx(-1.0 if rotated else 1.0)
    assert -np.pi <= found <= np.pi


def test_without_velocities_headings_stay():
    yaws = np.array([0.3, -2.0])
    np.testing.assert_array_equal(orient_by_motion(yaws, None), yaws)
    np.testing.assert_array_equal(orient_by_motion(yaws, np.full((2, 3), np.nan)), yaws)
