"""Deskewing: each point by the pose at its own timestamp, sweeps as if measured at once, warnings about timestamps."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.interpolation import EXTRAPOLATED, OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import (
    LONGEST_LAG_NS,
    PointTimes,
    RawTimes,
    TimedFrame,
    TimesFound,
    timed_frame,
)
from sceneloom.scene.poses import PoseSource
from sceneloom.warnings import DataWarning, WarningKind


def points_to_world(frame: LidarFrame, source: PoseSource) -> tuple[Float64Array, bool]:
    """Take the points of one sweep from the sensor's frame into the world, undoing the motion during the sweep.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.

    Returns:
        positions_world: (N, 3) float64 [m].
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: a point's time lies beyond the reach of the path.
    """
    times = _point_times(frame)
    if len(times) == 0:
        return np.zeros((0, 3)), False
    knots = BodyKnots.of(source, int(times.min()), int(times.max()))
    return knots.moved(frame.points.positions, times, source.mount), knots.extrapolated


def points_at(frame: LidarFrame, source: PoseSource, moment_ns: int) -> tuple[Float64Array, bool]:
    """Take the points of one sweep to where the sensor would have seen them at any one moment, had they was stationary.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.
        moment_ns: within the sweep or not [ns], such as the time of an image.

    Returns:
        positions: (N, 3) float64 [m], in the sensor's frame at that moment.
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: the moment or a point's time lies beyond the reach of the path.
    """
    times = _point_times(frame)
    first_ns, last_ns = int(times.min(initial=moment_ns)), int(times.max(initial=moment_ns))
    knots = BodyKnots.of(source, first_ns, last_ns)
    pose = source.at(np.array([moment_ns], np.int64))
    at_moment = RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])
    moved = knots.seen_from(at_moment.inverse()).moved(frame.points.positions, times, source.mount)
    return moved, knots.extrapolated


def _point_times(frame: LidarFrame) -> Int64Array:
    times = frame.points.timestamps_ns
    if times is None or len(times) == 0:
        return np.full(len(frame.points), frame.timestamp_ns, np.int64)
    return times


@dataclass(frozen=True, slots=True, eq=False)
class BodyKnots:
    """The poses of a moving body over one sweep: linear and slerp between them.

    Attributes:
        timestamps_ns: (K,) int64 [ns], strictly increasing, K >= 1.
        positions: (K, 3) float64 [m].
        quaternions_xyzw: (K, 4) float64, unit.
        extrapolated: whether any lies beyond the path's ends.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array
    extrapolated: bool

    @classmethod
    def of(cls, source: PoseSource, first_ns: int, last_ns: int) -> "BodyKnots":
        """Take the poses of a source's path from one time to another, both included.

        Raises:
            PoseError: one of the times lies beyond the reach of the path.
        """
        span_ns = np.array([first_ns, last_ns], np.int64)
        knots_ns = _knots_within(source.path.timestamps_ns, span_ns)
        body = source.path.interpolate(knots_ns, reach_ns=source.reach_ns)
        if (body.coverage == OUT_OF_REACH).any():
            raise PoseError(
                f"points from {first_ns} to {last_ns} ns; the poses reach from "
                f"{source.path.start_ns} to {source.path.stop_ns} ns and {source.reach_ns} ns beyond"
            )
        return cls(knots_ns, body.positions, body.quaternions_xyzw, bool((body.coverage == EXTRAPOLATED).any()))

    def seen_from(self, frame_from_world: RigidTransform) -> "BodyKnots":
        """The same poses in another frame that is stationary; linear ways and slerp stay what they are."""
        return replace(
            self,
            positions=frame_from_world.apply(self.positions),
            quaternions_xyzw=multiply_quaternions(frame_from_world.quaternion_xyzw, self.quaternions_xyzw),
        )

    def moved(
        self, positions: Float32Array, timestamps_ns: Int64Array, body_from_sensor: RigidTransform
    ) -> Float64Array:
        """Take points of the sensor, (N, 3) [m], each at its time, (N,) [ns], to where the poses lead, (N, 3)."""
        if len(self.timestamps_ns) == 1:
            world_from_body = RigidTransform.from_quaternion(self.positions[0], self.quaternions_xyzw[0])
            return _taken(world_from_body @ body_from_sensor, positions)
        from sceneloom.kernels.poses import transform_by_path

        moved = np.empty((len(positions), 3))
        transform_by_path(
            np.ascontiguousarray(positions),
            np.ascontiguousarray(timestamps_ns),
            np.ascontiguousarray(body_from_sensor.matrix[:3]),
            self.timestamps_ns,
            self.positions,
            self.quaternions_xyzw,
            moved,
        )
        return moved


def _taken(world_from_sensor: RigidTransform, positions: Float32Array) -> Float64Array:
    """Take points through one transform; those of a sensor that is the world's origin are as they were."""
    if np.array_equal(world_from_sensor.matrix, np.eye(4)):
        return positions.astype(np.float64)
    return world_from_sensor.apply(positions)


def _knots_within(path_ns: Int64Array, span_ns: Int64Array) -> Int64Array:
    """The path's own times inside the span, and the span's ends."""
    first, last = np.searchsorted(path_ns, span_ns, side="right")
    return np.unique(np.concatenate([span_ns, path_ns[first:last]]))


@dataclass(slots=True)
class PointTimesStatistics:
    """Counts what was found out while sweeps pass, and says it."""

    counts: Counter[TimesFound] = field(default_factory=Counter)
    stray_points: int = 0

    def add(self, found: TimesFound) -> None:
        """Count one sweep."""
        self.counts[replace(found, strays=0)] += 1
        self.stray_points += found.strays

    def warnings(self, location: str = "sensors[].frames[].points.timestamps") -> tuple[DataWarning, ...]:
        """What was assumed, repaired or left out, each with the number of sweeps, or of stray points."""
        warnings = [_warning(found, location, count) for found, count in self.counts.items() if found.kind in _NOTES]
        if self.stray_points:
            message = (
                "times of single points lie far away from those of their sweep; "
                "the median of the sweep's times was put in their location"
            )
            warnings.append(
                DataWarning(
                    kind=WarningKind.REPAIRED,
                    code="stray-point-times",
                    location=location,
                    message=message,
                    count=self.stray_points,
                )
            )
        return tuple(warnings)


_UNTIMED = "{}; the points were taken as measured at the sweep's time, and their times were left out"

_NOTES: Mapping[PointTimes, tuple[WarningKind, str, str]] = MappingProxyType(
    {
        PointTimes.EQUAL: (
            WarningKind.ASSUMED,
            "times-of-points",
            _UNTIMED.format("all points of a sweep bear one time, and it is not the sweep's own"),
        ),
        PointTimes.RELATIVE: (
            WarningKind.ASSUMED,
            "relative-point-times",
            "point times lie around zero and the sweep's own does not; they were read as counted from the sweep's time",
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
)
"""Kind, code and message of the warning about each kind of times that is not simply believed."""


def _warning(found: TimesFound, location: str, count: int) -> DataWarning:
    kind, code, message = _NOTES[found.kind]
    too_small = found.factor < 1
    text = message.format(
        factor=int(1 / found.factor if too_small else found.factor),
        size="small" if too_small else "large",
        origin=", counted from the sweep's time" if found.relative else "",
    )
    return DataWarning(kind=kind, code=code, location=location, message=text, count=count)


MEASURED = "measured_timestamps_ns"
"""Name of the further array of a deskewed sweep's points that says when each was measured [ns]."""

LEFT_SKEWED = "left_skewed"
"""Name of the further field of a sweep that says why it could not be deskewed."""

_EMPTY = "no points"
_INSTANT = "all points of one time"
_ONE_MOMENT_UNTIMED = "no times of the points"
_IN_GAP = "in a gap of the measured motion"

_BEYOND = "beyond the trajectory"
"""Why a sweep is left as it is."""


def _median_ns(times_ns: Int64Array) -> int:
    middle = len(times_ns) // 2
    return int(np.partition(times_ns, middle)[middle])


MOMENTS: Mapping[str, Callable[[Int64Array], int]] = MappingProxyType(
    {
        "start": lambda times_ns: int(times_ns.min()),
        "middle": _median_ns,
        "end": lambda times_ns: int(times_ns.max()),
    }
)
"""The moments of a sweep that its points can be brought to, by its point times (N,) int64 [ns], N >= 1."""

_LOOKS = 5
"""Sweeps that are looked at to report where in a sweep its timestamp is."""


@dataclass(frozen=True, slots=True, eq=False)
class DeskewedFrame:
    """A sweep as if all its points had been measured at once.

    Attributes:
        frame: its points in the frame that they came in, all of the frame's time; where `left` says why, as measured.
        times: what the times of its points were.
        shifts: (N,) float32 [m], how far each point was moved; none where it was left.
        raw: what the judgement of the next sweep's times may need.
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
    """Brings the points of a lidar's sweeps to one moment per sweep; they stay in the frame that they come in.

    Attributes:
        source: takes the points as stored into the world.
        period_ns: from sweep to sweep.
        offset_ns: from a sweep's timestamp to the moment that its points are brought to.
        gaps_ns: (G, 2) int64 [ns], between which the motion is not known.
    """

    source: PoseSource
    period_ns: int
    offset_ns: int
    gaps_ns: Int64Array

    def deskew(self, frame: LidarFrame, *, previous: RawTimes | None = None) -> DeskewedFrame:
        """Deskew one sweep, if its points have times and the motion at these times is known."""
        timed = timed_frame(frame, self.period_ns, previous=previous)
        moment_ns = frame.timestamp_ns + self.offset_ns
        measured = _measured(timed.frame)
        # the span reaches to the moment, too: its pose is as much needed as those of the points
        first_ns, last_ns = int(measured.min(initial=moment_ns)), int(measured.max(initial=moment_ns))
        nothing_to_undo = _nothing_to_undo(timed.frame)
        if nothing_to_undo is not None:
            return _left(timed, measured, moment_ns, nothing_to_undo)
        if self._meets_gap(first_ns, last_ns):
            return _left(timed, measured, moment_ns, _IN_GAP)
        try:
            knots = BodyKnots.of(self.source, first_ns, last_ns)
        except PoseError:
            return _left(timed, measured, moment_ns, _BEYOND)
        at_moment = self._sensor_from_world(moment_ns)
        moved = knots.seen_from(at_moment).moved(frame.points.positions, measured, self.source.mount)
        positions = moved.astype(np.float32)
        apart = positions - frame.points.positions
        return DeskewedFrame(
            _at_moment(timed.frame, positions, measured, moment_ns),
            timed.found,
            np.sqrt(np.einsum("ij,ij->i", apart, apart)),
            timed.raw,
            knots.extrapolated,
        )

    def _sensor_from_world(self, moment_ns: int) -> RigidTransform:
        pose = self.source.at(np.array([moment_ns], np.int64))
        return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]).inverse()

    def _meets_gap(self, first_ns: int, last_ns: int) -> bool:
        return bool(((self.gaps_ns[:, 0] < last_ns) & (self.gaps_ns[:, 1] > first_ns)).any())


def _nothing_to_undo(frame: LidarFrame) -> str | None:
    """Why the points of a sweep have no motion among them that is known."""
    times = frame.points.timestamps_ns
    if len(frame.points) == 0:
        return _EMPTY
    if times is None:
        return _ONE_MOMENT_UNTIMED
    return _INSTANT if times.min() == times.max() else None


def _measured(frame: LidarFrame) -> Int64Array:
    times = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if times is None else times


def _at_moment(frame: LidarFrame, positions: Float32Array, measured_ns: Int64Array, moment_ns: int) -> LidarFrame:
    further = {name: array for name, array in frame.points.extras.items() if name != "file_seconds"}
    points = replace(
        frame.points,
        positions=positions,
        timestamps_ns=np.full(len(measured_ns), moment_ns, np.int64),
        extras=MappingProxyType({**further, MEASURED: measured_ns}),
    )
    return LidarFrame(moment_ns, points, MappingProxyType(_without_file_seconds(frame)))


def _left(timed: TimedFrame, measured_ns: Int64Array, moment_ns: int, reason: str) -> DeskewedFrame:
    """Leave a sweep as it was measured; its timestamp moves like those of the others, its points keep their times."""
    points = replace(timed.frame.points, timestamps_ns=measured_ns)
    extras = _without_file_seconds(timed.frame)
    if reason not in {_INSTANT, _EMPTY}:
        extras[LEFT_SKEWED] = reason
    return DeskewedFrame(
        LidarFrame(moment_ns, points, MappingProxyType(extras)),
        timed.found,
        np.zeros(0, np.float32),
        timed.raw,
        left=reason,
    )


def _without_file_seconds(frame: LidarFrame) -> dict[str, object]:
    """The further fields of a sweep whose timestamp moved: the file's own number of it no longer holds."""
    return {name: value for name, value in frame.extras.items() if name != "file_seconds"}


class DeskewedFrames:
    """Reads sweeps and deskews them; what `LazyFrames` asks for a lidar's frames.

    It remembers the point times of the sweep that it read last, which help to judge those of the next one.
    """

    def __init__(
        self,
        frames: LazyFrames[LidarFrame],
        deskewer: Deskewer,
        on_frame: Callable[[int, DeskewedFrame], None] | None = None,
    ) -> None:
        """Hold the sweeps as measured; `on_frame` is reported each one after it was deskewed."""
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
    """The usual time from a sweep's timestamp to a moment of it, judged by a few sweeps spread over the drive.

    One offset for all sweeps keeps their moments as even as their timestamps are, and known without reading them.

    Args:
        at: one of `MOMENTS`.

    Returns:
        The median offset [ns], 0 where no sweep has times that report anything.
    """
    offsets = []
    for k in np.unique(np.linspace(0, len(frames) - 1, min(_LOOKS, len(frames))).astype(int)).tolist():
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
