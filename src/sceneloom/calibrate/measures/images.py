"""An image as the measures take it: small, its edges by direction, its grey levels evened out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sceneloom.arrays import Float32Array, Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import intrinsics_vector

DIRECTIONS = 4
"""Edges are distinguished by the direction across them: 0, 45, 90, 135 degrees from rightward to downward."""

LEVELS = 24
"""Grey levels and intensities are distinguished by so many."""

_PIXELS_PER_RADIAN = 750.0
"""About the finest that is looked at: a pixel of 0.08 degrees is less than the step of nearly all lidars."""

_SMOOTHED_PX = 1.0
_SURROUNDINGS_PX = 61
"""Edges are compared with others this near."""
_NOISE = 2.0
"""Grey levels per pixel that noise and compression make."""
_STRONGEST = 3.0
WIDTHS_PX = {"fine": 1.0, "coarse": 5.0}
"""How far edges are widened, so that what misses them by a little still meets them."""
_GREY_PX = 1.5
_STEPS = 16
"""Parts of a grey level that are distinguished."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredImage:
    """What measures need of an image.

    Attributes:
        camera: the camera model of the reduced image.
        camera_model: its numbers as the projection takes them.
        grey: (H, W) float32, the reduced image, 0 to 255.
        edges: by name of the width, "fine" and "coarse": (4, H, W) float32, strength of edges across each direction,
            as multiples of what is usual around them.
        levels: (H, W) float32, 0 to `LEVELS` - 1, each level as frequent as any other.
        plainness: share of the image that shows nothing: of one brightness, as far as can be reported.
    """

    camera: Camera
    camera_model: Float64Array
    grey: Float32Array
    edges: dict[str, Float32Array]
    levels: Float32Array
    plainness: float


def blur(image: Float32Array, width: float) -> Float32Array:
    """Blur an image (H, W) float32 by a Gaussian of a standard deviation [px], up to three of it; borders mirror."""
    return np.asarray(ndimage.gaussian_filter(image, width, truncate=3.0), np.float32)


def box_means(image: Float32Array, size: int) -> Float32Array:
    """Average an image (H, W) float32 over squares of an odd side [px]; the border's pixels go on beyond it."""
    return np.asarray(ndimage.uniform_filter(image, size, mode="nearest"), np.float32)


def measured_image(
    grey: Float32Array, camera: Camera, *, widths: Sequence[str] = tuple(WIDTHS_PX)
) -> MeasuredImage:
    """Reduce an image to what its camera model distinguishes at 0.08 degrees, and find its edges and levels.

    Args:
        widths: names of the widths at which edges are wanted.
    """
    small, camera_model = reduced_image(grey, camera)
    smoothed = blur(small, _SMOOTHED_PX)
    across, down = ndimage.sobel(smoothed, 1) / 8.0, ndimage.sobel(smoothed, 0) / 8.0
    strength = np.hypot(across, down)
    shares = 1.0 / (box_means(strength, _SURROUNDINGS_PX) + np.float32(_NOISE))
    trajectories = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    cosines, sines = np.cos(trajectories).astype(np.float32), np.sin(trajectories).astype(np.float32)
    directed = [
        np.minimum(np.abs(across * cosine + down * sine) * shares, np.float32(_STRONGEST))
        for cosine, sine in zip(cosines, sines, strict=True)
    ]
    edges = {name: np.stack([blur(image, WIDTHS_PX[name]) for image in directed]) for name in widths}
    plain = float(np.mean(box_means(strength, 9) < 0.25))
    return MeasuredImage(
        camera_model, intrinsics_vector(camera_model), small, edges, evened(blur(small, _GREY_PX)), plain
    )


def reduced_image(grey: Float32Array, camera: Camera) -> tuple[Float32Array, Camera]:
    """Average blocks of pixels to what the camera model distinguishes at 0.08 degrees.

    What is left over at the ends is cut.
    """
    factor = max(int(min(camera.fx, camera.fy) / _PIXELS_PER_RADIAN + 0.25), 1)
    height, width = grey.shape[0] // factor, grey.shape[1] // factor
    if factor == 1 or height < 2 or width < 2:
        return grey, camera
    blocks = grey[: height * factor, : width * factor].reshape(height, factor, width, factor)
    cut = Camera(
        camera.model,
        width * factor,
        height * factor,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        camera.coefficients,
    )
    return np.ascontiguousarray(blocks.mean(axis=(1, 3), dtype=np.float32)), cut.resized(width, height)


def evened(grey: Float32Array) -> Float32Array:
    """Rotate brightness (H, W), 0 to 255, into levels that are as frequent as any other, 0 to `LEVELS` - 1."""
    sample = np.sort(grey.ravel()[:: max(grey.size // 20_000, 1)])
    shares = np.searchsorted(sample, np.arange(256 * _STEPS) / _STEPS) / max(len(sample), 1)
    table = (shares * (LEVELS - 1)).astype(np.float32)
    return table[np.clip(grey * _STEPS, 0, len(table) - 1).astype(np.int32)]
