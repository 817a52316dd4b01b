"""Scan lines that lie close together in one part of a view and far apart in another."""

import math

import numpy as np
import pytest

from sceneloom.colouring.visibility import ScanLines, are_uneven, look_around, split_by_spacing

UNKNOWN = ScanLines(0.01, 0.01, 0.0)
FINE = np.arange(-4.0, 4.0, 0.25)
COARSE = np.concatenate([np.arange(-14.0, -4.0, 1.0), FINE, np.arange(4.0, 14.0, 1.0)])


def lines_at(across_deg, angle_deg=90.0, along_deg=0.2):
    """Directions (2, M) on lines at locations across them, shuffled, and unit inverse ranges."""
    across, along = np.meshgrid(np.radians(across_deg), np.radians(np.arange(-20, 20, along_deg)))
    along = along + np.radians(0.07) * np.arange(len(across_deg))
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    u, t = across.ravel(), along.ravel()
    directions = np.stack([c * u - s * t, s * u + c * t])
    order = np.random.default_rng(0).permutation(len(u))
    return np.ascontiguousarray(directions[:, order], np.float32), np.ones(len(u), np.float32), u[order]


@pytest.mark.parametrize("spacing_deg", [0.25, 0.6, 1.2, 2.0])
def test_lines_that_lie_alike_are_not_uneven(spacing_deg):
    directions, ones, _ = lines_at(np.arange(-14, 14, spacing_deg))
    assert not are_uneven(look_around(directions, ones))


@pytest.mark.parametrize("angle_deg", [90.0, 0.0, 45.0])
def test_parts_have_the_spacing_and_the_axis_of_their_lines(angle_deg):
    directions, ones, across = lines_at(COARSE, angle_deg)
    assert are_uneven(look_around(directions, ones))
    parts = split_by_spacing(directions, ones, UNKNOWN)
    assert np.sum([part.members for part in parts], axis=0).tolist() == [1] * len(ones)
    fine = np.abs(np.degrees(across)) < 3
    for spacing_deg, inside in ((0.25, fine), (1.0, np.abs(np.degrees(across)) > 5.5)):
        held = max(parts, key=lambda part: part.members[inside].mean())
        # In tiles at the corners of the view too few points are drawn to report.
        assert held.members[inside].mean() > 0.75
        # Cells of 0.1 degrees, and neighbours up to 45 degrees aside.
        assert math.degrees(held.lines.across) == pytest.approx(spacing_deg, abs=0.25)
        assert math.degrees(held.lines.along) == pytest.approx(0.2, abs=0.1)
        assert math.degrees(held.lines.angle) == pytest.approx(angle_deg)


def test_few_points_are_not_uneven_and_make_one_part():
    directions = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 20)).astype(np.float32)
    ones = np.ones(20, np.float32)
    assert not are_uneven(look_around(directions, ones))
    (part,) = split_by_spacing(directions, ones, UNKNOWN)
    assert part.members.all()
    assert math.degrees(part.lines.across) == pytest.approx(2.5)


def test_no_points_are_not_uneven():
    assert not are_uneven(look_around(np.zeros((2, 0), np.float32), np.zeros(0, np.float32)))
