"""What the compiled functions of all projection models share: signatures, options, parts of their loops.

Every model compiles the same three functions:

- `project_into_picture(points_world, camera_from_world, lens, width, height, point_ids, pixels, depths)` is
  the hot path. It fills the outputs with the points that fall into the picture, in ascending order of their
  ids, and returns how many those are.
- `project_points(points_camera, lens, pixels)` gives a pixel for every point, NaN outside the model's domain.
- `unproject_pixels(pixels, lens, rays)` gives a unit ray for every pixel, NaN where the model has none.

`lens` is `fx, fy, cx, cy`, all coefficients of the model in its own order, then the domain limit.
"""

from typing import Any

from numba import float32, float64, int64, njit, types, void

_READ_ONLY_ROWS = types.Array(float64, 2, "C", readonly=True)
_READ_ONLY_NUMBERS = types.Array(float64, 1, "C", readonly=True)

PICTURE_SIGNATURE = int64(
    _READ_ONLY_ROWS,
    _READ_ONLY_ROWS,
    _READ_ONLY_NUMBERS,
    int64,
    int64,
    int64[::1],
    float32[:, ::1],
    float32[::1],
)
ROWS_SIGNATURE = void(_READ_ONLY_ROWS, _READ_ONLY_NUMBERS, float64[:, ::1])

# Of the fast mathematics only fused multiply-add: the others would let a NaN slip through the tests.
INLINE: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
KERNEL: dict[str, Any] = {**INLINE, "cache": True}

MINIMUM_DEPTH = 1e-6
"""Perspective models see only what lies at least so far in front of the camera [m]."""


@njit(**INLINE)
def camera_coordinates(points_world, i, camera_from_world):  # type: ignore[no-untyped-def]
    """Take the i-th world point into the camera frame."""
    x, y, z = points_world[i, 0], points_world[i, 1], points_world[i, 2]
    m = camera_from_world
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@njit(**INLINE)
def keep_if_inside(  # type: ignore[no-untyped-def]
    i, u, v, z, width, height, count, point_ids, pixels, depths
):
    """Store a point if it falls into the picture, and return how many are stored now.

    The test is made on the rounded coordinates that are stored, so that whoever rounds them to the nearest
    pixel stays inside the picture.
    """
    column, row = float32(u), float32(v)
    if -0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5:
        point_ids[count] = i
        pixels[count, 0] = column
        pixels[count, 1] = row
        depths[count] = z
        return count + 1
    return count


@njit(**INLINE)
def store_ray(i, x, y, rays):  # type: ignore[no-untyped-def]
    """Store the unit ray through (x, y) on the plane z = 1."""
    scale = 1.0 / (x * x + y * y + 1.0) ** 0.5
    rays[i, 0] = x * scale
    rays[i, 1] = y * scale
    rays[i, 2] = scale
