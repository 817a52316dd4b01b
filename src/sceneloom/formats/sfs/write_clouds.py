"""Frames of lidars and radars on their way into a file."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.formats.sfs.drafts import Losses, SensorDraft, with_further
from sceneloom.formats.sfs.profiles import Profile
from sceneloom.formats.sfs.spool import Blob, Spool
from sceneloom.formats.sfs.times import UINT32_MAX, UINT64_MAX, FileClock
from sceneloom.scene import LidarFrame, LidarPoints, PointsFrame, RadarFrame

FARTHEST = 10_000.0
"""float32 resolves about 1 mm there: positions in the world beyond it need a nearer origin [m]."""

_FLOAT_TIMES = "file_seconds"
"""Readers of float seconds keep the file's own number of each point beside its time."""


@dataclass(slots=True)
class CloudWriter:
    """Spools the arrays of frames.

    Attributes:
        spool: takes the arrays.
        profile: says what may be written.
        losses: collects what cannot be held.
        verbatim: the frames come from a file of this format: stamps and far positions pass as they are.
        clock_for: gives the clock that can hold times from the given one on.
    """

    spool: Spool
    profile: Profile
    losses: Losses
    verbatim: bool
    clock_for: Callable[[int], FileClock]

    def add_lidar_frame(self, draft: SensorDraft, frame: LidarFrame) -> None:
        """Spool one sweep.

        Raises:
            OptionError: positions too far away, or times that the file cannot hold.
        """
        points = frame.points
        self._check_reach(draft, points.positions)
        arrays = {
            "positions": points.positions,
            "colors": points.colors,
            "intensities": points.intensities,
            "timestamps": self._point_times(draft, points.timestamps_ns),
            "ring": points.rings,
            "camera_index": points.camera_index,
        }
        self._add(draft, frame, arrays)

    def add_radar_frame(self, draft: SensorDraft, frame: RadarFrame) -> None:
        """Spool one cycle.

        Raises:
            OptionError: positions too far away, or times that the file cannot hold.
        """
        points = frame.points
        self._check_reach(draft, points.positions)
        lengths = None if points.lengths is None else self.spool.add(points.lengths)
        if not self.profile.radar_lengths:
            draft.lengths.append(lengths)
            if lengths is not None:
                what, kept = "Scale's library cannot load them", "metadata.sceneloom.sensor_notes[].lengths"
                self.losses.add(f"{draft.place}.frames[].points.lengths", what, kept=kept)
            lengths = None
        arrays = {
            "positions": points.positions,
            "directions": points.directions,
            "lengths": lengths,
            "timestamps": self._point_times(draft, points.timestamps_ns),
        }
        self._add(draft, frame, arrays)

    def unfused_points(self, points: LidarPoints) -> dict[str, Any]:
        """Spool points that stand, in their sensor's frame, under our metadata."""
        arrays = {
            "positions": points.positions,
            "colors": points.colors,
            "intensities": points.intensities,
            "timestamps_ns": points.timestamps_ns,
            "ring": points.rings,
        }
        return {name: self.spool.add(array) for name, array in arrays.items() if array is not None}

    def _add(self, draft: SensorDraft, frame: LidarFrame | RadarFrame, arrays: dict[str, Any]) -> None:
        further = {name: array for name, array in frame.points.extras.items() if arrays.get(name) is None}
        if arrays["timestamps"] is not None and further.pop(_FLOAT_TIMES, None) is not None:
            what = "left out: the same times in another form"
            self.losses.add(f"{draft.place}.frames[].points.{_FLOAT_TIMES}", what)
        blobs = {
            name: self.spool.add(array) if isinstance(array, np.ndarray) else array
            for name, array in {**arrays, **further}.items()
            if array is not None or name in further
        }
        stamp_ns = self._frame_stamp(draft, frame)
        frames = draft.frames if draft.frames is not None else []
        frames.append(with_further({"timestamp": stamp_ns, "points": blobs}, frame.extras))

    def _frame_stamp(self, draft: SensorDraft, frame: LidarFrame | RadarFrame) -> int:
        """The start of a frame: its earliest point time, rounded down, so that it is later than no point."""
        times_ns = frame.points.timestamps_ns
        start_ns = frame.timestamp_ns
        if times_ns is not None and len(times_ns):
            earliest_ns = int(times_ns.min())
            if not self.verbatim and start_ns < earliest_ns:
                self.losses.add(
                    f"{draft.place}.frames[].timestamp", "moved to the earliest point of the frame"
                )
            start_ns = min(start_ns, earliest_ns) if self.verbatim else earliest_ns
        tick_ns = self.clock_for(start_ns).tick_ns
        if start_ns % tick_ns:
            self.losses.add(f"{draft.place}.frames[].timestamp", "rounded down to a whole microsecond")
        return start_ns // tick_ns * tick_ns

    def _point_times(self, draft: SensorDraft, times_ns: Int64Array | None) -> Blob | None:
        if times_ns is None or (len(times_ns) == 0 and not self.profile.empty_point_times):
            return None
        clock = (
            self.clock_for(int(times_ns.min()) if len(times_ns) else 0)
            if len(times_ns)
            else self.clock_for_none()
        )
        stamps, inexact = clock.stamp_array(times_ns)
        what = "rounded to whole microseconds, halves to even: at most 0.5 µs off"
        self.losses.add(f"{draft.place}.frames[].points.timestamps", what, count=inexact)
        check_stamps(stamps, clock, f"{draft.place}.frames[{len(draft.frames or [])}]")
        blob = self.spool.add(stamps.astype(stamp_dtype(clock)))
        draft.point_times.append(blob)
        return blob

    def clock_for_none(self) -> FileClock:
        """A clock for an array without times: only its unit counts."""
        return FileClock(self.clock_for(0).tick_ns, 0)

    def _check_reach(self, draft: SensorDraft, positions: Float32Array) -> None:
        if self.verbatim or draft.points_frame != PointsFrame.WORLD or len(positions) == 0:
            return
        farthest = float(np.nanmax(np.abs(positions), initial=0.0))
        if farthest > FARTHEST:
            raise OptionError(
                f"{draft.place}.frames[{len(draft.frames or [])}].points.positions: {farthest:.0f} m from the origin; "
                f"float32 holds millimetres up to {FARTHEST:.0f} m: move the origin, for instance to the first pose"
            )


def stamp_dtype(clock: FileClock) -> type[np.unsignedinteger[Any]]:
    """The dtype of point times: uint64 where the unit is the nanosecond. Source: "Lidar Sensor" of the description."""
    return np.uint64 if clock.tick_ns == 1 else np.uint32


def check_stamps(stamps: Int64Array, clock: FileClock, place: str) -> None:
    """Refuse point times that the file's integers cannot hold.

    Raises:
        OptionError: naming what would hold them.
    """
    limit = UINT64_MAX if clock.tick_ns == 1 else UINT32_MAX
    if stamps.size and (int(stamps.min()) < 0 or int(stamps.max()) > limit):
        seconds = (int(stamps.min()) if int(stamps.min()) < 0 else int(stamps.max())) * clock.tick_ns / 1e9
        raise OptionError(
            f"{place}.points.timestamps: {seconds:.3f} s after the clock's zero; microseconds in 32 bits hold 0 to "
            "4294.967 s: choose another time offset, or `--time-unit nanoseconds`"
        )
