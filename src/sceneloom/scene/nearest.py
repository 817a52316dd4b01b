"""Which frame of a sensor belongs to a time."""

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.depth import DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import timed_frame

Timestamped = TypeVar("Timestamped", CameraImage, DepthFrame, RadarFrame)

NONE = "it has no frames"


class FramesByTimestamp(Generic[Timestamped]):
    """Frames that are found by their timestamps; these need not be in order."""

    def __init__(self, frames: LazyFrames[Timestamped]) -> None:
        """Take the frames; nothing is read."""
        self.frames: LazyFrames[Timestamped] = frames
        self._timestamps_ns: Int64Array = frames.timestamps_ns
        self._rows: Sequence[int] = range(len(frames))
        if (self._timestamps_ns[1:] < self._timestamps_ns[:-1]).any():
            order = np.argsort(self._timestamps_ns, kind="stable")
            self._timestamps_ns, self._rows = self._timestamps_ns[order], order.tolist()

    def read(self, index: int) -> tuple[Timestamped, int]:
        """Read a frame, and notify its time [ns]."""
        frame = self.frames[index]
        return frame, frame.timestamp_ns

    def find(self, time_ns: int, tolerance_ns: int) -> tuple[Timestamped, int] | str:
        """Read the frame nearest in time, the earlier one of two; or state why there is none.

        Raises:
            DataError: it cannot be read.
        """
        row = self._nearest(time_ns)
        if row is None:
            return NONE
        away_ns = abs(int(self._timestamps_ns[row]) - time_ns)
        return self.read(self._rows[row]) if away_ns <= tolerance_ns else too_far(away_ns, tolerance_ns)

    def _nearest(self, time_ns: int) -> int | None:
        timestamps = self._timestamps_ns
        if len(timestamps) == 0:
            return None
        after = int(np.searchsorted(timestamps, time_ns))
        if after == 0:
            return 0
        before_ns = int(timestamps[after - 1])
        if after < len(timestamps) and int(timestamps[after]) - time_ns < time_ns - before_ns:
            return after
        # of frames with the same timestamp the first one counts
        return int(np.searchsorted(timestamps, before_ns))


class SweepsByReference:
    """Sweeps of a lidar that are found by their reference times, which only the sweeps themselves report.

    What was learnt of a sweep's time is kept, a number for each; the sweeps are not.
    """

    def __init__(self, frames: LazyFrames[LidarFrame], period_ns: int) -> None:
        """Take the sweeps, in the order of their timestamps, and the usual time from one to the next.

        Nothing is read.
        """
        self.frames = frames
        self._period_ns = period_ns
        self._known: dict[int, int] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_known": {}}

    def read(self, index: int) -> tuple[LidarFrame, int]:
        """Read a sweep, its point times brought onto the scene's clock, and report its reference time [ns].

        Raises:
            DataError: the sweep cannot be read.
        """
        frame = timed_frame(self.frames[index], self._period_ns).frame
        self._known[index] = frame.reference_ns
        return frame, frame.reference_ns

    def find(self, time_ns: int, tolerance_ns: int) -> tuple[LidarFrame, int] | str:
        """Read the sweep whose reference time is nearest, the earlier one of two; or state why there is none.

        Sweeps around that time whose reference times are not known yet are read for them. A reference time is taken to
        be no earlier than its sweep's timestamp, and reference times to be in the order of the timestamps.

        Raises:
            DataError: a sweep cannot be read.
        """
        if len(self.frames) == 0:
            return NONE
        held: dict[int, LidarFrame] = {}
        index = max(int(np.searchsorted(self.frames.timestamps_ns, time_ns, side="right")) - 1, 0)
        while index > 0 and self._reference_ns(index, held) > time_ns:
            index -= 1
        while self._next_is_nearer(index, time_ns, held):
            index += 1
        reference_ns = self._reference_ns(index, held)
        away_ns = abs(reference_ns - time_ns)
        if away_ns > tolerance_ns:
            return too_far(away_ns, tolerance_ns)
        return (held[index], reference_ns) if index in held else self.read(index)

    def _next_is_nearer(self, index: int, time_ns: int, held: dict[int, LidarFrame]) -> bool:
        timestamps = self.frames.timestamps_ns
        away_ns = abs(time_ns - self._reference_ns(index, held))
        if index + 1 == len(timestamps) or int(timestamps[index + 1]) - time_ns >= away_ns:
            return False
        return abs(time_ns - self._reference_ns(index + 1, held)) < away_ns

    def _reference_ns(self, index: int, held: dict[int, LidarFrame]) -> int:
        if index not in self._known:
            held[index], self._known[index] = self.read(index)
        return self._known[index]


def too_far(away_ns: int, tolerance_ns: int) -> str:
    """Report that the nearest frame is not near enough."""
    return f"its nearest frame is {away_ns / 1e9:.3f} s away; expected at most {tolerance_ns / 1e9:.3f} s"
