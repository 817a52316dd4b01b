import math

import numpy as np
import pytest

from sceneloom.kernels.direction_grid import measure_extent
from sceneloom.kernels.occlusion import mark_unhidden

CELL, WINDOW = math.radians(0.16), math.radians(0.5)
MARGIN, SHARE, SLOPE, NEARING = 0.15, 0.01, 2.0, 0.85


def ellipse(across_deg=0.38, along_deg=0.24, angle=math.pi / 2):
    p, r, c, s = (
        math.radians(across_deg) ** -2,
        math.radians(along_deg) ** -2,
        math.cos(angle),
        math.sin(angle),
    )
    return p * c * c + r * s * s, 2 * (p - r) * c * s, p * s * s + r * c * c


def marked(
    directions, inverse_ranges, *, cell=CELL, window=WINDOW, near=None, slope=SLOPE, eyes=None, hiding=None
):
    """The kernel's answer; point i has row i of the fractions, which rise from 0 to 1."""
    count = len(inverse_ranges)
    visible = np.zeros(len(inverse_ranges), bool)
    locations, nearness = (np.ascontiguousarray(rows, np.float32) for rows in (directions, inverse_ranges))
    mark_unhidden(
        locations,
        nearness,
        nearness if hiding is None else np.ascontiguousarray(hiding, np.float32),
        measure_extent(locations, nearness),
        cell,
        window,
        *(ellipse() if near is None else near),
        slope,
        MARGIN,
        SHARE,
        np.zeros((0, 3)) if eyes is None else eyes,
        np.arange(count),
        np.linspace(0, 1, count, dtype=np.float32),
        NEARING,
        visible,
    )
    return visible


def in_map(points):
    """Lambert's map of points (N, 3) around the z axis, (2, N)."""
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return rays[:, :2].T * np.sqrt(2 / (1 + rays[:, 2]))


def shift_by_small_step(direction, eye):
    """How a point 1 m away in a direction shifts in the map, to first order, when the eye comes from `eye`."""
    x, y = direction.astype(np.float64)
    half = math.sqrt(1 - 0.25 * (x * x + y * y))
    ray = np.array([[x * half, y * half, 1 - 0.5 * (x * x + y * y)]])
    step = 1e-6
    return ((in_map(ray + step * eye) - in_map(ray - step * eye)) / (2 * step))[:, 0]


def hidden_one_by_one(directions, inverse_ranges, *, cell, window, near, slope, strictness, eyes=None):
    """The rule by its words: every point against the nearest point of every cell, no bounds, no windows of cells.

    `strictness` above 1 makes hiding harder: what is hidden even then is surely hidden.
    """
    per_cell = np.float32(1 / cell)
    steps = (directions * per_cell + np.float32(2.1) * per_cell).astype(np.int64)
    nearest = {}
    for j, (location, inverse) in enumerate(zip(map(tuple, steps.T), inverse_ranges, strict=True)):
        if inverse > 0 and (location not in nearest or inverse > inverse_ranges[nearest[location]]):
            nearest[location] = j
    holders = np.array(list(nearest.values()), np.int64)
    hidden = np.zeros(len(inverse_ranges), bool)
    for i, inverse in enumerate(inverse_ranges.astype(np.float64)):
        x, y = directions[:, holders].astype(np.float64) - directions[:, i : i + 1]
        flattening = math.sqrt(1 - 0.25 * float((directions[:, i].astype(np.float64) ** 2).sum()))
        needed = slope / flattening * np.hypot(x, y) * strictness
        excess = inverse_ranges[holders] - inverse - strictness * (MARGIN * inverse**2 + SHARE * inverse)
        hides = excess > needed
        beside = near[0] * x * x + near[1] * x * y + near[2] * y * y <= 1 / strictness
        if eyes is not None:
            eye = eyes[0] + i / max(len(inverse_ranges) - 1, 1) * (eyes[1] - eyes[0])
            gained = inverse_ranges[holders] - inverse
            # What the eye comes from, seen from there: the nearer thing has not yet made its larger shift.
            before = np.stack([x, y]) - gained * shift_by_small_step(directions[:, i], eye)[:, None]
            beside &= x * before[0] + y * before[1] <= NEARING / strictness * (before**2).sum(axis=0)
        rotation_of_vector = np.floor(np.arctan2(y, x) / (math.pi / 2)).astype(int) % 4
        quadrants = set(rotation_of_vector[hides & (np.hypot(x, y) <= window / strictness)])
        hidden[i] = (hides & beside).any() or {0, 2} <= quadrants or {1, 3} <= quadrants
    return hidden


def random_cloud(seed, count, spread_deg, *, layers=(1 / 30, 1 / 8)):
    """Two noisy surfaces behind each other, the nearer one with holes; and some points anywhere."""
    random = np.random.default_rng(seed)
    directions = np.radians(random.uniform(-spread_deg, spread_deg, (2, count))).astype(np.float32)
    inverse = np.where(random.random(count) < 0.5, *layers) + random.normal(scale=2e-3, size=count)
    inverse = inverse + 0.1 * directions[1]
    inverse[::17] = random.uniform(0.005, 0.5, len(inverse[::17]))
    return directions, np.maximum(inverse, 1e-3).astype(np.float32)


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"window": math.radians(1.15), "cell": math.radians(0.19), "near": ellipse(0.9, 0.24)},
        {"near": ellipse(0.5, 0.15, math.pi / 4), "slope": 0.8},
        {"near": ellipse(0.1, 0.1), "window": math.radians(0.3)},
        {"near": ellipse(1.2, 1.2), "window": math.radians(0.2), "cell": math.radians(0.3)},
        {"near": ellipse(0.5, 0.4), "eyes": np.array([[0.02, -0.06, -0.1], [-0.05, 0.01, 0.05]])},
        {"near": ellipse(1.2, 0.9), "eyes": np.array([[0.3, -0.6, -0.3], [0.3, -0.6, 0.4]])},
    ],
    ids=[
        "usual",
        "sparse lidar",
        "tilted",
        "dense lidar",
        "window smaller than near",
        "lidar beside",
        "lidar above",
    ],
)
@pytest.mark.parametrize(("count", "spread_deg"), [(600, 1.5), (1500, 8.0), (700, 40.0)])
@pytest.mark.few(6)
def test_decisions_are_those_of_the_rule_applied_point_by_point(kwargs, count, spread_deg):
    settings = {"cell": CELL, "window": WINDOW, "near": ellipse(), "slope": SLOPE, **kwargs}
    directions, inverse_ranges = random_cloud(count, count, spread_deg)
    visible = marked(directions, inverse_ranges, **settings)
    # Float32 decides within 1e-4 of a limit as it likes; beyond that there is one answer.
    surely_hidden = hidden_one_by_one(directions, inverse_ranges, **settings, strictness=1 + 1e-3)
    perhaps_hidden = hidden_one_by_one(directions, inverse_ranges, **settings, strictness=1 - 1e-3)
    assert not visible[surely_hidden].any()
    assert visible[~perhaps_hidden].all()
    assert (surely_hidden == perhaps_hidden).mean() > 0.99
    if spread_deg < 10:
        assert surely_hidden.any()


@pytest.mark.parametrize("seed", range(20))
def test_a_plane_that_passes_the_camera_at_the_surface_distance_or_farther_never_hides_itself(seed):
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    rays = random.normal(size=(40_000, 3)) * [0.6, 0.6, 0.1] + [0, 0, 1]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    inverse_ranges = rays @ normal / random.uniform(1 / SLOPE, 3)
    rays, inverse_ranges = rays[inverse_ranges > 0.005], inverse_ranges[inverse_ranges > 0.005]
    directions = rays[:, :2].T * np.sqrt(2 / (1 + rays[:, 2]))
    assert marked(directions, inverse_ranges, near=ellipse(0.8, 0.8)).all()


def grid(columns, rows, step_deg, inverse, *, offset_deg=0.0):
    right, down = np.meshgrid(np.arange(columns) * step_deg, np.arange(rows) * step_deg)
    directions = np.radians(np.stack([right.ravel(), down.ravel()]) + offset_deg)
    return directions, np.full(directions.shape[1], inverse)


def test_what_lies_between_the_samples_of_a_nearer_surface_is_hidden():
    near_directions, near_inverse = grid(11, 11, 0.4, 1 / 10)
    far_directions, far_inverse = grid(9, 9, 0.4, 1 / 30, offset_deg=0.6)
    visible = marked(
        np.column_stack([near_directions, far_directions]),
        np.concatenate([near_inverse, far_inverse]),
        near=ellipse(0.1, 0.1),
    )
    assert visible.tolist() == [True] * 121 + [False] * 81


def test_the_background_beside_an_edge_is_seen():
    near_directions, near_inverse = grid(5, 30, 0.2, 1 / 10)
    far_directions, far_inverse = grid(5, 30, 0.2, 1 / 30)
    far_directions = far_directions + np.radians([[1.2], [0.05]])
    visible = marked(
        np.column_stack([near_directions, far_directions]),
        np.concatenate([near_inverse, far_inverse]),
        near=ellipse(0.2, 0.2),
    )
    assert visible.all()


def test_something_nearer_by_less_than_the_margin_hides_nothing():
    directions = np.radians([[0, 0.005, -0.005], [0, 0.005, -0.005]])
    for gap, hidden in ((0.3, True), (0.2, False)):  # 0.15 m and 1 % of 10 m make 0.25 m
        visible = marked(directions, 1 / np.array([10, 10 - gap, 10 - gap]))
        assert visible.tolist() == [not hidden, True, True]


@pytest.mark.parametrize("inverse", [0.0, -1.0, math.nan, math.inf])
def test_a_point_without_range_is_not_visible_and_hides_nothing(inverse):
    visible = marked(np.zeros((2, 3)), np.array([0.1, inverse, 0.1]))
    assert visible.tolist() == [True, False, True]


@pytest.mark.parametrize("direction", [(math.nan, 0), (0, math.inf), (3, 0), (0, -1e30)])
def test_a_point_outside_the_map_is_not_visible_and_hides_nothing(direction):
    visible = marked(np.column_stack([(0, 0), direction]), np.array([0.1, 0.5]))
    assert visible.tolist() == [True, False]


def test_no_points_and_a_single_point_are_fine():
    assert marked(np.zeros((2, 0)), np.zeros(0)).tolist() == []
    assert marked(np.array([[1.9], [-0.5]]), np.array([1e-3])).tolist() == [True]


def test_points_that_shall_not_hide_others_are_hidden_themselves():
    rng = np.random.default_rng(8)
    directions, inverse = rng.uniform(-0.1, 0.1, (2, 3000)), rng.uniform(0.02, 0.5, 3000)
    hides = rng.random(3000) < 0.3
    partly = marked(directions, inverse, hiding=np.where(hides, inverse, 0.0))
    # As if the others were asked one at a time, each among those that hide.
    alone = marked(directions[:, hides], inverse[hides])
    np.testing.assert_array_equal(partly[hides], alone)
    for i in np.flatnonzero(~hides)[:40]:
        rows = np.append(np.flatnonzero(hides), i)
        # Where it takes the position of a hiding one in the grid, the answer may not be compared.
        in_cell = np.abs(directions[:, hides] - directions[:, [i]]).max(axis=0) < CELL
        if not in_cell.any():
            assert partly[i] == marked(directions[:, rows], inverse[rows])[-1]
    assert not marked(directions, inverse, hiding=np.zeros(3000))[inverse == 0].any()
    assert marked(directions, inverse, hiding=np.zeros(3000)).all()
