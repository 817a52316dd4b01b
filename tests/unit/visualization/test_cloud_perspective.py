import cv2
import numpy as np
import pytest

from sceneloom.errors import OptionError
from sceneloom.visualization import EgoPosition, draw_cloud_perspective
from sceneloom.visualization.clouds import Viewpoint, background, viewpoint_behind

SIZE = (900, 640)
EGO = EgoPosition(np.array([100.0, 50.0, 1.0]), np.array([0.0, 1.0, 0.0]))
RED, GREEN = (255, 0, 0), (0, 255, 0)


def _draw(points, colors, **options):
    return np.asarray(
        draw_cloud_perspective(
            np.array(points, np.float32).reshape(-1, 3),
            np.array(colors, np.uint8).reshape(-1, 3),
            **{"size_px": SIZE, "ego": EGO, "reach": 20.0, **options},
        )
    ).astype(int)


def _area(drawn, channel):
    """Rows and columns of what is drawn in one pure colour, as far as haze leaves it pure."""
    others = [other for other in range(3) if other != channel]
    return np.nonzero((drawn[..., channel] > 150) & (drawn[..., others] < 60).all(axis=2))


def test_points_are_projected_as_opencv_projects_them():
    viewpoint = Viewpoint(np.array([3.0, -4.0, 7.0]), np.array([10.0, 12.0, 1.0]), 800, 500)
    rng = np.random.default_rng(5)
    points = rng.uniform(-6, 6, (200, 3)) + np.array([10.0, 12.0, 1.0])
    # The pinhole's axes by hand: forward to the target, right level, down the rest.
    forward = np.array([7.0, 16.0, -6.0]) / np.sqrt(49 + 256 + 36)
    right = np.array([16.0, -7.0, 0.0]) / np.sqrt(256 + 49)
    rotation = np.array([right, np.cross(forward, right), forward])
    assert rotation[1, 2] < 0
    focal = 400 / np.tan(np.deg2rad(31.0))
    matrix = np.array([[focal, 0, 399.5], [0, focal, 249.5], [0, 0, 1.0]])
    shift = -rotation @ viewpoint.eye_world
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], shift, matrix, None)
    pixels, depths = viewpoint.project(points)
    assert pixels == pytest.approx(expected[:, 0], abs=1e-6)
    assert depths == pytest.approx((points - viewpoint.eye_world) @ forward)


def test_the_eye_stands_behind_and_above_the_ego_and_sees_it():
    viewpoint = viewpoint_behind(EGO, 20.0, *SIZE)
    offset = viewpoint.eye_world - EGO.position_world
    assert offset @ EGO.forward_world < 0
    assert offset[2] > 0
    pixels, depths = viewpoint.project(
        np.array([EGO.position_world, EGO.position_world + 1e6 * EGO.forward_world])
    )
    assert (depths > 0).all()
    # The ego in the middle of the lower half, the horizon in the upper half.
    assert pixels[0] == pytest.approx([(SIZE[0] - 1) / 2, pixels[0, 1]])
    assert SIZE[1] / 2 < pixels[0, 1] < SIZE[1]
    assert 0 < pixels[1, 1] < SIZE[1] / 2


def test_left_is_left_and_up_is_up():
    # The ego faces along y of the world, so that its left is towards smaller x.
    drawn = _draw([[95, 60, 0], [105, 60, 0]], [RED, GREEN])
    assert _area(drawn, 0)[1].max() < _area(drawn, 1)[1].min()
    drawn = _draw([[95, 60, 5], [105, 60, 0]], [RED, GREEN])
    assert _area(drawn, 0)[0].max() < _area(drawn, 1)[0].min()


@pytest.mark.parametrize("order", [1, -1])
def test_near_points_cover_far_ones_on_the_same_ray(order):
    eye = viewpoint_behind(EGO, 20.0, *SIZE).eye_world
    near = np.array([101.0, 62.0, 0.5])
    points, colors = [near, eye + 2.0 * (near - eye)], [RED, GREEN]
    drawn = _draw(points[::order], colors[::order])
    assert len(_area(drawn, 0)[0]) > 0
    assert len(_area(drawn, 1)[0]) == 0


def test_near_points_are_larger_than_far_ones():
    drawn = _draw([[100, 54, 0], [100, 90, 0]], [RED, GREEN])
    assert len(_area(drawn, 0)[0]) > 2 * len(_area(drawn, 1)[0])


def test_points_behind_the_eye_are_not_drawn():
    eye = viewpoint_behind(EGO, 20.0, *SIZE).eye_world
    behind = eye - 5.0 * EGO.forward_world
    top = slice(0, SIZE[1] - 100)
    assert np.array_equal(_draw([[100, 60, 0]], [RED])[top], _draw([[100, 60, 0], behind], [RED, GREEN])[top])


def test_points_that_no_camera_saw_are_grey():
    drawn = _draw([[95, 60, 0], [105, 60, 0]], [RED, GREEN], camera_index=np.array([0, 255], np.uint8))
    assert len(_area(drawn, 0)[0]) > 0
    assert len(_area(drawn, 1)[0]) == 0


def test_the_ego_and_its_path_are_marked():
    path = np.column_stack([np.full(20, 100.0), np.linspace(40, 90, 20), np.full(20, 1.0)])
    drawn = _draw([], [], ego_path=path)
    viewpoint = viewpoint_behind(EGO, 20.0, SIZE[0], _plot_height(drawn))
    for location in (EGO.position_world, np.array([100.0, 60.0, 1.0])):
        column, row = np.rint(viewpoint.project(location[None])[0][0]).astype(int)
        r, g, b = drawn[row, column]
        assert r > g > b
        assert r - b > 50


def _plot_height(drawn):
    """Rows above the strip, whose left column has one colour to the end."""
    column = drawn[:, 0]
    return int(np.flatnonzero((column != column[-1]).any(axis=1)).max()) + 1


@pytest.mark.parametrize("ego", [None, EGO])
def test_a_cloud_without_points_is_an_empty_stage(ego):
    assert draw_cloud_perspective(np.zeros((0, 3), np.float32), None, ego=ego).size == (1280, 780)


def test_the_background_is_lightest_at_the_horizon():
    column = background(10, 300)[:, 0].astype(int).sum(axis=1)
    lightest = int(np.argmax(column))
    assert 60 < lightest < 150
    assert (np.diff(column[:lightest]) >= 0).all()
    assert (np.diff(column[lightest + 1 :]) <= 0).all()


def test_drawing_twice_gives_the_same_image():
    points = np.random.default_rng(1).normal(0, 10, (3000, 3)) + np.array([100, 60, 0])
    assert np.array_equal(_draw(points, [RED] * 3000), _draw(points, [RED] * 3000))


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(OptionError, match="reach -1"):
        _draw([], [], reach=-1)
    with pytest.raises(OptionError, match="expected at least 320x240"):
        _draw([], [], size_px=(900, 100))
