"""`sceneloom calibrate`: checks, repairs and conventions."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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
    inject,
    sensor_mount,
    simulate_street,
)


def test_a_drive_that_shows_too_little_cannot_determine_nor_refine(call, recording, tmp_path):
    outcome = call("calibrate", recording, "--check", "--visualize", tmp_path / "look")
    # eight beams and an image of 96 pixels state nothing of a quarter of a degree
    assert (outcome.code, "cannot determine" in outcome.out) == (5, True)
    assert min(path.name for path in (tmp_path / "look").iterdir()) == "edges_000000.png"
    items = json.loads(call("calibrate", recording, "--json").out)["items"]
    names = ["rotation", "translation", "focal_length", "principal_point", "time_offset", "ego_from_lidar"]
    assert [item["name"] for item in items] == names
    assert all(item["reason"] for item in items)
    outcome = call("calibrate", recording, "--refine", "-o", tmp_path / "out.sfs")
    assert (outcome.code, "cannot determine: 3 frames; expected 4 or more" in outcome.out) == (5, True)
    assert not (tmp_path / "out.sfs").exists()
    outcome = call("calibrate", recording, "--hand-eye")
    assert (outcome.code in {1, 5}, "expected" in outcome.out + outcome.err) == (True, True)


@pytest.mark.parametrize(
    ("of", "words", "code", "problem"),
    [
        ("folder", ("--visualize", "look"), 2, "--visualize does not count here"),
        ("folder", ("--camera", "front"), 2, "--camera does not count here"),
        ("folder", ("--sequence", "0009"), 2, "sequence '0009'"),
        ("folder", ("--refine", "--sequence", "0001"), 2, "no camera with images"),
        ("file", ("--check", "--conventions"), 2, "use one of them"),
        ("file", ("--drive", "."), 2, "does nothing without --conventions"),
        ("recording", ("--camera", "left"), 2, "camera0"),
        ("recording", ("--visualize", "."), 1, "exists already"),
        ("recording", ("--most", "1", "--det2d", "x"), 2, "--det2d does not count here"),
        ("recording", ("--most", "1", "--boxes2d", "x.jsonl"), 2, "boxes of images alone"),
        ("recording", ("--boxes2d", "x.jsonl", "--boxes3d", "y.jsonl"), 1, "x.jsonl: cannot be read"),
        ("recording", ("--lidar-to-lidar",), 2, "expected two"),
        ("recording", ("--target", "7x5:0.12:1.1x0.86"), 1, "0 views of the board; expected 3 or more"),
        ("recording", ("--target", "seven"), 2, "board 'seven'; expected COLUMNSxROWS:SQUARE"),
        ("recording", ("--refine", "--parameters", "shear"), 2, "parameters shear; expected some of rotation"),
        ("recording", ("--refine", "--hand-eye"), 2, "--refine and --hand-eye: use one of them"),
        ("recording", ("-o", "x.json"), 2, "--output: needs --refine"),
        ("recording", ("--hand-eye", "--visualize", "look"), 2, "--visualize: with --check and --refine only"),
    ],
)
def test_what_a_drive_does_not_hold_or_words_do_not_mean_is_reported(
    refuses, request, tmp_path, monkeypatch, of, words, code, problem
):
    (tmp_path / "notes.txt").write_text("kept")
    monkeypatch.chdir(tmp_path)
    refuses(code, problem, "calibrate", request.getfixturevalue(of), *words)


@pytest.fixture
def folder(tmp_path):
    """A sequence laid out like KITTI's, of cars as high as long; images are rotated by 2 degrees about y."""
    generator, rotation = np.random.default_rng(4), Rotation.from_rotvec([0.0, 2.0, 0.0], degrees=True)
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    lines_2d, lines_3d = [], []
    for frame in range(20):
        for _ in range(4):
            depth = generator.uniform(12.0, 30.0)
            center = np.array([depth * generator.uniform(-0.6, 0.6), generator.uniform(0.0, 1.0), depth])
            seen = rotation.apply(center + cube)
            pixels = seen[:, :2] / seen[:, 2:] * 700.0 + [600.0, 180.0]
            corners = ",".join(f"{value:.2f}" for value in (*pixels.min(axis=0), *pixels.max(axis=0)))
            x, y, z = center + np.array([0.0, 1.0, 0.0])
            lines_2d.append(f"{frame},{corners},0.9\n")
            lines_3d.append(f"{frame},2,{corners},3.0,2.0,2.0,2.0,{x:.3f},{y:.3f},{z:.3f},0.0,0.0\n")
    texts = {
        "calib/0001.txt": "P2: 700 0 600 0 0 700 180 0 0 0 1 0\nR_rect 1 0 0 0 1 0 0 0 1\n"
        "Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0\nTr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0\n",
        "oxts/0001.txt": ("0 0" + " 0" * 28 + "\n") * 20,
        "det2d_a/Car/0001.txt": "".join(lines_2d),
        "det3d_b/Car/0001.txt": "".join(lines_3d),
    }
    for name, text in texts.items():
        (tmp_path / "kitti" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "kitti" / name).write_text(text)
    return tmp_path / "kitti"


def test_a_folder_of_lists_alone_is_judged_by_its_boxes(call, folder):
    outcome = call("calibrate", folder, "--check", "--json")
    assert outcome.code == 4, outcome.err
    (health,) = json.loads(outcome.out)
    across = next(item for item in health["items"] if item["name"] == "boxes_projection")
    # couples are known to 0.1 degrees each, and there are 80 of them
    np.testing.assert_allclose(across["values"], [0.0, 2.0], atol=0.1)
    reported = call("calibrate", folder)
    assert (reported.code, "0001: camera2 to velodyne: wrong (20 images)" in reported.out) == (4, True), reported.out


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "calib.txt"
    path.write_text("Tr_velo_to_cam: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n", "utf-8")
    return path


def test_a_file_is_reported_without_a_drive_and_known_by_one(refuses, succeeds, reported, file, tmp_path):
    outcome = succeeds("calibrate", file, "--conventions")
    assert "Tr_velo_to_cam: cannot determine" in outcome.out
    assert "--drive DRIVE" in outcome.out
    (found,) = reported("calibrate", file, "--conventions")["extrinsics"]
    assert found["possible"]["direction"] == ["camera from lidar"]
    camera = CameraSpec(Camera("pinhole", 620, 188, 360.0, 360.0, 309.5, 93.5))
    drive = simulate_street(4, frames=2, cameras=(camera,)).scene
    truth = (drive.cameras[0].mount.inverse() @ drive.lidars[0].mount).matrix[:3]
    file.write_text("Tr: " + " ".join(map(str, truth.ravel())), "utf-8")
    sceneloom.write(drive, tmp_path / "drive.sfs")
    outcome = succeeds("calibrate", file, "--conventions", "--drive", tmp_path / "drive.sfs")
    assert "Tr: decided" in outcome.out
    file.write_text("nothing", "utf-8")
    refuses(1, "no extrinsic in it", "calibrate", file, "--conventions")


@pytest.mark.slow
def test_a_file_of_a_real_drive_is_known_by_it(succeeds, file, data_dir):
    file.write_text(
        "Tr: 0.000235 -0.999944 -0.010563 0.05705 0.010449 0.010565 -0.99989 -0.07547 "
        "0.999945 0.000124 0.010451 -0.26939",
        "utf-8",
    )
    result = succeeds("calibrate", file, "--conventions", "--drive", data_dir / "recordings" / "kitti_drive")
    assert "Tr: decided" in result.out


@pytest.fixture(scope="module")
def rotated(tmp_path_factory):
    """Six frames, a few metres apart, of a camera that is stated 0.9 degrees off."""
    folder = tmp_path_factory.mktemp("rotated") / "drive"
    camera = CameraSpec(Camera("pinhole", 414, 126, 240.0, 240.0, 206.5, 62.5))
    lidar, path = LidarSpec(beams=40, steps=900), PathSpec(speeds=(10.0, 12.0))
    drive = simulate_street(5, frames=6, cameras=[camera], lidar=lidar, path=path)
    wrong = SensorFaults(rotation_deg=(0.5, -0.6, 0.4))
    sceneloom.write(inject(drive, Faults({"camera0": wrong})).scene, folder, images="png")
    return folder


def test_one_lidar_is_led_to_the_other(succeeds, tmp_path):
    corner = sensor_mount(position=(1.5, 0.6, 0.9), yaw_deg=70.0, pitch_deg=3.0, roll_deg=-4.0)
    other = LidarSpec(beams=16, steps=600, elevations_deg=(-30.0, 10.0), mount=corner)
    drive = simulate_street(3, frames=3, lidars=(LidarSpec(beams=32, steps=600), other), cameras=())
    sceneloom.write(drive.scene, tmp_path / "drive")
    out = tmp_path / "calibration.json"
    chosen = ("--onto", "lidar0", "--lidar", "lidar1")
    outcome = succeeds("calibrate", tmp_path / "drive", "--lidar-to-lidar", *chosen, "-o", out)
    assert "lidar0 from lidar1 (lidar-to-lidar): refined" in outcome.out
    assert f"wrote {out}, " in outcome.out
    assert len([entry["imuToLidar"] for entry in json.loads(out.read_text())["lidars"]]) == 2


def test_a_rotated_camera_is_refined_and_written_as_table_3(reported, rotated, tmp_path):
    out = tmp_path / "pair.json"
    report = reported("calibrate", rotated, "--refine", "--parameters", "rotation", "-o", out)
    assert (report["verdict"], report["form"], report["output"]) == ("refined", "table-3", str(out))
    rotation = np.array([report["change"][name] for name in ("pitch", "yaw", "roll")])
    # as far as injected; a pixel is a quarter of a degree
    assert np.linalg.norm(rotation) == pytest.approx(np.linalg.norm([0.5, 0.6, 0.4]), abs=0.15)
    written = np.reshape(parse_json(out.read_bytes()).extrinsic_matrix, (4, 4)).T
    np.testing.assert_allclose(written, report["transform"], atol=1e-9)


@pytest.mark.slow
def test_what_computes_with_a_refined_scene_uses_the_refined_calibration(call, refuses, rotated, tmp_path):
    refined, fused = tmp_path / "refined.sfs", tmp_path / "fused.sfs"
    outcome = call("calibrate", rotated, "--refine", "--parameters", "rotation", "-o", refined, "--json")
    camera_from_lidar = np.array(json.loads(outcome.out)["transform"])
    judged = json.loads(call("calibrate", refined, "--check", "--most", "2", "--json").out)
    assert [warning["code"] for warning in judged["corrections"]] == ["correction-applied"]
    refuses(0, "camera_calibration applied: camera 'camera0'", "fuse", refined, "-o", fused)
    for path in (refined, fused):
        with sceneloom.open(path) as scene:
            lidar, camera = scene.corrected().sensor("lidar"), scene.corrected().sensor("camera0")
            at_ns = camera.images.timestamps_ns[1:2]
            samples = [sensor.poses.interpolate(at_ns) for sensor in (camera, lidar)]
        poses = [RigidTransform.from_quaternion(s.positions[0], s.quaternions_xyzw[0]) for s in samples]
        # both poses are written within 1 mm and 0.01 deg, and half a degree was injected
        np.testing.assert_allclose((poses[0].inverse() @ poses[1]).matrix, camera_from_lidar, atol=4e-3)
