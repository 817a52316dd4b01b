"""Trajectories of any frame and form, brought to the ego, and IMU and satellite receivers out of files with columns."""

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
IMU_FRAME = f'[[transforms]]\nfrom = "imu"\nto = "base"\nmatrix = {BASE_FROM_IMU.tolist()}\n\n{FIRST_SENSOR}'
KITTI = 'file = "trajectory.txt"\nform = "kitti"\ntimes = "times.txt"'
AS_CSV = 'file = "trajectory.csv"\nform = "csv"'


@pytest.fixture
def written(folder):
    """The trajectory of the frame `imu` in three forms."""
    rows = np.column_stack([TIMES, LOCATIONS, ROTATIONS.as_quat()])
    np.savetxt(folder / "tum.txt", rows, header="t x y z qx qy qz qw")
    rows[:, 0] *= 1000
    names = "timestamp_ms,east,y,z,qw,qx,qy,qz"
    path = folder / "trajectory.csv"
    np.savetxt(path, rows[:, [0, 1, 2, 3, 7, 4, 5, 6]], header=names, comments="", delimiter=",")
    np.savetxt(folder / "trajectory.txt", WORLD_FROM_FRAME[:, :3].reshape(3, 12))
    np.savetxt(folder / "times.txt", TIMES)
    return folder


def test_every_form_of_another_frame_gives_the_ego_trajectory(opened, refused, written):
    expected = WORLD_FROM_FRAME @ np.linalg.inv(BASE_FROM_IMU)
    for stated in ('file = "tum.txt"\nform = "tum"', AS_CSV + '\ncolumns = { x = "east" }', KITTI):
        scene = opened((TUM, f'{stated}\nframe = "imu"\nname = "slam"'), (FIRST_SENSOR, IMU_FRAME))
        found = scene.trajectories["slam"]
        assert found.timestamps_ns.tolist() == [0, 500_000_000, 1_000_000_000]
        # the texts hold 18 digits
        np.testing.assert_allclose(found.positions, expected[:, :3, 3], atol=1e-12)
        rotations = Rotation.from_quat(found.quaternions_xyzw).as_matrix()
        np.testing.assert_allclose(rotations, expected[:, :3, :3], atol=1e-12)
    # of KITTI's form rotations have to be such, and there are as many times
    np.savetxt(written / "trajectory.txt", (WORLD_FROM_FRAME[:, :3] * [[[1.0]], [[1.1]], [[1.0]]]).reshape(3, 12))
    refused(r"line 2: rotation off by 0.21", (TUM, KITTI))
    (written / "times.txt").write_text("1\n2\n")
    refused("2 times for 3 poses", (TUM, KITTI))


def test_a_world_with_optical_axes_is_rotated_so_that_z_is_up(opened, folder):
    (folder / "poses.txt").write_text("1 1 2 3 0 0 0 1\n2 1 2 4 0 0 0 1\n")
    found = opened((TUM, f'{TUM}\nworld_axes = "optical"')).trajectories["pose"]
    assert found.positions.tolist() == [[3.0, -1.0, -2.0], [4.0, -1.0, -2.0]]
    rotated = Rotation.from_quat(found.quaternions_xyzw[0]).apply([0, 0, 1.0])
    np.testing.assert_allclose(rotated, [1, 0, 0], atol=1e-12)


def test_the_first_trajectory_is_the_default_and_names_of_columns_may_stand_in_a_comment(opened):
    second = f'{TUM}\nname = "a"\n\n[[trajectories]]\n{TUM}\nname = "b"\ntime_offset_s = 0.5'
    trajectories = opened((TUM, second.replace('form = "tum"\nname = "b"', 'form = "csv"\nname = "b"'))).trajectories
    assert [*trajectories] == ["a", "b"]
    assert (trajectories["b"].timestamps_ns - trajectories["a"].timestamps_ns).tolist() == [500_000_000] * 2
    assert trajectories["b"].positions.tolist() == [[0, 0, 0], [10, 0, 0]]


def test_poses_without_orientations_out_of_order_repeated_or_of_a_leaning_ego_are_remarked(opened, folder):
    (folder / "trajectory.csv").write_text("time;x;y;z\n0;1;2;3\n1;2;2;3\n")
    scene = opened((TUM, AS_CSV + '\nframe = "top"'))
    assert (scene.trajectories["pose"].quaternions_xyzw, scene.lidars[0].poses) == (None, None)
    assert {"lever-arm-ignored", "orientations-missing"} < set(codes(scene))
    lines = POSES.splitlines()
    (folder / "poses.txt").write_text("\n".join([lines[2], lines[1], lines[1]]))
    scene = opened()
    assert scene.trajectories["pose"].positions[:, 0].tolist() == [0.0, 10.0]
    assert codes(scene) == ["poses-sorted", "repeated-poses"]
    (folder / "poses.txt").write_text("1532402927.5 0 0 0 1 0 0 0\n1532402928.5 9 0 0 0.98 0.02 0 0.198\n")
    (warning,) = opened().warnings
    assert warning.code == "ego-leaning"
    assert "on its side or upside down in 2 of 2 poses; are the quaternions x y z w" in warning.message


IMU = """[[sensors]]
id = "imu"
type = "imu"
file = "imu.csv"
extrinsic = { to = "base", rotation_matrix = [[0, -1, 0], [1, 0, 0], [0, 0, 1]] }
"""
GNSS = '[[sensors]]\nid = "gps"\ntype = "gnss"\nfile = "gnss.csv"\n'
CAMERA = '[[sensors]]\nid = "front"'
WITH = {"poses.txt": (), "imu.csv": ((CAMERA, IMU + CAMERA),), "gnss.csv": ((CAMERA, GNSS + CAMERA),)}
"""What a manifest says of each file."""
ACCELERATIONS = "t_us,ax,ay,az,gyro_x,gyro_y,gyro_z\n1000000,1,0,9.8,90,0,0\n1010000,0,2,9.8,0,90,0\n"


def test_imu_values_are_converted_to_the_axes_of_the_ego(opened, folder):
    (folder / "imu.csv").write_text(ACCELERATIONS)
    away = IMU.replace("rotation_matrix", "translation = [1, 0, 0], rotation_matrix")
    scene = opened((CAMERA, f'{away}gyroscope_unit = "deg/s"\n' + CAMERA))
    streams = scene.sensor("imu").streams
    assert streams["accelerometer"].timestamps_ns.tolist() == [1_000_000_000, 1_010_000_000]
    np.testing.assert_allclose(streams["accelerometer"].values, [[0, 1, 9.8], [-2, 0, 9.8]], atol=1e-12)
    np.testing.assert_allclose(streams["gyroscope"].values, [[0, np.pi / 2, 0], [-np.pi / 2, 0, 0]], atol=1e-12)
    assert "imu-lever-arm" in codes(scene)
    assert "imu-lever-arm" not in codes(opened(*WITH["imu.csv"]))


def test_fixes_are_read_and_sorted(opened, folder):
    (folder / "gnss.csv").write_text("time lat lon alt hacc\n2 48.1 11.5 520.5 1.5\n1 48.0 11.6 520 2\n")
    scene = opened(*WITH["gnss.csv"])
    gnss = scene.sensor("gps")
    assert (gnss.timestamps_ns.tolist(), gnss.accuracies.tolist()) == ([1_000_000_000, 2_000_000_000], [2.0, 1.5])
    assert gnss.positions_lla.tolist() == [[48.0, 11.6, 520.0], [48.1, 11.5, 520.5]]
    assert np.isnan(gnss.vertical_accuracies).all()
    assert "samples-sorted" in codes(scene)


@pytest.mark.parametrize(
    ("file", "text", "problem"),
    [
        ("poses.txt", "", "is empty"),
        ("poses.txt", "# only a comment\n", "is empty"),
        ("poses.txt", "1 2 3\n", "3 values; expected 8: timestamp tx ty tz qx qy qz qw"),
        ("poses.txt", "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", "line 2: 7 values; expected 8"),
        ("poses.txt", "1 0 0 zero 0 0 0 1\n", "line 1: column 4: 'zero'; expected a finite number"),
        ("poses.txt", "1 0 0 0 0 0 0 nan\n", "line 1: column 8: 'nan'"),
        ("poses.txt", "1 0 0 0 0 0 0 2\n", r"line 1: orientation .* of length 2.0000"),
        ("poses.txt", "x 0 0 0 0 0 0 1\n", "line 1: 'x'; expected a number, or a date"),
        ("poses.txt", "1532402927647951001 0 0 0 0 0 0 1\n", 'is `unit = "nanoseconds"` meant'),
        ("gnss.csv", "time,lat,lon\n1,2,3\n", "no column for altitude among time, lat, lon"),
        ("gnss.csv", "lat,lon,alt\n1,2,3\n", "no column of times among lat, lon, alt"),
        ("gnss.csv", "time,lat,lon,alt\n1,91,3,0\n", "line 2: latitude 91.0, .* within ±90"),
        ("gnss.csv", "time,lat,lon,alt\n1,1,3,\n", "line 2: alt: ''; expected a finite number"),
        ("gnss.csv", "time,lat,lon,alt\n1,1,3\n", "line 2: 3 values; expected 4"),
        ("gnss.csv", "1,1,3,5\n", "line 1: '1,1,3,5'; expected the names of the columns"),
        ("imu.csv", "time,foo\n1,2\n", "no columns ax ay az or gx gy gz among time, foo"),
        ("imu.csv", "sec,nanosec,gx,gy,gz\n1.5,500000000,0,0,0\n",
         "line 2: 1.5.* s beside a column nanosec; expected whole seconds"),
        *(("imu.csv", f"sec,nanosec,gx,gy,gz\n1,{nanoseconds},0,0,0\n",
           "line 2: nanosec: .*expected a whole number from 0 to 999999999")
          for nanoseconds in ("-1", "1000000000", "0.5", "x")),
    ],
)  # fmt: skip
def test_a_wrong_line_is_reported_with_its_number(refused, folder, file, text, problem):
    (folder / file).write_text(text)
    refused(problem, *WITH[file])


@pytest.mark.parametrize(
    ("text", "expected_ns"),
    [
        *((f"{names},gx,gy,gz\n1532402927,5,0,0,0\n1532402927,5000005,0,0,0\n",
           [1_532_402_927_000_000_005, 1_532_402_927_005_000_005])
          for names in ("sec,nanosec", "secs,nsecs", "stamp_sec,stamp_nanosec", "Seconds,Nanoseconds")),
        ("nanoseconds,gx,gy,gz\n0,0,0,0\n5000000,0,0,0\n", [0, 5_000_000]),
        # cells in quotes may hold the sign between cells
        ('t_ns, note ,gx,gy,gz\n"7", "a,b",0,0,0\n 8 ,c,0,0,0\n', [7, 8]),
    ],
)  # fmt: skip
def test_times_stand_in_one_column_or_as_seconds_and_nanoseconds(opened, folder, text, expected_ns):
    (folder / "imu.csv").write_text(text)
    assert opened(*WITH["imu.csv"]).sensor("imu").streams["gyroscope"].timestamps_ns.tolist() == expected_ns
