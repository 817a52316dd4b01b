"""Tests of sequences as scenes."""

import numpy as np
import pytest

import sceneloom
from sceneloom.formats.kitti.tracking_reader import open_tracking_folder, sequence_scene


def test_the_camera_is_where_the_calibration_and_the_trajectory_put_it(tracking_folder, tmp_path):
    sequence = open_tracking_folder(tracking_folder()).sequence("0007")
    scene = sequence_scene(sequence)
    ego, camera = scene.sensors
    lidar_from_camera = sequence.camera_from_lidar.inverse()
    expected = sequence.lidar_from_imu.inverse().apply(lidar_from_camera.apply(np.zeros((1, 3))))
    assert camera.mount.translation == pytest.approx(expected[0], abs=1e-9)
    assert ego.poses is sequence.world_from_ego
    sceneloom.write(scene, tmp_path / "sequence.sfs")
    report = sceneloom.validate(tmp_path / "sequence.sfs")
    assert "error" not in {finding.severity for finding in report.findings}
    with sceneloom.open(tmp_path / "sequence.sfs") as read:
        assert read.cameras[0].camera == sequence.camera
        assert len(read.cameras[0].images) == 0


def test_without_a_trajectory_the_ego_is_the_lidar(tracking_folder):
    sequence = open_tracking_folder(tracking_folder(oxts__0007=None)).sequence("0007")
    ego, camera = sequence_scene(sequence).sensors
    assert ego.poses.static
    assert camera.mount.matrix == pytest.approx(sequence.camera_from_lidar.inverse().matrix, abs=1e-12)
