"""Traffic: what moves besides the ego, along which tracks, without collisions."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array
from sceneloom.simulate.objects import (
    Mover,
    Movers,
    MovingDesign,
    PackedShapes,
    design_cyclist,
    design_moving_car,
    design_pedestrian,
    pack_movers,
)
from sceneloom.simulate.parameters import check_bounds
from sceneloom.simulate.street import Lane, Street
from sceneloom.simulate.trajectory import DEGREE, EgoPath, control_points_through, spline_derivatives


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """A line at a constant distance beside the trajectory, straight on beyond its ends.

    Attributes:
        points: (L, 2) float64 [m], world frame.
        headings: (L,) float64 [rad], of the trajectory.
        along: (L,) float64 [m], arc length of this line, from 0.
        widths: (L,) float64, length of this line per length of the trajectory: small on the inside of a bend.
        parameters: (L,) float64, the ego's curve parameters beside the points.
    """

    points: Float64Array
    headings: Float64Array
    along: Float64Array
    widths: Float64Array
    parameters: Float64Array

    @classmethod
    def of(cls, lane: Lane, left: float) -> "_Track":
        """Lay a line `left` of the trajectory [m]."""
        normals = np.column_stack([-np.sin(lane.headings), np.cos(lane.headings)])
        points = lane.points + left * normals
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        return cls(points, lane.headings, along, 1.0 - lane.curvatures * left, lane.parameters)

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.along[-1])

    def beside(self, parameters: Float64Array) -> Float64Array:
        """How far along it one is beside the ego's curve at (N,) parameters, (N,) [m]."""
        along: Float64Array = np.interp(parameters, self.parameters, self.along)
        return along

    def at(self, along: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Give points (N, 2) [m] and the trajectory's headings (N,) [rad] at arc lengths (N,)."""
        inside = np.clip(along, 0.0, self.length)
        points = np.column_stack([np.interp(inside, self.along, self.points[:, axis]) for axis in range(2)])
        headings = np.interp(inside, self.along, self.headings)
        ahead = np.column_stack([np.cos(headings), np.sin(headings)])
        return points + (along - inside)[:, None] * ahead, headings

    def narrowest(self, first: float, last: float) -> float:
        """The least of `widths` between two arc lengths [m]; below 0 the line runs backwards."""
        low, high = np.searchsorted(self.along, [first, last])
        return float(self.widths[max(0, low - 1) : high + 1].min(initial=1.0))


_HEADROOM = 2.0
"""Shapes whose lowest point is higher [m] are passed under."""

_SPARE = np.array([0.4, 0.04])
"""How much longer to either end and wider to either side ground plans are taken [m]."""

_STRETCH = 32
"""Times of a trajectory that are looked at together."""


@dataclass(frozen=True, slots=True, eq=False)
class _Plans:
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

    def taken(self, which: AnyArray | slice) -> "_Plans":
        """Some of them, by index or mask."""
        return _Plans(self.centers[which], self.yaws[which], self.half[which], self.there[which])


def _plans_of(shapes: PackedShapes) -> _Plans:
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
    return _Plans(shapes.spheres[:, :2], yaws, np.stack(extents, axis=1), lowest < _HEADROOM)


def _overlapping(a: _Plans, b: _Plans) -> BoolArray:
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
class _Clearance:
    """The ground that is taken at each of T times while movers are planned.

    Attributes:
        stationary: what never moves.
        moving: the plans of each mover, one per time.
    """

    stationary: _Plans
    moving: list[_Plans] = field(default_factory=list)

    def try_add(self, plans: _Plans) -> bool:
        """Take the ground of a mover at all times unless it would come too near something; report whether."""
        wider = _Plans(plans.centers, plans.yaws, plans.half + _SPARE, plans.there)
        if not plans.there.any() or self._hits_stationary(wider) or self._hits_moving(wider):
            return False
        self.moving.append(plans)
        return True

    def _hits_stationary(self, plans: _Plans) -> bool:
        plans = plans.taken(plans.there)
        return any(
            self._hits_near(plans.taken(slice(start, start + _STRETCH)))
            for start in range(0, len(plans.yaws), _STRETCH)
        )

    def _hits_near(self, plans: _Plans) -> bool:
        """The same for a short stretch of a trajectory, where few things stand."""
        reach = self.stationary.radii[:, None] + float(plans.radii.max())
        low, high = plans.centers.min(axis=0) - reach, plans.centers.max(axis=0) + reach
        near = ((self.stationary.centers > low) & (self.stationary.centers < high)).all(axis=1)
        obstacles = self.stationary.taken(near & self.stationary.there)
        apart = plans.centers[:, None] - obstacles.centers[None]
        reach = plans.radii[:, None] + obstacles.radii[None]
        time, which = np.nonzero((apart * apart).sum(axis=2) < reach * reach)
        return len(time) > 0 and bool(_overlapping(plans.taken(time), obstacles.taken(which)).any())

    def _hits_moving(self, plans: _Plans) -> bool:
        for other in self.moving:
            apart, reach = plans.centers - other.centers, plans.radii + other.radii
            near = np.flatnonzero((apart * apart).sum(axis=1) < reach * reach)
            if len(near) and _overlapping(plans.taken(near), other.taken(near)).any():
                return True
        return False


_KNOT_STEP = 0.25

_MARGIN = 1.0
"""How far curves reach beyond the drive [s]."""

_LOOK = 0.05
"""Movers are kept apart at times this close [s]."""

_END = 3.0
"""Nearer to the end of the street than this nobody is there [m]."""

_EGO_LW = (4.6, 1.86)
"""Ground that the ego takes [m]."""

_TRIES = 6

_OWN_LANE, _ONCOMING_LANE = 0.0, 3.5

_EDGES = ((-1.5, 1.0), (5.05, -1.0))
"""Where cyclists ride: metres left of the trajectory, and whether with the ego or against it."""

_PAVEMENTS = (-5.6, 9.1)
"""Where pedestrians walk between posts, trees and bins: metres left of the trajectory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficSpec:
    """How busy the street is.

    Attributes:
        cars: moving cars on 100 m of each lane.
        cyclists: on 100 m of each edge of the road.
        pedestrians: on 100 m of each pavement. They and the cyclists are fewer where there is no room.
        stationary: share of the pedestrians who stand.
        crossing: share of the pedestrians who cross the street.

    Raises:
        OptionError: a number is out of bounds.
    """

    cars: float = 2.0
    cyclists: float = 1.0
    pedestrians: float = 4.0
    stationary: float = 0.2
    crossing: float = 0.3

    def __post_init__(self) -> None:
        bounds = (
            ("cars", self.cars, 0.0, 6.0),
            ("cyclists", self.cyclists, 0.0, 10.0),
            ("pedestrians", self.pedestrians, 0.0, 20.0),
            ("stationary", self.stationary, 0.0, 1.0),
            ("crossing", self.crossing, 0.0, 1.0 - self.stationary),
        )
        check_bounds("traffic", bounds)


@dataclass(slots=True)
class _Plan:
    """The street over the time of a drive, while movers are put into it.

    Attributes:
        path, lane: the ego trajectory.
        knots: (N,) float64 [s], when control points weigh most.
        looks: (T,) float64 [s], when movers are kept apart.
        clearance: the ground that is taken.
        designs, curves, there: of those that found room; (N, 4) control points, (T,) bool.
    """

    path: EgoPath
    lane: Lane
    knots: Float64Array
    looks: Float64Array
    clearance: _Clearance
    designs: list[MovingDesign] = field(default_factory=list)
    curves: list[Float64Array] = field(default_factory=list)
    there: list[BoolArray] = field(default_factory=list)

    @property
    def first_knot(self) -> float:
        """Time of the splines' first knot [s]."""
        return float(self.knots[0]) + 2 * _KNOT_STEP

    def try_add(self, design: MovingDesign, samples: Float64Array, inside: BoolArray | None = None) -> bool:
        """Let someone follow x, y, yaw and gait (N, 4) at the knots, unless that is too near another.

        Args:
            inside: (N,) bool, which samples lie in the street; None for all.
        """
        curve = control_points_through(samples)
        along = (self.looks - self.first_knot) / _KNOT_STEP
        (states,) = spline_derivatives(curve[None], np.zeros(1, np.int64), along, orders=1)
        inside = np.ones(len(samples), np.bool_) if inside is None else inside
        there = np.interp(self.looks, self.knots, inside.astype(np.float64)) >= 1.0
        half = np.tile(np.array(design.size_lwh[:2]) / 2, (len(self.looks), 1))
        if not self.clearance.try_add(_Plans(states[:, :2], states[:, 2], half, there)):
            return False
        self.designs.append(design)
        self.curves.append(curve)
        self.there.append(there)
        return True


def plan_traffic(
    generator: np.random.Generator,
    spec: TrafficSpec,
    path: EgoPath,
    street: Street,
    *,
    span_ns: tuple[int, int],
) -> Movers:
    """Put movers into a street for a drive; where there is no room for one it is left out.

    Args:
        street: what stands in it; movers are numbered after it.
        span_ns: first and last time that any sensor needs [ns].
    """
    first, last = ((timestamp - path.start_ns) * 1e-9 for timestamp in span_ns)
    count = int(np.ceil((last - first + 2 * _MARGIN) / _KNOT_STEP)) + DEGREE + 1
    knots: Float64Array = first - _MARGIN + _KNOT_STEP * (np.arange(count, dtype=np.float64) - 2.0)
    looks: Float64Array = np.arange(first, last + _LOOK, _LOOK)
    plan = _Plan(
        path, Lane.of(path), knots, looks, _Clearance(_plans_of(street.shapes), [_ego_plans(path, looks)])
    )
    _add_cars(generator, spec, plan)
    _add_cyclists(generator, spec, plan)
    _add_pedestrians(generator, spec, plan)
    things = [_thing(len(street.objects) + 1 + k, plan, k, span_ns=span_ns) for k in range(len(plan.designs))]
    curves = np.array(plan.curves).reshape(-1, count, 4)
    return pack_movers(
        things,
        plan.designs,
        curves,
        start_ns=path.start_ns,
        first_knot=plan.first_knot,
        knot_step=_KNOT_STEP,
    )


def _ego_plans(path: EgoPath, looks: Float64Array) -> _Plans:
    states = path.at_seconds(looks)
    yaws = np.arctan2(states.rotations[:, 1, 0], states.rotations[:, 0, 0])
    half = np.tile(np.array(_EGO_LW) / 2, (len(looks), 1))
    return _Plans(states.positions[:, :2], yaws, half, np.ones(len(looks), np.bool_))


def _thing(instance: int, plan: _Plan, k: int, *, span_ns: tuple[int, int]) -> Mover:
    design, there = plan.designs[k], np.flatnonzero(plan.there[k])
    timestamps = plan.path.start_ns + np.rint(plan.looks[there[[0, -1]]] * 1e9).astype(np.int64)
    first = span_ns[0] if there[0] == 0 else int(timestamps[0])
    last = span_ns[1] if there[-1] == len(plan.looks) - 1 else int(timestamps[1])
    stands = not np.ptp(plan.curves[k], axis=0).any()
    return Mover(instance, design.label, design.size_lwh, first, last, stands)


def _on_track(
    track: _Track, along: Float64Array, *, ahead: float, gait: Float64Array | float = 0.0
) -> tuple[Float64Array, BoolArray]:
    """Samples of someone who follows a track, and which of them lie in the street."""
    points, headings = track.at(along)
    yaws = headings + (0.0 if ahead > 0 else np.pi)
    samples = np.column_stack([points, yaws, np.broadcast_to(gait, len(along))])
    return samples, (along > _END) & (along < track.length - _END)


def _add_cars(generator: np.random.Generator, spec: TrafficSpec, plan: _Plan) -> None:
    """Cars before and behind the ego, which stop and go as it does, and a stream of oncoming ones."""
    if spec.cars == 0:
        return
    spacing = 100.0 / spec.cars
    parameters, _, _ = plan.path.warp.at(plan.knots)
    for side in (1.0, -1.0):
        track = _Track.of(plan.lane, _OWN_LANE + generator.uniform(-0.08, 0.08))
        ego = track.beside(parameters)
        room = track.length - float(ego.max()) if side > 0 else float(ego.min())
        for gap in _gaps(generator, generator.uniform(14.0, 24.0), spacing, room - 8.0):
            wave = _wave(generator, 2.0, (0.3, 0.5))
            along = ego + side * gap + wave(parameters)
            plan.try_add(design_moving_car(generator), *_on_track(track, along, ahead=1.0))
    track = _Track.of(plan.lane, _ONCOMING_LANE)
    speed, wave = generator.uniform(6.5, 9.0), _wave(generator, 3.0, (0.35, 0.45))
    driven = speed * plan.knots + wave(plan.knots)
    reach = track.length + float(np.ptp(driven))
    for location in _gaps(generator, generator.uniform(0.0, spacing), spacing, reach):
        own = _wave(generator, 1.0, (0.4, 0.7))
        along = location - (driven - driven[0]) + own(plan.knots)
        plan.try_add(design_moving_car(generator), *_on_track(track, along, ahead=-1.0))


def _gaps(generator: np.random.Generator, first: float, spacing: float, last: float) -> Iterator[float]:
    """Locations from `first` to `last` [m], apart by the spacing on average and by a car and its distance at least."""
    location = first
    while location < last:
        yield location
        location += max(13.0, spacing * generator.uniform(0.5, 1.5))


def _wave(
    generator: np.random.Generator, amplitude: float, frequencies: tuple[float, float]
) -> Callable[[Float64Array], Float64Array]:
    """A sine over time: amplitude [m], angular frequency drawn from a range [rad/s]."""
    frequency, phase = generator.uniform(*frequencies), generator.uniform(0, 2 * np.pi)

    def wave(seconds: Float64Array) -> Float64Array:
        swing: Float64Array = amplitude * np.sin(frequency * seconds + phase)
        return swing

    return wave


def _add_cyclists(generator: np.random.Generator, spec: TrafficSpec, plan: _Plan) -> None:
    """Cyclists at both edges of the road, each at a speed of its own."""
    for left, ahead in _EDGES:
        track = _Track.of(plan.lane, left)
        flow = 4.5 * float(np.ptp(plan.knots))
        for _ in range(generator.poisson(spec.cyclists / 100.0 * (track.length + flow))):
            design = design_cyclist(generator)
            for _ in range(_TRIES):
                speed, wave = generator.uniform(3.4, 5.6), _wave(generator, 0.8, (0.3, 0.5))
                start = generator.uniform(-flow, track.length)
                driven = start + speed * (plan.knots - plan.knots[0]) + wave(plan.knots)
                along = driven if ahead > 0 else track.length - driven
                if plan.try_add(design, *_on_track(track, along, ahead=ahead)):
                    break


def _add_pedestrians(generator: np.random.Generator, spec: TrafficSpec, plan: _Plan) -> None:
    """Some walk along the pavements, some stand there, some cross the street."""
    for left in _PAVEMENTS:
        length = _Track.of(plan.lane, left).length
        for _ in range(generator.poisson(spec.pedestrians / 100.0 * length)):
            kind = generator.uniform()
            add = _try_stand if kind < spec.stationary else _try_walk
            if spec.stationary <= kind < spec.stationary + spec.crossing:
                add = _try_cross
            design = design_pedestrian(generator, walks=add is not _try_stand)
            any(add(generator, plan, design, left) for _ in range(_TRIES))


def _try_walk(generator: np.random.Generator, plan: _Plan, design: MovingDesign, left: float) -> bool:
    track = _Track.of(plan.lane, left)
    ahead = 1.0 if generator.uniform() < 0.5 else -1.0
    speed, wave = generator.uniform(0.95, 1.6), _wave(generator, 0.25, (0.3, 0.5))
    walked = speed * (plan.knots - plan.knots[0]) + wave(plan.knots)
    along = generator.uniform(0.0, track.length) + ahead * (walked - generator.uniform() * walked[-1])
    if track.narrowest(float(along.min()), float(along.max())) < 0.25:
        return False
    gait = 2 * np.pi * walked / (0.8 * design.size_lwh[2])
    return plan.try_add(design, *_on_track(track, along, ahead=ahead, gait=gait))


def _try_stand(generator: np.random.Generator, plan: _Plan, design: MovingDesign, left: float) -> bool:
    side = np.sign(left - 1.75)
    spot = _Track.of(plan.lane, left + generator.uniform(-1.2, 0.5) * side)
    point, heading = spot.at(np.array([generator.uniform(_END, spot.length - _END)]))
    rotated = heading[0] + generator.uniform(-np.pi, np.pi)
    sample = np.array([*point[0], rotated, 0.0])
    samples = np.tile(sample, (len(plan.knots), 1))
    return plan.try_add(design, samples)


def _try_cross(generator: np.random.Generator, plan: _Plan, design: MovingDesign, left: float) -> bool:
    """Stand on the pavement, cross the street squarely near where the ego is by then, stand again."""
    track = _Track.of(plan.lane, left)
    begin = generator.uniform(plan.knots[0] - 6.0, plan.knots[-1])
    parameter, _, _ = plan.path.warp.at(np.array([begin]))
    along = track.beside(parameter)[0] + generator.uniform(-15.0, 60.0)
    if not _END < along < track.length - _END:
        return False
    (near,), (heading,) = track.at(np.array([along]))
    across = (_PAVEMENTS[0] + _PAVEMENTS[1] - left) - left
    speed, strides = generator.uniform(1.1, 1.6), 0.8 * design.size_lwh[2]
    share = _crossing_share(plan.knots, begin, abs(across) / speed)
    side = np.array([-np.sin(heading), np.cos(heading)])
    points = near + across * share[:, None] * side
    gait = 2 * np.pi * round(abs(across) / strides) * share
    yaw = heading + np.sign(across) * np.pi / 2
    return plan.try_add(design, np.column_stack([points, np.full(len(points), yaw), gait]))


def _crossing_share(seconds: Float64Array, begin: float, lasts: float) -> Float64Array:
    """How much of a trajectory is walked, 0 to 1: at a constant speed but for a second at either end."""
    ramp = 1.0
    past = np.clip(seconds - begin, 0.0, lasts + ramp)
    slow = np.clip(past, 0.0, ramp), np.clip(past - lasts, 0.0, ramp)
    walked = 0.5 * slow[0] ** 2 / ramp + np.maximum(0.0, past - ramp) - 0.5 * slow[1] ** 2 / ramp
    share: Float64Array = walked / lasts
    return share
