"""The motion between two sweeps where nothing is known about it yet."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import small_gicp

from sceneloom.arrays import Float64Array

_SPACING = 0.5
_NEIGHBOURS = 15
_REACHES = (5.0, 1.5)
"""Points farther apart than this [m] do not belong together: first roughly, then closely."""
SPEEDS = (0.0, 10.0, 20.0, 30.0, -5.0)
"""Speeds along the ego's x axis [m/s] to begin from where nothing is known: matching alone finds a few metres."""


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """A motion that may be the right one.

    Attributes:
        rotation, translation: (3, 3) and (3,) [m], `earlier_from_later`.
        misfit: mean squared distance of the points that found a partner, larger where fewer did.
    """

    rotation: Float64Array
    translation: Float64Array
    misfit: float


def guess_motion(
    earlier: Float64Array, later: Float64Array, seconds: float, *, speeds: Sequence[float]
) -> list[Guess]:
    """Match two sweeps, (N, 3) and (M, 3) [m] in the ego frame, from several speeds; the best guess comes first.

    One thread, so that equal sweeps give equal guesses.

    Source: Segal, Haehnel and Thrun 2009, "Generalized-ICP"; Koide 2024, "small_gicp".
    """
    target, tree = small_gicp.preprocess_points(earlier, _SPACING, _NEIGHBOURS, 1)
    source, _ = small_gicp.preprocess_points(later, _SPACING, _NEIGHBOURS, 1)
    guesses = []
    for speed in speeds:
        pose = np.eye(4)
        pose[0, 3] = speed * seconds
        for reach in _REACHES:
            result = small_gicp.align(
                target,
                source,
                tree,
                pose,
                registration_type="GICP",
                max_correspondence_distance=reach,
                num_threads=1,
            )
            pose = np.asarray(result.T_target_source)
        share = result.num_inliers / max(source.size(), 1)
        if share > 0:
            misfit = float(result.error) / max(result.num_inliers, 1) / share**2
            guesses.append(Guess(pose[:3, :3].copy(), pose[:3, 3].copy(), misfit))
    return sorted(guesses, key=lambda guess: guess.misfit)
