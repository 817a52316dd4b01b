"""Where the colour of each point comes from."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, UInt8Array, check_array

NO_IMAGE_NS = np.iinfo(np.int64).min
"""In `images_ns`: no image shows the point."""


@dataclass(frozen=True, slots=True, eq=False)
class PointSources:
    """For each point the image whose colour counts most.

    Attributes:
        camera_index: (N,) uint8, the camera among the scene's, 255 for none.
        images_ns: (N,) int64 [ns], time of its image, `NO_IMAGE_NS` for none.
        pixels: (N, 2) float32 [px], where the point falls in it, NaN for none.
        weights: (N,) float32, how far the colour is to be trusted, 0 for none.
    """

    camera_index: UInt8Array
    images_ns: Int64Array
    pixels: Float32Array
    weights: Float32Array

    def __post_init__(self) -> None:
        count = check_array("sources.camera_index", self.camera_index, (None,), np.uint8)
        check_array("sources.images_ns", self.images_ns, (count,), np.int64)
        check_array("sources.pixels", self.pixels, (count, 2), np.float32)
        check_array("sources.weights", self.weights, (count,), np.float32)

    @classmethod
    def none(cls, count: int) -> "PointSources":
        """Of points that no image shows; the arrays are new and may be filled."""
        return cls(
            np.full(count, 255, np.uint8),
            np.full(count, NO_IMAGE_NS, np.int64),
            np.full((count, 2), np.nan, np.float32),
            np.zeros(count, np.float32),
        )
