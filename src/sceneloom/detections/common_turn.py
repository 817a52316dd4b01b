"""The turn about which most couples of boxes agree, how sure that is, and what chance makes of such couples.

A couple is x and y, tangents of the angles of what the sweep shows, how far the picture has it from there, and how far
off it may be: five numbers. A turn ω of what the lidar sees moves a ray r by ω × r, in tangents

    Δx = ω₂ (1 + x²) - ω₁ x y - ω₃ y,    Δy = ω₂ x y - ω₁ (1 + y²) + ω₃ x.

Votes find the turn about which most couples agree, coarsely; least squares over those make it exact. Boxes of one
object err alike from picture to picture, so blocks of successive pictures are drawn anew to tell how sure it is.

Source: votes for parameters: Duda and Hart 1972, "Use of the Hough Transformation to Detect Lines and Curves in
Pictures"; motion of the picture under a turn: Longuet-Higgins and Prazdny 1980, eq. 2; bootstrap over blocks: Künsch
1989, "The Jackknife and the Bootstrap for General Stationary Observations".
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array

LARGEST_DEG = 5.0
"""Turns beyond are not looked for [°]."""
LEAST_AGREEING = 20
"""So many couples must agree."""
NO_TURN = np.zeros(3)
_STEP_DEG = 0.5
_ROUNDS = 10
_BLOCKS, _REPLICATES, _REPLICATE_ROUNDS = 20, 100, 5
_CHANCES, _CHANCE_DEG = 48, (3.0, 8.0)
"""So many turns, so far away from the one that was found, tell what chance makes of couples."""
_SEED = 0


def turn_slopes(couples: Float64Array) -> Float64Array:
    """How a turn moves tangents, (C, 2, 3)."""
    x, y = couples[:, 0], couples[:, 1]
    across = np.column_stack([-x * y, 1.0 + x * x, -y])
    down = np.column_stack([-(1.0 + y * y), x * y, x])
    return np.stack([across, down], axis=1)


def agreeing_with(couples: Float64Array, jacobian: Float64Array, turn: Float64Array) -> BoolArray:
    """Which couples, (C,), come together after a turn [rad]."""
    left = couples[:, 2:4] - jacobian @ turn
    found: BoolArray = np.hypot(left[:, 0], left[:, 1]) < couples[:, 4]
    return found


def voted_turn(couples: Float64Array, jacobian: Float64Array) -> Float64Array:
    """The turn of a grid about which most couples agree; of equal ones the smallest."""
    angles = np.radians(np.arange(-LARGEST_DEG, LARGEST_DEG + _STEP_DEG / 2, _STEP_DEG))
    edges = np.append(angles - np.radians(_STEP_DEG) / 2, angles[-1] + np.radians(_STEP_DEG) / 2)
    best, found = -np.inf, NO_TURN
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


def refined_turn(couples: Float64Array, jacobian: Float64Array, turn: Float64Array) -> Float64Array:
    """Least squares over the couples that agree, again and again."""
    for _ in range(_ROUNDS):
        rows = agreeing_with(couples, jacobian, turn)
        if rows.sum() < LEAST_AGREEING:
            return turn
        weights = 1.0 / couples[rows, 4]
        slopes = (jacobian[rows] * weights[:, None, None]).reshape(-1, 3)
        offsets = (couples[rows, 2:4] * weights[:, None]).ravel()
        turn = np.linalg.lstsq(slopes, offsets, rcond=None)[0]
    return turn


def turn_covariance(
    couples: Float64Array, jacobian: Float64Array, turn: Float64Array, pictures: Int64Array
) -> Float64Array:
    """How the turn scatters when blocks of successive pictures are drawn anew, (3, 3) [rad²].

    Args:
        couples: (C, 5).
        jacobian: (C, 2, 3), their slopes.
        turn: (3,) [rad], the one that was found.
        pictures: (C,), of which picture each couple is.
    """
    near = np.hypot(*(couples[:, 2:4] - jacobian @ turn).T) < 3.0 * couples[:, 4]
    _, order = np.unique(pictures, return_inverse=True)
    count = min(int(order.max()) + 1, _BLOCKS)
    block = (order * count // (order.max() + 1))[near]
    generator = np.random.default_rng(_SEED)
    found = []
    for _ in range(_REPLICATES):
        drawn = np.bincount(generator.integers(count, size=count), minlength=count)
        found.append(_weighted_turn(couples[near], jacobian[near], turn, drawn[block].astype(np.float64)))
    return np.atleast_2d(np.cov(np.array(found).T))


def _weighted_turn(
    couples: Float64Array, jacobian: Float64Array, turn: Float64Array, counts: Float64Array
) -> Float64Array:
    """The turn that couples agree about when each counts some times."""
    weights = counts / couples[:, 4] ** 2
    for _ in range(_REPLICATE_ROUNDS):
        chosen = np.where(agreeing_with(couples, jacobian, turn), weights, 0.0)
        weighted = jacobian * chosen[:, None, None]
        normal = np.einsum("cki,ckj->ij", weighted, jacobian)
        turn = np.linalg.lstsq(normal, np.einsum("cki,ck->i", weighted, couples[:, 2:4]), rcond=None)[0]
    return turn


def chance_agreement(couples: Float64Array, jacobian: Float64Array, turn: Float64Array) -> float:
    """The largest number of couples that agree about one of many turns far away from the one that was found."""
    generator = np.random.default_rng(_SEED)
    away = generator.normal(size=(_CHANCES, 3)) * np.array([1.0, 1.0, 0.0])
    away *= (np.radians(generator.uniform(*_CHANCE_DEG, _CHANCES)) / np.linalg.norm(away, axis=1))[:, None]
    return float(max(agreeing_with(couples, jacobian, turn + step).sum() for step in away))
