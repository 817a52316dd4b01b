"""The lines of a rolling shutter that see points: the camera's location at each line, and the search for the line."""

import math

from numba import float64, int64, types, void

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_IN_F64_1D = types.Array(float64, 1, "C", readonly=True)
_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)
_IN_F64_3D = types.Array(float64, 3, "C", readonly=True)

_LEAST_NEARING = 0.05
"""By how much less than a line an image moves from line to line; where that vanishes, steps would be static."""


@kernel(
    int64(_IN_F64_2D, _IN_F64_2D, float64, float64, float64, int64[::1], float64[:, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def keep_in_reach(
    points_world: Float64Array,
    camera_from_world: Float64Array,
    domain: float,
    rotation_of_vector: float,
    trajectory: float,
    point_ids: Int64Array,
    points_camera: Float64Array,
) -> int:
    """Keep the points that a camera model may see at some time while the camera moves.

    Args:
        points_world: (N, 3) [m].
        camera_from_world: (3, 4) or (4, 4), at the middle of that time.
        domain: angle off the axis that the camera model sees [rad], π at most.
        rotate, trajectory: how far at most the camera rotates [rad] and moves [m] from the middle.
        point_ids: (N,), written from the beginning on, ascending.
        points_camera: (N, 3) [m], in the frame of the camera in the middle; written likewise.

    Returns:
        How many they are.
    """
    m = camera_from_world
    count = 0
    for i in range(points_world.shape[0]):
        a, b, c = points_world[i, 0], points_world[i, 1], points_world[i, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        distance = math.sqrt(x * x + y * y + z * z)
        if not distance < math.inf:
            continue
        shift = math.asin(trajectory / distance) if trajectory < distance else math.pi
        angle = domain + rotation_of_vector + shift
        if angle >= math.pi or z >= distance * math.cos(angle):
            point_ids[count] = i
            points_camera[count, 0], points_camera[count, 1], points_camera[count, 2] = x, y, z
            count += 1
    return count


@kernel(
    void(
        _IN_F64_2D,
        types.Array(int64, 1, "C", readonly=True),
        _IN_F64_1D,
        _IN_F64_3D,
        float64,
        float64[:, ::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def position_at_lines(
    points_camera: Float64Array,
    active: Int64Array,
    lines: Float64Array,
    lines_from_middle: Float64Array,
    line_count: float,
    placed: Float64Array,
) -> None:
    """Give points in the frame of the camera at the time of a line, each at its own.

    Args:
        points_camera: (M, 3) [m], in the frame of the camera at the image's time.
        active: (A,), which of them.
        lines: (M,) [px], -0.5 to line_count - 0.5.
        lines_from_middle: (K, 3, 4), the camera at K times evenly spread from the image's first edge to its last,
            from the camera at the image's time; linear between them.
        line_count: lines of the image.
        placed: (A, 3) [m], written.
    """
    last = lines_from_middle.shape[0] - 1
    per_line = last / line_count
    for k in range(active.shape[0]):
        i = active[k]
        at = (lines[i] + 0.5) * per_line
        knot = min(max(int(at), 0), last - 1)
        later = at - knot
        sooner = 1.0 - later
        x, y, z = points_camera[i, 0], points_camera[i, 1], points_camera[i, 2]
        first, second = lines_from_middle[knot], lines_from_middle[knot + 1]
        for row in range(3):
            placed[k, row] = (
                (sooner * first[row, 0] + later * second[row, 0]) * x
                + (sooner * first[row, 1] + later * second[row, 1]) * y
                + (sooner * first[row, 2] + later * second[row, 2]) * z
                + (sooner * first[row, 3] + later * second[row, 3])
            )


@kernel(
    int64(
        _IN_F64_2D, int64, int64, float64, float64, int64[::1], float64[::1], float64[::1], float64[::1],
        int64[::1]
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def search_lines(
    pixels: Float64Array,
    axis: int,
    attempt: int,
    line_count: float,
    tolerance: float,
    active: Int64Array,
    lines: Float64Array,
    lines_before: Float64Array,
    off_before: Float64Array,
    settled: Int64Array,
) -> int:
    """Compare the lines for which points were placed with those in which they then lie, and choose the next.

    A point is off by f(s) = v(s) - s, where v(s) is where it lies at the time of line s. Settled is one whose f is
    nearly 0. The next line is v itself at first, and then where the secant through the last two ends.

    Args:
        pixels: (A, 2) [px], of the active points at the times of their lines; NaN for none.
        axis: 0 if lines are columns, 1 if they are rows.
        attempt: 0 for the first, one more each time.
        line_count: lines of the image.
        tolerance: how far off a settled line may be [px].
        active: (A,), which points are looked at; those that remain are moved to its beginning.
        lines, lines_before, off_before: (M,) [px]; the lines of the active points are replaced.
        settled: (A,), the locations among the active ones of those that have settled, then -1.

    Returns:
        How many remain.
    """
    low, high = -0.5, line_count - 0.5
    remaining = count = 0
    for k in range(active.shape[0]):
        i = active[k]
        line, there = lines[i], pixels[k, axis]
        off = there - line
        if abs(off) <= tolerance:
            settled[count] = k
            count += 1
            continue
        if math.isnan(pixels[k, 0] + there):
            # It may come into the camera model's domain by the first line, or the last.
            if attempt > 1 or lines_before[i] == lines_before[i]:
                continue
            lines[i] = low if attempt == 0 else high
        else:
            nearing = 1.0
            if lines_before[i] == lines_before[i] and line != lines_before[i]:
                nearing = (off_before[i] - off) / (line - lines_before[i])
            outward = (line <= low and off < 0.0) or (line >= high and off > 0.0)
            beyond_both = off * off_before[i] > 0.0 and abs(line - lines_before[i]) >= line_count
            if outward and (nearing > 0.0 or beyond_both):
                continue
            step = off / math.copysign(max(abs(nearing), _LEAST_NEARING), nearing)
            lines_before[i], off_before[i] = line, off
            lines[i] = min(max(line + step, low), high)
        active[remaining] = i
        remaining += 1
    for k in range(count, settled.shape[0]):
        settled[k] = -1
    return remaining
