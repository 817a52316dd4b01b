"""The turn of a camera about which planes go from picture to picture where they are found.

All pairs together, from blurred to sharp: pieces are followed; the turn and shift of `camera_from_lidar` and a small
turn of each pair's own motion are fitted to where they were found, by least squares with Cauchy weights; and again. The
shift and the motions are held near what is stated: they are no results.

Source: sandwich by clusters: Liang and Zeger 1986.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.frames import moved_by
from sceneloom.calibrate.planes.followed import Found, PlanePair

_ROUNDS = (0, 0, 1, 1, 2, 2)
"""Levels, one after the other."""
_TURN, _SHIFT, _MOTION = np.radians(3.0), 0.02, np.radians(0.3)
"""How far off numbers are taken to be before anything was seen: deviations [rad, m, rad]."""
_OWN, _SHARED = 3, 6


class PlaneTurn(NamedTuple):
    """What planes tell.

    Attributes:
        turn: (3,) [rad], that has to be added to `camera_from_lidar`, about the camera's axes.
        covariance: (3, 3) [rad²].
        pieces: how many were found again at last.
    """

    turn: Float64Array
    covariance: Float64Array
    pieces: int


def turn_of_planes(pairs: Sequence[PlanePair], camera_from_lidar: Float64Array) -> PlaneTurn:
    """Find the turn.

    Args:
        pairs: of pictures; at least one.
        camera_from_lidar: (4, 4), as stated.
    """
    size = _SHARED + _OWN * len(pairs)
    held = 1.0 / np.array([_TURN] * 3 + [_SHIFT] * 3 + [_MOTION] * (size - _SHARED)) ** 2
    numbers, candidate = np.zeros(size), camera_from_lidar
    for level in _ROUNDS:
        found = [
            pair.follow(candidate, own, level)
            for pair, own in zip(pairs, numbers[_SHARED:].reshape(-1, _OWN), strict=True)
        ]
        normal, pulls = _normal_equations(found, size)
        normal += np.diag(held)
        step = np.linalg.solve(normal, pulls.sum(axis=0) - held * numbers)
        numbers += step
        candidate = moved_by(step[:_SHARED]) @ candidate
    inverse = np.linalg.inv(normal)
    count = len(pairs)
    scatter = pulls.T @ pulls * (count / max(count - 1, 1)) + np.diag(held)
    covariance = inverse @ scatter @ inverse
    return PlaneTurn(numbers[:3], covariance[:3, :3], sum(len(piece.offsets) for piece in found))


def _normal_equations(found: Sequence[Found], size: int) -> tuple[Float64Array, Float64Array]:
    """The matrix (S, S), and what each pair pulls at, (P, S)."""
    normal, pulls = np.zeros((size, size)), np.zeros((len(found), size))
    for k, (offsets, certainties, slopes) in enumerate(found):
        if len(offsets) == 0:
            continue
        distances = np.einsum("ni,nij,nj->n", offsets, certainties, offsets)
        usual = max(float(np.median(distances)), 2.0)
        weighted = certainties * (1.0 / (1.0 + distances / (4.0 * usual)) / usual)[:, None, None]
        own = slice(_SHARED + _OWN * k, _SHARED + _OWN * (k + 1))
        places = np.r_[0:_SHARED, own]
        normal[np.ix_(places, places)] += np.einsum(
            "nki,nkl,nlj->ij", slopes, weighted, slopes, optimize=True
        )
        pulls[k, places] = np.einsum("nki,nkl,nl->i", slopes, weighted, offsets, optimize=True)
    return normal, pulls
