"""Frames of lidars and radars on their trajectory into a file."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.loss import Support
from sceneloom.formats.sfs.clock_keeper import ClockKeeper, check_timestamps, timestamp_dtype
from sceneloom.formats.sfs.drafts import Losses, SensorDraft, with_further
from sceneloom.formats.sfs.profiles import Profile
from sceneloom.formats.sfs.spool import Blob, Spool
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame
from sceneloom.scene.types import PointsFrame

FARTHEST = 10_000.0
"""float32 resolves about 1 mm there: positions in the world beyond it need a nearer origin [m]."""

_ROUNDING = 0.5
"""How far a time is off at most where it is rounded [µs]."""

_FLOAT_TIMES = "file_seconds"
"""Readers of float seconds keep the file's own number of each point beside its time."""


@dataclass(slots=True)
class CloudWriter:
    """Spools the arrays of frames.

    Attributes:
        spool: takes the arrays.
        profile: says what may be written.
        losses: collects what cannot be held.
        verbatim: the frames come from a file of this format: timestamps and far positions pass as they are.
        keeper: gives the clock.
    """

    spool: Spool
    profile: Profile
    losses: Losses
    verbatim: bool
    keeper: ClockKeeper

    def add_lidar_frame(self, draft: SensorDraft, frame: LidarFrame) -> None:
        """Spool one sweep.

        Raises:
            DataError: positions too far away.
            OptionError: times that the file cannot hold.
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
            DataError: positions too far away.
            OptionError: times that the file cannot hold.
        """
        points = frame.points
        self._check_reach(draft, points.positions)
        lengths = None if points.lengths is None else self.spool.add(points.lengths)
        if not self.profile.radar_lengths:
            draft.lengths.append(lengths)
            if lengths is not None:
                what, kept = "Scale's library cannot load them", "metadata.sceneloom.sensor_notes[].lengths"
                self.losses.add(f"{draft.location}.frames[].points.lengths", what, kept=kept)
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
        extras = frame.points.extras
        further = {name: v for name, v in extras.items() if arrays.get(name) is None} if extras else {}
        if arrays["timestamps"] is not None and further.pop(_FLOAT_TIMES, None) is not None:
            what = "left out: the same times in another form"
            self.losses.add(
                f"{draft.location}.frames[].points.{_FLOAT_TIMES}", what, support=Support.CONVERTED
            )
        blobs = {
            name: self.spool.add(array) if isinstance(array, np.ndarray) else array
            for name, array in ({**arrays, **further} if further else arrays).items()
            if array is not None or name in further
        }
        timestamp_ns = self._frame_timestamp(draft, frame)
        frames = draft.frames if draft.frames is not None else []
        frames.append(with_further({"timestamp": timestamp_ns, "points": blobs}, frame.extras))

    def _frame_timestamp(self, draft: SensorDraft, frame: LidarFrame | RadarFrame) -> int:
        """The start of a frame: its earliest point time, rounded down, so that it is later than no point."""
        times_ns, tick_ns = frame.points.timestamps_ns, self.keeper.tick_ns
        start_ns = frame.timestamp_ns
        if times_ns is not None and len(times_ns) and not (self.verbatim and self.profile.late_frames):
            earliest_ns = int(times_ns.min())
            start_ns = min(start_ns, earliest_ns) if self.verbatim else earliest_ns
        if start_ns // tick_ns != frame.timestamp_ns // tick_ns:
            what = "moved to the earliest point of the frame"
            self.losses.add(f"{draft.location}.frames[].timestamp", what, support=Support.APPROXIMATED)
        if start_ns % tick_ns:
            what, location = "rounded down to a whole microsecond", f"{draft.location}.frames[].timestamp"
            self.losses.add(
                location, what, support=Support.CONVERTED, largest_error=(start_ns % tick_ns) / 1e3
            )
        self.keeper.clock_for(start_ns)
        return start_ns // tick_ns * tick_ns

    def _point_times(self, draft: SensorDraft, times_ns: Int64Array | None) -> Blob | None:
        if times_ns is None or (len(times_ns) == 0 and not self.profile.empty_point_times):
            return None
        clock, span_ns = self.keeper.clock, None
        if len(times_ns):
            span_ns = (int(times_ns.min()), int(times_ns.max()))
            clock = self.keeper.clock_for(span_ns[0])
            location = f"{draft.location}.frames[{len(draft.frames or [])}]"
            check_timestamps(*clock.timestamps_of_span(*span_ns), clock, location)
        timestamps, inexact = clock.timestamp_array(times_ns, dtype=timestamp_dtype(clock), span_ns=span_ns)
        what = "rounded to whole microseconds, halves to even: at most 0.5 µs off"
        location = f"{draft.location}.frames[].points.timestamps"
        self.losses.add(location, what, count=inexact, support=Support.CONVERTED, largest_error=_ROUNDING)
        blob = self.spool.add(timestamps)
        draft.point_times.append(blob)
        return blob

    def _check_reach(self, draft: SensorDraft, positions: Float32Array) -> None:
        if self.verbatim or draft.points_frame != PointsFrame.WORLD or len(positions) == 0:
            return
        # two passes without a copy; where a number is none, both are, and the slow way follows
        if float(positions.min()) >= -FARTHEST and float(positions.max()) <= FARTHEST:
            return
        distances = np.abs(positions)
        # a point that is infinitely far is no point, as one that is no number
        farthest = float(np.max(distances, initial=0.0, where=np.isfinite(distances)))
        if farthest > FARTHEST:
            row = int(np.flatnonzero((distances == farthest).any(axis=1))[0])
            raise DataError(
                "",
                f"{draft.location}.frames[{len(draft.frames or [])}].points.positions[{row}]",
                f"{farthest:.6g} m from the origin; float32 holds millimetres up to {FARTHEST:.0f} m: take the point "
                "out if it is wrong, else write the drive in parts, each with an origin of its own (of a recording "
                "`sceneloom fuse` with `--start`, `--stop`)",
            )
