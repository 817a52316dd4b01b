"""Formulas of lenses: the loops call them by these names, and the compiler takes those of the lens at hand.

A lens is a named tuple of numbers, of a class of its own for every projection model. A model says with
`formula_of` what a name means for its class; the loops of `loops` and the searches of `solving` are written
once and compiled for each.
"""

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from sceneloom.cameras.compiled import INLINE

Formula = Callable[..., Any]


def project_point(x: Any, y: Any, z: Any, lens: Any) -> Any:
    """Give the pixel u, v of a point of the camera frame; u is NaN where the point is out of the domain."""
    raise NotImplementedError


def distance_at(angle: Any, lens: Any) -> Any:
    """Give the distance from the picture's centre at an angle off the axis, and its slope over the angle."""
    raise NotImplementedError


def distort(a: Any, b: Any, lens: Any) -> Any:
    """Take a place of the undistorted chart to the plane: x, y, dx/da, dx/db, dy/da, dy/db."""
    raise NotImplementedError


def plane_of_pixel(u: Any, v: Any, lens: Any) -> Any:
    """Undo what comes after the distortion: give the place x, y on the plane that a pixel shows."""
    raise NotImplementedError


def ray_of_chart(a: Any, b: Any, lens: Any) -> Any:
    """Give the unit ray that a place of the undistorted chart stands for."""
    raise NotImplementedError


def ray_of_pixel(u: Any, v: Any, lens: Any) -> Any:
    """Give the unit ray of a pixel, for models that can be solved for it; NaN where there is none."""
    raise NotImplementedError


def formula_of(lens_class: type, generic: Formula) -> Callable[[Formula], Formula]:
    """Say that the decorated function is what `generic` does for lenses of `lens_class`, the last argument."""

    def register(function: Formula) -> Formula:
        def choose(*types: Any) -> Formula | None:
            return function if getattr(types[-1], "instance_class", None) is lens_class else None

        overload(generic, jit_options=INLINE, strict=False)(choose)
        return function

    return register
