"""Clouds from above and in perspective, with the ego."""

import cv2
import numpy as np
import pytest

from sceneloom.arrays import finite_rows
from sceneloom.errors import ArrayError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.visualization import EgoPosition, clouds, draw_cloud_above, draw_cloud_perspective
from sceneloom.visualization.clouds import find_ego, layout_map, viewpoint_behind

SIZE = (900, 640)
EGO = EgoPosition(np.array([100.0, 50.0, 0.0]), np.array([1.0, 0.0, 0.0]))
RED, GREEN = (255, 0, 0), (0, 255, 0)
LAYOUT = layout_map((100.0, 50.0), 20.0, SIZE)


def _draw(points, colors, *, draw=draw_cloud_above, ego=EGO, **options):
    points = np.array(points, np.float32).reshape(-1, 3)
    colors = None if colors is None else np.array(colors, np.uint8).reshape(-1, 3)
    return np.asarray(draw(points, colors, **{"size_px": SIZE, "ego": ego, "reach": 20.0, **options})).astype(int)


def _pixel(layout, drawn, x, y):
    """The colour of a map at a position."""
    column, row = np.rint(layout.pixels(np.array([[x, y]]))[0]).astype(int)
    return drawn[layout.top + row, layout.left + column]


def _middle(drawn, channel):
    """Column and row of the middle of what is drawn in one pure colour."""
    others = [other for other in range(3) if other != channel]
    rows, columns = np.nonzero((drawn[..., channel] > 200) & (drawn[..., others] < 70).all(axis=2))
    assert len(rows) > 0
    return np.array([(columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2])


def _bar_length(drawn):
    """Length [px] between the ends of the scale bar, the longest light line of the image."""
    light = (drawn > 215).all(axis=2)
    longest = 0
    for row in light:
        dark = np.flatnonzero(~np.concatenate([[False], row, [False]]))
        longest = max(longest, int(np.diff(dark).max()) - 1)
    return longest - 1


def test_points_lie_at_their_metric_locations_the_higher_over_the_lower():
    # Reach 20 m: the scale bar of this size is 10 m long.
    drawn = _draw([[112.0, 50.0, 0.0], [92.0, 57.0, 0.0]], [RED, GREEN])
    step = _middle(drawn, 1) - _middle(drawn, 0)
    px_per_m = _bar_length(drawn) / 10.0
    # 2 px: both ends of the bar and the middles of the discs are rounded to pixels.
    assert step == pytest.approx([-20.0 * px_per_m, -7.0 * px_per_m], abs=2.0)
    for points, colors in (([[105, 55, 3], [105, 55, 0]], [RED, GREEN]), ([[105, 55, 0], [105, 55, 3]], [GREEN, RED])):
        red, green, _ = _pixel(LAYOUT, _draw(points, colors), 105.0, 55.0)
        assert (red > 200, green < 70) == (True, True)
    points = [[105, 55, 0], [np.nan, 0, 0], [0, np.inf, 0], [1e30, -1e30, 0]]
    top = slice(0, SIZE[1] - 100)
    assert np.array_equal(_draw(points[:1], [RED])[top], _draw(points, [RED] * 4)[top]), "others are passed over"
    points = np.random.default_rng(3).uniform(-14.0, 14.0, (500, 3)) + np.array([100, 50, 0])
    drawn = _draw(points, [RED] * 500, reach=None)
    # From the middle 14 m to each side: the next round reach is 15 m, the points fill most of the height.
    rows, _ = np.nonzero((drawn[..., 0] > 200) & (drawn[..., 1] < 70))
    assert np.ptp(rows) > 0.85 * layout_map((100.0, 50.0), 15.0, SIZE).height


def test_the_map_reaches_as_far_as_asked_and_its_grid_stands_at_multiples_of_its_spacing_wherever_it_is():
    corners = LAYOUT.pixels(np.array([[100.0, 50.0], [100.0, 70.0], [100.0, 30.0]]))
    assert corners[0] == pytest.approx([(LAYOUT.width - 1) / 2, (LAYOUT.height - 1) / 2])
    # The edges of the map are the outer edges of its first and last pixel.
    assert corners[1:, 1] == pytest.approx([-0.5, LAYOUT.height - 0.5])
    for axis, middle in ((0, 100.0), (1, 50.0)):
        lines = LAYOUT.grid(axis, 5.0)
        half = ((LAYOUT.width, LAYOUT.height)[axis] - 1) / 2 / LAYOUT.px_per_m
        assert [at for at, _ in lines] == [at for at in np.arange(-500.0, 500.0, 5.0) if abs(at - middle) <= half]
        for at, location in lines:
            point = np.array([[at, 50.0] if axis == 0 else [100.0, at]])
            assert location == pytest.approx(LAYOUT.pixels(point)[0, axis], abs=0.5)
    zeros = [f"{at:g}" for at, _ in layout_map((0.0, 0.0), 20.0, SIZE).grid(1, 10.0) if at == 0]
    assert zeros == ["0"], "without a sign"
    for far in (1e9, 1e155, 1e300, 1.7e308, -1.7e308):
        points = clouds.sample_polyline(np.array([[0.0, 0.0, 0.0], [far, 0.0, 0.0], [0.0, far, 0.0]]), 0.5)
        assert len(points) > 2
        assert finite_rows(points).all()
    for far in (1e17, 1e300, 1.7e308):
        assert len(layout_map((far, -far), 50.0, (640, 480)).grid(0, 10.0)) < 1000


def test_points_that_no_camera_saw_are_grey_and_the_ego_is_marked_in_the_middle():
    points = [[104.0 + 4 * k, 50.0, float(k)] for k in range(4)]
    index = np.array([255, 255, 255, 0], np.uint8)
    drawn = _draw(points, [RED] * 4, camera_index=index)
    colours = np.array([_pixel(LAYOUT, drawn, x, y) for x, y, _ in points])
    assert np.ptp(colours[:3], axis=1).max() < 30
    assert (np.diff(colours[:3].mean(axis=1)) > 5).all()
    assert colours[3].tolist()[0] > 200
    path = np.column_stack([np.linspace(80, 120, 9), np.full(9, 60.0), np.zeros(9)])
    marked = _draw([], [], ego_path=path)
    r, g, b = _pixel(LAYOUT, marked, 100.0, 50.0)
    assert r > g > b
    r, g, b = _pixel(LAYOUT, marked, 91.3, 60.0)
    assert r > g > b > 60
    grey = _draw([], [], ego=None)[LAYOUT.top :, LAYOUT.left :][: LAYOUT.height, : LAYOUT.width]
    assert np.ptp(grey, axis=2).max() < 30


def test_what_cannot_be_drawn_is_refused():
    for options, error, message in [
        ({"reach": 0.0}, OptionError, "reach 0.0 m"),
        ({"reach": float("nan")}, OptionError, "positive"),
        ({"size_px": (200, 640)}, OptionError, "200x640 px; expected at least 320x240"),
        ({"camera_index": np.zeros(2, np.uint8)}, ArrayError, "camera_index"),
    ]:
        with pytest.raises(error, match=message):
            _draw([[105, 55, 0]], [RED], **options)
    with pytest.raises(ArrayError, match=r"points_world: \(4, 2\)"):
        draw_cloud_above(np.zeros((4, 2)), None)
    for options, message in (({"reach": -1}, "reach -1"), ({"size_px": (900, 100)}, "expected at least 320x240")):
        with pytest.raises(OptionError, match=message):
            _draw([], [], draw=draw_cloud_perspective, **options)


DRIVER = EgoPosition(np.array([100.0, 50.0, 1.0]), np.array([0.0, 1.0, 0.0]))


def _perspective(points, colors, **options):
    return _draw(points, colors, draw=draw_cloud_perspective, ego=DRIVER, **options)


def _area(drawn, channel):
    """Rows and columns of what is drawn in one pure colour, as far as haze leaves it pure."""
    others = [other for other in range(3) if other != channel]
    return np.nonzero((drawn[..., channel] > 150) & (drawn[..., others] < 60).all(axis=2))


def test_points_are_projected_as_by_opencv_and_near_ones_are_larger_and_cover_far_ones():
    viewpoint = clouds.Viewpoint(np.array([3.0, -4.0, 7.0]), np.array([10.0, 12.0, 1.0]), 800, 500)
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
    # The ego faces along y of the world, so that its left is towards smaller x.
    for axis, height in ((1, 0), (0, 5)):
        drawn = _perspective([[95, 60, height], [105, 60, 0]], [RED, GREEN])
        assert _area(drawn, 0)[axis].max() < _area(drawn, 1)[axis].min()
    eye = viewpoint_behind(DRIVER, 20.0, *SIZE).eye_world
    near = np.array([101.0, 62.0, 0.5])
    points, colors = [near, eye + 2.0 * (near - eye)], [RED, GREEN]
    for order in (1, -1):
        drawn = _perspective(points[::order], colors[::order])
        assert (len(_area(drawn, 0)[0]) > 0, len(_area(drawn, 1)[0])) == (True, 0)
    drawn = _perspective([[100, 54, 0], [100, 90, 0]], [RED, GREEN])
    assert len(_area(drawn, 0)[0]) > 2 * len(_area(drawn, 1)[0])
    behind = eye - 5.0 * DRIVER.forward_world
    one, both = _perspective([[100, 60, 0]], [RED]), _perspective([[100, 60, 0], behind], [RED, GREEN])
    assert np.array_equal(one[: SIZE[1] - 100], both[: SIZE[1] - 100]), "what is behind the eye is not drawn"
    drawn = _perspective([[95, 60, 0], [105, 60, 0]], [RED, GREEN], camera_index=np.array([0, 255], np.uint8))
    assert (len(_area(drawn, 0)[0]) > 0, len(_area(drawn, 1)[0])) == (True, 0), "what no camera saw is grey"


def test_the_eye_stands_behind_and_above_the_ego_and_sees_it_its_path_and_the_light_at_the_horizon():
    viewpoint = viewpoint_behind(DRIVER, 20.0, *SIZE)
    offset = viewpoint.eye_world - DRIVER.position_world
    assert offset @ DRIVER.forward_world < 0
    assert offset[2] > 0
    far = DRIVER.position_world + 1e6 * DRIVER.forward_world
    pixels, depths = viewpoint.project(np.array([DRIVER.position_world, far]))
    assert (depths > 0).all()
    # The ego in the middle of the lower half, the horizon in the upper half.
    assert pixels[0] == pytest.approx([(SIZE[0] - 1) / 2, pixels[0, 1]])
    assert SIZE[1] / 2 < pixels[0, 1] < SIZE[1]
    assert 0 < pixels[1, 1] < SIZE[1] / 2
    path = np.column_stack([np.full(20, 100.0), np.linspace(40, 90, 20), np.full(20, 1.0)])
    drawn = _perspective([], [], ego_path=path)
    # rows above the strip, whose left column has one colour to the end
    column = drawn[:, 0]
    height = int(np.flatnonzero((column != column[-1]).any(axis=1)).max()) + 1
    viewpoint = viewpoint_behind(DRIVER, 20.0, SIZE[0], height)
    for location in (DRIVER.position_world, np.array([100.0, 60.0, 1.0])):
        column, row = np.rint(viewpoint.project(location[None])[0][0]).astype(int)
        r, g, b = drawn[row, column]
        assert r > g > b
        assert r - b > 50
    column = clouds.background(10, 300)[:, 0].astype(int).sum(axis=1)
    lightest = int(np.argmax(column))
    assert 60 < lightest < 150
    assert (np.diff(column[:lightest]) >= 0).all()
    assert (np.diff(column[lightest + 1 :]) <= 0).all()


@pytest.mark.parametrize(("draw", "size"), [(draw_cloud_above, (1280, 900)), (draw_cloud_perspective, (1280, 780))])
def test_a_cloud_without_points_is_an_empty_stage_and_drawing_twice_gives_the_same_image(draw, size):
    for ego in (None, DRIVER):
        assert draw(np.zeros((0, 3), np.float32), None, ego=ego).size == size
    points = np.random.default_rng(1).normal(0, 10, (3000, 3)) + np.array([100, 60, 0])
    assert np.array_equal(*(_draw(points, [RED] * 3000, draw=draw) for _ in range(2)))


# An IMU whose x points to the left of the car, as z stays up.
ROTATED = RigidTransform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 0.0, 1.0]))


def test_forward_is_where_the_path_leads_or_the_first_camera_looks(make_view):
    path = np.column_stack([np.linspace(0, 10, 11), np.zeros(11), np.linspace(0, 2, 11)])
    ego = find_ego(ROTATED, path, ())
    assert ego.position_world.tolist() == [5.0, 0.0, 1.0]
    assert ego.forward_world == pytest.approx([1.0, 0.0, 0.0])
    angles = np.linspace(0, np.pi, 181)
    path = np.column_stack([30 * np.cos(angles), 30 * np.sin(angles), np.zeros(181)])
    ego = find_ego(RigidTransform(np.eye(3), path[90].copy()), path, ())
    # The path is known every 0.5 m of a circle of 30 m: half a step is 0.0087 rad.
    assert ego.forward_world == pytest.approx([-1.0, 0.0, 0.0], abs=0.01)
    view = make_view([])
    for path in (None, np.zeros((5, 3)), np.zeros((0, 3)), np.full((3, 3), np.nan)):
        assert find_ego(ROTATED, path, [view]).forward_world == pytest.approx([1.0, 0.0, 0.0])
    assert find_ego(ROTATED, None, ()).forward_world == pytest.approx([0.0, 1.0, 0.0])
    assert find_ego(None, None, [view]).position_world == pytest.approx(view.world_from_camera.translation)
    assert find_ego(None, None, ()) is None
    upright = RigidTransform(np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), np.zeros(3))
    assert find_ego(upright, None, ()).forward_world == pytest.approx([1.0, 0.0, 0.0]), "somewhere level"
    corners = EgoPosition(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0])).arrow(2.0)
    assert np.ptp(corners, axis=0)[1] == pytest.approx(2.0)
    assert corners[0] == pytest.approx([1.0, 2.0 + 1.2, 3.0])
    assert corners[:, 0].mean() == pytest.approx(1.0)
    assert clouds.middle_of(np.zeros((0, 3))).position_world.tolist() == [0.0, 0.0, 0.0]
    points = np.array([[1.0, 5.0, 0.0], [2.0, 4.0, 9.0], [90.0, 3.0, 1.0]])
    assert clouds.middle_of(points).position_world.tolist() == [2, 4, 1]
