"""How far off boxes are taken to be."""

import numpy as np

from sceneloom.detections.detectors import CENTER_SIGMAS, KINDS, SIZE_SIGMAS, independent_detectors
from sceneloom.detections.settings import box_covariances, noise_table

NOISE = noise_table(independent_detectors())
YAWS = np.array([0.4, -2.0, 1.0, 0.2])


def covariances_of(reported=None):
    centers = np.array([[30.0, 40.0, 0.0], [0.0, 60.0, 0.0], [5.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    sizes = np.array([[4.0, 2.0, 1.5], [1.0, 0.5, 1.7], [4.0, 2.0, 1.5], [4.0, 2.0, 1.5]])
    reported = np.zeros((0, 7, 7)) if reported is None else reported
    boxes, cars = np.column_stack([centers, sizes, YAWS]), np.zeros(4, np.int64)
    return box_covariances(boxes, np.zeros(4), reported, np.arange(4), cars, NOISE)[0]


def test_deviations_lie_along_the_axes_of_the_box_and_grow_with_the_range():
    found = covariances_of()[0]
    growth = np.sqrt(50 / 20)
    rotation = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    size = np.array(KINDS["car"].size_lwh)
    along = np.diag(((CENTER_SIGMAS[0] * size + CENTER_SIGMAS[1]) * growth) ** 2)
    np.testing.assert_allclose(found[:3, :3], rotation @ along @ rotation.T, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        found[3:, 3:], np.diag(((SIZE_SIGMAS[0] * size + SIZE_SIGMAS[1]) * growth) ** 2)
    )
    assert not found[:3, 3:].any()


def test_what_a_detector_reports_counts_where_it_is_a_covariance():
    generator = np.random.default_rng(0)
    factor = generator.normal(size=(7, 7))
    reported = np.array([factor @ factor.T] * 4)
    reported[1, 0, 0] = np.nan
    reported[2, 4, 4] = -1.0
    reported[3] = 0.0
    found, assumed = covariances_of(reported), covariances_of()
    np.testing.assert_allclose(found[0], reported[0, :6, :6], rtol=1e-12)
    np.testing.assert_array_equal(found[1:], assumed[1:])
