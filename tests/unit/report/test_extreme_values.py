"""Any finite number of a scene gets through what counts and draws it."""

import numpy as np
import pytest

from sceneloom.arrays import finite_rows
from sceneloom.report.coverage import CloudStatistics
from sceneloom.visualization.clouds import layout_map, sample_polyline

LARGEST = float(np.finfo(np.float32).max)


@pytest.mark.parametrize("far", [1e9, 1e15, 1e19, 1e30, LARGEST, -LARGEST])
def test_one_far_point_is_in_the_last_bin_of_a_sweep(far):
    statistics = CloudStatistics()
    points = np.array([[1, 0, 0], [0, 2, 0], [far, far, 0]], np.float32)
    statistics.add(points)
    found = statistics.coverage("lidar", "lidar", of=1)
    assert statistics.non_finite == 0
    assert sum(found.range_counts) == 3
    assert found.range_counts[-1] == 1
    assert found.range_max == pytest.approx(np.hypot(far, far), rel=1e-6)
    assert np.isfinite(found.range_95)


@pytest.mark.parametrize("far", [1e9, 1e155, 1e300, 1.7e308, -1.7e308])
def test_lines_with_huge_corners_have_finite_points(far):
    points = sample_polyline(np.array([[0.0, 0.0, 0.0], [far, 0.0, 0.0], [0.0, far, 0.0]]), 0.5)
    assert len(points) > 2
    assert finite_rows(points).all()


@pytest.mark.parametrize("far", [1e17, 1e300, 1.7e308])
def test_maps_of_locations_that_are_far_off_have_no_infinite_grid(far):
    layout = layout_map((far, -far), 50.0, (640, 480))
    assert len(layout.grid(0, 10.0)) < 1000
