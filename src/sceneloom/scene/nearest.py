"""Which frame of a sensor belongs to a time."""

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.scene.cameras import Picture
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.depth import DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import timed_frame

Stamped = TypeVar("Stamped", Picture, DepthFrame, RadarFrame)

NONE = "it has no frames"


class FramesByStamp(Generic[Stamped]):
    """Frames that are found by their time stamps; these need not be in order."""

    def __init__(self, frames: LazyFrames[Stamped]) -> None:
        """Take the frames; nothing is read."""
        self.frames: LazyFrames[Stamped] = frames
        self._stamps_ns: Int64Array = frames.timestamps_ns
        self._rows: Sequence[int] = range(len(frames))
        if (self._stamps_ns[1:] < self._stamps_ns[:-1]).any():
            order = np.argsort(self._stamps_ns, kind="stable")
            self._stamps_ns, self._rows = self._stamps_ns[order], order.tolist()

    def read(self, index: int) -> tuple[Stamped, int]:
        """Read a frame, and tell its time [ns]."""
        frame = self.frames[index]
        return frame, frame.timestamp_ns

    def find(self, time_ns: int, tolerance_ns: int) -> tuple[Stamped, int] | str:
        """Read the frame nearest in time, the earlier one of two; or say why there is none.

        Raises:
            DataError: it cannot be read.
        """
        row = self._nearest(time_ns)
        if row is None:
            return NONE
        away_ns = abs(int(self._stamps_ns[row]) - time_ns)
        return self.read(self._rows[row]) if away_ns <= tolerance_ns else too_far(away_ns, tolerance_ns)

    def _nearest(self, time_ns: int) -> int | None:
        stamps = self._stamps_ns
        if len(stamps) == 0:
            return None
        after = int(np.searchsorted(stamps, time_ns))
        if after == 0:
            return 0
        before_ns = int(stamps[after - 1])
        if after < len(stamps) and int(stamps[after]) - time_ns < time_ns - before_ns:
            return after
        # of frames with the same stamp the first one counts
        return int(np.searchsorted(stamps, before_ns))


class SweepsByReference:
    """Sweeps of a lidar that are found by their reference times, which only the sweeps themselves tell.

    What was learnt of a sweep's time is kept, a number for each; the sweeps are not.
    """

    def __init__(self, frames: LazyFrames[LidarFrame], period_ns: int) -> None:
        """Take the sweeps, in the order of their stamps, and the usual time from one to the next; nothing is read."""
        self.frames = frames
        self._period_ns = period_ns
        self._known: dict[int, int] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_known": {}}

    def read(self, index: int) -> tuple[LidarFrame, int]:
        """Read a sweep, its point times brought onto the scene's clock, and tell its reference time [ns].

        Raises:
            DataError: the sweep cannot be read.
        """
        frame = timed_frame(self.frames[index], self._period_ns).frame
        self._known[index] = frame.reference_ns
        return frame, frame.reference_ns

    def find(self, time_ns: int, tolerance_ns: int) -> tuple[LidarFrame, int] | str:
        """Read the sweep whose reference time is nearest, the earlier one of two; or say why there is none.

        Sweeps around that time whose reference times are not known yet are read for them. A reference time is taken to
        be no earlier than its sweep's stamp, and reference times to be in the order of the stamps.

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
        stamps = self.frames.timestamps_ns
        away_ns = abs(time_ns - self._reference_ns(index, held))
        if index + 1 == len(stamps) or int(stamps[index + 1]) - time_ns >= away_ns:
            return False
        return abs(time_ns - self._reference_ns(index + 1, held)) < away_ns

    def _reference_ns(self, index: int, held: dict[int, LidarFrame]) -> int:
        if index not in self._known:
            held[index], self._known[index] = self.read(index)
        return self._known[index]


def too_far(away_ns: int, tolerance_ns: int) -> str:
    """Say that the nearest frame is not near enough."""
    return f"its nearest frame is {away_ns / 1e9:.3f} s away; expected at most {tolerance_ns / 1e9:.3f} s"
