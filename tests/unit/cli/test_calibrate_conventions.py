"""`sceneloom calibrate --conventions` on files and drives."""

import json

import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.simulate import CameraSpec, simulate_street

KITTI = "Tr_velo_to_cam: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n"


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "calib.txt"
    path.write_text(KITTI, "utf-8")
    return path


def test_a_file_is_reported_without_a_drive(call, file):
    result = call("calibrate", file, "--conventions")
    assert result.code == 0
    assert "Tr_velo_to_cam: cannot determine" in result.out
    assert "--drive DRIVE" in result.out


def test_a_file_is_reported_as_json(call, file):
    result = call("calibrate", file, "--conventions", "--json")
    (found,) = json.loads(result.out)["extrinsics"]
    assert found["possible"]["direction"] == ["camera from lidar"]


def test_a_file_is_known_by_a_drive(call, file, tmp_path):
    camera = CameraSpec(Camera("pinhole", 620, 188, 360.0, 360.0, 309.5, 93.5))
    drive = simulate_street(4, frames=2, cameras=(camera,)).scene
    truth = (drive.cameras[0].mount.inverse() @ drive.lidars[0].mount).matrix[:3]
    file.write_text("Tr: " + " ".join(map(str, truth.ravel())), "utf-8")
    sceneloom.write(drive, tmp_path / "drive.sfs")
    result = call("calibrate", file, "--conventions", "--drive", tmp_path / "drive.sfs")
    assert result.code == 0
    assert "Tr: decided" in result.out


@pytest.mark.slow
def test_a_file_of_a_real_drive_is_known_by_it(call, file, data_dir):
    file.write_text(
        "Tr: 0.000235 -0.999944 -0.010563 0.05705 0.010449 0.010565 -0.99989 -0.07547 "
        "0.999945 0.000124 0.010451 -0.26939",
        "utf-8",
    )
    result = call("calibrate", file, "--conventions", "--drive", data_dir / "recordings" / "kitti_drive")
    assert result.code == 0
    assert "Tr: decided" in result.out


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["--check", "--conventions"], "state one of them"),
        (["--drive", "."], "does nothing without --conventions"),
    ],
)
def test_options_that_state_nothing_together_are_refused(call, file, words, reported):
    result = call("calibrate", file, *words)
    assert result.code == 2
    assert reported in result.err


def test_a_file_without_an_extrinsic_ends_with_one_line(call, tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("nothing", "utf-8")
    result = call("calibrate", path, "--conventions")
    assert result.code == 1
    assert "no extrinsic in it" in result.err
