"""The measured points of an image, whatever they come from, and how they lie."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.colouring.results import FusedView
from sceneloom.errors import ArrayError


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """The measured points that an image shows.

    Attributes:
        image: (H, W) float32 [m], the nearest of each pixel, 0 for none.
        pixels: (N, 2) float32 [px], where each is.
        depths: (N,) float32 [m], all positive and finite.
    """

    image: Float32Array
    pixels: Float32Array
    depths: Float32Array

    @classmethod
    def of_view(cls, view: FusedView) -> "Samples":
        """The visible points of a view, at their locations between the pixels."""
        kept = view.visible & (view.depths > 0) & np.isfinite(view.depths)
        return cls(view.depth_image, view.pixels[kept], view.depths[kept])

    @classmethod
    def of_image(cls, sparse: Float32Array, camera: Camera) -> "Samples":
        """The pixels of a sparse depth image.

        Raises:
            ArrayError: it is of another size than the camera's images, or holds NaN, infinity or a negative depth.
        """
        check_array("sparse", sparse, (camera.height, camera.width), np.float32)
        wrong = np.argwhere(~((sparse >= 0) & (sparse < np.inf)))
        if len(wrong):
            row, column = wrong[0].tolist()
            raise ArrayError(
                f"sparse[{row}, {column}]: {sparse[row, column]}; expected metres, 0 where there is no depth"
            )
        image = np.ascontiguousarray(sparse)
        locations = np.flatnonzero(image)
        rows, columns = np.divmod(locations, camera.width)
        return cls(image, np.stack([columns, rows], axis=1).astype(np.float32), image.ravel()[locations])


def pixels_per_radian(camera: Camera) -> float:
    """How many pixels a radian takes in the middle of the image, of any camera model.

    Raises:
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    middle = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    around = middle + np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    rays = unproject(camera, around)
    angles = np.linalg.norm(rays[::2] - rays[1::2], axis=1)
    if not angles.all() or np.isnan(angles).any():
        return float(np.sqrt(camera.fx * camera.fy))
    return float(2.0 / np.sqrt(angles.prod()))


def weighted_quantile(values: AnyArray, weights: AnyArray, share: float) -> float:
    """The value below which this share of the weight lies; 0 of nothing."""
    if len(values) == 0:
        return 0.0
    order = np.argsort(values)
    sums: Float64Array = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order[min(int(np.searchsorted(sums, share * sums[-1])), len(values) - 1)]])
