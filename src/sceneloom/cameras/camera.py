"""The intrinsics of a camera, and the table of camera models: names, coefficients, domains and sources."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import CalibrationError


class Chart(StrEnum):
    """What a model's domain is a disk of, and so what the last number of `intrinsics_vector` is the radius of."""

    PERSPECTIVE = "perspective"
    """The plane z = 1."""
    ANGLE = "angle"
    """The angle off the axis [rad]."""
    SPHERE = "sphere"
    """The plane on which a shifted unit sphere is seen."""
    PANORAMA = "panorama"
    """The angle to each side [rad]; all directions but straight up and down."""


class Model(NamedTuple):
    """A row of the table of models.

    Attributes:
        module: where the model is, as a constant of its name in capitals; imported on first use, since it loads the
            compiler.
        coefficient_names: what the coefficients are called, in order.
        chart: what the domain is a disk of.
        source: where the formula comes from.
        assumed: whether no source confirms the formula.
        on_request: whether what is assumed is so much that a camera model is computed with only where a user asks for
            it.
        pixel_axes: of coefficients in pixels, the axis of the image that they are measured along: "u", "v",
            or "uv" in all directions.
    """

    module: str
    coefficient_names: tuple[str, ...]
    chart: Chart
    source: str
    assumed: bool = False
    on_request: bool = False
    pixel_axes: Mapping[str, str] = MappingProxyType({})


def _row(
    module: str,
    names: str,
    chart: Chart,
    source: str,
    *,
    assumed: bool = False,
    on_request: bool = False,
    pixel_axes: Mapping[str, str] = MappingProxyType({}),
) -> Model:
    """Make a row from the names of its coefficients in one line."""
    path, coefficients = f"sceneloom.cameras.{module}", tuple(names.split())
    return Model(path, coefficients, chart, source, assumed, on_request, MappingProxyType(pixel_axes))


_MEI = "Mei and Rives 2007"
_SFS = "Sensor Fusion Scene's own library"

MODELS: Mapping[str, Model] = MappingProxyType(
    {
        "pinhole": _row("perspective", "", Chart.PERSPECTIVE, "Hartley and Zisserman 2004"),
        "brown_conrady": _row(
            "perspective", "k1 k2 p1 p2 k3 k4 k5 k6 lx ly s1 s2 s3 s4 tx ty", Chart.PERSPECTIVE, "OpenCV"
        ),
        "fisheye": _row("fisheye", "k1 k2 k3 k4", Chart.ANGLE, "OpenCV; Kannala and Brandt 2006"),
        "mod_equi_fish": _row("fisheye", "k1 k2 k3 k4", Chart.ANGLE, _SFS),
        "mod_kannala": _row("fisheye", "k1 k2 k3 k4", Chart.ANGLE, _SFS),
        "cylindrical": _row("panorama", "", Chart.PANORAMA, "the usual cylindrical panorama", assumed=True),
        "equirectangular": _row("panorama", "", Chart.PANORAMA, "the usual equirectangular panorama", assumed=True),
        "omnidirectional": _row("omnidirectional", "k1 k2 k3 k4 p1 p2 xi lx ly", Chart.SPHERE, _MEI),
        "fisheye_rad_tan_prism": _row(
            "fisheye", "k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4", Chart.ANGLE, "Project Aria, Fisheye624"
        ),
        "fisheye_radial_custom": _row(
            "fisheye",
            "k1 k2 k3 k4 k5 k6 p1 p2 dcx dcy",
            Chart.ANGLE,
            "after the models beside it",
            assumed=True,
            on_request=True,
            pixel_axes={"dcx": "u", "dcy": "v"},
        ),
        "ftheta": _row(
            "fisheye",
            "k1 k2 k3 k4 k5",
            Chart.ANGLE,
            "after other camera models of the name",
            assumed=True,
            on_request=True,
            pixel_axes=dict.fromkeys(("k1", "k2", "k3", "k4", "k5"), "uv"),
        ),
        "ftheta_skewed": _row(
            "fisheye",
            "k0 k2 k3 k4 k5 skew_u skew_v",
            Chart.ANGLE,
            "NVIDIA NCore, FTheta",
            pixel_axes={"skew_u": "u", "skew_v": "v"},
        ),
        "kannala_brandt18": _row(
            "fisheye", "k0 k1 k2 k3 l1 l2 l3 i1 i2 i3 i4 m1 m2 m3 j1 j2 j3 j4", Chart.ANGLE, "Kannala and Brandt 2006"
        ),
        "omnidir": _row("omnidirectional", "k1 k2 s xi p1 p2", Chart.SPHERE, f"OpenCV; {_MEI}", pixel_axes={"s": "u"}),
    }
)
"""The projection models by name: those of the Sensor Fusion Scene format by its names, then others."""

MODEL_ALIASES: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(("plumb_bob", "rational_polynomial", "radtan", "radial_tangential", "opencv"), "brown_conrady")
    | dict.fromkeys(("equidistant", "equi", "opencv_fisheye", "kannala_brandt", "kannala_brandt4"), "fisheye")
    | {"fisheye624": "fisheye_rad_tan_prism"}
)
"""Names that ROS, OpenCV, Kalibr and others have for models of the table, in lower case with `_` between words."""

OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
OPENCV_LENGTHS = (0, 4, 5, 8, 12, 14)
"""The order and the possible numbers of OpenCV's coefficients. Source: "Camera Calibration and 3D Reconstruction"."""

_SHIFT = slice(8, 10)  # lx and ly of `brown_conrady`, which OpenCV does not have


def from_opencv(numbers: Sequence[float]) -> tuple[float, ...]:
    """Put coefficients from OpenCV's order into that of `brown_conrady`, whose centre of distortion can be shifted."""
    shift = (0.0, 0.0) if len(numbers) > _SHIFT.start else ()
    return (*numbers[: _SHIFT.start], *shift, *numbers[_SHIFT.start :])


def to_opencv(camera: "Camera") -> tuple[float, ...] | None:
    """Coefficients in OpenCV's order, as few as it can be told (5, 8, 12 or 14); None where OpenCV has no such model.

    Args:
        camera: of the model `pinhole` or `brown_conrady`.
    """
    numbers = camera.coefficients
    if camera.model not in {"pinhole", "brown_conrady"} or any(numbers[_SHIFT]):
        return None
    ordered = (*numbers[: _SHIFT.start], *numbers[_SHIFT.stop :], *(0.0,) * OPENCV_LENGTHS[-1])
    return ordered[: next(length for length in OPENCV_LENGTHS[2:] if not any(ordered[length:]))]


def to_ros(camera: "Camera", fisheye: str = "equidistant") -> tuple[str, tuple[float, ...]] | None:
    """Name and coefficients of the distortion as sensor_msgs/CameraInfo has them; None where ROS has no such model.

    Args:
        fisheye: what is said for an OpenCV fisheye camera model.
    """
    if camera.model == "fisheye":
        return fisheye, (*camera.coefficients, *(0.0,) * 4)[:4]
    numbers = to_opencv(camera)
    if numbers is None:
        return None
    return "plumb_bob" if len(numbers) == 5 else "rational_polynomial", numbers


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
            raise CalibrationError(f"image size {self.width}x{self.height}; expected positive numbers of pixels")
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
