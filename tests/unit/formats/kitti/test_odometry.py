"""Sequences of KITTI's odometry benchmark as scenes, and SemanticKITTI's labels with them."""

import shutil

import numpy as np
import pytest
from PIL import Image

from sceneloom.errors import DataError, OptionError
from sceneloom.formats import open_scene
from sceneloom.formats.base.registry import drives_of
from sceneloom.geometry.rigid import rotate_vectors
from sceneloom.scene.poses import PoseSource

TR = np.array([[0, -1, 0, 0.01], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
POSES = np.stack([np.eye(4), np.eye(4)])
POSES[1, :3, :3] = [[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]]
POSES[1, :3, 3] = 0.05, -0.02, 1.3
CALIBRATION = (
    "P0: 48 0 17 0 0 48 13 0 0 0 1 0\nP2: 48 0 17 2.88 0 48 13 0.5 0 0 1 0.003\n"
    f"Tr: {' '.join(map(str, TR[:3].reshape(-1)))}\n"
)
LABELS = np.array([40, 10 | 5 << 16, 10 | 5 << 16, 0, 777], np.uint32)


def rows(matrices):
    return "".join(" ".join(map(repr, matrix[:3].reshape(-1).tolist())) + "\n" for matrix in matrices)


@pytest.fixture
def root(tmp_path):
    folder = tmp_path / "sequences/04"
    for kind in ("velodyne", "image_2", "labels"):
        (folder / kind).mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    (folder / "calib.txt").write_text(CALIBRATION)
    (folder / "times.txt").write_text("0.000000000\n1.037360001e-01\n")
    (tmp_path / "poses/04.txt").write_text(rows(POSES))
    for k in range(2):
        np.arange(20, dtype=np.float32).reshape(5, 4).tofile(folder / "velodyne" / f"{k:06d}.bin")
        Image.new("RGB", (36, 28)).save(folder / "image_2" / f"{k:06d}.png")
        LABELS.tofile(folder / "labels" / f"{k:06d}.label")
    return tmp_path


@pytest.mark.parametrize("location", ["", "sequences", "sequences/04"])
def test_a_sequence_is_found_from_every_folder_and_its_points_where_poses_of_the_camera_put_them(root, location):
    scene = open_scene(root / location)
    assert (scene.format, list(scene.trajectories)) == ("kitti-odometry", ["groundTruth"])
    assert scene.sensor("camera2").images.timestamps_ns.tolist() == [0, 103_736_000]
    lidar, point = scene.sensor("velodyne"), np.array([7.0, 1.0, -1.5, 1.0])
    source = PoseSource(scene.trajectories["groundTruth"].poses, lidar.mount)
    at = source.at(lidar.frames.timestamps_ns)
    found = rotate_vectors(at.quaternions_xyzw, np.tile(point[:3], (2, 1))) + at.positions
    # the world is the lidar's first frame: back from the first camera's
    expected = [(np.linalg.inv(TR) @ pose @ TR @ point)[:3] for pose in POSES]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_labels_are_points_of_classes_and_objects_unless_they_are_left_aside(root):
    (root / "sequences/04/voxels").mkdir()
    scene = open_scene(root)
    found = {a.id: a for a in scene.annotations}
    assert set(found) == {"road", "car 5", "777"}
    car = found["car 5"]
    assert (car.label, car.is_instance, found["road"].is_instance) == ("car", True, False)
    assert [part.sensor_frame for part in car.labeled_points] == [0, 1]
    assert car.labeled_points[0].point_ids.tolist() == [1, 2]
    assert found["777"].label == "777"
    assert "unknown-classes" in [n.code for n in scene.warnings]
    scene = open_scene(root, labels="skip")
    assert scene.annotations == ()
    reported = {n.code: n for n in scene.warnings}
    assert (reported["labels-aside"].count, reported["not-read"].message) == (2, "voxels not read")
    with pytest.raises(OptionError, match=r"labels 'no'; expected one of read, skip"):
        open_scene(root, labels="no")


def test_without_a_lidar_the_ego_is_camera_0_rotated_to_look_ahead(root):
    for kind in ("velodyne", "labels"):
        shutil.rmtree(root / "sequences/04" / kind)
    (root / "sequences/04/calib.txt").write_text(CALIBRATION.split("Tr", maxsplit=1)[0])
    trajectory = open_scene(root).trajectories["groundTruth"]
    # 1.3 m along the camera's axis is 1.3 m ahead, its x to the right, its y down
    np.testing.assert_allclose(trajectory.positions[1], [1.3, -0.05, 0.02], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("sequences/04/times.txt", "0\n", "2 files up to number 1 for 1 times"),
        ("sequences/04/times.txt", "0\n1\n2\n", "3 times, and the last file has number 1"),
        ("sequences/04/times.txt", "1\n0\n", "line 2: is not later than the line before"),
        ("poses/04.txt", rows(POSES[:1]), "1 poses for 2 times; expected as many"),
        ("poses/04.txt", "1 2 3\n", "line 1: 3 values; expected 12"),
        ("poses/04.txt", "2 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "line 1: a rotation off by"),
        ("sequences/04/calib.txt", "P2: 48 0 17 0 0 48 13 0 0 0 1 0\n", "no Tr_velo_cam"),
        ("sequences/04/labels/000001.label", "abc", "3 bytes for the 5 points of the sweep; expected 20"),
    ],
)
def test_a_fault_is_reported_with_its_location(root, name, text, problem):
    (root / name).write_text(text)
    with pytest.raises(DataError) as caught:
        open_scene(root)
    assert problem in str(caught.value)


def test_each_sequence_is_a_drive_and_one_or_a_calibration_that_is_not_there_is_reported(root):
    assert drives_of(root) == ()
    shutil.copytree(root / "sequences/04", root / "sequences/06")
    assert drives_of(root) == (root / "sequences/04", root / "sequences/06")
    shutil.rmtree(root / "sequences/06")
    with pytest.raises(OptionError, match=r"sequence '05': .* has 04"):
        open_scene(root, sequence="05")
    (root / "sequences/04/calib.txt").unlink()
    with pytest.raises(DataError, match=r"calib.txt: is missing; expected P0 to P3, and Tr"):
        open_scene(root)
