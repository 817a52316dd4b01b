"""Columns of one part of a file, put behind those of all parts before it."""

from array import array

import numpy as np

from sceneloom.formats.recording.columns import (
    SEVERAL,
    CameraColumns,
    Columns,
    LidarColumns,
    PoseColumns,
    RecordingColumns,
    SharedLine,
)


def can_join(columns: RecordingColumns, part: RecordingColumns) -> bool:
    """Whether the part reads as it would behind the others: what a first sample decides was not decided otherwise."""
    alike = all(
        columns.sensors[name].width == stream.width
        for name, stream in part.sensors.items()
        if name in columns.sensors
    )
    return alike and columns.log.last_code + part.log.last_code < (1 << 15)


def join(columns: RecordingColumns, part: RecordingColumns) -> None:
    """Put a part behind the others; it gives its contents away."""
    lines = len(columns.log.codes)
    codes = np.zeros(part.log.last_code + 1, np.uint16)
    codes[: SEVERAL + 1] = range(SEVERAL + 1)
    rows: dict[int, int] = {}

    def take(into: Columns, stream: Columns) -> None:
        if not stream.code:
            return
        into.code = into.code or columns.log.new_code()
        codes[stream.code] = into.code
        rows[stream.code] = len(into)
        into.form = into.form or stream.form
        into.further.update({row + len(into): text for row, text in stream.further.items()})
        into.seconds.extend(stream.seconds)
        into.values.extend(stream.values)

    for name, stream in part.sensors.items():
        take(columns.sensors.setdefault(name, Columns(stream.width)), stream)
    for origin, stream in part.receivers.items():
        take(columns.receivers.setdefault(origin, Columns(stream.width)), stream)
    take(columns.gnss, part.gnss)
    take(columns.barometer, part.barometer)
    for origin, poses in part.poses.items():
        trajectory = columns.poses.setdefault(origin, PoseColumns())
        take(trajectory.samples, poses.samples)
        _extend(trajectory.lines, poses.lines, lines)
    for index, lidar in part.lidars.items():
        sweeps = columns.lidars.setdefault(index, LidarColumns(lidar.model))
        take(sweeps.sweeps, lidar.sweeps)
        sweeps.files.extend(lidar.files)
        _extend(sweeps.lines, lidar.lines, lines)
    _join_frames(columns, part, codes, lines)
    _join_texts(columns, part)
    columns.log.codes.frombytes(codes[np.frombuffer(part.log.codes, np.uint16)].tobytes())
    for line, shared in part.log.shared.items():
        moved = [(int(codes[code]), row + rows[code]) for code, row in shared.rows]
        columns.log.shared[line + lines] = SharedLine(shared.text, moved)


def _join_frames(
    columns: RecordingColumns,
    part: RecordingColumns,
    codes: "np.ndarray[tuple[int], np.dtype[np.uint16]]",
    lines: int,
) -> None:
    frames, more = columns.frames, part.frames
    if not more.code:
        return
    frames.code = frames.code or columns.log.new_code()
    codes[more.code] = frames.code
    before = len(frames.numbers)
    texts = np.array([frames.text_index(text) for text in more.texts] or [0], np.int64)
    for index, camera in more.cameras.items():
        into = frames.cameras.setdefault(index, CameraColumns())
        _extend(into.rows, camera.rows, before)
        into.seconds.extend(camera.seconds)
        into.missing.extend(camera.missing)
        for name in ("parameters", "mounts"):
            chosen = np.frombuffer(getattr(camera, name), np.int64)
            getattr(into, name).frombytes(np.where(chosen < 0, -1, texts[chosen]).tobytes())
    frames.numbers.extend(more.numbers)
    frames.seconds.extend(more.seconds)
    frames.offsets.extend(more.offsets)
    _extend(frames.lines, more.lines, lines)


def _join_texts(columns: RecordingColumns, part: RecordingColumns) -> None:
    columns.other_lines.extend(part.other_lines)
    columns.other_seconds.extend(part.other_seconds)
    for key, count in part.other_keys.items():
        columns.other_keys[key] = columns.other_keys.get(key, 0) + count


def _extend(numbers: "array[int]", more: "array[int]", shift: int) -> None:
    if more:
        numbers.frombytes((np.frombuffer(more, np.int64) + shift).tobytes())
