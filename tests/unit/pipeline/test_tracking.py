"""Tracks as labels of a scene, and images of tracked drives."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.pipeline.detected_drive import DetectedCamera, DetectedDrive, SweepPoints, moments
from sceneloom.pipeline.tracking import FOLLOWED, label_drive, save_tracking_images, track
from sceneloom.scene import Boxes2D, Boxes3D, CuboidAnnotation, PointsFrame, Scene, Support, Track, Tracks
from sceneloom.scene.ego import EgoMotion, sensor_source
from sceneloom.simulate import CameraSpec, LidarSpec, detect_2d, detect_3d, simulate_street


@pytest.fixture(scope="module")
def simulated():
    return simulate_street(4, frames=3, lidar=LidarSpec(beams=16, steps=360), cameras=())


def a_car(times_ns, centers):
    count = len(times_ns)
    sizes, still, none = np.tile([4.2, 1.8, 1.5], (count, 1)), np.zeros((count, 3)), np.zeros(count)
    covariances, scores = np.tile(0.01 * np.eye(10), (count, 1, 1)), np.full(count, 0.9)
    supports = np.full(count, Support.SWEEP, np.uint8)
    return Track(1, "car", times_ns, centers, sizes, none, still, none, covariances, scores, supports)


def drive_along(scene, path):
    lidar = scene.lidars[0]
    source = sensor_source(scene, lidar, EgoMotion("trajectory", path), reach_ns=10**8)
    return DetectedDrive("street", lidar.id, source, (), {})


def test_a_trajectory_that_tracking_found_goes_into_the_file_and_labels_lie_in_its_world(simulated, tmp_path):
    scene = replace(simulated.scene, annotations=(), trajectories={})
    ((name, known),) = simulated.scene.trajectories.items()
    drive = drive_along(scene, known.poses)
    times = simulated.truth.lidar.timestamps_ns + 50_000_000
    # a car 10 m to the left of the ego trajectory, as whoever followed the sweeps along that way has it
    locations = known.poses.interpolate(times).positions + np.array([0.0, 10.0, 0.8])
    labelled = label_drive(scene, drive, Tracks((a_car(times, locations),)))
    assert list(labelled.scene.trajectories) == [FOLLOWED]
    sceneloom.write(labelled.scene, tmp_path / "labels.sfs")
    with sceneloom.open(tmp_path / "labels.sfs") as read:
        sample = read.samples()[1]
        (cuboid,) = [one for one in read.annotations if isinstance(one, CuboidAnnotation)]
        row = np.abs(cuboid.path.timestamps_ns - sample.timestamp_ns).argmin()
        lidar = sample.world_from_lidar.translation
        assert abs(cuboid.path.values[row, 4] - lidar[1] - 10.0) < 2.0  # the mounting, and half a sweep of driving
    # one that the scene has becomes its default
    wrong = replace(known, name="other", positions=known.positions + 5.0)
    scene = replace(scene, trajectories={"other": wrong, name: known})
    assert list(label_drive(scene, drive, Tracks(())).scene.trajectories) == [name, "other"]


@pytest.fixture(scope="module")
def scene_and_drive():
    """A short drive with the lists of its detectors."""
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    simulated = simulate_street(4, frames=3, lidar=LidarSpec(beams=32, steps=600), cameras=(camera,))
    scene = simulated.scene
    ego = EgoMotion.of(next(iter(scene.trajectories.values())))
    lidar, camera = scene.lidars[0], scene.cameras[0]
    source, eye = (sensor_source(scene, sensor, ego, reach_ns=10**8) for sensor in (lidar, camera))
    boxes = tuple(one.boxes for one in detect_3d(simulated))
    seen = DetectedCamera(camera.camera, eye, tuple(one.boxes for one in detect_2d(simulated)))
    points = SweepPoints.of(scene, lidar.id, source)
    drive = DetectedDrive("street", lidar.id, source, boxes, {camera.id: seen}, points=points)
    return scene, drive


def test_moments_are_drawn_and_pairs_have_points_of_the_lidar_where_images_show_something(scene_and_drive, tmp_path):
    scene, drive = scene_and_drive
    objects, _ = track(drive)
    paths = save_tracking_images(scene, drive, objects, tmp_path / "drawn", count=2)
    names = [f"{number:06d}_{view}.png" for number in (0, 2) for view in ("above", "camera0")]
    assert [path.name for path in paths] == names
    with Image.open(paths[1]) as image:
        assert image.width >= 320
    bare = save_tracking_images(Scene(()), drive, objects, tmp_path / "bare", count=1)
    assert [path.name for path in bare] == ["000000_above.png"]
    scene, drive = scene_and_drive
    for k, moment in enumerate(moments(drive)):
        (pair,) = moment.pairs_with_points().values()
        np.testing.assert_array_equal(pair.points_lidar, scene.lidars[0].frames[k].points.positions)
    blind = {
        camera_id: replace(camera, boxes=tuple(Boxes2D.empty(one.timestamp_ns) for one in camera.boxes))
        for camera_id, camera in drive.cameras.items()
    }
    for moment in moments(replace(drive, cameras=blind)):
        assert next(iter(moment.pairs_with_points().values())).points_lidar is None
    scene, drive = scene_and_drive
    lidar, time_ns = scene.lidars[0], drive.boxes[1].timestamp_ns
    frame, pose = lidar.frames[1], drive.source.at(np.array([time_ns], np.int64))
    assert isinstance(drive.boxes[1], Boxes3D)
    found = SweepPoints(replace(lidar, points_frame=PointsFrame.WORLD), drive.source, 10**8).at(time_ns)
    # a point of the world at the lidar's own location is its origin
    moved = frame.points.positions - pose.positions[0]
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(moved, axis=1), rtol=1e-4)
    assert drive.points.at(0) is None
    assert drive.points.at(drive.boxes[-1].timestamp_ns + 10**9) is None
    on_ego = replace(lidar, points_frame=PointsFrame.EGO)
    assert SweepPoints.of(replace(scene, sensors=(on_ego,)), on_ego.id, drive.source) is None
    assert SweepPoints.of(scene, "other", drive.source) is None
