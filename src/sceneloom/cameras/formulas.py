"""What all compiled camera models share: signatures, the formulas that a model registers, angles.

Distortion terms and charts of rays.

Every model compiles the same three functions:

- `project_into_image(points_world, camera_from_world, camera model, width, height, kept)` is the hot path. It fills
  `PointsInImage` with the points that fall into the image, in ascending order of their ids, and returns how
  many those are.
- `project_points(points_camera, camera model, pixels)` gives a pixel for every point, NaN outside the model's domain.
- `unproject_pixels(pixels, camera model, rays)` gives a unit ray for every pixel, NaN where the model has none.

`camera_model` is `fx, fy, cx, cy`, all coefficients of the model in its own order, then the domain limit, which is the
radius of a disk of the model's own chart (`charts`), and not always an angle. Models that see behind the plane
z = 0 keep points of depth zero or less. Models with bends that are not radial also compile `fold_radius(camera model)`,
from which their domain limit comes.

The loops (`loops`) and searches (`solving`, `domain`) are written once. They take the camera model as a named tuple,
and the formulas of its model by their names in `formulas`. Numbers and tuples go around in them, never arrays: an array
handed on inside a loop has its references counted for every point, which takes ten times as long as the projection.

And the compiler takes those of the camera model at hand.

A camera model is a named tuple of numbers, of a class of its own for every projection model. A model says with
`formula_of` what a name means for its class; the loops of `loops` and the searches of `solving` are written
once and compiled for each.

The relative errors are some 2e-16: a millionth of a millionth of a pixel.

- perspective: (X, Y)/Z, for rays ahead of the camera;
- by angle: θ (X, Y)/sqrt(X² + Y²), θ the angle off the axis, for all rays but the one straight back;
- by sphere: (X, Y)/(Z + ξ P), P the distance of the point: the unit sphere seen from ξ behind its centre.

The first three functions are what `project_point` means for models of each chart, the next three
`ray_of_chart`; they take the model's own `distort` and `pixel_of_plane`.

Source: Mei and Rives 2007, "Single View Point Omnidirectional Camera Calibration from Planar Grids", eq. 1 and 3,
for the sphere.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from numba import float32, float64, int32, int64, njit, types, void
from numba.extending import overload
from numba.np.unsafe.ndarray import to_fixed_tuple

from sceneloom.cameras.projection import PointsInImage

_named_tuple: Any = types.NamedTuple

_READ_ONLY_ROWS = types.Array(float64, 2, "C", readonly=True)

_READ_ONLY_NUMBERS = types.Array(float64, 1, "C", readonly=True)

IMAGE_SIGNATURE = int64(
    _READ_ONLY_ROWS,
    _READ_ONLY_ROWS,
    _READ_ONLY_NUMBERS,
    int64,
    int64,
    _named_tuple(
        (int64[::1], float32[:, ::1], int32[::1], float32[::1], float32[::1], float32[::1], float32[::1]),
        PointsInImage,
    ),
)

ROWS_SIGNATURE = void(_READ_ONLY_ROWS, _READ_ONLY_NUMBERS, float64[:, ::1])

FOLD_SIGNATURE = float64(_READ_ONLY_NUMBERS)

# Of the fast mathematics only fused multiply-add: the others would let a NaN slip through the tests.
PART: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}

KERNEL: dict[str, Any] = {**PART, "cache": True}

INLINE: dict[str, Any] = {**PART, "forceinline": True}

BLOCK = 512
"""Points that are projected at once, by vector instructions, before those in the image are picked out."""

MINIMUM_DEPTH = 1e-6
"""Perspective models see only what lies at least so far in front of the camera [m]."""

first_numbers: Any = to_fixed_tuple
"""Gives the first numbers of an array as a tuple: `first_numbers(numbers, count)`, the count a constant."""


@njit(**INLINE)
def pose_numbers(m):  # type: ignore[no-untyped-def]
    """Give the twelve numbers of a (3, 4) matrix, row by row."""
    return (
        m[0, 0], m[0, 1], m[0, 2], m[0, 3],
        m[1, 0], m[1, 1], m[1, 2], m[1, 3],
        m[2, 0], m[2, 1], m[2, 2], m[2, 3],
    )  # fmt: skip


@njit(**INLINE)
def camera_coordinates(x, y, z, pose):  # type: ignore[no-untyped-def]
    """Take one world point into the camera frame."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[3],
        pose[4] * x + pose[5] * y + pose[6] * z + pose[7],
        pose[8] * x + pose[9] * y + pose[10] * z + pose[11],
    )


_Formula = Callable[..., Any]

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


def formula_of(camera_model_class: type, generic: _Formula) -> Callable[[_Formula], _Formula]:
    """Report that the decorated function is what `generic` does for camera models of `camera_model_class`.

    The last argument.
    """

    def register(function: _Formula) -> _Formula:
        def choose(*types: Any) -> _Formula | None:
            return function if getattr(types[-1], "instance_class", None) is camera_model_class else None

        overload(generic, jit_options=_OPTIONS, strict=False)(choose)
        return function

    return register


def use_formulas(camera_model_class: type, formulas: Mapping[_Formula, _Formula]) -> None:
    """Report for several names at once what they mean for camera models of `camera_model_class`."""
    for generic, function in formulas.items():
        formula_of(camera_model_class, generic)(function)


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

_C2, _C4, _C6, _C8, _C10, _C12, _C14, _C16, _C18 = (
    (-1.0) ** (n // 2) / math.factorial(n) for n in range(2, 19, 2)
)


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
def stretch(a, b, g, g_s):  # type: ignore[no-untyped-def]
    """Stretch (a, b) by the factor g(s), s = a² + b², whose slope is g_s: location and slopes as of `distort`."""
    mixed = 2.0 * a * b * g_s
    return a * g, b * g, g + 2.0 * a * a * g_s, mixed, mixed, g + 2.0 * b * b * g_s


@njit(**INLINE)
def _decentre(a, b, s, g, g_s, p1, p2):  # type: ignore[no-untyped-def]
    """Stretch (a, b) by g(s) and add the terms of a decentred camera model, for any s: location and partial slopes.

    x = a g + 2 p1 a b + p2 (s + 2 a²),  y = b g + p1 (s + 2 b²) + 2 p2 a b

    Returns:
        x, y; the slopes over a and b with s held: xa, xb, ya, yb; the slopes over s: xs, ys.

    Source: OpenCV documentation, "Camera Calibration and 3D Reconstruction", detailed description.
    """
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


def pixel_in_perspective(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel of a point by its location on the plane z = 1."""
    a, b = x / z, y / z
    to_x, to_y, _, _, _, _ = distort(a, b, camera_model)
    u, v = pixel_of_plane(to_x, to_y, camera_model)
    known = (z > MINIMUM_DEPTH) & (a * a + b * b < camera_model.limit * camera_model.limit)
    return (u if known else math.nan), v


def pixel_by_angle(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel of a point by its direction and its angle off the axis."""
    side = math.sqrt(x * x + y * y)
    angle = angle_off_axis(side, z)
    scale = angle / side if side > 0.0 else 0.0
    to_x, to_y, _, _, _, _ = distort(x * scale, y * scale, camera_model)
    u, v = pixel_of_plane(to_x, to_y, camera_model)
    known = (angle < camera_model.limit) & ((side > 0.0) | (z > 0.0))
    return (u if known else math.nan), v


def pixel_by_sphere(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel of a point by its location on the plane of the shifted sphere.

    With ξ > 1 the farther part of the sphere hides behind the nearer one.
    """
    distance = math.sqrt(x * x + y * y + z * z)
    depth = z + camera_model.xi * distance
    a, b = x / depth, y / depth
    to_x, to_y, _, _, _, _ = distort(a, b, camera_model)
    u, v = pixel_of_plane(to_x, to_y, camera_model)
    ahead = (depth > MINIMUM_DEPTH * distance) & (
        (camera_model.xi <= 1.0) | (distance + camera_model.xi * z > 0.0)
    )
    return (u if ahead & (a * a + b * b < camera_model.limit * camera_model.limit) else math.nan), v


def ray_in_perspective(a: Any, b: Any, _camera_model: Any) -> Any:
    """Give the unit ray through (a, b) on the plane z = 1; NaN where that is too far out for numbers."""
    scale = 1.0 / math.sqrt(a * a + b * b + 1.0)
    scale = scale if scale > 0.0 else math.nan
    return a * scale, b * scale, scale


def ray_by_angle(a: Any, b: Any, _camera_model: Any) -> Any:
    """Give the unit ray that lies as far off the axis as (a, b) from the middle."""
    angle = math.sqrt(a * a + b * b)
    sine, cosine = sine_and_cosine(angle)
    scale = sine / angle if angle > 0.0 else 1.0
    return a * scale, b * scale, cosine


def ray_by_sphere(a: Any, b: Any, camera_model: Any) -> Any:
    """Give the unit ray of a location on the plane of the shifted sphere."""
    square = a * a + b * b
    scale = (camera_model.xi + math.sqrt(1.0 + (1.0 - camera_model.xi * camera_model.xi) * square)) / (
        1.0 + square
    )
    return a * scale, b * scale, scale - camera_model.xi


def sphere_rim(xi: float) -> float:
    """The distance from the axis, on the plane of the shifted sphere, that none of its locations reaches."""
    if xi <= -1.0:
        return 0.0
    return 1.0 / math.sqrt(xi * xi - 1.0) if xi > 1.0 else math.inf


def pixel_off_axis(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel of a point: in its direction from the centre, as far as `distance_at` says.

    Right ahead there is no direction: that point is seen only where the distance vanishes there.
    """
    side = math.sqrt(x * x + y * y)
    angle = angle_off_axis(side, z)
    distance, _ = distance_at(angle, camera_model)
    scale = distance / side if side > 0.0 else 0.0
    u, v = pixel_of_plane(x * scale, y * scale, camera_model)
    ahead = (side == 0.0) & (z > 0.0) & (distance == 0.0)
    known = (angle < camera_model.limit) & (((side > 0.0) & (distance > 0.0)) | ahead)
    return (u if known else math.nan), v
