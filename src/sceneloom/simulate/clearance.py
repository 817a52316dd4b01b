"""Whether what moves keeps clear of everything: ground plans over time against each other."""

from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array
from sceneloom.simulate.shapes import PackedShapes

_HEADROOM = 2.0
"""Shapes whose lowest point is higher [m] are passed under."""

_SPARE = np.array([0.4, 0.04])
"""How much longer to either end and wider to either side ground plans are taken [m]."""

_STRETCH = 32
"""Times of a trajectory that are looked at together."""


@dataclass(frozen=True, slots=True, eq=False)
class Plans:
    """Rectangles on the ground, one per time or per thing.

    Attributes:
        centers: (N, 2) float64 [m], world frame.
        yaws: (N,) float64 [rad], of the side `half[:, 0]`.
        half: (N, 2) float64 [m].
        there: (N,) bool, whether it counts.
    """

    centers: Float64Array
    yaws: Float64Array
    half: Float64Array
    there: BoolArray

    @property
    def radii(self) -> Float64Array:
        """Half the diagonals (N,) [m]."""
        return np.hypot(self.half[:, 0], self.half[:, 1])

    def taken(self, which: AnyArray | slice) -> "Plans":
        """Some of them, by index or mask."""
        return Plans(self.centers[which], self.yaws[which], self.half[which], self.there[which])


def plans_of(shapes: PackedShapes) -> Plans:
    """Give the ground plans of the shapes that something on the ground can run into."""
    half = shapes.halves
    rotations = np.swapaxes(shapes.maps[:, :, :3] * half[:, :, None], 1, 2)
    yaws = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    along = np.stack([np.cos(yaws), np.sin(yaws)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    extents = [
        (np.abs(np.einsum("pi,pij->pj", axis, rotations[:, :2])) * half).sum(axis=1)
        for axis in (along, across)
    ]
    lowest = shapes.spheres[:, 2] - (np.abs(rotations[:, 2]) * half).sum(axis=1)
    return Plans(shapes.spheres[:, :2], yaws, np.stack(extents, axis=1), lowest < _HEADROOM)


def overlapping(a: Plans, b: Plans) -> BoolArray:
    """Report pair by pair (N,) whether rectangles that are both there touch: no side's direction parts them."""
    apart = b.centers - a.centers
    touching = a.there & b.there
    rotation = b.yaws - a.yaws
    cosine, sine = np.abs(np.cos(rotation)), np.abs(np.sin(rotation))
    mixed = np.stack([np.stack([cosine, sine], axis=1), np.stack([sine, cosine], axis=1)], axis=1)
    for own, other in ((a, b), (b, a)):
        along = np.stack([np.cos(own.yaws), np.sin(own.yaws)], axis=1)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        reach = own.half + np.einsum("nij,nj->ni", mixed, other.half)
        for k, axis in enumerate((along, across)):
            touching = touching & (np.abs((apart * axis).sum(axis=1)) < reach[:, k])
    return touching


@dataclass(slots=True)
class Clearance:
    """The ground that is taken at each of T times while movers are planned.

    Attributes:
        stationary: what never moves.
        moving: the plans of each mover, one per time.
    """

    stationary: Plans
    moving: list[Plans] = field(default_factory=list)

    def try_add(self, plans: Plans) -> bool:
        """Take the ground of a mover at all times unless it would come too near something; report whether."""
        wider = Plans(plans.centers, plans.yaws, plans.half + _SPARE, plans.there)
        if not plans.there.any() or self._hits_stationary(wider) or self._hits_moving(wider):
            return False
        self.moving.append(plans)
        return True

    def _hits_stationary(self, plans: Plans) -> bool:
        plans = plans.taken(plans.there)
        return any(
            self._hits_near(plans.taken(slice(start, start + _STRETCH)))
            for start in range(0, len(plans.yaws), _STRETCH)
        )

    def _hits_near(self, plans: Plans) -> bool:
        """The same for a short stretch of a trajectory, where few things stand."""
        reach = self.stationary.radii[:, None] + float(plans.radii.max())
        low, high = plans.centers.min(axis=0) - reach, plans.centers.max(axis=0) + reach
        near = ((self.stationary.centers > low) & (self.stationary.centers < high)).all(axis=1)
        obstacles = self.stationary.taken(near & self.stationary.there)
        apart = plans.centers[:, None] - obstacles.centers[None]
        reach = plans.radii[:, None] + obstacles.radii[None]
        time, which = np.nonzero((apart * apart).sum(axis=2) < reach * reach)
        return len(time) > 0 and bool(overlapping(plans.taken(time), obstacles.taken(which)).any())

    def _hits_moving(self, plans: Plans) -> bool:
        for other in self.moving:
            apart, reach = plans.centers - other.centers, plans.radii + other.radii
            near = np.flatnonzero((apart * apart).sum(axis=1) < reach * reach)
            if len(near) and overlapping(plans.taken(near), other.taken(near)).any():
                return True
        return False
