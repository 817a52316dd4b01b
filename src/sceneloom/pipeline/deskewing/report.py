"""What a deskewing did, in numbers."""

from dataclasses import dataclass, field

import msgspec
import numpy as np

from sceneloom.formats.loss import LossReport
from sceneloom.motion.one_moment import DeskewedFrame
from sceneloom.motion.point_time_warnings import PointTimesStatistics
from sceneloom.scene.types import Identifier, Progress
from sceneloom.scene.warnings import DataWarning


class DeskewReport(msgspec.Struct, frozen=True, kw_only=True):
    """One deskewing.

    Attributes:
        source: what was read.
        output: what was written.
        trajectory: name of the ego trajectory, or None where the lidars' own poses were used.
        at: the moment of each sweep that its points were brought to: "start", "middle" or "end".
        lidars: the lidars that were deskewed.
        sweeps: how many they have.
        deskewed: sweeps whose points were brought to one moment.
        extrapolated: those of them that needed poses beyond the trajectory's ends.
        left: why the others stayed as they were, with counts.
        skipped: sweeps that could not be read, one line each.
        points: points of the deskewed sweeps whose location is a number.
        mean_shift, max_shift: how far these were moved [m].
        seconds: how long it took.
        losses: what the output could not hold.
        warnings: what was assumed, repaired or left out.
    """

    source: str
    output: str
    trajectory: str | None
    at: str
    lidars: tuple[Identifier, ...]
    sweeps: int
    deskewed: int
    extrapolated: int
    left: dict[str, int]
    skipped: tuple[str, ...]
    points: int
    mean_shift: float
    max_shift: float
    seconds: float
    losses: LossReport
    warnings: tuple[DataWarning, ...]


@dataclass(slots=True)
class DeskewStatistics:
    """Counts what became of the sweeps; each counts once, however often it is read."""

    deskewed: int = 0
    extrapolated: int = 0
    points: int = 0
    shifted: float = 0.0
    farthest: float = 0.0
    left: dict[str, int] = field(default_factory=dict)
    times: PointTimesStatistics = field(default_factory=PointTimesStatistics)
    seen: set[tuple[type, Identifier, int]] = field(default_factory=set)

    def add(
        self,
        sensor_id: Identifier,
        k: int,
        frame: DeskewedFrame,
        *,
        progress: Progress | None,
        total: int,
    ) -> None:
        """Count sweep `k` of a sensor, and report how many of all are done."""
        key = (type(sensor_id), sensor_id, k)
        if key in self.seen:
            return
        self.seen.add(key)
        self._count(frame)
        if progress is not None:
            progress(len(self.seen), total)

    def _count(self, frame: DeskewedFrame) -> None:
        self.times.add(frame.times)
        if frame.left is not None:
            self.left[frame.left] = self.left.get(frame.left, 0) + 1
            return
        self.deskewed += 1
        self.extrapolated += frame.extrapolated
        shifts = frame.shifts[np.isfinite(frame.shifts)]
        self.points += len(shifts)
        self.shifted += float(shifts.sum())
        self.farthest = max(self.farthest, float(shifts.max(initial=0.0)))
