"""A scene as a recording's folder: sorted lines, calibration, videos or PNG images, lidar binaries."""

import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.loss import Loss, LossReport, Support
from sceneloom.formats.output import FolderKind, replacing
from sceneloom.formats.recording.calibration import CALIBRATION_FILE
from sceneloom.formats.recording.image_rows import ImageRows, grouping_losses, image_rows
from sceneloom.formats.recording.kept_texts import SharedLines, timed_lines, untimed_lines
from sceneloom.formats.recording.merged_lines import FRAMES, LineStream, OneByOne, WrittenLine, merged_lines
from sceneloom.formats.recording.spec import DATA_FILE
from sceneloom.formats.recording.writing_plan import WritingPlan
from sceneloom.formats.recording.written_calibration import antenna_entry, camera_entry, cropped, lidar_entry
from sceneloom.formats.recording.written_frames import FrameLines
from sceneloom.formats.recording.written_images import IMAGES, ImageSink, open_sink
from sceneloom.formats.recording.written_lines import NumberLines, receiver_origin
from sceneloom.formats.recording.written_shots import of_recording
from sceneloom.formats.recording.written_sweeps import LIDAR_MODEL, SweepWriter, sweep_stream
from sceneloom.formats.recording.written_times import TimeWriter
from sceneloom.scene.assumed_camera_models import check_camera_models
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.scene import Scene

_KIND = FolderKind(
    "recording",
    (
        r"data\d*\.(jsonl|mkv|mp4|mov|avi|ts)",
        r"calibration\.json",
        r"vio_config\.yaml",
        r"frames\d+/\d{8}\.png",
        r"lidar\d*/\w[\w.-]*\.(bin|dat|raw)",
        r"README(\.\w+)?",
    ),
    r"data\.jsonl",
)
"""What a recording's folder holds; one with anything else in it is somebody's own."""


def write_recording(scene: Scene, path: Path, *, overwrite: bool = False, images: str = "copy") -> LossReport:
    """Write a scene as a recording; frames are read, written and let go one by one.

    Args:
        scene: what to write.
        path: the folder that is made.
        overwrite: replace the folder if it is a recording, or empty, but for a README; nobody else's folder is ever
            replaced.
        images: "copy" copies a camera's own video packet by packet, cut to the images that are left, where that can
            be done, and encodes H.264 else, or FFV1 where that video has lost nothing; "lossless" encodes FFV1 then;
            "h264" copies only what is H.264 already; "ffv1" (video) and "png" (files) lose nothing.

    Returns:
        What the format could not hold.

    Raises:
        OptionError: `images` is none of these.
        OutputError: the path exists, lies inside a recording, or cannot be written.
        CalibrationError: no model of the format comes near a camera model, or a camera's mounting is unknown.
        PoseError: points are in the world, and it is not known where their lidar was.
        DataError: what the scene is read from is damaged, or has nothing that a recording can hold.
    """
    if images not in IMAGES:
        raise OptionError(f"images {images!r}; expected one of: {', '.join(IMAGES)}")
    check_outside_recordings(path)
    plan = WritingPlan.of(scene)
    check_camera_models(scene, plan.cameras)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        losses = _RecordingWriter(plan, draft, images).write()
        for note in path.glob("README*"):
            if note.is_file():
                shutil.copy2(note, draft)
    return LossReport.of(losses)


def check_outside_recordings(path: Path) -> None:
    """Refuse a folder inside a recording, which would then be part of that one: of its copies, archives and checks.

    Raises:
        OutputError: a folder above the path has a `data.jsonl`.
    """
    for above in path.absolute().parents:
        if (above / DATA_FILE).is_file():
            raise OutputError(f"{path}: lies inside the recording {above}; choose a location beside it")


class _LosingPart(Protocol):
    """A part of the writing that notes what it loses."""

    @property
    def losses(self) -> list[Loss]:
        """What was lost so far."""
        ...


class _RecordingWriter:
    """Writes one recording into an empty folder."""

    def __init__(self, plan: WritingPlan, folder: Path, images: str) -> None:
        self._plan, self._folder, self._images = plan, folder, images
        self._times = TimeWriter()
        self._numbers = NumberLines(self._times, plan.notes.further_keys)
        self._losses = list(plan.losses)

    def write(self) -> list[Loss]:
        """Write all files; give what was lost."""
        plan = self._plan
        rows = image_rows(plan.cameras, plan.notes.frame_lines)
        with ExitStack() as stack:
            sinks = self._open_sinks(rows, stack)
            keep = of_recording(plan.scene)
            frames = FrameLines(plan.cameras, sinks, rows, self._times, keep_extras=keep)
            images = frames.stream()
            shared = SharedLines(plan.notes.shared_lines, self._hosts(images))
            self._numbers = NumberLines(
                self._times,
                plan.notes.further_keys,
                shared=shared,
                sensor_barometer=plan.notes.sensor_barometer,
            )
            sweeps = self._sweep_writers(shared)
            # of one time, the small lines come first: a filter then knows all up to an image when it gets it
            self._write_lines(
                [
                    *self._number_streams(shared),
                    *(sweep.stream() for sweep in sweeps),
                    images,
                    _kept_stream(untimed_lines(plan.notes.other_lines, plan.notes.other_seconds)),
                ]
            )
            for sink in sinks:
                sink.close()
        self._write_calibration(sinks)
        if plan.notes.vio_config is not None:
            (self._folder / "vio_config.yaml").write_text(plan.notes.vio_config, encoding="utf-8")
        parts: list[_LosingPart] = [frames, self._numbers, *sweeps, *sinks]
        self._losses.extend(loss for part in parts for loss in part.losses)
        return [*self._losses, *grouping_losses(plan.cameras, rows), *_time_losses(self._times)]

    def _open_sinks(self, rows: ImageRows, stack: ExitStack) -> list[ImageSink]:
        sinks: list[ImageSink] = []
        for index, camera in enumerate(self._plan.cameras if len(rows.images) else ()):
            sinks.append(open_sink(camera, self._folder, index, rows.images[:, index], images=self._images))
            stack.callback(sinks[-1].abandon)
        return sinks

    def _hosts(self, images: LineStream) -> dict[str, Int64Array]:
        """Times of images and sweeps, by the names of their streams."""
        lidars = self._plan.lidars
        sweeps = {sweep_stream(lidar, k): lidar.frames.timestamps_ns for k, lidar in enumerate(lidars)}
        return {FRAMES: images.timestamps_ns, **sweeps}

    def _sweep_writers(self, shared: SharedLines) -> list[SweepWriter]:
        plan = self._plan
        writers = []
        for index, lidar in enumerate(plan.lidars):
            mount, name = plan.mounts[len(plan.cameras) + index], sweep_stream(lidar, index)
            further = {**plan.notes.further_keys.get(name, {}), **shared.texts_for(name)}
            writers.append(
                SweepWriter(lidar, index, mount, plan.ego_path, self._folder, self._times, further)
            )
        return writers

    def _number_streams(self, shared: SharedLines) -> list[LineStream]:
        plan, lines, notes = self._plan, self._numbers, self._plan.notes
        receivers = [sensor for sensor in plan.scene.sensors if isinstance(sensor, GnssSensor)]
        streams = [lines.trajectory(trajectory, origin) for trajectory, origin in plan.trajectories]
        streams += [] if plan.imu is None else lines.imu(plan.imu)
        for sensor in receivers:
            streams.append(lines.gnss(sensor, receiver_origin(sensor, notes.receiver_origins, receivers)))
        return [*streams, _kept_stream(shared.lines()), _kept_stream(timed_lines(notes.other_lines))]

    def _write_lines(self, streams: Sequence[LineStream]) -> None:
        with (self._folder / DATA_FILE).open("wb") as file:
            for lines in merged_lines(streams):
                file.write("\n".join([*lines, ""]).encode())
        if not any(len(stream.timestamps_ns) for stream in streams):
            raise DataError(self._plan.scene.source, "", "holds nothing that a recording could hold")

    def _write_calibration(self, sinks: list[ImageSink]) -> None:
        plan = self._plan
        cameras: list[dict[str, Any]] = []
        for index, camera in enumerate(plan.cameras):
            camera_model = (
                cropped(camera.camera, sinks[index].width, sinks[index].height) if sinks else camera.camera
            )
            entry, lost = camera_entry(camera, camera_model, plan.mounts[index])
            cameras.append(entry)
            self._losses.extend(lost)
        lidars = [
            lidar_entry(lidar, index, plan.mounts[len(cameras) + index], LIDAR_MODEL)
            for index, lidar in enumerate(plan.lidars)
        ]
        antenna = antenna_entry(plan.scene, plan.notes.calibration)
        further = {**plan.notes.calibration, **antenna}
        content = {**further, "cameras": cameras, **({"lidars": lidars} if lidars else {})}
        if cameras or lidars or further:
            text = msgspec.json.format(msgspec.json.encode(content), indent=2)
            (self._folder / CALIBRATION_FILE).write_bytes(text + b"\n")


def _kept_stream(lines: Sequence[WrittenLine]) -> LineStream:
    return OneByOne(np.array([line.timestamp_ns for line in lines], np.int64), lines)


def _time_losses(times: TimeWriter) -> list[Loss]:
    if not times.inexact:
        return []
    what = f"times written exactly, but a 64-bit number of seconds holds them within {times.worst_ns} ns only"
    worst = float(times.worst_ns)
    return [
        Loss(
            field="timestamps", what=what, count=times.inexact, support=Support.CONVERTED, largest_error=worst
        )
    ]
