"""Folders of the EuRoC layout, made here after the published description and the header lines of its files."""

import numpy as np
import pytest
from PIL import Image

from sceneloom.errors import DataError, OptionError, UnknownFormatError, UnknownOptionError
from sceneloom.formats.base.registry import find_format, open_scene, write_scene
from sceneloom.scene import CameraSensor, ImuSensor, PointsSensor

T0 = 1_403_636_579_763_555_584
STEP = 50_000_000
CAMERA = """%YAML:1.0
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02,
         1.0, 0.0, 0.0, -0.06,
         0.0, 0.0, 1.0, 0.01,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [8, 6]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
IMU = """%YAML:1.0
sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, 0,  1, 0, 0, 0,  0, 0, 1, 0,  0, 0, 0, 1]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04
"""
TRAJECTORY = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n"
)


def write_drive(tmp_path):
    mav = tmp_path / "MH_01" / "mav0"
    for name in ("cam0", "imu0", "state_groundtruth_estimate0", "leica0", "pointcloud0"):
        (mav / name).mkdir(parents=True)
    (mav / "cam0" / "data").mkdir()
    lines = ["#timestamp [ns],filename"]
    for k in range(3):
        Image.fromarray(np.full((6, 8), 10 * k, np.uint8)).save(mav / "cam0" / "data" / f"{T0 + k * STEP}.png")
        lines.append(f"{T0 + k * STEP},{T0 + k * STEP}.png")
    (mav / "cam0" / "data.csv").write_text("\r\n".join(lines) + "\r\n")
    (mav / "cam0" / "sensor.yaml").write_text(CAMERA)
    names = [f"{name}_RS_S_{axis} [{unit}]" for name, unit in (("w", "rad s^-1"), ("a", "m s^-2")) for axis in "xyz"]
    head = ",".join(["#timestamp [ns]", *names])
    rows = [f"{T0 + k * 5_000_000},1.0,2.0,3.0,9.8,{k}.5,-0.25" for k in range(4)]
    (mav / "imu0" / "data.csv").write_text("\n".join([head, *rows, ""]))
    (mav / "imu0" / "sensor.yaml").write_text(IMU)
    poses = [f"{T0 + k * STEP},{k}.0,2.0,0.5,1,0,0,0,0,0,0,0,0,0,0,0,0" for k in range(3)]
    (mav / "state_groundtruth_estimate0" / "data.csv").write_text(TRAJECTORY + "\n".join(poses) + "\n")
    spots = [f"{T0 + k * STEP},{k}.25,1.0,2.0" for k in range(2)]
    head = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]"
    (mav / "leica0" / "data.csv").write_text("\n".join([head, *spots]))
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (mav / "pointcloud0" / "data.ply").write_text(f"{head}1 2 3\n4 5 6\n")
    return mav.parent


@pytest.fixture
def drive(tmp_path):
    return write_drive(tmp_path)


def test_a_drive_is_read_whole_images_and_inertial_values_in_the_axes_of_the_body(drive):
    with open_scene(drive) as scene:
        assert scene.format == "euroc-mav"
        found = [(type(one), one.id) for one in scene.sensors]
        assert found == [(CameraSensor, "cam0"), (ImuSensor, "imu0"), (PointsSensor, "pointcloud0")]
        assert list(scene.trajectories) == ["groundTruth", "leica0"]
        assert scene.trajectories["leica0"].quaternions_xyzw is None
        assert {warning.code for warning in scene.warnings} == {"states-not-read"}
        camera, imu = scene.sensor("cam0"), scene.sensor("imu0")
        assert camera.images.timestamps_ns.tolist() == [T0, T0 + STEP, T0 + 2 * STEP]
        assert camera.images[2].rgb.tolist() == np.full((6, 8, 3), 20).tolist()
    assert (camera.camera.model, camera.camera.fx, camera.camera.cy, camera.fps) == (
        "brown_conrady", 458.654, 248.375, 20.0,
    )  # fmt: skip
    assert camera.camera.coefficients == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    # T_BS takes the sensor's x axis to the body's y axis
    np.testing.assert_allclose(camera.mount.apply(np.array([1.0, 0.0, 0.0])), [-0.02, 0.94, 0.01])
    np.testing.assert_allclose(camera.poses.positions, [[-0.02, 1.94, 0.51], [0.98, 1.94, 0.51], [1.98, 1.94, 0.51]])
    assert imu.streams["gyroscope"].values[0].tolist() == [-2.0, 1.0, 3.0]
    assert imu.streams["accelerometer"].values[3].tolist() == [-3.5, 9.8, -0.25]
    assert imu.streams["accelerometer"].timestamps_ns.tolist() == [T0 + k * 5_000_000 for k in range(4)]
    assert imu.extras["noises"] == {"gyroscope_noise_density": 1.6968e-04}


def test_the_folder_of_the_sensors_is_the_drive_too_models_of_tum_are_fisheyes_and_trajectories_of_the_body(drive):
    text = CAMERA.replace("radial-tangential", "equidistant").replace("[8, 6]", "[16, 12]")
    (drive / "mav0" / "cam0" / "sensor.yaml").write_text(text)
    folder = drive / "mav0" / "vicon0"
    folder.mkdir()
    # a quarter rotation to the left; the marker is 1 m ahead of the body
    half = np.sqrt(0.5)
    (folder / "data.csv").write_text(TRAJECTORY[: TRAJECTORY.index(", v_RS")] + f"\n{T0},5,5,1,{half},0,0,{half}\n")
    (folder / "sensor.yaml").write_text("T_BS:\n  data: [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n")
    with open_scene(drive / "mav0") as scene:
        camera = scene.sensor("cam0").camera
        # calibrated for images of twice the size
        assert (camera.model, camera.width, camera.fx) == ("fisheye", 8, 458.654 / 2)
        np.testing.assert_allclose(scene.trajectories["vicon0"].positions, [[5.0, 4.0, 1.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("file", "change", "problem"),
    [
        ("cam0/sensor.yaml", ("intrinsics", "intrinsic"), "list of numbers"),
        ("cam0/sensor.yaml", ("radial-tangential", "mystery"), "mystery"),
        ("cam0/sensor.yaml", ("[0.0, -1.0, 0.0, -0.02", "[0.5, -1.0, 0.0, -0.02"), "rotation"),
        ("cam0/sensor.yaml", ("rate_hz: 20", "rate 20"), "key: value"),
        ("cam0/data.csv", (f"{T0}.png", "../x.png"), "name of a file"),
        ("cam0/data.csv", (f"{T0 + STEP},", f"{T0},"), "twice"),
        ("cam0/data.csv", (f"{T0}.png", "none.png"), "none.png"),
        ("imu0/data.csv", (",9.8,0.5,-0.25", ",9.8,x,-0.25"), "finite number"),
    ],
)
def test_what_is_wrong_is_reported_with_its_location(drive, file, change, problem):
    path = drive / "mav0" / file
    before = path.read_text()
    assert change[0] in before
    path.write_text(before.replace(*change, 1))
    with pytest.raises(DataError, match=problem):
        open_scene(drive)


def test_half_folders_and_writing_are_refused(tmp_path, drive):
    (tmp_path / "empty" / "mav0").mkdir(parents=True)
    with pytest.raises(UnknownFormatError, match=r"neither mav0/cam0/data\.csv"):
        open_scene(tmp_path / "empty")
    assert find_format(drive).name == "euroc-mav"
    with open_scene(drive) as scene, pytest.raises(OptionError, match="only read"):
        write_scene(scene, tmp_path / "o", format="euroc-mav")
    with pytest.raises(UnknownOptionError):
        open_scene(drive, altitude="msl")
    (drive / "mav0" / "cam0" / "sensor.yaml").unlink()
    with pytest.raises(DataError, match="missing"):
        open_scene(drive)


@pytest.mark.parametrize("left", [0, 1])
def test_a_lenient_reading_leaves_out_images_that_are_not_there(drive, left):
    for file in sorted((drive / "mav0" / "cam0" / "data").iterdir())[left:]:
        file.unlink()
    with open_scene(drive, lenient=True) as scene:
        assert [image.rgb.shape[2] for image in scene.cameras[0].images] == [3] * left
        assert [one.count for one in scene.warnings if one.code == "files-missing"] == [3 - left]
