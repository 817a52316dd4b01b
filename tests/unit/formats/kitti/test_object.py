"""Frames of KITTI's object benchmark as one scene: each with its own calibration, all apart from each other."""

import numpy as np
import pytest
from PIL import Image

from sceneloom.cameras.projection import project
from sceneloom.errors import DataError
from sceneloom.formats import open_scene
from sceneloom.geometry.boxes import box_corners
from sceneloom.scene.annotations_at import cuboid_poses

CALIBRATIONS = {
    3: {"P2": "48 0 17 2.88 0 48 13 0.5 0 0 1 0.003", "T": "0.01 -0.08 -0.27"},
    7: {"P2": "60 0 20 3.5 0 60 11 0.1 0 0 1 0.002", "T": "0.02 -0.07 -0.33"},
}
R0 = "0.99995 0.01 0 -0.01 0.99995 0 0 0 1"
POINTS = np.array([[12.0, 1.5, -0.6], [20.0, -3.0, 0.4]])
LABEL = "Car 0.25 1 -1.57 5.5 6.5 20.25 18.0 1.5 1.6 4.0 1.0 1.7 12.0 0.8\n"
AROUND = "DontCare -1 -1 -10 1.00 2.00 3.00 4.00 -1 -1 -1 -1000 -1000 -1000 -10\n"


def calibration(frame):
    rows = CALIBRATIONS[frame]
    velo = "0 -1 0 {} 0 0 -1 {} 1 0 0 {}".format(*rows["T"].split())
    unit = "Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8"
    return f"P2: {rows['P2']}\nR0_rect: {R0}\nTr_velo_to_cam: {velo}\n{unit}\n\n"


@pytest.fixture
def frames(tmp_path):
    for frame, size in ((3, (36, 28)), (7, (40, 24))):
        for kind in ("calib", "label_2", "image_2", "velodyne"):
            (tmp_path / "training" / kind).mkdir(parents=True, exist_ok=True)
        (tmp_path / "training/calib" / f"{frame:06d}.txt").write_text(calibration(frame))
        (tmp_path / "training/label_2" / f"{frame:06d}.txt").write_text(LABEL + AROUND)
        Image.new("RGB", size, (frame, 0, 0)).save(tmp_path / "training/image_2" / f"{frame:06d}.png")
        np.full((4, 4), 0.1 * frame, np.float32).tofile(tmp_path / "training/velodyne" / f"{frame:06d}.bin")
    return tmp_path


def rotation():
    u, _, vt = np.linalg.svd(np.array(R0.split(), float).reshape(3, 3))
    return u @ vt


def test_each_frame_has_a_camera_model_mounting_and_labels_of_its_own_and_shares_no_world(frames):
    scene = open_scene(frames)
    assert scene.format == "kitti-object"
    for row, (frame, calibrated) in enumerate(CALIBRATIONS.items()):
        image = scene.sensor("camera2").images[row]
        projection = np.array(calibrated["P2"].split(), float).reshape(3, 4)
        camera = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ POINTS.T
        camera += np.array(calibrated["T"].split(), float)[:, None]
        homogeneous = projection @ np.vstack([rotation() @ camera, np.ones(2)])
        pixels, _ = project(image.camera, image.mount.inverse().apply(POINTS))
        np.testing.assert_allclose(pixels, (homogeneous[:2] / homogeneous[2]).T, atol=1e-9)
        assert image.rgb.shape == ((28, 36, 3), (24, 40, 3))[row]
        assert image.extras["file"] == f"image_2/{frame:06d}.png"
    assert scene.sensor("velodyne").frames.timestamps_ns.tolist() == [0, 10**9]
    assert scene.metadata["kitti"]["numbers"] == [3, 7]
    assert [n.code for n in scene.warnings] == ["frames-apart"]
    assert not scene.trajectories["frames"].positions.any()
    assert [a.id for a in scene.annotations] == ["000003.0", "000003.1", "000007.0", "000007.1"]
    car, around = scene.annotations[:2]
    stated = {a.name: a.values for a in car.attributes}
    assert stated == {"truncated": (0.25,), "occluded": (1,), "alpha": (-1.57,)}
    # the text counts from the centre of the first pixel, boxes here from the image's corner
    assert car.projections[0].boxes.tolist() == [[6.0, 7.0, 14.75, 11.5]]
    assert (around.label, around.type, around.attributes) == ("DontCare", "box_2d", ())
    assert around.path.values.tolist() == [[1.5, 2.5, 2.0, 2.0]]


def test_boxes_stand_where_the_kits_formula_puts_their_corners(frames):
    scene = open_scene(frames)
    box = next(a for a in scene.annotations if a.id == "000007.0")
    poses = cuboid_poses(box, box.path.timestamps_ns)
    found = box_corners(poses.centers_world[0], poses.sizes_lwh[0], poses.quaternions_xyzw[0])
    # corners of the kit: x along the length, y down from the bottom, rotated about y, moved to the location
    height, width, length, cosine, sine = 1.5, 1.6, 4.0, np.cos(0.8), np.sin(0.8)
    x = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * length / 2
    y = np.array([0, 0, 0, 0, -1, -1, -1, -1]) * height
    z = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * width / 2
    about_y = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    rectified = (about_y @ np.array([x, y, z])).T + np.array([1.0, 1.7, 12.0])
    camera = rectified @ rotation()
    lidar = (camera - np.array(CALIBRATIONS[7]["T"].split(), float)) @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    distances = np.linalg.norm(found[:, None] - lidar[None], axis=2)
    np.testing.assert_allclose([distances.min(axis=0), distances.min(axis=1)], 0, atol=1e-9)


def test_of_training_and_testing_the_former_is_read_and_a_frame_without_calibration_is_a_fault(frames):
    (frames / "testing/image_2").mkdir(parents=True)
    Image.new("RGB", (36, 28)).save(frames / "testing/image_2/000000.png")
    assert "other-part" in [n.code for n in open_scene(frames).warnings]
    (frames / "training/calib/000007.txt").unlink()
    with pytest.raises(DataError, match=r"calib/000007.txt: is missing; velodyne/000007.bin needs"):
        open_scene(frames)
    assert len(open_scene(frames, lenient=True).sensor("velodyne").frames) == 1
    (frames / "training/calib/000003.txt").unlink()
    with pytest.raises(DataError, match=r"without calibration: expected training/calib/000000.txt for each"):
        open_scene(frames)
