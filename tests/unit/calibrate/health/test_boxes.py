"""What boxes of detectors add to a verdict."""

import numpy as np
import pytest

from sceneloom.calibrate.health import (
    PARTS,
    CalibrationHealth,
    Item,
    Verdict,
    health_of_boxes,
    judge,
    judge_boxes,
    with_boxes,
)
from sceneloom.detections.residuals import BoxRotation

GOOD, DRIFTING, WRONG, UNTOLD = Verdict.GOOD, Verdict.DRIFTING, Verdict.WRONG, Verdict.UNDETERMINED
SURE = np.radians(0.05) ** 2 * np.eye(3)


def rotation(*rotation_deg, sigma_deg=0.05, agreeing=200, by_chance=10, images=50):
    covariance = np.radians(sigma_deg) ** 2 * np.eye(3)
    return BoxRotation(np.radians(rotation_deg), covariance, agreeing, by_chance, images)


def images_state(rotation_deg, *, stated=8.0):
    """What images and points state: a rotation about x, or nothing."""
    rotation = Item.unknown("rotation", "dark")
    if rotation_deg is not None:
        rotation = judge("rotation", np.radians([rotation_deg, 0.0, 0.0]), SURE)
    return CalibrationHealth(
        source="made up",
        camera_id="camera",
        lidar_id="lidar",
        verdict=rotation.verdict,
        items=(rotation, *(Item.unknown(name, "dark") for name in PARTS[1:])),
        frames=4,
        views=2,
        distinctness=8.0,
        stated_distinctness=stated,
        measures={},
    )


@pytest.mark.parametrize(
    ("found", "verdicts"),
    [
        (rotation(0.1, -0.1, 0.3), (GOOD, GOOD)),
        (rotation(0.8, 0.0, 0.0), (DRIFTING, GOOD)),
        (rotation(0.0, 3.0, 0.5), (WRONG, GOOD)),
        (rotation(0.0, 0.0, 2.5), (GOOD, WRONG)),
        # its own 0.4 degrees make 1.3 degrees about the axis of visibility chance
        (rotation(0.0, 0.0, 1.3), (GOOD, UNTOLD)),
        (rotation(3.0, 0.0, 0.0, sigma_deg=0.6), (UNTOLD, UNTOLD)),
        (rotation(3.0, 0.0, 0.0, agreeing=30), (UNTOLD, UNTOLD)),
        (rotation(3.0, 0.0, 0.0, images=6), (UNTOLD, UNTOLD)),
        (rotation(3.0, 0.0, 0.0, by_chance=120), (UNTOLD, UNTOLD)),
        (None, (UNTOLD, UNTOLD)),
    ],
)
def test_boxes_are_judged_by_their_rotation_and_by_how_many_agree(found, verdicts):
    items = judge_boxes(found)
    assert tuple(item.verdict for item in items) == verdicts
    assert all(bool(item.reason) is (item.verdict is not GOOD) for item in items)


@pytest.mark.parametrize(
    ("images_deg", "found", "verdict"),
    [
        (None, rotation(0.1, 0.0, 0.0), GOOD),
        (None, rotation(3.0, 0.0, 0.0), WRONG),
        (None, rotation(0.0, 0.0, 2.5), WRONG),
        (None, None, UNTOLD),
        (0.0, None, GOOD),
        (0.0, rotation(0.1, 0.0, 0.0), GOOD),
        (0.6, rotation(0.3, 0.0, 0.0), DRIFTING),
        (1.5, rotation(1.3, 0.0, 0.0), WRONG),
        (1.5, None, WRONG),
    ],
)
def test_boxes_decide_where_images_cannot_and_join_them_where_they_can(images_deg, found, verdict):
    health = with_boxes(images_state(images_deg), found)
    assert health.verdict is verdict
    assert [item.name for item in health.items] == [*PARTS, "boxes", "boxes_roll"]


@pytest.mark.parametrize(
    ("images_deg", "found"), [(0.0, rotation(3.0, 0.0, 0.0)), (1.5, rotation(0.0, 0.0, 0.0))]
)
def test_where_boxes_and_images_contradict_each_other_nothing_is_reported(images_deg, found):
    health = with_boxes(images_state(images_deg), found)
    assert health.verdict is UNTOLD
    assert ", but " in health.item("boxes").reason


def test_good_boxes_do_not_excuse_images_that_agree_much_better_elsewhere():
    health = images_state(0.0, stated=4.0)
    doubted = CalibrationHealth(
        **{**{k: getattr(health, k) for k in health.__struct_fields__}, "verdict": UNTOLD}
    )
    assert with_boxes(doubted, rotation(0.0, 0.0, 0.0)).verdict is UNTOLD
    assert with_boxes(doubted, rotation(3.0, 0.0, 0.0)).verdict is WRONG


def test_boxes_alone_are_enough_for_a_verdict():
    health = health_of_boxes(rotation(3.0, 0.0, 0.0), source="0001", camera_id=2, lidar_id=0, frames=50)
    assert (health.verdict, health.views, health.frames) == (WRONG, 0, 50)
    assert {item.verdict for item in health.items[:5]} == {UNTOLD}
    assert health.item("boxes").values == pytest.approx((3.0, 0.0))
