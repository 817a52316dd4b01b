"""Poses in compiled loops: the exponential of rotations, points of a moving sensor into the world."""

import math

import numpy as np
from numba import float64, types

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F32_2D, IN_F64_2D, IN_I64_1D

_V, _M = float64[::1], float64[:, ::1]
_SMALL = 1e-5  # angles [rad] below which the next term of the series is below rounding


@kernel(types.void(_V, _M))
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


_OUT_F64_2D = types.Array(types.float64, 2, "C")


@kernel(types.void(IN_F32_2D, IN_I64_1D, IN_F64_2D, IN_I64_1D, IN_F64_2D, IN_F64_2D, _OUT_F64_2D))
def transform_by_path(
    positions: Float32Array, timestamps_ns: Int64Array, body_from_sensor: Float64Array, knots_ns: Int64Array,
    knot_positions: Float64Array, knot_quaternions_xyzw: Float64Array, positions_world: Float64Array,
) -> None:  # fmt: skip
    """Write `world_from_body(t_i) ∘ body_from_sensor` applied to each point into `positions_world`.

    `positions` (N, 3) [m], sensor frame; `timestamps_ns` (N,) [ns]; times outside the knots take the nearest knot's
    pose; `body_from_sensor` (3, 4), rotation and translation [m]; `knots_ns` (K,) [ns], strictly increasing, K >= 1;
    `knot_positions` (K, 3) [m]; `knot_quaternions_xyzw` (K, 4), unit; `positions_world` (N, 3), filled here.

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
