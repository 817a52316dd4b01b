"""What boxes of detectors add to the check of a calibration, and what the check is by boxes alone.

Boxes of images and sweeps come together about a rotation. It is as exact as edges where there are many boxes, and known
from farther away. A camera that is shifted looks rotated to boxes, by the shift over their distance.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from sceneloom.calibrate.health.check import PARTS, CalibrationHealth
from sceneloom.calibrate.health.verdicts import LIMITS, SIGNIFICANT, Item, Verdict, judge
from sceneloom.detections.residuals import BoxRotation
from sceneloom.scene.types import Identifier

ACROSS, ABOUT_VISIBILITY = "boxes", "boxes_roll"
"""Rotates about the camera's x and y axes, and about its axis of visibility, of which boxes know less."""

_LEAST_AGREEING, _LEAST_IMAGES, _ABOVE_CHANCE = 40, 10, 2.0
"""So many couples must agree, in so many images, and so many times as many as about other rotations: boxes of other
images reach 35, and less than twice as many."""
_OFF = (Verdict.WRONG, Verdict.DRIFTING)


def judge_boxes(found: BoxRotation | None) -> tuple[Item, Item]:
    """Judge the rotation that boxes of images and sweeps show.

    Args:
        found: the rotation; None where hardly any boxes may be of one object.

    Returns:
        What is to be stated of the camera's x and y axes, and of its axis of visibility.
    """
    reason = _why_untold(found)
    if found is None or reason:
        return Item.unknown(ACROSS, reason), Item.unknown(ABOUT_VISIBILITY, reason)
    return (
        judge(ACROSS, found.rotation[:2], found.covariance[:2, :2]),
        judge(ABOUT_VISIBILITY, found.rotation[2:], found.covariance[2:, 2:]),
    )


def _why_untold(found: BoxRotation | None) -> str:
    if found is None:
        return "hardly any boxes of images and sweeps may be of one object"
    if found.agreeing < _LEAST_AGREEING or found.images < _LEAST_IMAGES:
        return (
            f"{found.agreeing} couples of boxes in {found.images} images come together about one rotation; "
            f"expected {_LEAST_AGREEING} in {_LEAST_IMAGES}"
        )
    if found.agreeing < _ABOVE_CHANCE * found.by_chance:
        return (
            f"{found.agreeing} couples of boxes come together about one rotation, {found.by_chance} about another; "
            f"expected {_ABOVE_CHANCE:g} times as many"
        )
    return ""


def health_of_boxes(
    found: BoxRotation | None, *, source: str, camera_id: Identifier, lidar_id: Identifier, frames: int
) -> CalibrationHealth:
    """Check a calibration by boxes alone, where there are neither images nor points.

    Args:
        frames: images whose boxes were looked at.
    """
    nothing = "there are neither images nor points to look at, but boxes alone"
    untold = CalibrationHealth(
        source=source,
        camera_id=camera_id,
        lidar_id=lidar_id,
        verdict=Verdict.UNDETERMINED,
        items=tuple(Item.unknown(name, nothing) for name in PARTS),
        frames=frames,
        views=0,
        distinctness=0.0,
        stated_distinctness=0.0,
        measures={},
    )
    return with_boxes(untold, found)


def with_boxes(health: CalibrationHealth, found: BoxRotation | None) -> CalibrationHealth:
    """Add what boxes state to what images and points state.

    Boxes decide where images and points cannot determine. Where both report, and one calls good what the other clearly
    does not, nothing can be reported all of it.
    """
    boxes = judge_boxes(found)
    reason = _contradiction(health, boxes)
    verdict = Verdict.UNDETERMINED if reason else _together(health, boxes)
    if reason:
        boxes = (msgspec.structs.replace(boxes[0], reason=reason), boxes[1])
    return msgspec.structs.replace(health, verdict=verdict, items=(*health.items, *boxes))


def _together(health: CalibrationHealth, boxes: Sequence[Item]) -> Verdict:
    reported = {health.verdict, *(item.verdict for item in boxes)}
    worst = next((verdict for verdict in _OFF if verdict in reported), None)
    if worst is not None:
        return worst
    if health.verdict is Verdict.UNDETERMINED and (health.doubted or any(i.suspected for i in health.items)):
        return Verdict.UNDETERMINED
    return Verdict.GOOD if Verdict.GOOD in {health.verdict, boxes[0].verdict} else Verdict.UNDETERMINED


def _contradiction(health: CalibrationHealth, boxes: Sequence[Item]) -> str:
    """Why images and boxes cannot both be right; "" if they can."""
    off = [item for item in boxes if item.verdict in _OFF]
    if health.verdict is Verdict.GOOD and off:
        return f"{off[0].reason}, but images and points agree with it"
    rotation = health.item("rotation")
    if rotation.verdict in _OFF and boxes[0].verdict is Verdict.GOOD and _differ(rotation, boxes[0]):
        return f"boxes agree with it, but {rotation.reason}"
    return ""


def _differ(rotation: Item, across: Item) -> bool:
    """Whether two rotates about the axes across are more than chance apart."""
    apart = np.subtract(rotation.values[:2], across.values)
    variances = np.square(rotation.sigmas[:2]) + np.square(across.sigmas)
    far = float(np.linalg.norm(apart)) > LIMITS[ACROSS].good
    return far and float(np.sum(apart**2 / variances)) > SIGNIFICANT
