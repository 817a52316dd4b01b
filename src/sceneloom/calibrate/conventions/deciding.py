"""Which of the ways to read an extrinsic is the right one, if the drive can tell."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.conventions.evidence import find_up, is_near, is_upright, sees_enough, share_seen
from sceneloom.calibrate.conventions.hypotheses import CHOICES, Hypothesis, groups, hypotheses
from sceneloom.calibrate.conventions.reading import Extrinsic
from sceneloom.calibrate.frames import CalibrationFrame

Score = Callable[[Float64Array], float]
"""How clearly points lie right in the pictures under a (4, 4) `camera_from_points`, in standard deviations."""

_Z_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What an extrinsic means, as far as that can be told.

    Attributes:
        place: where the extrinsic stands in its file.
        choices: each of `CHOICES` that it leaves open, and what it is; None where several are possible.
        possible: the same with all values that are possible.
        camera_from_points: (4, 4) float64, None where several transforms are possible.
        reason: why it was decided so, or why it could not be.
        by_drive: whether points and pictures had a say.
    """

    place: str
    choices: Mapping[str, str | None]
    possible: Mapping[str, tuple[str, ...]]
    camera_from_points: Float64Array | None
    reason: str
    by_drive: bool

    @property
    def decided(self) -> bool:
        """Whether the transform is known, however it may be called."""
        return self.camera_from_points is not None


def decide(
    extrinsic: Extrinsic, frames: Sequence[CalibrationFrame] = (), score: Score | None = None
) -> Decision:
    """Tell what an extrinsic means.

    Ways to read it that no vehicle has are left out first: a camera far from the lidar, or not upright, or one that
    sees nothing of what the lidar sees. Of the rest those stay that `score` does not tell from the best.

    Args:
        extrinsic: the numbers.
        frames: of the drive whose camera and lidar it relates; none where there is no drive.
        score: of these frames; None to go by what is left out alone.
    """
    found = groups(hypotheses(extrinsic.numbers, extrinsic.known, apart=extrinsic.apart))
    up = find_up(frames) if frames else _Z_UP
    left = [group for group in found if is_near(group[0].camera_from_points)]
    if up is not None:
        left = [group for group in left if is_upright(group[0].camera_from_points, up)]
    if frames:
        left = [group for group in left if sees_enough(share_seen(group[0].camera_from_points, frames))]
    if not left:
        return _told(
            extrinsic,
            [],
            "no way to read it puts an upright camera where it sees what the lidar sees",
            frames,
        )
    if score is not None and len(left) > 1:
        left, why = _best(left, score)
        return _told(extrinsic, left, why, frames)
    return _told(extrinsic, left, _COUNTED[len(left) == 1], frames)


_COUNTED = {
    True: "all other ways put the camera on its side, upside down, too far away, or where it sees nothing",
    False: "several ways put an upright camera near the lidar, and nothing tells them apart",
}


def _best(left: list[list[Hypothesis]], score: Score) -> tuple[list[list[Hypothesis]], str]:
    """Keep the one that is clearly right, or all that come near to the best."""
    scores = [score(group[0].camera_from_points) for group in left]
    best = max(scores)
    if best < _CLEAR:
        return left, f"none of {len(left)} ways that are possible matches points and pictures clearly"
    kept = [group for group, own in zip(left, scores, strict=True) if own > best - _LEAD]
    if len(kept) == 1:
        return (
            kept,
            f"of {len(left)} ways that are possible it alone matches points and pictures ({best:.1f} sigma)",
        )
    return kept, f"{len(kept)} of {len(left)} ways that are possible match points and pictures about equally"


_CLEAR = 2.0
"""Standard deviations, in the mean over the measures, that chance does not reach in some dozens of trials."""

_LEAD = 1.2
"""So many more than any other way, as the scores of wrong ones scatter."""


def _told(
    extrinsic: Extrinsic, left: list[list[Hypothesis]], reason: str, frames: Sequence[CalibrationFrame]
) -> Decision:
    ways = [hypothesis for group in left for hypothesis in group]
    possible = {
        name: tuple(dict.fromkeys(way.choices[name] for way in ways if name in way.choices))
        for name in CHOICES
    }
    possible = {name: values for name, values in possible.items() if values}
    return Decision(
        place=extrinsic.place,
        choices={name: values[0] if len(values) == 1 else None for name, values in possible.items()},
        possible=possible,
        camera_from_points=left[0][0].camera_from_points if len(left) == 1 else None,
        reason=reason,
        by_drive=bool(frames),
    )
