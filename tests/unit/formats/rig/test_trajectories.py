"""Trajectories of any frame and form, brought to the ego."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from .conftest import FIRST_SENSOR, POSES, TUM, codes

TIMES = np.array([0.0, 0.5, 1.0])
ROTATIONS = Rotation.from_euler("ZYX", [[0, 0, 0], [30, 5, -3], [60, 0, 2]], degrees=True)
LOCATIONS = np.array([[0.0, 0, 0], [3, 1, 0.1], [5, 4, 0.2]])
WORLD_FROM_FRAME = np.tile(np.eye(4), (3, 1, 1))
WORLD_FROM_FRAME[:, :3, :3], WORLD_FROM_FRAME[:, :3, 3] = ROTATIONS.as_matrix(), LOCATIONS
BASE_FROM_IMU = np.array([[0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 1.0], [0, 0, 0, 1]])
IMU = f'[[transforms]]\nfrom = "imu"\nto = "base"\nmatrix = {BASE_FROM_IMU.tolist()}\n\n{FIRST_SENSOR}'


def write_tum(folder):
    rows = np.column_stack([TIMES, LOCATIONS, ROTATIONS.as_quat()])
    np.savetxt(folder / "trajectory.txt", rows, header="t x y z qx qy qz qw")
    return 'file = "trajectory.txt"\nform = "tum"'


def write_csv(folder):
    names = "timestamp_ms,east,y,z,qw,qx,qy,qz"
    rows = np.column_stack([TIMES * 1000, LOCATIONS, ROTATIONS.as_quat()[:, [3, 0, 1, 2]]])
    np.savetxt(folder / "trajectory.csv", rows, header=names, comments="", delimiter=",")
    return 'file = "trajectory.csv"\nform = "csv"\ncolumns = { x = "east" }'


def write_kitti(folder):
    np.savetxt(folder / "trajectory.txt", WORLD_FROM_FRAME[:, :3].reshape(3, 12))
    np.savetxt(folder / "times.txt", TIMES)
    return 'file = "trajectory.txt"\nform = "kitti"\ntimes = "times.txt"'


def matrices(trajectory):
    found = np.tile(np.eye(4), (len(trajectory.positions), 1, 1))
    found[:, :3, :3] = Rotation.from_quat(trajectory.quaternions_xyzw).as_matrix()
    found[:, :3, 3] = trajectory.positions
    return found


@pytest.mark.parametrize("write", [write_tum, write_csv, write_kitti])
def test_every_form_of_another_frame_gives_the_ego_trajectory(opened, folder, write):
    stated = write(folder)
    scene = opened((TUM, f'{stated}\nframe = "imu"\nname = "slam"'), (FIRST_SENSOR, IMU))
    found = scene.trajectories["slam"]
    assert found.timestamps_ns.tolist() == [0, 500_000_000, 1_000_000_000]
    expected = WORLD_FROM_FRAME @ np.linalg.inv(BASE_FROM_IMU)
    # the texts hold 18 digits
    np.testing.assert_allclose(matrices(found), expected, atol=1e-12)


def test_a_world_with_optical_axes_is_rotated_so_that_z_is_up(opened, folder):
    (folder / "poses.txt").write_text("1 1 2 3 0 0 0 1\n2 1 2 4 0 0 0 1\n")
    found = opened((TUM, f'{TUM}\nworld_axes = "optical"')).trajectories["pose"]
    assert found.positions.tolist() == [[3.0, -1.0, -2.0], [4.0, -1.0, -2.0]]
    rotated = Rotation.from_quat(found.quaternions_xyzw[0]).apply([0, 0, 1.0])
    np.testing.assert_allclose(rotated, [1, 0, 0], atol=1e-12)


def test_the_first_trajectory_is_the_default(opened):
    second = f'{TUM}\nname = "a"\n\n[[trajectories]]\n{TUM}\nname = "b"\ntime_offset_s = 0.5'
    trajectories = opened((TUM, second)).trajectories
    assert [*trajectories] == ["a", "b"]
    assert (trajectories["b"].timestamps_ns - trajectories["a"].timestamps_ns).tolist() == [500_000_000] * 2


def test_positions_alone_are_a_trajectory_without_orientations(opened, folder):
    (folder / "trajectory.csv").write_text("time;x;y;z\n0;1;2;3\n1;2;2;3\n")
    scene = opened((TUM, 'file = "trajectory.csv"\nform = "csv"\nframe = "top"'))
    assert scene.trajectories["pose"].quaternions_xyzw is None
    assert scene.lidars[0].poses is None
    assert {"lever-arm-ignored", "orientations-missing"} < set(codes(scene))


def test_poses_out_of_order_are_sorted_and_repeated_ones_left_out(opened, folder):
    lines = POSES.splitlines()
    (folder / "poses.txt").write_text("\n".join([lines[2], lines[1], lines[1]]))
    scene = opened()
    assert scene.trajectories["pose"].positions[:, 0].tolist() == [0.0, 10.0]
    assert codes(scene) == ["poses-sorted", "repeated-poses"]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "is empty"),
        ("# only a comment\n", "is empty"),
        ("1 2 3\n", "3 values; expected 8: timestamp tx ty tz qx qy qz qw"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", "line 2: 7 values; expected 8"),
        ("1 0 0 zero 0 0 0 1\n", "line 1: column 4: 'zero'; expected a finite number"),
        ("1 0 0 0 0 0 0 nan\n", "line 1: column 8: 'nan'"),
        ("1 0 0 0 0 0 0 2\n", r"line 1: orientation .* of length 2.0000"),
        ("x 0 0 0 0 0 0 1\n", "line 1: 'x'; expected a number, or a date"),
        ("1532402927647951001 0 0 0 0 0 0 1\n", 'is `unit = "nanoseconds"` meant'),
    ],
)
def test_a_wrong_line_is_reported_with_its_number(refused, folder, text, problem):
    (folder / "poses.txt").write_text(text)
    refused(problem)


def test_the_names_of_columns_may_stand_in_the_comment_above_the_first_line(opened):
    as_csv = opened((TUM, 'file = "poses.txt"\nform = "csv"'))
    assert as_csv.trajectories["pose"].positions.tolist() == [[0, 0, 0], [10, 0, 0]]


def test_as_many_times_as_poses_are_needed(refused, folder):
    stated = write_kitti(folder)
    (folder / "times.txt").write_text("1\n2\n")
    refused("2 times for 3 poses", (TUM, stated))


def test_a_matrix_that_is_no_rotation_is_reported_with_its_line(refused, folder):
    stated = write_kitti(folder)
    np.savetxt(folder / "trajectory.txt", (WORLD_FROM_FRAME[:, :3] * [[[1.0]], [[1.1]], [[1.0]]]).reshape(3, 12))
    refused(r"line 2: rotation off by 0.21", (TUM, stated))


def test_quaternions_of_another_order_are_remarked(opened, folder):
    (folder / "poses.txt").write_text("1532402927.5 0 0 0 1 0 0 0\n1532402928.5 9 0 0 0.98 0.02 0 0.198\n")
    (warning,) = opened().warnings
    assert warning.code == "ego-leaning"
    assert "on its side or upside down in 2 of 2 poses; are the quaternions x y z w" in warning.message
