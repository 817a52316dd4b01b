"""Smoothing along an image's surfaces but not across its edges: a least-squares fit, axis by axis.

Along each row and column the values x that minimise Σ (x - value)² + λ Σ link (x - next x)² follow from one
tridiagonal system; rows and columns take rotates while λ falls. With weights, values and weights are smoothed alike and
divided, so that what is trusted flows into what is not.

Source: Min et al. 2014, "Fast Global Image Smoothing Based on Weighted Least Squares", IEEE TIP 23 (12), eq. 9 and 11
(λ of rotation t of T: 1.5 · 4^(T-t) / (4^T - 1) · λ).
"""

from typing import Any

import numpy as np
from numba import float32, int64, types, uint8, void

from sceneloom.arrays import Float32Array, UInt8Array
from sceneloom.kernels.cache import kernel

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_U8_3D = types.Array(uint8, 3, "C", readonly=True)
_KERNEL: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp"},
}
_LANES = 16


@kernel(void(_IN_U8_3D, _IN_F32_1D, float32[:, ::1], float32[:, ::1]), cache=True, nogil=True)
def link_pixels(
    rgb: UInt8Array, link_of_difference: Float32Array, rightward: Float32Array, downward: Float32Array
) -> None:
    """Give the strength of the links between neighbouring pixels.

    Args:
        rgb: (H, W, 3).
        link_of_difference: (766,), by the sum of the differences of the three channels.
        rightward, downward: (H, W), written: of each pixel to the next one; 0 in the last column or row.
    """
    height, width = rightward.shape
    for row in range(height):
        for column in range(width):
            right, down = 0, 0
            if column + 1 < width:
                for k in range(3):
                    right += abs(int64(rgb[row, column, k]) - int64(rgb[row, column + 1, k]))
                rightward[row, column] = link_of_difference[right]
            else:
                rightward[row, column] = 0
            if row + 1 < height:
                for k in range(3):
                    down += abs(int64(rgb[row, column, k]) - int64(rgb[row + 1, column, k]))
                downward[row, column] = link_of_difference[down]
            else:
                downward[row, column] = 0


@kernel(void(_IN_F32_2D, float32, float32[:, ::1], float32[:, ::1], float32[:, ::1]), **_KERNEL)
def smooth_downward(
    links: Float32Array, strength: float, first: Float32Array, second: Float32Array, room: Float32Array
) -> None:
    """Smooth two images along axis 0, all columns side by side.

    Args:
        links: (N, M), of each row to the next; 0 in the last.
        strength: λ.
        first, second: (N, M), smoothed in place.
        room: (N, M), overwritten.
    """
    count, lanes = first.shape
    one = np.float32(1)
    for column in range(lanes):
        link = strength * links[0, column]
        scale = one / (one + link)
        room[0, column] = link * scale
        first[0, column] *= scale
        second[0, column] *= scale
    for row in range(1, count):
        for column in range(lanes):
            above, link = strength * links[row - 1, column], strength * links[row, column]
            scale = one / (one + above + link - above * room[row - 1, column])
            room[row, column] = link * scale
            first[row, column] = (first[row, column] + above * first[row - 1, column]) * scale
            second[row, column] = (second[row, column] + above * second[row - 1, column]) * scale
    for row in range(count - 2, -1, -1):
        for column in range(lanes):
            first[row, column] += room[row, column] * first[row + 1, column]
            second[row, column] += room[row, column] * second[row + 1, column]


@kernel(void(_IN_F32_2D, float32, float32[:, ::1], float32[:, ::1]), **_KERNEL)
def smooth_rightward(links: Float32Array, strength: float, first: Float32Array, second: Float32Array) -> None:
    """Smooth two images along axis 1: some rows at a time are laid side by side.

    Args:
        links: (H, W), of each pixel to the next; 0 in the last column.
        strength: λ.
        first, second: (H, W), smoothed in place.
    """
    height, width = first.shape
    laid = np.zeros((4, width, _LANES), np.float32)
    for top in range(0, height, _LANES):
        rows = min(_LANES, height - top)
        for k in range(rows):
            for column in range(width):
                laid[0, column, k] = links[top + k, column]
                laid[1, column, k] = first[top + k, column]
                laid[2, column, k] = second[top + k, column]
        smooth_downward(laid[0], strength, laid[1], laid[2], laid[3])
        for k in range(rows):
            for column in range(width):
                first[top + k, column] = laid[1, column, k]
                second[top + k, column] = laid[2, column, k]
