"""A drive as one cloud: sweep after sweep goes into cubes of space, in tiles that rest on the disk while not needed."""

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.colouring.map_points import (
    CELL,
    POINT,
    VOTE,
    added_votes,
    cells_of,
    merged,
    points_of_cells,
    votes_of,
)
from sceneloom.errors import OptionError

TILE_CUBES = 512
"""A tile is a square column of so many cubes along x and y."""

_MOST_CELLS = 2_000_000
"""Cubes that are held in memory at most, some 250 MB, but for those of one tile; others rest on the disk."""
_PENDING_SHARE, _LEAST_PENDING = 0.5, 50_000
_HEIGHT_CUBES = 1 << 24
_FARTHEST_TILE = 1 << 30
_BOUNDS = np.array([64.0 * _HEIGHT_CUBES, 64.0 * _HEIGHT_CUBES, 0.5 * _HEIGHT_CUBES])
_AGREEMENT = 40.0
"""Colours that differ by more levels from the best one of their cube are left out of its mean."""

Tile = tuple[int, int]


@dataclass(slots=True, eq=False)
class _Tile:
    """What is in memory of a tile: its cells, and points that are not in cells yet."""

    cells: AnyArray
    votes: AnyArray
    pending: list[AnyArray] = field(default_factory=list)
    waiting: int = 0

    @property
    def size(self) -> int:
        return len(self.cells) + self.waiting


@dataclass(slots=True)
class WorldMap:
    """Gathers points and gives one for each cube of space.

    Attributes:
        voxel: side of the cubes [m].
        folder: an empty folder for tiles that do not fit into the memory.
        mean: whether a cube's colour is the mean of its points' by weight, or that with the greatest weight.
        most_cells: how many cubes are held in memory.
        added: points so far.

    Raises:
        OptionError: the side is not a positive number.
    """

    voxel: float
    folder: Path
    mean: bool = True
    most_cells: int = _MOST_CELLS
    added: int = 0
    _tiles: OrderedDict[Tile, _Tile] = field(default_factory=OrderedDict)
    _known: dict[Tile, None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (isfinite(self.voxel) and 0.001 <= self.voxel <= 1000):
            raise OptionError(f"voxel {self.voxel}; expected 0.001 to 1000 m")

    def add(self, points: AnyArray) -> None:
        """Take points (N,) of dtype `POINT`; those that are not finite, or beyond all bounds, are left out."""
        cubes = np.floor(points["position"] / self.voxel)
        inside = (np.abs(cubes) < _BOUNDS).all(axis=1)
        points, cubes = points[inside], cubes[inside].astype(np.int64)
        self.added += len(points)
        tiles = cubes[:, :2] // TILE_CUBES
        codes = tiles[:, 0] * _FARTHEST_TILE + tiles[:, 1]
        order = np.argsort(codes, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(codes[order])) + 1) if len(codes) else ():
            self._take((int(tiles[rows[0], 0]), int(tiles[rows[0], 1])), points[rows])
        self._rest()

    def _take(self, key: Tile, points: AnyArray) -> None:
        tile = self._opened(key)
        tile.pending.append(points)
        tile.waiting += len(points)
        if tile.waiting > max(_LEAST_PENDING, _PENDING_SHARE * len(tile.cells)):
            self._settle(tile)

    def _settle(self, tile: _Tile) -> None:
        """Put the points that wait into cells."""
        if tile.pending:
            points = np.concatenate(tile.pending)
            cubes = self._numbers(points)
            tile.cells = merged(
                [tile.cells, cells_of(points, cubes, agreement=_AGREEMENT)], agreement=_AGREEMENT
            )
            tile.votes = added_votes([tile.votes, votes_of(points, cubes)])
            tile.pending, tile.waiting = [], 0

    def _numbers(self, points: AnyArray) -> Int64Array:
        """The number of each point's cube in its tile."""
        cubes = np.floor(points["position"] / self.voxel).astype(np.int64)
        numbers: Int64Array = (
            (cubes[:, 0] % TILE_CUBES) * TILE_CUBES + cubes[:, 1] % TILE_CUBES
        ) * _HEIGHT_CUBES + (cubes[:, 2] + _HEIGHT_CUBES // 2)
        return numbers

    def _opened(self, key: Tile) -> _Tile:
        if key in self._tiles:
            self._tiles.move_to_end(key)
            return self._tiles[key]
        if key in self._known:
            tile = _Tile(np.load(self._file(key, "cells")), np.load(self._file(key, "votes")))
        else:
            tile = _Tile(np.zeros(0, CELL), np.zeros(0, VOTE))
        self._known[key] = None
        self._tiles[key] = tile
        return tile

    def _rest(self) -> None:
        """Put the tiles that were not touched for longest onto the disk, until the others fit."""
        size = sum(tile.size for tile in self._tiles.values())
        while size > self.most_cells and len(self._tiles) > 1:
            key, tile = self._tiles.popitem(last=False)
            size -= tile.size
            self._settle(tile)
            np.save(self._file(key, "cells"), tile.cells)
            np.save(self._file(key, "votes"), tile.votes)

    def _file(self, key: Tile, what: str) -> Path:
        return self.folder / f"{key[0]}_{key[1]}_{what}.npy"

    def points(self) -> Iterator[AnyArray]:
        """Give the map tile by tile, (C,) of dtype `POINT` each; nothing can be added afterwards."""
        for key in sorted(self._known):
            tile = self._opened(key)
            self._settle(tile)
            del self._tiles[key]
            for what in ("cells", "votes"):
                self._file(key, what).unlink(missing_ok=True)
            if len(tile.cells):
                yield points_of_cells(tile.cells, tile.votes, mean=self.mean)
        self._known.clear()


def empty_points(count: int) -> AnyArray:
    """Points (N,) of dtype `POINT` at 0 that nothing is said of."""
    points = np.zeros(count, POINT)
    points["color"], points["camera"], points["picture"], points["label"] = 255, 255, -1, 65535
    points["pixel"] = np.nan
    return points
