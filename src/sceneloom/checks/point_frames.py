"""A rule about the frame of points: they stay with the sensor, or match from frame to frame, in the one that is stated.

Two tests. By distance: points lie around their sensor, so a frame in which they are far from it is not theirs; this
needs a sensor that is far from the origin at some time. By overlap: what is stationary is at the same location in the
world in two frames, so the frame in which more points of one sweep meet points of another one is theirs; this needs
a sensor that moves by metres between the two. What is flat looks alike from everywhere: points near the ground, as
the lowest in their surroundings report it, are left out.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.checks.point_positions import point_positions, positions_at, sensor_position, transform_at
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.types import Identifier, PointsFrame, key_of

_LOOKED_AT = 4
"""So many frames of a sensor are looked at, spread over the drive, and one more for each to compare it with."""

_KEPT_POINTS = 40_000

_NEARER = 3.0
_NEARER_M = 30.0
"""Another frame is the right one if the points then lie this much nearer to the sensor, by factor and by metres."""

_LEAST_MOVE_M = 1.5
_LARGEST_MOVE_M = 30.0
"""Two frames are compared if the sensor moved by so much between them: less shows nothing, more sees other things."""

_ASKED_POINTS = 3_000
_MEETS_M = 0.3
_OFF_GROUND_M = 0.5
_CELL_M = 4.0
_CELLS_APART = 1 << 24
_LEAST_ASKED = 100
_MORE_OVERLAP, _MORE_TIMES = 0.15, 1.5
"""Another frame is the right one if so many more of the points meet, as a share and as a factor."""


@dataclass(slots=True, eq=False)
class Sweep:
    """Some points of a frame as stored, (K, 3) float64 [m], and its time [ns]."""

    timestamp_ns: int
    points: Float64Array


@dataclass(slots=True, eq=False)
class Sweeps:
    """The frames of one sensor that are looked at: which ones, in which pairs, and those seen so far."""

    path: str
    sensor: LidarSensor | RadarSensor
    wanted: frozenset[int]
    pairs: tuple[tuple[int, int], ...]
    seen: dict[int, Sweep] = field(default_factory=dict)


def _all_sweeps(subject: Subject) -> dict[tuple[type, Identifier], Sweeps]:
    return subject.table("sweeps for the frame of points", lambda _: {})


def _keep(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Keep some points of the frames that are looked at."""
    yield from ()
    sensor = frame.sensor
    if not isinstance(sensor, LidarSensor | RadarSensor):
        return
    known, key = _all_sweeps(subject), key_of(sensor.id)
    if key not in known:
        known[key] = plan_sweeps(subject, frame.sensor_path, sensor)
    if frame.number in known[key].wanted and isinstance(frame.frame, LidarFrame | RadarFrame):
        known[key].seen[frame.number] = sweep_of(frame.frame)


def sweep_of(frame: LidarFrame | RadarFrame) -> Sweep:
    """Keep some points of a frame."""
    positions = frame.points.positions
    some = positions[:: len(positions) // _KEPT_POINTS + 1].astype(np.float64)
    return Sweep(frame.timestamp_ns, some[np.isfinite(some).all(axis=1) & some.any(axis=1)])


def plan_sweeps(subject: Subject, path: str, sensor: LidarSensor | RadarSensor) -> Sweeps:
    """Choose frames spread over the drive, and to each one from which the sensor has moved far enough."""
    location, count = sensor_position(subject, sensor), len(sensor.frames)
    if location is None:
        return Sweeps(path, sensor, frozenset(), ())
    spread = np.unique(np.linspace(0, count - 1, _LOOKED_AT).astype(int)).tolist()
    where = positions_at(location, sensor)
    pairs: dict[tuple[int, int], None] = {}
    for number in spread:
        moved = np.linalg.norm(where - where[number], axis=1)
        others = np.flatnonzero((moved > _LEAST_MOVE_M) & (moved < _LARGEST_MOVE_M))
        if len(others):
            other = int(others[np.argmin(np.abs(others - number))])
            pairs[min(number, other), max(number, other)] = None
    return Sweeps(path, sensor, frozenset(spread) | {n for pair in pairs for n in pair}, tuple(pairs))


def _wrong_frame(subject: Subject) -> Iterator[Hit]:
    for sweeps in _all_sweeps(subject).values():
        reported = _by_distance(subject, sweeps) or _by_overlap(subject, sweeps)
        if reported is not None:
            yield Hit(f"{sweeps.path}.frames[].points", reported, count=len(sweeps.sensor.frames))


def _by_distance(subject: Subject, sweeps: Sweeps) -> str | None:
    """Compare how far the middle point of each frame is from the sensor, under each reading."""
    stated, middles = sweeps.sensor.points_frame, distances(subject, sweeps)
    if stated not in middles:
        return None
    nearest = min(middles, key=lambda reading: middles[reading])
    if not lie_nearer(middles[nearest], middles[stated]):
        return None
    return (
        f"taken as {_in(stated)} half of the points lie more than {middles[stated]:.0f} m from the sensor, "
        f"taken as {_in(nearest)} {middles[nearest]:.0f} m; stated is {stated.value}"
    )


def distances(subject: Subject, sweeps: Sweeps) -> Mapping[PointsFrame, float]:
    """Give the distance from the sensor within which half of the points of a sweep lie [m], under each reading."""
    location = sensor_position(subject, sweeps.sensor)
    middles = dict[PointsFrame, float]()
    for reading, source in point_positions(subject, sweeps.sensor).items():
        away = []
        for sweep in sweeps.seen.values():
            world_from_points = transform_at(source, sweep.timestamp_ns)
            world_from_sensor = None if location is None else transform_at(location, sweep.timestamp_ns)
            if world_from_points is None or world_from_sensor is None or len(sweep.points) == 0:
                continue
            to_sensor = world_from_points.apply(sweep.points) - world_from_sensor.translation
            away.append(float(np.median(np.linalg.norm(to_sensor, axis=1))))
        if away:
            middles[reading] = max(away)
    return middles


def lie_nearer(one: float, other: float) -> bool:
    """Whether points lie so much nearer to their sensor under one reading that the other one cannot be right [m]."""
    return other >= _NEARER * one and other >= one + _NEARER_M


def _in(frame: PointsFrame) -> str:
    return f"{frame.value} coordinates"


def _by_overlap(subject: Subject, sweeps: Sweeps) -> str | None:
    """Compare how many points of one frame meet points of another, under each reading."""
    stated, means = sweeps.sensor.points_frame, overlaps(subject, sweeps)
    if stated not in means:
        return None
    best = max(means, key=lambda reading: means[reading])
    if not meet_more(means[best], means[stated]):
        return None
    return (
        f"taken as {_in(stated)} {means[stated]:.0%} of the points off the ground meet points of another frame, "
        f"taken as {_in(best)} {means[best]:.0%} ({len(sweeps.pairs)} pairs of frames); stated is {stated.value}"
    )


def overlaps(subject: Subject, sweeps: Sweeps) -> Mapping[PointsFrame, float]:
    """Give the mean share of the points of a sweep that meet points of another one, under each reading."""
    if isinstance(sweeps.sensor, RadarSensor):
        return {}
    shares: dict[PointsFrame, list[float]] = {}
    for pair in sweeps.pairs:
        one, other = (sweeps.seen.get(number) for number in pair)
        if one is not None and other is not None:
            for reading, share in _overlaps(subject, sweeps.sensor, one, other).items():
                shares.setdefault(reading, []).append(share)
    return {reading: float(np.mean(found)) for reading, found in shares.items()}


def meet_more(one: float, other: float) -> bool:
    """Whether so many more points meet under one reading that the other one cannot be right, as shares."""
    return one >= max(other + _MORE_OVERLAP, other * _MORE_TIMES)


def _overlaps(subject: Subject, lidar: LidarSensor, one: Sweep, other: Sweep) -> Mapping[PointsFrame, float]:
    """The share of points of one frame that meet points of another, under each reading that locations both."""
    from scipy.spatial import cKDTree

    shares: dict[PointsFrame, float] = {}
    if len(other.points) < _LEAST_ASKED:
        return shares
    others = cKDTree(other.points)
    for reading, source in point_positions(subject, lidar).items():
        world_from_one = transform_at(source, one.timestamp_ns)
        world_from_other = transform_at(source, other.timestamp_ns)
        if world_from_one is None or world_from_other is None:
            continue
        asked = world_from_one.apply(one.points)
        asked = asked[_off_ground(asked)]
        asked = asked[:: len(asked) // _ASKED_POINTS + 1]
        if len(asked) >= _LEAST_ASKED:
            away, _ = others.query(world_from_other.inverse().apply(asked), distance_upper_bound=_MEETS_M)
            shares[reading] = float(np.isfinite(away).mean())
    return shares


def _off_ground(points: Float64Array) -> BoolArray:
    """(N,) bool: well above the lowest point of the same patch of ground; z is up in the world."""
    cells: Int64Array = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    # one number per cell sorts many times faster than pairs
    _, inverse = np.unique(cells[:, 0] * _CELLS_APART + cells[:, 1], return_inverse=True)
    lowest = np.full(int(inverse.max(initial=-1)) + 1, np.inf)
    np.minimum.at(lowest, inverse, points[:, 2])
    return np.asarray(points[:, 2] > lowest[inverse] + _OFF_GROUND_M)


RULES: tuple[Rule, ...] = (
    Rule(
        "points-in-another-frame",
        Severity.WARNING,
        "Points lie around their sensor, and match from frame to frame, in the frame that they are stated to be in.",
        "Open the file with `--points-frame world`, `ego` or `sensor`, and write it again.",
        look=_keep,
        conclude=_wrong_frame,
    ),
)
