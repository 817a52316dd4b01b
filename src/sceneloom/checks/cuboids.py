"""Rules about cuboids (angles, sizes, motion, points in them), the frame of points, and images that are upright."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, read_only
from sceneloom.checks.rule import (
    ERROR,
    HINT,
    WARNING,
    Find,
    FrameInHand,
    Hit,
    Rule,
    Subject,
    annotation_parts,
    frames_spread,
    with_each,
)
from sceneloom.errors import SceneloomError
from sceneloom.geometry.euler import ORDERS, AngleUnit, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform, rotate_vectors
from sceneloom.scene.annotations import Annotation, CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import EgoMotion, points_source, sensor_source
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.samples import choose_ego, locations_of
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind


def _cuboid_rows(subject: Subject) -> Float64Array:
    """The rows of all cuboids' paths, (R, 9) float64 as in `CuboidPath`."""
    return subject.table(
        "rows of cuboids", lambda inner: annotation_parts(inner, "cuboids").rows(lambda path: path.values, 9)
    )


_SAME_TIME_NS = 30_000_000


def _cuboids_at(subject: Subject, sweep: LidarFrame) -> Float64Array:
    """The finite rows of cuboids that have a keyframe at the time of a sweep, (K, 9)."""
    rows, times = _cuboid_rows(subject), annotation_parts(subject, "cuboids").timestamps_ns
    now = np.minimum(np.abs(times - sweep.timestamp_ns), np.abs(times - sweep.reference_ns)) < _SAME_TIME_NS
    return np.asarray(rows[now & np.isfinite(rows).all(axis=1)])


_COMPARED_FRAMES, _COMPARED_POINTS = 4, 40_000
"""So many frames of a sensor are compared, spread over the drive, each with one more; so many points of each."""

_NEARER, _NEARER_M = 3.0, 30.0
"""Another frame is the right one if the points then lie this much nearer to the sensor, by factor and by metres."""

_LEAST_MOVE_M, _LARGEST_MOVE_M = 1.5, 30.0
"""Two sweeps are compared if the sensor moved this far between them: less shows nothing, more sees other objects."""

_ASKED_POINTS, _LEAST_ASKED, _MEETS_M = 3_000, 100, 0.3
"""Points of two sweeps that are compared, at most and at least; those no farther apart are of one object."""

_ABOVE_CELL_M, _CELL_M, _CELLS_APART = 0.5, 4.0, 1 << 24
"""A point this far above the lowest point of its cell is off the ground."""

_MORE_OVERLAP, _MORE_TIMES = 0.15, 1.5
"""Another frame is the right one if this many more of the points meet, as a share and as a factor."""

_MOST_IMAGES, _ROLLED_DEG = 2_000, 60.0
"""So many images, evenly spread, show how a camera is usually rotated; beyond this it is not upright."""

_SURROUNDINGS_LOOKED_AT, _SURROUNDINGS_POINTS, _LEAST_SURROUNDINGS = 8, 60_000, 500
"""Frames of a lidar whose surroundings are judged; points of each, at most and at least."""

_SHEET_M, _TALLEST_M, _LEVEL_M = 0.25, 8.0, 0.3
_NEAREST_M, _FARTHEST_M = 3.0, 25.0  # level points and cuboids are judged between these distances from the sensor

_SHEET_SHARE, _SHEET_TIMES = 0.2, 4.0
"""The ground is above a sensor if a sheet there has this share of the points, and so many times those of any below."""

_MARGIN_M, _FLOOR_M, _LARGEST_BOX_M = 0.1, 0.3, 30.0
"""A point is in a box up to so far outside its sides, and so far above its floor: the ground is in every box."""

_LEAST_BOXES, _LEAST_HOLDING = 20, 0.5
"""Of so many boxes in sight of a lidar this share has to contain a point; occluded ones do not."""

_Ranging = LidarSensor | RadarSensor
_Sweep = tuple[int, Float64Array]  # time of a frame [ns], and some of its points as stored, (K, 3) float64 [m]


@dataclass(frozen=True, slots=True)
class _Locations:
    """`world_from_sensor`, None where unknown, and `world_from_points` for each frame that the points can be in."""

    sensor: PoseSource | None
    points: Mapping[PointsFrame, PoseSource]

    @classmethod
    def of(cls, subject: Subject, sensor: _Ranging) -> "_Locations":
        name = f"location of {type(sensor.id).__name__} {sensor.id}"
        return subject.table(name, lambda _: cls._found(subject, sensor))

    @classmethod
    def _found(cls, subject: Subject, sensor: _Ranging) -> "_Locations":
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
        return cls(own, points)


def _transform_at(source: PoseSource | None, timestamp_ns: int) -> RigidTransform | None:
    """The transform at one time; None without a source, beyond its reach, and where its poses are not finite."""
    return None if source is None else source.pose_at(timestamp_ns)


def _points_in_world(subject: Subject, lidar: LidarSensor, sweep: LidarFrame, most: int) -> Float64Array | None:
    """At most about `most` finite points of a sweep in the world, (N, 3) [m]; None where its pose is not known."""
    source = _Locations.of(subject, lidar).points.get(lidar.points_frame)
    world_from_points = _transform_at(source, sweep.timestamp_ns)
    return None if world_from_points is None else world_from_points.apply(_some_points(sweep, most))


def _some_points(frame: LidarFrame | RadarFrame, most: int) -> Float64Array:
    positions = frame.points.positions
    some = positions[:: len(positions) // most + 1].astype(np.float64)
    return np.asarray(some[np.isfinite(some).all(axis=1)])


@dataclass(slots=True, eq=False)
class _Sweeps:
    """The frames of one sensor that are compared: which ones, in which pairs, and those read so far."""

    path: str
    sensor: _Ranging
    locations: _Locations
    wanted: frozenset[int] = frozenset()
    pairs: tuple[tuple[int, int], ...] = ()
    seen: dict[int, _Sweep] = field(default_factory=dict)

    @classmethod
    def planned(cls, subject: Subject, path: str, sensor: _Ranging) -> "_Sweeps":
        """Choose frames spread over the drive, and for each another one from which the sensor has moved far enough."""
        locations = _Locations.of(subject, sensor)
        if locations.sensor is None:
            return cls(path, sensor, locations)
        spread = sorted(frames_spread(len(sensor.frames), _COMPARED_FRAMES))
        where = locations.sensor.at(sensor.frames.timestamps_ns).positions
        pairs: dict[tuple[int, int], None] = {}
        for number in spread:
            moved = np.linalg.norm(where - where[number], axis=1)
            others = np.flatnonzero((moved > _LEAST_MOVE_M) & (moved < _LARGEST_MOVE_M))
            if len(others):
                other = int(others[np.argmin(np.abs(others - number))])
                pairs[min(number, other), max(number, other)] = None
        wanted = frozenset(spread) | {number for pair in pairs for number in pair}
        return cls(path, sensor, locations, wanted, tuple(pairs))

    def keep(self, number: int, frame: LidarFrame | RadarFrame) -> None:
        """Keep some points of a frame, without those at the origin, if it is among those that are compared."""
        if number in self.wanted:
            some = _some_points(frame, _COMPARED_POINTS)
            self.seen[number] = frame.timestamp_ns, some[some.any(axis=1)]

    def distances(self) -> Mapping[PointsFrame, float]:
        """The distance from the sensor within which half of a sweep's points lie [m], by the frame they could be in."""
        middles: dict[PointsFrame, float] = {}
        for frame, source in self.locations.points.items():
            away = []
            for timestamp_ns, points in self.seen.values():
                world_from_points = _transform_at(source, timestamp_ns)
                world_from_sensor = _transform_at(self.locations.sensor, timestamp_ns)
                if world_from_points is not None and world_from_sensor is not None and len(points):
                    to_sensor = world_from_points.apply(points) - world_from_sensor.translation
                    away.append(float(np.median(np.linalg.norm(to_sensor, axis=1))))
            if away:
                middles[frame] = max(away)
        return middles

    def overlaps(self) -> Mapping[PointsFrame, float]:
        """The mean share of a sweep's points that meet points of another one, by the frame they could be in."""
        shares: dict[PointsFrame, list[float]] = {}
        for one, other in self.pairs if isinstance(self.sensor, LidarSensor) else ():
            if one in self.seen and other in self.seen:
                for frame, share in self._meeting(self.seen[one], self.seen[other]).items():
                    shares.setdefault(frame, []).append(share)
        return {frame: float(np.mean(found)) for frame, found in shares.items()}

    def _meeting(self, one: _Sweep, other: _Sweep) -> Mapping[PointsFrame, float]:
        """The share of points off the ground that meet points of another sweep, by frame whose poses are known."""
        shares: dict[PointsFrame, float] = {}
        if len(other[1]) < _LEAST_ASKED:
            return shares
        _, alone = np.unique(_cells(other[1], _MEETS_M / 3), return_index=True)
        others = other[1][alone]  # one for all in a small cube: dense clouds meet as often, and take no longer
        for frame, source in self.locations.points.items():
            world_from_one, world_from_other = _transform_at(source, one[0]), _transform_at(source, other[0])
            if world_from_one is None or world_from_other is None:
                continue
            asked = world_from_one.apply(one[1])
            asked = asked[_off_ground(asked)]
            asked = asked[:: len(asked) // _ASKED_POINTS + 1]
            if len(asked) >= _LEAST_ASKED:
                shares[frame] = _share_near(world_from_other.inverse().apply(asked), others)
        return shares


def _cells(points: Float64Array, size: float, step: tuple[int, int, int] = (0, 0, 0)) -> Int64Array:
    """Number the cubes of a size [m] that are some steps away from points (N, 3), (N,) int64."""
    x, y, z = (np.floor(points / size).astype(np.int64) + step).T
    return np.asarray((x << 42) + (y << 21) + z)


def _share_near(asked: Float64Array, others: Float64Array) -> float:
    """The share of points (A, 3) within `_MEETS_M` of one of others (N, 3), which are in the cubes about them."""
    met = np.zeros(len(asked), np.bool_)
    cells = _cells(others, _MEETS_M)
    order = np.argsort(cells)
    others, cells = others[order], cells[order]
    asked = asked[np.argsort(_cells(asked, _MEETS_M))]  # neighbours are looked up together
    for x, y in product((-1, 0, 1), repeat=2):
        first = np.searchsorted(cells, _cells(asked, _MEETS_M, (x, y, -1)))
        last = np.searchsorted(cells, _cells(asked, _MEETS_M, (x, y, 1)), "right")
        counts = last - first
        rows = np.repeat(np.arange(len(asked)), counts)
        found = others[np.arange(len(rows)) - np.repeat(np.cumsum(counts) - last, counts)]
        met[rows[np.sum((asked[rows] - found) ** 2, axis=1) < _MEETS_M**2]] = True
    return float(met.mean())


def _off_ground(points: Float64Array) -> BoolArray:
    """(N,) bool: well above the lowest point of the same cell; z is up in the world."""
    cells: Int64Array = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    # one number per cell sorts many times faster than pairs
    _, inverse = np.unique(cells[:, 0] * _CELLS_APART + cells[:, 1], return_inverse=True)
    lowest = np.full(int(inverse.max(initial=-1)) + 1, np.inf)
    np.minimum.at(lowest, inverse, points[:, 2])
    return np.asarray(points[:, 2] > lowest[inverse] + _ABOVE_CELL_M)


def _is_nearer(one: float, other: float) -> bool:
    """Whether points lie so much nearer to their sensor in one frame that the other one cannot be right [m]."""
    return other >= _NEARER * one and other >= one + _NEARER_M


def _meets_more(one: float, other: float) -> bool:
    """Whether so many more points meet in one frame that the other one cannot be right, as shares."""
    return one >= max(other + _MORE_OVERLAP, other * _MORE_TIMES)


def possible_points_frames(subject: Subject, lidar: LidarSensor) -> tuple[PointsFrame, ...]:
    """The frames that the points of a lidar can be in: around their sensor, and meeting from sweep to sweep.

    Raises:
        DataError: a sweep cannot be read.
    """
    sweeps = _Sweeps.planned(subject, "", lidar)
    for number in sorted(sweeps.wanted):
        sweeps.keep(number, lidar.frames[number])
    away, meeting = sweeps.distances(), sweeps.overlaps()
    nearest, most = min(away.values(), default=0.0), max(meeting.values(), default=0.0)
    return tuple(
        frame
        for frame in PointsFrame
        if frame in away and not _is_nearer(nearest, away[frame]) and not _meets_more(most, meeting.get(frame, most))
    )


def _all_sweeps(subject: Subject) -> dict[str, _Sweeps]:
    return subject.table("sweeps for the frame of points", lambda _: {})


def _keep(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Keep some points of the frames that are compared."""
    sensor, path, known = frame.sensor, frame.sensor_path, _all_sweeps(subject)
    if isinstance(sensor, LidarSensor | RadarSensor):
        if path not in known:
            known[path] = _Sweeps.planned(subject, path, sensor)
        if isinstance(frame.frame, LidarFrame | RadarFrame):
            known[path].keep(frame.number, frame.frame)
    return iter(())


def _wrong_frame(subject: Subject) -> Iterator[Hit]:
    """By how far points are from their sensor, else by how many meet points of another frame."""
    for sweeps in _all_sweeps(subject).values():
        stated = sweeps.sensor.points_frame
        middles, means = sweeps.distances(), sweeps.overlaps()
        nearest = min(middles, key=middles.__getitem__, default=stated)
        best = max(means, key=means.__getitem__, default=stated)
        if stated in middles and _is_nearer(middles[nearest], middles[stated]):
            problem = (
                f"taken as {stated.value} coordinates half of the points lie more than {middles[stated]:.0f} m from "
                f"the sensor, taken as {nearest.value} coordinates {middles[nearest]:.0f} m; stated is {stated.value}"
            )
        elif stated in means and _meets_more(means[best], means[stated]):
            problem = (
                f"taken as {stated.value} coordinates {means[stated]:.0%} of the points off the ground meet points of "
                f"another frame, taken as {best.value} coordinates {means[best]:.0%} "
                f"({len(sweeps.pairs)} pairs of frames); stated is {stated.value}"
            )
        else:
            continue
        yield Hit(f"{sweeps.path}.frames[].points", problem, count=len(sweeps.sensor.frames))


@dataclass(slots=True)
class _Surroundings:
    """What the frames of one lidar showed: how many were judged, heights of sheets above, boxes, those with points."""

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
        points = _points_in_world(subject, lidar, sweep, _SURROUNDINGS_POINTS)
        world_from_sensor = _transform_at(_Locations.of(subject, lidar).sensor, sweep.timestamp_ns)
        if points is not None and world_from_sensor is not None and len(points) >= _LEAST_SURROUNDINGS:
            sensor = world_from_sensor.translation
            around.frames += 1
            height = _sheet_above(points - sensor)
            around.above += [height] if height is not None else []
            boxes, holding = _boxes_with_points(subject, sweep, points, sensor)
            around.boxes, around.holding = around.boxes + boxes, around.holding + holding
    return iter(())


def _sheet_above(away: Float64Array) -> float | None:
    """Height above the sensor of a level sheet of points without any like it below [m]; None without one."""
    distances = np.hypot(away[:, 0], away[:, 1])
    heights = away[(distances > _NEAREST_M) & (distances < _FARTHEST_M), 2]
    if len(heights) < _LEAST_SURROUNDINGS:
        return None
    edges = np.arange(-_TALLEST_M, _TALLEST_M + _SHEET_M, _SHEET_M)
    counts, _ = np.histogram(heights, edges)
    above, below = np.where(edges[:-1] >= _LEVEL_M, counts, 0), np.where(edges[1:] <= -_LEVEL_M, counts, 0)
    is_above = above.max() >= _SHEET_SHARE * len(heights) and above.max() > _SHEET_TIMES * below.max()
    return float(edges[above.argmax()]) + _SHEET_M / 2 if is_above else None


def _boxes_with_points(
    subject: Subject, sweep: LidarFrame, points: Float64Array, sensor: Float64Array
) -> tuple[int, int]:
    """How many cuboids with a keyframe at a sweep are in sight of the lidar, and how many of them contain a point."""
    rows = _cuboids_at(subject, sweep)
    distances = np.hypot(*(rows[:, 3:5] - sensor[:2]).T)
    sized = ((rows[:, :3] > 0) & (rows[:, :3] < _LARGEST_BOX_M)).all(axis=1) & (rows[:, 2] > 2 * _FLOOR_M)
    rows = rows[sized & (distances > _NEAREST_M) & (distances < _FARTHEST_M)]
    if len(rows) == 0:
        return 0, 0
    rows = rows[_in_sight(rows[:, 3:5] - sensor[:2], points[:, :2] - sensor[:2])]
    angles = CuboidAngles.of(subject.scene)
    rotations = rotation_from_cuboid_angles(rows[:, 6:], unit=angles.unit, order=angles.order)
    centers, halves = rows[:, 3:6].copy(), rows[:, :3] / 2 + _MARGIN_M
    centers[:, 2] += (_FLOOR_M + _MARGIN_M) / 2
    halves[:, 2] -= (_FLOOR_M + _MARGIN_M) / 2
    nearby = _points_about(points, centers, np.linalg.norm(halves, axis=1))
    inside = [
        (np.abs((found - center) @ rotation) <= half).all(axis=1).any()
        for found, center, rotation, half in zip(nearby, centers, rotations, halves, strict=True)
    ]
    return len(rows), sum(map(bool, inside))


def _points_about(points: Float64Array, centers: Float64Array, reaches: Float64Array) -> Iterator[Float64Array]:
    """Give for each centre (B, 3) the points (N, 3) that lie within its reach (B,) along x, and some beside them."""
    points = points[np.argsort(points[:, 0])]
    first = np.searchsorted(points[:, 0], centers[:, 0] - reaches)
    last = np.searchsorted(points[:, 0], centers[:, 0] + reaches, "right")
    return (points[start:stop] for start, stop in zip(first, last, strict=True))


def _in_sight(centers: Float64Array, points: Float64Array) -> BoolArray:
    """(B,) bool: whether the lidar has points in the direction of a centre, at its distance or beyond."""

    def degrees(positions: Float64Array) -> Int64Array:
        return np.degrees(np.arctan2(positions[:, 1], positions[:, 0])).astype(np.int64) % 360

    farthest = np.zeros(360)
    np.maximum.at(farthest, degrees(points), np.hypot(*points.T))
    return np.asarray(farthest[degrees(centers)] >= np.hypot(*centers.T))


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
                f"{around.holding} of {around.boxes} cuboids within {_FARTHEST_M:.0f} m of {path} hold a point of its "
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
POINT_FRAME_RULES: tuple[Rule, ...] = (
    Rule("points-in-another-frame", WARNING,
         "Points lie around their sensor, and match from frame to frame, in the frame that they are stated to be in.",
         "Open the file with `--points-frame world`, `ego` or `sensor`, and write it again.", look=_keep,
         conclude=_wrong_frame),
    Rule("ground-above-sensor", WARNING, "The ground that a lidar sees lies below it: z is up in the world.",
         "Check that quaternions are x, y, z, w, that transforms lead from the sensor to the world, and that z of the "
         "points is up.", look=_look, conclude=_ground_above),
    Rule("cuboids-off-points", WARNING, "Cuboids near a lidar that it looks at contain points of it.",
         "Check that the cuboids are in the world, in metres, on the scene's clock and of this drive, and that the "
         "poses are right.", look=_look, conclude=_boxes_empty),
    Rule("camera-not-upright", HINT, "The lower side of images is what is down in the world, within 60°.",
         "Check that the axes are x right, y down, z forward, and that the transform leads from the camera.",
         find=_not_upright),
)
# fmt: on


_LEAST_STEP_M, _LEAST_SPEED = 0.5, 2.0  # steps that are shorter or slower show no direction [m], [m/s]

_STRIDES, _ENOUGH_STEPS = (1, 4, 16), 50
"""Where so few keyframes show motion to the next one, those farther apart are compared."""

_LONGEST_S = 2.0  # over a longer time an object may rotate, so that its heading is not that of its whole step
_MOST_STEPS, _LEAST_STEPS = 5_000, 5
_OFF_DEG, _ALONG_DEG = 20.0, 10.0
"""A reading whose headings are so far off the motion is wrong if under another one they are along it, in the median."""

_LOOKED_AT, _KEPT_POINTS, _MOST_BOXES, _NEAR_M = 4, 60_000, 150, 60.0
_LEAST_POINTS, _MORE_POINTS, _OFF_GROUND_M = 50, 1.15, 0.2
_SAME_DEG, _SAME_SHARE = 1.0, 0.98
"""Of readings that are so nearly alike, the one that differs least from what is stated is named."""

_SMALLEST_M, _LARGEST_M = 0.01, 100.0  # beyond it even trams and ferries end; a building that long deserves a look

_SIZE_FACTOR, _SIZE_CHANGE_M = 2.0, 0.5
"""Labels grow while more of an object is seen; doubling by more than this is another object."""

_SLACK_M, _ACCELERATION = 2.0, 20.0
"""Twice what tyres hold on a road [m/s²]; with the slack it bounds how far a keyframe lies off the trajectory."""

_FASTEST = 100.0  # no vehicle on a road is faster [m/s]
_STATIONARY_M = 1.0
_ROTATION_DEG, _ROTATION_WITHIN_NS = 100.0, 600_000_000  # nothing on wheels rotates that far within this time


def _readings(stated: CuboidAngles) -> list[CuboidAngles]:
    """The stated reading of the angles, then all others, the likeliest mistakes first."""
    readings = [CuboidAngles(unit.value, order) for unit in AngleUnit for order in ORDERS]
    return sorted(readings, key=lambda one: (one != stated) + (one.order != stated.order))


def _rotations(reading: CuboidAngles, rows: Float64Array) -> Float64Array:
    """(N, 3, 3) `world_from_cuboid` of rows (N, 9); their first columns are the headings."""
    return rotation_from_cuboid_angles(rows[:, 6:9], unit=reading.unit, order=reading.order)


def _worded(reading: CuboidAngles) -> str:
    return f"{reading.unit} in the order {reading.order}"


@dataclass(slots=True, eq=False)
class _Evidence:
    """What the data show about the reading of angles."""

    stated: CuboidAngles  # the reading that the scene states, or is taken to state
    off_deg: dict[CuboidAngles, float]  # median angle of heading (or back) to motion; empty where too little moves
    steps: int  # of how many steps that is
    points: dict[CuboidAngles, int] = field(default_factory=dict)  # in boxes, by reading
    boxes: int = 0  # in which points were counted
    counted: set[str] = field(default_factory=set)  # frames


def _evidence(subject: Subject) -> _Evidence:
    return subject.table("evidence for the reading of angles", _motion_evidence)


def _motion_evidence(subject: Subject) -> _Evidence:
    stated, off_deg = CuboidAngles.of(subject.scene), {}
    rows, directions = _moving(subject)
    for reading in _readings(stated) if len(rows) >= _LEAST_STEPS else ():
        cosines = np.abs(np.sum(_rotations(reading, rows)[:, :, 0] * directions, axis=1)).clip(0, 1)
        off_deg[reading] = float(np.degrees(np.median(np.arccos(cosines))))
    return _Evidence(stated, off_deg, len(rows))


def _moving(subject: Subject) -> tuple[Float64Array, Float64Array]:
    """Some keyframes at which a cuboid moves, (K, 9), and the directions of motion there, (K, 3) unit vectors."""
    # labels of many keyframes a second move too little from one to the next: then those farther apart are compared
    found = _moving_over(subject, _STRIDES[0])
    for stride in _STRIDES[1:]:
        if len(found[0]) >= _ENOUGH_STEPS:
            break
        found = max(found, _moving_over(subject, stride), key=lambda steps: len(steps[0]))
    return found


def _moving_over(subject: Subject, stride: int) -> tuple[Float64Array, Float64Array]:
    """The same, from half the stride before a keyframe to half of it after."""
    table, rows = annotation_parts(subject, "cuboids"), _cuboid_rows(subject)
    if len(rows) <= stride:
        return np.zeros((0, 9)), np.zeros((0, 3))
    owners, finite = table.owners, np.asarray(np.isfinite(rows).all(axis=1))
    seconds = (table.timestamps_ns[stride:] - table.timestamps_ns[:-stride]) / 1e9
    steps = rows[stride:, 3:6] - rows[:-stride, 3:6]
    lengths = np.linalg.norm(steps, axis=1)
    moves = (lengths > _LEAST_STEP_M) & (lengths > _LEAST_SPEED * seconds)
    moves &= (owners[stride:] == owners[:-stride]) & finite[stride:] & finite[:-stride]
    chosen = np.flatnonzero(moves & (seconds > 0) & (seconds <= _LONGEST_S))
    chosen = chosen[:: len(chosen) // _MOST_STEPS + 1]
    return rows[chosen + stride // 2], steps[chosen] / lengths[chosen, None]


def _count_in_boxes(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Count the points in the boxes of a frame under each reading; what they show is reported at the end."""
    lidar, sweep, evidence = frame.sensor, frame.frame, _evidence(subject)
    if (
        isinstance(lidar, LidarSensor)
        and isinstance(sweep, LidarFrame)
        and len(_cuboid_rows(subject))
        and frame.path not in evidence.counted
        and frame.number in frames_spread(len(lidar.frames), _LOOKED_AT)
    ):
        points_world = _points_in_world(subject, lidar, sweep, _KEPT_POINTS)
        if points_world is not None and len(points_world):
            evidence.counted.add(frame.path)
            _count_points(evidence, points_world, _cuboids_at(subject, sweep))
    return iter(())


def _count_points(evidence: _Evidence, points_world: Float64Array, rows: Float64Array) -> None:
    """Count the points in some boxes near the middle of a sweep, except for those just above their floors."""
    near = np.linalg.norm(rows[:, 3:6] - np.median(points_world, axis=0), axis=1) < _NEAR_M
    rows = rows[near & (rows[:, :3] > 0).all(axis=1)]
    rows = rows[:: len(rows) // _MOST_BOXES + 1]
    evidence.boxes += len(rows)
    reaches = np.linalg.norm(rows[:, :3], axis=1) / 2
    lists = [
        (found - center)[np.linalg.norm(found - center, axis=1) <= reach]
        for center, reach, found in zip(
            rows[:, 3:6], reaches, _points_about(points_world, rows[:, 3:6], reaches), strict=True
        )
    ]
    boxes: Int64Array = np.repeat(np.arange(len(rows)), np.array([len(found) for found in lists], np.int64))
    away, halves = np.concatenate([np.zeros((0, 3)), *lists]), rows[boxes, :3] / 2
    for reading in _readings(evidence.stated):
        points_box = np.einsum("nji,nj->ni", _rotations(reading, rows)[boxes], away)
        inside = (np.abs(points_box) <= halves).all(axis=1) & (points_box[:, 2] > _OFF_GROUND_M - halves[:, 2])
        evidence.points[reading] = evidence.points.get(reading, 0) + int(np.count_nonzero(inside))


def _against_motion(subject: Subject) -> Iterator[Hit]:
    found = _evidence(subject)
    stated, angles = found.stated, found.off_deg
    if not angles or angles[stated] < _OFF_DEG:
        return
    least = min(angles.values())
    best = next(reading for reading, angle in angles.items() if angle <= least + _SAME_DEG)
    if angles[best] < _ALONG_DEG:
        yield Hit(
            "annotations",
            f"read as {_worded(stated)} headings are {angles[stated]:.0f}° off the motion, read as {_worded(best)} "
            f"{angles[best]:.0f}° (median of {found.steps} steps)",
        )


def _against_points(subject: Subject) -> Iterator[Hit]:
    found = _evidence(subject)
    stated, angles, points = found.stated, found.off_deg, found.points
    if not points:
        return
    most = max(points.values())
    best = next(reading for reading, count in points.items() if count >= _SAME_SHARE * most)
    if points[best] < _LEAST_POINTS or points[best] < _MORE_POINTS * points[stated]:
        return
    if angles and angles[best] > max(angles[stated], _ALONG_DEG):
        return
    problem = (
        f"read as {_worded(stated)} {found.boxes} boxes hold {points[stated]} points, read as {_worded(best)} "
        f"{points[best]}"
    )
    if angles:
        problem += (
            f"; headings are {angles[stated]:.0f}° and {angles[best]:.0f}° off the motion, in the median of "
            f"{found.steps} steps"
        )
    yield Hit("annotations", problem)


def _unsaid(subject: Subject) -> Iterator[Hit]:
    """Where nothing states how the angles are meant, report what the data show about the reading that was taken."""
    assumed = {warning.code for warning in subject.notes if warning.kind is WarningKind.ASSUMED}
    if not assumed & {"euler-unit", "euler-order"}:
        return
    found = _evidence(subject)
    stated = found.stated
    other = CuboidAngles(next(unit.value for unit in AngleUnit if unit.value != stated.unit), stated.order)
    evidence = []
    if found.off_deg:
        evidence.append(
            f"headings are {found.off_deg[stated]:.0f}° off the motion in the median of {found.steps} steps, in "
            f"{other.unit} {found.off_deg[other]:.0f}°"
        )
    if found.points:
        held, in_other = found.points[stated], found.points[other]
        evidence.append(f"{found.boxes} boxes hold {held} points, in {other.unit} {in_other}")
    shown = "; ".join(evidence) or "neither motion nor points in the boxes show it"
    yield Hit("annotations", f"not stated; taken to be {_worded(stated)}: {shown}")


def _hits(subject: Subject, bad: Any, state: Callable[[int], str]) -> Iterator[Hit]:
    return annotation_parts(subject, "cuboids").hits(subject, bad, state, within=".values")


def _numbers(values: Float64Array) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values.tolist()) + "]"


def _from_second(subject: Subject, bad_steps: Any) -> BoolArray:
    """Mark the later row of each step that is bad and inside one path."""
    table = annotation_parts(subject, "cuboids")
    return np.concatenate([np.zeros(min(len(table.timestamps_ns), 1), np.bool_), bad_steps & table.inner])


def _not_finite(subject: Subject) -> Iterator[Hit]:
    rows = _cuboid_rows(subject)
    bad = (~np.isfinite(rows)).any(axis=1)
    yield from _hits(subject, bad, lambda row: f"{_numbers(rows[row])}; expected finite numbers")
    for path, annotation in subject.annotations():
        for k, activation in enumerate(getattr(annotation, "activations", ())):
            if activation.cuboids is None:
                continue
            seen = activation.cuboids
            # a cuboid that is not reported is null as a whole
            partly = ~np.isfinite(seen).all(axis=1) & ~np.isnan(seen).all(axis=1)
            for row in np.flatnonzero(partly).tolist():
                yield Hit(f"{path}.activations[{k}].cuboids[{row}]", f"{_numbers(seen[row])}; expected finite numbers")


def _size(is_bad: Callable[[Float64Array], BoolArray], expected: str) -> Find:
    """Find cuboids any length of which, (N, 3) [m], is bad."""

    def find(subject: Subject) -> Iterator[Hit]:
        sizes = _cuboid_rows(subject)[:, :3]
        return _hits(
            subject, is_bad(sizes).any(axis=1), lambda row: f"size {_numbers(sizes[row])} m; expected {expected}"
        )

    return find


def _is_absurd(sizes: Float64Array) -> BoolArray:
    lengths = np.abs(sizes)
    return ((lengths > 0) & (lengths < _SMALLEST_M)) | ((lengths > _LARGEST_M) & np.isfinite(lengths))


def _positive_sizes(scene: Scene) -> Scene:
    """Make negative lengths positive: a box is the same seen from its other side."""

    def positive(cuboid: Annotation) -> Annotation:
        if not isinstance(cuboid, CuboidAnnotation) or not (cuboid.path.values[:, :3] < 0).any():
            return cuboid
        values = np.concatenate([np.abs(cuboid.path.values[:, :3]), cuboid.path.values[:, 3:]], axis=1)
        return replace(cuboid, path=replace(cuboid.path, values=read_only(values)))

    return with_each(scene, "annotations", positive)


def _size_changes(subject: Subject) -> Iterator[Hit]:
    sizes = np.abs(_cuboid_rows(subject)[:, :3])
    smaller, larger = np.minimum(sizes[:-1], sizes[1:]), np.maximum(sizes[:-1], sizes[1:])
    jumps = (larger > _SIZE_FACTOR * smaller) & (larger - smaller > _SIZE_CHANGE_M) & np.isfinite(larger)
    bad = _from_second(subject, jumps.any(axis=1))
    return _hits(subject, bad, lambda row: f"size {_numbers(sizes[row])} m after {_numbers(sizes[row - 1])} m")


def _jumps(subject: Subject) -> Iterator[Hit]:
    """Find keyframes that no vehicle could reach, or that lie off the trajectory between their neighbours."""
    table, positions = annotation_parts(subject, "cuboids"), _cuboid_rows(subject)[:, 3:6]
    seconds = np.diff(table.timestamps_ns) / 1e9
    forward = table.inner & (seconds > 0)
    lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    out_of_reach = _from_second(subject, forward & (lengths > _SLACK_M + _FASTEST * seconds))
    off = _off_the_trajectory(positions, seconds, forward)

    def state(row: int) -> str:
        if off[row]:
            return f"{off[row]:.1f} m off the trajectory between the keyframes before and after"
        return f"{lengths[row - 1]:.1f} m from the keyframe before, in {seconds[row - 1]:.3f} s"

    return _hits(subject, out_of_reach | (off > 0), state)


def _off_the_trajectory(positions: Float64Array, seconds: Float64Array, forward: BoolArray) -> Float64Array:
    """How far keyframes lie off the trajectory between their neighbours, (R,) [m]; 0 where an object may."""
    # one misplaced keyframe bends the trajectories of its neighbours, too: only the one farthest off is reported
    off = np.zeros(len(positions))
    if len(positions) < 3:
        return off
    whole = np.where(forward[:-1] & forward[1:], seconds[:-1] + seconds[1:], 1.0)
    share = (seconds[:-1] / whole)[:, None]
    between = positions[:-2] * (1 - share) + positions[2:] * share
    gaps = np.where(forward[:-1] & forward[1:], np.linalg.norm(positions[1:-1] - between, axis=1), 0.0)
    limit = _SLACK_M + _ACCELERATION / 2 * seconds[:-1] * seconds[1:]
    before, after = np.r_[0.0, gaps[:-1]], np.r_[gaps[1:], 0.0]
    off[1:-1] = np.where((gaps > limit) & (gaps >= before) & (gaps >= after), gaps, 0.0)
    return off


def _stationary_moves(subject: Subject) -> Iterator[Hit]:
    for path, annotation in subject.annotations_of(CuboidAnnotation):
        positions = annotation.path.values[:, 3:6]
        if annotation.stationary and len(positions) > 1:
            spread = float(np.linalg.norm(np.ptp(positions, axis=0)))
            if spread > _STATIONARY_M:
                yield Hit(f"{path}.stationary", f"true, yet the keyframes lie {spread:.1f} m apart")


def _fast_rotations(subject: Subject) -> Iterator[Hit]:
    table, rows, reading = annotation_parts(subject, "cuboids"), _cuboid_rows(subject), CuboidAngles.of(subject.scene)
    steps = np.diff(table.timestamps_ns)
    half_rotation = 180.0 if reading.unit == AngleUnit.DEGREES else np.pi
    reach = np.abs(np.diff(rows[:, 6:9], axis=0)).sum(axis=1) / half_rotation * 180.0
    # no cuboid rotates by more than its three angles do together
    chosen = np.flatnonzero(table.inner & (steps > 0) & (steps <= _ROTATION_WITHIN_NS) & (reach > _ROTATION_DEG))
    before, after = (_rotations(reading, rows[chosen + k])[:, :, 0] for k in (0, 1))
    angles = np.zeros(len(rows))
    angles[chosen + 1] = np.degrees(np.arccos(np.sum(before * after, axis=1).clip(-1, 1)))
    return _hits(
        subject, angles > _ROTATION_DEG, lambda row: f"rotated by {angles[row]:.0f}° in {steps[row - 1] / 1e9:.3f} s"
    )


_REMEDY = "Open the file with `--euler-unit` and `--euler-order` as the message says, and write it again."

# fmt: off
CUBOID_RULES: tuple[Rule, ...] = (
    Rule("cuboid-not-finite", ERROR, "All numbers of a cuboid are finite.", "Remove the keyframe.", find=_not_finite),
    Rule("cuboid-negative-size", ERROR, "No length of a cuboid is negative.",
         "Take the length without its sign: the box is the same.",
         find=_size(lambda sizes: sizes < 0, "positive lengths"), fix=_positive_sizes),
    Rule("cuboid-no-size", ERROR, "No length of a cuboid is zero.", "Draw the cuboid as large as the object.",
         find=_size(lambda sizes: sizes == 0, "positive lengths")),
    Rule("cuboid-size-absurd", WARNING, f"Cuboids are {_SMALLEST_M:g} m to {_LARGEST_M:g} m long, wide and high.",
         "Check that the lengths are in metres, and in the order length, width, height, position, angles.",
         find=_size(_is_absurd, f"{_SMALLEST_M:g} to {_LARGEST_M:g} m")),
    Rule("cuboid-size-changes", WARNING,
         f"From keyframe to keyframe no length changes by more than {_SIZE_FACTOR:g} times and {_SIZE_CHANGE_M:g} m.",
         "Check whether one path joins two objects.", find=_size_changes),
    Rule("cuboid-jump", WARNING,
         "Cuboids move as objects can: no keyframe lies off the trajectory between its neighbours or out of reach.",
         "Check whether one path joins two objects, or a keyframe is misplaced.", find=_jumps),
    Rule("cuboid-rotation", WARNING,
         f"No cuboid rotates by more than {_ROTATION_DEG:g}° within {_ROTATION_WITHIN_NS / 1e9:g} s.",
         "Check whether front and back were mixed up in a keyframe.", find=_fast_rotations),
    Rule("cuboid-stationary-moves", WARNING, f"The keyframes of a stationary cuboid lie within {_STATIONARY_M:g} m.",
         "Remove `stationary`, or leave one keyframe.", find=_stationary_moves),
    Rule("cuboid-heading-off-motion", WARNING,
         "Cuboids move along their headings under the unit and order of their angles that is stated.", _REMEDY,
         find=_against_motion),
    Rule("cuboid-angles-off-points", WARNING,
         "No other unit or order of their angles puts clearly more points into the cuboids.", _REMEDY,
         look=_count_in_boxes, conclude=_against_points),
    Rule("cuboid-angles-unsaid", HINT, "The scene says in which unit and order the angles of its cuboids are.",
         "Open the file with `--euler-unit` and `--euler-order`, and write it again, which records them.",
         look=_count_in_boxes, conclude=_unsaid),
)
# fmt: on
