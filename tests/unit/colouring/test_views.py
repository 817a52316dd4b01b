import math

import cv2
import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.visibility import VisibilitySettings
from sceneloom.errors import ArrayError, CalibrationError
from sceneloom.geometry.rigid import RigidTransform

CAMERA = Camera("brown_conrady", 640, 480, 520.0, 530.0, 322.0, 237.0, (-0.15, 0.05, 1e-3, -5e-4, -0.01))
POSE = RigidTransform.from_quaternion(np.array([4.0, -2.0, 1.5]), np.array([0.1, -0.7, 0.2, 0.4]))
PLAIN = VisibilitySettings(enabled=False)


def view(points_world, camera=CAMERA, visibility=PLAIN, rgb=None):
    image = np.zeros((camera.height, camera.width, 3), np.uint8) if rgb is None else rgb
    return view_points(
        points_world, camera, POSE, image, camera_id="c", timestamp_ns=7, visibility=visibility
    )


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


def test_points_fall_where_opencv_puts_them():
    points = cloud()
    fused = view(points)
    ids, pixels, depths = projected_by_opencv(points)
    assert len(ids) > 1000
    np.testing.assert_array_equal(fused.point_ids, ids)
    np.testing.assert_allclose(fused.pixels, pixels[ids], atol=1e-4)  # float32 keeps 3e-5 px of 640
    np.testing.assert_allclose(fused.depths, depths[ids], rtol=1e-6)


def test_the_plain_depth_image_holds_the_nearest_depth_of_each_pixel():
    fused = view(cloud(60_000))
    expected, nearest = np.zeros((480, 640), np.float32), {}
    for i, (u, v) in enumerate(fused.pixels.astype(float)):
        pixel = math.floor(v + 0.5), math.floor(u + 0.5)
        if pixel not in nearest or fused.depths[i] < fused.depths[nearest[pixel]]:
            nearest[pixel] = i
    for pixel, i in nearest.items():
        expected[pixel] = fused.depths[i]
    np.testing.assert_array_equal(fused.depth_image, expected)
    assert np.flatnonzero(fused.visible).tolist() == sorted(nearest.values())
    assert 0 < fused.visible.mean() < 1


def test_the_depth_image_holds_the_nearest_visible_depth_of_each_pixel():
    fused = view(cloud(60_000), visibility=VisibilitySettings())
    expected = np.full((480, 640), np.inf)
    columns, rows = np.floor(fused.pixels.astype(float) + 0.5).astype(int)[fused.visible].T
    np.minimum.at(expected, (rows, columns), fused.depths[fused.visible])
    np.testing.assert_array_equal(fused.depth_image, np.where(np.isinf(expected), 0, expected))
    assert 0.01 < fused.visible.mean() < 0.99


def test_a_view_keeps_what_it_was_given():
    fused = view(cloud(10))
    assert (fused.camera_id, fused.camera, fused.timestamp_ns) == ("c", CAMERA, 7)
    assert fused.world_from_camera is POSE


@pytest.mark.parametrize("visibility", [None, PLAIN], ids=["windowed", "plain"])
class TestFewPoints:
    def test_an_empty_cloud_gives_an_empty_view(self, visibility):
        fused = view(np.zeros((0, 3)), visibility=visibility)
        assert len(fused.point_ids) == len(fused.visible) == 0
        assert not fused.depth_image.any()

    def test_a_single_point_is_seen(self, visibility):
        fused = view(POSE.apply(np.array([[0.1, 0.2, 5.0]])), visibility=visibility)
        assert fused.visible.tolist() == [True]
        assert fused.depth_image.max() == pytest.approx(5.0)
        assert (fused.depth_image > 0).sum() == 1

    def test_points_that_are_not_finite_are_in_no_image(self, visibility):
        points = cloud(300)
        points[::3] = [math.nan, 0, 0]
        points[1::3, 1] = math.inf
        fused = view(points, visibility=visibility)
        assert len(fused.point_ids) > 0
        assert (fused.point_ids % 3 == 2).all()

    def test_an_image_of_one_pixel_works(self, visibility):
        camera = Camera("pinhole", 1, 1, 10.0, 10.0, 0.0, 0.0)
        fused = view(POSE.apply(np.array([[0, 0, 9.0], [0.01, 0, 3.0], [5, 0, 3]])), camera, visibility)
        assert fused.point_ids.tolist() == [0, 1]
        assert fused.depth_image.tolist() == [[3.0]]

    def test_points_behind_the_camera_are_in_no_image(self, visibility):
        assert (
            len(view(POSE.apply(np.array([[0, 0, -5.0], [0, 0, 0]])), visibility=visibility).point_ids) == 0
        )


def test_a_fisheye_sees_beside_and_behind_itself_but_such_points_have_no_depth():
    camera = Camera("fisheye", 900, 900, 200.0, 200.0, 449.5, 449.5, (0.0, 0.0, 0.0, 0.0))
    points = POSE.apply(np.array([[5.0, 0, 1], [5, 0, -1], [0, 0, 4]]))
    for visibility in (PLAIN, VisibilitySettings()):
        fused = view(points, camera, visibility)
        assert fused.visible.tolist() == [True] * 3
        assert sorted(fused.depth_image[fused.depth_image > 0].tolist()) == pytest.approx([1, 4])


def test_points_in_any_memory_order_are_taken():
    points = cloud(500)
    expected = view(points)
    for other in (np.asfortranarray(points), np.repeat(points, 2, axis=0)[::2], points[::-1][::-1]):
        fused = view(other)
        np.testing.assert_array_equal(fused.point_ids, expected.point_ids)
        np.testing.assert_array_equal(fused.depth_image, expected.depth_image)


def test_read_only_points_are_taken():
    points = cloud(500)
    points.flags.writeable = False
    assert len(view(points).point_ids) > 0


def test_a_view_of_few_points_does_not_hold_the_room_of_all():
    points = np.concatenate([cloud(10), POSE.apply(np.full((1000, 3), -5.0))])
    fused = view(points)
    assert all(a.base is None for a in (fused.point_ids, fused.pixels, fused.pixel_numbers, fused.depths))


def test_a_view_of_many_points_holds_no_more_than_its_own():
    points = np.concatenate([POSE.apply(np.full((1000, 3), [0.0, 0, 5])), POSE.apply(np.full((10, 3), -5.0))])
    fused = view(points)
    for held in (fused.point_ids, fused.pixels, fused.pixel_numbers, fused.depths):
        assert held.base.shape == (len(points), *held.shape[1:])


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.zeros((5, 3), np.float32), np.zeros(3)], ids=str)
def test_points_of_another_shape_or_type_are_refused(points):
    with pytest.raises(ArrayError, match="points_world"):
        view(points)


def test_an_image_of_another_size_is_refused():
    with pytest.raises(ArrayError, match=r"view\.rgb"):
        view(cloud(5), rgb=np.zeros((640, 480, 3), np.uint8))


def test_an_unknown_camera_model_is_refused():
    with pytest.raises(CalibrationError, match="mirror"):
        view(cloud(5), Camera("mirror", 640, 480, 500.0, 500.0, 320.0, 240.0))
