"""How clearly points lie right in pictures, told for any candidate alike.

What an edge score is worth differs from scene to scene and from view to view, so a candidate is compared with itself,
turned away: right where it is, points meet the edges and the brightness that belong to them more than anywhere around.
A candidate that is altogether wrong meets them by chance, turned or not.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.measures.agreement import Agreement
from sceneloom.calibrate.measures.candidate import Change
from sceneloom.calibrate.measures.pictures import measured_picture
from sceneloom.geometry.rigid import RigidTransform

_TURNS = 24
_NEAREST_DEG, _FARTHEST_DEG = 2.5, 7.0
_SEED = 7
_DECIMALS = 6


def edges_meeting(frames: Sequence[CalibrationFrame]) -> Callable[[Float64Array], float]:
    """Give the function that scores (4, 4) candidates for `camera_from_points`.

    The number is by how many standard deviations all frames together agree better with the candidate than with the
    same one turned by 2.5 to 7 degrees, in the mean over the measures; about 0 for a candidate that is wrong. Frames
    of one view agree or disagree alike, so that many of them do not count as much evidence.
    """
    turns = [Change.turn(turn) for turn in _turns()]
    pictures = [measured_picture(frame.grey, frame.camera) for frame in frames]
    known: dict[bytes, float] = {}

    def score(camera_from_points: Float64Array) -> float:
        key = np.round(camera_from_points, _DECIMALS).tobytes()
        if key not in known:
            known[key] = judged(camera_from_points)
        return known[key]

    def judged(camera_from_points: Float64Array) -> float:
        candidate, _ = RigidTransform.nearest(camera_from_points)
        agreement = Agreement(
            [replace(frame, camera_from_lidar=candidate) for frame in frames], pictures=pictures
        )
        stated = agreement.score(Change()).values()
        turned = np.stack([agreement.score(turn).values() for turn in turns])
        clear = [
            (stated[row] - np.nanmean(turned[:, row])) / np.nanstd(turned[:, row])
            for row in range(len(stated))
            if np.isfinite(stated[row]) and np.isfinite(turned[:, row]).sum() > _TURNS // 2
        ]
        return float(np.mean([value for value in clear if np.isfinite(value)] or [0.0]))

    return score


def _turns() -> Float64Array:
    """Draw turns in all directions, (K, 3) rotation vectors [rad]."""
    generator = np.random.default_rng(_SEED)
    axes = generator.normal(size=(_TURNS, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    angles = np.radians(np.linspace(_NEAREST_DEG, _FARTHEST_DEG, _TURNS))
    turns: Float64Array = axes * angles[:, None]
    return turns
