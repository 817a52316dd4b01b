"""The camera model of a camera: which projection model, with which numbers, for which image size."""

import math
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.table import MODELS
from sceneloom.errors import CalibrationError


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of one camera in the centre convention: pixel (0, 0) is the centre of the top-left pixel.

    Attributes:
        model: a name out of `sceneloom.cameras.MODELS` ("pinhole", "brown_conrady", "fisheye", …).
        width, height: image size [px].
        fx, fy: focal lengths [px].
        cx, cy: principal point [px].
        coefficients: distortion in the model's own order, as many as the model has; () for none.

    Source: "Camera Sensor" of the SFS description.
    """

    model: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise CalibrationError(
                f"image size {self.width}x{self.height}; expected positive numbers of pixels"
            )
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        if not all(abs(value) < float("inf") for value in numbers):
            raise CalibrationError(f"camera numbers {numbers}; expected finite ones")
        if self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(f"focal lengths {self.fx}, {self.fy}; expected positive numbers of pixels")

    @property
    def matrix(self) -> Float64Array:
        """The calibration matrix K, (3, 3) float64 [px]: takes (x/z, y/z, 1) to (u, v, 1), without distortion."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera model for images of another size: c' = (c + 0.5) s - 0.5 along each axis.

        Raises:
            CalibrationError: the axes shrink differently, by more than rounding to whole pixels, and the model has no
                focal length of its own for each of them.
        """
        scale_u, scale_v = width / self.width, height / self.height
        return Camera(
            self.model,
            width,
            height,
            self.fx * scale_u,
            self.fy * scale_v,
            (self.cx + 0.5) * scale_u - 0.5,
            (self.cy + 0.5) * scale_v - 0.5,
            self._resized_coefficients(scale_u, scale_v),
        )

    def _resized_coefficients(self, scale_u: float, scale_v: float) -> tuple[float, ...]:
        model = MODELS.get(self.model)
        if model is None or not model.pixel_axes:
            return self.coefficients
        if "uv" in model.pixel_axes.values() and abs(scale_u - scale_v) * max(self.width, self.height) > 1.0:
            raise CalibrationError(
                f"image size times {scale_u:g} and {scale_v:g}; expected the same for both axes of a "
                f"{self.model} camera model, whose coefficients are pixels in all directions"
            )
        scales = {None: 1.0, "u": scale_u, "v": scale_v, "uv": math.sqrt(scale_u * scale_v)}
        axes = [model.pixel_axes.get(name) for name in model.coefficient_names]
        return tuple(value * scales[axis] for value, axis in zip(self.coefficients, axes, strict=False))
