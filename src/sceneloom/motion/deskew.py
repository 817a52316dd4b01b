"""Deskewing: each point by the pose at its own timestamp, sweeps as if measured at once, warnings about timestamps."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.rigid import EXTRAPOLATED, OUT_OF_REACH, RigidTransform, multiply_quaternions
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import LONGEST_LAG_NS, PointTimes, RawTimes, TimesFound, timed_frame
from sceneloom.scene.poses import PoseSource
from sceneloom.warnings import DataWarning, WarningKind


def points_to_world(frame: LidarFrame, source: PoseSource) -> tuple[Float64Array, bool]:
    """Transform the points of one sweep into the world, each by the pose at its own time.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.

    Returns:
        positions_world: (N, 3) float64 [m].
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: a point's time is beyond the extrapolation limit of the path.
    """
    times = _point_times(frame)
    if len(times) == 0:
        return np.zeros((0, 3)), False
    knots = BodyKnots.of(source, int(times.min()), int(times.max()))
    return knots.moved(frame.points.positions, times, source.mount), knots.extrapolated


def points_at(frame: LidarFrame, source: PoseSource, moment_ns: int) -> tuple[Float64Array, bool]:
    """Transform the points of one sweep into the sensor's frame at one moment, as if the world had been seen then.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.
        moment_ns: within the sweep or not [ns], such as the time of an image.

    Returns:
        positions: (N, 3) float64 [m], in the sensor's frame at that moment.
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: the moment or a point's time is beyond the extrapolation limit of the path.
    """
    times = _point_times(frame)
    knots = BodyKnots.of(source, int(times.min(initial=moment_ns)), int(times.max(initial=moment_ns)))
    knots = knots.seen_from(_sensor_from_world(source, moment_ns))
    return knots.moved(frame.points.positions, times, source.mount), knots.extrapolated


def _sensor_from_world(source: PoseSource, moment_ns: int) -> RigidTransform:
    pose = source.at(np.array([moment_ns], np.int64))
    return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]).inverse()


def _point_times(frame: LidarFrame) -> Int64Array:
    times = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if times is None else times


@dataclass(frozen=True, slots=True, eq=False)
class BodyKnots:
    """The poses of a moving body over one sweep: linear and slerp between them.

    Attributes:
        timestamps_ns: (K,) int64 [ns], strictly increasing, K >= 1.
        positions: (K, 3) float64 [m].
        quaternions_xyzw: (K, 4) float64, unit.
        extrapolated: whether any is beyond the path's ends.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array
    extrapolated: bool

    @classmethod
    def of(cls, source: PoseSource, first_ns: int, last_ns: int) -> "BodyKnots":
        """Take the poses of a source's path from one time to another, both included.

        Raises:
            PoseError: one of the times is beyond the extrapolation limit of the path.
        """
        span_ns, path_ns = np.array([first_ns, last_ns], np.int64), source.path.timestamps_ns
        first, last = np.searchsorted(path_ns, span_ns, side="right")
        knots_ns = np.unique(np.concatenate([span_ns, path_ns[first:last]]))
        body = source.path.interpolate(knots_ns, reach_ns=source.reach_ns)
        if (body.coverage == OUT_OF_REACH).any():
            raise PoseError(
                f"points from {first_ns} to {last_ns} ns; the poses reach from "
                f"{source.path.start_ns} to {source.path.stop_ns} ns and {source.reach_ns} ns beyond"
            )
        return cls(knots_ns, body.positions, body.quaternions_xyzw, bool((body.coverage == EXTRAPOLATED).any()))

    def seen_from(self, frame_from_world: RigidTransform) -> "BodyKnots":
        """The same poses in another static frame; linear motion and slerp are preserved."""
        return replace(
            self,
            positions=frame_from_world.apply(self.positions),
            quaternions_xyzw=multiply_quaternions(frame_from_world.quaternion_xyzw, self.quaternions_xyzw),
        )

    def moved(
        self, positions: Float32Array, timestamps_ns: Int64Array, body_from_sensor: RigidTransform
    ) -> Float64Array:
        """Transform points of the sensor, (N, 3) [m], by the poses at their times, (N,) [ns]."""
        if len(self.timestamps_ns) == 1:
            world_from_body = RigidTransform.from_quaternion(self.positions[0], self.quaternions_xyzw[0])
            world_from_sensor = world_from_body @ body_from_sensor
            # points of a sensor that is the world's origin stay exactly as they are
            if np.array_equal(world_from_sensor.matrix, np.eye(4)):
                return positions.astype(np.float64)
            return world_from_sensor.apply(positions)
        from sceneloom.kernels.poses import transform_by_path

        moved = np.empty((len(positions), 3))
        transform_by_path(
            np.ascontiguousarray(positions), np.ascontiguousarray(timestamps_ns),
            np.ascontiguousarray(body_from_sensor.matrix[:3]), self.timestamps_ns, self.positions,
            self.quaternions_xyzw, moved,
        )  # fmt: skip
        return moved


_UNTIMED = "{}; the points were taken as measured at the sweep's time, and their times were left out"

_NOTES: Mapping[PointTimes, tuple[WarningKind, str, str]] = MappingProxyType(
    {
        PointTimes.EQUAL: (
            WarningKind.ASSUMED,
            "times-of-points",
            _UNTIMED.format("all points of a sweep have one time, and it is not the sweep's own"),
        ),
        PointTimes.RELATIVE: (
            WarningKind.ASSUMED,
            "relative-point-times",
            "point times are near zero and the sweep's own is not; they were read as relative to the sweep's time",
        ),
        PointTimes.OTHER_CLOCK: (
            WarningKind.ASSUMED,
            "point-times-of-another-clock",
            "point times are not on the clock of their sweep's time; the first of them was taken to be that time",
        ),
        PointTimes.WRONG_UNIT: (
            WarningKind.REPAIRED,
            "unit-of-point-times",
            "point times are {factor} times too {size} for their sweep; they were read in the unit that fits{origin}",
        ),
        PointTimes.UNKNOWN: (
            WarningKind.SKIPPED,
            "unknown-point-times",
            _UNTIMED.format("point times fit neither the sweep's own time nor its period"),
        ),
    }
)  # kind, code and message of the warning about each kind of times that is not taken as it is


@dataclass(slots=True)
class PointTimesStatistics:
    """Counts how the point times of sweeps were read."""

    counts: Counter[TimesFound] = field(default_factory=Counter)
    stray_points: int = 0

    def add(self, found: TimesFound) -> None:
        """Count one sweep."""
        self.counts[replace(found, strays=0)] += 1
        self.stray_points += found.strays

    def warnings(self, location: str = "sensors[].frames[].points.timestamps") -> tuple[DataWarning, ...]:
        """What was assumed, repaired or left out, each with the number of sweeps, or of stray points."""
        notes = []
        for found, count in self.counts.items():
            if found.kind in _NOTES:
                kind, code, template = _NOTES[found.kind]
                message = template.format(
                    factor=int(1 / found.factor if found.factor < 1 else found.factor),
                    size="small" if found.factor < 1 else "large",
                    origin=", relative to the sweep's time" if found.relative else "",
                )
                notes.append((kind, code, message, count))
        if self.stray_points:
            message = "times of single points are far from those of their sweep; the sweep's median was taken instead"
            notes.append((WarningKind.REPAIRED, "stray-point-times", message, self.stray_points))
        return tuple(
            DataWarning(kind=kind, code=code, location=location, message=message, count=count)
            for kind, code, message, count in notes
        )


MEASURED = "measured_timestamps_ns"
"""Name of the additional array of a deskewed sweep's points with the time when each was measured [ns]."""

LEFT_SKEWED = "left_skewed"
"""Name of the additional field of a sweep with the reason why it could not be deskewed."""

_EMPTY = "no points"
_INSTANT = "all points of one time"
_UNTIMED_POINTS = "no times of the points"
_IN_GAP = "in a gap of the measured motion"
_BEYOND = "beyond the trajectory"  # why a sweep is left as it is


def _median_ns(times_ns: Int64Array) -> int:
    middle = len(times_ns) // 2
    return int(np.partition(times_ns, middle)[middle])


MOMENTS: Mapping[str, Callable[[Int64Array], int]] = MappingProxyType(
    {"start": lambda times_ns: int(times_ns.min()), "middle": _median_ns, "end": lambda times_ns: int(times_ns.max())}
)
"""The moments of a sweep that its points can be deskewed to, by its point times (N,) int64 [ns], N >= 1."""

_SAMPLED_SWEEPS = 5  # sweeps from which the usual location of the timestamp within a sweep is taken


@dataclass(frozen=True, slots=True, eq=False)
class DeskewedFrame:
    """A sweep as if all its points had been measured at once.

    Attributes:
        frame: its points in their original frame, all at the frame's time; as measured where `left` gives the reason.
        times: how the times of its points were read.
        shifts: (N,) float32 [m], how far each point was moved; none where it was left.
        raw: what reading the next sweep's times may need.
        extrapolated: whether poses beyond the trajectory's ends were used.
        left: why it was left as it was, or None.
    """

    frame: LidarFrame
    times: TimesFound
    shifts: Float32Array
    raw: RawTimes | None = None
    extrapolated: bool = False
    left: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Deskewer:
    """Deskews a lidar's sweeps to one moment each; the points stay in their original frame.

    Attributes:
        source: transforms the points as stored into the world.
        period_ns: from sweep to sweep.
        offset_ns: from a sweep's timestamp to the moment that it is deskewed to.
        gaps_ns: (G, 2) int64 [ns], between which the motion is unknown.
    """

    source: PoseSource
    period_ns: int
    offset_ns: int
    gaps_ns: Int64Array

    def deskew(self, frame: LidarFrame, *, previous: RawTimes | None = None) -> DeskewedFrame:
        """Deskew one sweep, if its points have times and the motion at these times is known."""
        timed = timed_frame(frame, self.period_ns, previous=previous)
        moment_ns = frame.timestamp_ns + self.offset_ns
        measured = _point_times(timed.frame)
        knots = self._knots(timed.frame, moment_ns)
        # the file's own time of a sweep no longer holds where its timestamp moves
        extras = {name: value for name, value in timed.frame.extras.items() if name != "file_seconds"}
        if isinstance(knots, str):
            # left as measured: the timestamp moves like those of the others, the points keep their times
            if knots not in {_INSTANT, _EMPTY}:
                extras[LEFT_SKEWED] = knots
            points = replace(timed.frame.points, timestamps_ns=measured)
            left = LidarFrame(moment_ns, points, MappingProxyType(extras))
            return DeskewedFrame(left, timed.found, np.zeros(0, np.float32), timed.raw, left=knots)
        at_moment = knots.seen_from(_sensor_from_world(self.source, moment_ns))
        positions = at_moment.moved(frame.points.positions, measured, self.source.mount).astype(np.float32)
        apart = positions - frame.points.positions
        columns = {name: array for name, array in timed.frame.points.extras.items() if name != "file_seconds"}
        points = replace(
            timed.frame.points,
            positions=positions,
            timestamps_ns=np.full(len(measured), moment_ns, np.int64),
            extras=MappingProxyType({**columns, MEASURED: measured}),
        )
        moved = LidarFrame(moment_ns, points, MappingProxyType(extras))
        shifts = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        return DeskewedFrame(moved, timed.found, shifts, timed.raw, knots.extrapolated)

    def _knots(self, frame: LidarFrame, moment_ns: int) -> BodyKnots | str:
        """The poses over a sweep and the moment that it is deskewed to, or why it stays as it is."""
        times = frame.points.timestamps_ns
        if len(frame.points) == 0:
            return _EMPTY
        if times is None:
            return _UNTIMED_POINTS
        if times.min() == times.max():
            return _INSTANT
        first_ns, last_ns = int(times.min(initial=moment_ns)), int(times.max(initial=moment_ns))
        if ((self.gaps_ns[:, 0] < last_ns) & (self.gaps_ns[:, 1] > first_ns)).any():
            return _IN_GAP
        try:
            return BodyKnots.of(self.source, first_ns, last_ns)
        except PoseError:
            return _BEYOND


class DeskewedFrames:
    """Reads sweeps and deskews them, as `LazyFrames` asks for a lidar's frames.

    It keeps the point times of the sweep that it read last, which help to interpret those of the next one.
    """

    def __init__(
        self,
        frames: LazyFrames[LidarFrame],
        deskewer: Deskewer,
        on_frame: Callable[[int, DeskewedFrame], None] | None = None,
    ) -> None:
        """Hold the sweeps as measured; `on_frame` is called with each one after it was deskewed."""
        self._frames, self._deskewer, self._on_frame = frames, deskewer, on_frame
        self._last: tuple[int, RawTimes | None] = (-1, None)

    def __call__(self, k: int) -> LidarFrame:
        """Deskew sweep `k`.

        Raises:
            DataError: it cannot be read.
        """
        frame = self._frames[k]
        deskewed = self._deskewer.deskew(frame, previous=self._previous(k, frame))
        self._last = (k, deskewed.raw)
        if self._on_frame is not None:
            self._on_frame(k, deskewed)
        return deskewed.frame

    def _previous(self, k: int, frame: LidarFrame) -> RawTimes | None:
        """Of the sweep before; it is read again only where its times may be needed, near the clock's zero."""
        if self._last[0] == k - 1:
            return self._last[1]
        if k == 0 or abs(frame.timestamp_ns) > LONGEST_LAG_NS:
            return None
        try:
            return timed_frame(self._frames[k - 1], self._deskewer.period_ns).raw
        except DataError:
            return None


def typical_offset_ns(frames: LazyFrames[LidarFrame], period_ns: int, at: str) -> int:
    """The usual time from a sweep's timestamp to a moment of it, from a few sweeps spread over the drive.

    One offset for all sweeps keeps their moments as even as their timestamps are, and known without reading them.

    Args:
        at: one of `MOMENTS`.

    Returns:
        The median offset [ns], 0 where no sweep has usable point times.
    """
    offsets = []
    for k in np.unique(np.linspace(0, len(frames) - 1, min(_SAMPLED_SWEEPS, len(frames))).astype(int)).tolist():
        try:
            frame, previous = frames[k], frames[k - 1] if k else None
        except DataError:
            continue
        raw = None if previous is None else timed_frame(previous, period_ns).raw
        times = timed_frame(frame, period_ns, previous=raw).frame.points.timestamps_ns
        if times is not None and len(times):
            offsets.append(MOMENTS[at](times) - frame.timestamp_ns)
    # whole microseconds: where the timestamps are such, the moments can be written as exactly
    return round(float(np.median(offsets)) / 1000) * 1000 if offsets else 0
