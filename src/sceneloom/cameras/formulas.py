"""Formulas of lenses: the loops call them by these names, and the compiler takes those of the lens at hand.

A lens is a named tuple of numbers, of a class of its own for every projection model. A model says with
`formula_of` what a name means for its class; the loops of `loops` and the searches of `solving` are written
once and compiled for each.
"""

from collections.abc import Callable, Mapping
from typing import Any

from numba.extending import overload

from sceneloom.cameras.compiled import INLINE

Formula = Callable[..., Any]

_OPTIONS: Any = INLINE


def project_point(x: Any, y: Any, z: Any, lens: Any) -> Any:
    """Give the pixel u, v of a point of the camera frame; u is NaN where the point is out of the domain."""
    raise NotImplementedError


def distance_at(angle: Any, lens: Any) -> Any:
    """Give the distance from the picture's centre at an angle off the axis, and its slope over the angle."""
    raise NotImplementedError


def distort(a: Any, b: Any, lens: Any) -> Any:
    """Take a place of the undistorted chart to the plane: x, y, dx/da, dx/db, dy/da, dy/db."""
    raise NotImplementedError


def pixel_of_plane(x: Any, y: Any, lens: Any) -> Any:
    """Give the pixel u, v of a distorted place on the plane; u is NaN where there is none."""
    raise NotImplementedError


def plane_of_pixel(u: Any, v: Any, lens: Any) -> Any:
    """Undo `pixel_of_plane`: give the place x, y that a pixel shows."""
    raise NotImplementedError


def ray_of_chart(a: Any, b: Any, lens: Any) -> Any:
    """Give the unit ray that a place of the undistorted chart stands for."""
    raise NotImplementedError


def ray_of_pixel(u: Any, v: Any, lens: Any) -> Any:
    """Give the unit ray of a pixel, for models that can be solved for it; NaN where there is none."""
    raise NotImplementedError


def centred_pixel(x: Any, y: Any, lens: Any) -> Any:
    """Put in the focal lengths and the principal point: `pixel_of_plane` of most models."""
    return lens.fx * x + lens.cx, lens.fy * y + lens.cy


def plane_of_centred_pixel(u: Any, v: Any, lens: Any) -> Any:
    """Take out the principal point and the focal lengths: `plane_of_pixel` of most models."""
    return (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy


def formula_of(lens_class: type, generic: Formula) -> Callable[[Formula], Formula]:
    """Say that the decorated function is what `generic` does for lenses of `lens_class`, the last argument."""

    def register(function: Formula) -> Formula:
        def choose(*types: Any) -> Formula | None:
            return function if getattr(types[-1], "instance_class", None) is lens_class else None

        overload(generic, jit_options=_OPTIONS, strict=False)(choose)
        return function

    return register


def use_formulas(lens_class: type, formulas: Mapping[Formula, Formula]) -> None:
    """Say for several names at once what they mean for lenses of `lens_class`."""
    for generic, function in formulas.items():
        formula_of(lens_class, generic)(function)
