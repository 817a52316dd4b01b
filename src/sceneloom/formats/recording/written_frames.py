"""The `frames` lines: pictures of several cameras that belong together, one line for each such set."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.loss import Loss
from sceneloom.formats.recording.line_order import FRAMES
from sceneloom.formats.recording.merged_lines import LineStream, OneByOne, WrittenLine
from sceneloom.formats.recording.written_calibration import lens_entry, lens_losses
from sceneloom.formats.recording.written_lines import make_line
from sceneloom.formats.recording.written_mounts import matrix_entry
from sceneloom.formats.recording.written_pictures import PictureSink
from sceneloom.formats.recording.written_shots import ShootingSensor, Shot, field_of, shots_of
from sceneloom.formats.recording.written_times import TimeWriter
from sceneloom.scene import DepthFrame

_DEFAULT_PERIOD_NS = 100_000_000
_OWN_EXTRAS = frozenset({"file_seconds", "number", "line_seconds", "line"})
"""Extras of a picture that its line is made from anew."""
_OWN_DEPTH_EXTRAS = frozenset({"colorFormat", "depthScale"})
"""Those of a depth image that are told by how it is written."""
_FORMATS_WORDS = {"exposureTimeSeconds"}
"""Extras that mean the same whatever a scene was read from: words of the recording format that the model took over."""


def group_pictures(stamps: Sequence[Int64Array]) -> Int64Array:
    """Find which pictures share a line: those within half a period of the earliest, at most one per camera.

    Args:
        stamps: per camera, (N,) int64 [ns], ascending.

    Returns:
        (L, C) int64: for each line and camera the index of the picture, -1 for none; lines in time order.
    """
    steps = [np.diff(times) for times in stamps]
    periods = [float(np.median(step[step > 0])) for step in steps if (step > 0).any()]
    half_ns = min(periods, default=_DEFAULT_PERIOD_NS) / 2
    cameras = np.concatenate([np.full(len(times), c, np.int64) for c, times in enumerate(stamps)])
    indices = np.concatenate([np.arange(len(times), dtype=np.int64) for times in stamps])
    times = np.concatenate(list(stamps))
    lines: list[list[int]] = []
    start_ns = 0
    for k in np.argsort(times, kind="stable").tolist():
        camera, stamp = int(cameras[k]), int(times[k])
        if not lines or lines[-1][camera] >= 0 or stamp - start_ns >= half_ns:
            lines.append([-1] * len(stamps))
            start_ns = stamp
        lines[-1][camera] = int(indices[k])
    return np.array(lines, np.int64).reshape(len(lines), len(stamps))


def grouping_losses(sensors: Sequence[ShootingSensor], rows: Int64Array) -> list[Loss]:
    """Say where cameras are not in step, so that lines lack some of their pictures."""
    missing = (rows < 0).sum(axis=0).tolist()
    what = (
        "is not in step with the other cameras: its video repeats a picture where a line has none of its own"
    )
    return [
        Loss(field=field_of(sensor), what=what, count=count)
        for sensor, count in zip(sensors, missing, strict=True)
        if count
    ]


class FrameLines:
    """Makes the `frames` lines, and hands each picture to the sink of its camera on the way.

    Attributes:
        losses: what could not be written.
    """

    def __init__(
        self,
        sensors: Sequence[ShootingSensor],
        sinks: Sequence[PictureSink],
        rows: Int64Array,
        times: TimeWriter,
        *,
        keep_extras: bool,
    ) -> None:
        """Begin.

        Args:
            sensors: the cameras, in the order of `cameraInd`.
            sinks: where the pictures of each go.
            rows: (L, C) int64, which picture of each camera each line has, -1 for none.
            times: writes the times.
            keep_extras: whether further fields of pictures are a recording's own, to be written back.
        """
        self.losses: list[Loss] = []
        self._sensors, self._sinks, self._rows, self._times = sensors, sinks, rows, times
        self._keep_extras = keep_extras

    def stream(self) -> LineStream:
        """The lines, each made after its pictures were handed on."""
        stamps = np.full(self._rows.shape, np.iinfo(np.int64).max)
        for column, sensor in enumerate(self._sensors):
            there = self._rows[:, column] >= 0
            stamps[there, column] = shots_of(sensor).timestamps_ns[self._rows[there, column]]
        return OneByOne(stamps.min(axis=1, initial=np.iinfo(np.int64).max), self._lines(), FRAMES)

    def _lines(self) -> Iterator[WrittenLine]:
        for number, row in enumerate(self._rows.tolist()):
            pairs = zip(self._sensors, row, strict=True)
            shots: list[Shot | None] = [shots_of(sensor)[k] if k >= 0 else None for sensor, k in pairs]
            first = min((shot for shot in shots if shot is not None), key=_time)
            entries = [self._entry(c, shot, first) for c, shot in enumerate(shots)]
            beside = first.extras.get("line", {}) if self._keep_extras else {}
            fields = {**beside, "frames": entries, "number": number}
            yield make_line(fields, first.timestamp_ns, self._times, first.extras.get("file_seconds"))

    def _entry(self, index: int, shot: Shot | None, first: Shot) -> dict[str, Any]:
        shown, sink = first if shot is None else shot, self._sinks[index]
        sink.add(shot, shown.timestamp_ns)
        entry = {
            "cameraInd": index,
            "time": self._times.raw(shown.timestamp_ns, shown.extras.get("file_seconds")),
        }
        if shot is None:
            return {**entry, "missingBitmap": True}
        own = {**sink.fields(shot), **self._own_parameters(index, shot)}
        return {**self._extras(index, shot), **entry, **own}

    def _own_parameters(self, index: int, shot: Shot) -> dict[str, Any]:
        sensor, fields = self._sensors[index], dict[str, Any]()
        if shot.camera != sensor.camera:
            lens, how_far = lens_entry(shot.camera, model_key="distortionModel")
            fields["cameraParameters"] = {k: v for k, v in lens.items() if not k.startswith("image")}
            self.losses += lens_losses(f"{field_of(sensor)}[].camera", how_far)
        if shot.mount is not None and shot.mount is not sensor.mount:
            fields["imuToCamera"] = matrix_entry(shot.mount.inverse())
        return fields

    def _extras(self, index: int, shot: Shot) -> dict[str, Any]:
        own = _OWN_EXTRAS | (_OWN_DEPTH_EXTRAS if isinstance(shot, DepthFrame) else frozenset())
        further = {key: value for key, value in shot.extras.items() if key not in own}
        if self._keep_extras:
            return further
        for name in [name for name in further if name not in _FORMATS_WORDS]:
            self._lose(f"{field_of(self._sensors[index])}[].{name}", "left out: the format has none", 1)
        return {name: value for name, value in further.items() if name in _FORMATS_WORDS}

    def _lose(self, field: str, what: str, count: int) -> None:
        self.losses.append(Loss(field=field, what=what, count=count))


def _time(shot: Shot) -> tuple[int, float]:
    seconds = shot.extras.get("file_seconds")
    return shot.timestamp_ns, shot.timestamp_ns / 1e9 if seconds is None else seconds
