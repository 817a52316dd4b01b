"""What lies in and behind annotated boxes of real drives, against the numbers that come with the data."""

import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_points import count_points
from sceneloom.colouring.cuboid_projection import Observations, observe_cuboids
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    Boxes,
    CuboidAnnotation,
    CuboidPath,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    Poses,
    Scene,
)

ARGOVERSE_LOG = "real/argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def read_feather(path: Path) -> dict[str, np.ndarray]:
    """The columns of a feather file."""
    feather = pytest.importorskip("pyarrow.feather", reason="pyarrow is not installed")
    table = feather.read_table(path)
    return {name: np.asarray(table[name].to_pylist()) for name in table.column_names}


def test_points_in_the_cuboids_of_argoverse_are_as_many_as_its_annotations_state(data_dir):
    log = data_dir / ARGOVERSE_LOG
    rows, trajectories = (read_feather(log / "annotations.feather"), read_feather(log / "city_SE3_egovehicle.feather"))
    sweeps = sorted((log / "sensors" / "lidar").glob("*.feather"))
    times = np.array([int(path.stem) for path in sweeps])
    frames = []
    for time_ns, path in zip(times, sweeps, strict=True):
        columns = read_feather(path)
        positions = np.column_stack([columns[axis] for axis in "xyz"]).astype(np.float32)
        frames.append(LidarFrame(int(time_ns), LidarPoints(positions)))
    order = np.argsort(trajectories["timestamp_ns"])
    path = Poses(
        trajectories["timestamp_ns"][order].astype(np.int64),
        np.column_stack([trajectories[f"t{axis}_m"] for axis in "xyz"])[order],
        np.column_stack([trajectories[f"q{axis}"] for axis in "xyzw"])[order],
    )
    lidar = LidarSensor("lidar", LazyFrames.of(frames, times), poses=path, points_frame=PointsFrame.SENSOR)
    cuboids, stated = [], {}
    for k in np.flatnonzero(np.isin(rows["timestamp_ns"], times)):
        time_ns = int(rows["timestamp_ns"][k])
        pose = path.interpolate(np.array([time_ns]))
        world_from_ego = Rotation.from_quat(pose.quaternions_xyzw[0])
        ego_from_box = Rotation.from_quat([rows[f"q{axis}"][k] for axis in "xyzw"])
        center = world_from_ego.apply([rows[f"t{axis}_m"][k] for axis in "xyz"]) + pose.positions[0]
        angles = (world_from_ego * ego_from_box).as_euler("XYZ", degrees=True)
        size = [rows[f"{name}_m"][k] for name in ("length", "width", "height")]
        values = np.array([[*size, *center, *angles]])
        cuboids.append(CuboidAnnotation(int(k), CuboidPath(np.array([time_ns]), values)))
        stated[int(k)] = (int(np.flatnonzero(times == time_ns)[0]), int(rows["num_interior_pts"][k]))
    assert len(cuboids) > 100
    found = count_points(Scene((lidar,), tuple(cuboids))).lidars[0]
    away = [
        abs(int(found.counts[stated[cuboid.id][0], column]) - stated[cuboid.id][1])
        for column, cuboid in enumerate(cuboids)
    ]
    assert max(away) <= 2  # points on a face, which float32 coordinates put on one side or the other
    assert np.mean(np.array(away) == 0) > 0.9


def test_the_points_of_a_scene_of_another_writer_lie_in_its_cuboids(data_dir):
    with sceneloom.open(data_dir / "real/sfs_reference/argoverse2_2frames_cuboids.sfs") as scene:
        found = count_points(scene).lidars[0]
    assert found.there.all()
    # one point in eight was kept, so that small and far things may have lost all of theirs
    assert (found.counts > 0).any(axis=0).mean() > 0.5


def boxes_in_camera(rows: np.ndarray) -> Boxes:
    """Boxes of rows x, y, z of the centre, l, h, w, rotate about the camera's y axis."""
    x, y, z, length, height, width, rotation = rows.T
    cosine, sine, none = np.cos(rotation), np.sin(rotation), np.zeros_like(rotation)
    forward, up = np.column_stack([cosine, none, -sine]), np.column_stack([none, none - 1.0, none])
    axes = np.stack([forward, np.cross(up, forward), up], axis=2)
    return Boxes(
        tuple(range(len(rows))),
        (None,) * len(rows),
        np.column_stack([x, y, z]),
        np.column_stack([length, width, height]),
        Rotation.from_matrix(axes).as_quat(),
    )


def overlaps(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Intersection over union of boxes (N, 4), row by row."""
    low, high = np.maximum(first[:, :2], second[:, :2]), np.minimum(first[:, 2:], second[:, 2:])
    shared = np.maximum(high - low, 0.0).prod(axis=1)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (first, second)]
    return shared / (areas[0] + areas[1] - shared)


def kitti_labels(path: Path, first: int) -> list[tuple[str, np.ndarray]]:
    """Frame, and truncation, occlusion, angle, 4 of the 2D box, h w l, x y z of the bottom, rotate of each label."""
    lines = [line.split() for line in path.read_text().splitlines()]
    return [(words[0], np.array(words[first + 1 : first + 15], float)) for words in lines if words[first] != "DontCare"]


def kitti_camera_model(numbers: list[str], size: tuple[int, int]) -> tuple[Camera, np.ndarray]:
    """The camera model of P2, and where the rectified frame's origin is in its frame."""
    matrix = np.array(numbers, float).reshape(3, 4)
    shift = np.linalg.solve(matrix[:, :3], matrix[:, 3])
    (fx, _, cx), (_, fy, cy) = matrix[:2, :3]
    return Camera("pinhole", *size, fx, fy, cx, cy), shift


def seen_labels(labels: list[np.ndarray], camera_model: Camera, shift: np.ndarray) -> tuple[Observations, np.ndarray]:
    """What the camera model sees of labels, and these labels."""
    rows = np.array(labels)
    height, width, length, x, y, z, rotation = rows[:, 7:14].T
    centers = np.column_stack([x, y - height / 2, z]) + shift
    seen = observe_cuboids(
        camera_model,
        RigidTransform.identity(),
        boxes_in_camera(np.column_stack([centers, length, height, width, rotation])),
    )
    return seen, rows[seen.rows]


def test_boxes_of_kitti_in_space_lie_where_its_boxes_in_the_image_are(data_dir):
    found = []
    for path in sorted((data_dir / "real/kitti_object/label_2").glob("*.txt")):
        calib = (data_dir / "real/kitti_object/calib" / path.name).read_text().splitlines()
        (numbers,) = (line.split()[1:] for line in calib if line.startswith("P2"))
        with Image.open(data_dir / "real/kitti_object/image_2" / f"{path.stem}.png") as image:
            camera_model, shift = kitti_camera_model(numbers, image.size)
        seen, rows = seen_labels([label for _, label in kitti_labels(path, 0)], camera_model, shift)
        found.append(overlaps(seen.boxes_xyxy - 0.5, rows[:, 3:7]))
    overlap = np.concatenate(found)
    assert len(overlap) == 18
    # boxes in the image were drawn by hand around what is seen; of walking people legs stand out of the box in space
    assert overlap.mean() > 0.94
    assert np.median(overlap) > 0.96


def test_shares_cut_off_and_hidden_rise_with_the_levels_that_people_gave_in_kitti(data_dir):
    hidden, cut = defaultdict(list), defaultdict(list)
    for name in ("0000", "0006", "0010"):
        calib = (data_dir / f"real/kitti_tracking/calib/{name}.txt").read_text().splitlines()
        (numbers,) = (line.split()[1:] for line in calib if line.startswith("P2"))
        camera_model, shift = kitti_camera_model(numbers, (1242, 375))
        frames = defaultdict(list)
        for frame, label in kitti_labels(data_dir / f"real/kitti_tracking/label_02/{name}.txt", 2):
            frames[frame].append(label)
        for labels in frames.values():
            seen, rows = seen_labels(labels, camera_model, shift)
            for row, truncation, occlusion in zip(rows, seen.truncations, seen.occlusions, strict=True):
                cut[int(row[0])].append(truncation)
                hidden[int(row[1])].append(occlusion)
    means = [np.mean(hidden[level]) for level in (0, 1, 2)]
    assert means[0] < 0.15
    assert means[0] + 0.1 < means[1] < means[2] - 0.1
    assert np.mean(cut[0]) < 0.03
    assert np.mean(cut[1]) > 0.4


def test_boxes_in_the_images_of_nuscenes_are_those_that_its_tools_projected(data_dir):
    sample = json.loads((data_dir / "real/nuscenes_one_sample/infos.json").read_text())["data_list"][0]
    away, overlap = [], []
    for name, labels in sample["cam_instances"].items():
        (fx, _, cx), (_, fy, cy), _ = sample["images"][name]["cam2img"]
        camera_model = Camera("pinhole", 1600, 900, fx, fy, cx, cy)
        boxes = boxes_in_camera(np.array([label["bbox_3d"] for label in labels]))
        seen = observe_cuboids(camera_model, RigidTransform.identity(), boxes)
        expected = np.array([label["bbox"] for label in labels])[seen.rows]
        assert len(seen.rows) >= len(labels) - 1
        away.append(np.abs(seen.boxes_xyxy - 0.5 - expected).max(axis=1))
        overlap.append(overlaps(seen.boxes_xyxy - 0.5, expected))
    # these rows keep only the rotation about the camera's own axis, which is tilted by about a degree
    assert np.median(np.concatenate(away)) < 2.0
    assert np.concatenate(overlap).mean() > 0.95
