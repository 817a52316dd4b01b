"""Sequences of KITTI-360, built to its documentation; what is expected follows the formulas of its public scripts."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras.projection import project
from sceneloom.errors import DataError, OptionError
from sceneloom.scene.annotations_at import CuboidAngles

NAME = "2013_05_28_drive_0000_sync"
CAM_TO_POSE = np.array(
    [[0.0372, -0.0986, 0.9944, 1.5753], [0.9993, -0.0054, -0.0379, 0.0044], [0.0091, 0.9951, 0.0983, -0.65]]
)
CAM_TO_VELO = np.array(
    [[0.0431, -0.0884, 0.9951, 0.8044], [-0.9990, 0.0078, 0.0439, 0.2993], [-0.0117, -0.9960, -0.0880, -0.1770]]
)
RECT = Rotation.from_euler("xyz", [0.4, -0.7, 0.1], degrees=True).as_matrix()
P = np.array([[55.2, 0.0, 32.0, 0.0], [0.0, 55.2, 12.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
MEI = {
    "xi": 2.2134,
    "k1": 0.0168,
    "k2": 1.6548,
    "p1": 0.0004,
    "p2": 0.0004,
    "gamma1": 133.6,
    "gamma2": 133.5,
    "u0": 35.0,
    "v0": 34.0,
}
FRAMES = [1, 2, 3]


def rigid(matrix):
    found = np.eye(4)
    u, _, vt = np.linalg.svd(matrix[:, :3])
    found[:3, :3], found[:3, 3] = u @ vt, matrix[:, 3]
    return found


def pose(frame):
    """GPS/IMU to world: x ahead, y right, z down, as it drives a bend."""
    found = np.eye(4)
    turned = Rotation.from_euler("ZYX", [0.3 + 0.02 * frame, 0.01, 0.02]) * Rotation.from_euler("x", np.pi)
    found[:3, :3], found[:3, 3] = turned.as_matrix(), [1200.0 + frame, 3700.0 + 0.1 * frame, 115.0]
    return found


def words(values):
    return " ".join(f"{value:.10e}" for value in np.ravel(values))


def stamps(folder, after_us):
    lines = [f"2013-05-28 08:46:{2 + (100_000 * k + after_us) / 1e6:012.9f}" for k in range(5)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")


def box(number, semantic, instance, frame, turned, center, size):
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turned.as_matrix() * size, center
    corners = [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]

    def matrix(name, values):
        rows, columns = np.shape(values)
        sizes = f"<rows>{rows}</rows><cols>{columns}</cols><dt>f</dt>"
        return f'<{name} type_id="opencv-matrix">{sizes}<data>{words(values)}</data></{name}>'

    head = {"index": number, "label": "x", "semanticId": semantic, "instanceId": instance, "category": "v"}
    head |= {"timestamp": frame, "dynamic": int(frame >= 0), "start_frame": 1, "end_frame": 3}
    texts = "".join(f"<{name}>{value}</{name}>" for name, value in head.items())
    return f"<object{number}>{texts}{matrix('transform', transform)}{matrix('vertices', corners)}</object{number}>"


STATIC = Rotation.from_euler("z", 0.7), [1210.0, 3702.0, 114.0], np.array([30.0, 12.0, 9.0])
MOVING = {
    frame: (Rotation.from_euler("z", 0.1 * frame), [1205.0 + frame, 3701.0, 113.5], np.array([4.4, 1.8, 1.5]))
    for frame in (1, 2)
}


def write_data(root):
    calibration = root / "calibration"
    calibration.mkdir(parents=True)
    lines = [f"image_{k:02d}: {words(CAM_TO_POSE)}" for k in range(4)]
    (calibration / "calib_cam_to_pose.txt").write_text("\n".join(lines) + "\n")
    (calibration / "calib_cam_to_velo.txt").write_text(words(CAM_TO_VELO))
    lines = ["calib_time: 29-May-2013"]
    for k in range(2):
        lines += [f"S_rect_{k:02d}: 64 24", f"R_rect_{k:02d}: {words(RECT)}", f"P_rect_{k:02d}: {words(P)}"]
    (calibration / "perspective.txt").write_text("\n".join(lines) + "\n")
    groups = {"mirror_parameters": ["xi"], "distortion_parameters": ["k1", "k2", "p1", "p2"]}
    groups |= {"projection_parameters": ["gamma1", "gamma2", "u0", "v0"]}
    text = "%YAML:1.0\n---\nmodel_type: MEI\ncamera_name: image_02\nimage_width: 70\nimage_height: 68\n"
    for group, names in groups.items():
        text += f"{group}:\n" + "".join(f"   {name}: {MEI[name]}\n" for name in names)
    (calibration / "image_02.yaml").write_text(text)
    for number, (data, size) in {0: ("data_rect", (64, 24)), 2: ("data_rgb", (70, 68))}.items():
        folder = root / "data_2d_raw" / NAME / f"image_{number:02d}"
        stamps(folder, 1000 * number)
        (folder / data).mkdir()
        for frame in FRAMES:
            Image.new("RGB", size, (50 * frame, 0, 10 * number)).save(folder / data / f"{frame:010d}.png")
    folder = root / "data_3d_raw" / NAME / "velodyne_points"
    stamps(folder, 20_000)
    (folder / "data").mkdir()
    for frame in FRAMES:
        cloud(frame).tofile(folder / "data" / f"{frame:010d}.bin")
    poses = root / "data_poses" / NAME
    poses.mkdir(parents=True)
    (poses / "poses.txt").write_text("".join(f"{frame} {words(pose(frame)[:3])}\n" for frame in (0, *FRAMES, 4)))
    (root / "data_3d_bboxes" / "train").mkdir(parents=True)
    boxes = [box(1, 11, 3, -1, *STATIC), *(box(2 + k, 13, 7, k, *MOVING[k]) for k in (2, 1))]
    boxes.append(
        box(9, 5, 0, -1, *STATIC).replace("<rows>8</rows>", "<rows>7</rows>").replace(words([0.5] * 3) + "<", "<")
    )
    text = f'<?xml version="1.0"?><opencv_storage>{"".join(boxes)}</opencv_storage>'
    (root / "data_3d_bboxes" / "train" / f"{NAME}.xml").write_text(text)
    return root


def cloud(frame):
    return np.random.default_rng(frame).uniform(0, 1, (20 + frame, 4)).astype(np.float32)


@pytest.fixture
def root(tmp_path):
    return write_data(tmp_path / "KITTI-360")


def test_cameras_and_lidar_are_where_the_scripts_place_them_in_the_world(root):
    scene = sceneloom.open(root)
    assert [sensor.id for sensor in scene.sensors] == ["velodyne", "camera0", "camera2"]
    rectified = np.eye(4)
    rectified[:3, :3] = RECT
    cam = rigid(CAM_TO_POSE)
    to_pose = {
        "camera0": cam @ np.linalg.inv(rectified),
        "camera2": cam,
        "velodyne": cam @ np.linalg.inv(rigid(CAM_TO_VELO)),
    }
    path = scene.trajectories["pose"].poses
    points = np.random.default_rng(3).uniform(-20, 20, (9, 3))
    for frame in (0, *FRAMES):  # seen from the ego, whose y is left and z up
        here = Rotation.from_quat(path.quaternions_xyzw[frame]).as_matrix()
        for name, expected in to_pose.items():
            found = scene.sensor(name).mount.apply(points) @ here.T + path.positions[frame]
            matrix = pose(frame) @ expected
            assert np.allclose(found, points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-6)
        assert here[2, 2] > 0.99
    lidar = scene.sensor("velodyne")
    assert np.array_equal(lidar.frames[1].points.positions, cloud(2)[:, :3])
    times = {
        sensor.id: (sensor.frames if sensor.id == "velodyne" else sensor.images).timestamps_ns
        for sensor in scene.sensors
    }
    assert (times["velodyne"] - times["camera0"]).tolist() == [20_000_000] * 3
    assert (times["camera2"] - times["camera0"]).tolist() == [2_000_000] * 3
    assert path.timestamps_ns[1:4].tolist() == times["camera0"].tolist()
    assert scene.sensor("camera2").images[2].rgb[0, 0].tolist() == [150, 0, 20]


def test_fisheye_images_are_projected_as_by_the_model_of_mei(root):
    camera = sceneloom.open(root).sensor("camera2").camera
    points = np.array([[0.3, -0.2, 1.0], [0.5, 0.4, 0.6], [-0.8, 0.9, 1.1]])
    unit = points / np.linalg.norm(points, axis=1)[:, None]
    x, y = unit[:, 0] / (unit[:, 2] + MEI["xi"]), unit[:, 1] / (unit[:, 2] + MEI["xi"])
    r2 = x * x + y * y
    radial = 1 + MEI["k1"] * r2 + MEI["k2"] * r2 * r2
    u = MEI["gamma1"] * (x * radial + 2 * MEI["p1"] * x * y + MEI["p2"] * (r2 + 2 * x * x)) + MEI["u0"]
    v = MEI["gamma2"] * (y * radial + 2 * MEI["p2"] * x * y + MEI["p1"] * (r2 + 2 * y * y)) + MEI["v0"]
    pixels, visible = project(camera, points)
    assert visible.all()
    assert np.allclose(pixels, np.stack([u, v], axis=1), atol=1e-6)


def test_boxes_are_in_the_world_static_ones_over_their_frames_and_moving_ones_at_theirs(root):
    scene = sceneloom.open(root)
    building, car = scene.annotations
    assert (building.id, building.label, building.stationary) == ("11003", "building", True)
    assert (car.id, car.label, car.stationary) == ("26007", "car", False)
    times = scene.sensor("camera0").images.timestamps_ns
    assert building.path.timestamps_ns.tolist() == times[[0, 2]].tolist()
    assert car.path.timestamps_ns.tolist() == times[[0, 1]].tolist()
    for row, (turned, center, size) in ((building.path.values[1], STATIC), (car.path.values[1], MOVING[2])):
        assert np.allclose(row[:3], size, atol=1e-6)
        assert np.allclose(row[3:6], center, atol=1e-6)
        found = Rotation.from_quat(CuboidAngles.of(scene).quaternions(row[6:]))
        assert (found.inv() * turned).magnitude() < 1e-6
    assert {warning.code: warning.count for warning in scene.warnings}["no-cuboids"] == 1


def test_sequences_are_chosen_by_number_and_what_is_missing_is_named(root):
    assert sceneloom.open(root, sequence="0000").metadata["kitti"]["sequence"] == NAME
    (root / "data_poses" / "2013_05_28_drive_0002_sync").mkdir()
    with pytest.raises(OptionError, match="several sequences"):
        sceneloom.open(root)
    for file in root.glob("data_*_raw/*/*/timestamps.txt"):
        file.unlink()
    scene = sceneloom.open(root, sequence=NAME)
    assert "frame-times" in {warning.code for warning in scene.warnings}
    assert scene.sensor("velodyne").frames.timestamps_ns.tolist() == [100_000_000 * frame for frame in FRAMES]
    (root / "calibration" / "image_02.yaml").unlink()
    with pytest.raises(DataError, match="expected the fisheye calibration"):
        sceneloom.open(root, sequence=NAME)
    scene = sceneloom.open(root, sequence=NAME, lenient=True)
    assert [sensor.id for sensor in scene.sensors] == ["velodyne", "camera0"]
    with pytest.raises(DataError, match="holds no sequence"):
        sceneloom.open(Path(root, "calibration"), format="kitti-360")
