"""Real clouds and images in nobody's format, described by a manifest; judged by what is known of the data."""

import json
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras import project
from sceneloom.formats.rig.template import survey


def kitti(folder: Path, path: Path, names: tuple[str, str], lidar: str, camera: str) -> dict[str, np.ndarray]:
    """Describe KITTI data that lies in another folder; gives the matrices of its calibration file."""
    lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
    numbers = {words[0].rstrip(":"): np.array(words[1:], float).reshape(3, -1) for words in lines}
    (folder / "rig.toml").write_text(f"""
ego = "velodyne"
root = "{path.parent if "raw" in str(path) else path.parent.parent}"
transforms = [
    {{ from = "velodyne", to = "camera_0", matrix = {numbers[names[0]].tolist()} }},
    {{ from = "camera_0", to = "rectified", rotation_matrix = {numbers[names[1]].tolist()} }},
]
[[sensors]]
id = "velodyne"
type = "lidar"
files = "{lidar}"
times = {{ rate_hz = 10 }}
[[sensors]]
id = "cam2"
type = "camera"
frame = "rectified"
files = "{camera}"
times = {{ rate_hz = 10 }}
camera_model = {{ P = {numbers["P2"].tolist()} }}
""")
    return numbers


def shares(folder: Path, **options: str) -> dict[str, float]:
    """Which share of all points falls into the images of each camera [%]."""
    with sceneloom.open(folder) as scene:
        report = sceneloom.fuse(scene, **options)
    return {str(camera.camera): camera.in_image_percent for camera in report.cameras}


@pytest.mark.parametrize("frame", ["000000", "000001", "000002", "000114"])
def test_kitti_frames_project_as_a_plain_matrix_product_does(drive, tmp_path, frame):
    data, names = drive("real/kitti_object"), ("Tr_velo_to_cam", "R0_rect")
    path = data / "calib" / f"{frame}.txt"
    numbers = kitti(tmp_path, path, names, f"velodyne/{frame}.bin", f"image_2/{frame}.png")
    scene = sceneloom.open(tmp_path)
    lidar, camera = scene.lidars[0], scene.cameras[0]
    points = lidar.frames[0].points
    raw = np.fromfile(data / "velodyne" / f"{frame}.bin", "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(points.positions, raw[:, :3])
    np.testing.assert_array_equal(points.intensities, np.rint(raw[:, 3].astype(float) * 255.0))

    rigid, rectify = np.vstack([numbers["Tr_velo_to_cam"], [0, 0, 0, 1]]), np.eye(4)
    rectify[:3, :3] = numbers["R0_rect"]
    homogeneous = np.column_stack([raw[:, :3].astype(float), np.ones(len(raw))])
    plane = homogeneous @ (numbers["P2"] @ rectify @ rigid).T
    front = plane[:, 2] > 0.5
    expected = plane[:, :2] / plane[:, 2:]

    pixels, visible = project(camera.camera, camera.mount.inverse().apply(points.positions))
    # the file's rotations have 12 digits; made orthonormal, pixels move by less than 1e-3
    np.testing.assert_allclose(pixels[visible & front], expected[visible & front], atol=1e-3)
    height, width = camera.images[0].rgb.shape[:2]
    inside = front & (expected >= -0.5).all(axis=1) & (expected < [width - 0.5, height - 0.5]).all(axis=1)
    assert 0.15 < visible.mean() < 0.18
    assert abs(int(visible.sum()) - int(inside.sum())) <= 2, "points on the very edge"


def test_three_kitti_sweeps_are_counted_and_paired_one_by_one(drive, tmp_path):
    path = drive("real/kitti_raw_sfnd") / "calib_2011_09_26.txt"
    kitti(tmp_path, path, ("Tr_velo_cam", "R_rect"), "velodyne/*.bin", "image_02/*.png")
    frames = sceneloom.open(tmp_path).lidars[0].frames
    counts = [file.stat().st_size // 16 for file in sorted((path.parent / "velodyne").iterdir())]
    assert [(frame.timestamp_ns, len(frame.points)) for frame in frames] == [
        (100_000_000 * k, count) for k, count in enumerate(counts)
    ]


def test_a_nuscenes_frame_opens_with_its_own_times_and_mountings(drive, tmp_path):
    data = drive("real/nuscenes_one_sample")
    (known,) = json.loads((data / "infos.json").read_text())["data_list"]
    sensors = [
        f"""[[sensors]]
id = "LIDAR_TOP"
type = "lidar"
files = "*LIDAR_TOP*.pcd.bin"
times = {{ pattern = "*__{{us}}" }}
timestamp = "end"
sweep_s = 0.05
extrinsic = {{ to = "base", matrix = {known["lidar_points"]["lidar2ego"]} }}"""
    ]
    for name, camera in known["images"].items():
        sensors.append(f"""[[sensors]]
id = "{name}"
type = "camera"
files = "*__{name}__*.jpg"
times = {{ pattern = "*__{{us}}" }}
extrinsic = {{ from = "base", matrix = {np.linalg.inv(camera["cam2ego"]).tolist()} }}
camera_model = {{ K = {camera["cam2img"]} }}""")
    (tmp_path / "rig.toml").write_text(f'root = "{data}"\n' + "\n".join(sensors))
    scene = sceneloom.open(tmp_path)
    frame = scene.lidars[0].frames[0]
    assert frame.timestamp_ns == 1_532_402_927_647_951_000 - 25_000_000
    assert set(np.unique(frame.points.rings)) == set(range(32))
    for camera in scene.cameras:
        timestamp = known["images"][camera.id]["timestamp"]
        assert camera.images.timestamps_ns[0] == round(timestamp * 1e6) * 1000
        # the calibration is rounded to float32
        np.testing.assert_allclose(camera.mount.matrix, known["images"][camera.id]["cam2ego"], atol=2e-6)
    # the data's own share is 9 to 14 %; here the ego is stationary between lidar and images
    assert all(8.0 < share < 15.0 for share in shares(tmp_path, trajectory="identity").values())


def test_pandaset_clouds_and_poses_fall_into_the_images_as_they_should(drive, tmp_path):
    data = drive("real/pandaset_scale_sample")
    text = f"""root = "{data}"
[[trajectories]]
root = "."
file = "poses.csv"
form = "csv"
[[sensors]]
id = "lidar"
type = "lidar"
frame = "base"
files = "pointcloud/*.ply"
deskewed = true
times = {{ pattern = "{{index}}", rate_hz = 10 }}
"""
    for name in ("front_camera", "front_left_camera", "back_camera"):
        location = json.loads((data / "cameras" / name / "extrinsics.json").read_text())
        model = json.loads((data / "cameras" / name / "intrinsics.json").read_text())
        text += f"""[[sensors]]
id = "{name}"
type = "camera"
files = "cameras/{name}/*.jpg"
times = {{ pattern = "{{index}}", rate_hz = 10 }}
extrinsic = {{ to = "base", translation = {location["position"]}, quaternion_wxyz = {location["heading"]} }}
camera_model = {{ fx = {model["fx"]}, fy = {model["fy"]}, cx = {model["cx"]}, cy = {model["cy"]} }}
"""
    (tmp_path / "rig.toml").write_text(text)
    lines = ["timestamp,x,y,z,qw,qx,qy,qz"]
    for frame in (1, 2):
        pose = json.loads((data / "poses" / f"{frame}.json").read_text())
        lines.append(",".join(map(str, [frame / 10, *pose["position"], *pose["heading"]])))
    (tmp_path / "poses.csv").write_text("\n".join(lines) + "\n")
    found = shares(tmp_path)
    # measured over five frames of the same drive
    for name, share in (("front_camera", 40.0), ("front_left_camera", 21.8), ("back_camera", 14.5)):
        assert found[name] == pytest.approx(share, abs=0.5)


@pytest.mark.parametrize(
    ("folder", "cameras"),
    [("kitti_object", 1), ("kitti_raw_sfnd", 1), ("nuscenes_one_sample", 6), ("pandaset_scale_sample", 3)],
)
def test_a_look_into_real_folders_finds_their_sensors(drive, folder, cameras):
    types = [sensor.type for sensor in survey(drive(f"real/{folder}")).sensors]
    assert (types.count("lidar"), types.count("camera")) == (1, cameras)
