"""Labels of images onto points, and of points into images: always those of single pixels and points."""

import math

import numpy as np
from numba import boolean, float32, int64, types, uint16, void

from sceneloom.arrays import BoolArray, Float32Array, Int64Array, UInt16Array
from sceneloom.kernels.cache import kernel

_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)
_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)
_IN_U16_1D = types.Array(uint16, 1, "C", readonly=True)
_IN_U16_2D = types.Array(uint16, 2, "C", readonly=True)


@kernel(
    void(_IN_I64_1D, _IN_F32_2D, _IN_F32_1D, _IN_U16_2D, uint16[::1], float32[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def take_labels(
    point_ids: Int64Array,
    pixels: Float32Array,
    weights: Float32Array,
    labels: UInt16Array,
    votes: UInt16Array,
    trust: Float32Array,
) -> None:
    """Give each point that an image shows the label of its nearest pixel.

    Args:
        point_ids: (M,), rows of the outputs.
        pixels: (M, 2) [px].
        weights: (M,), 0 for points that are not visible, which are passed over.
        labels: (H, W).
        votes, trust: (N,), written where the image shows the point.
    """
    height, width = labels.shape
    for i in range(point_ids.shape[0]):
        if weights[i] > 0.0:
            column = min(max(math.floor(pixels[i, 0] + 0.5), 0), width - 1)
            row = min(max(math.floor(pixels[i, 1] + 0.5), 0), height - 1)
            votes[point_ids[i]] = labels[row, column]
            trust[point_ids[i]] = weights[i]


@kernel(
    void(_IN_U16_2D, types.Array(float32, 2, "C", readonly=True), uint16, uint16[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def count_votes(votes: UInt16Array, trust: Float32Array, none: int, labels: UInt16Array) -> None:
    """Give each point the label that most images give it; of equally many the one that is trusted more.

    Args:
        votes: (V, N), `none` where an image says nothing.
        trust: (V, N).
        none: what stands for no label.
        labels: (N,), written.
    """
    for i in range(votes.shape[1]):
        labels[i] = none
        most, surest = 0, np.float32(0.0)
        for a in range(votes.shape[0]):
            if votes[a, i] == none:
                continue
            count, sure = 0, np.float32(0.0)
            for b in range(votes.shape[0]):
                if votes[b, i] == votes[a, i]:
                    count += 1
                    sure += trust[b, i]
            if count > most or (count == most and sure > surest):
                most, surest, labels[i] = count, sure, votes[a, i]


@kernel(
    void(
        _IN_I64_1D,
        _IN_F32_2D,
        _IN_F32_1D,
        _IN_BOOL_1D,
        _IN_U16_1D,
        uint16,
        int64,
        float32[:, ::1],
        uint16[:, ::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def draw_labels(
    point_ids: Int64Array,
    pixels: Float32Array,
    depths: Float32Array,
    visible: BoolArray,
    labels: UInt16Array,
    none: int,
    radius_px: int,
    depth_image: Float32Array,
    label_image: UInt16Array,
) -> None:
    """Draw the labels of visible points into an image, each as a square; the nearest point of a pixel counts.

    Points without a label cover what is behind them, too, and leave their pixels as they are.

    Args:
        point_ids: (M,), rows of `labels`.
        pixels: (M, 2) [px].
        depths: (M,) [m].
        visible: (M,).
        labels: (N,), `none` for points without one.
        none: what stands for no label.
        radius_px: of the square beside the pixel itself.
        depth_image: (H, W) [m], updated: depth of the nearest point drawn so far, infinite for none.
        label_image: (H, W), updated; 0 where no labelled point is.
    """
    height, width = label_image.shape
    for i in range(point_ids.shape[0]):
        if not visible[i]:
            continue
        label = labels[point_ids[i]]
        column = min(max(math.floor(pixels[i, 0] + 0.5), 0), width - 1)
        row = min(max(math.floor(pixels[i, 1] + 0.5), 0), height - 1)
        for r in range(max(row - radius_px, 0), min(row + radius_px + 1, height)):
            for c in range(max(column - radius_px, 0), min(column + radius_px + 1, width)):
                if depths[i] < depth_image[r, c]:
                    depth_image[r, c] = depths[i]
                    label_image[r, c] = 0 if label == none else label
