"""Every way to write a rig down, read back by the ways that are tried; SciPy says what the rotations are."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.calibrate.conventions import groups, hypotheses

ROTATION = Rotation.from_euler("ZYX", [-88.0, 1.5, -91.0], degrees=True)
TRANSLATION = np.array([0.1, -0.3, 0.2])
RIG = np.eye(4)
RIG[:3, :3], RIG[:3, 3] = ROTATION.as_matrix(), TRANSLATION


def _quaternion(transform, *, scalar_first):
    quaternion = Rotation.from_matrix(transform[:3, :3]).as_quat()
    return np.roll(quaternion, 1) if scalar_first else quaternion


WRITINGS = {
    "4x4 by rows": (lambda m: m.reshape(-1), {"layout": "rows"}),
    "4x4 by columns": (lambda m: m.T.reshape(-1), {"layout": "columns"}),
    "3x4 by rows": (lambda m: m[:3].reshape(-1), {"layout": "rows"}),
    "3x4 by columns": (lambda m: m[:3].T.reshape(-1), {"layout": "columns"}),
    "translation, x y z w": (
        lambda m: np.r_[m[:3, 3], _quaternion(m, scalar_first=False)],
        {"order of parts": "translation first", "quaternion": "x y z w"},
    ),
    "w x y z, translation": (
        lambda m: np.r_[_quaternion(m, scalar_first=True), m[:3, 3]],
        {"order of parts": "rotation first", "quaternion": "w x y z"},
    ),
    "translation, degrees about fixed axes": (
        lambda m: np.r_[m[:3, 3], Rotation.from_matrix(m[:3, :3]).as_euler("xyz", degrees=True)],
        {"order of parts": "translation first", "angles": "degrees", "order of angles": "Rz Ry Rx"},
    ),
    "radians about moving axes, translation": (
        lambda m: np.r_[Rotation.from_matrix(m[:3, :3]).as_euler("XYZ"), m[:3, 3]],
        {"order of parts": "rotation first", "angles": "radians", "order of angles": "Rx Ry Rz"},
    ),
}


@pytest.mark.parametrize("direction", ["camera from lidar", "lidar from camera"])
@pytest.mark.parametrize("writing", WRITINGS)
def test_one_of_the_trajectories_gives_the_rig_that_was_written(writing, direction):
    write, choices = WRITINGS[writing]
    numbers = write(RIG if direction == "camera from lidar" else np.linalg.inv(RIG))
    wanted = {
        **choices,
        "direction": direction,
        "camera axes": "x right, y down, z forward",
        "lidar axes": "those of the points",
    }
    right = [trajectory for trajectory in hypotheses(numbers) if wanted.items() <= trajectory.choices.items()]
    assert len(right) == 1
    np.testing.assert_allclose(right[0].camera_from_points, RIG, atol=1e-9)  # rounding alone


def test_other_axes_rotate_the_frames_on_both_sides():
    body_from_camera = np.array(
        [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    )  # columns: right, down, forward
    stated = np.eye(4)
    stated[:3, :3] = body_from_camera @ RIG[:3, :3] @ Rotation.from_euler("z", -90, degrees=True).as_matrix()
    stated[:3, 3] = body_from_camera @ RIG[:3, 3]
    wanted = {
        "direction": "camera from lidar",
        "camera axes": "x forward, y left, z up",
        "lidar axes": "x, y along the points' -y, x",
    }
    right = [
        trajectory
        for trajectory in hypotheses(stated.reshape(-1))
        if wanted.items() <= trajectory.choices.items()
    ]
    assert len(right) == 1
    np.testing.assert_allclose(right[0].camera_from_points, RIG, atol=1e-9)  # rounding alone


def test_a_rotation_beside_its_translation_is_read_by_rows_and_by_columns():
    numbers = np.r_[RIG[:3, :3].T.reshape(-1), RIG[:3, 3]]
    trajectories = hypotheses(numbers, apart=True)
    assert any(
        np.allclose(trajectory.camera_from_points, RIG)
        for trajectory in trajectories
        if trajectory.choices["layout"] == "columns"
    )
    assert not any(
        np.allclose(trajectory.camera_from_points, RIG)
        for trajectory in trajectories
        if trajectory.choices["layout"] == "rows"
    )


@pytest.mark.parametrize(
    "numbers",
    [
        np.full(16, np.nan),
        np.diag([1.0, 1.0, -1.0, 1.0]).reshape(-1),
        [1, 2, 3, 0.5, 0.5, 0.5, 0.6],
        [400, 0, 0, 400, 0, 0],
        [700, 0, 600, 0, 700, 180, 0, 0, 1],
        [1.0, 2.0],
    ],
)
def test_what_is_no_transform_is_read_not(numbers):
    assert hypotheses(numbers) == ()


def test_choices_that_are_certain_leave_the_others_out():
    quaternion = np.r_[TRANSLATION, ROTATION.as_quat()]
    everything, certain = hypotheses(quaternion), hypotheses(quaternion, {"quaternion": "x y z w"})
    assert {trajectory.choices["quaternion"] for trajectory in certain} == {"x y z w"}
    assert {trajectory.choices["quaternion"] for trajectory in everything} == {"x y z w", "w x y z"}


def test_ways_of_the_same_transform_make_one_group():
    half_rotation = np.diag([1.0, -1.0, -1.0, 1.0])
    found = groups(hypotheses(half_rotation.reshape(-1)))
    together = [
        {
            (trajectory.choices["layout"], trajectory.choices["direction"], trajectory.choices["camera axes"])
            for trajectory in group
        }
        for group in found
    ]
    # by rows as by columns, in both directions, it is one and the same half rotation about x
    same = set(
        itertools.product(
            ("rows", "columns"), ("camera from lidar", "lidar from camera"), ("x right, y down, z forward",)
        )
    )
    assert any(same <= group for group in together)
    for one, other in itertools.combinations(found, 2):
        assert np.abs(one[0].camera_from_points - other[0].camera_from_points).max() > 1e-3
