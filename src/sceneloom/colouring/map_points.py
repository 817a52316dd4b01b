"""The points that a world map is made of, as columns, and what cubes of space keep of them."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Int64Array

POINT = np.dtype(
    [
        ("position", "f8", 3),
        ("color", "f4", 3),
        ("weight", "f4"),
        ("intensity", "f4"),
        ("time_ns", "i8"),
        ("camera", "u1"),
        ("image", "i4"),
        ("pixel", "f4", 2),
        ("label", "u2"),
    ]
)
"""One point: world position [m], colour (0 to 255), how far that is trusted (0 for none), brightness, time [ns], camera
and number of the image that counts most (255 and -1 for none), where it falls in it [px], label (65535 for none)."""

CELL = np.dtype(
    [
        ("cube", "i8"),
        ("count", "u4"),
        ("position", "f8", 3),
        ("color", "f4", 3),
        ("weight", "f4"),
        ("intensity", "f4"),
        ("best", POINT),
    ]
)
"""One cube: its number in the tile, how many points fell into it, sums of their positions, of their colours by weight,
of the weights, of the brightness; and the point with the greatest weight."""

VOTE = np.dtype([("cube", "i8"), ("label", "u2"), ("count", "u4")])
"""How many points of a cube have a label."""

NO_LABEL = 65535


def cells_of(points: AnyArray, cubes: Int64Array, *, agreement: float) -> AnyArray:
    """Make a cell of each cube that points (N,) of dtype `POINT` fall into, (C,) ascending by `cube`."""
    cells = np.zeros(len(points), CELL)
    cells["cube"], cells["count"], cells["best"] = cubes, 1, points
    for name in ("position", "weight", "intensity"):
        cells[name] = points[name]
    cells["color"] = points["color"] * points["weight"][:, None]
    return merged([cells], agreement=agreement)


def merged(parts: Iterable[AnyArray], *, agreement: float) -> AnyArray:
    """Join cells of the same cubes, (C,) ascending by `cube`.

    Mean colours hold only those parts whose mean is within `agreement` levels of the best colour of the cube.
    """
    cells = np.concatenate([*parts])
    if not len(cells):
        return cells
    order = np.argsort(cells["cube"], kind="stable")
    cells = cells[order]
    starts = np.flatnonzero(np.append(True, cells["cube"][1:] != cells["cube"][:-1]))
    group = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(cells))))
    best = _best_rows(cells["best"]["weight"], starts, group)
    joined = cells[best]
    agrees = _agrees(cells, joined["best"]["color"][group], agreement)
    for name in ("count", "position", "intensity"):
        joined[name] = np.add.reduceat(cells[name], starts, axis=0)
    joined["weight"] = np.add.reduceat(np.where(agrees, cells["weight"], np.float32(0)), starts)
    joined["color"] = np.add.reduceat(
        np.where(agrees[:, None], cells["color"], np.float32(0)), starts, axis=0
    )
    return joined


def _best_rows(weights: AnyArray, starts: Int64Array, group: Int64Array) -> Int64Array:
    """The row with the greatest weight of each group, the first of equals."""
    is_best = weights == np.maximum.reduceat(weights, starts)[group]
    rows = np.flatnonzero(is_best)
    first: Int64Array = rows[np.unique(group[rows], return_index=True)[1]]
    return first


def _agrees(cells: AnyArray, colors: AnyArray, agreement: float) -> BoolArray:
    weights = np.maximum(cells["weight"], np.float32(1e-20))[:, None]
    near: BoolArray = (np.abs(cells["color"] / weights - colors) <= agreement).all(axis=1)
    return near


def votes_of(points: AnyArray, cubes: Int64Array) -> AnyArray:
    """Count the labels of points (N,) in each cube, ascending by cube and label."""
    stated = points["label"] != NO_LABEL
    votes = np.zeros(int(stated.sum()), VOTE)
    votes["cube"], votes["label"], votes["count"] = cubes[stated], points["label"][stated], 1
    return added_votes([votes])


def added_votes(parts: Iterable[AnyArray]) -> AnyArray:
    """Add up votes of the same cubes and labels."""
    votes = np.concatenate([*parts])
    if not len(votes):
        return votes
    votes = votes[np.lexsort((votes["label"], votes["cube"]))]
    new = (votes["cube"][1:] != votes["cube"][:-1]) | (votes["label"][1:] != votes["label"][:-1])
    starts = np.flatnonzero(np.append(True, new))
    added = votes[starts]
    added["count"] = np.add.reduceat(votes["count"], starts)
    return added


def points_of_cells(cells: AnyArray, votes: AnyArray, *, mean: bool) -> AnyArray:
    """One point for each cell: at the mean location, with the mean or the best colour and the label with most votes."""
    points: Any = cells["best"].copy()
    points["position"] = cells["position"] / cells["count"][:, None]
    points["intensity"] = cells["intensity"] / cells["count"]
    if mean:
        seen = cells["weight"] > 0
        points["color"][seen] = cells["color"][seen] / cells["weight"][seen, None]
    points["label"] = NO_LABEL
    if len(votes):
        # of equally many the smaller number
        order = np.lexsort((-votes["label"].astype(np.int64), votes["count"], votes["cube"]))
        ranked = votes[order]
        last = np.append(ranked["cube"][1:] != ranked["cube"][:-1], True)
        points["label"][np.searchsorted(cells["cube"], ranked["cube"][last])] = ranked["label"][last]
    ready: AnyArray = points
    return ready
