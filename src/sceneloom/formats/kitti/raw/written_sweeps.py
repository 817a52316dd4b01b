"""Sweeps of a drive with the times at which they began, looked ahead and ended."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array
from sceneloom.formats.kitti.raw.timestamps import format_timestamp
from sceneloom.formats.kitti.scenes.sweeps import times_in_rotation
from sceneloom.formats.kitti.written.choice import Choice
from sceneloom.formats.kitti.written.files import SweepFiles
from sceneloom.formats.loss import Loss, Support
from sceneloom.scene.clouds import LidarFrame

_WELL_REPORTED = 0.05
"""Times that directions report worse than this share of a rotation are not those of such a scanner.

And are not reported.
"""

_NAMES = ("timestamps_start.txt", "timestamps.txt", "timestamps_end.txt")


@dataclass(slots=True)
class RotationWriter:
    """Writes sweeps and remembers their times.

    Attributes:
        choice: what is written.
        folder: `velodyne_points`.
    """

    choice: Choice
    folder: Path
    _files: SweepFiles = field(init=False)
    _rotations: list[tuple[int, int, int] | None] = field(default_factory=list)
    _starts: list[int] = field(default_factory=list)
    _rotated: bool = True
    _worst_ns: int = 0
    _timed_points: int = 0

    def __post_init__(self) -> None:
        self._files = SweepFiles(self.choice)
        (self.folder / "data").mkdir(parents=True)

    def write(self, frame: LidarFrame, number: int) -> None:
        """Write a sweep; frames without one have blank lines."""
        self._rotations += [None] * (number - len(self._rotations))
        frame = self._files.placed(frame)
        positions = self._files.write(frame, self.folder / "data" / f"{number:010d}.bin")
        self._rotations.append(self._rotation(frame, positions))
        self._starts.append(frame.timestamp_ns)

    def _rotation(self, frame: LidarFrame, positions: Float32Array) -> tuple[int, int, int]:
        """When a sweep began, looked ahead and ended [ns]; of points without times all are its own time."""
        times = frame.points.timestamps_ns
        start = frame.timestamp_ns
        forward, end = frame.extras.get("forward_ns"), frame.extras.get("end_ns")
        if times is None or not len(times) or times.min() == times.max():
            if isinstance(forward, int) and isinstance(end, int):
                return start, forward, end
            self._rotated = False
            return start, start, start
        if not (isinstance(forward, int) and isinstance(end, int) and start <= forward <= end):
            start = min(start, int(times.min()))
            forward, end = frame.reference_ns, max(int(times.max()), frame.reference_ns)
        error = int(np.abs(times_in_rotation(positions, start, forward, end) - times).max())
        self._rotated = self._rotated and error <= _WELL_REPORTED * max(end - start, 1)
        self._worst_ns = max(self._worst_ns, error)
        self._timed_points += len(times)
        return start, forward, end

    def moments_ns(self, frames_ns: Int64Array) -> Int64Array:
        """Times of frames as `timestamps.txt` reports them, (F,) int64 [ns]; of those without a sweep as given."""
        reported = frames_ns.copy()
        for number, rotation in enumerate(self._rotations):
            if rotation is not None:
                reported[number] = rotation[1]
        return reported

    def close(self) -> list[Loss]:
        """Write the times; starts and ends only where they report those of points. Gives what was lost."""
        for column, name in enumerate(_NAMES):
            if self._rotated or name == "timestamps.txt":
                lines = [
                    "" if rotation is None else format_timestamp(rotation[column])
                    for rotation in self._rotations
                ]
                (self.folder / name).write_text("".join(f"{line}\n" for line in lines), "utf-8", newline="\n")
        return [*self._files.losses, *self._time_losses()]

    def _time_losses(self) -> list[Loss]:
        losses = []
        name = "sensors.lidar.frames.points.timestamps_ns"
        if self._timed_points and not self._rotated:
            what = "left out: a drive reports times of points by one counter-clockwise rotate from behind, and these differ"
            losses.append(Loss(field=name, what=what, count=self._timed_points))
        elif self._worst_ns:
            what = "reported by the directions of points in one rotation, counter-clockwise from behind [s]"
            worst = self._worst_ns / 1e9
            losses.append(
                Loss(
                    field=name,
                    what=what,
                    count=self._timed_points,
                    support=Support.APPROXIMATED,
                    largest_error=worst,
                )
            )
        column = 0 if self._rotated else 1
        reported = [rotation[column] for rotation in self._rotations if rotation is not None]
        away = [abs(a - b) for a, b in zip(reported, self._starts, strict=True)]
        if any(away):
            what = "the moment of the sweep in location of its start [s]"
            losses.append(
                Loss(
                    field="sensors.lidar.frames.timestamp_ns",
                    what=what,
                    count=sum(map(bool, away)),
                    support=Support.APPROXIMATED,
                    largest_error=max(away) / 1e9,
                )
            )
        return losses
