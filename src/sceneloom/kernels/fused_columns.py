"""The columns of fused boxes: of those of a sweep, then of those of a picture alone."""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_ROWS, _BLOCKS, _WHOLE = "float64[:,::1]", "float64[:,:,::1]", "int64[::1]"


@kernel(
    f"Tuple(({_ROWS}, {_BLOCKS}, {_ROWS}, {_BLOCKS}, float64[::1]))({_ROWS}, {_BLOCKS}, {_ROWS}, {_BLOCKS}, {_ROWS}, "
    f"{_BLOCKS})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def join_places(
    boxes: Float64Array,
    covariances: Float64Array,
    centers: Float64Array,
    center_covariances: Float64Array,
    sizes: Float64Array,
    size_covariances: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array, Float64Array]:
    """Join where objects of a sweep are with where those of a picture alone are, whose heading is given as 0.

    Args:
        boxes: (N, 7), middle, size [m] and heading [rad].
        covariances: (N, 6, 6) [m²], of middle and size.
        centers, sizes: (P, 3) [m].
        center_covariances, size_covariances: (P, 3, 3) [m²].

    Returns:
        Of N + P objects float64: centers, their covariances, sizes, their covariances, headings.
    """
    count, room = len(boxes), len(boxes) + len(centers)
    joined, lengths, yaws = np.empty((room, 3)), np.empty((room, 3)), np.zeros(room)
    of_joined, of_lengths = np.empty((room, 3, 3)), np.empty((room, 3, 3))
    for n in range(count):
        yaws[n] = boxes[n, 6]
        for i in range(3):
            joined[n, i], lengths[n, i] = boxes[n, i], boxes[n, 3 + i]
            for k in range(3):
                of_joined[n, i, k] = covariances[n, i, k]
                of_lengths[n, i, k] = covariances[n, 3 + i, 3 + k]
    joined[count:], of_joined[count:] = centers, center_covariances
    lengths[count:], of_lengths[count:] = sizes, size_covariances
    return joined, of_joined, lengths, of_lengths, yaws


@kernel(
    f"Tuple(({_ROWS}, {_WHOLE}, {_WHOLE}))({_ROWS}, {_WHOLE}, {_WHOLE}, {_ROWS}, {_WHOLE}, {_WHOLE}, int64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def join_sources(
    outlines: Float64Array,
    rows_3d: Int64Array,
    partners: Int64Array,
    corners: Float64Array,
    rows_2d: Int64Array,
    alone: Int64Array,
    none: int,
) -> tuple[Float64Array, Int64Array, Int64Array]:
    """Say where a picture shows objects, and which boxes they come from.

    Args:
        outlines: (N, 4) [px], of the boxes of the sweep in the picture.
        rows_3d: (N,), what those boxes are called.
        partners: (N,), which box of the picture is the same object, -1 for none.
        corners: (M, 4) [px], boxes of the picture.
        rows_2d: (M,), what those are called.
        alone: (P,), which of them are objects by themselves.
        none: what no box is called.

    Returns:
        Of N + P objects: (N + P, 4) float64 [px], the box of the picture where there is one; what the boxes of the
        sweep and those of the picture are called, both (N + P,) int64.
    """
    count, room = len(outlines), len(outlines) + len(alone)
    shown, of_sweep, of_picture = np.empty((room, 4)), np.full(room, none), np.full(room, none)
    of_sweep[:count] = rows_3d
    for n in range(room):
        source = partners[n] if n < count else alone[n - count]
        if source >= 0:
            shown[n], of_picture[n] = corners[source], rows_2d[source]
        else:
            shown[n] = outlines[n]
    return shown, of_sweep, of_picture
