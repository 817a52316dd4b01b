"""The street: what stands where along the ego trajectory, laid out by seed."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.simulate.ground import GroundMap, Lane
from sceneloom.simulate.movers import NO_MOVERS, Movers
from sceneloom.simulate.objects import (
    Design,
    design_bin,
    design_car,
    design_hedge,
    design_house,
    design_lamp,
    design_sign,
    design_tree,
)
from sceneloom.simulate.path import EgoPath
from sceneloom.simulate.shapes import PackedShapes, Shape


@dataclass(frozen=True, slots=True)
class StreetObject:
    """One thing of the street.

    Attributes:
        instance: its number in instance images, from 1; 0 is the ground, -1 the sky.
        label: its class: "building", "car", "tree", "pole", "bin", "barrier".
        center_world: middle of its box [m].
        size_lwh: length, width, height of its box [m].
        yaw: direction of its forward axis [rad], counter-clockwise from the world's x.
    """

    instance: int
    label: str
    center_world: tuple[float, float, float]
    size_lwh: tuple[float, float, float]
    yaw: float


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """All that sensors can meet.

    Attributes:
        objects: what stands on the ground, by instance number - 1.
        shapes: their bodies.
        ground: the map of the plane z = 0.
        movers: what moves.
        bodies: the shapes of the objects, then those of the movers: what the numbers of hits mean.
    """

    objects: tuple[StreetObject, ...]
    shapes: PackedShapes
    ground: GroundMap
    movers: Movers = NO_MOVERS
    bodies: PackedShapes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bodies", self.shapes.joined(self.movers.shapes))


@dataclass(frozen=True, slots=True)
class Row:
    """Things of one kind along the street.

    Attributes:
        left: how far left of the ego trajectory their middles are [m]: from, to.
        every: distance from one to the next [m]: from, to.
        share: how many of the locations are taken.
        design: makes one.
        rotation: added to the street's heading [rad]: from, to.
        keep: how near the trajectory their ground plan may come [m], to the right and to the left.
    """

    left: tuple[float, float]
    every: tuple[float, float]
    share: float
    design: Callable[[np.random.Generator], Design]
    rotation: tuple[float, float] = (-0.03, 0.03)
    keep: tuple[float, float] = (2.0, 5.6)


def _hedge(generator: np.random.Generator) -> Design:
    return design_hedge(generator, length=generator.uniform(3.0, 7.0))


_ROTATED = (np.pi - 0.03, np.pi + 0.03)
ROWS: tuple[Row, ...] = (
    Row((-3.05, -2.85), (5.6, 9.0), 0.62, design_car),
    Row((6.5, 6.6), (5.6, 9.0), 0.62, design_car, _ROTATED),
    Row((-4.7, -4.6), (24.0, 28.0), 1.0, design_lamp, (np.pi / 2,) * 2),
    Row((8.1, 8.2), (24.0, 28.0), 1.0, design_lamp, (-np.pi / 2,) * 2),
    Row((-5.0, -4.8), (9.0, 16.0), 0.75, design_tree, (0.0, 6.3)),
    Row((8.3, 8.6), (9.0, 16.0), 0.75, design_tree, (0.0, 6.3)),
    Row((-4.7, -4.6), (30.0, 60.0), 1.0, design_sign, _ROTATED),
    Row((8.1, 8.2), (30.0, 60.0), 1.0, design_sign),
    Row((-6.6, -6.3), (8.0, 20.0), 0.8, design_bin, (0.0, 6.3)),
    Row((9.7, 10.0), (8.0, 20.0), 0.8, design_bin, (0.0, 6.3)),
    Row((-7.5, -7.3), (7.2, 12.0), 0.7, _hedge, (0.0, 0.0), (6.8, 10.3)),
    Row((10.9, 11.1), (7.2, 12.0), 0.7, _hedge, (0.0, 0.0), (6.8, 10.3)),
)
"""Everything between the houses."""

_HOUSE_KEEP = (8.0, 11.6)
_SETBACK = (0.2, 3.0)
_BACK_ROW = (16.0, 26.0)


@dataclass(slots=True)
class _Plots:
    """The ground that is taken while a street is laid out."""

    lane: Lane
    centers: list[tuple[float, float]] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    plans: list[Float64Array] = field(default_factory=list)
    placed: list[tuple[Design, float, float, float]] = field(default_factory=list)

    def try_location(
        self, design: Design, along: float, left: float, rotation: float, keep: tuple[float, float]
    ) -> bool:
        """Set an object down unless it would come too near the trajectory or stand in another."""
        x, y, heading = self.lane.location(along, left)
        plan = design.plan(x, y, heading + rotation)
        offsets = self.lane.offsets(plan)
        if ((offsets > -keep[0]) & (offsets < keep[1])).any() or np.ptp(np.sign(offsets)) != 0:
            return False
        apart = np.linalg.norm(np.array(self.centers).reshape(-1, 2) - [x, y], axis=1)
        near = np.flatnonzero(apart < np.array(self.radii) + _radius(plan))
        if any(_overlap(plan, self.plans[k]) for k in near):
            return False
        self.put(design, x, y, heading + rotation)
        return True

    def put(self, design: Design, x: float, y: float, yaw: float) -> None:
        """Set an object down at a location of the world [m], rotated by `yaw` [rad]."""
        plan = design.plan(x, y, yaw)
        self.centers.append((x, y))
        self.radii.append(_radius(plan))
        self.plans.append(plan)
        self.placed.append((design, x, y, yaw))


def _radius(plan: Float64Array) -> float:
    """Half the diagonal of a ground plan [m]."""
    return float(np.linalg.norm(plan[0] - plan[4])) / 2


def _overlap(a: Float64Array, b: Float64Array) -> bool:
    """Whether two rectangular ground plans touch: no line along a side of either parts them."""
    for plan in (a, b):
        for axis in (plan[0] - plan[2], plan[2] - plan[4]):
            if (a @ axis).max() < (b @ axis).min() or (b @ axis).max() < (a @ axis).min():
                return False
    return True


def build_street(generator: np.random.Generator, path: EgoPath) -> Street:
    """Build houses first, then everything between them and the road, along the whole of the ego's curve."""
    lane = Lane.of(path)
    plots = _Plots(lane)
    _close_ends(generator, plots)
    for side in (-1.0, 1.0):
        _build_houses(generator, plots, side)
        _build_back_row(generator, plots, side)
    for row in ROWS:
        for along in _locations(generator, lane, row.every):
            if generator.uniform() < row.share:
                left, rotation = generator.uniform(*row.left), generator.uniform(*row.rotation)
                plots.try_location(row.design(generator), along, left, rotation, row.keep)
    return _street_of(plots, GroundMap.of(lane))


def _locations(generator: np.random.Generator, lane: Lane, every: tuple[float, float]) -> Iterator[float]:
    along = float(lane.along[0]) + generator.uniform(*every)
    while along < lane.along[-1]:
        yield along
        along += generator.uniform(*every)


def _build_houses(generator: np.random.Generator, plots: _Plots, side: float) -> None:
    """A row of houses, some wall to wall, some with gardens between."""
    along = float(plots.lane.along[0])
    while along < plots.lane.along[-1]:
        length, depth = generator.uniform(8.0, 15.0), generator.uniform(7.0, 10.0)
        design = design_house(generator, length=length, depth=depth, storeys=int(generator.integers(2, 5)))
        keep = _HOUSE_KEEP[int(side > 0)] + generator.uniform(*_SETBACK)
        left = side * (keep + design.size_lwh[1] / 2 + 0.3)
        fits = plots.try_location(design, along + design.size_lwh[0] / 2, left, 0.0, _HOUSE_KEEP)
        gap = 0.1 if generator.uniform() < 0.4 else generator.uniform(1.5, 6.0)
        along += design.size_lwh[0] + gap if fits else 2.0


def _build_back_row(generator: np.random.Generator, plots: _Plots, side: float) -> None:
    """Taller houses behind, seen through the gaps and above the roofs."""
    for along in _locations(generator, plots.lane, (22.0, 40.0)):
        length, depth = generator.uniform(12.0, 20.0), generator.uniform(10.0, 14.0)
        design = design_house(generator, length=length, depth=depth, storeys=int(generator.integers(4, 8)))
        left = side * (generator.uniform(*_BACK_ROW) + depth)
        plots.try_location(design, along, left, generator.uniform(-0.2, 0.2), _HOUSE_KEEP)


def _close_ends(generator: np.random.Generator, plots: _Plots) -> None:
    """A house across each end of the street, where the ego never comes."""
    lane = plots.lane
    for end, ahead in ((-1, 1.0), (0, -1.0)):
        design = design_house(generator, length=44.0, depth=12.0, storeys=5)
        x, y, heading = lane.location(float(lane.along[end]), 1.75)
        plots.put(
            design,
            x + ahead * 14.0 * np.cos(heading),
            y + ahead * 14.0 * np.sin(heading),
            heading + np.pi / 2,
        )


def _street_of(plots: _Plots, ground: GroundMap) -> Street:
    shapes: list[Shape] = []
    instances: list[int] = []
    objects = []
    for number, (design, x, y, yaw) in enumerate(plots.placed, start=1):
        parts = design.placed(x, y, yaw)
        shapes += parts
        instances += [number] * len(parts)
        objects.append(StreetObject(number, design.label, design.center(x, y, yaw), design.size_lwh, yaw))
    return Street(tuple(objects), PackedShapes.of(shapes, instances), ground)
