"""Samples of recordings made from real logs, held against their calibrations and what was counted in them."""

import json
from itertools import pairwise

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras import project
from sceneloom.motion.ego_trajectory import find_ego_motion


def samples_of(data_dir, name, **arguments):
    folder = data_dir / "recordings" / name
    if not folder.is_dir():
        pytest.skip(f"no recording at {folder}")
    with sceneloom.open(folder) as scene:
        yield from scene.samples(**arguments)


def calibration(data_dir, name):
    return json.loads((data_dir / "recordings" / name / "calibration.json").read_text())


def test_each_sweep_of_the_kitti_drive_has_the_image_taken_in_its_middle(data_dir):
    for k, sample in enumerate(samples_of(data_dir, "kitti_drive")):
        assert sample.index == k
        assert sample.sweep.timestamp_ns == k * 100_000_000
        assert sample.images["camera0"].timestamp_ns == k * 100_000_000 + 50_000_000
        # the middle of the rotation, but for the points that never came back
        assert abs(sample.time_differences_ns["camera0"]) < 10_000_000
        assert sample.missing == {}
    assert k == 11


def test_the_kitti_drive_without_poses_still_has_its_calibration(data_dir):
    known = calibration(data_dir, "kitti_drive")
    camera_from_imu = np.array(known["cameras"][0]["imuToCamera"])
    lidar_from_imu = np.array(known["lidars"][0]["imuToLidar"])
    for sample in samples_of(data_dir, "kitti_drive"):
        assert sample.world_from_lidar is None
        found = sample.camera_from_points["camera0"].matrix
        # the file's matrices are rounded, ours are made orthonormal
        np.testing.assert_allclose(found, camera_from_imu @ np.linalg.inv(lidar_from_imu), atol=1e-5)


def test_a_trajectory_found_from_the_sweeps_locations_the_samples_of_the_kitti_drive(data_dir):
    folder = data_dir / "recordings" / "kitti_drive"
    if not folder.is_dir():
        pytest.skip(f"no recording at {folder}")
    with sceneloom.open(folder) as scene:
        samples = scene.samples(trajectory=find_ego_motion(scene))
        assert samples.trajectory == "lidar"
        trajectories = [
            sample.world_from_lidar.inverse() @ later.world_from_lidar for sample, later in pairwise(samples)
        ]
    # it crawls ahead, about as fast all the time
    forward = [trajectory.translation[0] for trajectory in trajectories]
    assert 0.1 < min(forward) <= max(forward) < 0.3
    assert max(abs(trajectory.translation[1]) for trajectory in trajectories) < 0.03


def points(sample):
    return sample.sweep.points.positions


def test_as_many_points_fall_into_the_pandaset_images_as_were_counted(data_dir):
    shares = [
        [
            project(sample.cameras[camera_id], transform.apply(points(sample)))[1].mean()
            for camera_id, transform in sample.camera_from_points.items()
        ]
        for sample in samples_of(data_dir, "pandaset")
    ]
    # the figures are of frames of the same drive, to a tenth of a per cent, of all frames together
    np.testing.assert_allclose(np.mean(shares, axis=0), [0.400, 0.218, 0.145], atol=0.003)


def test_arrays_of_real_samples_can_be_stacked_but_for_their_points(data_dir):
    arrays = [sample.arrays() for sample in samples_of(data_dir, "pandaset")]
    for name in arrays[0]:
        shapes = {array[name].shape for array in arrays}
        assert len(shapes) == 1 or name.startswith("lidar."), name
        assert len({array[name].dtype for array in arrays}) == 1, name
