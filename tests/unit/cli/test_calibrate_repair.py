"""`sceneloom calibrate --refine`, `--hand-eye`, `--lidar-to-lidar`, `--target`: what is printed and written."""

import json
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.json import parse_json
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import (
    CameraSpec,
    Faults,
    LidarSpec,
    PathSpec,
    SensorFaults,
    plant,
    sensor_mount,
    simulate_street,
)

BOARD = "7x5:0.12:1.1x0.86"


@pytest.fixture(scope="module")
def rotated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames, a few metres apart, of a camera that is stated 0.9 degrees off."""
    folder = tmp_path_factory.mktemp("rotated") / "drive"
    camera_model = Camera("pinhole", 414, 126, 240.0, 240.0, 206.5, 62.5)
    drive = simulate_street(
        5,
        frames=6,
        cameras=[CameraSpec(camera_model)],
        lidar=LidarSpec(beams=40, steps=900),
        path=PathSpec(speeds=(10.0, 12.0)),
    )
    wrong = SensorFaults(rotation_deg=(0.5, -0.6, 0.4))
    sceneloom.write(plant(drive, Faults({"camera0": wrong})).scene, folder, images="png")
    return folder


@pytest.fixture(scope="module")
def two_lidars(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sweeps of two coarse lidars."""
    corner = sensor_mount(position=(1.5, 0.6, 0.9), yaw_deg=70.0, pitch_deg=3.0, roll_deg=-4.0)
    lidars = (
        LidarSpec(beams=32, steps=600),
        LidarSpec(beams=16, steps=600, elevations_deg=(-30.0, 10.0), mount=corner),
    )
    folder = tmp_path_factory.mktemp("two") / "drive"
    camera = CameraSpec(Camera("pinhole", 32, 32, 30.0, 30.0, 15.5, 15.5))
    drive = simulate_street(3, frames=3, lidars=lidars, cameras=(camera,))
    sceneloom.write(drive.scene, folder, images="png")
    return folder


def test_a_rotated_camera_is_refined_and_written_as_table_3(call, rotated, tmp_path):
    out = tmp_path / "pair.json"
    outcome = call("calibrate", rotated, "--refine", "--parameters", "rotation", "-o", out, "--json")
    assert outcome.code == 0, outcome.out
    report = json.loads(outcome.out)
    assert (report["verdict"], report["form"], report["output"]) == ("refined", "table-3", str(out))
    rotation = np.array([report["change"][name] for name in ("pitch", "yaw", "roll")])
    # as far as injected; a pixel is a quarter of a degree
    assert np.linalg.norm(rotation) == pytest.approx(np.linalg.norm([0.5, 0.6, 0.4]), abs=0.15)
    written = np.reshape(parse_json(out.read_bytes()).extrinsic_matrix, (4, 4)).T
    np.testing.assert_allclose(written, report["transform"], atol=1e-9)


@pytest.mark.slow
def test_what_computes_with_a_refined_scene_uses_the_refined_calibration(call, rotated, tmp_path):
    refined, fused = tmp_path / "refined.sfs", tmp_path / "fused.sfs"
    outcome = call("calibrate", rotated, "--refine", "--parameters", "rotation", "-o", refined, "--json")
    camera_from_lidar = np.array(json.loads(outcome.out)["transform"])
    judged = json.loads(call("calibrate", refined, "--check", "--most", "2", "--json").out)
    assert [warning["code"] for warning in judged["corrections"]] == ["correction-applied"]
    reported = call("fuse", refined, "-o", fused)
    assert (reported.code, "camera_calibration applied: camera 'camera0'" in reported.err) == (0, True)
    for path, expected in ((refined, camera_from_lidar), (fused, camera_from_lidar)):
        with sceneloom.open(path) as scene:
            lidar, camera = scene.corrected().sensor("lidar"), scene.corrected().sensor("camera0")
            at_ns = camera.images.timestamps_ns[1:2]
            camera_pose, lidar_pose = (path.interpolate(at_ns) for path in (camera.poses, lidar.poses))
        found = pose_of(camera_pose).inverse() @ pose_of(lidar_pose)
        # both poses are written within 1 mm and 0.01 deg, and half a degree was injected
        np.testing.assert_allclose(found.matrix, expected, atol=4e-3)


def pose_of(samples):
    return RigidTransform.from_quaternion(samples.positions[0], samples.quaternions_xyzw[0])


def test_what_cannot_be_refined_is_reported_and_not_written(call, recording, tmp_path):
    outcome = call("calibrate", recording, "--refine", "-o", tmp_path / "out.sfs")
    assert outcome.code == 5
    assert "cannot determine: 3 frames; expected 4 or more" in outcome.out
    assert not (tmp_path / "out.sfs").exists()


def test_one_lidar_is_led_to_the_other(call, two_lidars, tmp_path):
    out = tmp_path / "calibration.json"
    outcome = call(
        "calibrate", two_lidars, "--lidar-to-lidar", "--onto", "lidar0", "--lidar", "lidar1", "-o", out
    )
    assert outcome.code == 0, outcome.err
    assert "lidar0 from lidar1 (lidar-to-lidar): refined" in outcome.out
    assert f"written as recording: {out}" in outcome.out
    mountings = [entry["imuToLidar"] for entry in json.loads(out.read_text())["lidars"]]
    assert len(mountings) == 2


def test_a_single_lidar_has_no_other_to_be_led_to(call, recording):
    outcome = call("calibrate", recording, "--lidar-to-lidar")
    assert outcome.code == 2
    assert "expected two" in outcome.err


def test_three_sweeps_are_too_few_to_report_a_mounting_from_motion(call, recording):
    outcome = call("calibrate", recording, "--hand-eye")
    assert outcome.code in {1, 5}
    assert "expected" in outcome.out + outcome.err


def test_a_drive_without_a_board_has_no_views_of_it(call, recording):
    outcome = call("calibrate", recording, "--target", BOARD)
    assert outcome.code == 1
    assert "0 views of the board; expected 3 or more" in outcome.err


@pytest.mark.parametrize(
    ("words", "stated"),
    [
        (("--target", "seven"), "board 'seven'; expected COLUMNSxROWS:SQUARE"),
        (("--refine", "--parameters", "shear"), "parameters shear; expected some of rotation"),
        (("--refine", "--hand-eye"), "--refine and --hand-eye: state one of them"),
        (("-o", "x.json"), "--output: needs --refine"),
        (("--hand-eye", "--visualize", "look"), "--visualize: with --check and --refine only"),
    ],
)
def test_words_that_mean_nothing_together_are_refused(call, recording, words, stated):
    outcome = call("calibrate", recording, *words)
    assert (outcome.code, stated in outcome.err) == (2, True), outcome.err
