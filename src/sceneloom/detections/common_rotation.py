"""The rotation about which most couples of boxes agree, how sure that is, and what chance makes of such couples.

A couple is x and y, tangents of the angles of what the sweep shows, how far the image has it from there, and how far
off it may be: five numbers. A rotation ω of what the lidar sees moves a ray r by ω × r, in tangents

    Δx = ω₂ (1 + x²) - ω₁ x y - ω₃ y,    Δy = ω₂ x y - ω₁ (1 + y²) + ω₃ x.

Votes find the rotation about which most couples agree, coarsely; least squares over those make it exact. Boxes of one
object err alike from image to image, so blocks of successive images are drawn anew to report how sure it is.

Source: votes for parameters: Duda and Hart 1972, "Use of the Hough Transformation to Detect Lines and Curves in
Images"; motion of the image under a rotation: Longuet-Higgins and Prazdny 1980, eq. 2; bootstrap over blocks: Künsch
1989, "The Jackknife and the Bootstrap for General Stationary Observations".
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array

LARGEST_DEG = 5.0
"""Rotates beyond are not looked for [°]."""
LEAST_AGREEING = 20
"""So many couples must agree."""
NO_ROTATION = np.zeros(3)
_STEP_DEG = 0.5
_ROUNDS = 10
_BLOCKS, _REPLICATES, _REPLICATE_ROUNDS = 20, 100, 5
_CHANCES, _CHANCE_DEG = 48, (3.0, 8.0)
"""So many rotates, so far away from the one that was found, report what chance makes of couples."""
_SEED = 0


def rotation_slopes(couples: Float64Array) -> Float64Array:
    """How a rotation moves tangents, (C, 2, 3)."""
    x, y = couples[:, 0], couples[:, 1]
    across = np.column_stack([-x * y, 1.0 + x * x, -y])
    down = np.column_stack([-(1.0 + y * y), x * y, x])
    return np.stack([across, down], axis=1)


def agreeing_with(couples: Float64Array, jacobian: Float64Array, rotation: Float64Array) -> BoolArray:
    """Which couples, (C,), come together after a rotation [rad]."""
    left = couples[:, 2:4] - jacobian @ rotation
    found: BoolArray = np.hypot(left[:, 0], left[:, 1]) < couples[:, 4]
    return found


def voted_rotation(couples: Float64Array, jacobian: Float64Array) -> Float64Array:
    """The rotation of a grid about which most couples agree; of equal ones the smallest."""
    angles = np.radians(np.arange(-LARGEST_DEG, LARGEST_DEG + _STEP_DEG / 2, _STEP_DEG))
    edges = np.append(angles - np.radians(_STEP_DEG) / 2, angles[-1] + np.radians(_STEP_DEG) / 2)
    best, found = -np.inf, NO_ROTATION
    for roll in angles.tolist():
        left = couples[:, 2:4] - jacobian[:, :, 2] * roll
        votes = np.histogram2d(left[:, 0], -left[:, 1], bins=(edges, edges))[0]
        spread = votes.copy()
        spread[1:] += votes[:-1]
        spread[:-1] += votes[1:]
        spread[:, 1:], spread[:, :-1] = spread[:, 1:] + votes[:, :-1], spread[:, :-1] + votes[:, 1:]
        yaw, pitch = np.unravel_index(int(spread.argmax()), spread.shape)
        worth = float(spread[yaw, pitch]) - 1e-3 * abs(roll)
        if worth > best:
            best, found = worth, np.array([angles[pitch], angles[yaw], roll])
    return found


def refined_rotation(couples: Float64Array, jacobian: Float64Array, rotation: Float64Array) -> Float64Array:
    """Least squares over the couples that agree, again and again."""
    for _ in range(_ROUNDS):
        rows = agreeing_with(couples, jacobian, rotation)
        if rows.sum() < LEAST_AGREEING:
            return rotation
        weights = 1.0 / couples[rows, 4]
        slopes = (jacobian[rows] * weights[:, None, None]).reshape(-1, 3)
        offsets = (couples[rows, 2:4] * weights[:, None]).ravel()
        rotation = np.linalg.lstsq(slopes, offsets, rcond=None)[0]
    return rotation


def rotation_covariance(
    couples: Float64Array, jacobian: Float64Array, rotation: Float64Array, images: Int64Array
) -> Float64Array:
    """How the rotation scatters when blocks of successive images are drawn anew, (3, 3) [rad²].

    Args:
        couples: (C, 5).
        jacobian: (C, 2, 3), their slopes.
        rotation: (3,) [rad], the one that was found.
        images: (C,), of which image each couple is.
    """
    near = np.hypot(*(couples[:, 2:4] - jacobian @ rotation).T) < 3.0 * couples[:, 4]
    _, order = np.unique(images, return_inverse=True)
    count = min(int(order.max()) + 1, _BLOCKS)
    block = (order * count // (order.max() + 1))[near]
    generator = np.random.default_rng(_SEED)
    found = []
    for _ in range(_REPLICATES):
        drawn = np.bincount(generator.integers(count, size=count), minlength=count)
        found.append(
            _weighted_rotation(couples[near], jacobian[near], rotation, drawn[block].astype(np.float64))
        )
    return np.atleast_2d(np.cov(np.array(found).T))


def _weighted_rotation(
    couples: Float64Array, jacobian: Float64Array, rotation: Float64Array, counts: Float64Array
) -> Float64Array:
    """The rotation that couples agree about when each counts some times."""
    weights = counts / couples[:, 4] ** 2
    for _ in range(_REPLICATE_ROUNDS):
        chosen = np.where(agreeing_with(couples, jacobian, rotation), weights, 0.0)
        weighted = jacobian * chosen[:, None, None]
        normal = np.einsum("cki,ckj->ij", weighted, jacobian)
        rotation = np.linalg.lstsq(normal, np.einsum("cki,ck->i", weighted, couples[:, 2:4]), rcond=None)[0]
    return rotation


def chance_agreement(couples: Float64Array, jacobian: Float64Array, rotation: Float64Array) -> float:
    """The largest number of couples that agree about one of many rotates far away from the one that was found."""
    generator = np.random.default_rng(_SEED)
    away = generator.normal(size=(_CHANCES, 3)) * np.array([1.0, 1.0, 0.0])
    away *= (np.radians(generator.uniform(*_CHANCE_DEG, _CHANCES)) / np.linalg.norm(away, axis=1))[:, None]
    return float(max(agreeing_with(couples, jacobian, rotation + step).sum() for step in away))
