"""Poses in compiled loops: the exponential and logarithm of rotations, points of a moving sensor into the world.

And the image lines of a rolling shutter.
"""

import math

import numpy as np
from numba import float64, int64, types, void

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.surface_map import INNER

_V, _M = float64[::1], float64[:, ::1]

_SMALL = 1e-5
"""Angles [rad] below which the next term of the series is below rounding."""


@kernel(types.void(_V, _M), **INNER)
def rotation_of_vector(vector: Float64Array, matrix: Float64Array) -> None:
    """Write the rotation matrix of a rotation vector. Source: Rodrigues 1840."""
    x, y, z = vector[0], vector[1], vector[2]
    angle2 = x * x + y * y + z * z
    if angle2 < _SMALL * _SMALL:
        a, b = 1.0 - angle2 / 6.0, 0.5
    else:
        angle = math.sqrt(angle2)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)


@kernel(types.void(_M, _V), **INNER)
def rotation_vector(matrix: Float64Array, vector: Float64Array) -> None:
    """Write the rotation vector of a rotation matrix, its angle at most π."""
    x, y, z = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
    sine2, cosine2 = math.sqrt(x * x + y * y + z * z), matrix[0, 0] + matrix[1, 1] + matrix[2, 2] - 1.0
    angle = math.atan2(sine2, cosine2)
    if cosine2 > -1.999:
        scale = 0.5 if sine2 < _SMALL else angle / sine2
        vector[0], vector[1], vector[2] = scale * x, scale * y, scale * z
        return
    # near half a rotation the axis is the column of R + Rᵀ + (1 - trace) I with the largest diagonal
    best = 0
    for k in range(1, 3):
        if matrix[k, k] > matrix[best, best]:
            best = k
    norm2 = 0.0
    for k in range(3):
        vector[k] = matrix[k, best] + matrix[best, k]
    vector[best] += 1.0 - (matrix[0, 0] + matrix[1, 1] + matrix[2, 2])
    for k in range(3):
        norm2 += vector[k] * vector[k]
    sign = 1.0 if vector[0] * x + vector[1] * y + vector[2] * z >= 0.0 else -1.0
    scale = sign * angle / math.sqrt(norm2)
    for k in range(3):
        vector[k] *= scale


@kernel(types.void(_V, float64, _M), **INNER)
def right_slope(vector: Float64Array, sign: float, matrix: Float64Array) -> None:
    """Write J with Exp(v + δ) ≈ Exp(v) Exp(J δ) for sign 1, and for sign -1 the inverse of it.

    Source: Chirikjian 2012, "Stochastic Models, Information Theory, and Lie Groups 2", section 10.6.
    """
    x, y, z = vector[0], vector[1], vector[2]
    angle2 = x * x + y * y + z * z
    if sign > 0.0:
        if angle2 < _SMALL * _SMALL:
            a, b = -0.5, 1.0 / 6.0
        else:
            angle = math.sqrt(angle2)
            a, b = -(1.0 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    elif angle2 < _SMALL * _SMALL:
        a, b = 0.5, 1.0 / 12.0
    else:
        angle = math.sqrt(angle2)
        a = 0.5
        b = 1.0 / angle2 - 0.5 / (angle * math.tan(0.5 * angle))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)


@kernel(types.void(_M, _M, _M), **INNER)
def times(first: Float64Array, second: Float64Array, product: Float64Array) -> None:
    """Write the product of two (3, 3) matrices into a third."""
    for i in range(3):
        for j in range(3):
            product[i, j] = (
                first[i, 0] * second[0, j] + first[i, 1] * second[1, j] + first[i, 2] * second[2, j]
            )


@kernel(types.void(_M, _M, _M), **INNER)
def transposed_times(first: Float64Array, second: Float64Array, product: Float64Array) -> None:
    """Write the product of the transposed first and the second (3, 3) matrix into a third."""
    for i in range(3):
        for j in range(3):
            product[i, j] = (
                first[0, i] * second[0, j] + first[1, i] * second[1, j] + first[2, i] * second[2, j]
            )


@kernel(types.void(_M, _V, _M), **INNER)
def times_cross(matrix: Float64Array, vector: Float64Array, product: Float64Array) -> None:
    """Write matrix · [vector]×, (3, 3), where [v]× w = v × w."""
    x, y, z = vector[0], vector[1], vector[2]
    for i in range(3):
        a, b, c = matrix[i, 0], matrix[i, 1], matrix[i, 2]
        product[i, 0], product[i, 1], product[i, 2] = b * z - c * y, c * x - a * z, a * y - b * x


_IN_F32_2D = types.Array(types.float32, 2, "C", readonly=True)

_IN_F64_2D = types.Array(types.float64, 2, "C", readonly=True)

_IN_I64_1D = types.Array(types.int64, 1, "C", readonly=True)

_OUT_F64_2D = types.Array(types.float64, 2, "C")


@kernel(
    types.void(_IN_F32_2D, _IN_I64_1D, _IN_F64_2D, _IN_I64_1D, _IN_F64_2D, _IN_F64_2D, _OUT_F64_2D),
    cache=True,
    nogil=True,
)
def transform_by_path(
    positions: Float32Array,
    timestamps_ns: Int64Array,
    body_from_sensor: Float64Array,
    knots_ns: Int64Array,
    knot_positions: Float64Array,
    knot_quaternions_xyzw: Float64Array,
    positions_world: Float64Array,
) -> None:
    """Write `world_from_body(t_i) ∘ body_from_sensor` applied to each point into `positions_world`.

    Args:
        positions: (N, 3) [m], sensor frame.
        timestamps_ns: (N,) [ns]; times outside the knots take the nearest knot's pose.
        body_from_sensor: (3, 4), rotation and translation [m].
        knots_ns: (K,) [ns], strictly increasing, K >= 1.
        knot_positions: (K, 3) [m].
        knot_quaternions_xyzw: (K, 4), unit.
        positions_world: (N, 3), filled here.

    Source: slerp after Shoemake 1985, on the shorter arc; positions linear between the knots.
    """
    segments = knots_ns.shape[0] - 1
    segment = -1
    angle = sine = sign = 0.0
    for i in range(positions.shape[0]):
        t = min(max(timestamps_ns[i], knots_ns[0]), knots_ns[segments])
        if segments > 0 and (segment < 0 or t < knots_ns[segment] or t > knots_ns[segment + 1]):
            segment = min(max(np.searchsorted(knots_ns, t) - 1, 0), segments - 1)
            cosine = 0.0
            for c in range(4):
                cosine += knot_quaternions_xyzw[segment, c] * knot_quaternions_xyzw[segment + 1, c]
            sign = 1.0 if cosine >= 0.0 else -1.0
            angle = math.acos(min(abs(cosine), 1.0))
            sine = math.sin(angle)
        k = max(segment, 0)
        n = min(k + 1, segments)
        fraction = 0.0
        if segments > 0:
            fraction = (t - knots_ns[k]) / (knots_ns[n] - knots_ns[k])
        if sine > 1e-9:
            a = math.sin((1.0 - fraction) * angle) / sine
            b = sign * math.sin(fraction * angle) / sine
        else:
            a, b = 1.0 - fraction, sign * fraction
        qx = a * knot_quaternions_xyzw[k, 0] + b * knot_quaternions_xyzw[n, 0]
        qy = a * knot_quaternions_xyzw[k, 1] + b * knot_quaternions_xyzw[n, 1]
        qz = a * knot_quaternions_xyzw[k, 2] + b * knot_quaternions_xyzw[n, 2]
        qw = a * knot_quaternions_xyzw[k, 3] + b * knot_quaternions_xyzw[n, 3]
        px, py, pz = positions[i, 0], positions[i, 1], positions[i, 2]
        m = body_from_sensor
        x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        # v' = v + 2 w (q x v) + 2 q x (q x v)
        cx, cy, cz = qy * z - qz * y, qz * x - qx * z, qx * y - qy * x
        dx, dy, dz = qy * cz - qz * cy, qz * cx - qx * cz, qx * cy - qy * cx
        kp, np_ = knot_positions[k], knot_positions[n]
        positions_world[i, 0] = x + 2.0 * (qw * cx + dx) + kp[0] + fraction * (np_[0] - kp[0])
        positions_world[i, 1] = y + 2.0 * (qw * cy + dy) + kp[1] + fraction * (np_[1] - kp[1])
        positions_world[i, 2] = z + 2.0 * (qw * cz + dz) + kp[2] + fraction * (np_[2] - kp[2])


_IN_F64_1D = types.Array(float64, 1, "C", readonly=True)

_ROLLING_LINES_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)

_IN_F64_3D = types.Array(float64, 3, "C", readonly=True)

_LEAST_NEARING = 0.05
"""By how much less than a line an image moves from line to line; where that vanishes, steps would be static."""


@kernel(
    int64(
        _ROLLING_LINES_IN_F64_2D,
        _ROLLING_LINES_IN_F64_2D,
        float64,
        float64,
        float64,
        int64[::1],
        float64[:, ::1],
    ),
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
        _ROLLING_LINES_IN_F64_2D,
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
        _ROLLING_LINES_IN_F64_2D, int64, int64, float64, float64, int64[::1], float64[::1], float64[::1], float64[::1],
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
