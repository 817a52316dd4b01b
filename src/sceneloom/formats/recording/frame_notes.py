"""What `frames` lines were, where the images alone do not report it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.files import open_file
from sceneloom.formats.recording.column_arrays import nanoseconds, time_order, view
from sceneloom.formats.recording.columns import FrameColumns


class FrameNotes(msgspec.Struct):
    """What is kept of the `frames` lines of a recording.

    Attributes:
        count: how many there are.
        first: `number` of the first one, where each has one more than the one before in the order of time; else None.
        own: whether images share lines, or lines have times, in another way than images of their times would.
        texts: lines that lack the image of a camera, in the order of time.
    """

    count: int
    first: int | None = None
    own: bool = False
    texts: list[str] = []


def frame_notes(frames: FrameColumns, data_path: Path) -> dict[str, Any] | None:
    """Find out what has to be kept of `frames` lines so that they can be written as they were.

    Args:
        frames: the lines.
        data_path: the file that they are in.

    Returns:
        The fields of `FrameNotes`; None where the lines are what would be written anyway.
    """
    if not frames.numbers or not frames.cameras:
        return None
    seconds = view(frames.seconds)
    order = time_order(seconds)
    numbers = np.asarray(frames.numbers, np.int64)[order]
    consecutive = bool((numbers == numbers[0] + np.arange(len(numbers))).all())
    times = _image_times(frames)[order]
    lacking = order[np.isnan(times).any(axis=1)].tolist()
    own = bool(lacking) or not _would_be_grouped(times, seconds[order])
    if consecutive and numbers[0] == 0 and not own:
        return None
    note: dict[str, Any] = {"count": len(numbers), "own": own}
    if consecutive:
        note["first"] = int(numbers[0])
    if lacking:
        note["texts"] = _texts(frames, lacking, data_path)
    return note


def _image_times(frames: FrameColumns) -> Float64Array:
    """Times of the images of each line and camera, (L, C) float64 [s], NaN where there is none."""
    times = np.full((len(frames.numbers), len(frames.cameras)), np.nan)
    for location, camera in enumerate(frames.cameras.values()):
        seconds = np.where(np.asarray(camera.missing, np.bool_), np.nan, view(camera.seconds))
        times[np.asarray(camera.rows, np.int64), location] = seconds
    return times


def _would_be_grouped(times: Float64Array, seconds: Float64Array) -> bool:
    """Whether it is sure that images of these times come into these lines, with these times, by themselves.

    Args:
        times: (L, C) float64 [s], of the images, none missing.
        seconds: (L,) float64 [s], of the lines, ascending.
    """
    if not np.array_equal(times.min(axis=1), seconds):
        return False
    if times.shape[1] == 1:
        return True
    timestamps: Int64Array = nanoseconds(times)
    earliest, latest = timestamps.min(axis=1), timestamps.max(axis=1)
    steps = np.diff(np.sort(timestamps, axis=0), axis=0)
    periods = [float(np.median(column[column > 0])) for column in steps.T if (column > 0).any()]
    spread = (latest - earliest).max()
    return bool((latest[:-1] < earliest[1:]).all()) and (
        spread == 0 or (bool(periods) and float(spread) < min(periods) / 2)
    )


def _texts(frames: FrameColumns, rows: list[int], data_path: Path) -> list[str]:
    """Lines as they stand in the file; those that state nothing but their images are made of their columns."""
    named: dict[int, list[int]] = {row: [] for row in rows}
    for index, camera in frames.cameras.items():
        for row in camera.rows:
            if row in named:
                named[row].append(index)
    with open_file(data_path) as file:
        texts = []
        for row in rows:
            if frames.offsets[row] >= 0:
                file.seek(frames.offsets[row])
                texts.append(file.readline().decode().strip())
            else:
                texts.append(_plain_text(named[row], frames.numbers[row], frames.seconds[row]))
    return texts


def _plain_text(cameras: list[int], number: int, seconds: float) -> str:
    line: Mapping[str, Any] = {
        "frames": [{"cameraInd": index} for index in cameras],
        "number": number,
        "time": seconds,
    }
    return msgspec.json.encode(line).decode()
