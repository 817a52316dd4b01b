"""One point of each cube, against a slow answer in plain Python."""

import math

import numpy as np

from sceneloom.kernels.voxels import first_of_cubes, nearest_of_cubes, number_cubes


def cubes_slowly(points, side):
    """Rows of the points of each cube, cubes in the order in which they are met."""
    found = {}
    for row, point in enumerate(points.tolist()):
        if all(math.isfinite(value) for value in point):
            found.setdefault(tuple(math.floor(value / side) for value in point), []).append(row)
    return list(found.values())


def nearest_slowly(points, rows):
    """The row nearest to the mean of all, the first of equally near ones."""
    mean = [math.fsum(points[row, axis] for row in rows) / len(rows) for axis in range(3)]
    apart = {row: sum((points[row, k] - mean[k]) ** 2 for k in range(3)) for row in rows}
    # the mean is rounded: two points of one cube are equally near to it but for the last digits
    return next(row for row in rows if apart[row] <= min(apart.values()) * (1 + 1e-9))


def chosen(points, side):
    """What the kernels give: numbers of the cubes, first rows, nearest rows."""
    numbers = np.empty(len(points), np.int64)
    first = np.empty(number_cubes(points, side, numbers), np.int64)
    first_of_cubes(numbers, first)
    nearest = first.copy()
    nearest_of_cubes(points, numbers, nearest)
    return numbers, first, nearest


def test_cubes_and_their_points_are_those_of_the_slow_answer_apart_on_both_sides_of_zero():
    for center in [0.0, -1e4, 4e5]:
        for side in [0.3, 1.0, 7.5]:
            points = np.random.default_rng(1).normal(center, 4.0, (2000, 3))
            points[::97] = np.nan
            points[5, 1] = np.inf
            cubes = cubes_slowly(points, side)
            numbers, first, nearest = chosen(points, side)
            assert [np.flatnonzero(numbers == k).tolist() for k in range(len(first))] == cubes
            assert (numbers[::97] == -1).all()
            assert first.tolist() == [rows[0] for rows in cubes]
            assert nearest.tolist() == [nearest_slowly(points, rows) for rows in cubes]
    points = np.array([[0.1, 0.1, 0.1], [-0.1, 0.1, 0.1], [0.9, 0.9, 0.9], [-0.9, 0.9, 0.9]])
    assert chosen(points, 1.0)[0].tolist() == [0, 1, 0, 1]
    points = np.array([[1.0, 0.0, 0.0], [0.999, 0.0, 0.0], [-1.0, 0.0, 0.0], [-1.001, 0.0, 0.0]])
    assert chosen(points, 1.0)[0].tolist() == [0, 1, 2, 3]
    assert number_cubes(np.zeros((0, 3)), 1.0, np.zeros(0, np.int64)) == 0
    points = np.array([[2e6 * k, -3e6 * k, 1e6 * k] for k in range(500)])
    assert len(chosen(points, 0.01)[1]) == 500
