"""The trajectory of a scene by lidar odometry: sweeps in the ego frame, the run over all of them, and its poses."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, quaternion_from_matrix, slerp
from sceneloom.motion.deskew import PointTimesStatistics
from sceneloom.motion.odometry.lidar_odometry import LidarOdometry, Outcome, PoseEstimate
from sceneloom.motion.odometry.registration import MotionState, OdometryConfiguration
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.point_times import RawTimes, timed_frame
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, sweep_period_ns
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import DataWarning, WarningKind

_SAME_PERIOD = 0.75
"""Sweeps that begin within this part of a period of one another belong together."""


@dataclass(frozen=True, slots=True, eq=False)
class EgoCloud:
    """What the lidars measured in one period.

    Attributes:
        timestamp_ns: start of the first of its sweeps [ns].
        positions_ego: (N, 3) float [m], each as measured at its own time.
        timestamps_ns: (N,) int64 [ns], or None where no point's time is known.
    """

    timestamp_ns: int
    positions_ego: FloatArray
    timestamps_ns: Int64Array | None


@dataclass(slots=True)
class _Source:
    """A lidar that odometry can use."""

    lidar: LidarSensor
    ego_from_points: RigidTransform
    period_ns: int
    raw: RawTimes | None = None
    statistics: PointTimesStatistics = field(default_factory=PointTimesStatistics)
    unreadable: int = 0
    empty: int = 0
    repeated: int = 0
    _latest: FloatArray | None = None

    def note(self, frame: LidarFrame) -> None:
        """Count sweeps without returns, and those that are the one before over again."""
        positions = frame.points.positions
        if len(positions) == 0:
            self.empty += 1
        elif self._latest is not None and np.array_equal(positions, self._latest, equal_nan=True):
            self.repeated += 1
        self._latest = positions

    def warnings(self) -> list[DataWarning]:
        """What there is to state of the lidar's sweeps."""
        location, count = f"sensors[{self.lidar.id}].frames", len(self.lidar.frames)
        notes = (
            ("odometry-sweep-unreadable", self.unreadable, f"of {count} sweeps these cannot be read"),
            (
                "sweeps-without-returns",
                self.empty,
                f"of {count} sweeps these have no returns; was the lidar blind?",
            ),
            (
                "repeated-sweeps",
                self.repeated,
                f"of {count} sweeps these hold exactly the points of the one before, as if it stood; was it stuck?",
            ),
        )
        return [
            *self.statistics.warnings(f"{location}[].points.timestamps"),
            *(
                DataWarning(
                    kind=WarningKind.ASSUMED, code=code, location=location, message=message, count=found
                )
                for code, found, message in notes
                if found
            ),
        ]


@dataclass(slots=True)
class SceneSweeps:
    """Gives the clouds of a scene one after another and remembers what had to be stated about them.

    Attributes:
        groups: the sweeps that make each cloud: number of the lidar, number of the frame.
        warnings: what was assumed, repaired or left out of the whole scene.
    """

    scene: Scene
    lenient: bool
    sources: list[_Source]
    groups: list[list[tuple[int, int]]]
    warnings: list[DataWarning]
    untimed: int = 0

    @classmethod
    def of(cls, scene: Scene, *, lenient: bool = False) -> "SceneSweeps":
        """Find the lidars that odometry can use, and which of their sweeps belong together.

        Raises:
            PoseError: there is none.
        """
        warnings: list[DataWarning] = []
        sources = _usable_sources(scene, warnings)
        return cls(scene, lenient, sources, _grouped(sources, warnings), warnings)

    def __len__(self) -> int:
        return len(self.groups)

    def clouds(self) -> Iterator[tuple[int, EgoCloud]]:
        """Read clouds in the order of their time, each with its number.

        Raises:
            DataError: a sweep cannot be read, and this is not lenient.
        """
        for row, group in enumerate(self.groups):
            cloud = self._cloud(group)
            if cloud is not None:
                yield row, cloud

    def counted_warnings(self) -> tuple[DataWarning, ...]:
        """Notes on the clouds that were read; `warnings` are those on the whole scene."""
        of_lidars = [warning for source in self.sources for warning in source.warnings()]
        return (*of_lidars, *self._untimed_warning())

    def _untimed_warning(self) -> list[DataWarning]:
        if not self.untimed:
            return []
        message = (
            "points without times of their own were taken as measured at once, at their sweep's time: "
            "what the ego moved during a sweep stays in its points and in the poses"
        )
        return [
            DataWarning(
                kind=WarningKind.ASSUMED,
                code="odometry-without-point-times",
                location=self.scene.source,
                message=message,
                count=self.untimed,
            )
        ]

    def _cloud(self, group: list[tuple[int, int]]) -> EgoCloud | None:
        parts = []
        for number, index in group:
            source = self.sources[number]
            frame = self._read(source, index)
            if frame is not None:
                parts.append((frame, source.ego_from_points.apply(frame.points.positions)))
        if not parts:
            return None
        start_ns = min(frame.timestamp_ns for frame, _ in parts)
        positions = np.concatenate([points for _, points in parts])
        if len(positions) and all(frame.points.timestamps_ns is None for frame, _ in parts):
            return EgoCloud(start_ns, positions, None)
        return EgoCloud(start_ns, positions, np.concatenate([_times(frame) for frame, _ in parts]))

    def _read(self, source: _Source, index: int) -> LidarFrame | None:
        try:
            frame = source.lidar.frames[index]
        except DataError:
            if not self.lenient:
                raise
            source.unreadable += 1
            return None
        source.note(frame)
        timed = timed_frame(frame, source.period_ns, previous=source.raw)
        source.raw = timed.raw or source.raw
        source.statistics.add(timed.found)
        if timed.frame.points.timestamps_ns is None and len(frame.points):
            self.untimed += 1
        return timed.frame


def _times(frame: LidarFrame) -> Int64Array:
    times = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if times is None else times


def _skipped(code: str, location: str, message: str, count: int = 1) -> DataWarning:
    return DataWarning(kind=WarningKind.SKIPPED, code=code, location=location, message=message, count=count)


def _usable_sources(scene: Scene, warnings: list[DataWarning]) -> list[_Source]:
    """The lidars whose points can be brought into the ego frame.

    Raises:
        PoseError: there is none.
    """
    lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
    if not lidars:
        raise PoseError(
            f"{scene.source}: no lidar sweeps in it, so lidar odometry has nothing to go by; "
            "choose another trajectory with `--trajectory NAME`"
        )
    raw = [lidar for lidar in lidars if lidar.points_frame is not PointsFrame.WORLD]
    if not raw:
        raise PoseError(
            f"{scene.source}: the lidar points are in the world already, so their motion is known and taken out; "
            "use the scene's own trajectory, or state `--points-frame sensor` if they are not"
        )
    mounted = [(lidar, mount) for lidar in raw if (mount := _ego_from_points(lidar)) is not None]
    if not mounted:
        mounted = [(raw[0], RigidTransform.identity())]
        message = f"lidar {raw[0].id!r} has no mounting on the ego; the lidar was taken as the ego"
        warnings.append(
            DataWarning(
                kind=WarningKind.ASSUMED,
                code="lidar-is-the-ego",
                location=f"sensors[{raw[0].id}]",
                message=message,
            )
        )
    used = {id(lidar) for lidar, _ in mounted}
    for lidar in lidars:
        if id(lidar) not in used:
            why = "its points are in the world already" if lidar not in raw else "its mounting is not known"
            message = f"lidar {lidar.id!r} was left out of the odometry: {why}"
            warnings.append(_skipped("lidar-left-out-of-odometry", f"sensors[{lidar.id}]", message))
    return [_Source(lidar, mount, sweep_period_ns(lidar)) for lidar, mount in mounted]


def _ego_from_points(lidar: LidarSensor) -> RigidTransform | None:
    return RigidTransform.identity() if lidar.points_frame is PointsFrame.EGO else lidar.mount


def _grouped(sources: list[_Source], warnings: list[DataWarning]) -> list[list[tuple[int, int]]]:
    """Sweeps in the order of their time, those within one period together; a slow lidar once in each group."""
    longest_ns = max(source.period_ns for source in sources)
    entries = []
    for number, source in enumerate(sources):
        timestamps = source.lidar.frames.timestamps_ns
        order = np.argsort(timestamps, kind="stable")
        location = f"sensors[{source.lidar.id}].frames"
        if (order != np.arange(len(order))).any():
            message = "sweeps were not in the order of their time; they were taken in that order"
            warnings.append(
                DataWarning(
                    kind=WarningKind.REPAIRED, code="sweeps-sorted", location=location, message=message
                )
            )
        fresh = np.diff(timestamps[order], prepend=timestamps[order[0]] - 1) > 0
        if not fresh.all():
            message = "sweeps with the time of the one before were left out of the odometry"
            warnings.append(_skipped("sweeps-of-one-time", location, message, int((~fresh).sum())))
        entries += [(int(timestamps[k]), number, int(k)) for k in order[fresh]]
    groups: list[list[tuple[int, int]]] = []
    start_ns, latest = 0, dict[int, int]()
    for timestamp_ns, number, index in sorted(entries):
        period_ns = sources[number].period_ns
        is_slow = period_ns >= _SAME_PERIOD * longest_ns
        if (
            groups
            and timestamp_ns - start_ns < _SAME_PERIOD * longest_ns
            and not (is_slow and number in latest)
        ):
            groups[-1].append((number, index))
        else:
            groups.append([(number, index)])
            start_ns, latest = timestamp_ns, {}
        latest[number] = timestamp_ns
    return groups


def _trajectory_of(name: str, estimates: list[PoseEstimate]) -> Trajectory:
    """Lay a path through the sweeps' poses, from the first point to the last, that begins with the identity.

    There is a knot in the middle of every sweep, and one between two sweeps half-way in time, where both motions
    meet. Where the sweeps are far apart in time, each motion ends with its own points.

    Args:
        estimates: at least one, in the order of their time.
    """
    knots: list[tuple[int, Float64Array, Float64Array, int]] = []
    for k, estimate in enumerate(estimates):
        before = estimates[k - 1] if k else None
        if before is None:
            knots.append(_own(estimate, estimate.first_ns, k))
        else:
            knots += _between(before, estimate, k)
        knots.append(_own(estimate, estimate.state.timestamp_ns, k))
    knots.append(_own(estimates[-1], estimates[-1].last_ns, len(estimates) - 1))
    return _from_first_pose(name, knots, estimates)


def _own(estimate: PoseEstimate, timestamp_ns: int, k: int) -> tuple[int, Float64Array, Float64Array, int]:
    rotation, position = estimate.state.at(timestamp_ns)
    return timestamp_ns, position, quaternion_from_matrix(rotation), k


def _between(
    before: PoseEstimate, after: PoseEstimate, k: int
) -> list[tuple[int, Float64Array, Float64Array, int]]:
    """The knots between the middles of two sweeps."""
    middles_ns = before.state.timestamp_ns, after.state.timestamp_ns
    longest_ns = 2 * max(before.last_ns - before.first_ns, after.last_ns - after.first_ns)
    if 0 < longest_ns < middles_ns[1] - middles_ns[0]:
        return [_own(before, before.last_ns, k - 1), _own(after, after.first_ns, k)]
    halfway_ns = sum(middles_ns) // 2
    _, first_position, first_rotation, _ = _own(before, halfway_ns, k - 1)
    _, second_position, second_rotation, _ = _own(after, halfway_ns, k)
    return [
        (
            halfway_ns,
            0.5 * (first_position + second_position),
            slerp(first_rotation, second_rotation, 0.5),
            k - 1,
        )
    ]


def _from_first_pose(
    name: str, knots: list[tuple[int, Float64Array, Float64Array, int]], estimates: list[PoseEstimate]
) -> Trajectory:
    """Move the world's origin and axes to the first knot's pose."""
    times = np.array([knot[0] for knot in knots], np.int64)
    kept = np.concatenate([[0], 1 + np.flatnonzero(_rises(times))])
    positions = np.array([knots[k][1] for k in kept])
    quaternions = np.array([knots[k][2] for k in kept])
    origin = RigidTransform.from_quaternion(positions[0], quaternions[0]).inverse()
    axes = np.kron(np.eye(2), origin.rotation)
    covariances = np.array([axes @ estimates[knots[k][3]].covariance @ axes.T for k in kept])
    return Trajectory(
        name,
        times[kept],
        origin.apply(positions),
        multiply_quaternions(origin.quaternion_xyzw, quaternions),
        covariances=covariances,
    )


def _rises(times: Int64Array) -> BoolArray:
    """Which times are later than every one before, but for the first: overlapping sweeps may put a knot too early."""
    return times[1:] > np.maximum.accumulate(times)[:-1]


NAME = "lidar"
"""The trajectory's name."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """What lidar odometry made of a scene.

    Attributes:
        trajectory: `world_from_ego` under the name "lidar", from the first point's time to the last one's, with
            covariances; the world is the ego's first pose.
        warnings: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    warnings: tuple[DataWarning, ...]


def lidar_odometry(
    scene: Scene,
    *,
    configuration: OdometryConfiguration | None = None,
    progress: Callable[[int, int], None] | None = None,
    lenient: bool = False,
) -> OdometryRun:
    """Find the ego trajectory through a scene from its lidar sweeps.

    Args:
        configuration: settings; the defaults hold for everything.
        progress: reported after each cloud how many are done and how many there are.
        lenient: leave sweeps out that cannot be read, with a warning.

    Raises:
        PoseError: the scene has no lidar sweeps, their points are in the world already, or none has returns.
        DataError: a sweep cannot be read, and this is not lenient.
    """
    sweeps = SceneSweeps.of(scene, lenient=lenient)
    settings = configuration or OdometryConfiguration()
    odometry = LidarOdometry(settings)
    estimates: list[PoseEstimate] = []
    late = 0
    for row, cloud in sweeps.clouds():
        estimate = odometry.add(cloud.timestamp_ns, cloud.positions_ego, cloud.timestamps_ns)
        if estimate is None:
            late += 1
        else:
            _append(estimates, estimate, settings)
        if progress is not None:
            progress(row + 1, len(sweeps))
    if not any(estimate.outcome in _BEGINNINGS for estimate in estimates):
        raise PoseError(
            f"{scene.source}: none of {len(sweeps)} lidar sweeps has enough returns to go by; "
            "choose another trajectory with `--trajectory NAME`"
        )
    counts = Counter(estimate.outcome for estimate in estimates)
    if not counts[Outcome.FITTED]:
        estimates = [_of_unknown_motion(estimate, settings) for estimate in estimates]
    warnings = (*sweeps.warnings, *sweeps.counted_warnings(), *_notes(counts, late, scene.source))
    return OdometryRun(_trajectory_of(NAME, estimates), warnings)


def _append(estimates: list[PoseEstimate], estimate: PoseEstimate, settings: OdometryConfiguration) -> None:
    """Add an estimate; what it reports about the sweep that the map began with replaces what was not known then.

    Sweeps before the very first map get the poses from which its motion comes.
    """
    first = estimate.first_state
    if first is not None:
        begun_at = max(k for k, earlier in enumerate(estimates) if earlier.outcome in _BEGINNINGS)
        estimates[begun_at] = replace(estimates[begun_at], state=first)
        if estimates[begun_at].outcome is Outcome.STARTED:
            estimates[:begun_at] = [_led_back(earlier, first, settings) for earlier in estimates[:begun_at]]
    estimates.append(estimate)


def _led_back(earlier: PoseEstimate, first: MotionState, settings: OdometryConfiguration) -> PoseEstimate:
    state = first.predicted(earlier.state.timestamp_ns, settings.acceleration, settings.yaw_acceleration)
    return replace(earlier, state=state, covariance=state.covariance[:6, :6])


def _of_unknown_motion(estimate: PoseEstimate, settings: OdometryConfiguration) -> PoseEstimate:
    """Covariance of the ego pose at the end of a sweep that could not be compared with any other."""
    later = estimate.state.predicted(
        max(estimate.last_ns, estimate.state.timestamp_ns), settings.acceleration, settings.yaw_acceleration
    )
    return replace(estimate, covariance=estimate.covariance + later.covariance[:6, :6])


_BEGINNINGS = (Outcome.STARTED, Outcome.RESTARTED)

_NOTES: Mapping[Outcome, tuple[str, str]] = MappingProxyType(
    {
        Outcome.TOO_FEW: (
            "odometry-too-few-points",
            "sweeps with too few usable points: their poses go on with the motion before, and their covariances grow",
        ),
        Outcome.MISFIT: (
            "odometry-misfit",
            "sweeps that do not fit onto the map: their poses go on with the motion before, and their covariances grow",
        ),
        Outcome.RESTARTED: (
            "odometry-restarted",
            "a gap in time or many misfits: new map begun where the motion before leads, with grown covariances",
        ),
    }
)
"""Code and message of the warning about each outcome that is not a fit."""


def _notes(counts: Counter[Outcome], late: int, location: str) -> list[DataWarning]:
    warnings = [
        DataWarning(
            kind=WarningKind.ASSUMED, code=code, location=location, message=message, count=counts[outcome]
        )
        for outcome, (code, message) in _NOTES.items()
        if counts[outcome]
    ]
    if not counts[Outcome.FITTED]:
        message = "no two sweeps could be compared, so nothing is known of the motion; the ego was taken as stationary"
        warnings.append(
            DataWarning(
                kind=WarningKind.ASSUMED, code="odometry-without-motion", location=location, message=message
            )
        )
    if late:
        message = (
            "sweeps whose middle is not later than that of the sweep before were left out of the odometry"
        )
        warnings.append(
            DataWarning(
                kind=WarningKind.SKIPPED,
                code="odometry-late-sweep",
                location=location,
                message=message,
                count=late,
            )
        )
    return warnings
