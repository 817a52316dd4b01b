"""Visibility, depths and colours: by hand, against OpenCV, and against the truth of a simulated drive."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import LidarTrajectory, PointVisibility, VisibilitySettings
from sceneloom.colouring.algorithms import ALGORITHMS, ViewRequest, fuse_by_projection, view_points
from sceneloom.errors import ArrayError, CalibrationError, OptionError
from sceneloom.geometry.rigid import RigidTransform

AHEAD = RigidTransform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
LEFT = RigidTransform(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))
CAMERA_MODEL = Camera("pinhole", 20, 10, 10.0, 10.0, 9.5, 4.5)


def request(camera_id, camera_index, pose, image, camera=CAMERA_MODEL):
    """One image of a camera; of one colour where `image` is that."""
    rgb = image if np.ndim(image) == 3 else np.full((camera.height, camera.width, 3), image, np.uint8)
    return ViewRequest(
        camera_id=camera_id, camera_index=camera_index, camera=camera, timestamp_ns=camera_index,
        world_from_camera=pose, rgb=rgb,
    )  # fmt: skip


def test_projection_gives_views_in_order_and_each_point_the_colour_of_an_image_that_shows_it():
    points = np.array([[5.0, 0, 0], [0, 5, 0], [-5, 0, 0], [5, 4, 0], [4, 5, 0]])
    requests = [request("ahead", 3, AHEAD, (1, 2, 3)), request("left", 1, LEFT, (4, 5, 6))]
    fused = ALGORITHMS["projection"](points, requests, VisibilitySettings())
    assert [view.camera_id for view in fused.views] == ["ahead", "left"]
    assert [view.point_ids.tolist() for view in fused.views] == [[0, 3], [1, 4]]
    assert fused.camera_index.tolist() == [3, 1, 255, 3, 1]
    assert fused.colors.tolist() == [[1, 2, 3], [4, 5, 6], [255] * 3, [1, 2, 3], [4, 5, 6]]
    points, beside = np.array([[9.0, 8.0, 0], [4.5, 4.0, 0]]), RigidTransform(AHEAD.rotation, np.array([0.0, 8.0, 0.0]))
    requests = [request("ahead", 0, AHEAD, (1, 1, 1)), request("beside", 1, beside, (2, 2, 2))]
    for margin, visible, cameras in ((0.15, [False, True], [1, 0]), (30.0, [True, True], [1, 0])):
        fused = ALGORITHMS["projection"](points, requests, VisibilitySettings(margin=margin))
        assert (fused.views[0].visible.tolist(), fused.camera_index.tolist()) == (visible, cameras)
    for name in ALGORITHMS:
        fused = ALGORITHMS[name](np.zeros((2, 3)), [], VisibilitySettings())
        assert (fused.views, fused.camera_index.tolist()) == ((), [255, 255])
    with pytest.raises(OptionError, match="255"):
        ALGORITHMS["projection"](np.zeros((2, 3)), [request("a", 255, AHEAD, 0)], VisibilitySettings())
    camera, pose = Camera("pinhole", 21, 21, 20.0, 20.0, 10.0, 10.0), RigidTransform.identity()
    requests = [request(f"camera{k}", k, pose, level, camera) for k, level in enumerate((100, 110))]
    fused = ALGORITHMS["blending"](np.array([[0.0, 0.0, 5.0]]), requests, VisibilitySettings())
    assert fused.colors.tolist() == [[105, 105, 105]]
    assert [view.camera_id for view in fused.views] == ["camera0", "camera1"]


CAMERA = Camera("brown_conrady", 640, 480, 520.0, 530.0, 322.0, 237.0, (-0.15, 0.05, 1e-3, -5e-4, -0.01))
POSE = RigidTransform.from_quaternion(np.array([4.0, -2.0, 1.5]), np.array([0.1, -0.7, 0.2, 0.4]))
PLAIN = VisibilitySettings(enabled=False)


def view(points_world, camera=CAMERA, visibility=PLAIN, rgb=None):
    image = np.zeros((camera.height, camera.width, 3), np.uint8) if rgb is None else rgb
    return view_points(points_world, camera, POSE, image, camera_id="c", timestamp_ns=7, visibility=visibility)


def cloud(count=4000, seed=0):
    """Points before, beside and behind the camera."""
    return POSE.apply(np.random.default_rng(seed).normal(size=(count, 3)) * [4, 3, 6] + [0, 0, 6])


def projected_by_opencv(points_world):
    points = POSE.inverse().apply(points_world)
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    camera_model = np.array(CAMERA.coefficients)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, camera_model)[0][:, 0]
    inside = (pixels >= -0.5).all(axis=1) & (pixels < [CAMERA.width - 0.5, CAMERA.height - 0.5]).all(axis=1)
    # Beyond this angle the polynomial of the camera model folds the world back into the image.
    ahead = (points[:, 2] > 0) & (np.hypot(points[:, 0], points[:, 1]) < 0.9 * points[:, 2])
    return np.flatnonzero(inside & ahead), pixels, points[:, 2]


def test_points_fall_where_opencv_puts_them_and_depth_images_hold_the_nearest_visible_of_each_pixel():
    for visibility in [PLAIN, VisibilitySettings()]:
        fused = view(cloud(60_000), visibility=visibility)
        assert (fused.camera_id, fused.camera, fused.timestamp_ns) == ("c", CAMERA, 7)
        assert fused.world_from_camera is POSE
        expected = np.full((480, 640), np.inf)
        columns, rows = np.floor(fused.pixels.astype(float) + 0.5).astype(int).T
        counted = fused.visible if visibility.enabled else np.ones(len(rows), bool)
        np.minimum.at(expected, (rows[counted], columns[counted]), fused.depths[counted])
        np.testing.assert_array_equal(fused.depth_image, np.where(np.isinf(expected), 0, expected))
        assert 0.01 < fused.visible.mean() < 0.99
        if not visibility.enabled:  # a plain z-buffer shows the nearest points
            np.testing.assert_array_equal(fused.visible, fused.depths == expected[rows, columns])
    camera = Camera("fisheye", 900, 900, 200.0, 200.0, 449.5, 449.5, (0.0, 0.0, 0.0, 0.0))
    points = POSE.apply(np.array([[5.0, 0, 1], [5, 0, -1], [0, 0, 4]]))
    for visibility in (PLAIN, VisibilitySettings()):
        fused = view(points, camera, visibility)
        assert fused.visible.tolist() == [True] * 3
        assert sorted(fused.depth_image[fused.depth_image > 0].tolist()) == pytest.approx([1, 4])
    points = cloud()
    fused = view(points)
    ids, pixels, depths = projected_by_opencv(points)
    assert len(ids) > 1000
    np.testing.assert_array_equal(fused.point_ids, ids)
    np.testing.assert_allclose(fused.pixels, pixels[ids], atol=1e-4)  # float32 keeps 3e-5 px of 640
    np.testing.assert_allclose(fused.depths, depths[ids], rtol=1e-6)
    points = cloud(500)
    expected = view(points)
    points.flags.writeable = False
    for other in (points, np.asfortranarray(points), np.repeat(points, 2, axis=0)[::2], points[::-1][::-1]):
        fused = view(other)
        np.testing.assert_array_equal(fused.point_ids, expected.point_ids)
        np.testing.assert_array_equal(fused.depth_image, expected.depth_image)


def test_few_points_and_pixels_are_fine_what_is_behind_is_in_no_image_and_what_does_not_fit_is_refused():
    for visibility in [None, PLAIN]:
        fused = view(np.zeros((0, 3)), visibility=visibility)
        assert len(fused.point_ids) == len(fused.visible) == 0
        assert not fused.depth_image.any()
        fused = view(POSE.apply(np.array([[0.1, 0.2, 5.0]])), visibility=visibility)
        assert (fused.visible.tolist(), fused.depth_image[fused.depth_image > 0]) == ([True], pytest.approx([5.0]))
        points = cloud(300)
        points[::3] = [math.nan, 0, 0]
        points[1::3, 1] = math.inf
        fused = view(points, visibility=visibility)
        assert len(fused.point_ids) > 0
        assert (fused.point_ids % 3 == 2).all()
        pixel = Camera("pinhole", 1, 1, 10.0, 10.0, 0.0, 0.0)
        fused = view(POSE.apply(np.array([[0, 0, 9.0], [0.01, 0, 3.0], [5, 0, 3]])), pixel, visibility)
        assert (fused.point_ids.tolist(), fused.depth_image.tolist()) == ([0, 1], [[3.0]])
        assert len(view(POSE.apply(np.array([[0, 0, -5.0], [0, 0, 0]])), visibility=visibility).point_ids) == 0
    for many in [False, True]:
        inside, outside = (1000, 10) if many else (10, 1000)
        points = POSE.apply(np.concatenate([np.full((inside, 3), [0.0, 0, 5]), np.full((outside, 3), -5.0)]))
        fused = view(points)
        for held in (fused.point_ids, fused.pixels, fused.pixel_numbers, fused.depths):
            assert (None if held.base is None else held.base.shape) == ((1010, *held.shape[1:]) if many else None)
    for points, options, error, message in [
        (np.zeros((5, 2)), {}, ArrayError, "points_world"),
        (np.zeros((5, 3), np.float32), {}, ArrayError, "points_world"),
        (np.zeros(3), {}, ArrayError, "points_world"),
        (np.zeros((5, 3)), {"rgb": np.zeros((640, 480, 3), np.uint8)}, ArrayError, r"view\.rgb"),
        (np.zeros((5, 3)), {"camera": replace(CAMERA, model="mirror")}, CalibrationError, "mirror"),
    ]:
        with pytest.raises(error, match=message):
            view(points, **options)


PINHOLE = Camera("pinhole", 640, 480, 400.0, 400.0, 319.5, 239.5)
BARREL = Camera("brown_conrady", 640, 480, 400.0, 400.0, 319.5, 239.5, (-0.3, 0.0))
WIDE = Camera("fisheye", 640, 640, 150.0, 150.0, 319.5, 319.5)


def observations_of(points_camera, camera, *, enabled=True):
    known = np.isfinite(points_camera)
    points_world = np.where(known, POSE.apply(np.nan_to_num(points_camera, posinf=0)), points_camera)
    found = view(points_world, camera, VisibilitySettings(enabled=enabled))
    return found, found.observations


def at_angle(degrees, distance=10.0):
    return distance * math.sin(math.radians(degrees)), 0.0, distance * math.cos(math.radians(degrees))


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize("camera", [PINHOLE, BARREL, WIDE], ids=lambda camera: camera.model)
def test_observations_agree_with_the_points_in_the_image(camera, enabled):
    points = np.random.default_rng(3).normal(size=(20_000, 3)) * [5, 5, 5]
    found, observations = observations_of(points, camera, enabled=enabled)
    np.testing.assert_array_equal(np.flatnonzero(observations <= PointVisibility.HIDDEN), found.point_ids)
    visible = np.flatnonzero(observations == PointVisibility.VISIBLE)
    np.testing.assert_array_equal(visible, found.point_ids[found.visible])
    assert len(np.unique(observations)) == (3 if camera is WIDE else 4)


def test_each_point_is_told_from_what_the_camera_model_can_see_and_what_a_wall_hides():
    for camera, points, expected in [
        (PINHOLE, [(0, 0, 5), (9, 0, 5), (0, 0, -5), (0, 0, 0)], "VISIBLE OUTSIDE BEHIND BEHIND"),
        # The polynomial of this camera model folds where 1 - 0.9 r² is 0: 46.5 degrees off the axis.
        (BARREL, [at_angle(45), (0, 9, 9), at_angle(48), at_angle(100)], "VISIBLE OUTSIDE BEHIND BEHIND"),
        # 320 px from the centre are 122 degrees; the camera model has pixels for all directions.
        (WIDE, [at_angle(60), at_angle(110), at_angle(130), at_angle(179)], "VISIBLE VISIBLE OUTSIDE OUTSIDE"),
        (PINHOLE, [(math.nan, 0, 5), (0, math.inf, 5), (0, 0, 3)], "BEHIND BEHIND VISIBLE"),
        (PINHOLE, [], ""),
    ]:
        _, observations = observations_of(np.array(points, float).reshape(-1, 3), camera)
        assert observations.dtype == np.uint8
        assert [PointVisibility(visibility).name for visibility in observations] == expected.split()
    across = 5 * np.mgrid[-0.5:0.5:0.02, -0.5:0.5:0.02].reshape(2, -1).T
    wall = np.insert(across, 2, 5.0, axis=1)
    _, observations = observations_of(np.array([*wall, [0.01, 0.01, 30.0]]), PINHOLE)
    assert np.flatnonzero(observations == PointVisibility.HIDDEN).tolist() == [len(wall)]


THREADS_CAMERA = Camera("brown_conrady", 320, 200, 200.0, 200.0, 159.5, 99.5, (-0.1, 0.02, 5e-4, -3e-4, 1e-3, 0.05))
COUNT = 30_000  # enough for threads to share them


@pytest.fixture(scope="module")
def rough_walls():
    """Two walls behind each other, rough, the nearer one with holes; some points behind the camera, some nowhere."""
    random = np.random.default_rng(5)
    x, y = random.uniform(-8, 8, (2, COUNT))
    z = np.where(random.random(COUNT) < 0.5, 20.0, 9.0) + random.normal(scale=0.02, size=COUNT)
    points = np.stack([x, y, z], axis=1)
    points[::50] *= -1
    points[::77] = math.nan
    return points


@pytest.mark.parametrize("images", [1, 2, 5])
@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize("known_trajectory", [False, True])
@pytest.mark.parametrize("enabled", [False, True])
def test_any_number_of_threads_gives_the_same_bits(rough_walls, images, threads, known_trajectory, enabled):
    fractions, requests = np.linspace(0, 1, COUNT, dtype=np.float32), []
    trajectory = LidarTrajectory(np.array([[0, -0.8, 0], [0.2, -0.8, 0.1]]), fractions) if known_trajectory else None
    for k in range(images):
        rotation = np.array([0, math.sin(k / 20), 0, math.cos(k / 20)])
        rgb = np.random.default_rng(k).integers(0, 255, (200, 320, 3), np.uint8)
        pose = RigidTransform.from_quaternion(np.array([0.1 * k, 0, 0]), rotation)
        requests.append(request(f"camera {k}", k, pose, rgb, THREADS_CAMERA))
    alone, shared = (VisibilitySettings(enabled=enabled, threads=size) for size in (1, threads))
    alone, shared = (fuse_by_projection(rough_walls, requests, how, trajectory=trajectory) for how in (alone, shared))
    np.testing.assert_array_equal(shared.colors, alone.colors)
    np.testing.assert_array_equal(shared.camera_index, alone.camera_index)
    for one, other in zip(shared.views, alone.views, strict=True):
        assert one.camera_id == other.camera_id
        for name in ("point_ids", "pixels", "depths", "visible", "depth_image"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert 0.05 < np.mean([1 - view.visible.mean() for view in alone.views]) < 0.95
