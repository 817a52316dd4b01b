"""From a sparse depth image to a dense one, by a method with a name."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float32Array, UInt8Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.results import FusedView
from sceneloom.depth.confidence import grade
from sceneloom.depth.gaps import Filled, blend, close_gaps
from sceneloom.depth.results import DenseDepth
from sceneloom.depth.samples import Samples, pixels_per_radian
from sceneloom.depth.surfaces import cover_surfaces
from sceneloom.errors import ArrayError, OptionError


def complete_depth(
    source: FusedView | Float32Array,
    camera: Camera | None = None,
    rgb: UInt8Array | None = None,
    *,
    method: str = "quality",
) -> DenseDepth:
    """Give a depth to every pixel near measured points, and state how far each can be trusted.

    Points must be free of what the camera does not see: of a view the hidden ones are left out. What has no points near
    it, as the sky, stays empty.

    Args:
        source: a sweep in an image, whose points count at their exact locations; or (H, W) float32 [m], the depths of
            some pixels, 0 for none.
        camera: the camera model of the image; a view has its own.
        rgb: (H, W, 3) uint8, the image, by which `quality` locations jumps; None: that of the view, or none.
        method: a name out of `METHODS`.

    Raises:
        ArrayError: an array is not of the camera's size, or a depth is NaN, infinite or negative.
        CalibrationError: the camera's model is unknown or has other coefficients.
        OptionError: the method is not known.
    """
    if method not in METHODS:
        raise OptionError(f"method {method!r}; expected one of {', '.join(METHODS)}")
    if isinstance(source, FusedView):
        camera_model, samples = source.camera, Samples.of_view(source)
        image: UInt8Array | None = source.rgb if rgb is None else rgb
    elif camera is None:
        raise ArrayError("camera: missing; a depth image needs the camera model that it was taken with")
    else:
        camera_model, samples, image = camera, Samples.of_image(source, camera), rgb
    check_array("rgb", image, (camera_model.height, camera_model.width, 3), np.uint8, optional=True)
    filled = METHODS[method](samples, image, pixels_per_radian(camera_model))
    return DenseDepth(filled.depths, grade(method, filled))


def _fill_fast(samples: Samples, _: UInt8Array | None, per_radian: float) -> Filled:
    filled = close_gaps(samples, per_radian)
    return Filled(blend(filled.depths), filled.trusts, filled.spreads, filled.gaps, filled.spacing)


Method = Callable[[Samples, UInt8Array | None, float], Filled]
"""Fills an image: samples, the image or None, pixels per radian."""

METHODS: Mapping[str, Method] = MappingProxyType({"fast": _fill_fast, "quality": cover_surfaces})
"""Name of each method and what runs it."""
