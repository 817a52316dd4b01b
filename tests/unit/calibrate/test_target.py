"""A checkerboard in images and clouds, against exact scenes and OpenCV's detector."""

import cv2
import numpy as np
import pytest

from sceneloom.calibrate import checkerboard
from sceneloom.calibrate.extrinsics import step_between
from sceneloom.cameras import project, unproject
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform, quaternion_from_rotation_vector

BOARD = checkerboard.Board(7, 5, 0.12, 1.1, 0.86)
CAMERA = Camera("brown_conrady", 600, 380, 465.0, 465.0, 301.0, 186.0, (-0.1, 0.02, 0.0005, -0.0003, 0.0))
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAMERA_FROM_LIDAR = RigidTransform.from_quaternion(
    np.array([0.12, -0.25, -0.4]), quaternion_from_rotation_vector(np.radians([1.0, -2.0, 1.5]))
) @ RigidTransform(AXES, np.zeros(3))
LOCATIONS = [
    (-0.5, 0.1, 3.2, 25.0, 20.0, 8.0),
    (0.6, -0.1, 3.5, -30.0, 15.0, -12.0),
    (0.0, 0.2, 2.6, 10.0, -35.0, 20.0),
    (0.4, 0.0, 4.2, -15.0, -25.0, 5.0),
    (-0.8, -0.2, 4.0, 20.0, 35.0, -20.0),
]


def rendered(camera, camera_from_board, board, *, seed=0):
    """The board before a grey wall, (H, W) float32, four rays a pixel."""
    total = np.zeros((camera.height, camera.width))
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    for du, dv in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        rays = unproject(camera, np.stack([u.ravel() + du, v.ravel() + dv], axis=1))
        total += _brightness(rays, camera_from_board, board).reshape(total.shape)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, total.shape)
    return np.clip(total / 4.0 + noise, 0, 255).astype(np.float32)


def _brightness(rays, camera_from_board, board):
    x, y, hit = _on_board(rays, np.zeros(3), camera_from_board)
    column = np.floor(x / board.square + (board.columns + 1) / 2.0)
    row = np.floor(y / board.square + (board.rows + 1) / 2.0)
    on = hit & (np.abs(x) < board.width / 2) & (np.abs(y) < board.height / 2)
    pattern = (column >= 0) & (column <= board.columns) & (row >= 0) & (row <= board.rows)
    black = pattern & ((column + row) % 2 == 0)
    return np.where(on, np.where(black, 30.0, 225.0), 110.0)


def _on_board(rays, origin, frame_from_board):
    inverse = frame_from_board.inverse()
    directions, start = inverse.rotate(rays), inverse.apply(origin)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -start[2] / directions[:, 2]
    locations = start + distance[:, None] * directions
    return locations[:, 0], locations[:, 1], np.isfinite(distance) & (distance > 0)


def cloud(lidar_from_board, board, *, noise, seed=0):
    """What a lidar 1.5 m above flat ground measures of the board and the ground, (N, 3) [m]."""
    azimuths = np.radians(np.arange(-60.0, 60.0, 0.2))
    elevations = np.radians(np.arange(-25.0, 15.0, 0.4))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuths, elevations))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    x, y, hit = _on_board(rays, np.zeros(3), lidar_from_board)
    on = hit & (np.abs(x) < board.width / 2) & (np.abs(y) < board.height / 2)
    with np.errstate(divide="ignore"):
        ground = np.where(rays[:, 2] < 0, -1.5 / rays[:, 2], np.inf)
    local = np.stack([x, y, np.zeros_like(x)], axis=1)
    ranges = np.where(on, np.linalg.norm(lidar_from_board.apply(local), axis=1), ground)
    ranges = ranges + np.random.default_rng(seed).normal(0.0, noise, len(ranges))
    seen = np.isfinite(ranges) & (ranges < 30.0)
    return rays[seen] * ranges[seen, None]


def placed(location):
    """`camera_from_board`."""
    rotation = quaternion_from_rotation_vector(np.radians(location[3:]))
    return RigidTransform.from_quaternion(np.array(location[:3]), rotation)


def test_corners_lie_where_they_were_rendered_and_opencv_finds_them_and_the_pose_is_found_from_them_and_the_cloud():
    for location in LOCATIONS:
        corners = checkerboard.find_corners(rendered(CAMERA, placed(location), BOARD), BOARD)
        assert corners is not None
        truth, visible = project(CAMERA, placed(location).apply(BOARD.corners))
        assert visible.all()
        error = min(np.sqrt(np.mean(np.sum((order - truth) ** 2, axis=1))) for order in (corners, corners[::-1]))
        assert error < 0.15  # noise of 2 grey levels moves a saddle by some hundredths of a pixel
    image = rendered(CAMERA, placed(LOCATIONS[0]), BOARD)
    ours = checkerboard.find_corners(image, BOARD)
    found, theirs = cv2.findChessboardCornersSB(image.astype(np.uint8), (BOARD.columns, BOARD.rows))
    assert found
    assert ours is not None
    theirs = theirs.reshape(-1, 2)
    differences = [np.abs(order - theirs).max() for order in (ours, ours[::-1])]
    assert min(differences) < 0.35  # both are good to some tenths of a pixel at single corners
    truth = placed(LOCATIONS[1])
    pixels, _ = project(CAMERA, truth.apply(BOARD.corners))
    found = checkerboard.board_pose(CAMERA, pixels, BOARD)
    assert found is not None
    np.testing.assert_allclose(step_between(found[0], truth), 0.0, atol=1e-6)
    assert found[1] < 1e-5
    lidar_from_board = CAMERA_FROM_LIDAR.inverse() @ placed(LOCATIONS[0])
    points = cloud(lidar_from_board, BOARD, noise=0.01)
    found = checkerboard.board_in_cloud(points, BOARD)
    assert found is not None
    assert abs(found.normal @ lidar_from_board.rotation[:, 2]) > np.cos(np.radians(1.0))
    assert np.linalg.norm(found.center - lidar_from_board.translation) < 0.05
    assert checkerboard.board_in_cloud(points, checkerboard.Board(7, 5, 0.12, 2.4, 1.9)) is None
    assert checkerboard.board_in_cloud(np.zeros((0, 3)), BOARD) is None


@pytest.mark.slow
def test_images_without_the_whole_board_give_nothing():
    rng = np.random.default_rng(0)
    assert checkerboard.find_corners(np.zeros((200, 300), np.float32), BOARD) is None
    assert checkerboard.find_corners(rng.uniform(0, 255, (200, 300)).astype(np.float32), BOARD) is None
    image = rendered(CAMERA, placed(LOCATIONS[0]), BOARD)
    assert checkerboard.find_corners(image[:, 250:], BOARD) is None


@pytest.fixture(scope="module")
def views():
    """What camera and lidar report all locations, with 1 cm of noise."""
    found = []
    for seed, location in enumerate(LOCATIONS):
        corners = checkerboard.find_corners(rendered(CAMERA, placed(location), BOARD, seed=seed), BOARD)
        assert corners is not None
        pose = checkerboard.board_pose(CAMERA, corners, BOARD)
        points = cloud(CAMERA_FROM_LIDAR.inverse() @ placed(location), BOARD, noise=0.01, seed=seed)
        seen = checkerboard.board_in_cloud(points, BOARD)
        assert pose is not None
        assert seen is not None
        found.append(checkerboard.BoardView(pose[0], seen))
    return found


def test_five_views_of_a_board_give_the_mounting_and_boards_without_sense_and_few_or_like_views_are_refused(views):
    mounting = checkerboard.start_from_target(views, BOARD)
    step = step_between(mounting.a_from_b, CAMERA_FROM_LIDAR)
    assert np.degrees(np.linalg.norm(step[:3])) < 0.3
    assert np.linalg.norm(step[3:]) < 0.02
    assert (np.abs(step) < 4.0 * mounting.sigmas + 1e-9).all()
    assert mounting.unobserved == ()
    found = views[:1]
    with pytest.raises(PoseError, match="expected 3 or more"):
        checkerboard.start_from_target(found, BOARD)
    with pytest.raises(PoseError, match="rotated alike"):
        checkerboard.start_from_target(found * 4, BOARD)
    for text in ["", "7x5", "7x5:0.1:0.2", "2x5:0.1", "7x5:0.1:0.3x0.3", "axb:c"]:
        with pytest.raises(OptionError, match="expected"):
            checkerboard.Board.parse(text)
