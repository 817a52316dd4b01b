"""What the hot path of the projection writes."""

from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float32Array, Int32Array, Int64Array


class PointsInImage(NamedTuple):
    """Room for the points of a cloud that fall into an image, as many rows as the cloud has points.

    Attributes:
        point_ids: (N,) int64, ascending.
        pixels: (N, 2) float32 [px].
        pixel_numbers: (N,) int32, the nearest pixel, counted row by row.
        depths: (N,) float32, z in the camera frame [m].
        rightward, downward: (N,) float32, direction in the equal-area map of `kernels.directions`.
        inverse_ranges: (N,) float32 [1/m], 0 for a point so near or so far that it has no direction.
    """

    point_ids: Int64Array
    pixels: Float32Array
    pixel_numbers: Int32Array
    depths: Float32Array
    rightward: Float32Array
    downward: Float32Array
    inverse_ranges: Float32Array

    @classmethod
    def room(cls, count: int) -> "PointsInImage":
        """Make room for so many points."""
        ids, pixels = np.empty(count, np.int64), np.empty((count, 2), np.float32)
        # arrays of their own: what keeps one of them shall not hold the others
        return cls(ids, pixels, np.empty(count, np.int32), *(np.empty(count, np.float32) for _ in range(4)))

    def part(self, start: int, stop: int) -> "PointsInImage":
        """Give some rows of all."""
        return PointsInImage._make(rows[start:stop] for rows in self)
