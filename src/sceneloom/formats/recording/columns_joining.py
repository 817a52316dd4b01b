"""Columns of the parts of a file, put one behind the other.

Each column is put together once, at the end, at its full length: grown part by part it would be copied a dozen times.
"""

from array import array
from typing import Any

import numpy as np

from sceneloom.arrays import UInt16Array
from sceneloom.formats.recording.columns import (
    SEVERAL,
    CameraColumns,
    Columns,
    FrameColumns,
    LidarColumns,
    PoseColumns,
    RecordingColumns,
    SharedLine,
)


class ColumnsJoiner:
    """Puts parts of a file behind what columns hold already; these are whole again after `finish`.

    Attributes:
        columns: those that take all.
        lines: how many lines they and the parts hold.
    """

    def __init__(self, columns: RecordingColumns) -> None:
        """Begin with what the columns hold."""
        self.columns = columns
        self.lines = len(columns.log.codes)
        self._pieces: dict[tuple[int, str], tuple[object, list[array[Any]]]] = {}
        self._lengths = {stream.code: len(stream) for stream in columns.streams().values()}
        self._frames = len(columns.frames.numbers)

    def can_join(self, part: RecordingColumns) -> bool:
        """Whether a part reads as it would behind the others: no first sample of theirs decides otherwise."""
        sensors, log = self.columns.sensors, self.columns.log
        alike = all(
            sensors[name].width == stream.width for name, stream in part.sensors.items() if name in sensors
        )
        return alike and log.last_code + part.log.last_code < (1 << 15)

    def join(self, part: RecordingColumns) -> None:
        """Put a part behind the others; it gives its contents away."""
        codes, rows = self._join_streams(part)
        self._join_frames(part.frames, codes)
        self._join_texts(part)
        log = self.columns.log
        told = array("H", codes[np.frombuffer(part.log.codes, np.uint16)].tobytes())
        self._add(log, "codes", told)
        for line, shared in part.log.shared.items():
            moved = [(int(codes[code]), row + rows[code]) for code, row in shared.rows]
            log.shared[line + self.lines] = SharedLine(shared.text, moved)
        self.lines += len(told)

    def finish(self) -> None:
        """Put each column together."""
        while self._pieces:
            (_, name), (owner, pieces) = self._pieces.popitem()
            setattr(owner, name, _together([getattr(owner, name), *pieces]))

    def _join_streams(self, part: RecordingColumns) -> tuple[UInt16Array, dict[int, int]]:
        """Give by code of a stream in the part its code here, and how many rows it had here before."""
        columns = self.columns
        codes = np.zeros(part.log.last_code + 1, np.uint16)
        codes[: SEVERAL + 1] = range(SEVERAL + 1)
        rows: dict[int, int] = {}

        def take(into: Columns, stream: Columns) -> None:
            if stream.code:
                rows[stream.code] = self._join_stream(into, stream)
                codes[stream.code] = into.code

        for name, stream in part.sensors.items():
            take(columns.sensors.setdefault(name, Columns(stream.width)), stream)
        for origin, stream in part.receivers.items():
            take(columns.receivers.setdefault(origin, Columns(stream.width)), stream)
        take(columns.gnss, part.gnss)
        take(columns.barometer, part.barometer)
        for origin, poses in part.poses.items():
            trajectory = columns.poses.setdefault(origin, PoseColumns())
            take(trajectory.samples, poses.samples)
            self._add(trajectory, "lines", poses.lines, self.lines)
        for index, lidar in part.lidars.items():
            sweeps = columns.lidars.setdefault(index, LidarColumns(lidar.model))
            take(sweeps.sweeps, lidar.sweeps)
            sweeps.files.extend(lidar.files)
            self._add(sweeps, "lines", lidar.lines, self.lines)
        return codes, rows

    def _join_stream(self, into: Columns, stream: Columns) -> int:
        """Give how many rows there were before."""
        into.code = into.code or self.columns.log.new_code()
        into.form = into.form or stream.form
        before = self._lengths.get(into.code, 0)
        into.further.update({row + before: text for row, text in stream.further.items()})
        self._lengths[into.code] = before + len(stream)
        self._add(into, "seconds", stream.seconds)
        self._add(into, "values", stream.values)
        return before

    def _join_frames(self, more: FrameColumns, codes: UInt16Array) -> None:
        frames = self.columns.frames
        if not more.code:
            return
        frames.code = frames.code or self.columns.log.new_code()
        codes[more.code] = frames.code
        texts = np.array([frames.text_index(text) for text in more.texts] or [0], np.int64)
        for index, camera in more.cameras.items():
            into = frames.cameras.setdefault(index, CameraColumns())
            self._add(into, "rows", camera.rows, self._frames)
            self._add(into, "seconds", camera.seconds)
            self._add(into, "missing", camera.missing)
            for name in ("parameters", "mounts"):
                chosen = np.frombuffer(getattr(camera, name), np.int64)
                self._add(into, name, array("q", np.where(chosen < 0, -1, texts[chosen]).tobytes()))
        self._frames += len(more.numbers)
        self._add(frames, "numbers", more.numbers)
        self._add(frames, "seconds", more.seconds)
        self._add(frames, "offsets", more.offsets)
        self._add(frames, "lines", more.lines, self.lines)

    def _join_texts(self, part: RecordingColumns) -> None:
        columns = self.columns
        columns.other_lines.extend(part.other_lines)
        self._add(columns, "other_seconds", part.other_seconds)
        for key, count in part.other_keys.items():
            columns.other_keys[key] = columns.other_keys.get(key, 0) + count

    def _add(self, owner: object, name: str, numbers: "array[Any]", shift: int = 0) -> None:
        """Put numbers behind those of a column, whole ones greater by a shift."""
        if not numbers:
            return
        if shift:
            shifted = np.frombuffer(numbers, np.int64)
            shifted += shift
        self._pieces.setdefault((id(owner), name), (owner, []))[1].append(numbers)


def _together(pieces: "list[array[Any]]") -> "array[Any]":
    if not pieces[0]:
        del pieces[0]
    if len(pieces) == 1:
        return pieces[0]
    whole = pieces[0][:1] * sum(map(len, pieces))
    taken, reached = memoryview(whole), 0
    for piece in pieces:
        taken[reached : reached + len(piece)] = memoryview(piece)
        reached += len(piece)
    return whole
