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

TILE_CUBES = 256
"""A tile is a square column of so many cubes along x and y."""

_MOST_CELLS = 2_000_000
"""Cubes that are held in memory at most, some 250 MB, but for those of one tile; others rest on the disk."""
_PENDING_SHARE, _LEAST_PENDING = 0.5, 50_000
_ROOM_SHARE = 0.75
"""What is left in memory once tiles are put onto the disk."""
_HEIGHT_CUBES = 1 << 24
_FARTHEST_TILE = 1 << 30
_BOUNDS = np.array([64.0 * _HEIGHT_CUBES, 64.0 * _HEIGHT_CUBES, 0.5 * _HEIGHT_CUBES])
_AGREEMENT = 40.0
"""Colours that differ by more levels from the best one of their cube are left out of its mean."""

Tile = tuple[int, int]


@dataclass(slots=True, eq=False)
class _Tile:
    """A tile: its cells, in memory or on the disk, and points that are not in cells yet, likewise.

    Attributes:
        cells, votes: None where they rest on the disk.
        known: how many cells there are.
        pending: points in memory that are not in cells yet.
        waiting: how many points are not in cells yet, those on the disk included.
    """

    cells: AnyArray | None = field(default_factory=lambda: np.zeros(0, CELL))
    votes: AnyArray = field(default_factory=lambda: np.zeros(0, VOTE))
    known: int = 0
    pending: list[AnyArray] = field(default_factory=list)
    waiting: int = 0

    @property
    def size(self) -> int:
        """What is in memory of it, counted in cells."""
        return (0 if self.cells is None else len(self.cells)) + sum(map(len, self.pending))


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
    _size: int = 0

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
        tile = self._tiles.setdefault(key, _Tile())
        self._tiles.move_to_end(key)
        tile.pending.append(points)
        tile.waiting += len(points)
        self._size += len(points)
        if tile.waiting > max(_LEAST_PENDING, _PENDING_SHARE * tile.known):
            self._settle(key, tile)

    def _settle(self, key: Tile, tile: _Tile) -> None:
        """Put the points that wait into cells."""
        before = tile.size
        resting = self._file(key, "pending")
        if resting.exists():
            tile.pending.insert(0, np.fromfile(resting, POINT))
            resting.unlink()
        if tile.cells is None:
            tile.cells = np.load(self._file(key, "cells"))
            tile.votes = np.load(self._file(key, "votes"))
        if tile.pending:
            points = np.concatenate(tile.pending)
            tile.pending, tile.waiting = [], 0
            cubes = self._numbers(points)
            made = cells_of(points, cubes, agreement=_AGREEMENT)
            tile.cells = merged([tile.cells, made], agreement=_AGREEMENT)
            tile.votes = added_votes([tile.votes, votes_of(points, cubes)])
            tile.known = len(tile.cells)
        self._size += tile.size - before

    def _numbers(self, points: AnyArray) -> Int64Array:
        """The number of each point's cube in its tile."""
        cubes = np.floor(points["position"] / self.voxel).astype(np.int64)
        numbers: Int64Array = (
            (cubes[:, 0] % TILE_CUBES) * TILE_CUBES + cubes[:, 1] % TILE_CUBES
        ) * _HEIGHT_CUBES + (cubes[:, 2] + _HEIGHT_CUBES // 2)
        return numbers

    def _rest(self) -> None:
        """Put the tiles that were not touched for longest onto the disk, until the others fit."""
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
        """Give the map tile by tile, (C,) of dtype `POINT` each; nothing can be added afterwards."""
        for key in sorted(self._tiles):
            tile = self._tiles.pop(key)
            self._settle(key, tile)
            for what in ("cells", "votes"):
                self._file(key, what).unlink(missing_ok=True)
            if tile.cells is not None and len(tile.cells):
                yield points_of_cells(tile.cells, tile.votes, mean=self.mean)


def empty_points(count: int) -> AnyArray:
    """Points (N,) of dtype `POINT` at 0 that nothing is stated for."""
    points = np.zeros(count, POINT)
    points["color"], points["camera"], points["image"], points["label"] = 255, 255, -1, 65535
    points["pixel"] = np.nan
    return points
