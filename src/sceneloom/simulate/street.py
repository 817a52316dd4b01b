"""The simulated street: ground and lanes, where objects stand by seed, and their true boxes."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.scene.annotations import CuboidAnnotation, CuboidPath
from sceneloom.simulate.objects import (
    NO_MOVERS,
    Design,
    Mover,
    Movers,
    PackedShapes,
    Shape,
    design_bin,
    design_car,
    design_hedge,
    design_house,
    design_lamp,
    design_sign,
    design_tree,
)
from sceneloom.simulate.trajectory import EgoPath

PALETTE = ((104, 105, 110), (238, 238, 228), (172, 166, 158), (196, 194, 188), (112, 136, 74))
"""Asphalt, paint, pavement, kerb, grass."""

GRAIN = 0.55
"""Share of laser light that the ground gives back where it is white."""

_STEP = 0.25

_WIDTH = 14.0

_CELL = 0.5

_FAR = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """The ego trajectory as a chain of points every 25 cm, which the street follows.

    Attributes:
        points: (L, 2) float64 [m], world frame.
        headings: (L,) float64 [rad].
        curvatures: (L,) float64 [1/m].
        along: (L,) float64 [m], arc length, 0 where the drive begins.
        parameters: (L,) float64 [s], of the path's curve.
    """

    points: Float64Array
    headings: Float64Array
    curvatures: Float64Array
    along: Float64Array
    parameters: Float64Array

    @classmethod
    def of(cls, path: EgoPath) -> "Lane":
        """Follow a path from the beginning to the end of its curve."""
        first, last = path.reach
        fine = np.linspace(first, last, int((last - first) * 100) + 1)[:-1]
        xy = path.on_curve(fine).positions[:, :2]
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
        even = np.arange(0.0, length[-1], _STEP)
        seconds = np.interp(even, length, fine)
        states = path.on_curve(seconds)
        (vx, vy), (ax, ay) = states.velocities[:, :2].T, states.accelerations[:, :2].T
        return cls(
            states.positions[:, :2],
            np.unwrap(np.arctan2(vy, vx)),
            (vx * ay - vy * ax) / np.hypot(vx, vy) ** 3,
            even - np.interp(0.0, fine, length),
            seconds,
        )

    def location(self, along: float, left: float) -> tuple[float, float, float]:
        """World x, y [m] and heading [rad] of a spot `along` the trajectory and `left` of it."""
        x, y = (float(np.interp(along, self.along, self.points[:, axis])) for axis in range(2))
        heading = float(np.interp(along, self.along, self.headings))
        return x - left * np.sin(heading), y + left * np.cos(heading), heading

    def offsets(self, points: Float64Array) -> Float64Array:
        """How far left of the trajectory (M, 2) points lie [m]; negative to the right."""
        apart = points[:, None, :] - self.points[None, ::4, :]
        nearest = np.argmin((apart * apart).sum(axis=2), axis=1)
        dx, dy = apart[np.arange(len(points)), nearest].T
        heading = self.headings[::4][nearest]
        sign = np.sign(np.cos(heading) * dy - np.sin(heading) * dx)
        left: Float64Array = sign * np.hypot(dx, dy)
        return left


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """Coordinates of the ground around the trajectory, at the nodes of a square grid.

    Attributes:
        nodes: (X, Y, 4) float32: along [m], left [m], cosine and sine of the trajectory's heading.
        corner: (2,) float64 [m], world position of node (0, 0).
        cell: distance of neighbouring nodes [m].
    """

    nodes: Float32Array
    corner: Float64Array
    cell: float = _CELL

    @classmethod
    def of(cls, lane: Lane) -> "GroundMap":
        """Draw a strip along the lane; elsewhere the ground lies far to its left."""
        corner = np.floor(lane.points.min(axis=0)) - _FAR
        size = np.ceil((lane.points.max(axis=0) + _FAR - corner) / _CELL).astype(np.int64) + 1
        nodes = np.zeros((*size, 4), np.float32)
        nodes[..., 1], nodes[..., 2] = _WIDTH, 1.0
        nearest = np.full(size, np.inf)
        for k in range(len(lane.points)):
            _draw(nodes, nearest, corner, lane, k)
        return cls(nodes, corner)


def _draw(nodes: Float32Array, nearest: Float64Array, corner: Float64Array, lane: Lane, k: int) -> None:
    """Write the coordinates of the nodes that lie nearer to point k of the lane than to those before."""
    low = np.maximum(0, np.floor((lane.points[k] - _WIDTH - corner) / _CELL).astype(np.int64))
    high = np.ceil((lane.points[k] + _WIDTH - corner) / _CELL).astype(np.int64) + 1
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    shape = nearest[window].shape
    x = (corner[0] + _CELL * (low[0] + np.arange(shape[0])) - lane.points[k, 0])[:, None]
    y = (corner[1] + _CELL * (low[1] + np.arange(shape[1])) - lane.points[k, 1])[None, :]
    squared = x * x + y * y
    closer = squared < np.minimum(nearest[window], _WIDTH**2)
    cosine, sine = np.cos(lane.headings[k]), np.sin(lane.headings[k])
    ahead, left = (cosine * x + sine * y)[closer], (cosine * y - sine * x)[closer]
    stretch = np.maximum(0.2, 1.0 - lane.curvatures[k] * left)
    values = np.column_stack(
        [lane.along[k] + ahead / stretch, left, np.full(len(left), cosine), np.full(len(left), sine)]
    )
    nearest[window][closer] = squared[closer]
    nodes[window][closer] = values


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

_ROWS: tuple[Row, ...] = (
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
    for row in _ROWS:
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


_EVERY_NS = 50_000_000
"""Distance of the samples of a moving box [ns].

Between them lines miss an acceleration a by a dt² / 8: 3 mm at 10 m/s², a car in the tightest bend, and 0.04 degrees
at 2 rad/s².
"""


@dataclass(frozen=True, slots=True, eq=False)
class BoxTruth:
    """Where every object is at T times: first those that stand, then those that move, I of them.

    Attributes:
        timestamps_ns: (T,) int64 [ns].
        instances: (I,) int64, as in instance images.
        labels: I of them.
        sizes_lwh: (I, 3) float64 [m].
        centers_world: (T, I, 3) float64 [m].
        yaws: (T, I) float64 [rad], counter-clockwise from the world's x.
        velocities: (T, I, 3) float64 [m/s], world frame.
        yaw_rates: (T, I) float64 [rad/s].
        present: (T, I) bool, whether it is in the street; elsewhere the numbers mean nothing.
    """

    timestamps_ns: Int64Array
    instances: Int64Array
    labels: tuple[str, ...]
    sizes_lwh: Float64Array
    centers_world: Float64Array
    yaws: Float64Array
    velocities: Float64Array
    yaw_rates: Float64Array
    present: BoolArray


def boxes_of(street: Street, timestamps_ns: Int64Array) -> BoxTruth:
    """Give the boxes of a street at (T,) int64 times [ns]."""
    times = np.asarray(timestamps_ns, np.int64).reshape(-1)
    things: tuple[StreetObject | Mover, ...] = (*street.objects, *street.movers.things)
    sizes = np.array([thing.size_lwh for thing in things], np.float64).reshape(-1, 3)
    count, stationary = len(times), len(street.objects)
    locations = np.array([(*thing.center_world, thing.yaw) for thing in street.objects]).reshape(-1, 4)
    which = np.arange(len(street.movers))[None, :]
    states = street.movers.states(which, times[:, None])
    lifted = states.positions + np.array([0.0, 0.0, 0.5]) * sizes[stationary:]
    still = np.zeros((count, stationary))
    return BoxTruth(
        times,
        np.array([thing.instance for thing in things], np.int64),
        tuple(thing.label for thing in things),
        sizes,
        np.concatenate([np.broadcast_to(locations[:, :3], (count, stationary, 3)), lifted], axis=1),
        np.concatenate([np.broadcast_to(locations[:, 3], (count, stationary)), states.yaws], axis=1),
        np.concatenate([np.zeros((count, stationary, 3)), states.velocities], axis=1),
        np.concatenate([still, states.yaw_rates], axis=1),
        np.concatenate([still == 0.0, street.movers.present(which, times[:, None])], axis=1),
    )


def annotations_of(street: Street, labels: Collection[str], *, start_ns: int) -> tuple[CuboidAnnotation, ...]:
    """Give a box for each object of some classes; angles in degrees.

    What moves has a path while it is in the street, sampled every 50 ms: between samples a line stays within 1 cm, up
    to an acceleration of 30 m/s², and the shortest arc within 0.1 degrees of the truth. Samples lie on `start_ns` and
    all multiples of their distance.
    """
    stationary = tuple(
        _annotation(thing, np.array([start_ns], np.int64), [(*thing.center_world, thing.yaw)], stands=True)
        for thing in street.objects
        if thing.label in labels
    )
    return stationary + tuple(_moving(street, k, start_ns) for k in range(len(street.movers)))


def _moving(street: Street, k: int, start_ns: int) -> CuboidAnnotation:
    thing = street.movers.things[k]
    timestamps = np.array([start_ns], np.int64) if thing.stands else _samples(thing, start_ns)
    states = street.movers.states(np.full(len(timestamps), k), timestamps)
    heights = np.full(len(timestamps), 0.5 * thing.size_lwh[2])
    locations = np.column_stack([states.positions[:, :2], heights, states.yaws])
    return _annotation(thing, timestamps, locations, stands=thing.stands)


def _samples(thing: Mover, start_ns: int) -> Int64Array:
    """Times while it is in the street, its first and last included."""
    first, last = (-(-(thing.first_ns - start_ns) // _EVERY_NS), (thing.last_ns - start_ns) // _EVERY_NS)
    inner = start_ns + _EVERY_NS * np.arange(first, last + 1, dtype=np.int64)
    return np.unique(np.concatenate([[thing.first_ns], inner, [thing.last_ns]])).astype(np.int64)


def _annotation(
    thing: StreetObject | Mover, timestamps: Int64Array, locations: ArrayLike, *, stands: bool
) -> CuboidAnnotation:
    """A box from x, y, z and yaw (T, 4)."""
    x_y_z_yaw = np.asarray(locations, np.float64)
    values = np.zeros((len(timestamps), 9))
    values[:, :3], values[:, 3:6] = thing.size_lwh, x_y_z_yaw[:, :3]
    values[:, 8] = np.degrees(x_y_z_yaw[:, 3])
    return CuboidAnnotation(
        f"{thing.label}-{thing.instance}",
        CuboidPath(timestamps, values),
        label=thing.label,
        stationary=stands,
    )
