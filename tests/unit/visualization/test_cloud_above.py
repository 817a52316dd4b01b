import numpy as np
import pytest

from sceneloom.errors import ArrayError, OptionError
from sceneloom.visualization import EgoPosition, draw_cloud_above
from sceneloom.visualization.clouds import layout_map

SIZE = (900, 640)
EGO = EgoPosition(np.array([100.0, 50.0, 0.0]), np.array([1.0, 0.0, 0.0]))
RED, GREEN = (255, 0, 0), (0, 255, 0)


def _draw(points, colors, **options):
    return np.asarray(
        draw_cloud_above(
            np.array(points, np.float32).reshape(-1, 3),
            None if colors is None else np.array(colors, np.uint8).reshape(-1, 3),
            **{"size_px": SIZE, "ego": EGO, "reach": 20.0, **options},
        )
    ).astype(int)


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


def test_points_lie_at_their_metric_locations():
    # Reach 20 m: the scale bar of this size is 10 m long.
    drawn = _draw([[112.0, 50.0, 0.0], [92.0, 57.0, 0.0]], [RED, GREEN])
    step = _middle(drawn, 1) - _middle(drawn, 0)
    px_per_m = _bar_length(drawn) / 10.0
    # 2 px: both ends of the bar and the middles of the discs are rounded to pixels.
    assert step == pytest.approx([-20.0 * px_per_m, -7.0 * px_per_m], abs=2.0)


def test_the_map_reaches_as_far_as_asked_from_the_ego():
    layout = layout_map((100.0, 50.0), 20.0, SIZE)
    corners = layout.pixels(np.array([[100.0, 50.0], [100.0, 70.0], [100.0, 30.0]]))
    assert corners[0] == pytest.approx([(layout.width - 1) / 2, (layout.height - 1) / 2])
    # The edges of the map are the outer edges of its first and last pixel.
    assert corners[1:, 1] == pytest.approx([-0.5, layout.height - 0.5])


def test_the_lines_of_the_grid_stand_at_multiples_of_their_spacing():
    layout = layout_map((100.0, 50.0), 20.0, SIZE)
    for axis, middle in ((0, 100.0), (1, 50.0)):
        lines = layout.grid(axis, 5.0)
        half = ((layout.width, layout.height)[axis] - 1) / 2 / layout.px_per_m
        expected = [at for at in np.arange(-500.0, 500.0, 5.0) if abs(at - middle) <= half]
        assert [at for at, _ in lines] == expected
        for at, location in lines:
            point = np.array([[at, 50.0] if axis == 0 else [100.0, at]])
            assert location == pytest.approx(layout.pixels(point)[0, axis], abs=0.5)


def test_the_zero_of_the_grid_has_no_sign():
    layout = layout_map((0.0, 0.0), 20.0, SIZE)
    assert [f"{at:g}" for at, _ in layout.grid(1, 10.0) if at == 0] == ["0"]


def test_the_higher_point_is_drawn_over_the_lower():
    for points, colors in (
        ([[105, 55, 3], [105, 55, 0]], [RED, GREEN]),
        ([[105, 55, 0], [105, 55, 3]], [GREEN, RED]),
    ):
        drawn = _draw(points, colors)
        layout = layout_map((100.0, 50.0), 20.0, SIZE)
        column, row = np.rint(layout.pixels(np.array([[105.0, 55.0]]))[0]).astype(int)
        assert drawn[layout.top + row, layout.left + column, 0] > 200
        assert drawn[layout.top + row, layout.left + column, 1] < 70


def test_points_that_no_camera_saw_are_grey_and_lighter_the_higher():
    points = [[104.0 + 4 * k, 50.0, float(k)] for k in range(4)]
    index = np.array([255, 255, 255, 0], np.uint8)
    drawn = _draw(points, [RED] * 4, camera_index=index)
    layout = layout_map((100.0, 50.0), 20.0, SIZE)
    locations = np.rint(layout.pixels(np.array(points))).astype(int) + np.array([layout.left, layout.top])
    colours = drawn[locations[:, 1], locations[:, 0]]
    assert np.ptp(colours[:3], axis=1).max() < 30
    assert (np.diff(colours[:3].mean(axis=1)) > 5).all()
    assert colours[3].tolist()[0] > 200


def test_the_ego_is_marked_in_the_middle_and_its_path_drawn():
    path = np.column_stack([np.linspace(80, 120, 9), np.full(9, 60.0), np.zeros(9)])
    bare, marked = _draw([], [], ego=None, reach=20.0), _draw([], [], ego_path=path)
    layout = layout_map((100.0, 50.0), 20.0, SIZE)
    column, row = np.rint(layout.pixels(np.array([[100.0, 50.0]]))[0]).astype(int)
    r, g, b = marked[layout.top + row, layout.left + column]
    assert r > g > b
    line = np.rint(layout.pixels(np.array([[91.3, 60.0]]))[0]).astype(int)
    r, g, b = marked[layout.top + line[1], layout.left + line[0]]
    assert r > g > b > 60
    grey = bare[layout.top : layout.top + layout.height, layout.left : layout.left + layout.width]
    assert np.ptp(grey, axis=2).max() < 30


def test_points_that_are_not_finite_or_very_far_are_passed_over():
    points = [[105, 55, 0], [np.nan, 0, 0], [0, np.inf, 0], [1e30, -1e30, 0]]
    top = slice(0, SIZE[1] - 100)
    assert np.array_equal(_draw(points[:1], [RED])[top], _draw(points, [RED] * 4)[top])


@pytest.mark.parametrize("ego", [None, EGO])
def test_a_cloud_without_points_is_an_empty_map(ego):
    assert draw_cloud_above(np.zeros((0, 3), np.float32), None, ego=ego).size == (1280, 900)


def test_the_chosen_reach_holds_most_points():
    rng = np.random.default_rng(3)
    points = rng.uniform(-14.0, 14.0, (500, 3)) + np.array([100, 50, 0])
    drawn = _draw(points, [RED] * 500, reach=None)
    # From the middle 14 m to each side: the next round reach is 15 m, the points fill most of the height.
    rows, _ = np.nonzero((drawn[..., 0] > 200) & (drawn[..., 1] < 70))
    layout = layout_map((100.0, 50.0), 15.0, SIZE)
    assert np.ptp(rows) > 0.85 * layout.height


def test_drawing_twice_gives_the_same_map():
    rng = np.random.default_rng(1)
    points = rng.normal(0, 10, (3000, 3)) + np.array([100, 50, 0])
    assert np.array_equal(_draw(points, [RED] * 3000), _draw(points, [RED] * 3000))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"reach": 0.0}, OptionError, "reach 0.0 m"),
        ({"reach": float("nan")}, OptionError, "positive"),
        ({"size_px": (200, 640)}, OptionError, "200x640 px; expected at least 320x240"),
        ({"camera_index": np.zeros(2, np.uint8)}, ArrayError, "camera_index"),
    ],
)
def test_what_cannot_be_drawn_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        _draw([[105, 55, 0]], [RED], **options)


def test_points_of_another_shape_are_refused():
    with pytest.raises(ArrayError, match=r"points_world: \(4, 2\)"):
        draw_cloud_above(np.zeros((4, 2)), None)
