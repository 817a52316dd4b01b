"""Drives through the fusion system: rolling shutters, several sensors, mountings that change."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline import iter_fused
from sceneloom.scene import Coordinates, LazyFrames, Poses
from sceneloom.simulate import CameraSpec, LidarSpec, PathSpec, camera_mount, simulate_street
from sceneloom.simulate.trajectory import sensor_mount

CAMERA_MODEL = Camera("brown_conrady", 640, 360, 400.0, 400.0, 319.5, 179.5, (-0.12, 0.04, 0.0004, -0.0003))
LIDAR = LidarSpec(beams=16, elevations_deg=(-20.0, 5.0), steps=600, range_sigma=0.0)
FAST = PathSpec(speeds=(12.0, 15.0), yaw_rate=0.5)
ROLLING = (
    CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=50.0), readout_ns=33_000_000),
    CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=-60.0), readout_ns=33_000_000, left_to_right=True),
)


@pytest.fixture(scope="module")
def rolling_drive(keep):
    """A fast drive with one shutter of rows and one of columns."""
    made = simulate_street(3, frames=3, lidar=LIDAR, cameras=ROLLING, path=FAST, trajectory_hz=500.0)
    return replace(made, scene=keep(made.scene))


def true_pixels(drive, view, k):
    """Where the lines of an image see the points of a view: between the exact poses of the two nearest lines."""
    camera = drive.truth.cameras[view.camera_id]
    rotations, origins = camera.line_poses(k)
    into_truth = drive.truth.world_from_camera(view.camera_id, k) @ view.world_from_camera.inverse()
    points = into_truth.apply(view.points_world[view.point_ids])
    lines = view.pixels[:, 0 if camera.spec.left_to_right else 1].astype(float)
    below = np.clip(np.floor(lines), 0, camera.spec.line_count - 2).astype(int)
    pixels = [
        project(view.camera, np.einsum("nji,nj->ni", rotations[at], points - origins[at]))[0]
        for at in (below, below + 1)
    ]
    share = (lines - below)[:, None]
    return (1 - share) * pixels[0] + share * pixels[1]


def check_rolled(drive, scene):
    """Every point lies where its line saw it; taken at once, it would lie many pixels beside."""
    for k, fused in enumerate(iter_fused(scene)):
        for camera_id, view in zip(("camera0", "camera1"), fused.views, strict=True):
            assert view.rolled
            assert view.unsettled == 0
            known = replace(view, camera_id=camera_id)
            expected = true_pixels(drive, known, k)
            inside = np.isfinite(expected).all(axis=1)
            assert inside.sum() > 500
            # The trajectory's chords and half a line between two lines leave less than this.
            assert np.abs(view.pixels - expected)[inside].max() < 0.05
            in_camera = view.world_from_camera.inverse().apply(view.points_world[view.point_ids])
            at_once = project(view.camera, in_camera)[0]
            assert np.nanmax(np.abs(at_once - view.pixels)) > 8


def test_points_fall_where_the_lines_of_a_rolling_shutter_see_them(rolling_drive):
    check_rolled(rolling_drive, rolling_drive.scene)


@pytest.mark.parametrize("name", ["drive", "drive.sfs"])
def test_the_shutter_is_known_from_files(rolling_drive, tmp_path, name):
    sceneloom.write(rolling_drive.scene, tmp_path / name)
    with sceneloom.open(tmp_path / name) as again:
        check_rolled(rolling_drive, again)


def test_depths_and_visibility_agree_with_what_each_line_saw(rolling_drive):
    agreeing, kept = [], []
    for k, fused in enumerate(iter_fused(rolling_drive.scene)):
        for view in fused.views:
            columns, rows = np.floor(view.pixels + 0.5).astype(int).T
            plain = ~rolling_drive.truth.edges(view.camera_id, k)[rows, columns]
            depths = rolling_drive.truth.depth(view.camera_id, k)[rows, columns]
            agree = np.abs(view.depths - depths) < 0.3 + 0.02 * depths
            agreeing.append(agree[plain & view.visible])
            kept.append(view.visible[plain & agree])
    assert np.concatenate(agreeing).mean() > 0.97
    assert np.concatenate(kept).mean() > 0.95


def test_without_motion_a_rolling_shutter_takes_its_lines_at_once(rolling_drive):
    for fused in iter_fused(rolling_drive.scene, trajectory="identity"):
        assert [view.rolled for view in fused.views] == [False, False]


def test_several_lidars_and_cameras_make_one_cloud():
    """Each lidar's sweep is fused with the images nearest to it, and all points meet in one world."""
    lidars = [
        replace(LIDAR, mount=sensor_mount(position=(1.0, 0.5, 1.9), yaw_deg=20.0)),
        replace(LIDAR, mount=sensor_mount(position=(-1.0, -0.5, 1.7), yaw_deg=-100.0), offset_ns=30_000_000),
    ]
    cameras = [CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=yaw)) for yaw in (0.0, 90.0, 180.0)]
    drive = simulate_street(2, frames=2, lidars=lidars, cameras=cameras, path=FAST, trajectory_hz=500.0)
    indices: dict[str | int, int] = {}
    for fused in iter_fused(drive.scene):
        k = indices.get(fused.lidar_id, 0)
        indices[fused.lidar_id] = k + 1
        sweep = drive.truth.sweep(k, str(fused.lidar_id))
        view = fused.views[0]
        number = int(np.flatnonzero(drive.scene.cameras[0].images.timestamps_ns == view.timestamp_ns).item())
        true_pose = drive.truth.world_from_camera(view.camera_id, number)
        world = (view.world_from_camera @ true_pose.inverse()).apply(sweep.points_world)
        # Chords of the trajectory, float32.
        np.testing.assert_allclose(fused.points.positions, world, atol=2e-3)
        assert [other.camera_id for other in fused.views] == ["camera0", "camera1", "camera2"]
        assert fused.points.camera_index is not None
        assert set(np.unique(fused.points.camera_index)) >= {0, 1, 2}
    assert indices == {"lidar0": 2, "lidar1": 2}


def test_mountings_may_change_from_frame_to_frame():
    """A camera whose mounting is reported with each image, and a lidar on a mast that swings, by poses on the ego."""
    drive = simulate_street(
        2, frames=3, lidar=LIDAR, cameras=(CameraSpec(CAMERA_MODEL),), path=FAST, trajectory_hz=500.0
    )
    (camera,), (lidar,) = drive.scene.cameras, drive.scene.lidars
    assert camera.mount is not None
    assert lidar.mount is not None
    rotations = [
        RigidTransform(Rotation.from_euler("z", 5 * k, degrees=True).as_matrix(), np.zeros(3)) for k in range(3)
    ]
    images = [replace(image, mount=rotations[k] @ camera.mount) for k, image in enumerate(camera.images)]
    swinging = LazyFrames(camera.images.timestamps_ns, lambda k: images[k])
    (trajectory,) = drive.scene.trajectories.values()
    start, stop = trajectory.poses.start_ns, trajectory.poses.stop_ns
    times = np.linspace(start, stop, 50).astype(np.int64)
    swing = Rotation.from_euler("z", np.linspace(0, 20, 50)[:, None], degrees=True)
    mast = Poses(
        times, np.tile(lidar.mount.translation, (50, 1)), (swing * Rotation.from_matrix(lidar.mount.rotation)).as_quat()
    )
    moved = {
        camera.id: replace(camera, images=swinging),
        lidar.id: replace(lidar, poses=mast, mount=None, coordinates=Coordinates.EGO),
    }
    scene = replace(drive.scene, sensors=tuple(moved.get(sensor.id, sensor) for sensor in drive.scene.sensors))
    for k, (fused, plain) in enumerate(zip(iter_fused(scene), iter_fused(drive.scene), strict=True)):
        ego = plain.views[0].world_from_camera @ camera.mount.inverse()
        expected = ego @ rotations[k] @ camera.mount
        np.testing.assert_allclose(fused.views[0].world_from_camera.matrix, expected.matrix, atol=1e-12)
        at = lidar.frames[k].points.timestamps_ns
        path = trajectory.poses.interpolate(at)
        angles = np.interp(at, times, np.linspace(0, np.radians(20), 50))
        swung = swing[0] * Rotation.from_rotvec(np.outer(angles, (0, 0, 1)))
        from_mast = lidar.mount.apply(lidar.frames[k].points.positions) - lidar.mount.translation
        on_ego = swung.apply(from_mast) + lidar.mount.translation
        world = Rotation.from_quat(path.quaternions_xyzw).apply(on_ego) + path.positions
        into_fused = plain.points.positions[0] - points_in_world(drive, k)[0]
        np.testing.assert_allclose(fused.points.positions, world + into_fused, atol=3e-3)


def points_in_world(drive, k):
    """The points of a sweep by trajectory and mounting, as they were measured."""
    (lidar,) = drive.scene.lidars
    points, mount = lidar.frames[k].points, lidar.mount
    assert mount is not None
    (trajectory,) = drive.scene.trajectories.values()
    path = trajectory.poses.interpolate(points.timestamps_ns)
    return Rotation.from_quat(path.quaternions_xyzw).apply(mount.apply(points.positions)) + path.positions
