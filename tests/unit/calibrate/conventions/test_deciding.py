"""One simulated rig written in many ways: each is reported as it was written, or left open."""

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.calibrate.conventions import CAMERA_AXES, LIDAR_AXES, Extrinsic, decide, edges_meeting
from sceneloom.calibrate.frames import calibration_frames
from sceneloom.simulate import simulate_street


@dataclass(frozen=True)
class Judge:
    frames: tuple[Any, ...]
    score: Any
    truth: np.ndarray


@pytest.fixture(scope="module")
def judge():
    frames = calibration_frames(simulate_street(4, frames=3).scene, most=2)
    return Judge(frames, edges_meeting(frames), frames[0].camera_from_lidar.matrix)


def _quaternion(matrix, *, scalar_first):
    quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return np.roll(quaternion, 1) if scalar_first else quaternion


def _angles(matrix, order, *, degrees):
    return Rotation.from_matrix(matrix[:3, :3]).as_euler(order, degrees=degrees)


WRITINGS = {
    "4x4 rows": lambda m: m.reshape(-1),
    "4x4 columns": lambda m: m.T.reshape(-1),
    "3x4 rows": lambda m: m[:3].reshape(-1),
    "3x4 columns": lambda m: m[:3].T.reshape(-1),
    **{
        f"quaternion, scalar first {scalar_first}, translation first {translation_first}": partial(
            lambda m, scalar_first, translation_first: np.concatenate(
                [m[:3, 3], _quaternion(m, scalar_first=scalar_first)]
                if translation_first
                else [_quaternion(m, scalar_first=scalar_first), m[:3, 3]]
            ),
            scalar_first=scalar_first,
            translation_first=translation_first,
        )
        for scalar_first in (False, True)
        for translation_first in (False, True)
    },
    **{
        f"angles {order}, degrees {degrees}": partial(
            lambda m, order, degrees: np.concatenate([m[:3, 3], _angles(m, order, degrees=degrees)]),
            order=order,
            degrees=degrees,
        )
        for order in ("xyz", "XYZ")
        for degrees in (False, True)
    },
}


def _written(truth, direction, camera_axes, lidar_axes):
    """What a file says of the true rig, (4, 4), under some axes and in some direction."""
    left, right = np.eye(4), np.eye(4)
    left[:3, :3], right[:3, :3] = CAMERA_AXES[camera_axes].T, LIDAR_AXES[lidar_axes].T
    stated = left @ truth @ right
    return stated if direction == "camera from lidar" else np.linalg.inv(stated)


COMBINATIONS = tuple(
    itertools.product(WRITINGS, ("camera from lidar", "lidar from camera"), CAMERA_AXES, LIDAR_AXES)
)


def _judged(judge, combination):
    """Whether the decision is right, wrong, or left open."""
    writing, direction, camera_axes, lidar_axes = combination
    numbers = WRITINGS[writing](_written(judge.truth, direction, camera_axes, lidar_axes))
    decision = decide(Extrinsic(writing, tuple(numbers.tolist())), judge.frames, judge.score)
    possible = (
        direction in decision.possible.get("direction", ())
        and camera_axes in decision.possible["camera axes"]
        and lidar_axes in decision.possible["lidar axes"]
    )
    if not decision.decided:
        return "open"
    return (
        "right" if possible and np.allclose(decision.camera_from_lidar, judge.truth, atol=1e-3) else "wrong"
    )


@pytest.mark.slow
def test_rigs_written_in_some_of_all_ways_are_reported(judge):
    verdicts = [_judged(judge, combination) for combination in COMBINATIONS[:: len(COMBINATIONS) // 5]]
    assert "wrong" not in verdicts
    assert verdicts.count("right") >= 0.9 * len(verdicts)


@pytest.mark.slow
def test_a_rig_written_in_a_third_of_all_ways_is_reported_or_left_open(judge):
    verdicts = [_judged(judge, combination) for combination in COMBINATIONS[::3]]
    assert verdicts.count("wrong") <= 0.01 * len(verdicts)
    assert verdicts.count("right") >= 0.9 * len(verdicts)


def test_without_a_drive_only_what_no_vehicle_has_is_left_out(judge):
    decision = decide(Extrinsic("file", tuple(judge.truth.reshape(-1).tolist())))
    assert decision.possible["direction"] == ("camera from lidar",)
    assert decision.possible["camera axes"] == ("x right, y down, z forward",)
    assert len(decision.possible["lidar axes"]) > 1
    assert not decision.decided


def test_a_rig_of_another_vehicle_is_left_open(judge):
    elsewhere = np.eye(4)
    elsewhere[:3, :3] = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    decision = decide(
        Extrinsic("file", tuple((elsewhere @ judge.truth).reshape(-1).tolist())), judge.frames, judge.score
    )
    assert not decision.decided


def test_a_camera_on_its_head_is_read_not(judge):
    over = np.diag([-1.0, -1.0, 1.0, 1.0]) @ judge.truth
    numbers = tuple(over[:3].reshape(-1).tolist())
    decision = decide(Extrinsic("file", numbers), judge.frames, judge.score)
    assert not decision.decided or not np.allclose(decision.camera_from_lidar, over)
