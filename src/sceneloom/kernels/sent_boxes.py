"""Boxes as detectors send them, in the numbers that are reckoned with."""

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array
from sceneloom.kernels.cache import kernel

_LIST, _ROWS = (f"Array(float32, {n}, 'C', readonly=True)" for n in (1, 2))


@kernel(
    "Tuple((float64[:,::1], float64[:,::1], float64[::1], float64[:,::1]))"
    f"({_ROWS}, {_ROWS}, {_ROWS}, {_LIST}, {_ROWS})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def upright_boxes(
    centers: Float32Array,
    sizes: Float32Array,
    directions: Float32Array,
    speeds: Float32Array,
    vectors: Float32Array,
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Give boxes by their headings, and how they move.

    Args:
        centers, sizes: (N, 3) [m].
        directions: (N, 3), where boxes head, of any length but 0.
        speeds: (N,) [m/s], along the directions.
        vectors: (N, 3) [m/s], velocities, which count instead of speeds; (0, 3) for none.

    Returns:
        centers and sizes: (N, 3) float64 [m]; headings about z: (N,) float64 [rad]; velocities: (N, 3) float64 [m/s].
    """
    count = len(centers)
    places, lengths, yaws, velocities = (
        np.empty((count, 3)),
        np.empty((count, 3)),
        np.empty(count),
        np.empty((count, 3)),
    )
    for n in range(count):
        x, y, z = np.float64(directions[n, 0]), np.float64(directions[n, 1]), np.float64(directions[n, 2])
        yaws[n] = np.arctan2(y, x)
        along = np.float64(speeds[n]) / np.sqrt(x * x + y * y + z * z)
        for k in range(3):
            places[n, k], lengths[n, k] = centers[n, k], sizes[n, k]
            velocities[n, k] = vectors[n, k] if len(vectors) else np.float64(directions[n, k]) * along
    return places, lengths, yaws, velocities
