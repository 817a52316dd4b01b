"""Images of rolling shutters: made ray by ray, each from where the camera is at its line's own time."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, unproject
from sceneloom.colouring import LidarTrajectory, PointVisibility, ShutterDirection, VisibilitySettings
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.rolling_shutter import project_by_lines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import Shutter
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.simulate import camera_mount

SPEED, ROTATION, READOUT_S = 15.0, math.radians(30.0), 0.033
MOUNT = camera_mount(position=(1.5, 0.3, 1.6), yaw_deg=40.0)

CAMERA_MODELS = {
    "pinhole": Camera("pinhole", 1920, 1080, 1000.0, 1000.0, 959.5, 539.5),
    "brown_conrady": Camera("brown_conrady", 1280, 720, 800.0, 800.0, 639.5, 359.5, (-0.12, 0.04, 4e-4, -3e-4)),
    "fisheye": Camera("fisheye", 1280, 960, 400.0, 400.0, 639.5, 479.5, (0.03, -0.008, 0.002, -0.0004)),
    "omnidir": Camera("omnidir", 1280, 960, 700.0, 700.0, 639.5, 479.5, (-0.1, 0.02, 0.0, 0.9, 0.0, 0.0)),
    "equirectangular": Camera("equirectangular", 1200, 400, 203.7, 203.7, 599.5, 199.5),
}


def ego_at(seconds):
    """An ego that drives a circle at 15 m/s and rotates by 30 degrees a second."""
    radius, rotated = SPEED / ROTATION, np.asarray(seconds) * ROTATION
    positions = np.column_stack([radius * np.sin(rotated), radius * (1 - np.cos(rotated)), 0 * rotated])
    return Rotation.from_rotvec(np.outer(rotated, (0, 0, 1))), positions


# A trajectory of 1 kHz: between its poses the circle leaves the chord by 1 µm.
TIMES = np.linspace(-0.1, 0.1, 201)
SOURCE = PoseSource(Poses(np.rint(TIMES * 1e9).astype(np.int64), ego_at(TIMES)[1], ego_at(TIMES)[0].as_quat()), MOUNT)


def pose_at(timestamp_ns, source=SOURCE):
    samples = source.at(np.array([timestamp_ns]))
    return RigidTransform.from_quaternion(samples.positions[0], samples.quaternions_xyzw[0])


def seen_points(camera, over_columns, count=20_000, seed=0):
    """Pixels all over an image, and points at 2 to 60 m on the rays through them at their lines' times."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(-0.5, (camera.width - 0.5, camera.height - 0.5), (count, 2))
    rays = unproject(camera, pixels)
    pixels, rays = pixels[np.isfinite(rays).all(axis=1)], rays[np.isfinite(rays).all(axis=1)]
    lines, size = (pixels[:, 0], camera.width) if over_columns else (pixels[:, 1], camera.height)
    rotations, positions = ego_at(((lines + 0.5) / size - 0.5) * READOUT_S)
    points_ego = rays * rng.uniform(2, 60, (len(rays), 1)) @ MOUNT.rotation.T + MOUNT.translation
    return rotations.apply(points_ego) + positions, pixels


def view(points_world, camera, **more):
    rgb, shutter = (
        np.zeros((camera.height, camera.width, 3), np.uint8),
        ShutterDirection.of(Shutter(READOUT_S), 0, SOURCE),
    )
    return view_points(points_world, camera, pose_at(0), rgb, camera_id="c", timestamp_ns=0, shutter=shutter, **more)


@pytest.mark.parametrize("over_columns", [False, True], ids=["rows", "columns"])
@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_points_fall_where_the_rays_of_their_lines_saw_them(name, over_columns):
    camera = CAMERA_MODELS[name]
    points_world, pixels = seen_points(camera, over_columns)
    trajectory = ShutterDirection.of(Shutter(READOUT_S, over_columns), 0, SOURCE)
    rolled = project_by_lines(points_world, camera, pose_at(0), trajectory)
    assert rolled.unsettled == 0
    # Only points within a hundredth of a pixel of an edge may fall out.
    assert len(rolled.point_ids) > 0.9995 * len(pixels)
    off = np.abs(rolled.pixels - pixels[rolled.point_ids]).max(axis=1)
    assert off.max() < 0.01
    at_once, inside = project(camera, pose_at(0).inverse().apply(points_world))
    assert np.linalg.norm(at_once - pixels, axis=1)[inside].max() > 30


def rolled_points(points_world, camera, **shutter):
    trajectory = ShutterDirection.of(Shutter(READOUT_S, **shutter), 0, SOURCE)
    return project_by_lines(points_world, camera, pose_at(0), trajectory)


def test_points_enter_the_view_only_by_the_time_of_their_line_and_those_that_no_line_sees_are_left_out():
    points_world, pixels = seen_points(CAMERA_MODELS["pinhole"], over_columns=False)
    rolled = rolled_points(points_world, Camera("pinhole", 1280, 1080, 1000.0, 1000.0, 639.5, 539.5))
    columns = pixels[:, 0] - 320
    clear = np.abs(np.abs(columns - 639.5) - 640) > 0.02
    expected = np.flatnonzero((columns >= -0.5) & (columns < 1279.5) & clear)
    np.testing.assert_array_equal(np.intersect1d(rolled.point_ids, np.flatnonzero(clear)), expected)
    nowhere = np.array([[np.nan, 0, 0], [np.inf, 0, 0], pose_at(0).apply(np.array([0, 0, -5.0]))])
    for points in (nowhere, nowhere[:0]):
        rolled = rolled_points(points, CAMERA_MODELS["pinhole"])
        assert len(rolled.point_ids) == len(rolled.pixels) == len(rolled.points_camera) == 0
    camera = CAMERA_MODELS["pinhole"]
    points_world, _ = seen_points(camera, over_columns=True)
    _, inside = project(camera, pose_at(0).inverse().apply(points_world))
    rolled = rolled_points(points_world, camera, over_columns=True)
    assert np.isin(np.flatnonzero(~inside), rolled.point_ids).mean() > 0.999
    assert (~inside).sum() > 100


def test_a_camera_that_shakes_faster_than_its_shutter_leaves_no_wrong_pixels():
    """Its image moves by more than a line from line to line: what is found is right, the rest is counted."""
    camera = Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5)
    seconds = np.linspace(-0.05, 0.05, 401)
    rotations = Rotation.from_rotvec(np.outer(0.5 * np.sin(seconds * 400), (1, 0, 0))).as_quat()
    path = Poses(np.rint(seconds * 1e9).astype(np.int64), np.zeros((401, 3)), rotations)
    source = PoseSource(path, RigidTransform.identity())
    rays = unproject(camera, np.random.default_rng(1).uniform(-200, 800, (3000, 2)))
    shutter = Shutter(0.03)
    rolled = project_by_lines(10 * rays, camera, pose_at(0, source), ShutterDirection.of(shutter, 0, source))
    assert rolled.unsettled > 0
    assert len(rolled.point_ids) > 500
    times = np.rint(shutter.delays(rolled.pixels[:, 1], camera) * 1e9).astype(np.int64)
    rotated = Rotation.from_quat(source.at(times).quaternions_xyzw)
    there, _ = project(camera, rotated.inv().apply(10 * rays[rolled.point_ids]))
    # 80,000 rad/s² between knots 0.47 ms apart are 2.2 mrad, 1.1 px.
    np.testing.assert_allclose(rolled.pixels, there, atol=1.5)


def test_depths_and_what_is_hidden_are_those_of_the_time_of_each_line_evenly_around_the_images_time():
    camera = CAMERA_MODELS["pinhole"]
    points_world, pixels = seen_points(camera, over_columns=False, count=500)
    found = view(points_world, camera, visibility=VisibilitySettings(enabled=False))
    rotations, positions = ego_at(((pixels[:, 1] + 0.5) / camera.height - 0.5) * READOUT_S)
    points_ego = rotations.inv().apply(points_world - positions)
    expected = ((points_ego - MOUNT.translation) @ MOUNT.rotation)[found.point_ids, 2]
    np.testing.assert_allclose(found.depths, expected, atol=1e-4)  # float32 of 60 m, a hundredth of a line
    assert found.rolled
    assert found.unsettled == 0
    inside = found.observations <= PointVisibility.HIDDEN
    np.testing.assert_array_equal(np.flatnonzero(inside), found.point_ids)
    points_world, _ = seen_points(camera, over_columns=False, count=4000)
    lidar = LidarTrajectory(np.tile(pose_at(0).translation, (2, 1)), np.zeros(len(points_world), np.float32))
    alone, known = (view(points_world, camera, trajectory=trajectory) for trajectory in (None, lidar))
    assert alone.rolled
    # What hangs in the air hides a lot; a lidar beside the camera saw past all of it.
    assert alone.visible.mean() < 0.9
    assert known.visible.mean() > alone.visible.mean()
    still = PoseSource(Poses.identity(), MOUNT)
    directions = [
        ShutterDirection.of(Shutter(readout), time_ns, source)
        for readout, time_ns, source in ((0, 0, SOURCE), (READOUT_S, 0, still), (READOUT_S, 10**12, SOURCE))
    ]
    assert directions == [None] * 3
    camera, shutter, columns = CAMERA_MODELS["pinhole"], Shutter(0.108), Shutter(0.192, over_columns=True)
    for one, lines, delays in (
        (shutter, [0, 539.5, 1079], [-0.05395, 0.0, 0.05395]),
        (shutter, [-90, 2000], [-0.054, 0.054]),
        (columns, [0, 1919], [-0.09595, 0.09595]),
    ):
        np.testing.assert_allclose(one.delays(lines, camera), delays)
    assert list(shutter.knots_ns(10**9, 5)) == [10**9 + k * 27_000_000 for k in range(-2, 3)]
