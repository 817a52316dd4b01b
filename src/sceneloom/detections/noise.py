"""How far off boxes are, where their detector does not say so."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.kernels.upright_boxes import assumed_covariances
from sceneloom.scene.detections import Boxes3D

CENTER_SIGMAS = (0.05, 0.03)
"""Deviation of a middle along an axis of its box: this share of its size along that axis, plus so much [m].

Source: about twice the errors of PointRCNN on KITTI's sequences, on which it was trained: 0.18, 0.09 and 0.06 m along
length, width and height of cars at 15 to 30 m, 0.28, 0.19 and 0.13 m beyond 50 m.
"""
SIZE_SIGMAS = (0.06, 0.04)
"""Deviation of a size: this share of it, plus so much [m]."""
RANGE_SCALE = 60.0
"""Range at which deviations have doubled [m]."""


def center_and_size_covariances(boxes: Boxes3D) -> Float64Array:
    """Give the covariances of middles and sizes, (N, 6, 6) float64 [m²]: x, y, z, length, width, height.

    What the detector tells counts where it is a covariance: finite, with variances above 0. Otherwise deviations are
    taken to grow with size and range, σ = (share · size + least) (1 + range / 60 m), along the axes of the box.
    """
    numbers = np.column_stack([boxes.centers, boxes.sizes_lwh, boxes.yaws])
    covariances: Float64Array = assumed_covariances(numbers, *CENTER_SIGMAS, *SIZE_SIGMAS, RANGE_SCALE)
    if boxes.covariances is not None:
        said = boxes.covariances[:, :6, :6]
        said = (said + said.transpose(0, 2, 1)) / 2.0
        sound: BoolArray = np.all(np.isfinite(said), axis=(1, 2))
        sound[sound] = np.linalg.eigvalsh(said[sound])[:, 0] > 0.0
        covariances[sound] = said[sound]
    return covariances
