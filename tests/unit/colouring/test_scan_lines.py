import math

import numpy as np
import pytest

from sceneloom.colouring.visibility import (
    find_lines,
    fit_reach,
    look_around,
    measure_spacings,
    measure_surface_distance,
)


def scan_lines(across_deg, along_deg, angle_deg=0.0, jitter=0.02):
    """Directions on parallel lines; at angle 0 the lines run to the right."""
    random = np.random.default_rng(0)
    right, down = np.meshgrid(np.arange(-15, 15, along_deg), np.arange(-12, 12, across_deg))
    right = right + random.normal(scale=jitter, size=right.shape)
    rotation = np.radians(angle_deg)
    rotated = (
        right * np.cos(rotation) - down * np.sin(rotation),
        right * np.sin(rotation) + down * np.cos(rotation),
    )
    return np.radians([axis.ravel() for axis in rotated]).astype(np.float32)


def spacings_deg(directions, inverse_ranges=None):
    inverse = np.full(directions.shape[1], 0.1, np.float32) if inverse_ranges is None else inverse_ranges
    return np.degrees(measure_spacings(look_around(directions, inverse)))


@pytest.mark.parametrize(("angle_deg", "along_axis"), [(0, 0), (45, 1), (90, 2), (135, 3)])
@pytest.mark.parametrize(("across_deg", "along_deg"), [(0.42, 0.17), (1.0, 0.2), (2.0, 0.4), (0.6, 0.35)])
def test_the_spacings_across_and_along_scan_lines_are_found(across_deg, along_deg, angle_deg, along_axis):
    spacings = spacings_deg(scan_lines(across_deg, along_deg, angle_deg))
    # Half a cell of resolution, and the neighbour across may lie a little to the side.
    assert spacings[along_axis] == pytest.approx(along_deg, abs=0.05)
    assert spacings[(along_axis + 2) % 4] == pytest.approx(across_deg, abs=0.05 + 0.1 * across_deg)


def test_points_that_take_no_part_do_not_count():
    lines, others = scan_lines(0.42, 0.17), scan_lines(0.29, 0.87)
    both = np.column_stack([lines, others])
    inverse = np.concatenate([np.full(lines.shape[1], 0.1), np.zeros(others.shape[1])]).astype(np.float32)
    assert spacings_deg(both[:, ::-1].copy(), inverse[::-1].copy())[2] == pytest.approx(0.42, abs=0.1)


@pytest.mark.parametrize("count", [0, 1, 5, 100])
def test_too_few_points_give_no_spacing(count):
    assert np.isnan(spacings_deg(scan_lines(0.42, 0.17)[:, :count].copy())).all()


def test_lines_beyond_reach_give_no_spacing_across_them():
    spacings = spacings_deg(scan_lines(4.0, 0.2))
    assert np.isnan(spacings[2])
    assert spacings[0] == pytest.approx(0.2, abs=0.05)


@pytest.mark.parametrize(
    ("spacings_deg", "window_deg", "across_deg", "along_deg", "angle_deg"),
    [
        ((0.2, 0.45, 0.4, 0.45), 0.46, 0.3, 0.18, 90),
        ((0.4, 0.45, 0.2, 0.45), 0.46, 0.3, 0.18, 0),
        ((0.45, 0.2, 0.45, 0.4), 0.46, 0.3, 0.18, 135),
        ((0.1, 0.11, 0.1, 0.1), 0.3, 0.1, 0.1, 45),
        ((0.2, 2.1, 2.4, 2.1), 2.76, 2.2, 2.76 / 6, 90),  # what is near reaches one cell
        ((0.2, math.nan, 1.0, math.nan), 1.15, 0.87, 1.15 / 6, 90),
        ((0.2, 0.3, math.nan, math.nan), 0.5, 0.16, 0.16, 0),
        ((math.nan,) * 4, 0.5, 0.16, 0.16, 0),
    ],
)
def test_the_reach_follows_the_scan_lines(spacings_deg, window_deg, across_deg, along_deg, angle_deg):
    reach = fit_reach(find_lines(np.radians(spacings_deg)))
    assert math.degrees(reach.window) == pytest.approx(window_deg)
    assert math.degrees(reach.across) == pytest.approx(across_deg, abs=1e-3)
    assert math.degrees(reach.along) == pytest.approx(along_deg)
    assert math.degrees(reach.angle) == pytest.approx(angle_deg)


def test_the_ellipse_has_its_axes_across_and_along_the_scan_lines():
    reach = fit_reach(find_lines(np.radians([0.45, 0.2, 0.45, 0.4])))
    xx, xy, yy = reach.ellipse
    for length, angle in ((reach.across, reach.angle), (reach.along, reach.angle + math.pi / 2)):
        x, y = length * math.cos(angle), length * math.sin(angle)
        assert xx * x * x + xy * x * y + yy * y * y == pytest.approx(1)


def ground_and_wall(height, *, spacing_deg=0.4, wall_at=40.0, noise=0.02):
    """A cloud of a flat ground, that many metres below the camera, and of a wall ahead."""
    random = np.random.default_rng(0)
    across, along = np.meshgrid(
        np.radians(np.arange(-12, 25, spacing_deg)), np.radians(np.arange(-30, 30, 0.2))
    )
    rays = np.stack([np.sin(along) * np.cos(across), np.sin(across), np.cos(along) * np.cos(across)], axis=-1)
    rays = rays.reshape(-1, 3)
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 1] > 0, height / rays[:, 1], np.inf)
    ranges = np.minimum(to_ground, wall_at / rays[:, 2]) + random.normal(scale=noise, size=len(rays))
    directions = rays[:, :2].T * np.sqrt(2 / (1 + rays[:, 2]))
    return np.ascontiguousarray(directions, np.float32), (1 / ranges).astype(np.float32)


@pytest.mark.parametrize(("height", "expected"), [(0.3, 0.24), (0.8, 0.64), (1.65, 1.32), (3.0, 1.5)])
@pytest.mark.parametrize("spacing_deg", [0.2, 0.4, 2.0])
def test_surfaces_pass_the_camera_at_its_height_above_the_ground(height, expected, spacing_deg):
    directions, inverse_ranges = ground_and_wall(height, spacing_deg=spacing_deg, noise=0.0)
    neighbours = look_around(directions, inverse_ranges)
    measured = measure_surface_distance(neighbours, directions, inverse_ranges, 0.075, 0.005)
    # The ground in the image is met at up to 25 degrees, whose cosine is 0.91, and directions are rounded to float32.
    assert 0.99 * expected < measured < expected / 0.9


@pytest.mark.parametrize(("height", "most"), [(0.3, 0.26), (0.8, 0.7), (1.65, 1.4)])
def test_noise_makes_surfaces_steeper_never_flatter(height, most):
    directions, inverse_ranges = ground_and_wall(height)
    neighbours = look_around(directions, inverse_ranges)
    measured = measure_surface_distance(neighbours, directions, inverse_ranges, 0.075, 0.005)
    assert 0.4 * most < measured < most


def test_a_cloud_that_shows_no_surface_gives_the_usual_distance():
    directions = scan_lines(0.42, 0.17)
    ranges = np.random.default_rng(0).uniform(2, 80, directions.shape[1])
    for inverse in ((1 / ranges).astype(np.float32), np.zeros(directions.shape[1], np.float32)):
        assert measure_surface_distance(look_around(directions, inverse), directions, inverse, 0, 0) == 0.5
    nothing = np.zeros((2, 0), np.float32), np.zeros(0, np.float32)
    assert measure_surface_distance(look_around(*nothing), *nothing, 0.1, 0.1) == 0.5
