"""Undistorted images, against OpenCV's."""

import numpy as np
import pytest

from sceneloom.cameras import Camera
from sceneloom.cameras.undistortion import Undistortion, undistorted_camera

cv2 = pytest.importorskip("cv2")

PERSPECTIVE = (-0.35, 0.15, 1e-3, -5e-4, -0.03)
RATIONAL = (0.45, -0.12, 2e-4, -3e-4, 0.004, 0.8, -0.08, 0.01)
FISHEYE = (0.05, -0.02, 0.01, -0.003)
CAMERAS = [
    Camera("brown_conrady", 1242, 375, 721.5, 721.5, 609.6, 172.9, PERSPECTIVE),
    Camera("brown_conrady", 1242, 375, 721.5, 721.5, 609.6, 172.9, RATIONAL),
    Camera("fisheye", 1242, 375, 421.5, 420.0, 609.6, 172.9, FISHEYE),
]
EACH_CAMERA = pytest.mark.parametrize("camera", CAMERAS, ids=["five", "rational", "fisheye"])


def opencv_maps(camera, target):
    make = cv2.fisheye.initUndistortRectifyMap if camera.model == "fisheye" else cv2.initUndistortRectifyMap
    size = (target.width, target.height)
    numbers = np.array(camera.coefficients)
    return make(camera.matrix, numbers, np.eye(3), target.matrix, size, cv2.CV_32FC1)


@EACH_CAMERA
@pytest.mark.parametrize("keep", [0.0, 1.0])
def test_pixels_come_from_where_opencv_takes_them(camera, keep):
    maps = Undistortion.between(camera, undistorted_camera(camera, keep=keep))
    columns, rows = opencv_maps(camera, maps.target)
    expected = np.stack([columns, rows], axis=-1)
    inside = maps.seen
    assert inside.mean() > 0.3
    assert np.abs(maps.locations - expected)[inside].max() < 2e-4  # float32 of up to 1242 px


@EACH_CAMERA
def test_images_are_those_that_opencv_makes_of_a_real_one(camera, data_dir):
    from PIL import Image

    with Image.open(data_dir / "real" / "kitti_object" / "image_2" / "000001.png") as image:
        rgb = np.asarray(image.convert("RGB"))
    camera = camera.resized(rgb.shape[1], rgb.shape[0])
    maps = Undistortion.between(camera, undistorted_camera(camera, keep=1.0))
    ours = maps.apply(rgb).astype(int)
    columns, rows = opencv_maps(camera, maps.target)
    exact = cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR)
    undo = cv2.fisheye.undistortImage if camera.model == "fisheye" else cv2.undistort
    usual = undo(rgb, camera.matrix, np.array(camera.coefficients), None, maps.target.matrix)
    size = [camera.width - 1, camera.height - 1]
    whole = ((maps.locations >= 0) & (maps.locations <= size)).all(axis=-1)  # OpenCV blends its border with black
    assert np.abs(ours - exact)[whole].max() <= 1
    # its own call takes weights of 1/32: next to black and white that is up to 255/64 levels and more
    off = np.abs(ours - usual)[whole]
    assert np.mean(off > 2) < 2e-3
    assert off.max() <= 8
