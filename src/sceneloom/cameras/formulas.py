"""Formulas of camera models: the loops call them by these names.

And the compiler takes those of the camera model at hand.

A camera model is a named tuple of numbers, of a class of its own for every projection model. A model says with
`formula_of` what a name means for its class; the loops of `loops` and the searches of `solving` are written
once and compiled for each.
"""

from collections.abc import Callable, Mapping
from typing import Any

from numba.extending import overload

from sceneloom.cameras.compiled import INLINE

Formula = Callable[..., Any]

_OPTIONS: Any = INLINE


def project_point(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel u, v of a point of the camera frame; u is NaN where the point is out of the domain."""
    raise NotImplementedError


def distance_at(angle: Any, camera_model: Any) -> Any:
    """Give the distance from the image's centre at an angle off the axis, and its slope over the angle."""
    raise NotImplementedError


def distort(a: Any, b: Any, camera_model: Any) -> Any:
    """Take a location of the undistorted chart to the plane: x, y, dx/da, dx/db, dy/da, dy/db."""
    raise NotImplementedError


def pixel_of_plane(x: Any, y: Any, camera_model: Any) -> Any:
    """Give the pixel u, v of a distorted location on the plane; u is NaN where there is none."""
    raise NotImplementedError


def plane_of_pixel(u: Any, v: Any, camera_model: Any) -> Any:
    """Undo `pixel_of_plane`: give the location x, y that a pixel shows."""
    raise NotImplementedError


def ray_of_chart(a: Any, b: Any, camera_model: Any) -> Any:
    """Give the unit ray that a location of the undistorted chart stands for."""
    raise NotImplementedError


def ray_of_pixel(u: Any, v: Any, camera_model: Any) -> Any:
    """Give the unit ray of a pixel, for models that can be solved for it; NaN where there is none."""
    raise NotImplementedError


def centred_pixel(x: Any, y: Any, camera_model: Any) -> Any:
    """Put in the focal lengths and the principal point: `pixel_of_plane` of most models."""
    return camera_model.fx * x + camera_model.cx, camera_model.fy * y + camera_model.cy


def plane_of_centred_pixel(u: Any, v: Any, camera_model: Any) -> Any:
    """Take out the principal point and the focal lengths: `plane_of_pixel` of most models."""
    return (u - camera_model.cx) / camera_model.fx, (v - camera_model.cy) / camera_model.fy


def formula_of(camera_model_class: type, generic: Formula) -> Callable[[Formula], Formula]:
    """Report that the decorated function is what `generic` does for camera models of `camera_model_class`.

    The last argument.
    """

    def register(function: Formula) -> Formula:
        def choose(*types: Any) -> Formula | None:
            return function if getattr(types[-1], "instance_class", None) is camera_model_class else None

        overload(generic, jit_options=_OPTIONS, strict=False)(choose)
        return function

    return register


def use_formulas(camera_model_class: type, formulas: Mapping[Formula, Formula]) -> None:
    """Report for several names at once what they mean for camera models of `camera_model_class`."""
    for generic, function in formulas.items():
        formula_of(camera_model_class, generic)(function)
