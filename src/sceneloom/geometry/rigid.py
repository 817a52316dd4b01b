"""Rotations as quaternions and matrices, rigid transforms, and poses between the poses of a path.

A rigid transform takes points of one frame into another: a rotation and a translation.
"""

from dataclasses import dataclass
from math import inf, isfinite, radians
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float64Array, FloatArray, Int64Array, UInt8Array, hold_arrays
from sceneloom.errors import ArrayError, CalibrationError

SILENT_ERROR, GREATEST_ERROR = 1e-3, 1e-2
"""Errors of a rotation read from a file, max abs of R·Rᵀ - I: up to the first normalised in silence (the examples of
the specifications are 2e-4 off), up to the second with a warning, beyond it refused."""

_CONJUGATION = np.array([-1.0, -1.0, -1.0, 1.0])


def normalise_quaternion(quaternion_xyzw: ArrayLike) -> Float64Array:
    """Scale (..., 4) quaternions to length 1; NaN stays NaN.

    Raises:
        ArrayError: the last axis is not 4 long, or a quaternion is zero, which is no rotation.
    """
    quaternion = np.asarray(quaternion_xyzw, np.float64)
    if quaternion.shape[-1:] != (4,):
        raise ArrayError(f"quaternion_xyzw: {quaternion.shape}; expected (..., 4)")
    # Scaling by the largest element first keeps the squares of tiny and huge numbers within float64.
    largest = np.abs(quaternion).max(axis=-1, keepdims=True)
    if (largest == 0).any():
        raise ArrayError("quaternion_xyzw: 0, 0, 0, 0; expected a rotation")
    scaled = quaternion / largest
    unit: Float64Array = scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    return unit


def matrix_from_quaternion(quaternion_xyzw: ArrayLike) -> Float64Array:
    """Give the (..., 3, 3) rotation matrices of (..., 4) quaternions, which are normalised first.

    Raises:
        ArrayError: a quaternion is zero.
    """
    x, y, z, w = np.moveaxis(normalise_quaternion(quaternion_xyzw), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(matrix: ArrayLike) -> Float64Array:
    """Give the (..., 4) unit quaternions, scalar last, w >= 0, of (..., 3, 3) rotation matrices.

    The sums below are the rows of 4 q qᵀ; the row with the largest diagonal is the one that loses no digits.

    Source: Shepperd 1978, "Quaternion from Rotation Matrix".
    """
    m = np.asarray(matrix, np.float64)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    xw, yw, zw = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    products = (
        (1 + m00 - m11 - m22, xy, xz, xw),
        (xy, 1 - m00 + m11 - m22, yz, yw),
        (xz, yz, 1 - m00 - m11 + m22, zw),
        (xw, yw, zw, 1 + m00 + m11 + m22),
    )
    outer = np.stack([np.stack(row, axis=-1) for row in products], axis=-2)
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    return _with_positive_w(normalise_quaternion(np.take_along_axis(outer, best[..., None, None], -2)[..., 0, :]))


def _with_positive_w(quaternion_xyzw: Float64Array) -> Float64Array:
    return np.where(quaternion_xyzw[..., 3:] < 0, -quaternion_xyzw, quaternion_xyzw)


def multiply_quaternions(a: ArrayLike, b: ArrayLike) -> Float64Array:
    """Give the product of (..., 4) quaternions: rotate by b, then by a, like a product of matrices."""
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    u, s = first[..., :3], first[..., 3:]
    v, t = second[..., :3], second[..., 3:]
    vector = s * v + t * u + np.cross(u, v)
    scalar = s * t - (u * v).sum(axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def conjugate_quaternion(quaternion_xyzw: ArrayLike) -> Float64Array:
    """Give the opposite rotations of (..., 4) unit quaternions."""
    conjugate: Float64Array = np.asarray(quaternion_xyzw, np.float64) * _CONJUGATION
    return conjugate


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def rotate_vectors(quaternion_xyzw: ArrayLike, vectors: ArrayLike) -> Float64Array:
    """Rotate (..., 3) vectors by (..., 4) quaternions, which broadcast and are normalised first.

    Raises:
        ArrayError: a quaternion is zero.
    """
    quaternion = normalise_quaternion(quaternion_xyzw)
    axis, scalar = quaternion[..., :3], quaternion[..., 3:]
    points = np.asarray(vectors, np.float64)
    twice = 2.0 * np.cross(axis, points)
    rotated: Float64Array = points + scalar * twice + np.cross(axis, twice)
    return rotated


def angle_between(a: ArrayLike, b: ArrayLike) -> Float64Array:
    """Give the angle [0, π] of the rotations that take a to b, for (..., 4) unit quaternions.

    Source: Kahan 2006, "How Futile are Mindless Assessments of Roundoff", section 12: exact for tiny angles,
    where the arc cosine of the dot product is not.
    """
    return 2.0 * _arc(*_on_one_side(np.asarray(a, np.float64), np.asarray(b, np.float64)))


def _on_one_side(a: Float64Array, b: Float64Array) -> tuple[Float64Array, Float64Array]:
    return a, np.where((a * b).sum(axis=-1, keepdims=True) < 0, -b, b)


def _arc(a: Float64Array, b: Float64Array) -> Float64Array:
    apart, together = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    arc: Float64Array = 2.0 * np.arctan2(apart, together)
    return arc


def slerp(a: ArrayLike, b: ArrayLike, fraction: ArrayLike) -> Float64Array:
    """Rotate from a (fraction 0) towards b (fraction 1) at constant speed along the shorter arc.

    Args:
        a: (..., 4) quaternions, normalised here.
        b: (..., 4) quaternions, normalised here.
        fraction: (...) float; below 0 and above 1 the rotating goes on.

    Raises:
        ArrayError: a quaternion is zero.

    Source: Shoemake 1985, "Animating Rotation with Quaternion Curves"; the sines are written as
    sin(x) = x sinc(x), which has no division by zero where a = b.
    """
    start, stop = _on_one_side(normalise_quaternion(a), normalise_quaternion(b))
    along = np.asarray(fraction, np.float64)[..., None]
    half_rotations = _arc(start, stop)[..., None] / np.pi
    whole = np.sinc(half_rotations)
    weight_start = (1.0 - along) * np.sinc((1.0 - along) * half_rotations) / whole
    weight_stop = along * np.sinc(along * half_rotations) / whole
    return normalise_quaternion(weight_start * start + weight_stop * stop)


def nearest_rotation(matrix: ArrayLike) -> tuple[Float64Array, float]:
    """Give the proper rotation closest to a (3, 3) matrix, and how far the matrix is from being one.

    Returns:
        rotation: (3, 3), orthonormal, determinant +1.
        error: max abs of M Mᵀ - I; infinite where the determinant of M is not positive.

    Raises:
        CalibrationError: the matrix is not (3, 3) or holds a value that is not finite.

    Source: Horn, Hilden and Negahdaripour 1988: of all rotations U Vᵀ is nearest in the Frobenius norm.
    """
    m = np.asarray(matrix, np.float64)
    if m.shape != (3, 3) or not np.isfinite(m).all():
        raise CalibrationError(f"rotation {m.tolist()}; expected 3x3 finite numbers")
    u, _, vt = np.linalg.svd(m)
    handedness = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers beyond 1e154, whose error is infinite
        error = float(np.abs(m @ m.T - np.eye(3)).max()) if np.linalg.det(m) > 0 else np.inf
    return (u * handedness) @ vt, np.inf if np.isnan(error) else error


def rotation_vector_from_quaternion(quaternion_xyzw: ArrayLike) -> Float64Array:
    """Give (..., 3) rotation vectors: along the axis, as long as the angle, which is at most π.

    Raises:
        ArrayError: a quaternion is zero.
    """
    quaternion = _with_positive_w(normalise_quaternion(quaternion_xyzw))
    axis, scalar = quaternion[..., :3], quaternion[..., 3:]
    half = np.arctan2(np.linalg.norm(axis, axis=-1, keepdims=True), scalar)
    vector: Float64Array = 2.0 * axis / np.sinc(half / np.pi)
    return vector


def quaternion_from_rotation_vector(rotation_vector: ArrayLike) -> Float64Array:
    """Give the (..., 4) unit quaternions, w >= 0, of (..., 3) rotation vectors."""
    vector = np.asarray(rotation_vector, np.float64)
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2.0
    quaternion = np.concatenate([0.5 * np.sinc(half / np.pi) * vector, np.cos(half)], axis=-1)
    return _with_positive_w(normalise_quaternion(quaternion))


def matrix_from_rotation_vector(rotation_vector: ArrayLike) -> Float64Array:
    """Give the (..., 3, 3) rotations about (..., 3) vectors by their length [rad]."""
    return matrix_from_quaternion(quaternion_from_rotation_vector(rotation_vector))


def rotation_vector_from_matrix(matrix: ArrayLike) -> Float64Array:
    """Give the (..., 3) rotation vectors [rad] of (..., 3, 3) rotations, at most π long."""
    return rotation_vector_from_quaternion(quaternion_from_matrix(matrix))


def cross_matrix(vectors: ArrayLike) -> Float64Array:
    """Give the (..., 3, 3) matrices that take a vector w to v × w, for (..., 3) vectors v."""
    x, y, z = np.moveaxis(np.asarray(vectors, np.float64), -1, 0)
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


_LAST_ROW_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class RigidTransform:
    """`a_from_b`: takes points of frame b into frame a, p_a = R p_b + t.

    Attributes:
        rotation: (3, 3) float64, orthonormal, determinant +1.
        translation: (3,) float64 [m].

    Raises:
        CalibrationError: the rotation is off by more than 1e-6.
    """

    rotation: Float64Array
    translation: Float64Array

    def __post_init__(self) -> None:
        hold_arrays(self, "", {"rotation": (np.float64, 3, 3), "translation": (np.float64, 3)}, frozen=True)
        error, determinant = _measure(self.rotation)
        if not (error < 1e-6 and determinant > 0 and all(map(isfinite, self.translation.tolist()))):
            raise CalibrationError(
                f"rotation off by {error:.2g}, translation {self.translation.tolist()}; "
                "expected an orthonormal right-handed matrix and finite numbers"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        return RigidTransform, (self.rotation, self.translation)

    @classmethod
    def identity(cls) -> Self:
        """The transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quaternion(cls, position: FloatArray, quaternion_xyzw: FloatArray) -> Self:
        """Build from a (3,) position [m] and a (4,) scalar-last quaternion, normalised here."""
        return cls(matrix_from_quaternion(quaternion_xyzw), np.asarray(position, np.float64))

    @classmethod
    def nearest(cls, matrix: FloatArray) -> tuple[Self, float]:
        """Build from a (4, 4) or (3, 4) matrix of a file, whose rotation may be rounded.

        Returns:
            The transform with the closest proper rotation, and how far the given one is from it: max abs of
            R Rᵀ - I, infinite for a mirrored one. The caller judges that number.

        Raises:
            CalibrationError: shape, a value that is not finite, or a last row that is not 0 0 0 1.
        """
        m = np.asarray(matrix, np.float64)
        if m.shape not in {(4, 4), (3, 4)} or not np.isfinite(m).all():
            raise CalibrationError(f"matrix {m.tolist()}; expected 4x4 or 3x4 finite numbers")
        if m.shape == (4, 4) and np.abs(m[3] - (0.0, 0.0, 0.0, 1.0)).max() > _LAST_ROW_TOLERANCE:
            raise CalibrationError(f"matrix with the last row {m[3].tolist()}; expected 0 0 0 1")
        rotation, error = nearest_rotation(m[:3, :3])
        return cls(rotation, m[:3, 3].copy()), error

    @property
    def quaternion_xyzw(self) -> Float64Array:
        """The rotation as a unit quaternion, scalar last, w >= 0."""
        return quaternion_from_matrix(self.rotation)

    @property
    def matrix(self) -> Float64Array:
        """The (4, 4) homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    @property
    def inverse_matrix(self) -> Float64Array:
        """The (4, 4) homogeneous matrix of the inverse, which need not be checked anew."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation.T, -self.rotation.T @ self.translation
        return matrix

    def __matmul__(self, other: "RigidTransform") -> "RigidTransform":
        """`a_from_b @ b_from_c` is `a_from_c`."""
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> "RigidTransform":
        """`b_from_a`."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    def carried(self, positions: Float64Array, quaternions_xyzw: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Give the poses, (N, 3) [m] and (N, 4), of what is mounted so on a body that has the given ones."""
        moved = rotate_vectors(quaternions_xyzw, self.translation) + positions
        return moved, multiply_quaternions(quaternions_xyzw, self.quaternion_xyzw)

    @np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
    def apply(self, points: FloatArray) -> Float64Array:
        """Take (..., 3) points [m] of frame b into frame a."""
        moved: Float64Array = np.asarray(points, np.float64) @ self.rotation.T
        # In location: of many points another array would cost twice as long as the sum.
        moved += self.translation
        return moved

    @np.errstate(invalid="ignore", over="ignore")
    def rotate(self, vectors: FloatArray) -> Float64Array:
        """Take (..., 3) directions or velocities of frame b into frame a, which moves nothing."""
        rotated: Float64Array = np.asarray(vectors, np.float64) @ self.rotation.T
        return rotated


def _measure(rotation: Float64Array) -> tuple[float, float]:
    """Max abs of R Rᵀ - I, infinite if something is not finite, and the determinant."""
    # by plain numbers: transforms are made for each image and sweep, and NumPy takes several times as long for nine
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    off = (
        *(a * a + b * b + c * c - 1.0, d * d + e * e + f * f - 1.0, g * g + h * h + i * i - 1.0),
        *(a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i),
    )
    error = max(map(abs, off)) if all(map(isfinite, off)) else inf
    return error, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


_EARLIEST_NS, _LATEST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max
_LEVELS_AT_WORST_POSE = 32
_INSIDE, EXTRAPOLATED, OUT_OF_REACH = 0, 1, 2
"""Values of `coverage`."""


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def interpolate_poses(
    timestamps_ns: Int64Array,
    positions: Float64Array,
    quaternions_xyzw: Float64Array,
    query_ns: Int64Array,
    *,
    reach_ns: int = 0,
    mount: RigidTransform | None = None,
) -> tuple[Float64Array, Float64Array, UInt8Array]:
    """Give the pose at each time: position linear, rotation slerp between the neighbouring poses.

    Beyond either end the velocity and the rotating of the end segment go on; a path of one pose is stationary.

    Args:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 1.
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, normalised here.
        query_ns: (M,) int64 [ns].
        reach_ns: how far beyond either end poses are given.
        mount: gives the poses of what is mounted so on the body.

    Returns:
        positions: (M, 3) float64 [m]; NaN where out of reach.
        quaternions_xyzw: (M, 4) float64, unit; NaN where out of reach.
        coverage: (M,) uint8: 0 inside the path, 1 extrapolated, 2 out of reach.

    Raises:
        ArrayError: the path has no pose.
    """
    count = len(timestamps_ns)
    if count == 0:
        raise ArrayError("timestamps_ns: no pose to interpolate; expected at least one")
    times, coverage = _within_reach(timestamps_ns, np.asarray(query_ns, np.int64), reach_ns)
    before = np.clip(np.searchsorted(timestamps_ns, times, side="right") - 1, 0, max(count - 2, 0))
    after = np.minimum(before + 1, count - 1)
    # differences of int64 are taken as uint64, which holds each of them
    spans = np.maximum((timestamps_ns[after] - timestamps_ns[before]).view(np.uint64), 1)
    late = times >= timestamps_ns[before]
    since = np.where(late, times - timestamps_ns[before], timestamps_ns[before] - times).view(np.uint64)
    fraction = np.where(late, 1.0, -1.0) * since / spans
    fraction[before == after] = 0.0
    start, stop = positions[before], positions[after]
    locations = start + fraction[:, None] * (stop - start)
    rotations = slerp(quaternions_xyzw[before], quaternions_xyzw[after], fraction)
    locations[coverage == OUT_OF_REACH], rotations[coverage == OUT_OF_REACH] = np.nan, np.nan
    if mount is not None:
        locations, rotations = mount.carried(locations, rotations)
    return locations, rotations, coverage


def _within_reach(timestamps_ns: Int64Array, query_ns: Int64Array, reach_ns: int) -> tuple[Int64Array, UInt8Array]:
    """Cut the times to the path and its reach, so that their differences stay within int64."""
    first, last = int(timestamps_ns[0]), int(timestamps_ns[-1])
    times = np.clip(query_ns, max(first - reach_ns, _EARLIEST_NS), min(last + reach_ns, _LATEST_NS))
    coverage = np.full(len(query_ns), _INSIDE, np.uint8)
    coverage[(query_ns < first) | (query_ns > last)] = EXTRAPOLATED
    coverage[query_ns != times] = OUT_OF_REACH
    return times, coverage


@np.errstate(invalid="ignore", over="ignore")
def thin_poses(
    timestamps_ns: Int64Array,
    positions: Float64Array,
    quaternions_xyzw: Float64Array,
    required_ns: Int64Array,
    *,
    position_tolerance: float = 1e-3,
    rotation_tolerance: float = radians(0.01),
) -> Int64Array:
    """Find the poses of a dense path that a thinner path needs besides those at the required times.

    The thinner path has a pose, interpolated from the dense one, at every required time, and the poses
    returned here. Between the first and the last required time it stays within the tolerances of the dense
    path. Segments are split at their worst pose until they fit; all segments of one level at once, so long
    paths need no deep recursion.

    Args:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 1.
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64.
        required_ns: (K,) int64 [ns], in any order; where empty, the ends of the dense path are required.
        position_tolerance: largest distance between the two paths [m].
        rotation_tolerance: largest angle between them.

    Returns:
        (E,) int64, ascending indices into the dense path, none of them at a required time.

    Raises:
        ArrayError: the path has no pose.

    Source: Douglas and Peucker 1973, with the distance taken at equal times; it is largest at a pose of the
    dense path, since both paths move linearly between those.
    """
    unit = normalise_quaternion(quaternions_xyzw)
    required = np.unique(required_ns if len(required_ns) else timestamps_ns[[0, -1]])
    kept = np.zeros(len(timestamps_ns), np.bool_)
    open_poses = np.flatnonzero(
        (timestamps_ns > required[0]) & (timestamps_ns < required[-1]) & ~np.isin(timestamps_ns, required)
    )
    level = 0
    while len(open_poses):
        knots_ns = np.union1d(required, timestamps_ns[kept])
        locations, rotations, _ = interpolate_poses(timestamps_ns, positions, unit, knots_ns, reach_ns=_LATEST_NS)
        times = timestamps_ns[open_poses]
        near, rotated, _ = interpolate_poses(knots_ns, locations, rotations, times)
        misfits = np.maximum(
            np.linalg.norm(near - positions[open_poses], axis=1) / position_tolerance,
            angle_between(rotated, unit[open_poses]) / rotation_tolerance,
        )
        misfits[np.isnan(misfits)] = np.inf  # poses that are no numbers are kept
        chosen, undecided = _split(np.searchsorted(knots_ns, times), misfits, at_worst=level < _LEVELS_AT_WORST_POSE)
        kept[open_poses[chosen]] = True
        open_poses = open_poses[undecided]
        level += 1
    return np.flatnonzero(kept)


def _split(segments: Int64Array, misfits: Float64Array, *, at_worst: bool) -> tuple[Int64Array, BoolArray]:
    """Choose one pose of every segment that does not fit, and report which poses have to be judged again."""
    # at the worst pose few are needed, but maybe as many levels as there are poses; in the middle these are bounded
    starts = np.flatnonzero(np.diff(segments, prepend=segments[0] - 1))
    lengths = np.diff(starts, append=len(segments))
    worst = np.maximum.reduceat(misfits, starts)
    wrong = ~(worst <= 1.0)
    if at_worst:
        hits = np.flatnonzero(misfits == np.repeat(worst, lengths))
        middle = hits[np.searchsorted(hits, starts)]
    else:
        middle = starts + lengths // 2
    undecided = np.repeat(wrong, lengths)
    undecided[middle] = False
    return middle[wrong], undecided
