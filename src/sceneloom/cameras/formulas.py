"""The formulas that camera models share, and the names by which the loops of `compiled` ask for a model's own.

The numbers of a camera are a named tuple, of a class of its own for every model (`numbers_of`): `fx, fy, cx, cy`, all
coefficients in the model's order, then the limit of its domain, the radius of a disk in the model's `Chart`. A function
that raises `NotImplementedError` here is a name: `formula_of` registers what it means for a class, and the compiler
takes the formula of the class at hand. Numbers and tuples are handed on, never arrays: an array that is handed on
inside a loop has its references counted for every point, which takes ten times as long as the projection.

Three charts take a direction to a plane, and back to a ray:

- perspective: (X, Y)/Z, for rays ahead of the camera;
- by angle: θ (X, Y)/sqrt(X² + Y²), θ the angle off the axis, for all rays but the one straight back;
- by sphere: (X, Y)/(Z + ξ P), P the distance of the point: the unit sphere seen from ξ behind its centre.

Own arctangent, sine and cosine, since those of the C library cannot be vectorised; their relative errors are some
2e-16: a millionth of a millionth of a pixel.

Source: Mei and Rives 2007, "Single View Point Omnidirectional Camera Calibration from Planar Grids", eq. 1 and 3,
for the sphere.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from numba import njit
from numba.extending import overload

from sceneloom.cameras.camera import MODELS
from sceneloom.kernels.cache import OPTIONS, PART_OPTIONS

# Of the fast mathematics only fused multiply-add: the others would let a NaN slip through the tests.
FORMULA: dict[str, Any] = {**OPTIONS, "fastmath": {"contract"}}
PART: dict[str, Any] = {**FORMULA, **PART_OPTIONS}
INLINE: dict[str, Any] = {**PART, "forceinline": True}
MINIMUM_DEPTH = 1e-6
"""Perspective models see only what lies at least so far in front of the camera [m]."""

Formula = Callable[..., Any]
_OPTIONS: Any = INLINE


def numbers_of(model: str, module: str, *, computed: str = "") -> Any:
    """Make the class of the numbers of a model's cameras, called as the model is in camel case.

    Args:
        model: a name out of `MODELS`.
        module: the `__name__` of the module that keeps the class, by which kept kernels find it again.
        computed: names of what `prepared` adds; the class is then called `...Prepared`.
    """
    name = model.title().replace("_", "") + ("Prepared" if computed else "")
    fields = ("fx", "fy", "cx", "cy", *MODELS[model].coefficient_names, "limit", *computed.split())
    numbers: Any = NamedTuple(name, [(field, float) for field in fields])  # type: ignore[misc]
    numbers.__module__ = module
    return numbers


def prepared(given: Any, c: Any) -> Any:
    """Give what the other formulas take: the numbers, or those with what is computed once; `given` is a plain tuple."""
    raise NotImplementedError


def project_point(x: Any, y: Any, z: Any, c: Any) -> Any:
    """Give the pixel u, v of a point of the camera frame; u is NaN where the point is out of the domain."""
    raise NotImplementedError


def distance_at(angle: Any, c: Any) -> Any:
    """Give the distance from the image's centre at an angle off the axis, and its slope over the angle."""
    raise NotImplementedError


def distort(a: Any, b: Any, c: Any) -> Any:
    """Take a location of the undistorted chart to the plane: x, y, dx/da, dx/db, dy/da, dy/db."""
    raise NotImplementedError


def pixel_of_plane(x: Any, y: Any, c: Any) -> Any:
    """Give the pixel u, v of a distorted location on the plane; u is NaN where there is none."""
    raise NotImplementedError


def plane_of_pixel(u: Any, v: Any, c: Any) -> Any:
    """Undo `pixel_of_plane`: give the location x, y that a pixel shows."""
    raise NotImplementedError


def ray_of_chart(a: Any, b: Any, c: Any) -> Any:
    """Give the unit ray that a location of the undistorted chart stands for."""
    raise NotImplementedError


def ray_of_pixel(u: Any, v: Any, c: Any) -> Any:
    """Give the unit ray of a pixel, for models that can be solved for it; NaN where there is none."""
    raise NotImplementedError


def rays_of_pixels(pixels: Any, rays: Any, c: Any) -> Any:
    """Write a unit ray for every pixel, NaN where there is none: a loop of `compiled`."""
    raise NotImplementedError


def formula_of(numbers: type, name: Formula) -> Callable[[Formula], Formula]:
    """Register the decorated function as what a name means for cameras with numbers of this class."""

    def register(function: Formula) -> Formula:
        def choose(*types: Any) -> Formula | None:
            return function if getattr(types[-1], "instance_class", None) is numbers else None

        overload(name, jit_options=_OPTIONS, strict=False)(choose)
        return function

    return register


def use_formulas(numbers: type, formulas: Mapping[Formula, Formula]) -> None:
    """Register several formulas, by name, for cameras with numbers of this class."""
    for name, function in formulas.items():
        formula_of(numbers, name)(function)


def as_given(_given: Any, c: Any) -> Any:
    """Compute nothing beforehand: `prepared` of most models."""
    return c


def centred_pixel(x: Any, y: Any, c: Any) -> Any:
    """Put in the focal lengths and the principal point: `pixel_of_plane` of most models."""
    return c.fx * x + c.cx, c.fy * y + c.cy


def plane_of_centred_pixel(u: Any, v: Any, c: Any) -> Any:
    """Take out the principal point and the focal lengths: `plane_of_pixel` of most models."""
    return (u - c.cx) / c.fx, (v - c.cy) / c.fy


CENTRED: dict[Formula, Formula] = {
    prepared: as_given,
    pixel_of_plane: centred_pixel,
    plane_of_pixel: plane_of_centred_pixel,
}
"""What most models share."""


_EIGHTH = math.tan(math.pi / 8)
_QUARTER, _HALF = 0.25 * math.pi, 0.5 * math.pi

# Of (atan(t)/t - 1)/t² in powers of t², interpolated at the Chebyshev nodes of 0 <= t <= tan(pi/8).
_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8, _A9, _A10 = (
    -0.3333333333333333,
    0.19999999999995516,
    -0.14285714284665682,
    0.11111111015187018,
    -0.0909090457530649,
    0.07692183125376892,
    -0.06664510525508936,
    0.05858140904866328,
    -0.050854078345894844,
    0.03923044778479309,
    -0.019175404711104932,
)

# Taylor's: beyond these terms less than 1e-17 is left up to pi/4.
_S3, _S5, _S7, _S9, _S11, _S13, _S15, _S17 = ((-1.0) ** (n // 2) / math.factorial(n) for n in range(3, 18, 2))
_C2, _C4, _C6, _C8, _C10, _C12, _C14, _C16, _C18 = ((-1.0) ** (n // 2) / math.factorial(n) for n in range(2, 19, 2))


@njit(**INLINE)
def _arctangent(small, large):  # type: ignore[no-untyped-def]
    """The angle whose tangent is small/large, for 0 <= small <= large."""
    wide = small > _EIGHTH * large
    above, below = (small - large if wide else small), (small + large if wide else large)
    t = above / (below if below > 0.0 else 1.0)
    q = t * t
    bend = _A6 + q * (_A7 + q * (_A8 + q * (_A9 + q * _A10)))
    bend = _A0 + q * (_A1 + q * (_A2 + q * (_A3 + q * (_A4 + q * (_A5 + q * bend)))))
    return t + t * (q * bend) + (_QUARTER if wide else 0.0)


@njit(**INLINE)
def angle_off_axis(side, z):  # type: ignore[no-untyped-def]
    """Give the angle, 0 to pi, between the axis and a point that lies `side` >= 0 beside it and z along it."""
    ahead = abs(z)
    steep = side > ahead
    angle = _arctangent(ahead if steep else side, side if steep else ahead)
    angle = _HALF - angle if steep else angle
    return math.pi - angle if z < 0.0 else angle


@njit(**INLINE)
def sine_and_cosine(angle):  # type: ignore[no-untyped-def]
    """Give sine and cosine of an angle between -pi and pi."""
    quarters = math.floor(angle / _HALF + 0.5)
    rest = angle - quarters * _HALF
    q = rest * rest
    sine = _S3 + q * (_S5 + q * (_S7 + q * (_S9 + q * (_S11 + q * (_S13 + q * (_S15 + q * _S17))))))
    sine = rest + rest * (q * sine)
    cosine = _C10 + q * (_C12 + q * (_C14 + q * (_C16 + q * _C18)))
    cosine = 1.0 + q * (_C2 + q * (_C4 + q * (_C6 + q * (_C8 + q * cosine))))
    rotated, opposite = abs(quarters) == 1.0, abs(quarters) == 2.0
    side, ahead = (cosine if rotated else sine), (sine if rotated else cosine)
    if quarters == 1.0:
        ahead = -ahead
    if quarters == -1.0:
        side = -side
    return (-side if opposite else side), (-ahead if opposite else ahead)


@njit(**INLINE)
def odd_polynomial(s, k1, k2, k3, k4):  # type: ignore[no-untyped-def]
    """Give p(t)/t and p'(t) of p(t) = t + k1 t³ + k2 t⁵ + k3 t⁷ + k4 t⁹, with s = t²."""
    return (
        1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))),
        1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4))),
    )


@njit(**INLINE)
def stretch(a, b, g, g_s):  # type: ignore[no-untyped-def]
    """Stretch (a, b) by the factor g(s), s = a² + b², whose slope is g_s: location and slopes as of `distort`."""
    mixed = 2.0 * a * b * g_s
    return a * g, b * g, g + 2.0 * a * a * g_s, mixed, mixed, g + 2.0 * b * b * g_s


@njit(**INLINE)
def _decentre(a, b, s, g, g_s, p1, p2):  # type: ignore[no-untyped-def]
    """Stretch (a, b) by g(s), decentred, for any s: x, y; slopes xa, xb, ya, yb with s held; slopes xs, ys over s."""
    # x = a g + 2 p1 a b + p2 (s + 2 a²),  y = b g + p1 (s + 2 b²) + 2 p2 a b: OpenCV documentation, "Camera Calibration
    # and 3D Reconstruction", detailed description
    mixed = 2.0 * a * b
    return (
        a * g + p1 * mixed + p2 * (s + 2.0 * a * a),
        b * g + p1 * (s + 2.0 * b * b) + p2 * mixed,
        g + 2.0 * p1 * b + 4.0 * p2 * a,
        2.0 * p1 * a,
        2.0 * p2 * b,
        g + 4.0 * p1 * b + 2.0 * p2 * a,
        a * g_s + p2,
        b * g_s + p1,
    )


@njit(**INLINE)
def shift_and_decentre(x, y, g, g_s, lx, ly, p1, p2):  # type: ignore[no-untyped-def]
    """Decentre (x + lx, y + ly) with s = x² + y² of the location before the shift.

    Location and slopes as of `distort`.
    """
    to_x, to_y, xa, xb, ya, yb, xs, ys = _decentre(x + lx, y + ly, x * x + y * y, g, g_s, p1, p2)
    return to_x, to_y, xa + 2.0 * x * xs, xb + 2.0 * y * xs, ya + 2.0 * x * ys, yb + 2.0 * y * ys


@njit(**INLINE)
def bend_image(stretched, p1, p2, s1, s2, s3, s4):  # type: ignore[no-untyped-def]
    """Add decentring and prism terms to a location that is already stretched: location and slopes as of `distort`.

    Args:
        stretched: what `stretch` gave.
        p1, p2: OpenCV's decentring.
        s1, s2, s3, s4: x gains s1 r² + s2 r⁴, y gains s3 r² + s4 r⁴, r the distance of the stretched location.
    """
    x, y, xx, xy, yx, yy = stretched
    s = x * x + y * y
    to_x, to_y, xa, xb, ya, yb, xs, ys = _decentre(x, y, s, 1.0, 0.0, p1, p2)
    xs, ys = xs + s1 + 2.0 * s2 * s, ys + s3 + 2.0 * s4 * s
    xa, xb, ya, yb = xa + 2.0 * x * xs, xb + 2.0 * y * xs, ya + 2.0 * x * ys, yb + 2.0 * y * ys
    return (
        to_x + s * (s1 + s * s2),
        to_y + s * (s3 + s * s4),
        xa * xx + xb * yx,
        xa * xy + xb * yy,
        ya * xx + yb * yx,
        ya * xy + yb * yy,
    )


def ray_in_perspective(a: Any, b: Any, _c: Any) -> Any:
    """Give the unit ray through (a, b) on the plane z = 1; NaN where that is too far out for numbers."""
    scale = 1.0 / math.sqrt(a * a + b * b + 1.0)
    scale = scale if scale > 0.0 else math.nan
    return a * scale, b * scale, scale
