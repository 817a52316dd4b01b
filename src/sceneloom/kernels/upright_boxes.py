"""Upright boxes: where their corners are in another frame."""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.kernels.cache import kernel


@kernel(
    "Tuple((float64[:,:,::1], float64[:,:,::1], float64[::1], float64[::1]))(float64[:,::1], "
    "Array(float64, 2, 'C', readonly=True), Array(float64, 2, 'C', readonly=True), "
    "Array(float64, 1, 'C', readonly=True))",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def place_upright_boxes(
    boxes: Float64Array, signs: Float64Array, rotation: Float64Array, translation: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Take boxes into the frame of an eye.

    Args:
        boxes: (N, 7): middle, length, width, height [m] and heading about z [rad].
        signs: (8, 3), on which side of the middle each corner lies.
        rotation, translation: (3, 3) and (3,) [m], take the boxes' frame into the eye's.

    Returns:
        axes: (N, 3, 3) float64, whose columns are the boxes' axes in the eye's frame.
        corners: (N, 8, 3) float64 [m], in the eye's frame.
        distances: (N,) float64 [m], of their middles from the eye.
        gaps: (N,) float64 [m], of the boxes from the eye, 0 for those around it.
    """
    count = len(boxes)
    axes, corners = np.empty((count, 3, 3)), np.empty((count, 8, 3))
    distances, gaps = np.empty(count), np.empty(count)
    middle, inside = np.empty(3), np.empty(3)
    for n in range(count):
        cosine, sine = np.cos(boxes[n, 6]), np.sin(boxes[n, 6])
        for k in range(3):
            axes[n, k, 0] = rotation[k, 0] * cosine + rotation[k, 1] * sine
            axes[n, k, 1] = rotation[k, 1] * cosine - rotation[k, 0] * sine
            axes[n, k, 2] = rotation[k, 2]
            middle[k] = translation[k]
            for i in range(3):
                middle[k] += rotation[k, i] * boxes[n, i]
        for c in range(8):
            for k in range(3):
                corners[n, c, k] = middle[k]
                for i in range(3):
                    corners[n, c, k] += axes[n, k, i] * signs[c, i] * boxes[n, 3 + i] / 2.0
        distances[n] = np.sqrt(middle[0] ** 2 + middle[1] ** 2 + middle[2] ** 2)
        for i in range(3):
            along = axes[n, 0, i] * middle[0] + axes[n, 1, i] * middle[1] + axes[n, 2, i] * middle[2]
            inside[i] = max(abs(along) - boxes[n, 3 + i] / 2.0, 0.0)
        gaps[n] = np.sqrt(inside[0] ** 2 + inside[1] ** 2 + inside[2] ** 2)
    return axes, corners, distances, gaps
