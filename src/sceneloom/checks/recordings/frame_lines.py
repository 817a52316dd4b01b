"""Rules about `frames` lines: their numbers, which state which image is meant, their cameras, and their times."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.checks.reading import warnings_of_code
from sceneloom.checks.recordings.camera_pairs import stereo_pairs
from sceneloom.checks.recordings.repaired_frames import counted_anew, with_all_cameras
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.recording.column_arrays import time_order, view
from sceneloom.formats.recording.columns import FrameColumns
from sceneloom.scene.findings import Severity

IN_STEP = 0.002
"""Images of a stereo pair are taken within this time [s]."""
_NO_STEP = 0.1
"""Taken for the time from line to line [s] where the lines notify none."""


def _frames(subject: Subject) -> FrameColumns | None:
    """The lines in the order of the file, or None where there are none."""
    columns = None if subject.recording is None else subject.recording.columns.frames
    return columns if columns is not None and len(columns.numbers) else None


def _by_time(frames: FrameColumns) -> tuple[Int64Array, Int64Array]:
    """Numbers, and the lines that they stand in, in the order of time."""
    order = time_order(view(frames.seconds))
    return np.asarray(frames.numbers, np.int64)[order], np.asarray(frames.lines, np.int64)[order]


def _at(line: int) -> str:
    return f"data.jsonl: line {line}"


def _begin(subject: Subject) -> Iterator[Hit]:
    frames = _frames(subject)
    if frames is not None:
        numbers, lines = _by_time(frames)
        if numbers.min() != 0:
            row = int(numbers.argmin())
            yield Hit(_at(lines[row]), f"number: the first is {numbers[row]}; expected 0")


def _order(subject: Subject) -> Iterator[Hit]:
    frames = _frames(subject)
    if frames is None:
        return
    numbers, lines = _by_time(frames)
    for row in np.flatnonzero(np.diff(numbers) <= 0).tolist():
        reported = f"number: {numbers[row + 1]} after {numbers[row]}; expected {numbers[row] + 1}"
        yield Hit(_at(lines[row + 1]), reported)


def _gaps(subject: Subject) -> Iterator[Hit]:
    frames = _frames(subject)
    if frames is None:
        return
    numbers, lines = _by_time(frames)
    for row in np.flatnonzero(np.diff(numbers) > 1).tolist():
        before, after = int(numbers[row]), int(numbers[row + 1])
        missing = str(before + 1) if after == before + 2 else f"{before + 1} to {after - 1}"
        yield Hit(
            _at(lines[row + 1]), f"number: {after} after {before}; {missing} missing", after - before - 1
        )


def _without_cameras(subject: Subject) -> Iterator[Hit]:
    """Lines that lack a camera which other lines have."""
    frames = _frames(subject)
    if frames is None:
        return
    if not frames.cameras:
        yield Hit(
            _at(frames.lines[0]), "frames: no line names a camera; expected one entry each", len(frames.lines)
        )
    for index, camera in sorted(frames.cameras.items()):
        has_it = np.zeros(len(frames.lines), np.bool_)
        has_it[np.asarray(camera.rows, np.int64)] = True
        lacking = np.flatnonzero(~has_it)
        if len(lacking):
            reported = f"frames: cameraInd {index} is missing in {len(lacking)} of {len(frames.lines)} lines"
            yield Hit(_at(frames.lines[int(lacking[0])]), reported, len(lacking))


def _entry_times(subject: Subject) -> Iterator[Hit]:
    frames = _frames(subject)
    if frames is None:
        return
    line_seconds = view(frames.seconds)
    steps = np.diff(np.sort(line_seconds))
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else _NO_STEP
    for index, camera in sorted(frames.cameras.items()):
        rows = np.asarray(camera.rows, np.int64)
        off = view(camera.seconds) - line_seconds[rows]
        wrong = np.flatnonzero(np.abs(off) > 0.5 * period)
        if len(wrong):
            worst = int(wrong[np.abs(off[wrong]).argmax()])
            reported = (
                f"frames[].time of camera {index} is up to {off[worst]:+.3f} s off its line's time in {len(wrong)} of "
                f"{len(rows)} lines; expected less than half a period of {period:.3f} s"
            )
            yield Hit(_at(frames.lines[rows[worst]]), reported, len(wrong))


def _out_of_step(subject: Subject) -> Iterator[Hit]:
    frames = _frames(subject)
    if frames is None:
        return
    for pair in stereo_pairs(subject):
        rows, apart = _apart(frames, pair.first, pair.second)
        wrong = np.flatnonzero(np.abs(apart) > IN_STEP)
        if len(wrong):
            reported = (
                f"images of cameras {pair.first} and {pair.second}, which look the same way, are "
                f"{np.median(np.abs(apart[wrong])) * 1e3:.1f} ms apart in {len(wrong)} of {len(rows)} lines; "
                f"expected at most {IN_STEP * 1e3:g} ms"
            )
            yield Hit(_at(frames.lines[rows[wrong[0]]]), reported, len(wrong))


def _apart(frames: FrameColumns, first: int, second: int) -> tuple[Int64Array, Float64Array]:
    """Rows of lines that have both cameras, and how much later the second camera's image is [s]."""
    none = np.zeros(0, np.int64)
    if first not in frames.cameras or second not in frames.cameras:
        return none, np.zeros(0)
    a, b = frames.cameras[first], frames.cameras[second]
    rows, in_a, in_b = np.intersect1d(
        np.asarray(a.rows, np.int64), np.asarray(b.rows, np.int64), assume_unique=True, return_indices=True
    )
    return rows.astype(np.int64), view(b.seconds)[in_b] - view(a.seconds)[in_a]


RULES: tuple[Rule, ...] = (
    Rule(
        "frame-numbers-begin",
        Severity.HINT,
        "`number` of the first `frames` line is 0.",
        "Count from 0: what counts from elsewhere takes other images of the video in some programs.",
        find=_begin,
        fix=counted_anew,
    ),
    Rule(
        "frame-numbers-increasing",
        Severity.WARNING,
        "`number` grows from `frames` line to `frames` line, in the order of their times.",
        "See which image each line means: it is known by its number; `--fix` numbers them by time, and the video with "
        "them.",
        find=_order,
        fix=counted_anew,
    ),
    Rule(
        "frame-numbers-gaps",
        Severity.WARNING,
        "`number` grows by one from `frames` line to `frames` line.",
        "See whether frames were dropped; `--fix` numbers the lines anew and takes images without a line out.",
        find=_gaps,
        fix=counted_anew,
    ),
    Rule(
        "frames-without-camera",
        Severity.WARNING,
        "Every `frames` line names every camera.",
        "Add the camera, with `missingBitmap` where it has no image: the vendor's software refuses other lines.",
        find=_without_cameras,
        fix=with_all_cameras,
    ),
    Rule(
        "frames-missing-bitmap",
        Severity.HINT,
        "No entry of a `frames` line says `missingBitmap`.",
        "See whether the camera dropped images.",
        find=warnings_of_code("missing-bitmaps"),
    ),
    Rule(
        "frame-entry-times",
        Severity.WARNING,
        "`frames[].time` lies within half a period of its line's time.",
        "Write the time at which the image was taken, on the clock of the other lines.",
        find=_entry_times,
    ),
    Rule(
        "stereo-in-step",
        Severity.WARNING,
        f"Cameras that look the same way take their images within {IN_STEP * 1e3:g} ms.",
        "Trigger both together, or give them lines of their own: a pair is taken for one moment.",
        find=_out_of_step,
    ),
)
