"""Sweeps of a drive with the times at which they began, looked ahead and ended."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array
from sceneloom.formats.kitti.raw.stamps import format_stamp
from sceneloom.formats.kitti.scenes.sweeps import times_in_turn
from sceneloom.formats.kitti.written.choice import Choice
from sceneloom.formats.kitti.written.files import SweepFiles
from sceneloom.formats.loss import Fate, Loss
from sceneloom.scene.clouds import LidarFrame

_WELL_TOLD = 0.05
"""Times that directions tell worse than this share of a turn are not those of such a scanner, and are not told."""

_NAMES = ("timestamps_start.txt", "timestamps.txt", "timestamps_end.txt")


@dataclass(slots=True)
class TurnWriter:
    """Writes sweeps and remembers their times.

    Attributes:
        choice: what is written.
        folder: `velodyne_points`.
    """

    choice: Choice
    folder: Path
    _files: SweepFiles = field(init=False)
    _turns: list[tuple[int, int, int] | None] = field(default_factory=list)
    _starts: list[int] = field(default_factory=list)
    _turned: bool = True
    _worst_ns: int = 0
    _timed_points: int = 0

    def __post_init__(self) -> None:
        self._files = SweepFiles(self.choice)
        (self.folder / "data").mkdir(parents=True)

    def write(self, frame: LidarFrame, number: int) -> None:
        """Write a sweep; frames without one have blank lines."""
        self._turns += [None] * (number - len(self._turns))
        frame = self._files.placed(frame)
        positions = self._files.write(frame, self.folder / "data" / f"{number:010d}.bin")
        self._turns.append(self._turn(frame, positions))
        self._starts.append(frame.timestamp_ns)

    def _turn(self, frame: LidarFrame, positions: Float32Array) -> tuple[int, int, int]:
        """When a sweep began, looked ahead and ended [ns]; of points without times all are its own time."""
        times = frame.points.timestamps_ns
        start = frame.timestamp_ns
        forward, end = frame.extras.get("forward_ns"), frame.extras.get("end_ns")
        if times is None or not len(times) or times.min() == times.max():
            if isinstance(forward, int) and isinstance(end, int):
                return start, forward, end
            self._turned = False
            return start, start, start
        if not (isinstance(forward, int) and isinstance(end, int) and start <= forward <= end):
            start = min(start, int(times.min()))
            forward, end = frame.reference_ns, max(int(times.max()), frame.reference_ns)
        error = int(np.abs(times_in_turn(positions, start, forward, end) - times).max())
        self._turned = self._turned and error <= _WELL_TOLD * max(end - start, 1)
        self._worst_ns = max(self._worst_ns, error)
        self._timed_points += len(times)
        return start, forward, end

    def moments_ns(self, frames_ns: Int64Array) -> Int64Array:
        """Times of frames as `timestamps.txt` tells them, (F,) int64 [ns]; of those without a sweep as given."""
        told = frames_ns.copy()
        for number, turn in enumerate(self._turns):
            if turn is not None:
                told[number] = turn[1]
        return told

    def close(self) -> list[Loss]:
        """Write the times; starts and ends only where they tell those of points. Gives what was lost."""
        for column, name in enumerate(_NAMES):
            if self._turned or name == "timestamps.txt":
                lines = ["" if turn is None else format_stamp(turn[column]) for turn in self._turns]
                (self.folder / name).write_text("".join(f"{line}\n" for line in lines), "utf-8", newline="\n")
        return [*self._files.losses, *self._time_losses()]

    def _time_losses(self) -> list[Loss]:
        losses = []
        name = "sensors.lidar.frames.points.timestamps_ns"
        if self._timed_points and not self._turned:
            what = "left out: a drive tells times of points by one counter-clockwise turn from behind, and these differ"
            losses.append(Loss(field=name, what=what, count=self._timed_points))
        elif self._worst_ns:
            what = "told by the directions of points in one turn, counter-clockwise from behind [s]"
            worst = self._worst_ns / 1e9
            losses.append(
                Loss(
                    field=name,
                    what=what,
                    count=self._timed_points,
                    fate=Fate.APPROXIMATED,
                    largest_error=worst,
                )
            )
        column = 0 if self._turned else 1
        told = [turn[column] for turn in self._turns if turn is not None]
        away = [abs(a - b) for a, b in zip(told, self._starts, strict=True)]
        if any(away):
            what = "the moment of the sweep in place of its start [s]"
            losses.append(
                Loss(
                    field="sensors.lidar.frames.timestamp_ns",
                    what=what,
                    count=sum(map(bool, away)),
                    fate=Fate.APPROXIMATED,
                    largest_error=max(away) / 1e9,
                )
            )
        return losses
