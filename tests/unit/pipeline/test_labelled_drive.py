"""Tests of labels in the world in which a drive was tracked."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.pipeline.detected_drive import DetectedDrive
from sceneloom.pipeline.tracking import FOLLOWED, label_drive
from sceneloom.scene import CuboidAnnotation, Support, Track, Tracks
from sceneloom.scene.ego import EgoMotion, sensor_source
from sceneloom.simulate import LidarSpec, simulate_street


@pytest.fixture(scope="module")
def simulated():
    return simulate_street(4, frames=3, lidar=LidarSpec(beams=16, steps=360), cameras=())


def a_car(times_ns, centers):
    count = len(times_ns)
    return Track(
        1,
        "car",
        times_ns,
        centers,
        np.tile([4.2, 1.8, 1.5], (count, 1)),
        np.zeros(count),
        np.zeros((count, 3)),
        np.zeros(count),
        np.tile(0.01 * np.eye(10), (count, 1, 1)),
        np.full(count, 0.9),
        np.full(count, Support.SWEEP, np.uint8),
    )


def drive_along(scene, path):
    lidar = scene.lidars[0]
    source = sensor_source(scene, lidar, EgoMotion("trajectory", path), reach_ns=10**8)
    return DetectedDrive("street", lidar.id, source, (), {})


def test_a_trajectory_that_tracking_found_goes_into_the_file_and_labels_lie_in_its_world(simulated, tmp_path):
    scene = replace(simulated.scene, annotations=(), trajectories={})
    trajectory = next(iter(simulated.scene.trajectories.values())).poses
    drive = drive_along(scene, trajectory)
    times = simulated.truth.lidar.timestamps_ns + 50_000_000
    # a car 10 m to the left of the ego trajectory, as whoever followed the sweeps along that way has it
    locations = trajectory.interpolate(times).positions + np.array([0.0, 10.0, 0.8])
    labelled = label_drive(scene, drive, Tracks((a_car(times, locations),)))
    assert list(labelled.scene.trajectories) == [FOLLOWED]
    sceneloom.write(labelled.scene, tmp_path / "labels.sfs")
    with sceneloom.open(tmp_path / "labels.sfs") as read:
        sample = read.samples()[1]
        (cuboid,) = [one for one in read.annotations if isinstance(one, CuboidAnnotation)]
        row = np.abs(cuboid.path.timestamps_ns - sample.timestamp_ns).argmin()
        lidar = sample.world_from_lidar.translation
        assert (
            abs(cuboid.path.values[row, 4] - lidar[1] - 10.0) < 2.0
        )  # the mounting, and half a sweep of driving


def test_a_trajectory_that_the_scene_has_becomes_its_default_one(simulated):
    (name,) = simulated.scene.trajectories
    trajectory = simulated.scene.trajectories[name]
    wrong = replace(trajectory, name="other", positions=trajectory.positions + 5.0)
    scene = replace(simulated.scene, annotations=(), trajectories={"other": wrong, name: trajectory})
    labelled = label_drive(scene, drive_along(scene, trajectory.poses), Tracks(()))
    assert list(labelled.scene.trajectories) == [name, "other"]
