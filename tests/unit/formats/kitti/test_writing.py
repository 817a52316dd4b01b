"""Scenes written as KITTI's folders and read again: the same camera models, mountings, ways, points and boxes."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base.losses import Support
from sceneloom.geometry.rigid import RigidTransform, rotate_vectors
from sceneloom.scene import CuboidAnnotation, LabeledPoints, LabeledPointsAnnotation, LazyFrames, PointsFrame, Scene
from sceneloom.scene.annotations_at import cuboid_poses
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import CameraSpec, GnssSpec, ImuSpec, LidarSpec, camera_mount, simulate_street

FORMATS = ("kitti-raw", "kitti-object", "kitti-tracking", "kitti-odometry")
PINHOLE = Camera("pinhole", 80, 28, 45.0, 45.5, 39.5, 13.5)
BENT = Camera("brown_conrady", 80, 28, 45.0, 45.5, 39.5, 13.5, (-0.2, 0.05, 0.001, -0.002, 0.01))
WIDE = Camera("fisheye", 80, 40, 30.0, 30.0, 39.5, 19.5, (0.02, -0.004, 0.001, 0.0))
POINTS = np.array([[12.0, 1.5, -0.6], [20.0, -3.0, 0.4]])


def street(*camera_models):
    """A drive whose sweeps and images are made once."""
    cameras = [CameraSpec(model, camera_mount(pitch_deg=1.0 + k)) for k, model in enumerate(camera_models)]
    lidar, imu = LidarSpec(beams=8, steps=90), ImuSpec(rate_hz=50.0)
    scene = simulate_street(3, frames=3, lidar=lidar, cameras=cameras, imu=imu, gnss=GnssSpec()).scene
    made = {}
    for lidar in scene.lidars:
        made[lidar.id] = {"frames": LazyFrames.of(list(lidar.frames), lidar.frames.timestamps_ns)}
    for camera in scene.cameras:
        images = [image.loaded() for image in camera.images]
        made[camera.id] = {"images": LazyFrames.of(images, camera.images.timestamps_ns)}
    return replace(scene, sensors=tuple(replace(sensor, **made.get(sensor.id, {})) for sensor in scene.sensors))


@pytest.fixture(scope="module")
def drive():
    return street(PINHOLE)


def first_pose(scene, sensor, time_ns):
    trajectory = next(iter(scene.trajectories.values())).poses
    at = PoseSource(trajectory, sensor.mount).at(np.array([time_ns], np.int64))
    return RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])


def rotated_pixels(scene):
    """Where the first camera sees points of the lidar's frame."""
    camera, lidar = scene.cameras[0], scene.lidars[0]
    return project(camera.camera, (camera.mount.inverse() @ lidar.mount).apply(POINTS))[0]


@pytest.mark.parametrize("name", FORMATS)
def test_points_images_calibration_boxes_and_the_trajectory_but_for_its_world_come_back(drive, name, tmp_path):
    losses = write_scene(drive, tmp_path / "out", format=name)
    back = open_scene(tmp_path / "out")
    assert back.format == name
    for before, after in zip(drive.lidars[0].frames, back.lidars[0].frames, strict=True):
        np.testing.assert_array_equal(after.points.positions, before.points.positions)
        np.testing.assert_array_equal(after.points.intensities, before.points.intensities)
    for before, after in zip(drive.cameras[0].images, back.cameras[0].images, strict=True):
        np.testing.assert_array_equal(after.rgb, before.rgb)
    np.testing.assert_allclose(rotated_pixels(back), rotated_pixels(drive), atol=1e-9)
    if name != "kitti-object":
        times = back.lidars[0].frames.timestamps_ns[[0, -1]]
        ends = [[first_pose(scene, scene.lidars[0], time) for time in times] for scene in (drive, back)]
        before, after = (start.inverse() @ stop for start, stop in ends)
        # text has all digits, but east and north at the first location are rotated by 1e-6 against those at the origin
        np.testing.assert_allclose(after.matrix, before.matrix, atol=1e-6)
    if name == "kitti-odometry":
        return
    first = drive.lidars[0].frames[0]
    raw_times = drive.lidars[0].frames.timestamps_ns + first.reference_ns - first.timestamp_ns
    centers = []
    for scene, time in ((drive, raw_times[1]), (back, back.lidars[0].frames.timestamps_ns[1])):
        boxes = [a for a in scene.annotations if isinstance(a, CuboidAnnotation)]
        poses = [cuboid_poses(box, [time]) for box in boxes]
        there = [pose.centers_world[0] for pose in poses if pose.there[0]]
        centers.append(first_pose(scene, scene.lidars[0], time).inverse().apply(np.array(there)))
    before, after = centers
    assert len(after) == len(before) if name == "kitti-raw" else 0 < len(after) < len(before)
    nearest = np.linalg.norm(after[:, None] - before[None], axis=2).min(axis=1)
    assert nearest.max() < 2e-6  # labels have six decimals
    if name == "kitti-tracking":  # boxes that no image shows are reported
        boxes = [a for a in drive.annotations if isinstance(a, CuboidAnnotation)]
        (lost,) = [loss for loss in losses if loss.field == "annotations.cuboid"]
        assert (lost.support, lost.count) == (Support.DROPPED, len(boxes) - len(back.annotations))


def test_a_distorted_camera_model_stays_in_an_extract_and_is_resampled_for_a_sync(tmp_path):
    scene = street(BENT)
    write_scene(scene, tmp_path / "whole", format="kitti-raw")
    whole = open_scene(tmp_path / "whole").cameras[0]
    assert whole.camera.model == "brown_conrady"
    assert whole.camera.coefficients[:5] == BENT.coefficients
    losses = write_scene(scene, tmp_path / "flat", format="kitti-raw", kind="sync")
    flat = open_scene(tmp_path / "flat")
    assert flat.cameras[0].camera.model == "pinhole"
    assert "sensors.camera.images.rgb" in {loss.field for loss in losses if loss.support == Support.APPROXIMATED}
    assert (tmp_path / "flat/1970_01_01/1970_01_01_drive_0001_sync").is_dir()


@pytest.mark.slow
def test_camera_models_and_directions_that_a_folder_cannot_hold_are_reported(tmp_path):
    scene = street(WIDE, PINHOLE)
    losses = write_scene(scene, tmp_path / "out", format="kitti-tracking")
    back = open_scene(tmp_path / "out")
    assert [camera.id for camera in back.cameras] == ["camera2"]
    reported = {loss.what for loss in losses}
    assert any("rotated by 1° against camera 'camera0'" in what for what in reported)
    assert any("a fisheye camera model replaced by a pinhole" in what for what in reported)


def test_points_in_the_world_are_brought_back_into_the_lidars_frame(drive, tmp_path):
    lidar, frame = drive.lidars[0], drive.lidars[0].frames[1]
    trajectory = next(iter(drive.trajectories.values())).poses
    at = PoseSource(trajectory, lidar.mount).at(frame.points.timestamps_ns)
    world = rotate_vectors(at.quaternions_xyzw, frame.points.positions) + at.positions
    placed = replace(frame, points=replace(frame.points, positions=world.astype(np.float32)))
    frames = LazyFrames.of([placed], [frame.timestamp_ns])
    scene = replace(drive, sensors=(replace(lidar, frames=frames, points_frame=PointsFrame.WORLD),))
    losses = write_scene(scene, tmp_path / "out", format="kitti-odometry")
    after = open_scene(tmp_path / "out").lidars[0].frames[0].points
    np.testing.assert_allclose(after.positions, frame.points.positions, atol=2e-5)  # float32 at 100 m
    (reported,) = [loss for loss in losses if loss.field == "sensors.lidar.frames.points.positions"]
    assert reported.support == Support.CONVERTED


def test_labelled_points_get_semantic_kittis_numbers(drive, tmp_path):
    ids = np.arange(5, dtype=np.uint32)
    annotations = (
        LabeledPointsAnnotation("a", (LabeledPoints("lidar", ids, 1),), label="Road", is_instance=False),
        LabeledPointsAnnotation("b", (LabeledPoints("lidar", ids[3:], 1),), label="car", is_instance=True),
        LabeledPointsAnnotation("c", (LabeledPoints("lidar", ids[:2], 0),), label="spaceship"),
    )
    losses = write_scene(replace(drive, annotations=annotations), tmp_path / "out", format="kitti-odometry")
    found = np.fromfile(tmp_path / "out/sequences/00/labels/000001.label", "<u4")
    assert found[:6].tolist() == [40, 40, 40, 10 | 1 << 16, 10 | 1 << 16, 0]
    reported = {loss.field: loss for loss in losses}
    assert reported["annotations.labeled_points"].count == 2
    assert reported["annotations.labeled_points.labeled_points.point_ids"].count == 2
    assert {a.id for a in open_scene(tmp_path / "out").annotations} == {"road", "car 1"}


@pytest.mark.parametrize("name", FORMATS)
def test_images_alone_are_written_nothing_is_refused_and_other_peoples_folders_are_left_alone(drive, name, tmp_path):
    images = Scene(drive.cameras)
    for _ in range(2):
        write_scene(images, tmp_path / "own", format=name, overwrite=True)
    assert len(open_scene(tmp_path / "own").cameras[0].images) == 3
    with pytest.raises(OutputError, match=r"exists already"):
        write_scene(images, tmp_path / "own", format=name)
    with pytest.raises(DataError, match=r"holds (nothing that a folder of KITTI's could hold|neither sweeps nor)"):
        write_scene(Scene(()), tmp_path / "out", format=name)
    assert not (tmp_path / "out").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear")
    with pytest.raises(OutputError, match=r"holds 'letter.txt', so it is no folder of KITTI's"):
        write_scene(images, tmp_path / "mine", format=name, overwrite=True)


def test_times_before_1970_come_back(drive, tmp_path):
    times = [-1_500_000_001, -1, 7]
    shots = [replace(shot, timestamp_ns=time) for shot, time in zip(drive.cameras[0].images, times, strict=True)]
    early = replace(drive.cameras[0], images=LazyFrames.of(shots, times), poses=None)
    write_scene(Scene((early,)), tmp_path / "out", format="kitti-raw", kind="extract")
    assert open_scene(tmp_path / "out").cameras[0].images.timestamps_ns.tolist() == times


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("kitti-raw", {"kind": "both"}, "kind 'both'; expected one of sync, extract"),
        ("kitti-raw", {"sequence": "a"}, "sequence 'a'; expected up to four digits"),
        ("kitti-tracking", {"sequence": "12345"}, "sequence '12345'; expected four digits"),
        ("kitti-odometry", {"sequence": "x"}, "sequence 'x'; expected two digits"),
        ("kitti-object", {"sequence": "x"}, "option 'sequence'"),
    ],
)
def test_options_that_cannot_be_followed_are_refused(drive, tmp_path, name, options, problem):
    with pytest.raises(OptionError) as caught:
        write_scene(drive, tmp_path / "out", format=name, **options)
    assert problem in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", [*FORMATS, "kitti-bin", "nuscenes-bin"])
def test_points_without_a_location_are_left_out_of_files_of_bare_numbers(drive, name, tmp_path):
    lidar = drive.lidars[0]
    frames = list(lidar.frames)
    locations = frames[0].points.positions.copy()
    locations[::4] = np.nan
    frames[0] = replace(frames[0], points=replace(frames[0].points, positions=locations))
    holes = replace(lidar, frames=LazyFrames.of(frames, lidar.frames.timestamps_ns))
    road = LabeledPoints(lidar.id, np.arange(8, dtype=np.uint32), 0)
    labelled = LabeledPointsAnnotation("r", (road,), label="road")
    scene = replace(drive, sensors=(holes, *drive.cameras), annotations=(labelled,))
    losses = write_scene(scene, tmp_path / "out", format=name)
    assert any("not finite" in loss.what and loss.count == len(locations[::4]) for loss in losses)
    with open_scene(tmp_path / "out") as back:
        np.testing.assert_array_equal(back.lidars[0].frames[0].points.positions, locations[~np.isnan(locations[:, 0])])
        if name == "kitti-odometry":
            (reported,) = (labeled for found in back.annotations for labeled in found.labeled_points)
            np.testing.assert_array_equal(np.asarray(reported.point_ids), np.arange(6))
