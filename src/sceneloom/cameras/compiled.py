"""What the compiled functions of all projection models share: signatures, options, parts of their loops.

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
"""

from typing import Any

from numba import float32, float64, int32, int64, njit, types, void
from numba.np.unsafe.ndarray import to_fixed_tuple

from sceneloom.cameras.points_in_image import PointsInImage

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
