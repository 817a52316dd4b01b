"""Sensors in ego coordinates follow the odometry sensor that is meant, or nothing computes with them."""

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import PoseError
from sceneloom.formats import open_scene, write_scene
from sceneloom.scene import (
    Coordinates,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    OdometrySensor,
    PointsFrame,
    Poses,
    Scene,
)

TIMESTAMPS = np.array([1_000_000_000, 1_100_000_000], np.int64)


def trajectory(y):
    return Poses(TIMESTAMPS, np.array([[0.0, y, 0.0], [1.0, y, 0.0]]), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))


@pytest.fixture
def drive(tmp_path):
    """Write a scene file with a lidar in ego coordinates and odometry sensors that are 100 m apart."""

    def make(odometries, parent_id=None):
        rows = np.random.default_rng(1).normal(0, 5, (50, 3)).astype(np.float32)
        frames = [LidarFrame(int(t), LidarPoints(rows)) for t in TIMESTAMPS]
        lidar = LidarSensor(
            "top",
            LazyFrames.of(frames, TIMESTAMPS.tolist()),
            poses=Poses.identity(),
            coordinates=Coordinates.EGO,
            points_frame=PointsFrame.EGO,
            parent_id=parent_id,
        )
        trajectories = [OdometrySensor(f"odometry{k}", trajectory(100.0 * k)) for k in range(odometries)]
        write_scene(Scene((lidar, *trajectories)), tmp_path / "drive.sfs")
        return tmp_path / "drive.sfs"

    return make


@pytest.mark.parametrize(
    ("odometries", "target", "options"),
    [
        (0, "clouds", {"to": "pcd", "frame": "world"}),
        (2, "clouds", {"to": "pcd", "frame": "world"}),
        # points that stay in the ego's frame need no trajectory of it
        (2, "clouds", {"to": "ply"}),
        (2, "nuscenes", {"to": "nuscenes"}),
        (2, "kitti", {"to": "kitti-odometry"}),
        (2, "drive.mcap", {}),
        (2, "drive.json", {"to": "openlabel"}),
        (2, "recording", {"to": "recording"}),
    ],
)
def test_what_needs_the_ego_refuses_where_it_is_not_clear(drive, tmp_path, odometries, target, options):
    path = drive(odometries)
    with pytest.raises(PoseError, match="'top' is in ego coordinates"):
        sceneloom.convert(path, tmp_path / target, **options)
    with open_scene(path) as scene, pytest.raises(PoseError, match="'top' is in ego coordinates"):
        sceneloom.fuse(scene, output=tmp_path / "fused.sfs")


@pytest.mark.parametrize("odometries", [0, 2])
def test_what_only_looks_opens_it_and_validate_says_what_is_wrong(drive, odometries):
    path = drive(odometries)
    with open_scene(path) as scene:
        assert len(scene.lidars[0].frames[0].points) == 50
    report = sceneloom.validate(path)
    rule = "ego-odometry-unique" if odometries else "ego-odometry"
    assert {finding.rule for finding in report.findings if finding.severity == "error"} == {rule}


def test_the_parent_says_which_odometry_sensor_is_meant(drive, tmp_path):
    path = drive(2, parent_id="odometry1")
    assert not [f for f in sceneloom.validate(path).findings if f.severity == "error"]
    sceneloom.convert(path, tmp_path / "copy.sfs")
    with open_scene(tmp_path / "copy.sfs") as scene:
        assert scene.lidars[0].parent_id == "odometry1"
    with pytest.raises(PoseError, match="ego coordinates of odometry sensor 'odometry1'"):
        sceneloom.convert(path, tmp_path / "drive.mcap")
