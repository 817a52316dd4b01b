"""Rules about the frame of points: sweeps match, the ground is below, cuboids contain points, images are upright."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.checks.annotation_table import cuboids_at
from sceneloom.checks.rule import HINT, WARNING, FrameInHand, Hit, Rule, Subject, frames_spread
from sceneloom.errors import SceneloomError
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform, rotate_vectors
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import EgoMotion, points_source, sensor_source
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.samples import choose_ego, locations_of
from sceneloom.scene.scene import scene_period_ns
from sceneloom.scene.types import PointsFrame

_LOOKED_AT, _KEPT_POINTS = 4, 40_000
"""So many frames of a sensor are compared, spread over the drive, each with one more; so many points of each."""

_NEARER, _NEARER_M = 3.0, 30.0
"""Another frame is the right one if the points then lie this much nearer to the sensor, by factor and by metres."""

_LEAST_MOVE_M, _LARGEST_MOVE_M = 1.5, 30.0
"""Two sweeps are compared if the sensor moved this far between them: less shows nothing, more sees other objects."""

_ASKED_POINTS, _LEAST_ASKED, _MEETS_M = 3_000, 100, 0.3
"""Points of two sweeps that are compared, at most and at least; those no farther apart are of one object."""

_OFF_GROUND_M, _CELL_M, _CELLS_APART = 0.5, 4.0, 1 << 24
"""A point this far above the lowest point of its cell is off the ground."""

_MORE_OVERLAP, _MORE_TIMES = 0.15, 1.5
"""Another frame is the right one if this many more of the points meet, as a share and as a factor."""

_MOST_IMAGES, _ROLLED_DEG = 2_000, 60.0
"""So many images, evenly spread, show how a camera is usually rotated; beyond this it is not upright."""

_SURROUNDINGS_LOOKED_AT, _SURROUNDINGS_POINTS, _LEAST_POINTS = 8, 60_000, 500
"""Frames of a lidar whose surroundings are judged; points of each, at most and at least."""

_SHEET_M, _TALLEST_M, _LEVEL_M = 0.25, 8.0, 0.3
_NEAR_M, _FAR_M = 3.0, 25.0  # level points and cuboids are judged between these distances from the sensor

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
    if source is None:
        return None
    poses = source.at(np.array([timestamp_ns], np.int64))
    if poses.coverage[0] == 2 or not np.isfinite(poses.positions).all():
        return None
    return RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])


def points_in_world(subject: Subject, lidar: LidarSensor, sweep: LidarFrame, most: int) -> Float64Array | None:
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
        spread = sorted(frames_spread(len(sensor.frames), _LOOKED_AT))
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
            some = _some_points(frame, _KEPT_POINTS)
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
        from scipy.spatial import cKDTree

        shares: dict[PointsFrame, float] = {}
        if len(other[1]) < _LEAST_ASKED:
            return shares
        others = cKDTree(other[1])
        for frame, source in self.locations.points.items():
            world_from_one, world_from_other = _transform_at(source, one[0]), _transform_at(source, other[0])
            if world_from_one is None or world_from_other is None:
                continue
            asked = world_from_one.apply(one[1])
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
        points = points_in_world(subject, lidar, sweep, _SURROUNDINGS_POINTS)
        world_from_sensor = _transform_at(_Locations.of(subject, lidar).sensor, sweep.timestamp_ns)
        if points is not None and world_from_sensor is not None and len(points) >= _LEAST_POINTS:
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
    """How many cuboids with a keyframe at a sweep are in sight of the lidar, and how many of them contain a point."""
    from sceneloom.kernels.boxes import find_points_in_boxes  # imports the compiler: only where there are cuboids

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
