"""What completion gives."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float32Array, check_array


@dataclass(frozen=True, slots=True, eq=False)
class DenseDepth:
    """A depth for every pixel near measured points.

    Attributes:
        depths: (H, W) float32 [m], z in the camera frame, 0 for none, in the image's own grid.
        confidence: (H, W) float32, 0 to 1: how probable it is that the depth is less than 0.5 m, or less than 5 % where
            that is more, from the true one; 0 where there is none.
    """

    depths: Float32Array
    confidence: Float32Array

    def __post_init__(self) -> None:
        check_array("dense.depths", self.depths, (None, None), np.float32)
        check_array("dense.confidence", self.confidence, self.depths.shape, np.float32)

    def above(self, confidence: float) -> Float32Array:
        """The depths with at least this confidence; 0 elsewhere."""
        return np.where(self.confidence >= confidence, self.depths, np.float32(0))
