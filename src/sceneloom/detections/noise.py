"""How far off boxes are, where their detector does not say so."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.scene.detections import Boxes3D

CENTER_SIGMAS = (0.05, 0.03)
"""Deviation of a middle along an axis of its box: this share of its size along that axis, plus so much [m]."""
SIZE_SIGMAS = (0.06, 0.04)
"""Deviation of a size: this share of it, plus so much [m]."""
RANGE_SCALE = 60.0
"""Range at which deviations have doubled [m]."""


def center_and_size_covariances(boxes: Boxes3D) -> Float64Array:
    """Give the covariances of middles and sizes, (N, 6, 6) float64 [m²]: x, y, z, length, width, height.

    What the detector tells counts where it is a covariance: finite, with variances above 0. Otherwise deviations are
    taken to grow with size and range, σ = (share · size + least) (1 + range / 60 m), along the axes of the box.
    """
    covariances = _assumed(boxes)
    if boxes.covariances is not None:
        said = boxes.covariances[:, :6, :6]
        said = (said + said.transpose(0, 2, 1)) / 2.0
        sound: BoolArray = np.all(np.isfinite(said), axis=(1, 2))
        sound[sound] = np.linalg.eigvalsh(said[sound])[:, 0] > 0.0
        covariances[sound] = said[sound]
    return covariances


def _assumed(boxes: Boxes3D) -> Float64Array:
    growth = 1.0 + np.sqrt((boxes.centers**2).sum(axis=1)) / RANGE_SCALE
    along = ((CENTER_SIGMAS[0] * boxes.sizes_lwh + CENTER_SIGMAS[1]) * growth[:, None]) ** 2
    sizes = ((SIZE_SIGMAS[0] * boxes.sizes_lwh + SIZE_SIGMAS[1]) * growth[:, None]) ** 2
    cosines, sines = np.cos(boxes.yaws), np.sin(boxes.yaws)
    covariances = np.zeros((len(boxes), 6, 6))
    covariances[:, 0, 0] = along[:, 0] * cosines**2 + along[:, 1] * sines**2
    covariances[:, 1, 1] = along[:, 0] * sines**2 + along[:, 1] * cosines**2
    covariances[:, 0, 1] = covariances[:, 1, 0] = (along[:, 0] - along[:, 1]) * cosines * sines
    covariances[:, 2, 2] = along[:, 2]
    for axis in range(3):
        covariances[:, 3 + axis, 3 + axis] = sizes[:, axis]
    return covariances
