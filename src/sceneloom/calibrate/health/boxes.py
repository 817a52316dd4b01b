"""What boxes of detectors add to the check of a calibration, and what the check is by boxes alone.

Boxes of pictures and sweeps come together about a turn. It is as exact as edges where there are many boxes, and known
from farther away. A camera that is shifted looks turned to boxes, by the shift over their distance.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from sceneloom.calibrate.health.check import PARTS, CalibrationHealth
from sceneloom.calibrate.health.verdicts import LIMITS, SIGNIFICANT, Item, Verdict, judge
from sceneloom.detections.residuals import BoxTurn
from sceneloom.scene.types import Identifier

ACROSS, ABOUT_SIGHT = "boxes", "boxes_roll"
"""Turns about the camera's x and y axes, and about its axis of sight, of which boxes know less."""

_LEAST_AGREEING, _LEAST_PICTURES, _ABOVE_CHANCE = 40, 10, 2.0
"""So many couples must agree, in so many pictures, and so many times as many as about other turns: boxes of other
pictures reach 35, and less than twice as many."""
_OFF = (Verdict.WRONG, Verdict.DRIFTING)


def judge_boxes(found: BoxTurn | None) -> tuple[Item, Item]:
    """Judge the turn that boxes of pictures and sweeps show.

    Args:
        found: the turn; None where hardly any boxes may be of one object.

    Returns:
        What is to be said of the camera's x and y axes, and of its axis of sight.
    """
    reason = _why_untold(found)
    if found is None or reason:
        return Item.unknown(ACROSS, reason), Item.unknown(ABOUT_SIGHT, reason)
    return (
        judge(ACROSS, found.rotation[:2], found.covariance[:2, :2]),
        judge(ABOUT_SIGHT, found.rotation[2:], found.covariance[2:, 2:]),
    )


def _why_untold(found: BoxTurn | None) -> str:
    if found is None:
        return "hardly any boxes of pictures and sweeps may be of one object"
    if found.agreeing < _LEAST_AGREEING or found.pictures < _LEAST_PICTURES:
        return (
            f"{found.agreeing} couples of boxes in {found.pictures} pictures come together about one turn; "
            f"expected {_LEAST_AGREEING} in {_LEAST_PICTURES}"
        )
    if found.agreeing < _ABOVE_CHANCE * found.by_chance:
        return (
            f"{found.agreeing} couples of boxes come together about one turn, {found.by_chance} about another; "
            f"expected {_ABOVE_CHANCE:g} times as many"
        )
    return ""


def health_of_boxes(
    found: BoxTurn | None, *, source: str, camera_id: Identifier, lidar_id: Identifier, frames: int
) -> CalibrationHealth:
    """Check a calibration by boxes alone, where there are neither pictures nor points.

    Args:
        frames: pictures whose boxes were looked at.
    """
    nothing = "there are neither pictures nor points to look at, but boxes alone"
    untold = CalibrationHealth(
        source=source,
        camera_id=camera_id,
        lidar_id=lidar_id,
        verdict=Verdict.CANNOT_TELL,
        items=tuple(Item.unknown(name, nothing) for name in PARTS),
        frames=frames,
        views=0,
        distinctness=0.0,
        stated_distinctness=0.0,
        measures={},
    )
    return with_boxes(untold, found)


def with_boxes(health: CalibrationHealth, found: BoxTurn | None) -> CalibrationHealth:
    """Add what boxes say to what pictures and points say.

    Boxes decide where pictures and points cannot tell. Where both tell, and one calls good what the other clearly does
    not, nothing can be told of all of it.
    """
    boxes = judge_boxes(found)
    reason = _contradiction(health, boxes)
    verdict = Verdict.CANNOT_TELL if reason else _together(health, boxes)
    if reason:
        boxes = (msgspec.structs.replace(boxes[0], reason=reason), boxes[1])
    return msgspec.structs.replace(health, verdict=verdict, items=(*health.items, *boxes))


def _together(health: CalibrationHealth, boxes: Sequence[Item]) -> Verdict:
    told = {health.verdict, *(item.verdict for item in boxes)}
    worst = next((verdict for verdict in _OFF if verdict in told), None)
    if worst is not None:
        return worst
    if health.verdict is Verdict.CANNOT_TELL and (health.doubted or any(i.suspected for i in health.items)):
        return Verdict.CANNOT_TELL
    return Verdict.GOOD if Verdict.GOOD in {health.verdict, boxes[0].verdict} else Verdict.CANNOT_TELL


def _contradiction(health: CalibrationHealth, boxes: Sequence[Item]) -> str:
    """Why pictures and boxes cannot both be right; "" if they can."""
    off = [item for item in boxes if item.verdict in _OFF]
    if health.verdict is Verdict.GOOD and off:
        return f"{off[0].reason}, but pictures and points agree with it"
    rotation = health.item("rotation")
    if rotation.verdict in _OFF and boxes[0].verdict is Verdict.GOOD and _differ(rotation, boxes[0]):
        return f"boxes agree with it, but {rotation.reason}"
    return ""


def _differ(rotation: Item, across: Item) -> bool:
    """Whether two turns about the axes across are more than chance apart."""
    apart = np.subtract(rotation.values[:2], across.values)
    variances = np.square(rotation.sigmas[:2]) + np.square(across.sigmas)
    far = float(np.linalg.norm(apart)) > LIMITS[ACROSS].good
    return far and float(np.sum(apart**2 / variances)) > SIGNIFICANT
