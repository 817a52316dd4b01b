"""The `frames` lines: images of several cameras that belong together, one line for each such set."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.image_rows import ImageRows
from sceneloom.formats.recording.image_table import OWN_FIELDS
from sceneloom.formats.recording.kept_parameters import CAMERA_MODEL, MOUNT, ImageParameters
from sceneloom.formats.recording.merged_lines import FRAMES, LineStream, OneByOne, WrittenLine
from sceneloom.formats.recording.written_images import ImageSink
from sceneloom.formats.recording.written_lines import make_line
from sceneloom.formats.recording.written_shots import field_of
from sceneloom.formats.recording.written_times import TimeWriter
from sceneloom.scene.depth import DepthFrame
from sceneloom.scene.shooting import ShootingSensor, Shot, shots_of

_OWN_EXTRAS = OWN_FIELDS | {CAMERA_MODEL, MOUNT}
"""Extras of an image that its line is made from anew."""
_OWN_DEPTH_EXTRAS = frozenset({"colorFormat", "depthScale"})
"""Those of a depth image that are reported by how it is written."""
_FORMATS_WORDS = {"exposureTimeSeconds"}
"""Extras that mean the same whatever a scene was read from: words of the recording format that the model took over."""
_OWN_KEYS = {"frames", "number", "time"}
_CAMERA = re.compile(r"camera(\d+)")


class FrameLines:
    """Makes the `frames` lines, and hands each image to the sink of its camera on the way.

    Attributes:
        losses: what could not be written.
    """

    def __init__(
        self,
        sensors: Sequence[ShootingSensor],
        sinks: Sequence[ImageSink],
        rows: ImageRows,
        times: TimeWriter,
        *,
        keep_extras: bool,
    ) -> None:
        """Begin.

        Args:
            sensors: the cameras, in the order of `cameraInd`.
            sinks: where the images of each go.
            rows: which image of each camera each line has.
            times: writes the times.
            keep_extras: whether further fields of images are a recording's own, to be written back.
        """
        self._losses: list[Loss] = list(rows.losses)
        self._sensors, self._sinks, self._rows, self._times = sensors, sinks, rows, times
        self._keep_extras = keep_extras
        self._read_as = [_index_before(sensor, location) for location, sensor in enumerate(sensors)]
        self._parameters = [
            ImageParameters(sensor, sink.width, sink.height)
            for sensor, sink in zip(sensors, sinks, strict=False)
        ]
        self._not_listed = 0

    @property
    def losses(self) -> list[Loss]:
        """What could not be written."""
        what = "`frames` lines that do not list every camera, as they were read: the vendor's software refuses them"
        short = [Loss(field="replay", what=what, count=self._not_listed, support=Support.KEPT)][
            : self._not_listed
        ]
        return [*self._losses, *(loss for writer in self._parameters for loss in writer.losses), *short]

    def stream(self) -> LineStream:
        """The lines, each made after its images were handed on."""
        images, seconds = self._rows.images, self._rows.seconds
        if seconds is not None:
            return OneByOne(
                np.array([round(time * 1e9) for time in seconds], np.int64), self._lines(), FRAMES
            )
        timestamps = np.full(images.shape, np.iinfo(np.int64).max)
        for column, sensor in enumerate(self._sensors):
            there = images[:, column] >= 0
            timestamps[there, column] = shots_of(sensor).timestamps_ns[images[there, column]]
        return OneByOne(timestamps.min(axis=1, initial=np.iinfo(np.int64).max), self._lines(), FRAMES)

    def _lines(self) -> Iterator[WrittenLine]:
        seconds, numbers = self._rows.seconds, self._rows.numbers
        for location, row in enumerate(self._rows.images.tolist()):
            pairs = zip(self._sensors, row, strict=True)
            shots: list[Shot | None] = [shots_of(sensor)[k] if k >= 0 else None for sensor, k in pairs]
            first = min((shot for shot in shots if shot is not None), key=_time, default=None)
            if first is not None and seconds is None:
                timestamp, reported = first.timestamp_ns, first.extras.get("file_seconds")
            else:
                reported = 0.0 if seconds is None else seconds[location]
                timestamp = round(reported * 1e9)
            kept = self._rows.lines.get(location)
            time = (
                (timestamp, reported)
                if first is None
                else (first.timestamp_ns, first.extras.get("file_seconds"))
            )
            entries = [self._entry(c, shot, time, kept) for c, shot in enumerate(shots)]
            fields = {
                **self._beside(first, kept),
                "frames": [entry for entry in entries if entry is not None],
                "number": self._rows.first + location if numbers is None else numbers[location],
            }
            yield make_line(fields, timestamp, self._times, reported)

    def _beside(self, first: Shot | None, kept: Mapping[str, Any] | None) -> Mapping[str, Any]:
        if kept is not None:
            return {key: value for key, value in kept.items() if key not in _OWN_KEYS}
        beside = first.extras.get("line", {}) if first is not None and self._keep_extras else {}
        return beside if isinstance(beside, Mapping) else {}

    def _entry(
        self, index: int, shot: Shot | None, time: tuple[int, float | None], kept: Mapping[str, Any] | None
    ) -> dict[str, Any] | None:
        """Make the entry of a camera; None for a camera that the line did not list."""
        sink = self._sinks[index]
        if shot is None:
            sink.add(None, time[0])
            return self._without_image(index, time, kept)
        sink.add(shot, shot.timestamp_ns)
        entry = {
            "cameraInd": index,
            "time": self._times.raw(shot.timestamp_ns, shot.extras.get("file_seconds")),
        }
        before = shot.extras if self._keep_extras else {}
        own = {**sink.fields(shot), **self._parameters[index].fields(shot, before)}
        return {**self._extras(index, shot), **entry, **own}

    def _without_image(
        self, index: int, time: tuple[int, float | None], kept: Mapping[str, Any] | None
    ) -> dict[str, Any] | None:
        listed = kept["frames"] if kept is not None else [{"cameraInd": self._read_as[index]}]
        before = next((entry for entry in listed if entry["cameraInd"] == self._read_as[index]), None)
        if before is None:
            self._not_listed += 1
            return None
        own = before if before.get("missingBitmap") is True else {}
        known = own.get("time")
        seconds = self._times.raw(*time) if known is None else known
        return {**own, "cameraInd": index, "time": seconds, "missingBitmap": True}

    def _extras(self, index: int, shot: Shot) -> dict[str, Any]:
        own = _OWN_EXTRAS | (_OWN_DEPTH_EXTRAS if isinstance(shot, DepthFrame) else frozenset())
        further = {key: value for key, value in shot.extras.items() if key not in own}
        if self._keep_extras:
            hidden = shot.extras.get("entry", {})
            return {**further, **hidden} if isinstance(hidden, Mapping) else further
        for name in [name for name in further if name not in _FORMATS_WORDS]:
            self._lose(f"{field_of(self._sensors[index])}[].{name}", "left out: the format has none", 1)
        return {name: value for name, value in further.items() if name in _FORMATS_WORDS}

    def _lose(self, field: str, what: str, count: int) -> None:
        self._losses.append(Loss(field=field, what=what, count=count))


def _index_before(sensor: ShootingSensor, location: int) -> int:
    """The `cameraInd` that a camera was read with."""
    found = _CAMERA.fullmatch(str(sensor.id))
    return int(found[1]) if found else location


def _time(shot: Shot) -> tuple[int, float]:
    seconds = shot.extras.get("file_seconds")
    return shot.timestamp_ns, shot.timestamp_ns / 1e9 if seconds is None else seconds
