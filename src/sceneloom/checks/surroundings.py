"""Rules about what stands around a vehicle: the ground below, objects where points are, images upright.

Poses of another drive, quaternions whose numbers stand in another order, transforms that go the other way and axes that
point elsewhere leave every number plausible. What they spoil is where things are: z is up in the world, so most of what
a lidar measures as a level sheet lies below it, and cuboids hold points of the objects that they were drawn around.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.checks.annotation_table import cuboid_paths, cuboid_rows
from sceneloom.checks.point_positions import point_positions, sensor_position, transform_at
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.errors import SceneloomError
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.kernels.points_in_boxes import find_points_in_boxes
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.sample_positions import choose_ego, locations_of

_MOST_IMAGES = 2_000
"""So many, evenly spread, report how a camera is usually rotated."""

_LOOKED_AT = 8
_KEPT_POINTS = 60_000
_LEAST_POINTS = 500
"""Fewer in a frame show nothing."""

_SHEET_M = 0.25
_TALLEST_M = 8.0
_GROUND_NEAR_M, _GROUND_FAR_M = 3.0, 25.0
_LEVEL_M = 0.3
_SHEET_SHARE, _SHEET_TIMES = 0.2, 4.0
"""The ground is above a sensor if a sheet there has this share of the points, and so many times those of any below."""

_BOX_NEAR_M, _BOX_FAR_M = 3.0, 25.0
_MARGIN_M, _OFF_GROUND_M = 0.1, 0.3
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
        spread = np.linspace(0, len(lidar.frames) - 1, _LOOKED_AT).astype(int)
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
        sensor_position(subject, lidar),
    )
    positions = sweep.points.positions
    some = positions[:: len(positions) // _KEPT_POINTS + 1].astype(np.float64)
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
        rows[:, 2] > 2 * _OFF_GROUND_M
    )
    rows = rows[sized & (distances > _BOX_NEAR_M) & (distances < _BOX_FAR_M)]
    rows = rows[_looked_at(rows[:, 3:5] - sensor[:2], points[:, :2] - sensor[:2])]
    if len(rows) == 0:
        return 0, 0
    found = np.zeros(len(rows), np.int64)
    angles = CuboidAngles.of(subject.scene)
    rotations = rotation_from_cuboid_angles(rows[:, 6:], unit=angles.unit, order=angles.order)
    centers, halves = rows[:, 3:6].copy(), rows[:, :3] / 2 + _MARGIN_M
    centers[:, 2] += (_OFF_GROUND_M + _MARGIN_M) / 2
    halves[:, 2] -= (_OFF_GROUND_M + _MARGIN_M) / 2
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


RULES: tuple[Rule, ...] = (
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
