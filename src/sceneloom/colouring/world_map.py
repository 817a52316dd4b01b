"""A drive as one voxel map: points and votes per voxel, in tiles that are kept on disk while unused."""

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.errors import OptionError

_POINT = np.dtype([
    ("position", "f8", 3), ("color", "f4", 3), ("weight", "f4"), ("intensity", "f4"), ("time_ns", "i8"),
    ("camera", "u1"), ("image", "i4"), ("pixel", "f4", 2), ("label", "u2"),
])  # fmt: skip
"""One point: world position [m], colour (0 to 255), its weight (0 for none), brightness, time [ns], camera and number
of the image that counts most (255 and -1 for none), position in it [px], label (65535 for none)."""

_CELL = np.dtype([
    ("cube", "i8"), ("count", "u4"), ("position", "f8", 3), ("color", "f4", 3), ("weight", "f4"), ("intensity", "f4"),
    ("best", _POINT),
])  # fmt: skip
"""One cube: its number in the tile, number of points in it, sums of their positions, of their colours by weight, of the
weights, of the brightness; and the point with the greatest weight."""

_VOTE = np.dtype([("cube", "i8"), ("label", "u2"), ("count", "u4")])  # how many points of a cube have a label
_NO_LABEL = 65535


def _cells_of(points: AnyArray, cubes: Int64Array) -> AnyArray:
    """A cell for each cube that points (N,) of dtype `_POINT` fall into, (C,) ascending by `cube`."""
    cells = np.zeros(len(points), _CELL)
    cells["cube"], cells["count"], cells["best"] = cubes, 1, points
    for name in ("position", "weight", "intensity"):
        cells[name] = points[name]
    cells["color"] = points["color"] * points["weight"][:, None]
    return _merged([cells])


def _merged(parts: Iterable[AnyArray]) -> AnyArray:
    """Join cells of the same cubes, (C,) ascending by `cube`."""
    cells = np.concatenate([*parts])
    if not len(cells):
        return cells
    order = np.argsort(cells["cube"], kind="stable")
    cells = cells[order]
    starts = np.flatnonzero(np.append(True, cells["cube"][1:] != cells["cube"][:-1]))
    group = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(cells))))
    # the row with the greatest weight of each group, the first of equals
    weights = cells["best"]["weight"]
    rows = np.flatnonzero(weights == np.maximum.reduceat(weights, starts)[group])
    joined = cells[rows[np.unique(group[rows], return_index=True)[1]]]
    for name in ("count", "position", "color", "weight", "intensity"):
        joined[name] = np.add.reduceat(cells[name], starts, axis=0)
    return joined


def _votes_of(points: AnyArray, cubes: Int64Array) -> AnyArray:
    """Count the labels of points (N,) in each cube, ascending by cube and label."""
    labelled = points["label"] != _NO_LABEL
    votes = np.zeros(int(labelled.sum()), _VOTE)
    votes["cube"], votes["label"], votes["count"] = cubes[labelled], points["label"][labelled], 1
    return _added_votes([votes])


def _added_votes(parts: Iterable[AnyArray]) -> AnyArray:
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


def _points_of_cells(cells: AnyArray, votes: AnyArray) -> AnyArray:
    """One point for each cell: at the mean position, with the mean colour and the label with most votes."""
    points: Any = cells["best"].copy()
    points["position"] = cells["position"] / cells["count"][:, None]
    points["intensity"] = cells["intensity"] / cells["count"]
    seen = cells["weight"] > 0
    points["color"][seen] = cells["color"][seen] / cells["weight"][seen, None]
    points["label"] = _NO_LABEL
    if len(votes):
        # of equally many the smaller number
        order = np.lexsort((-votes["label"].astype(np.int64), votes["count"], votes["cube"]))
        ranked = votes[order]
        last = np.append(ranked["cube"][1:] != ranked["cube"][:-1], True)
        points["label"][np.searchsorted(cells["cube"], ranked["cube"][last])] = ranked["label"][last]
    ready: AnyArray = points
    return ready


TILE_CUBES = 256
"""A tile is a square column of so many cubes along x and y."""

_MOST_CELLS = 2_000_000
"""Largest number of cubes in memory, some 250 MB, but for those of one tile; others are kept on disk."""

_PENDING_SHARE, _LEAST_PENDING = 0.5, 50_000
_ROOM_SHARE = 0.75  # share that is left in memory once tiles are moved to the disk
_HEIGHT_CUBES = 1 << 24
_FARTHEST_TILE = 1 << 30
_BOUNDS = np.array([64.0 * _HEIGHT_CUBES, 64.0 * _HEIGHT_CUBES, 0.5 * _HEIGHT_CUBES])
Tile = tuple[int, int]


@dataclass(slots=True, eq=False)
class _Tile:
    """A tile: its cells, in memory or on the disk, and points that are not in cells yet, likewise."""

    cells: AnyArray | None = field(default_factory=lambda: np.zeros(0, _CELL))  # None where they rest on the disk
    votes: AnyArray = field(default_factory=lambda: np.zeros(0, _VOTE))  # None where they rest on the disk
    known: int = 0  # how many cells there are
    pending: list[AnyArray] = field(default_factory=list)  # points in memory that are not in cells yet
    waiting: int = 0  # how many points are not in cells yet, those on the disk included

    @property
    def size(self) -> int:
        """What is in memory of it, counted in cells."""
        return (0 if self.cells is None else len(self.cells)) + sum(map(len, self.pending))


@dataclass(slots=True)
class WorldMap:
    """Collects points and gives one for each cube of space.

    Attributes:
        voxel: side of the cubes [m].
        folder: an empty folder for tiles that do not fit into the memory.
        most_cells: largest number of cubes in memory.
        added: number of points so far.

    Raises:
        OptionError: the side is not a positive number.
    """

    voxel: float
    folder: Path
    most_cells: int = _MOST_CELLS
    added: int = 0
    _tiles: OrderedDict[Tile, _Tile] = field(default_factory=OrderedDict)
    _size: int = 0

    def __post_init__(self) -> None:
        if not (isfinite(self.voxel) and 0.001 <= self.voxel <= 1000):
            raise OptionError(f"voxel {self.voxel}; expected 0.001 to 1000 m")

    def add(self, points: AnyArray) -> None:
        """Add points (N,) of dtype `_POINT`; those that are not finite, or out of bounds, are left out."""
        cubes = np.floor(points["position"] / self.voxel)
        inside = (np.abs(cubes) < _BOUNDS).all(axis=1)
        points, cubes = points[inside], cubes[inside].astype(np.int64)
        self.added += len(points)
        tiles = cubes[:, :2] // TILE_CUBES
        codes = tiles[:, 0] * _FARTHEST_TILE + tiles[:, 1]
        order = np.argsort(codes, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(codes[order])) + 1) if len(codes) else ():
            key = int(tiles[rows[0], 0]), int(tiles[rows[0], 1])
            tile = self._tiles.setdefault(key, _Tile())
            self._tiles.move_to_end(key)
            tile.pending.append(points[rows])
            tile.waiting += len(rows)
            self._size += len(rows)
            if tile.waiting > max(_LEAST_PENDING, _PENDING_SHARE * tile.known):
                self._settle(key, tile)
        self._rest()

    def _settle(self, key: Tile, tile: _Tile) -> None:
        """Put the waiting points into cells."""
        before = tile.size
        resting = self._file(key, "pending")
        if resting.exists():
            tile.pending.insert(0, np.fromfile(resting, _POINT))
            resting.unlink()
        if tile.cells is None:
            tile.cells = np.load(self._file(key, "cells"))
            tile.votes = np.load(self._file(key, "votes"))
        if tile.pending:
            points = np.concatenate(tile.pending)
            tile.pending, tile.waiting = [], 0
            cubes = np.floor(points["position"] / self.voxel).astype(np.int64)
            columns = (cubes[:, 0] % TILE_CUBES) * TILE_CUBES + cubes[:, 1] % TILE_CUBES
            cubes = columns * _HEIGHT_CUBES + (cubes[:, 2] + _HEIGHT_CUBES // 2)
            made = _cells_of(points, cubes)
            tile.cells = _merged([tile.cells, made])
            tile.votes = _added_votes([tile.votes, _votes_of(points, cubes)])
            tile.known = len(tile.cells)
        self._size += tile.size - before

    def _rest(self) -> None:
        """Move the least recently used tiles to the disk, until the others fit."""
        for key, tile in [*self._tiles.items()] if self._size > self.most_cells else ():
            if self._size <= self.most_cells * _ROOM_SHARE:
                break
            self._size -= tile.size
            if tile.pending:
                with self._file(key, "pending").open("ab") as file:
                    file.writelines(points.tobytes() for points in tile.pending)
                tile.pending = []
            if tile.cells is not None:
                np.save(self._file(key, "cells"), tile.cells)
                np.save(self._file(key, "votes"), tile.votes)
                tile.cells = None

    def _file(self, key: Tile, what: str) -> Path:
        return self.folder / f"{key[0]}_{key[1]}_{what}.npy"

    def points(self) -> Iterator[AnyArray]:
        """The map tile by tile, (C,) of dtype `_POINT` each; nothing can be added afterwards."""
        for key in sorted(self._tiles):
            tile = self._tiles.pop(key)
            self._settle(key, tile)
            for what in ("cells", "votes"):
                self._file(key, what).unlink(missing_ok=True)
            if tile.cells is not None and len(tile.cells):
                yield _points_of_cells(tile.cells, tile.votes)


def empty_points(count: int) -> AnyArray:
    """Points (N,) of dtype `_POINT` at 0 without colour, image and label."""
    points = np.zeros(count, _POINT)
    points["color"], points["camera"], points["image"], points["label"] = 255, 255, -1, 65535
    points["pixel"] = np.nan
    return points
