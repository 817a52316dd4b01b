"""The surfaces around the ego, in memory that does not grow with the drive."""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.surface_map import SIDE, describe_surfaces, fill_table, insert_points

_FIRST_ROOM = 1 << 15
_LEAST_POINTS = 5.0
"""Points that a cube needs before it says where its surface is."""
_MOST_HITS = 3
"""Points that each part of a cube takes: what is full stays as it was measured first, so a stationary ego changes
nothing, and the map does not follow the poses that were found with it."""


class SurfaceLevel:
    """Cubes of space of one size, with the mean and the spread of the points in them."""

    def __init__(self, leaf: float, noise: float) -> None:
        """Start empty, with cubes of side `leaf` [m] for points with a standard deviation `noise` [m]."""
        self.leaf, self._noise = leaf, noise
        self.count = 0
        self.keys = np.zeros(_FIRST_ROOM, np.int64)
        self.table = np.full(4 * _FIRST_ROOM, -1, np.int32)
        self.surfaces = np.zeros((_FIRST_ROOM, 15))
        self._moments = np.zeros((_FIRST_ROOM, 10))
        self._hits = np.zeros((_FIRST_ROOM, SIDE**3), np.uint8)
        self._touched = np.zeros(_FIRST_ROOM, np.uint8)

    def insert(self, points_world: Float64Array) -> None:
        """Add (N, 3) finite points [m]."""
        progress = np.array([0, self.count], np.int64)
        while True:
            insert_points(
                points_world,
                progress,
                self.leaf,
                _MOST_HITS,
                self.table,
                self.keys,
                self._moments,
                self._hits,
                self._touched,
            )
            self.count = int(progress[1])
            if progress[0] == len(points_world):
                break
            self._resize(np.arange(self.count), 2 * len(self.keys))
        describe_surfaces(
            self.count,
            self.leaf,
            self._noise,
            _LEAST_POINTS,
            self.keys,
            self._moments,
            self._touched,
            self.surfaces,
        )

    def drop_beyond(self, position_world: Float64Array, reach: float) -> None:
        """Forget the cubes farther than `reach` [m] from a location, and return the memory they took."""
        keys = self.keys[: self.count]
        parts = np.stack([(keys >> 42), (keys >> 21), keys], axis=1) & ((1 << 21) - 1)
        centers = (parts - (1 << 20) + 0.5) * self.leaf
        kept = np.flatnonzero(((centers - position_world) ** 2).sum(axis=1) <= reach * reach)
        room = _FIRST_ROOM
        while room < 1.5 * len(kept):
            room *= 2
        self._resize(kept, room)

    def _resize(self, kept: Int64Array, room: int) -> None:
        for name in ("keys", "surfaces", "_moments", "_hits", "_touched"):
            old = getattr(self, name)
            new = np.zeros((room, *old.shape[1:]), old.dtype)
            new[: len(kept)] = old[kept]
            setattr(self, name, new)
        self.count = len(kept)
        self.table = np.full(4 * room, -1, np.int32)
        fill_table(self.count, self.keys, self.table)


_COARSE = 4.0
"""How many times larger the cubes of the second level are: near scan lines a few metres apart lie in one of them."""


class LocalMap:
    """Two levels of surfaces: small cubes for what is measured densely, large ones for the rest."""

    def __init__(self, cube: float, noise: float) -> None:
        """Start empty, with small cubes of side `cube` [m]."""
        self.fine, self.coarse = SurfaceLevel(cube, noise), SurfaceLevel(_COARSE * cube, noise)

    @property
    def is_empty(self) -> bool:
        """Whether nothing was inserted yet."""
        return self.fine.count == 0

    def insert(self, points_world: Float64Array) -> None:
        """Add (N, 3) finite points [m]."""
        for level in (self.fine, self.coarse):
            level.insert(points_world)

    def drop_beyond(self, position_world: Float64Array, reach: float) -> None:
        """Forget what lies farther than `reach` [m] from a location."""
        for level in (self.fine, self.coarse):
            level.drop_beyond(position_world, reach)
