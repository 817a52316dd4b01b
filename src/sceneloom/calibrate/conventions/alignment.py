"""How clearly the points of each frame lie right in its picture, told for any candidate alike.

What an edge score is worth differs from scene to scene and from view to view, so a candidate is compared with itself,
turned away: right where it is, points meet the edges and the brightness that belong to them more than anywhere around.
A candidate that is altogether wrong meets them by chance, turned or not.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.measures.agreement import MEASURES, Agreement
from sceneloom.calibrate.measures.candidate import Change
from sceneloom.calibrate.measures.features import TILES
from sceneloom.geometry.rigid import RigidTransform

_TURNS = 30
_NEAREST_DEG, _FARTHEST_DEG = 2.5, 7.0
_SEED = 7


def edges_meeting(frames: Sequence[CalibrationFrame]) -> Callable[[Float64Array], Float64Array]:
    """Give the function that scores (4, 4) candidates for `camera_from_points`: (F,), one number for each frame.

    The number is by how many standard deviations the candidate agrees better than when it is turned by 2.5 to 7
    degrees, in the mean over the measures; about 0 for a candidate that is wrong.
    """
    turns = [Change.turn(turn) for turn in _turns()]

    def score(camera_from_points: Float64Array) -> Float64Array:
        candidate, _ = RigidTransform.nearest(camera_from_points)
        agreement = Agreement([replace(frame, camera_from_lidar=candidate) for frame in frames])
        stated = _by_frame(agreement, Change())
        turned = np.stack([_by_frame(agreement, turn) for turn in turns])
        known = np.isfinite(turned).sum(axis=0) > _TURNS // 2
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.nanmean(np.where(known, turned, 0.0), axis=0)
            spread = np.nanstd(np.where(known, turned, 1.0), axis=0)
            scores = np.where(known & (spread > 0), (stated - mean) / spread, np.nan)
        return np.asarray(np.nan_to_num(scores).mean(axis=0))

    return score


def _turns() -> Float64Array:
    """Draw turns in all directions, (K, 3) rotation vectors [rad]."""
    generator = np.random.default_rng(_SEED)
    axes = generator.normal(size=(_TURNS, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    angles = np.radians(np.linspace(_NEAREST_DEG, _FARTHEST_DEG, _TURNS))
    turns: Float64Array = axes * angles[:, None]
    return turns


def _by_frame(agreement: Agreement, change: Change) -> Float64Array:
    """Score a candidate, (M, F): by measure and frame; NaN where nothing was measured."""
    found = agreement.score(change)
    shape = (len(MEASURES), -1, TILES)
    sums, totals = found.sums.reshape(shape).sum(axis=2), found.totals.reshape(shape).sum(axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(totals > 0, sums / totals, np.nan))
