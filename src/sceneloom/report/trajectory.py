"""Ego trajectories, GNSS fixes, altitudes and speeds, and metrics against ground truth."""

from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import ArrayError, DataError, OptionError, PoseError, SceneloomError
from sceneloom.evaluate.tracking import TrackingReport, compare_tracks
from sceneloom.evaluate.trajectory import evaluate_trajectory
from sceneloom.evaluate.trajectory_errors import TrajectoryReport
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.motion.ego_trajectory import find_ego_motion, usable_fixes, usable_positions
from sceneloom.scene.ego import stated_origin
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Coordinates, Identifier

MOST_CORNERS = 400
"""So many locations of a trajectory are reported, evenly in time, for those who draw it."""

_STANDS = 0.2
"""Slower than this the ego stands [m/s]."""

_HALF_WINDOW = 0.25
"""Speeds are taken over twice this [s], or over two poses where these are farther apart: noise is no speed."""

_LEAST_ROTATING_TRAJECTORY = 5.0
"""A trajectory that leads less far from its beginning [m] does not notify where north is."""


class Corner(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """A location on a trajectory: seconds after the scene's first timestamp, x, y, z [m], speed [m/s]."""

    seconds: float
    x: float
    y: float
    z: float
    speed: float


class TrajectoryMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """One way through the world.

    Attributes:
        name: of the method that found it.
        found_now: whether it was found from the drive's measurements for this report.
        poses, seconds, metres: how many, over how long, how far.
        oriented: whether orientations are known.
        start, stop: seconds after the scene's first timestamp.
        farthest: from its first location [m].
        lowest, highest: heights [m].
        climb, descent: along it [m], steps below 5 cm left out.
        mean_speed, top_speed: [m/s]; the top one is what 99 % of the time is not exceeded.
        stationary_share: of the time, slower than 0.2 m/s.
        rotated_deg: how much the heading changed, added up [deg]; None without orientations.
        corners: locations on it, evenly in time.
    """

    name: str
    found_now: bool = False
    poses: int
    seconds: float
    metres: float
    oriented: bool
    start: float
    stop: float
    farthest: float
    lowest: float
    highest: float
    climb: float
    descent: float
    mean_speed: float
    top_speed: float
    stationary_share: float
    rotated_deg: float | None = None
    corners: tuple[Corner, ...] = ()


class Fixes(msgspec.Struct, frozen=True, kw_only=True):
    """What a satellite receiver reported.

    Attributes:
        sensor: the receiver.
        count, usable: fixes, and those that are locations.
        first_lla, last_lla: latitude, longitude [deg], height above the ellipsoid [m] of the first and the last usable
            one.
        south, west, north, east: what the fixes lie within [deg].
        accuracy_m, worst_accuracy_m: median and largest of the stated ones; None where none is stated.
        locations: (seconds, east, north, up) [s, m] of some of them, evenly in time, seen from the map's origin.
    """

    sensor: Identifier
    count: int
    usable: int
    first_lla: tuple[float, float, float]
    last_lla: tuple[float, float, float]
    south: float
    west: float
    north: float
    east: float
    accuracy_m: float | None
    worst_accuracy_m: float | None
    locations: tuple[tuple[float, float, float, float], ...]


class North(msgspec.Struct, frozen=True, kw_only=True):
    """Where north is in the world's axes.

    Attributes:
        direction_deg: counter-clockwise from the world's x axis [deg].
        shift: (3,) what is added to fixes' locations, rotated, to bring them onto the trajectory [m].
        rms: how far fixes and trajectory are apart, level [m]; None where the axes are stated to be east, north and up.
        trajectory: name of the trajectory that was held against the fixes.
    """

    direction_deg: float
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rms: float | None = None
    trajectory: str | None = None


class Trajectories(msgspec.Struct, frozen=True, kw_only=True):
    """All ways and fixes of a drive.

    Attributes:
        trajectories: the default one first; where there is none, that of the first sensor with poses in the world.
        fixes: of each receiver with usable ones.
        origin_lla: the location that fixes are seen from, the first usable one; None without fixes.
        north: where north is in the world of the trajectories; None where not known.
    """

    trajectories: tuple[TrajectoryMetrics, ...]
    fixes: tuple[Fixes, ...] = ()
    origin_lla: tuple[float, float, float] | None = None
    north: North | None = None


def trajectories_of(scene: Scene, *, start_ns: int, found_now: frozenset[str] = frozenset()) -> Trajectories:
    """Look at the trajectories and fixes of a scene.

    Args:
        start_ns: the scene's first timestamp [ns].
        found_now: names of the trajectories that were not in the drive as it is stored.
    """
    all_trajectories = _trajectories(scene)
    trajectories = [
        _trajectory(trajectory, start_ns, found_now=trajectory.name in found_now)
        for trajectory in all_trajectories
        if len(trajectory.timestamps_ns)
    ]
    receivers = [s for s in scene.sensors if isinstance(s, GnssSensor) and usable_fixes(s).any()]
    if not receivers:
        return Trajectories(trajectories=tuple(trajectories))
    origin = usable_positions(receivers[0])[1][0]
    return Trajectories(
        trajectories=tuple(trajectories),
        fixes=tuple(_fixes(receiver, origin, start_ns) for receiver in receivers),
        origin_lla=_three(origin),
        north=_stated_north(scene, origin)
        or (_north(all_trajectories[0], receivers[0], origin) if trajectories else None),
    )


def _trajectories(scene: Scene) -> list[Trajectory]:
    """The trajectories of a scene, else the first trajectory that a sensor's poses report."""
    if scene.trajectories:
        return list(scene.trajectories.values())
    for sensor in scene.sensors:
        path = _world_path(sensor)
        if path is not None:
            name = f"poses of {sensor.id}"
            return [Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)]
    return []


def _world_path(sensor: Sensor) -> Poses | None:
    path: Poses | None = getattr(sensor, "poses", None)
    in_world = getattr(sensor, "coordinates", Coordinates.WORLD) is Coordinates.WORLD
    return path if path is not None and in_world and not path.static else None


def _trajectory(trajectory: Trajectory, start_ns: int, *, found_now: bool) -> TrajectoryMetrics:
    rows = np.isfinite(trajectory.positions).all(axis=1)
    times = (trajectory.timestamps_ns[rows] - start_ns) / 1e9
    locations = trajectory.positions[rows] if rows.any() else np.zeros((1, 3))
    times = times if len(times) else np.zeros(1)
    steps = np.linalg.norm(np.diff(locations, axis=0), axis=1)
    grid = np.unique(np.linspace(times[0], times[-1], min(max(len(times), 2), MOST_CORNERS)))
    speeds = _speeds(times, locations, grid)
    at = np.column_stack([np.interp(grid, times, locations[:, axis]) for axis in range(3)])
    climbs = _climbs(at[:, 2])
    quaternions = trajectory.quaternions_xyzw
    return TrajectoryMetrics(
        name=trajectory.name,
        found_now=found_now,
        poses=len(trajectory.timestamps_ns),
        seconds=float(times[-1] - times[0]),
        metres=float(steps.sum()),
        oriented=quaternions is not None,
        start=float(times[0]),
        stop=float(times[-1]),
        farthest=float(np.linalg.norm(locations - locations[0], axis=1).max()),
        lowest=float(locations[:, 2].min()),
        highest=float(locations[:, 2].max()),
        climb=climbs[0],
        descent=climbs[1],
        mean_speed=float(steps.sum() / max(times[-1] - times[0], 1e-9)) if len(times) > 1 else 0.0,
        top_speed=float(np.percentile(speeds, 99)),
        stationary_share=float((speeds < _STANDS).mean()),
        rotated_deg=None if quaternions is None else _rotated(quaternions[rows]),
        corners=tuple(
            Corner(seconds=round(s, 4), x=round(x, 3), y=round(y, 3), z=round(z, 3), speed=round(v, 3))
            for s, (x, y, z), v in zip(grid.tolist(), at.tolist(), speeds.tolist(), strict=True)
        ),
    )


def _speeds(times: Float64Array, locations: Float64Array, grid: Float64Array) -> Float64Array:
    """Speeds [m/s] at times of a grid, each over a window of its own."""
    if len(times) < 2:
        return np.zeros(len(grid))
    half = max(_HALF_WINDOW, float(np.median(np.diff(times))))
    before, after = np.maximum(grid - half, times[0]), np.minimum(grid + half, times[-1])
    moved = np.column_stack(
        [
            np.interp(after, times, locations[:, k]) - np.interp(before, times, locations[:, k])
            for k in range(3)
        ]
    )
    speeds: Float64Array = np.linalg.norm(moved, axis=1) / np.maximum(after - before, 1e-9)
    return speeds


def _climbs(heights: Float64Array) -> tuple[float, float]:
    """How much a trajectory climbs and descends [m]; up and down within 5 cm is noise."""
    climb = descent = 0.0
    held = float(heights[0])
    for height in heights.tolist():
        if abs(height - held) >= 0.05:
            climb, descent = climb + max(height - held, 0.0), descent + max(held - height, 0.0)
            held = height
    return climb, descent


def _rotated(quaternions_xyzw: Float64Array) -> float:
    """Changes of the heading of the body's most level axis, added up [deg]; steps below 0.05 degrees are noise."""
    matrices = matrix_from_quaternion(quaternions_xyzw)
    axis = int(np.argmin(np.abs(matrices[:, 2]).mean(axis=0)))
    headings = np.unwrap(np.arctan2(matrices[:, 1, axis], matrices[:, 0, axis]))
    thinned = headings[
        np.unique(np.linspace(0, len(headings) - 1, min(len(headings), MOST_CORNERS)).astype(int))
    ]
    rotations = np.degrees(np.abs(np.diff(thinned)))
    return float(rotations[rotations > 0.05].sum())


def _fixes(receiver: GnssSensor, origin_lla: Float64Array, start_ns: int) -> Fixes:
    rows, lla = usable_positions(receiver)
    shown = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST_CORNERS)).astype(int))
    enu = enu_from_geodetic(lla[shown], origin_lla)
    seconds = (receiver.timestamps_ns[rows[shown]] - start_ns) / 1e9
    stated = receiver.accuracies[rows]
    stated = stated[np.isfinite(stated)]
    return Fixes(
        sensor=receiver.id,
        count=len(receiver.timestamps_ns),
        usable=len(rows),
        first_lla=_three(lla[0]),
        last_lla=_three(lla[-1]),
        south=float(lla[:, 0].min()),
        west=float(lla[:, 1].min()),
        north=float(lla[:, 0].max()),
        east=float(lla[:, 1].max()),
        accuracy_m=float(np.median(stated)) if len(stated) else None,
        worst_accuracy_m=float(stated.max()) if len(stated) else None,
        locations=tuple(
            (round(s, 4), *(round(value, 3) for value in location))
            for s, location in zip(seconds.tolist(), enu.tolist(), strict=True)
        ),
    )


def _three(values: Float64Array | Int64Array) -> tuple[float, float, float]:
    a, b, c = (float(value) for value in values)
    return a, b, c


def _stated_north(scene: Scene, origin_lla: Float64Array) -> North | None:
    """North where the scene says that its axes are east, north and up at a location, and was not moved since."""
    stated = stated_origin(scene)
    if stated is None:
        return None
    shift = enu_from_geodetic(origin_lla[None], stated)[0]
    return North(direction_deg=90.0, shift=_three(shift))


def _north(trajectory: Trajectory, receiver: GnssSensor, origin_lla: Float64Array) -> North | None:
    """Lay the fixes onto the trajectory by a shift and a rotation about the upright axis.

    None where that leaves north open.
    """
    rows, locations = usable_positions(receiver)
    enu = enu_from_geodetic(locations, origin_lla)
    times, first = np.unique(receiver.timestamps_ns[rows], return_index=True)
    if len(times) < 3 or np.linalg.norm(enu - enu[0], axis=1).max() < _LEAST_ROTATING_TRAJECTORY:
        return None
    try:
        reported = evaluate_trajectory(
            Trajectory("fixes", times, enu[first]), trajectory, align="yaw", rpe_deltas=()
        )
    except (PoseError, OptionError, ArrayError):
        return None
    x, y = matrix_from_quaternion(np.array([reported.alignment.quaternion_xyzw]))[0][:2, 1]
    return North(
        direction_deg=float(np.degrees(np.arctan2(y, x))),
        shift=reported.alignment.translation,
        rms=reported.absolute.horizontal.rms,
        trajectory=trajectory.name,
    )


_TRUTH = "groundTruth"
"""The name of trajectories that are taken for the truth."""


class Metrics(msgspec.Struct, frozen=True, kw_only=True):
    """Comparisons with the truth.

    Attributes:
        trajectories: one per trajectory that was held against a reference.
        tracks: objects of the drive held against those of the truth; None where there are none of both.
        skipped: what could not be compared, and why.
    """

    trajectories: tuple[TrajectoryReport, ...] = ()
    tracks: TrackingReport | None = None
    skipped: tuple[str, ...] = ()


def metrics_of(
    scene: Scene, *, source: Path | str | None, truth: Path | str | None, compare: tuple[str, ...] = ()
) -> Metrics:
    """Compare the trajectories of a scene with its true one, and with a truth that lies elsewhere.

    Args:
        source: where the drive lies, to be held against `truth`; None where it is in memory only.
        truth: a trajectory, or a scene or KITTI's text with the true objects and trajectory; None for none.
        compare: ways to be found and compared, too: "lidar", "gnss".

    Raises:
        DataError: neither the drive's trajectory nor its objects can be compared with `truth`, or nothing can be found
            and compared of `compare`.
    """
    collected = _Collected()
    true_trajectory = scene.trajectories.get(_TRUTH)
    reference = (
        true_trajectory if true_trajectory is not None else next(iter(scene.trajectories.values()), None)
    )
    if true_trajectory is not None:
        for name, trajectory in scene.trajectories.items():
            if name != _TRUTH and not same_direction(trajectory, true_trajectory):
                collected.compare(trajectory, true_trajectory)
    for name in compare:
        collected.find_and_compare(scene, name, reference)
    if truth is not None:
        collected.against(scene, source, truth)
    return Metrics(
        trajectories=tuple(collected.trajectories), tracks=collected.tracks, skipped=tuple(collected.skipped)
    )


class _Collected:
    """Comparisons so far; what cannot be compared is reported, not raised, but for what was asked for by name."""

    def __init__(self) -> None:
        self.trajectories: list[TrajectoryReport] = []
        self.tracks: TrackingReport | None = None
        self.skipped: list[str] = []

    def compare(self, estimate: Trajectory, reference: Trajectory | Path | str) -> None:
        try:
            self.trajectories.append(evaluate_trajectory(estimate, reference))
        except SceneloomError as error:
            self.skipped.append(f"{estimate.name}: {error}")

    def find_and_compare(self, scene: Scene, name: str, reference: Trajectory | None) -> None:
        try:
            if reference is None:
                raise DataError(scene.source, "", "the drive has no trajectory to be compared with")
            path = find_ego_motion(scene, name=name).path
            found = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
            self.trajectories.append(evaluate_trajectory(found, reference))
        except SceneloomError as error:
            problem = (
                f"nothing can be compared with what is found from {name}: {getattr(error, 'problem', error)}"
            )
            raise DataError(scene.source, "", f"{problem}; leave `--compare {name}` out") from error

    def against(self, scene: Scene, source: Path | str | None, truth: Path | str) -> None:
        """Hold the drive's trajectory, and its objects, against a truth that may have one of both only."""
        refused: list[str] = []
        before = len(self.trajectories)
        if scene.trajectories:
            reported = len(self.skipped)
            self.compare(next(iter(scene.trajectories.values())), truth)
            refused += self.skipped[reported:]
            del self.skipped[reported:]
        if source is not None:
            try:
                self.tracks = compare_tracks(source, truth)
            except SceneloomError as error:
                refused.append(f"objects: {error}")
        if self.tracks is None and len(self.trajectories) == before:
            reasons = "; ".join(refused) or "the drive has neither a trajectory nor objects"
            raise DataError(
                truth,
                "",
                f"cannot be compared with the drive: {reasons}. Expected a trajectory whose times overlap with the "
                "drive's, or objects of the same frames; name such a file, or leave `--truth` out",
            )
