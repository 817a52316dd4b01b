"""IMU and satellite receivers out of files with columns."""

import numpy as np
import pytest

from sceneloom.errors import DataError

from .conftest import codes

IMU = """[[sensors]]
id = "imu"
type = "imu"
file = "imu.csv"
extrinsic = { to = "base", rotation_matrix = [[0, -1, 0], [1, 0, 0], [0, 0, 1]] }
"""
GNSS = '[[sensors]]\nid = "gps"\ntype = "gnss"\nfile = "gnss.csv"\n'
CAMERA = '[[sensors]]\nid = "front"'


@pytest.fixture
def with_motion(folder):
    (folder / "imu.csv").write_text(
        "t_us,ax,ay,az,gyro_x,gyro_y,gyro_z\n1000000,1,0,9.8,90,0,0\n1010000,0,2,9.8,0,90,0\n"
    )
    (folder / "gnss.csv").write_text("time lat lon alt hacc\n2 48.1 11.5 520.5 1.5\n1 48.0 11.6 520 2\n")
    return folder


def test_values_are_converted_to_the_axes_of_the_ego(opened, with_motion):
    scene = opened((CAMERA, f'{IMU}gyroscope_unit = "deg/s"\n' + CAMERA))
    imu = scene.sensor("imu")
    assert imu.streams["accelerometer"].timestamps_ns.tolist() == [1_000_000_000, 1_010_000_000]
    np.testing.assert_allclose(imu.streams["accelerometer"].values, [[0, 1, 9.8], [-2, 0, 9.8]], atol=1e-12)
    np.testing.assert_allclose(imu.streams["gyroscope"].values, [[0, np.pi / 2, 0], [-np.pi / 2, 0, 0]], atol=1e-12)


def test_an_imu_that_is_not_at_the_ego_is_remarked(opened, with_motion):
    scene = opened((CAMERA, IMU.replace("rotation_matrix", "translation = [1, 0, 0], rotation_matrix") + CAMERA))
    assert "imu-lever-arm" in codes(scene)


def test_fixes_are_read_and_sorted(opened, with_motion):
    scene = opened((CAMERA, GNSS + CAMERA))
    gnss = scene.sensor("gps")
    assert gnss.timestamps_ns.tolist() == [1_000_000_000, 2_000_000_000]
    assert gnss.positions_lla.tolist() == [[48.0, 11.6, 520.0], [48.1, 11.5, 520.5]]
    assert gnss.accuracies.tolist() == [2.0, 1.5]
    assert np.isnan(gnss.vertical_accuracies).all()
    assert "samples-sorted" in codes(scene)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("time,lat,lon\n1,2,3\n", "no column for altitude among time, lat, lon"),
        ("lat,lon,alt\n1,2,3\n", "no column of times among lat, lon, alt"),
        ("time,lat,lon,alt\n1,91,3,0\n", "line 2: latitude 91.0, .* within ±90"),
        ("time,lat,lon,alt\n1,1,3,\n", "line 2: alt: ''; expected a finite number"),
        ("time,lat,lon,alt\n1,1,3\n", "line 2: 3 values; expected 4"),
        ("1,1,3,5\n", "line 1: '1,1,3,5'; expected the names of the columns"),
    ],
)
def test_a_wrong_file_is_reported_with_its_line(refused, with_motion, text, problem):
    (with_motion / "gnss.csv").write_text(text)
    refused(problem, (CAMERA, GNSS + CAMERA))


def test_an_imu_needs_columns_of_values(refused, with_motion):
    (with_motion / "imu.csv").write_text("time,foo\n1,2\n")
    refused("no columns ax ay az or gx gy gz among time, foo", (CAMERA, IMU + CAMERA))


def imu_times(opened, folder, text):
    (folder / "imu.csv").write_text(text)
    return opened((CAMERA, IMU + CAMERA)).sensor("imu").streams["gyroscope"].timestamps_ns.tolist()


@pytest.mark.parametrize("names", ["sec,nanosec", "secs,nsecs", "stamp_sec,stamp_nanosec", "Seconds,Nanoseconds"])
def test_seconds_and_nanoseconds_in_two_columns_are_added_up(opened, with_motion, names):
    times = imu_times(opened, with_motion, f"{names},gx,gy,gz\n1532402927,5,0,0,0\n1532402927,5000005,0,0,0\n")
    assert times == [1_532_402_927_000_000_005, 1_532_402_927_005_000_005]


def test_a_column_that_is_called_nanoseconds_holds_them(opened, with_motion):
    assert imu_times(opened, with_motion, "nanoseconds,gx,gy,gz\n0,0,0,0\n5000000,0,0,0\n") == [0, 5_000_000]


@pytest.mark.parametrize("nanoseconds", ["-1", "1000000000", "0.5", "x"])
def test_what_is_no_part_of_a_second_is_refused(opened, with_motion, nanoseconds):
    with pytest.raises(DataError, match=r"line 2: nanosec: .*expected a whole number from 0 to 999999999"):
        imu_times(opened, with_motion, f"sec,nanosec,gx,gy,gz\n1,{nanoseconds},0,0,0\n")


def test_seconds_that_hold_their_parts_already_are_no_whole_ones(opened, with_motion):
    with pytest.raises(DataError, match=r"line 2: 1.5.* s beside a column nanosec; expected whole seconds"):
        imu_times(opened, with_motion, "sec,nanosec,gx,gy,gz\n1.5,500000000,0,0,0\n")


def test_cells_in_quotes_may_hold_the_sign_between_cells(opened, with_motion):
    assert imu_times(opened, with_motion, 't_ns, note ,gx,gy,gz\n"7", "a,b",0,0,0\n 8 ,c,0,0,0\n') == [7, 8]
