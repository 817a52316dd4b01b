import math

import numpy as np
import pytest

from sceneloom.kernels.direction_grid import (
    find_neighbours,
    measure_across,
    measure_along_axes,
    measure_extent,
)

CELL = 0.002
STEPS = [(dx, dy) for dx in range(-6, 7) for dy in range(-6, 7) if 0 < dx * dx + dy * dy <= 36]
RIGHT, DOWN = np.array(sorted(STEPS, key=lambda step: (math.hypot(*step), step)), np.int64).T.copy()
SECTORS, DISTANCES = (RIGHT > 0) + 2 * (DOWN > 0), np.hypot(RIGHT, DOWN)


def found(directions, inverse_ranges, samples):
    distances, neighbours = np.zeros((samples, 4)), np.zeros((samples, 4), np.int64)
    find_neighbours(
        directions,
        inverse_ranges,
        measure_extent(directions, inverse_ranges),
        CELL,
        RIGHT,
        DOWN,
        SECTORS.astype(np.int64),
        DISTANCES,
        distances,
        neighbours,
    )
    return distances, neighbours


def cells_of(directions):
    """Column and row of each point's cell, (M, 2)."""
    per_cell = np.float32(1 / CELL)
    return (directions * per_cell + np.float32(2.1) * per_cell).astype(np.int64).T


def found_one_by_one(directions, inverse_ranges, samples):
    """Every sampled cell against every other cell that holds a point."""
    cells = cells_of(directions)
    taking_part = (inverse_ranges > 0) & (np.abs(directions) <= 2.1).all(axis=0)
    occupied = {tuple(cell) for cell in cells[taking_part].tolist()}
    rows = []
    for s in range(samples):
        nearest, count = [math.nan] * 4, len(inverse_ranges)
        i = s * count // min(samples, count) if s < min(samples, count) else None
        for x, y in occupied if i is not None and taking_part[i] else ():
            dx, dy = x - int(cells[i, 0]), y - int(cells[i, 1])
            if 0 < math.hypot(dx, dy) <= 6:
                sector = (dx > 0) + 2 * (dy > 0)
                nearest[sector] = min(
                    math.hypot(dx, dy), nearest[sector], key=lambda d: math.inf if d != d else d
                )
        rows.append(nearest)
    return np.array(rows)


@pytest.mark.parametrize("count", [1, 7, 300, 1500])
@pytest.mark.parametrize("samples", [1, 50])
def test_the_next_occupied_cell_of_each_sector_is_found(count, samples):
    random = np.random.default_rng(count)
    directions = random.uniform(-0.06, 0.06, (2, count)).astype(np.float32)
    inverse_ranges = np.where(random.random(count) < 0.8, 0.1, 0).astype(np.float32)
    expected = found_one_by_one(directions, inverse_ranges, samples)
    distances, neighbours = found(directions, inverse_ranges, samples)
    np.testing.assert_allclose(distances, expected)
    np.testing.assert_array_equal(neighbours < 0, np.isnan(expected))
    cells, drawn = cells_of(directions), min(samples, count)
    own = cells[np.arange(drawn) * count // drawn]
    dx, dy = np.moveaxis(cells[neighbours[:drawn]] - own[:, None], 2, 0)
    known = neighbours[:drawn] >= 0
    np.testing.assert_allclose(np.hypot(dx, dy)[known], distances[:drawn][known])
    np.testing.assert_array_equal(((dx > 0) + 2 * (dy > 0))[known], np.nonzero(known)[1])
    assert (inverse_ranges[neighbours[:drawn][known]] > 0).all()


def test_no_points_have_no_neighbours():
    distances, neighbours = found(np.zeros((2, 0), np.float32), np.zeros(0, np.float32), 3)
    assert np.isnan(distances).all()
    assert (neighbours == -1).all()


@pytest.mark.parametrize("samples", [0, 1, 7, 200])
def test_spacings_are_the_middle_of_what_is_found_along_axes_and_the_upper_quartile_across(samples):
    random = np.random.default_rng(samples)
    distances = CELL * DISTANCES[random.integers(0, len(DISTANCES), (samples, 8))]
    distances[random.random((samples, 8)) < 0.3] = math.nan
    along, across = np.zeros(4), np.zeros(samples)
    measure_along_axes(distances, CELL, 6, 8, along)
    measure_across(distances, 5, across)
    for axis in range(4):
        steps = np.sort(distances[:, [axis, axis + 4]], axis=None)
        steps = steps[np.isfinite(steps)]
        middle = steps[len(steps) // 4 : len(steps) - len(steps) // 4]
        expected = middle.mean() if len(steps) >= 8 else math.nan
        # Roots and sums are rounded in another order.
        assert along[axis] == pytest.approx(expected, rel=1e-12, nan_ok=True)
    for found, spacing in zip(distances, across, strict=True):
        known = np.sort(found[np.isfinite(found)])
        np.testing.assert_equal(spacing, known[3 * len(known) // 4] if len(known) >= 5 else math.nan)
