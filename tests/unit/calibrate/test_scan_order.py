"""Scan lines of clouds made line by line."""

import numpy as np
import pytest

from sceneloom.calibrate.frames import find_scan_order


def scanned(lines: int = 16, steps: int = 360) -> tuple[np.ndarray, np.ndarray]:
    """Points on a round wall, line after line from below, each a full rotation from the front."""
    rings = np.repeat(np.arange(lines), steps)
    azimuths = np.tile(np.linspace(0.001, 2 * np.pi - 0.001, steps), lines)
    elevations = np.radians(-15.0 + 2.0 * rings)
    ranges = 10.0 + 0.3 * np.sin(7 * azimuths)
    directions = [
        np.cos(elevations) * np.cos(azimuths),
        np.cos(elevations) * np.sin(azimuths),
        np.sin(elevations),
    ]
    return (ranges * np.array(directions)).T.copy(), rings


@pytest.mark.parametrize("known", [True, False], ids=["rings", "order"])
def test_lines_are_reported_by_rings_or_by_the_order_of_the_file(known):
    points, rings = scanned()
    scan = find_scan_order(points, rings.astype(np.uint16) if known else None)
    assert scan is not None
    assert scan.count == 16
    assert (rings[scan.order] == scan.lines).all()


def test_lines_are_reported_by_elevations_where_the_order_says_nothing():
    points, rings = scanned()
    shuffled = np.random.default_rng(1).permutation(len(points))
    scan = find_scan_order(points[shuffled], None)
    assert scan is not None
    assert (rings[shuffled][scan.order] == scan.lines).all()


def test_each_line_goes_by_azimuth():
    scan = find_scan_order(scanned()[0], None)
    assert scan is not None
    same = np.diff(scan.lines) == 0
    assert (np.diff(scan.azimuths)[same] > 0).all()


def test_a_cloud_without_lines_has_none():
    points = np.random.default_rng(2).normal(size=(5000, 3)) * 10.0
    assert find_scan_order(points, None) is None


def test_few_points_have_no_lines():
    assert find_scan_order(scanned()[0][:20], None) is None
    assert find_scan_order(np.zeros((500, 3)), None) is None
