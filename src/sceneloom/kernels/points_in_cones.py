"""The points of a cloud that lie in any of several cones: what may be in boxes of an image.

Before a camera model is asked.
"""

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_CLOUD, _TABLE = "Array(float32, 2, 'C', readonly=True)", "Array(float64, 2, 'C', readonly=True)"
_VECTOR = "Array(float64, 1, 'C', readonly=True)"


@kernel(
    f"int64[::1]({_CLOUD}, {_VECTOR}, {_TABLE}, {_VECTOR})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def points_in_cones(
    points: Float32Array, apex: Float64Array, axes: Float64Array, cosines: Float64Array
) -> Int64Array:
    """Choose the points that lie in any of the cones.

    Args:
        points: (N, 3) [m]; those that are not finite lie in none.
        apex: (3,) [m], where all cones begin.
        axes: (L, 3), unit, where they lead.
        cosines: (L,), of the angles between their axes and their sides, above 0.

    Returns:
        (M,) int64, rising, which points.
    """
    kept, count = np.empty(len(points), np.int64), 0
    for n in range(len(points)):
        x, y, z = points[n, 0] - apex[0], points[n, 1] - apex[1], points[n, 2] - apex[2]
        square = x * x + y * y + z * z
        for k in range(len(axes)):
            along = x * axes[k, 0] + y * axes[k, 1] + z * axes[k, 2]
            if along > 0.0 and along * along >= cosines[k] * cosines[k] * square and square < np.inf:
                kept[count] = n
                count += 1
                break
    return kept[:count]
