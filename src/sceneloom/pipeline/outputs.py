"""Outputs that several jobs have: scene files whose sweeps follow one by one, folders of depth images, file names."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.errors import DataError
from sceneloom.formats.base.images import write_depth_npz, write_depth_png
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import file_stems
from sceneloom.formats.sfs.clock import TICKS_NS
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.pipeline.alignment import Aligned
from sceneloom.pipeline.play import Skips
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import sensor_path
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Scene, time_span
from sceneloom.scene.types import Identifier


def lidar_folders(folder: Path, scene: Scene) -> Mapping[Identifier, Path]:
    """Where the files of each lidar go: a folder of its own where there are several."""
    names = names_of(scene.lidars)
    return {lidar_id: folder / name if len(names) > 1 else folder for lidar_id, name in names.items()}


def names_of(sensors: Sequence[LidarSensor] | Sequence[CameraSensor]) -> Mapping[Identifier, str]:
    """The part of a file name that stands for each sensor."""
    ids: list[Identifier] = [sensor.id for sensor in sensors]
    return dict(zip(ids, file_stems(ids), strict=True))


def spread(scene: Scene, most: int, *, every: int | None = None) -> frozenset[int]:
    """Numbers of at most so many sweeps, spread over the drive; or of every Nth one."""
    count = max((len(lidar.frames) for lidar in scene.lidars), default=0)
    if every is not None:
        return frozenset(range(0, count, every))
    return frozenset(np.linspace(0, count - 1, min(most, count)).astype(int).tolist())


@dataclass(slots=True)
class DepthFolder:
    """A folder of depth images: `<camera>/<frame number>.png`, or `.npz`; of several lidars below `<lidar>/`.

    `index.jsonl` names for each image its sweep, its camera image, and their times.

    Attributes:
        folder: the folder.
        folders: of the images of each lidar.
        names: of the folder of each camera therein.
        form: "png" (16 bit, metres times 256) or "npz" (float32 metres).
        written: files so far.
        beyond_range: pixels that the form cannot hold.
    """

    folder: Path
    folders: Mapping[Identifier, Path]
    names: Mapping[Identifier, str]
    form: str
    written: int = 0
    beyond_range: int = 0

    @classmethod
    def of(cls, folder: Path, scene: Scene, form: str) -> "DepthFolder":
        """The folder of a scene's depth images."""
        return cls(folder, lidar_folders(folder, scene), names_of(scene.cameras), form)

    def write(
        self, frame: FusedFrame, view: FusedView, depths: Float32Array, confidence: Float32Array | None = None
    ) -> Path:
        """Write the depths of a view, and a line into the index; give the file."""
        target = self.folders[frame.lidar_id] / self.names[view.camera_id] / f"{frame.index:06d}.{self.form}"
        target.parent.mkdir(parents=True, exist_ok=True)
        if self.form == "npz":
            write_depth_npz(depths, target, confidence=confidence)
        else:
            self.beyond_range += write_depth_png(depths, target)
        record = {
            "file": target.relative_to(self.folder).as_posix(),
            "lidar": frame.lidar_id,
            "sweep_ns": frame.timestamp_ns,
            "camera": view.camera_id,
            "image_ns": view.timestamp_ns,
        }
        with (self.folder / "index.jsonl").open("ab") as lines:
            lines.write(msgspec.json.encode(record) + b"\n")
        self.written += 1
        return target


@dataclass(slots=True)
class SceneSink:
    """Writes fused sweeps into a scene file whose other sensors stand in it already.

    Attributes:
        writer: the open file.
        sources: `world_from_sensor` of the lidars whose location is known.
        time_unit: the file's unit of time.
        origin: what the sweeps are read from, for messages.
        skips: collects sweeps that the file cannot hold; None where they are errors.
        left_out: how many these were.
    """

    writer: SceneWriter
    sources: Mapping[Identifier, PoseSource]
    time_unit: str
    origin: str = ""
    skips: Skips | None = None
    left_out: int = 0
    _starts_ns: dict[Identifier, list[int]] = field(default_factory=dict)
    _stops_ns: dict[Identifier, int] = field(default_factory=dict)
    _extrapolated_ns: dict[Identifier, list[int]] = field(default_factory=dict)

    @classmethod
    def open(
        cls,
        aligned: Aligned,
        target: Path,
        stack: ExitStack,
        skips: Skips | None,
        *,
        profile: str = "sfs",
        time_unit: str = "microseconds",
        overwrite: bool = False,
    ) -> "SceneSink":
        """Begin a scene file with everything of a drive but its sweeps, which follow.

        Args:
            aligned: the drive.
            target: the file.
            stack: closes the file.
            skips: collects what cannot be read; None where that is an error.
            profile, time_unit, overwrite: how the file is written.
        """
        scene, sources = aligned.output_scene()
        spans_ns = [span_ns for span_ns in map(time_span, (aligned.scene, scene)) if span_ns is not None]
        writer = stack.enter_context(
            SceneWriter(
                target,
                overwrite=overwrite,
                profile=profile,
                time_unit=time_unit,
                first_ns=min((first_ns for first_ns, _ in spans_ns), default=None),
                frame_count=sum(len(lidar.frames) for lidar in aligned.scene.lidars),
            )
        )
        if skips is None:
            writer.add_scene(scene)
        else:
            _add_readable(writer, scene, skips)
        writer.set_metadata(aligned.provenance())
        return cls(writer, sources, time_unit, aligned.scene.source, skips)

    def add(self, frame: FusedFrame) -> None:
        """Write one sweep; an unfused one goes, in its sensor's frame, under the file's metadata.

        Raises:
            DataError: a point of it is too far away.
        """
        sweep = LidarFrame(frame.timestamp_ns, frame.points, frame.extras)
        if frame.unfused is not None:
            self.writer.add_unfused(frame.lidar_id, sweep, frame.unfused)
            return
        try:
            self.writer.add_frame(frame.lidar_id, sweep)
        except DataError as error:
            row = error.location.partition(".points.")[2]
            location = f"sensors[{frame.lidar_id}].frames[{frame.index}].points.{row}"
            reported = DataError(self.origin, location, error.problem)
            if self.skips is None:
                raise reported from error
            self.skips.add(reported)
            self.left_out += 1
            return
        start_ns, stop_ns = _bounds_ns(frame, TICKS_NS[self.time_unit])
        self._starts_ns.setdefault(frame.lidar_id, []).append(start_ns)
        self._stops_ns[frame.lidar_id] = max(stop_ns, self._stops_ns.get(frame.lidar_id, stop_ns))
        if frame.extrapolated:
            self._extrapolated_ns.setdefault(frame.lidar_id, []).append(start_ns)

    def finish(self) -> LossReport:
        """Give each lidar its poses, up to the end of its last sweep, mark what was extrapolated, complete the file."""
        if self._extrapolated_ns:
            marks = [{"sensor_id": key, "timestamps_ns": t} for key, t in self._extrapolated_ns.items()]
            self.writer.set_metadata({"sceneloom": {"extrapolated": marks}})
        for lidar_id, starts_ns in self._starts_ns.items():
            if lidar_id in self.sources:
                ends = (max(time_ns, -(2**63)) for time_ns in starts_ns)
                times_ns = np.array([*ends, min(self._stops_ns[lidar_id], 2**63 - 1)], np.int64)
                path = sensor_path(self.sources[lidar_id], times_ns)
                if path is not None:
                    self.writer.set_poses(lidar_id, path)
        return self.writer.finish()


def _bounds_ns(frame: FusedFrame, tick_ns: int) -> tuple[int, int]:
    """The times of a frame's earliest and latest point, rounded down and up to the file's unit.

    A frame of a file begins after none of its points.
    """
    times = frame.points.timestamps_ns
    if times is None or len(times) == 0:
        earliest = latest = frame.timestamp_ns
    else:
        earliest, latest = int(times.min()), int(times.max())
    return earliest // tick_ns * tick_ns, -(-latest // tick_ns) * tick_ns


def _add_readable(writer: SceneWriter, scene: Scene, skips: Skips) -> None:
    """Add a scene, but pass over single images that cannot be read; a video is taken as it is."""
    alone = [camera for camera in scene.cameras if camera.video is None]
    none: LazyFrames[CameraImage] = LazyFrames.of([], [])
    sensors = [
        replace(sensor, images=none) if isinstance(sensor, CameraSensor) and sensor.video is None else sensor
        for sensor in scene.sensors
    ]
    writer.add_scene(replace(scene, sensors=tuple(sensors)))
    for camera in alone:
        for index in range(len(camera.images)):
            try:
                writer.add_frame(camera.id, camera.images[index])
            except DataError as error:
                skips.add(error)
