"""Rules about the frame of points: sweeps match, the ground is below, cuboids hold points, images are upright."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.checks.annotation_table import cuboids_at
from sceneloom.checks.rule import HINT, WARNING, FrameInHand, Hit, Rule, Subject
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
from sceneloom.scene.scene import scene_period_ns
from sceneloom.scene.types import Identifier, PointsFrame, key_of

_Ranging = LidarSensor | RadarSensor

_LOOKED_AT = 4
"""So many frames of a sensor are compared, spread over the drive, each with one more."""

_KEPT_POINTS = 40_000

_NEARER, _NEARER_M = 3.0, 30.0
"""Another frame is the right one if the points then lie this much nearer to the sensor, by factor and by metres."""

_LEAST_MOVE_M, _LARGEST_MOVE_M = 1.5, 30.0
"""Two frames are compared if the sensor moved this far between them: less shows nothing, more sees other things."""

_ASKED_POINTS, _LEAST_ASKED = 3_000, 100

_MEETS_M = 0.3
"""Points of two frames that are no farther apart are of one thing."""

_OFF_GROUND_M, _CELL_M = 0.5, 4.0
"""A point this far above the lowest point of its cell is off the ground."""

_CELLS_APART = 1 << 24

_MORE_OVERLAP, _MORE_TIMES = 0.15, 1.5
"""Another frame is the right one if this many more of the points meet, as a share and as a factor."""


@dataclass(frozen=True, slots=True)
class _Locations:
    """Where a sensor and its points are in the world.

    Attributes:
        sensor: `world_from_sensor`; None where it is not known.
        points: `world_from_points` for each frame that the points could be in.
    """

    sensor: PoseSource | None
    points: Mapping[PointsFrame, PoseSource]


def _locations(subject: Subject, sensor: _Ranging) -> _Locations:
    name = f"location of {type(sensor.id).__name__} {sensor.id}"
    return subject.table(name, lambda inner: _located(inner, sensor))


def _located(subject: Subject, sensor: _Ranging) -> _Locations:
    scene = subject.scene
    rotating = (one for one in scene.trajectories.values() if one.quaternions_xyzw is not None)
    ego = next(map(EgoMotion.of, rotating), None)
    reach_ns, own = scene_period_ns(scene), None
    points = {PointsFrame.WORLD: PoseSource(Poses.identity(), RigidTransform.identity())}
    with suppress(SceneloomError):
        own = points[PointsFrame.SENSOR] = sensor_source(scene, sensor, ego, reach_ns=reach_ns)
    if isinstance(sensor, LidarSensor):
        with suppress(SceneloomError):
            on_ego = points_source(scene, replace(sensor, points_frame=PointsFrame.EGO), ego, reach_ns=reach_ns)
            if on_ego is not None:
                points[PointsFrame.EGO] = on_ego
    return _Locations(own, points)


def _transform_at(source: PoseSource | None, timestamp_ns: int) -> RigidTransform | None:
    """A source's transform at one time; None without one, out of its reach, and where its poses are not finite."""
    if source is None:
        return None
    poses = source.at(np.array([timestamp_ns], np.int64))
    if poses.coverage[0] == 2 or not np.isfinite(poses.positions).all():
        return None
    return RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])


def points_in_world(subject: Subject, lidar: LidarSensor, sweep: LidarFrame, most: int) -> Float64Array | None:
    """At most about `most` finite points of a sweep in the world, (N, 3) [m]; None where its pose is not known."""
    source = _locations(subject, lidar).points.get(lidar.points_frame)
    world_from_points = _transform_at(source, sweep.timestamp_ns)
    return None if world_from_points is None else world_from_points.apply(_some_points(sweep, most))


def _some_points(frame: LidarFrame | RadarFrame, most: int) -> Float64Array:
    positions = frame.points.positions
    some = positions[:: len(positions) // most + 1].astype(np.float64)
    return np.asarray(some[np.isfinite(some).all(axis=1)])


def frames_spread(count: int, wanted: int) -> frozenset[int]:
    """Numbers of frames, evenly spread over all of a sensor's."""
    return frozenset(np.linspace(0, count - 1, wanted).astype(int).tolist())


@dataclass(slots=True, eq=False)
class _Sweep:
    """Some points of a frame as stored, (K, 3) float64 [m], and its time [ns]."""

    timestamp_ns: int
    points: Float64Array


@dataclass(slots=True, eq=False)
class Sweeps:
    """The frames of one sensor that are compared: which ones, in which pairs, and those read so far."""

    path: str
    sensor: LidarSensor | RadarSensor
    wanted: frozenset[int]
    pairs: tuple[tuple[int, int], ...]
    seen: dict[int, _Sweep] = field(default_factory=dict)


def plan_sweeps(subject: Subject, path: str, sensor: LidarSensor | RadarSensor) -> Sweeps:
    """Choose frames spread over the drive, and for each another one from which the sensor has moved far enough."""
    source, count = _locations(subject, sensor).sensor, len(sensor.frames)
    if source is None:
        return Sweeps(path, sensor, frozenset(), ())
    spread = sorted(frames_spread(count, _LOOKED_AT))
    where = source.at(sensor.frames.timestamps_ns).positions
    pairs: dict[tuple[int, int], None] = {}
    for number in spread:
        moved = np.linalg.norm(where - where[number], axis=1)
        others = np.flatnonzero((moved > _LEAST_MOVE_M) & (moved < _LARGEST_MOVE_M))
        if len(others):
            other = int(others[np.argmin(np.abs(others - number))])
            pairs[min(number, other), max(number, other)] = None
    return Sweeps(path, sensor, frozenset(spread) | {n for pair in pairs for n in pair}, tuple(pairs))


def sweep_of(frame: LidarFrame | RadarFrame) -> _Sweep:
    """Some points of a frame, without those at the origin."""
    some = _some_points(frame, _KEPT_POINTS)
    return _Sweep(frame.timestamp_ns, some[some.any(axis=1)])


def distances(subject: Subject, sweeps: Sweeps) -> Mapping[PointsFrame, float]:
    """The distance from the sensor within which half of a sweep's points lie [m], for each frame they could be in."""
    locations, middles = _locations(subject, sweeps.sensor), dict[PointsFrame, float]()
    for frame, source in locations.points.items():
        away = []
        for sweep in sweeps.seen.values():
            world_from_points = _transform_at(source, sweep.timestamp_ns)
            world_from_sensor = _transform_at(locations.sensor, sweep.timestamp_ns)
            if world_from_points is not None and world_from_sensor is not None and len(sweep.points):
                to_sensor = world_from_points.apply(sweep.points) - world_from_sensor.translation
                away.append(float(np.median(np.linalg.norm(to_sensor, axis=1))))
        if away:
            middles[frame] = max(away)
    return middles


def lie_nearer(one: float, other: float) -> bool:
    """Whether points lie so much nearer to their sensor in one frame that the other one cannot be right [m]."""
    return other >= _NEARER * one and other >= one + _NEARER_M


def overlaps(subject: Subject, sweeps: Sweeps) -> Mapping[PointsFrame, float]:
    """The mean share of a sweep's points that meet points of another one, for each frame they could be in."""
    shares: dict[PointsFrame, list[float]] = {}
    for pair in sweeps.pairs if isinstance(sweeps.sensor, LidarSensor) else ():
        one, other = (sweeps.seen.get(number) for number in pair)
        if one is not None and other is not None:
            for frame, share in _overlaps(_locations(subject, sweeps.sensor), one, other).items():
                shares.setdefault(frame, []).append(share)
    return {frame: float(np.mean(found)) for frame, found in shares.items()}


def _overlaps(locations: _Locations, one: _Sweep, other: _Sweep) -> Mapping[PointsFrame, float]:
    """The share of points off the ground that meet points of another sweep, for each frame whose poses are known."""
    from scipy.spatial import cKDTree

    shares: dict[PointsFrame, float] = {}
    if len(other.points) < _LEAST_ASKED:
        return shares
    others = cKDTree(other.points)
    for frame, source in locations.points.items():
        world_from_one = _transform_at(source, one.timestamp_ns)
        world_from_other = _transform_at(source, other.timestamp_ns)
        if world_from_one is None or world_from_other is None:
            continue
        asked = world_from_one.apply(one.points)
        asked = asked[_off_ground(asked)]
        asked = asked[:: len(asked) // _ASKED_POINTS + 1]
        if len(asked) >= _LEAST_ASKED:
            away, _ = others.query(world_from_other.inverse().apply(asked), distance_upper_bound=_MEETS_M)
            shares[frame] = float(np.isfinite(away).mean())
    return shares


def _off_ground(points: Float64Array) -> BoolArray:
    """(N,) bool: well above the lowest point of the same cell; z is up in the world."""
    cells: Int64Array = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    # one number per cell sorts many times faster than pairs
    _, inverse = np.unique(cells[:, 0] * _CELLS_APART + cells[:, 1], return_inverse=True)
    lowest = np.full(int(inverse.max(initial=-1)) + 1, np.inf)
    np.minimum.at(lowest, inverse, points[:, 2])
    return np.asarray(points[:, 2] > lowest[inverse] + _OFF_GROUND_M)


def meet_more(one: float, other: float) -> bool:
    """Whether so many more points meet in one frame that the other one cannot be right, as shares."""
    return one >= max(other + _MORE_OVERLAP, other * _MORE_TIMES)


def _all_sweeps(subject: Subject) -> dict[tuple[type, Identifier], Sweeps]:
    return subject.table("sweeps for the frame of points", lambda _: {})


def _keep(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Keep some points of the frames that are compared."""
    sensor, known = frame.sensor, _all_sweeps(subject)
    if isinstance(sensor, LidarSensor | RadarSensor):
        key = key_of(sensor.id)
        if key not in known:
            known[key] = plan_sweeps(subject, frame.sensor_path, sensor)
        if frame.number in known[key].wanted and isinstance(frame.frame, LidarFrame | RadarFrame):
            known[key].seen[frame.number] = sweep_of(frame.frame)
    return iter(())


def _wrong_frame(subject: Subject) -> Iterator[Hit]:
    """By how far points are from their sensor, else by how many meet points of another frame."""
    for sweeps in _all_sweeps(subject).values():
        stated = sweeps.sensor.points_frame
        middles, means = distances(subject, sweeps), overlaps(subject, sweeps)
        nearest, best = (
            min(middles, key=middles.__getitem__, default=None),
            max(means, key=means.__getitem__, default=None),
        )
        if nearest is not None and stated in middles and lie_nearer(middles[nearest], middles[stated]):
            problem = (
                f"taken as {stated.value} coordinates half of the points lie more than {middles[stated]:.0f} m from "
                f"the sensor, taken as {nearest.value} coordinates {middles[nearest]:.0f} m; stated is {stated.value}"
            )
        elif best is not None and stated in means and meet_more(means[best], means[stated]):
            problem = (
                f"taken as {stated.value} coordinates {means[stated]:.0%} of the points off the ground meet points of "
                f"another frame, taken as {best.value} coordinates {means[best]:.0%} "
                f"({len(sweeps.pairs)} pairs of frames); stated is {stated.value}"
            )
        else:
            continue
        yield Hit(f"{sweeps.path}.frames[].points", problem, count=len(sweeps.sensor.frames))


# fmt: off
POINT_FRAME_RULES: tuple[Rule, ...] = (
    Rule("points-in-another-frame", WARNING,
         "Points lie around their sensor, and match from frame to frame, in the frame that they are stated to be in.",
         "Open the file with `--points-frame world`, `ego` or `sensor`, and write it again.", look=_keep,
         conclude=_wrong_frame),
)
# fmt: on

_MOST_IMAGES = 2_000
"""So many, evenly spread, show how a camera is usually rotated."""

_SURROUNDINGS_LOOKED_AT, _SURROUNDINGS_POINTS = 8, 60_000

_LEAST_POINTS = 500
"""Fewer in a frame show nothing."""

_SHEET_M, _TALLEST_M = 0.25, 8.0

_NEAR_M, _FAR_M = 3.0, 25.0
"""Level points and cuboids are judged between these distances from the sensor."""

_LEVEL_M = 0.3

_SHEET_SHARE, _SHEET_TIMES = 0.2, 4.0
"""The ground is above a sensor if a sheet there has this share of the points, and so many times those of any below."""

_MARGIN_M, _FLOOR_M = 0.1, 0.3
"""A point is in a box up to so far outside its sides, and so far above its floor: the ground is in every box."""

_LARGEST_BOX_M = 30.0

_LEAST_BOXES, _LEAST_HOLDING = 20, 0.5
"""Of so many boxes in sight of a lidar this share has to hold a point; occluded ones do not."""

_ROLLED_DEG = 60.0


@dataclass(slots=True)
class _Surroundings:
    """What the frames of one lidar showed."""

    lidar: LidarSensor
    wanted: frozenset[int]
    frames: int = 0
    above: list[float] = field(default_factory=list)
    boxes: int = 0
    holding: int = 0


def _surroundings(subject: Subject) -> dict[str, _Surroundings]:
    return subject.table("surroundings of lidars", lambda _: {})


def _look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Judge some frames of a lidar; what they show together is reported at the end."""
    lidar, sweep, known = frame.sensor, frame.frame, _surroundings(subject)
    if not isinstance(lidar, LidarSensor):
        return iter(())
    if frame.sensor_path not in known:
        wanted = frames_spread(len(lidar.frames), _SURROUNDINGS_LOOKED_AT)
        known[frame.sensor_path] = _Surroundings(lidar, wanted)
    around = known[frame.sensor_path]
    if frame.number in around.wanted and isinstance(sweep, LidarFrame):
        around.wanted -= {frame.number}
        points = points_in_world(subject, lidar, sweep, _SURROUNDINGS_POINTS)
        world_from_sensor = _transform_at(_locations(subject, lidar).sensor, sweep.timestamp_ns)
        if points is not None and world_from_sensor is not None and len(points) >= _LEAST_POINTS:
            sensor = world_from_sensor.translation
            around.frames += 1
            height = _sheet_above(points - sensor)
            around.above += [height] if height is not None else []
            boxes, holding = _boxes_with_points(subject, sweep, points, sensor)
            around.boxes, around.holding = around.boxes + boxes, around.holding + holding
    return iter(())


def _sheet_above(away: Float64Array) -> float | None:
    """Height above the sensor of a level sheet of points that has no like below [m]; None without one."""
    distances = np.hypot(away[:, 0], away[:, 1])
    heights = away[(distances > _NEAR_M) & (distances < _FAR_M), 2]
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
    """How many cuboids with a keyframe at a sweep are in sight of the lidar, and how many of them hold a point."""
    rows = cuboids_at(subject, sweep)
    distances = np.hypot(*(rows[:, 3:5] - sensor[:2]).T)
    sized = ((rows[:, :3] > 0) & (rows[:, :3] < _LARGEST_BOX_M)).all(axis=1) & (rows[:, 2] > 2 * _FLOOR_M)
    rows = rows[sized & (distances > _NEAR_M) & (distances < _FAR_M)]
    rows = rows[_in_sight(rows[:, 3:5] - sensor[:2], points[:, :2] - sensor[:2])]
    if len(rows) == 0:
        return 0, 0
    found, angles = np.zeros(len(rows), np.int64), CuboidAngles.of(subject.scene)
    rotations = rotation_from_cuboid_angles(rows[:, 6:], unit=angles.unit, order=angles.order)
    centers, halves = rows[:, 3:6].copy(), rows[:, :3] / 2 + _MARGIN_M
    centers[:, 2] += (_FLOOR_M + _MARGIN_M) / 2
    halves[:, 2] -= (_FLOOR_M + _MARGIN_M) / 2
    boxes = (centers[None], np.ascontiguousarray(rotations[None]), np.ascontiguousarray(halves[None]))
    find_points_in_boxes(np.ascontiguousarray(points), np.zeros(0), *boxes, found, np.zeros(0, np.int64))
    return len(rows), int(np.count_nonzero(found))


def _in_sight(centers: Float64Array, points: Float64Array) -> BoolArray:
    """(B,) bool: whether the lidar has points in the direction of a centre, at its distance or beyond."""
    farthest = np.zeros(360)
    np.maximum.at(farthest, _degrees(points), np.hypot(*points.T))
    return np.asarray(farthest[_degrees(centers)] >= np.hypot(*centers.T))


def _degrees(positions: Float64Array) -> Int64Array:
    return np.degrees(np.arctan2(positions[:, 1], positions[:, 0])).astype(np.int64) % 360


def _ground_above(subject: Subject) -> Iterator[Hit]:
    for path, around in _surroundings(subject).items():
        if len(around.above) * 2 > around.frames:
            problem = (
                f"most level points lie {float(np.median(around.above)):.1f} m above the sensor in "
                f"{len(around.above)} of {around.frames} frames looked at; expected the ground below it"
            )
            yield Hit(f"{path}.frames[].points", problem, count=len(around.lidar.frames))


def _boxes_empty(subject: Subject) -> Iterator[Hit]:
    for path, around in _surroundings(subject).items():
        if around.boxes >= _LEAST_BOXES and around.holding < _LEAST_HOLDING * around.boxes:
            problem = (
                f"{around.holding} of {around.boxes} cuboids within {_FAR_M:.0f} m of {path} hold a point of its "
                "frames; expected most"
            )
            yield Hit("annotations", problem)


def _not_upright(subject: Subject) -> Iterator[Hit]:
    scene = subject.scene
    try:
        locations = locations_of(scene, scene.cameras, choose_ego(scene, None))
    except SceneloomError:
        return
    for camera in scene.cameras:
        source, timestamps_ns = locations[camera.id].source, camera.images.timestamps_ns
        if source is None or len(timestamps_ns) == 0:
            continue
        rotations = source.at(timestamps_ns[:: len(timestamps_ns) // _MOST_IMAGES + 1]).quaternions_xyzw
        rotations = rotations[np.isfinite(rotations).all(axis=1)]
        downs = rotate_vectors(rotations, np.array([0.0, 1.0, 0.0]))[:, 2]
        off = float(np.degrees(np.arccos(np.clip(-np.median(downs), -1.0, 1.0)))) if len(downs) else 0.0
        if off > _ROLLED_DEG:
            problem = f"the lower side of its images is {off:.0f}° off what is down in the world"
            yield Hit(subject.sensor_path(camera), problem)


# fmt: off
SURROUNDINGS_RULES: tuple[Rule, ...] = (
    Rule("ground-above-sensor", WARNING, "The ground that a lidar sees lies below it: z is up in the world.",
         "See whether quaternions are x, y, z, w, transforms lead from the sensor to the world, and z of the "
         "points is up.", look=_look, conclude=_ground_above),
    Rule("cuboids-off-points", WARNING, "Cuboids near a lidar that it looks at hold points of it.",
         "See whether the cuboids are in the world, in metres, on the scene's clock and of this drive, and "
         "whether the poses are right.", look=_look, conclude=_boxes_empty),
    Rule("camera-not-upright", HINT, "The lower side of images is what is down in the world, within 60°.",
         "See whether the axes are x right, y down, z forward, and whether the transform leads from the camera.",
         find=_not_upright),
)
# fmt: on
