"""Lidar sweeps as if all their points had been measured at one moment."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array
from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import BodyKnots
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import LONGEST_LAG_NS, RawTimes, TimedFrame, TimesFound, timed_frame
from sceneloom.scene.pose_source import PoseSource

MEASURED = "measured_timestamps_ns"
"""Name of the further array of a deskewed sweep's points that says when each was measured [ns]."""

LEFT_SKEWED = "left_skewed"
"""Name of the further field of a sweep that says why it could not be deskewed."""

EMPTY = "no points"
INSTANT = "all points of one time"
UNTIMED = "no times of the points"
IN_GAP = "in a gap of the measured motion"
BEYOND = "beyond the trajectory"
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
            return _left(timed, measured, moment_ns, IN_GAP)
        try:
            knots = BodyKnots.of(self.source, first_ns, last_ns)
        except PoseError:
            return _left(timed, measured, moment_ns, BEYOND)
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
        return EMPTY
    if times is None:
        return UNTIMED
    return INSTANT if times.min() == times.max() else None


def _measured(frame: LidarFrame) -> Int64Array:
    times = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if times is None else times


def _at_moment(
    frame: LidarFrame, positions: Float32Array, measured_ns: Int64Array, moment_ns: int
) -> LidarFrame:
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
    if reason not in {INSTANT, EMPTY}:
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
