"""Outputs that several jobs have: scene files whose sweeps follow one by one, folders of depth images, visualisations.

They are one family: `add` takes a fused sweep, `finish` completes the output, `written` counts files.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import Float32Array, spread_rows
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.errors import DataError
from sceneloom.formats.base.images import write_depth_image
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import file_stems, filling
from sceneloom.formats.sfs.clock import TICKS_NS
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.pipeline.alignment import Aligned
from sceneloom.pipeline.play import Skips
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import sensor_path
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, time_span
from sceneloom.scene.types import Identifier
from sceneloom.visualization.fused_frames import MOST_SWEEPS, DriveCloud, save_images


def names_of(sensors: Sequence[LidarSensor] | Sequence[CameraSensor]) -> Mapping[Identifier, str]:
    """The part of a file name that stands for each sensor."""
    ids: list[Identifier] = [sensor.id for sensor in sensors]
    return dict(zip(ids, file_stems(ids), strict=True))


def lidar_folders(folder: Path, scene: Scene) -> Mapping[Identifier, Path]:
    """The folder of each lidar's files: `folder`, or one of its own in it where there are several lidars."""
    names = names_of(scene.lidars)
    return {lidar_id: folder / name if len(names) > 1 else folder for lidar_id, name in names.items()}


@dataclass(slots=True)
class DepthFolder:
    """A folder of depth images: `<camera>/<frame number>.png`, or `.npz`; of several lidars below `<lidar>/`.

    `index.jsonl` names for each image its sweep, its camera image, and their times.

    Attributes:
        form: "png" (16 bit, metres times 256) or "npz" (float32 metres).
        beyond_range: pixels that the form cannot hold.
    """

    folder: Path
    scene: Scene
    form: str
    written: int = 0
    beyond_range: int = 0
    _folders: Mapping[Identifier, Path] = field(init=False)
    _names: Mapping[Identifier, str] = field(init=False)

    def __post_init__(self) -> None:
        self._folders, self._names = lidar_folders(self.folder, self.scene), names_of(self.scene.cameras)

    def place(self, frame: FusedFrame, view: FusedView) -> Path:
        """The file of a view, relative to the folder, without a suffix."""
        lidar = self._folders[frame.lidar_id].relative_to(self.folder)
        return lidar / self._names[view.camera_id] / f"{frame.index:06d}"

    def write(
        self, frame: FusedFrame, view: FusedView, depths: Float32Array, confidence: Float32Array | None = None
    ) -> None:
        """Write the depths of a view, and a line into the index."""
        file = self.place(frame, view).with_suffix(f".{self.form}")
        target = self.folder / file
        target.parent.mkdir(parents=True, exist_ok=True)
        self.beyond_range += write_depth_image(depths, target, confidence=confidence)
        record = {
            "file": file.as_posix(),
            "lidar": frame.lidar_id,
            "sweep_ns": frame.timestamp_ns,
            "camera": view.camera_id,
            "image_ns": view.timestamp_ns,
        }
        with (self.folder / "index.jsonl").open("ab") as lines:
            lines.write(msgspec.json.encode(record) + b"\n")
        self.written += 1

    def add(self, frame: FusedFrame) -> None:
        """Write the depths of a sweep's points in each of its views."""
        for view in frame.views:
            self.write(frame, view, view.depth_image)

    def finish(self) -> None:
        """Nothing is left to do."""


_IMAGES_PER_DRIVE = 8


@dataclass(slots=True)
class ImageSink:
    """Draws the drive as one cloud for people to look at, and some of the sweeps by themselves.

    Attributes:
        folders: of the images of each lidar.
        ego_poses: the ego trajectory, drawn into the clouds; None where it is not known.
    """

    folder: Path
    folders: Mapping[Identifier, Path]
    chosen: frozenset[int]
    cloud: DriveCloud
    ego_poses: Poses | None
    written: int = 0

    @classmethod
    def open(
        cls,
        aligned: Aligned,
        target: Path,
        stack: ExitStack,
        *,
        overwrite: bool,
        sweeps: bool = True,
        every: int | None = None,
    ) -> "ImageSink":
        """Begin a folder of images: of the drive, and with `sweeps` of every Nth sweep, None: some over the drive."""
        folder = stack.enter_context(filling(target, overwrite=overwrite))
        count = max((len(lidar.frames) for lidar in aligned.scene.lidars), default=0)

        def spread(most: int) -> frozenset[int]:
            return frozenset(spread_rows(count, most, nearest=False).tolist())

        chosen = spread(_IMAGES_PER_DRIVE) if every is None else frozenset(range(0, count, every))
        path = None if aligned.ego is None else aligned.ego.path
        cloud = DriveCloud(spread(MOST_SWEEPS))
        return cls(folder, lidar_folders(folder, aligned.scene), chosen if sweeps else frozenset(), cloud, path)

    def add(self, frame: FusedFrame) -> None:
        """Draw the sweep if it is chosen."""
        self.cloud.add(frame)
        if frame.index in self.chosen and frame.unfused is None:
            folder = self.folders[frame.lidar_id]
            self.written += len(save_images(frame, folder, frame.index, ego_poses=self.ego_poses))

    def finish(self) -> None:
        """Draw the drive."""
        self.written += len(self.cloud.save(self.folder, self.ego_poses))


@dataclass(slots=True)
class SceneSink:
    """Writes fused sweeps into a scene file whose other sensors stand in it already.

    Attributes:
        sources: `world_from_sensor` of the lidars whose location is known.
        origin: what the sweeps are read from, for messages.
        skips: collects sweeps that the file cannot hold.
        written: sweeps so far, unfused ones apart.
        losses: what the file could not hold; known when it is complete.
    """

    writer: SceneWriter
    sources: Mapping[Identifier, PoseSource]
    tick_ns: int
    origin: str
    skips: Skips
    written: int = 0
    losses: LossReport = field(default_factory=LossReport)
    _starts_ns: dict[Identifier, list[int]] = field(default_factory=dict)
    _stops_ns: dict[Identifier, int] = field(default_factory=dict)
    _extrapolated_ns: dict[Identifier, list[int]] = field(default_factory=dict)

    @classmethod
    def open(
        cls,
        aligned: Aligned,
        target: Path,
        stack: ExitStack,
        skips: Skips,
        *,
        profile: str = "sfs",
        time_unit: str = "microseconds",
        overwrite: bool = False,
    ) -> "SceneSink":
        """Begin a scene file with everything of a drive but its sweeps, which follow; `stack` closes it."""
        scene, sources = aligned.output_scene()
        spans_ns = [span_ns for span_ns in map(time_span, (aligned.scene, scene)) if span_ns is not None]
        writer = stack.enter_context(
            SceneWriter(
                target,
                overwrite=overwrite,
                profile=profile,
                time_unit=time_unit,
                first_ns=min((first_ns for first_ns, _ in spans_ns), default=None),
                frame_count=aligned.sweeps,
            )
        )
        if skips.lenient:
            _add_readable(writer, scene, skips)
        else:
            writer.add_scene(scene)
        writer.set_metadata(aligned.provenance())
        return cls(writer, sources, TICKS_NS[time_unit], aligned.scene.source, skips)

    def add(self, frame: FusedFrame) -> None:
        """Write one sweep; an unfused one goes, in its sensor's frame, under the file's metadata.

        Raises:
            DataError: a point of it is too far away, and nothing may be skipped.
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
            self.skips.add(DataError(self.origin, location, error.problem))
            return
        self.written += 1
        # a frame of a file begins after none of its points: rounded down and up to the file's unit
        times = frame.points.timestamps_ns
        if times is None or not len(times):
            times = np.array([frame.timestamp_ns], np.int64)
        earliest, latest = int(times.min()), int(times.max())
        start_ns, stop_ns = earliest // self.tick_ns * self.tick_ns, -(-latest // self.tick_ns) * self.tick_ns
        self._starts_ns.setdefault(frame.lidar_id, []).append(start_ns)
        self._stops_ns[frame.lidar_id] = max(stop_ns, self._stops_ns.get(frame.lidar_id, stop_ns))
        if frame.extrapolated:
            self._extrapolated_ns.setdefault(frame.lidar_id, []).append(start_ns)

    def finish(self) -> None:
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
        self.losses = self.writer.finish()


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
