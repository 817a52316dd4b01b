"""Folders of public driving data, as their authors publish them, against the numbers that come with them."""

import json

import numpy as np
import pytest
from tests.unit.formats.nuscenes.schema_folder import from_infos

import sceneloom
from sceneloom.cameras import project
from sceneloom.colouring.cuboid_points import count_points
from sceneloom.geometry.rigid import RigidTransform

ARGOVERSE = "real/argoverse2"


def test_points_in_the_cuboids_of_an_argoverse_log_are_as_many_as_it_says(data_dir):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    scene = sceneloom.open(data_dir / ARGOVERSE)
    found = count_points(scene).lidars
    assert [lidar.id for lidar in scene.lidars] == ["up_lidar", "down_lidar"]
    away = []
    for column, cuboid in enumerate(scene.annotations):
        for k, timestamp in enumerate(scene.lidars[0].frames.timestamps_ns):
            row = np.flatnonzero(cuboid.path.timestamps_ns == timestamp)
            if len(row):
                counted = sum(int(lidar.counts[k, column]) for lidar in found)
                away.append(abs(counted - cuboid.attributes[0].values[int(row[0])]))
    assert len(away) > 100
    assert max(away) <= 2  # points on a face, which float32 coordinates put on one side or the other


def test_the_lasers_of_an_argoverse_lidar_keep_their_elevation_seen_from_it(data_dir):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    scene = sceneloom.open(data_dir / ARGOVERSE)
    up, down = scene.lidars

    def spread(lidar, mount):
        points = lidar.frames[0].points
        seen = mount.inverse().apply(points.positions)
        distances = np.linalg.norm(seen, axis=1)
        elevations = np.degrees(np.arcsin(seen[:, 2] / distances))
        rows = [(points.rings == ring) & (distances > 15) for ring in np.unique(points.rings)]
        return np.median([np.ptp(np.percentile(elevations[row], [10, 90])) for row in rows if row.sum() > 30])

    assert spread(up, up.mount) < 0.6 * spread(up, down.mount)
    assert spread(down, down.mount) < 0.6 * spread(down, up.mount)


def seen(scene, camera):
    """Which points of the first sweep a camera's first image shows, over the world."""
    lidar = scene.lidars[0]
    points = lidar.frames[0].points.positions.astype(np.float64)
    if lidar.points_frame == "sensor":
        points = placed(lidar.poses, 0).apply(points)
    elif lidar.points_frame == "ego":
        points = placed(next(iter(scene.trajectories.values())).poses, 0).apply(points)
    inside = placed(camera.poses, 0).inverse().apply(points)
    return project(camera.camera, inside)[1]


def placed(poses, k):
    return RigidTransform.from_quaternion(poses.positions[k], poses.quaternions_xyzw[k])


def test_each_camera_of_nuscenes_shows_the_points_that_its_own_calibration_says(data_dir, tmp_path):
    infos = data_dir / "real" / "nuscenes_one_sample"
    scene = sceneloom.open(from_infos(infos, tmp_path).write())
    frame = json.loads((infos / "infos.json").read_text("utf-8"))["data_list"][0]
    points = np.fromfile(infos / frame["lidar_points"]["lidar_path"], np.float32).reshape(-1, 5)[:, :3]
    assert len(scene.cameras) == 6
    for camera in scene.cameras:
        reported = frame["images"][camera.id]
        x, y, z = np.array(reported["lidar2cam"])[:3] @ np.column_stack([points, np.ones(len(points))]).T
        u, v, w = np.array(reported["cam2img"]) @ [x, y, z]
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = (z > 0) & (abs(u / w - 799.5) <= 800) & (abs(v / w - 449.5) <= 450)
        visible = seen(scene, camera)
        assert 0.08 < visible.mean() < 0.15
        # matrices of infos.json are float32: points within 0.1 px of the edge may differ
        assert (visible != expected).sum() <= 5


def test_the_boxes_of_nuscenes_hold_as_many_points_as_its_tables_state(data_dir, tmp_path):
    scene = sceneloom.open(from_infos(data_dir / "real" / "nuscenes_one_sample", tmp_path).write())
    counts = count_points(scene).lidars[0].counts[0]
    reported = [a.attributes[1].values[0] for a in scene.annotations]
    away = np.abs(counts - np.array(reported))
    # boxes of infos.json have lost their tilt: of 69, few differ, none by much of its points
    assert (away <= 1).mean() > 0.9
    assert away.sum() < 0.05 * sum(reported)


def test_cameras_of_a_folder_of_scales_toolkit_show_known_shares_of_all_points(data_dir):
    scene = sceneloom.open(data_dir / "real" / "pandaset_scale_sample")
    shares = {camera.id: 100 * seen(scene, camera).mean() for camera in scene.cameras}
    known = {"front_camera": 40.0, "front_left_camera": 21.8, "back_camera": 14.5}
    assert shares == pytest.approx(known, abs=0.5)  # known of five frames, this is the first
