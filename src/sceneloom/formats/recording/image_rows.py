"""Which images share a `frames` line: those of one time, or those that did when they were read."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.frame_notes import FrameNotes
from sceneloom.formats.recording.image_files import choose_images
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.old_forms import has_old_frame, with_frames
from sceneloom.formats.recording.written_shots import field_of
from sceneloom.scene.shooting import ShootingSensor, Shot, shots_of

_DEFAULT_PERIOD_NS = 100_000_000
_ROUNDED_NS = 500
"""Scene files in microseconds round times by so much [ns]; the lines that images belong to stay the same."""

_decode = msgspec.json.Decoder(dict[str, Any]).decode

_Key = tuple[int, float, int, int]
"""Time of a line [ns] and [s], its number, and how many lines of these come before it."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageRows:
    """Which image of each camera each line has.

    Attributes:
        images: (L, C) int64, index of the image, -1 for none; lines in the order of time.
        seconds: (L,) float64 [s], times of the lines; None: those of their first images.
        lines: by row, what a line stated that lacks images.
        first: `number` of the first line, from which numbers grow by one.
        numbers: `number` of each line, where they are kept as they were read; None: counted from `first` on.
        losses: what of the lines as they were read is not written.
    """

    images: Int64Array
    seconds: Sequence[float] | None = None
    lines: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    first: int = 0
    numbers: Sequence[int] | None = None
    losses: Sequence[Loss] = ()


def image_rows(sensors: Sequence[ShootingSensor], notes: FrameNotes | None) -> ImageRows:
    """Bring images together, as they were where that is known and their times are still the same.

    Args:
        sensors: the cameras, in the order of `cameraInd`.
        notes: what is known of the lines that the images were read from.
    """
    if not sensors:
        return ImageRows(np.zeros((0, 0), np.int64))
    found = _as_read(sensors, notes) if notes is not None and notes.own else None
    if found is None:
        found = ImageRows(group_images([shots_of(sensor).timestamps_ns for sensor in sensors]))
    if notes is None:
        return found
    untouched = len(found.images) == notes.count
    first = notes.first if untouched and notes.first is not None else 0
    numbers = _numbers_as_read(sensors, found) if untouched and notes.first is None else None
    losses = _losses(found, notes, counted_anew=untouched and notes.first is None and numbers is None)
    return ImageRows(found.images, found.seconds, found.lines, first, numbers, losses)


def _numbers_as_read(sensors: Sequence[ShootingSensor], rows: ImageRows) -> list[int] | None:
    """Numbers of lines that do not grow by one; None where one is not known, or they would mean other images.

    The video that is written has one image for each line.
    """
    numbers = []
    for row, images in enumerate(rows.images.tolist()):
        shots = [shots_of(sensor)[k] for sensor, k in zip(sensors, images, strict=True) if k >= 0]
        known = [shot.extras.get("number") for shot in shots] or [rows.lines.get(row, {}).get("number")]
        if type(known[0]) is not int or known.count(known[0]) < len(known):
            return None
        numbers.append(known[0])
    found = choose_images(np.array(numbers, np.int64), len(numbers)).indices
    return numbers if np.array_equal(found, np.arange(len(numbers))) else None


def _losses(rows: ImageRows, notes: FrameNotes, *, counted_anew: bool) -> list[Loss]:
    losses, count = list[Loss](), len(rows.images)
    if counted_anew:
        what = "counted from 0: they did not grow from line to line, and would mean other images"
        losses.append(Loss(field="frames[].number", what=what, count=count, support=Support.KEPT))
    if notes.own and rows.seconds is None:
        what = "put together anew by the times of their images, which are not those that were read"
        losses.append(Loss(field="frames", what=what, count=count, support=Support.KEPT))
    return losses


def group_images(timestamps: Sequence[Int64Array]) -> Int64Array:
    """Find which images share a line: those within half a period of the earliest, at most one per camera.

    Args:
        timestamps: per camera, (N,) int64 [ns], ascending.

    Returns:
        (L, C) int64: for each line and camera the index of the image, -1 for none; lines in time order.
    """
    steps = [np.diff(times) for times in timestamps]
    periods = [float(np.median(step[step > 0])) for step in steps if (step > 0).any()]
    half_ns = min(periods, default=_DEFAULT_PERIOD_NS) / 2
    cameras = np.concatenate([np.full(len(times), c, np.int64) for c, times in enumerate(timestamps)])
    indices = np.concatenate([np.arange(len(times), dtype=np.int64) for times in timestamps])
    times = np.concatenate(list(timestamps))
    lines: list[list[int]] = []
    start_ns = 0
    for k in np.argsort(times, kind="stable").tolist():
        camera, timestamp = int(cameras[k]), int(times[k])
        if not lines or lines[-1][camera] >= 0 or timestamp - start_ns >= half_ns:
            lines.append([-1] * len(timestamps))
            start_ns = timestamp
        lines[-1][camera] = int(indices[k])
    return np.array(lines, np.int64).reshape(len(lines), len(timestamps))


def grouping_losses(sensors: Sequence[ShootingSensor], rows: ImageRows) -> list[Loss]:
    """Report where cameras are not in step, so that lines lack some of their images, unless that was read so."""
    fresh = [row for row in range(len(rows.images)) if row not in rows.lines]
    missing = (rows.images[fresh] < 0).sum(axis=0).tolist()
    what = (
        "is not in step with the other cameras: its video repeats an image where a line has none of its own"
    )
    return [
        Loss(field=field_of(sensor), what=what, count=count, support=Support.CONVERTED)
        for sensor, count in zip(sensors, missing, strict=True)
        if count
    ]


def _as_read(sensors: Sequence[ShootingSensor], notes: FrameNotes) -> ImageRows | None:
    """Bring images together that were in one line; None where one has another time, or none reports its line."""
    members: dict[_Key, list[int]] = {}
    for location, sensor in enumerate(sensors):
        seen = Counter[tuple[int, float, int]]()
        for k, shot in enumerate(shots_of(sensor)):
            line = _line_of(shot)
            if line is None:
                return None
            members.setdefault((*line, seen[line]), [-1] * len(sensors))[location] = k
            seen[line] += 1
    lines = _kept_lines(notes.texts)
    if len(members.keys() | lines.keys()) == notes.count:
        # nothing was cut: lines without any image have their locations
        members = {key: members.get(key) or [-1] * len(sensors) for key in [*members, *lines]}
    keys = sorted(members)
    return ImageRows(
        images=np.array([members[key] for key in keys], np.int64).reshape(len(keys), len(sensors)),
        seconds=[key[1] for key in keys],
        lines={row: lines[key] for row, key in enumerate(keys) if key in lines},
    )


def _line_of(shot: Shot) -> tuple[int, float, int] | None:
    seconds, number = shot.extras.get("file_seconds"), shot.extras.get("number")
    if not isinstance(seconds, float) or type(number) is not int or not isfinite(seconds):
        return None
    if abs(round(seconds * 1e9) - shot.timestamp_ns) > _ROUNDED_NS:
        return None
    own = shot.extras.get("line_seconds", seconds)
    if not isinstance(own, float) or not isfinite(own):
        return None
    return round(own * 1e9), own, number


def _kept_lines(texts: Sequence[str]) -> dict[_Key, Mapping[str, Any]]:
    lines: dict[_Key, Mapping[str, Any]] = {}
    seen = Counter[tuple[int, float, int]]()
    for text in texts:
        try:
            line = _decode(text)
            content = with_frames(line) if has_old_frame(line) else line
            seconds, number = float(content["time"]), int(content["number"])
            timestamp, known = round(seconds * 1e9), [entry["cameraInd"] for entry in content["frames"]]
        except (*DECODER_FAULTS, KeyError, TypeError, ValueError, OverflowError):
            continue
        if all(type(index) is int for index in known):
            key = (timestamp, seconds, number)
            lines[(*key, seen[key])] = content
            seen[key] += 1
    return lines
