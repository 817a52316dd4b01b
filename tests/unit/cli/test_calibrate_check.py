"""`sceneloom calibrate --check`: its result for people and machines, its images and its exit codes."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def test_a_drive_that_shows_too_little_cannot_determine(call, recording, tmp_path):
    outcome = call("calibrate", recording, "--check", "--visualize", tmp_path / "look")
    # eight beams and an image of 96 pixels state nothing of a quarter of a degree
    assert outcome.code == 5
    assert "cannot determine" in outcome.out
    assert min(path.name for path in (tmp_path / "look").iterdir()) == "edges_000000.png"


def test_machines_get_all_parts_with_reasons(call, recording):
    outcome = call("calibrate", recording, "--json")
    health = json.loads(outcome.out)
    names = ["rotation", "translation", "focal_length", "principal_point", "time_offset"]
    assert [item["name"] for item in health["items"]] == names
    assert all(item["reason"] for item in health["items"])


def test_unknown_sensors_and_full_folders_are_refused_at_once(call, recording, tmp_path):
    unknown = call("calibrate", recording, "--camera", "left")
    assert (unknown.code, "camera0" in unknown.err) == (2, True)
    (tmp_path / "notes.txt").write_text("kept")
    full = call("calibrate", recording, "--visualize", tmp_path)
    assert (full.code, "exists already" in full.err) == (1, True)


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
    across = next(item for item in health["items"] if item["name"] == "boxes")
    # couples are known to 0.1 degrees each, and there are 80 of them
    np.testing.assert_allclose(across["values"], [0.0, 2.0], atol=0.1)
    reported = call("calibrate", folder)
    assert (reported.code, "0001: camera2 to velodyne: wrong (20 images)" in reported.out) == (4, True), (
        reported.out
    )


@pytest.mark.parametrize(
    ("words", "code", "problem"),
    [
        (("--visualize", "look"), 2, "--visualize does not count here"),
        (("--camera", "front"), 2, "--camera does not count here"),
        (("--sequence", "0009"), 2, "sequence '0009'"),
        (("--refine", "--sequence", "0001"), 2, "no camera with images"),
    ],
)
def test_what_a_folder_of_lists_cannot_do_is_reported(call, folder, words, code, problem):
    outcome = call("calibrate", folder, *words)
    assert (outcome.code, problem in outcome.err) == (code, True), outcome.err


@pytest.mark.parametrize(
    ("words", "code", "problem"),
    [
        (("--det2d", "x"), 2, "--det2d does not count here"),
        (("--boxes2d", "x.jsonl"), 2, "boxes of images alone"),
        (("--boxes2d", "x.jsonl", "--boxes3d", "y.jsonl"), 1, "x.jsonl: cannot be read"),
    ],
)
def test_boxes_that_cannot_be_taken_are_reported(call, recording, words, code, problem):
    outcome = call("calibrate", recording, "--most", "1", *words)
    assert (outcome.code, problem in outcome.err) == (code, True), outcome.err
