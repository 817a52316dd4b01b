"""What rotating says of a rotation, on synthetic rotates whose truth is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.calibrate.health import Item, Verdict, health_of_boxes, judge, judge_motion, with_coarse

AXES = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def rotations(injected, *, rate_deg=1.5, count=60, noise_deg=0.02, seed=0):
    """A vehicle that rotates about its z axis; the camera is really rotated from where it is stated to be."""
    generator = np.random.default_rng(seed)
    lidar = np.radians(rate_deg) * np.array([0.0, 0.0, 1.0]) * generator.uniform(0.5, 1.0, (count, 1))
    lidar = lidar + np.radians(0.02) * generator.normal(size=(count, 3))
    camera = (injected * AXES).apply(lidar) + np.radians(noise_deg) * generator.normal(size=(count, 3))
    return camera, lidar, AXES.as_matrix()


@pytest.mark.parametrize("size_deg", [4.0, 20.0, 90.0, 150.0])
def test_a_rotation_across_the_axis_is_found_however_large(size_deg):
    injected = Rotation.from_rotvec([size_deg, 0.0, 0.0], degrees=True)
    item = judge_motion(*rotations(injected))
    # 0.02 degrees against a degree, sixty times: 0.15 degrees
    assert (item.verdict, abs(item.values[0])) == (Verdict.WRONG, pytest.approx(size_deg, abs=0.6))
    assert abs(item.values[1]) < 0.6


@pytest.mark.parametrize(
    "injected_deg", [(0.0, 0.0, 0.0), (0.5, 0.0, 0.5), (0.0, 30.0, 0.0)], ids=["none", "small", "along"]
)
def test_what_is_small_or_along_the_axis_is_not_reported(injected_deg):
    assert judge_motion(*rotations(Rotation.from_rotvec(injected_deg, degrees=True))).verdict is Verdict.GOOD


def test_a_camera_upside_down_is_wrong():
    assert (
        judge_motion(*rotations(Rotation.from_rotvec([0, 0, 180.0], degrees=True))).verdict is Verdict.WRONG
    )


@pytest.mark.parametrize("more", [{"rate_deg": 0.05}, {"count": 10}, {"noise_deg": 2.0}])
def test_a_drive_that_hardly_rotates_or_is_hardly_seen_cannot_determine(more):
    injected = Rotation.from_rotvec([4.0, 0.0, 0.0], degrees=True)
    assert judge_motion(*rotations(injected, **more)).verdict is Verdict.UNDETERMINED


def test_rotating_makes_nothing_good_but_may_contradict():
    untold = health_of_boxes(None, source="made up", camera_id=0, lidar_id=0, frames=0)
    good, wrong = (judge("motion", np.radians([d, 0.0]), np.zeros((2, 2))) for d in (0.0, 9.0))
    assert with_coarse(untold, good).verdict is Verdict.UNDETERMINED
    assert with_coarse(untold, wrong).verdict is Verdict.WRONG
    right = type(untold)(
        **{f: getattr(untold, f) for f in untold.__struct_fields__} | {"verdict": Verdict.GOOD}
    )
    assert with_coarse(right, Item.unknown("motion", "stood")).verdict is Verdict.GOOD
    doubtful = with_coarse(right, wrong)
    assert (doubtful.verdict, ", but " in doubtful.item("motion").reason) == (Verdict.UNDETERMINED, True)
