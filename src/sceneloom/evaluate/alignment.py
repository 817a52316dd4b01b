"""The rigid transform, with or without a scale, that lays an estimate onto the reference."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.evaluate.association import MatchedPoses, Pairs
from sceneloom.geometry.rotations import matrix_from_quaternion, multiply_quaternions, quaternion_from_matrix

_POINT = 1e-12
"""Spread [m²] below which positions are one point, a micrometre wide."""

_LINE = 1e-9
"""Ratio of the second spread to the first (squared lengths) below which positions lie on a line."""

_WEIGHT = 1e-6
"""Of orientations beside positions that leave a rotation open: they decide that rotation, and bend nothing else."""

_THIN, _SMALL = 0.01, 0.1
"""Ratio of the second extent to the first, and extent [m].

Below which a fitted delta_rotation is reported to be doubtful.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """`reference_from_estimate`: p_reference = scale · rotation · p_estimate + translation.

    Attributes:
        rotation: (3, 3) float64.
        translation: (3,) float64 [m].
        scale: of lengths.
        doubts: what the poses leave open, for people.
    """

    rotation: Float64Array
    translation: Float64Array
    scale: float = 1.0
    doubts: tuple[str, ...] = ()

    def apply(self, poses: MatchedPoses) -> MatchedPoses:
        """The poses as the reference would report them."""
        positions = self.scale * poses.positions @ self.rotation.T + self.translation
        if poses.quaternions_xyzw is None:
            return MatchedPoses(positions, None)
        return MatchedPoses(
            positions, multiply_quaternions(quaternion_from_matrix(self.rotation), poses.quaternions_xyzw)
        )


def umeyama(
    source: Float64Array, target: Float64Array, *, with_scale: bool = True
) -> tuple[Float64Array, Float64Array, float]:
    """The similarity that takes (N, D) points onto (N, D) others with the least sum of squares.

    Returns:
        rotation (D, D), translation (D,), scale: target = scale · rotation · source + translation.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns", eq. 40-43.
    """
    covariance = _covariance(source, target)
    rotation = _nearest_rotation(covariance)
    variance = float(((source - source.mean(axis=0)) ** 2).sum(axis=1).mean())
    scale = float(np.trace(rotation.T @ covariance)) / variance if with_scale else 1.0
    return rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0), scale


def _covariance(source: Float64Array, target: Float64Array) -> Float64Array:
    centred: Float64Array = (target - target.mean(axis=0)).T @ (source - source.mean(axis=0)) / len(source)
    return centred


def _nearest_rotation(matrix: Float64Array) -> Float64Array:
    """The rotation R with the largest trace of Rᵀ·matrix. Source: Umeyama 1991, eq. 39 and 43."""
    u, _, vt = np.linalg.svd(matrix)
    signs = np.ones(len(matrix))
    signs[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation: Float64Array = (u * signs) @ vt
    return rotation


def _mean_rotation(pairs: Pairs) -> Float64Array | None:
    """Mean of the matrices that take each orientation of the estimate to the reference's, (3, 3), or None."""
    ours, theirs = pairs.estimate.quaternions_xyzw, pairs.reference.quaternions_xyzw
    if ours is None or theirs is None:
        return None
    return np.asarray(
        np.einsum("nij,nkj->ik", matrix_from_quaternion(theirs), matrix_from_quaternion(ours)) / len(ours)
    )


def _none(pairs: Pairs) -> Alignment:
    del pairs
    return Alignment(np.eye(3), np.zeros(3))


def _origin(pairs: Pairs) -> Alignment:
    """Lay the first pose onto the first pose."""
    first, delta_rotation = pairs.estimate.positions[0], _mean_rotation(_first(pairs, 1))
    if delta_rotation is None:
        raise PoseError(
            "alignment 'origin' lays the first pose onto the first pose and needs orientations on both sides; "
            "state `--align yaw` or `--align se3`"
        )
    rotation = _nearest_rotation(delta_rotation)
    return Alignment(rotation, pairs.reference.positions[0] - rotation @ first)


def _yaw(pairs: Pairs) -> Alignment:
    """Shift, and rotate about the vertical: what cameras with an IMU leave open.

    Source: Zhang and Scaramuzza 2018, "A Tutorial on Quantitative Trajectory Evaluation for Visual(-Inertial)
    Odometry", section IV: the angle whose rotation about z has the largest trace with the covariance.
    """
    covariance = _covariance(pairs.estimate.positions, pairs.reference.positions)
    delta_rotation = _mean_rotation(pairs)
    doubts: tuple[str, ...] = ()
    flat = covariance[:2, :2]
    extent = np.sqrt(_spread(pairs.reference.positions[:, :2]))
    if extent < _SMALL:
        doubts = (_kept_within(float(extent)),)
    if np.hypot(flat[0, 0] + flat[1, 1], flat[1, 0] - flat[0, 1]) <= _POINT:
        flat = np.eye(2) if delta_rotation is None else delta_rotation[:2, :2]
    yaw = float(np.arctan2(flat[1, 0] - flat[0, 1], flat[0, 0] + flat[1, 1]))
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    shift = pairs.reference.positions.mean(axis=0) - rotation @ pairs.estimate.positions.mean(axis=0)
    return Alignment(rotation, shift, doubts=doubts)


def _se3(pairs: Pairs) -> Alignment:
    return _fitted(pairs, with_scale=False)


def _sim3(pairs: Pairs) -> Alignment:
    return _fitted(pairs, with_scale=True)


def _fitted(pairs: Pairs, *, with_scale: bool) -> Alignment:
    source, target = pairs.estimate.positions, pairs.reference.positions
    if with_scale and _spread(source) <= _POINT:
        raise PoseError("the estimate is stationary, so that it has no scale; state `--align se3`")
    covariance, delta_rotation = _covariance(source, target), _mean_rotation(pairs)
    sizes = np.linalg.svd(covariance, compute_uv=False)
    weighed = covariance
    if delta_rotation is not None and sizes[0] <= _POINT:
        weighed = delta_rotation
    elif delta_rotation is not None and sizes[1] <= _LINE * sizes[0]:
        weighed = covariance + _WEIGHT * sizes[0] * delta_rotation
    rotation = _nearest_rotation(weighed)
    scale = float(np.trace(rotation.T @ covariance)) / _spread(source) if with_scale else 1.0
    shift = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    return Alignment(rotation, shift, scale, _doubts(target))


def _doubts(positions: Float64Array) -> tuple[str, ...]:
    """What the shape of the trajectory leaves open."""
    extents = np.sqrt(np.maximum(np.linalg.eigvalsh(np.atleast_2d(np.cov(positions.T, bias=True))), 0.0))
    if extents[2] < _SMALL:
        return (_kept_within(float(extents[2])),)
    if extents[1] < _THIN * extents[2]:
        reported = f"the reference is nearly straight ({extents[2]:.3g} m along, {extents[1]:.2g} m across)"
        return (
            f"{reported}, so that its positions hardly report the rotation about that line; `--align yaw` needs none",
        )
    return ()


def _kept_within(extent: float) -> str:
    return (
        f"the reference keeps within {extent:.2g} m, so that its positions hardly report the rotation; `--align "
        f"origin` "
        "takes it from the first poses"
    )


def _spread(positions: Float64Array) -> float:
    """Mean square distance from the mean [m²]."""
    return float(((positions - positions.mean(axis=0)) ** 2).sum(axis=1).mean())


_FEWEST: Mapping[str, int] = MappingProxyType({"none": 1, "origin": 1, "yaw": 2, "se3": 3, "sim3": 3})
"""How many pairs each kind of alignment needs."""

_ALIGNING: Mapping[str, Callable[[Pairs], Alignment]] = MappingProxyType(
    {"none": _none, "origin": _origin, "yaw": _yaw, "se3": _se3, "sim3": _sim3}
)

ALIGNMENTS = tuple(_ALIGNING)
"""Kinds of alignment, from none to a similarity."""


def align_pairs(pairs: Pairs, kind: str, *, first: int | None = None) -> Alignment:
    """Find the transform of that kind that lays the estimate onto the reference.

    Args:
        kind: one of `ALIGNMENTS`.
        first: find it from so many pairs from the first on; None: from all.

    Raises:
        OptionError: there is no such kind, or the count is not above 0.
        PoseError: the pairs are too few for it, or leave it open.
    """
    if kind not in _ALIGNING:
        raise OptionError(f"alignment {kind!r}; expected one of {', '.join(ALIGNMENTS)}")
    if first is not None and first < 1:
        raise OptionError(f"alignment on the first {first} poses; expected 1 or more")
    used = pairs if first is None else _first(pairs, first)
    count = len(used.timestamps_ns)
    if count < _FEWEST[kind]:
        enough = [name for name, fewest in _FEWEST.items() if fewest <= count]
        raise PoseError(
            f"{count} pairs of poses; alignment {kind!r} needs {_FEWEST[kind]}: state `--align {enough[-1]}`, or pair "
            "more (`--tolerance`, `--align-first`)"
        )
    return _ALIGNING[kind](used)


def _first(pairs: Pairs, count: int) -> Pairs:
    rows = slice(0, count)
    return Pairs(pairs.timestamps_ns[rows], pairs.estimate.at(rows), pairs.reference.at(rows))
