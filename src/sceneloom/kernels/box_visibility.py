"""Which rays meet which boxes, and whether another box stands before them."""

from typing import Any

import numba
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_PART: dict[str, Any] = {"nogil": True, "error_model": "numpy", "inline": "always"}
_BEHIND = 1e-9
"""Of two boxes that begin at the same location, to this share of the distance, neither hides the other."""


@numba.njit(**_PART)
def _centre(k, b, centers, lines, drifts):  # type: ignore[no-untyped-def]
    """Where a box is from where ray k begins, while the line of the ray was taken."""
    x, y, z = centers[b, 0], centers[b, 1], centers[b, 2]
    if len(lines):
        x += lines[k, 3] * drifts[b, 0] - lines[k, 0]
        y += lines[k, 3] * drifts[b, 1] - lines[k, 1]
        z += lines[k, 3] * drifts[b, 2] - lines[k, 2]
    return x, y, z


@numba.njit(**_PART)
def _crossing(x, y, z, centre, b, rotations, halves):  # type: ignore[no-untyped-def]
    """Where a ray from the origin enters and leaves a box, in lengths of the ray; the first is larger if it misses."""
    near, far = -np.inf, np.inf
    for axis in range(3):
        along = rotations[b, 0, axis] * x + rotations[b, 1, axis] * y + rotations[b, 2, axis] * z
        middle = (
            rotations[b, 0, axis] * centre[0]
            + rotations[b, 1, axis] * centre[1]
            + rotations[b, 2, axis] * centre[2]
        )
        if along == 0.0:
            if abs(middle) > halves[b, axis]:
                return 1.0, 0.0
            continue
        first, last = (middle - halves[b, axis]) / along, (middle + halves[b, axis]) / along
        near, far = max(near, min(first, last)), min(far, max(first, last))
    return near, far


@numba.njit(**_PART)
def _entry(x, y, z, centre, b, rotations, halves):  # type: ignore[no-untyped-def]
    """Where a ray from the origin enters a box, in lengths of the ray; infinity where it misses it or starts in it."""
    near, far = _crossing(x, y, z, centre, b, rotations, halves)
    if near <= far and near > 0.0:
        return near
    return np.inf


@kernel(
    "void(float64[:,::1], int64[::1], float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], "
    "float64[:,::1], int64[::1], int64[::1], int64[::1], int64[::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def count_observations(
    rays: Float64Array,
    ray_starts: Int64Array,
    centers: Float64Array,
    rotations: Float64Array,
    halves: Float64Array,
    lines: Float64Array,
    drifts: Float64Array,
    rival_starts: Int64Array,
    rivals: Int64Array,
    met: Int64Array,
    hidden: Int64Array,
) -> None:
    """Count the rays that meet each box, and those of them that meet another one before.

    Args:
        rays: (R, 3) from the origin, or from where `lines` says; one with a NaN meets nothing.
        ray_starts: (B + 1,), which rays belong to each box.
        centers: (B, 3) [m].
        rotations: (B, 3, 3), whose columns are the boxes' axes.
        halves: (B, 3) [m], half of length, width and height.
        lines: (R, 4), of a rolling shutter, where each ray begins [m], and at which share of the time in which the
            image was taken, -0.5 to 0.5; (0, 4) where it was taken at once.
        drifts: (B, 3) [m], how far the boxes go in that time; of no account without `lines`.
        rival_starts: (B + 1,), which of `rivals` belong to each box.
        rivals: numbers of the boxes that may stand before it.
        met: (B,), filled.
        hidden: (B,), filled.

    Source: Kay and Kajiya 1986, "Ray Tracing Complex Scenes": a ray is in a box while it is between all pairs of faces.
    """
    for b in range(len(centers)):
        met[b] = hidden[b] = 0
        for k in range(ray_starts[b], ray_starts[b + 1]):
            x, y, z = rays[k, 0], rays[k, 1], rays[k, 2]
            own = _entry(x, y, z, _centre(k, b, centers, lines, drifts), b, rotations, halves)
            if not own < np.inf:
                continue
            met[b] += 1
            for r in range(rival_starts[b], rival_starts[b + 1]):
                rival = rivals[r]
                centre = _centre(k, rival, centers, lines, drifts)
                if _entry(x, y, z, centre, rival, rotations, halves) < own * (1.0 - _BEHIND):
                    hidden[b] += 1
                    break


@kernel(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1], "
    "float64[:,::1], float64[:,::1], float64, int64[:,::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def count_evidence(
    points: Float64Array,
    pixels: Float64Array,
    extents: Float64Array,
    centers: Float64Array,
    rotations: Float64Array,
    halves: Float64Array,
    lines: Float64Array,
    drifts: Float64Array,
    margin: float,
    evidence: Int64Array,
) -> None:
    """Count the points that lie before each box, as the camera sees them, and those that lie on or in it.

    Args:
        points: (N, 3) [m], from where the camera saw them: the origin, or where `lines` says.
        pixels: (N, 2) [px], where they are in the image; NaN for those that are not.
        extents: (B, 4) [px], left, top, right, bottom of each box in the image.
        centers, rotations, halves, lines, drifts: as in `count_observations`, a ray being that to a point.
        margin: how far outside its faces a point still counts as on a box [m].
        evidence: (B, 2), filled: points before it, points on it.
    """
    evidence[:] = 0
    for i in range(len(points)):
        u, v = pixels[i, 0], pixels[i, 1]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        slack = margin / np.sqrt(x * x + y * y + z * z)
        for b in range(len(centers)):
            if extents[b, 0] <= u <= extents[b, 2] and extents[b, 1] <= v <= extents[b, 3]:
                centre = _centre(i, b, centers, lines, drifts)
                near, far = _crossing(x, y, z, centre, b, rotations, halves)
                if near <= far and far > 0.0:
                    if near - slack > 1.0:
                        evidence[b, 0] += 1
                    elif far + slack >= 1.0:
                        evidence[b, 1] += 1
