"""The camera models that OpenCV knows, and undistorted images, against OpenCV."""

import numpy as np
import pytest
from PIL import Image

from sceneloom.cameras import Camera, project_unbounded, unproject
from sceneloom.cameras.undistortion import Undistortion, undistorted_camera

cv2 = pytest.importorskip("cv2")

MATRIX = np.array([[901.3, 0.0, 957.2], [0.0, 898.7, 541.9], [0.0, 0.0, 1.0]])
NUMBERS = (1920, 1080, MATRIX[0, 0], MATRIX[1, 1], MATRIX[0, 2], MATRIX[1, 2])
DIFFERENCE_PX = 1e-9  # both compute in float64

EIGHT = (0.4461, -0.1213, 0.00017, -0.00025, 0.0035, 0.8021, -0.0771, 0.0110)
CAMERA_MODELS = [
    (-0.3437, 0.1402, 0.00031, -0.00082, -0.0271),
    EIGHT,
    (*EIGHT, 1e-3, -2e-4, -1.5e-3, 3e-4),  # with a prism, and tilted
    (-0.2, 0.05, 0.0003, -0.0008, 0.001, 0.02, 0.01, 0.002, 1e-3, -2e-4, -1.5e-3, 3e-4, 0.031, -0.047),
]


def brown_conrady(coefficients: tuple[float, ...]) -> Camera:
    """OpenCV's order has no lx, ly between k6 and s1."""
    ours = (*coefficients[:8], 0.0, 0.0, *coefficients[8:]) if len(coefficients) > 8 else coefficients
    return Camera("brown_conrady", *NUMBERS, ours)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """Points in front of the camera, up to 40 degrees off its axis and a little outside the image."""
    z = np.random.default_rng(0).uniform(1, 80, (2000, 1))
    return np.hstack([np.random.default_rng(1).uniform(-1, 1, (2000, 2)) * (1.05, 0.6) * z, z])


@pytest.mark.parametrize("coefficients", [None, *CAMERA_MODELS])
def test_pinhole_and_brown_conrady_project_and_unproject_as_opencv_does(points, coefficients):
    camera = Camera("pinhole", *NUMBERS) if coefficients is None else brown_conrady(coefficients)
    distortion = None if coefficients is None else np.array(coefficients)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, distortion)
    assert np.abs(project_unbounded(camera, points) - expected[:, 0]).max() < DIFFERENCE_PX
    rays = unproject(camera, expected[:, 0])
    assert np.abs(rays[:, :2] / rays[:, 2:] - points[:, :2] / points[:, 2:]).max() < 1e-9  # a millionth of a pixel


@pytest.mark.parametrize("coefficients", [(), (0.0345, -0.0121, 0.0053, -0.0018), (-0.05, 0.01)])
def test_fisheye_projects_to_its_edge_and_unprojects_as_opencv_does(points, points_all_around, coefficients):
    four = np.array([*coefficients, *(0.0,) * (4 - len(coefficients))])
    camera = Camera("fisheye", *NUMBERS, coefficients)
    for ahead in (points_all_around[points_all_around[:, 2] > 0], points):
        expected, _ = cv2.fisheye.projectPoints(ahead[:, None], np.zeros(3), np.zeros(3), MATRIX, four)
        assert np.abs(project_unbounded(camera, ahead) - expected[:, 0]).max() < DIFFERENCE_PX
    plane = cv2.fisheye.undistortPoints(expected, MATRIX, four)[:, 0]
    rays = unproject(camera, expected[:, 0])
    assert np.abs(rays[:, :2] / rays[:, 2:] - plane).max() < 1e-7  # OpenCV stops its iterations at 1e-8


@pytest.fixture(scope="module")
def points_all_around() -> np.ndarray:
    """Points up to 100 degrees off the axis."""
    random = np.random.default_rng(2)
    angle, about = np.radians(random.uniform(0, 100, 2000)), random.uniform(0, 2 * np.pi, 2000)
    rays = np.stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)], axis=1)
    return rays * random.uniform(1, 80, (2000, 1))


@pytest.mark.parametrize(
    "coefficients",
    [
        (0.0, 0.0, 0.0, 1.1, 0.0, 0.0),
        (-0.21, 0.043, 0.0, 0.87, 0.0011, -0.0023),
        (-0.21, 0.043, 1.73, 1.34, 0.0011, -0.0023),
    ],
)
def test_omnidir_projects_as_opencv_does_behind_the_camera_too(points_all_around, coefficients):
    k1, k2, skew, xi, p1, p2 = coefficients
    matrix = np.add(MATRIX, [[0, skew, 0], [0, 0, 0], [0, 0, 0]])
    none, points = np.zeros(3), points_all_around[None]
    expected, _ = cv2.omnidir.projectPoints(points, none, none, matrix, xi, np.array([[k1, k2, p1, p2]]))
    camera = Camera("omnidir", *NUMBERS, coefficients)
    found = project_unbounded(camera, points_all_around)
    assert np.abs(found - expected[0]).max() < DIFFERENCE_PX
    if skew == 0:  # the same camera model in the words of the Sensor Fusion Scene format
        same = Camera("omnidirectional", *NUMBERS, (k1, k2, 0, 0, p1, p2, xi))
        assert np.abs(project_unbounded(same, points_all_around) - expected[0]).max() < DIFFERENCE_PX


PERSPECTIVE = (-0.35, 0.15, 1e-3, -5e-4, -0.03)
RATIONAL = (0.45, -0.12, 2e-4, -3e-4, 0.004, 0.8, -0.08, 0.01)
FISHEYE_FOUR = (0.05, -0.02, 0.01, -0.003)
UNDISTORTED = [
    Camera("brown_conrady", 1242, 375, 721.5, 721.5, 609.6, 172.9, PERSPECTIVE),
    Camera("brown_conrady", 1242, 375, 721.5, 721.5, 609.6, 172.9, RATIONAL),
    Camera("fisheye", 1242, 375, 421.5, 420.0, 609.6, 172.9, FISHEYE_FOUR),
]


def opencv_maps(camera, target):
    make = cv2.fisheye.initUndistortRectifyMap if camera.model == "fisheye" else cv2.initUndistortRectifyMap
    size = (target.width, target.height)
    numbers = np.array(camera.coefficients)
    return make(camera.matrix, numbers, np.eye(3), target.matrix, size, cv2.CV_32FC1)


@pytest.mark.parametrize("camera", UNDISTORTED, ids=["five", "rational", "fisheye"])
def test_undistorted_pixels_come_from_where_opencv_takes_them_and_images_are_its_images_of_a_real_one(camera, data_dir):
    for keep in (0.0, 1.0):
        maps = Undistortion.between(camera, undistorted_camera(camera, keep=keep))
        expected = np.stack(opencv_maps(camera, maps.target), axis=-1)
        assert maps.seen.mean() > 0.3
        assert np.abs(maps.locations - expected)[maps.seen].max() < 2e-4  # float32 of up to 1242 px
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
