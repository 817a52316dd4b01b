"""The sweeps of a scene's lidars in the ego frame, those of one period as one cloud."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import FloatArray, Int64Array
from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.point_time_warnings import PointTimesStatistics
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.point_times import RawTimes, timed_frame
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import sweep_period_ns
from sceneloom.scene.types import PointsFrame
from sceneloom.scene.warnings import DataWarning, WarningKind

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
