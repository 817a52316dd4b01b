"""The sweeps of a scene's lidars in the ego frame, those of one period as one cloud."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import FloatArray, Int64Array
from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.point_time_notices import PointTimesTally
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.point_times import RawTimes, timed_frame
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import sweep_period_ns
from sceneloom.scene.types import PointsFrame

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
    tally: PointTimesTally = field(default_factory=PointTimesTally)
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

    def notices(self) -> list[Notice]:
        """What there is to say of the lidar's sweeps."""
        place, count = f"sensors[{self.lidar.id}].frames", len(self.lidar.frames)
        remarks = (
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
            *self.tally.notices(f"{place}[].points.timestamps"),
            *(
                Notice(kind=NoticeKind.ASSUMED, code=code, place=place, message=message, count=found)
                for code, found, message in remarks
                if found
            ),
        ]


@dataclass(slots=True)
class SceneSweeps:
    """Gives the clouds of a scene one after another and remembers what had to be said about them.

    Attributes:
        groups: the sweeps that make each cloud: number of the lidar, number of the frame.
        notices: what was assumed, repaired or left out of the whole scene.
    """

    scene: Scene
    lenient: bool
    sources: list[_Source]
    groups: list[list[tuple[int, int]]]
    notices: list[Notice]
    untimed: int = 0

    @classmethod
    def of(cls, scene: Scene, *, lenient: bool = False) -> "SceneSweeps":
        """Find the lidars that odometry can use, and which of their sweeps belong together.

        Raises:
            PoseError: there is none.
        """
        notices: list[Notice] = []
        sources = _usable_sources(scene, notices)
        return cls(scene, lenient, sources, _grouped(sources, notices), notices)

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

    def counted_notices(self) -> tuple[Notice, ...]:
        """Remarks on the clouds that were read; `notices` are those on the whole scene."""
        of_lidars = [notice for source in self.sources for notice in source.notices()]
        return (*of_lidars, *self._untimed_notice())

    def _untimed_notice(self) -> list[Notice]:
        if not self.untimed:
            return []
        message = (
            "points without times of their own were taken as measured at once, at their sweep's time: "
            "what the ego moved during a sweep stays in its points and in the poses"
        )
        return [
            Notice(
                kind=NoticeKind.ASSUMED,
                code="odometry-without-point-times",
                place=self.scene.source,
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
        source.tally.add(timed.found)
        if timed.frame.points.timestamps_ns is None and len(frame.points):
            self.untimed += 1
        return timed.frame


def _times(frame: LidarFrame) -> Int64Array:
    times = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if times is None else times


def _skipped(code: str, place: str, message: str, count: int = 1) -> Notice:
    return Notice(kind=NoticeKind.SKIPPED, code=code, place=place, message=message, count=count)


def _usable_sources(scene: Scene, notices: list[Notice]) -> list[_Source]:
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
            "use the scene's own trajectory, or say `--points-frame sensor` if they are not"
        )
    mounted = [(lidar, mount) for lidar in raw if (mount := _ego_from_points(lidar)) is not None]
    if not mounted:
        mounted = [(raw[0], RigidTransform.identity())]
        message = f"lidar {raw[0].id!r} has no mounting on the ego; the lidar was taken as the ego"
        notices.append(
            Notice(
                kind=NoticeKind.ASSUMED,
                code="lidar-is-the-ego",
                place=f"sensors[{raw[0].id}]",
                message=message,
            )
        )
    used = {id(lidar) for lidar, _ in mounted}
    for lidar in lidars:
        if id(lidar) not in used:
            why = "its points are in the world already" if lidar not in raw else "its mounting is not known"
            message = f"lidar {lidar.id!r} was left out of the odometry: {why}"
            notices.append(_skipped("lidar-left-out-of-odometry", f"sensors[{lidar.id}]", message))
    return [_Source(lidar, mount, sweep_period_ns(lidar)) for lidar, mount in mounted]


def _ego_from_points(lidar: LidarSensor) -> RigidTransform | None:
    return RigidTransform.identity() if lidar.points_frame is PointsFrame.EGO else lidar.mount


def _grouped(sources: list[_Source], notices: list[Notice]) -> list[list[tuple[int, int]]]:
    """Sweeps in the order of their time, those within one period together; a slow lidar once in each group."""
    longest_ns = max(source.period_ns for source in sources)
    entries = []
    for number, source in enumerate(sources):
        stamps = source.lidar.frames.timestamps_ns
        order = np.argsort(stamps, kind="stable")
        place = f"sensors[{source.lidar.id}].frames"
        if (order != np.arange(len(order))).any():
            message = "sweeps were not in the order of their time; they were taken in that order"
            notices.append(
                Notice(kind=NoticeKind.REPAIRED, code="sweeps-sorted", place=place, message=message)
            )
        fresh = np.diff(stamps[order], prepend=stamps[order[0]] - 1) > 0
        if not fresh.all():
            message = "sweeps with the time of the one before were left out of the odometry"
            notices.append(_skipped("sweeps-of-one-time", place, message, int((~fresh).sum())))
        entries += [(int(stamps[k]), number, int(k)) for k in order[fresh]]
    groups: list[list[tuple[int, int]]] = []
    start_ns, latest = 0, dict[int, int]()
    for stamp_ns, number, index in sorted(entries):
        period_ns = sources[number].period_ns
        is_slow = period_ns >= _SAME_PERIOD * longest_ns
        if groups and stamp_ns - start_ns < _SAME_PERIOD * longest_ns and not (is_slow and number in latest):
            groups[-1].append((number, index))
        else:
            groups.append([(number, index)])
            start_ns, latest = stamp_ns, {}
        latest[number] = stamp_ns
    return groups
