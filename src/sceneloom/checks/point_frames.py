"""Rules about the frame of points: points match from frame to frame, the ground is below.

Objects are where points are, images are upright.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.checks.annotation_table import cuboid_paths, cuboid_rows
from sceneloom.checks.rule import FrameInHand, Hit, Rule, Subject
from sceneloom.errors import SceneloomError
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.kernels.boxes import find_points_in_boxes
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import EgoMotion, points_source, sensor_source
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.sampling import choose_ego, locations_of
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier, PointsFrame, key_of
from sceneloom.warnings import Severity

_Ranging = LidarSensor | RadarSensor

_WORLD = PoseSource(Poses.identity(), RigidTransform.identity())


def _ego(scene: Scene) -> EgoMotion | None:
    trajectory = next(
        (trajectory for trajectory in scene.trajectories.values() if trajectory.quaternions_xyzw is not None),
        None,
    )
    return None if trajectory is None else EgoMotion.of(trajectory)


def _sensor_position(subject: Subject, sensor: _Ranging) -> PoseSource | None:
    """Give `world_from_sensor`; None where it is not known."""

    def made(inner: Subject) -> PoseSource | None:
        scene = inner.scene
        try:
            return sensor_source(scene, sensor, _ego(scene), reach_ns=scene_period_ns(scene))
        except SceneloomError:
            return None

    return subject.table(f"location of {type(sensor.id).__name__} {sensor.id}", made)


def point_positions(subject: Subject, sensor: _Ranging) -> Mapping[PointsFrame, PoseSource]:
    """Give what takes the points as stored into the world, for each frame that they could be in."""

    def made(inner: Subject) -> Mapping[PointsFrame, PoseSource]:
        scene, locations = inner.scene, {PointsFrame.WORLD: _WORLD}
        own = _sensor_position(inner, sensor)
        if own is not None:
            locations[PointsFrame.SENSOR] = own
        if isinstance(sensor, LidarSensor):
            rider_association = replace(sensor, points_frame=PointsFrame.EGO)
            with suppress(SceneloomError):
                on_ego = points_source(scene, rider_association, _ego(scene), reach_ns=scene_period_ns(scene))
                if on_ego is not None:
                    locations[PointsFrame.EGO] = on_ego
        return locations

    return subject.table(f"locations of points of {type(sensor.id).__name__} {sensor.id}", made)


def transform_at(source: PoseSource, timestamp_ns: int) -> RigidTransform | None:
    """Give a source's transform at one time; None beyond its reach, and where its poses are no finite numbers."""
    poses = source.at(np.array([timestamp_ns], np.int64))
    if poses.coverage[0] == 2 or not np.isfinite(poses.positions).all():
        return None
    return RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])


def _positions_at(source: PoseSource, sensor: _Ranging) -> Float64Array:
    """Positions at the times of a sensor's frames, (F, 3) float64 [m]; NaN beyond the source's reach."""
    return source.at(sensor.frames.timestamps_ns).positions


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
    location, count = _sensor_position(subject, sensor), len(sensor.frames)
    if location is None:
        return Sweeps(path, sensor, frozenset(), ())
    spread = np.unique(np.linspace(0, count - 1, _LOOKED_AT).astype(int)).tolist()
    where = _positions_at(location, sensor)
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
    location = _sensor_position(subject, sweeps.sensor)
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

_MOST_IMAGES = 2_000
"""So many, evenly spread, report how a camera is usually rotated."""

_SURROUNDINGS_LOOKED_AT = 8

_SURROUNDINGS_KEPT_POINTS = 60_000

_LEAST_POINTS = 500
"""Fewer in a frame show nothing."""

_SHEET_M = 0.25

_TALLEST_M = 8.0

_GROUND_NEAR_M, _GROUND_FAR_M = 3.0, 25.0

_LEVEL_M = 0.3

_SHEET_SHARE, _SHEET_TIMES = 0.2, 4.0
"""The ground is above a sensor if a sheet there has this share of the points, and so many times those of any below."""

_BOX_NEAR_M, _BOX_FAR_M = 3.0, 25.0

_MARGIN_M, _SURROUNDINGS_OFF_GROUND_M = 0.1, 0.3
"""A point is in a box up to so far outside its sides, and so far above its floor: the ground is in every box."""

_SAME_TIME_NS = 30_000_000

_LARGEST_BOX_M = 30.0

_LEAST_BOXES, _LEAST_HOLDING = 20, 0.5
"""Of so many boxes that a lidar looks at, this share has to hold a point; hidden ones do not."""

_ROLLED_DEG = 60.0


@dataclass(slots=True)
class _Statistics:
    """What the frames of one lidar showed."""

    lidar: LidarSensor
    wanted: frozenset[int]
    frames: int = 0
    above: list[float] = field(default_factory=list)
    boxes: int = 0
    holding: int = 0


def _tallies(subject: Subject) -> dict[str, _Statistics]:
    return subject.table("surroundings of lidars", lambda _: {})


def _look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Look around a lidar in some of its frames; what they show is stated at the end."""
    yield from ()
    lidar, sweep = frame.sensor, frame.frame
    if not isinstance(lidar, LidarSensor):
        return
    statistics = _tallies(subject).get(frame.sensor_path)
    if statistics is None:
        spread = np.linspace(0, len(lidar.frames) - 1, _SURROUNDINGS_LOOKED_AT).astype(int)
        statistics = _tallies(subject)[frame.sensor_path] = _Statistics(lidar, frozenset(spread.tolist()))
    if frame.number not in statistics.wanted or not isinstance(sweep, LidarFrame):
        return
    statistics.wanted -= {frame.number}
    placed = _around(subject, lidar, sweep)
    if placed is not None:
        points, sensor = placed
        statistics.frames += 1
        height = _sheet_above(points - sensor)
        statistics.above += [height] if height is not None else []
        boxes, holding = _boxes_with_points(subject, sweep, points, sensor)
        statistics.boxes, statistics.holding = statistics.boxes + boxes, statistics.holding + holding


def _around(
    subject: Subject, lidar: LidarSensor, sweep: LidarFrame
) -> tuple[Float64Array, Float64Array] | None:
    """Some points of a sweep (N, 3) and the position of its sensor (3,), in the world [m]; None where not known."""
    source, location = (
        point_positions(subject, lidar).get(lidar.points_frame),
        _sensor_position(subject, lidar),
    )
    positions = sweep.points.positions
    some = positions[:: len(positions) // _SURROUNDINGS_KEPT_POINTS + 1].astype(np.float64)
    some = some[np.isfinite(some).all(axis=1)]
    if source is None or location is None or len(some) < _LEAST_POINTS:
        return None
    world_from_points = transform_at(source, sweep.timestamp_ns)
    world_from_sensor = transform_at(location, sweep.timestamp_ns)
    if world_from_points is None or world_from_sensor is None:
        return None
    return world_from_points.apply(some), world_from_sensor.translation


def _sheet_above(away: Float64Array) -> float | None:
    """How high above the sensor a level sheet of points is that has no like below [m]; None without one."""
    distances = np.hypot(away[:, 0], away[:, 1])
    heights = away[(distances > _GROUND_NEAR_M) & (distances < _GROUND_FAR_M), 2]
    if len(heights) < _LEAST_POINTS:
        return None
    edges = np.arange(-_TALLEST_M, _TALLEST_M + _SHEET_M, _SHEET_M)
    counts, _ = np.histogram(heights, edges)
    above, below = np.where(edges[:-1] >= _LEVEL_M, counts, 0), np.where(edges[1:] <= -_LEVEL_M, counts, 0)
    is_above = above.max() >= _SHEET_SHARE * len(heights) and above.max() > _SHEET_TIMES * below.max()
    return float(edges[above.argmax()]) + _SHEET_M / 2 if is_above else None


def _boxes_with_points(
    subject: Subject, sweep: LidarFrame, points: Float64Array, sensor: Float64Array
) -> tuple[int, int]:
    """How many cuboids with a keyframe at a sweep the lidar looks at, and how many of them hold a point."""
    rows, times = cuboid_rows(subject), cuboid_paths(subject).timestamps_ns
    now = np.minimum(np.abs(times - sweep.timestamp_ns), np.abs(times - sweep.reference_ns)) < _SAME_TIME_NS
    now &= np.isfinite(rows).all(axis=1)
    rows = rows[now]
    distances = np.hypot(*(rows[:, 3:5] - sensor[:2]).T)
    sized = ((rows[:, :3] > 0) & (rows[:, :3] < _LARGEST_BOX_M)).all(axis=1) & (
        rows[:, 2] > 2 * _SURROUNDINGS_OFF_GROUND_M
    )
    rows = rows[sized & (distances > _BOX_NEAR_M) & (distances < _BOX_FAR_M)]
    rows = rows[_looked_at(rows[:, 3:5] - sensor[:2], points[:, :2] - sensor[:2])]
    if len(rows) == 0:
        return 0, 0
    found = np.zeros(len(rows), np.int64)
    angles = CuboidAngles.of(subject.scene)
    rotations = rotation_from_cuboid_angles(rows[:, 6:], unit=angles.unit, order=angles.order)
    centers, halves = rows[:, 3:6].copy(), rows[:, :3] / 2 + _MARGIN_M
    centers[:, 2] += (_SURROUNDINGS_OFF_GROUND_M + _MARGIN_M) / 2
    halves[:, 2] -= (_SURROUNDINGS_OFF_GROUND_M + _MARGIN_M) / 2
    find_points_in_boxes(
        np.ascontiguousarray(points),
        np.zeros(0),
        centers[None],
        np.ascontiguousarray(rotations[None]),
        np.ascontiguousarray(halves[None]),
        found,
        np.zeros(0, np.int64),
    )
    return len(rows), int(np.count_nonzero(found))


def _looked_at(centers: Float64Array, points: Float64Array) -> BoolArray:
    """(B,) bool: whether the lidar has points in the direction of a centre, at its distance or beyond."""
    farthest = np.zeros(360)
    np.maximum.at(farthest, _degrees(points), np.hypot(*points.T))
    return np.asarray(farthest[_degrees(centers)] >= np.hypot(*centers.T))


def _degrees(locations: Float64Array) -> Int64Array:
    return np.degrees(np.arctan2(locations[:, 1], locations[:, 0])).astype(np.int64) % 360


def _ground_above(subject: Subject) -> Iterator[Hit]:
    for path, statistics in _tallies(subject).items():
        if len(statistics.above) * 2 > statistics.frames:
            height = float(np.median(statistics.above))
            reported = (
                f"most level points lie {height:.1f} m above the sensor in {len(statistics.above)} of "
                f"{statistics.frames} "
                "frames looked at; expected the ground below it"
            )
            yield Hit(f"{path}.frames[].points", reported, count=len(statistics.lidar.frames))


def _boxes_empty(subject: Subject) -> Iterator[Hit]:
    for path, statistics in _tallies(subject).items():
        if statistics.boxes >= _LEAST_BOXES and statistics.holding < _LEAST_HOLDING * statistics.boxes:
            reported = (
                f"{statistics.holding} of {statistics.boxes} cuboids within {_BOX_FAR_M:.0f} m of {path} hold a point "
                f"of its "
                f"frames; expected most"
            )
            yield Hit("annotations", reported)


def _not_upright(subject: Subject) -> Iterator[Hit]:
    scene = subject.scene
    try:
        locations = locations_of(scene, scene.cameras, choose_ego(scene, None))
    except SceneloomError:
        return
    for camera in scene.cameras:
        source = locations[camera.id].source
        if source is None or len(camera.images) == 0:
            continue
        timestamps_ns = camera.images.timestamps_ns
        rotations = source.at(timestamps_ns[:: len(timestamps_ns) // _MOST_IMAGES + 1]).quaternions_xyzw
        rotations = rotations[np.isfinite(rotations).all(axis=1)]
        downs = rotate_vectors(rotations, np.array([0.0, 1.0, 0.0]))[:, 2]
        if len(downs):
            off = float(np.degrees(np.arccos(np.clip(-np.median(downs), -1.0, 1.0))))
            if off > _ROLLED_DEG:
                reported = f"the lower side of its images is {off:.0f}° off what is down in the world"
                yield Hit(subject.sensor_path(camera), reported)


SURROUNDINGS_RULES: tuple[Rule, ...] = (
    Rule(
        "ground-above-sensor",
        Severity.WARNING,
        "The ground that a lidar sees lies below it: z is up in the world.",
        "See whether quaternions are x, y, z, w, transforms lead from the sensor to the world, and z of the points is "
        "up.",
        look=_look,
        conclude=_ground_above,
    ),
    Rule(
        "cuboids-off-points",
        Severity.WARNING,
        "Cuboids near a lidar that it looks at hold points of it.",
        "See whether the cuboids are in the world, in metres, on the scene's clock and of this drive, and whether the "
        "poses are right.",
        look=_look,
        conclude=_boxes_empty,
    ),
    Rule(
        "camera-not-upright",
        Severity.HINT,
        "The lower side of images is what is down in the world, within 60°.",
        "See whether the axes are x right, y down, z forward, and whether the transform leads from the camera.",
        find=_not_upright,
    ),
)
