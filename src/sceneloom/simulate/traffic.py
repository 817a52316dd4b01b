"""What moves in the street besides the ego: how much of it, and what each of them does."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.simulate.bounds import check_bounds
from sceneloom.simulate.clearance import Clearance, Plans, plans_of
from sceneloom.simulate.ground import Lane
from sceneloom.simulate.movers import Mover, Movers, MovingDesign, pack_movers
from sceneloom.simulate.path import EgoPath
from sceneloom.simulate.people import design_cyclist, design_moving_car, design_pedestrian
from sceneloom.simulate.splines import DEGREE, control_points_through, spline_derivatives
from sceneloom.simulate.street import Street
from sceneloom.simulate.tracks import Track

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

OWN_LANE, ONCOMING_LANE = 0.0, 3.5
EDGES = ((-1.5, 1.0), (5.05, -1.0))
"""Where cyclists ride: metres left of the trajectory, and whether with the ego or against it."""
PAVEMENTS = (-5.6, 9.1)
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
    clearance: Clearance
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
        if not self.clearance.try_add(Plans(states[:, :2], states[:, 2], half, there)):
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
        path, Lane.of(path), knots, looks, Clearance(plans_of(street.shapes), [_ego_plans(path, looks)])
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


def _ego_plans(path: EgoPath, looks: Float64Array) -> Plans:
    states = path.at_seconds(looks)
    yaws = np.arctan2(states.rotations[:, 1, 0], states.rotations[:, 0, 0])
    half = np.tile(np.array(_EGO_LW) / 2, (len(looks), 1))
    return Plans(states.positions[:, :2], yaws, half, np.ones(len(looks), np.bool_))


def _thing(instance: int, plan: _Plan, k: int, *, span_ns: tuple[int, int]) -> Mover:
    design, there = plan.designs[k], np.flatnonzero(plan.there[k])
    timestamps = plan.path.start_ns + np.rint(plan.looks[there[[0, -1]]] * 1e9).astype(np.int64)
    first = span_ns[0] if there[0] == 0 else int(timestamps[0])
    last = span_ns[1] if there[-1] == len(plan.looks) - 1 else int(timestamps[1])
    stands = not np.ptp(plan.curves[k], axis=0).any()
    return Mover(instance, design.label, design.size_lwh, first, last, stands)


def _on_track(
    track: Track, along: Float64Array, *, ahead: float, gait: Float64Array | float = 0.0
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
        track = Track.of(plan.lane, OWN_LANE + generator.uniform(-0.08, 0.08))
        ego = track.beside(parameters)
        room = track.length - float(ego.max()) if side > 0 else float(ego.min())
        for gap in _gaps(generator, generator.uniform(14.0, 24.0), spacing, room - 8.0):
            wave = _wave(generator, 2.0, (0.3, 0.5))
            along = ego + side * gap + wave(parameters)
            plan.try_add(design_moving_car(generator), *_on_track(track, along, ahead=1.0))
    track = Track.of(plan.lane, ONCOMING_LANE)
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
    for left, ahead in EDGES:
        track = Track.of(plan.lane, left)
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
    for left in PAVEMENTS:
        length = Track.of(plan.lane, left).length
        for _ in range(generator.poisson(spec.pedestrians / 100.0 * length)):
            kind = generator.uniform()
            add = _try_stand if kind < spec.stationary else _try_walk
            if spec.stationary <= kind < spec.stationary + spec.crossing:
                add = _try_cross
            design = design_pedestrian(generator, walks=add is not _try_stand)
            any(add(generator, plan, design, left) for _ in range(_TRIES))


def _try_walk(generator: np.random.Generator, plan: _Plan, design: MovingDesign, left: float) -> bool:
    track = Track.of(plan.lane, left)
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
    spot = Track.of(plan.lane, left + generator.uniform(-1.2, 0.5) * side)
    point, heading = spot.at(np.array([generator.uniform(_END, spot.length - _END)]))
    rotated = heading[0] + generator.uniform(-np.pi, np.pi)
    sample = np.array([*point[0], rotated, 0.0])
    samples = np.tile(sample, (len(plan.knots), 1))
    return plan.try_add(design, samples)


def _try_cross(generator: np.random.Generator, plan: _Plan, design: MovingDesign, left: float) -> bool:
    """Stand on the pavement, cross the street squarely near where the ego is by then, stand again."""
    track = Track.of(plan.lane, left)
    begin = generator.uniform(plan.knots[0] - 6.0, plan.knots[-1])
    parameter, _, _ = plan.path.warp.at(np.array([begin]))
    along = track.beside(parameter)[0] + generator.uniform(-15.0, 60.0)
    if not _END < along < track.length - _END:
        return False
    (near,), (heading,) = track.at(np.array([along]))
    across = (PAVEMENTS[0] + PAVEMENTS[1] - left) - left
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
