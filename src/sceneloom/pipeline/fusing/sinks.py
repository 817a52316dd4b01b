"""Where the results of a fusion go: a scene file, depth images, images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np

from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.errors import DataError
from sceneloom.formats.depth_images import write_depth_npz, write_depth_png
from sceneloom.formats.file_names import file_stems
from sceneloom.formats.loss import LossReport
from sceneloom.formats.sfs.times import TICKS_NS
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.images.drive_cloud import DriveCloud
from sceneloom.images.sheets import save_images
from sceneloom.motion.sensor_paths import sensor_path
from sceneloom.pipeline.play import Skips
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier


class Sink(Protocol):
    """Takes the results of a fusion, one after another."""

    def add(self, frame: FusedFrame) -> None:
        """Take one result."""
        ...


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
        tick_ns = TICKS_NS[self.time_unit]
        start_ns, stop_ns = _start_ns(frame, tick_ns), _stop_ns(frame, tick_ns)
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


def _start_ns(frame: FusedFrame, tick_ns: int) -> int:
    """The frame's time in the file: that of its earliest point, rounded down, so that it starts after no point."""
    times = frame.points.timestamps_ns
    earliest = frame.timestamp_ns if times is None or len(times) == 0 else int(times.min())
    return earliest // tick_ns * tick_ns


def _stop_ns(frame: FusedFrame, tick_ns: int) -> int:
    """The time of the frame's latest point, rounded up to the file's unit."""
    times = frame.points.timestamps_ns
    latest = frame.timestamp_ns if times is None or len(times) == 0 else int(times.max())
    return -(-latest // tick_ns) * tick_ns


@dataclass(slots=True)
class DepthSink:
    """Writes one depth image per view: `<camera>/<frame number>.png`, or `.npz`; of several lidars below `<lidar>/`.

    Attributes:
        folders: of the views of each lidar.
        names: of the folder of each camera therein.
        form: "png" (16 bit, metres times 256) or "npz" (float32 metres).
        index: file of JSON lines that says of each image which sweep and which image it is of, and their times.
        written: files so far.
        beyond_range: pixels that the form cannot hold.
    """

    folders: Mapping[Identifier, Path]
    names: Mapping[Identifier, str]
    form: str
    index: Path
    written: int = 0
    beyond_range: int = 0

    def add(self, frame: FusedFrame) -> None:
        """Write the views of one sweep."""
        for view in frame.views:
            folder = self.folders[frame.lidar_id] / self.names[view.camera_id]
            folder.mkdir(parents=True, exist_ok=True)
            target = folder / f"{frame.index:06d}.{self.form}"
            if self.form == "npz":
                write_depth_npz(view.depth_image, target)
            else:
                self.beyond_range += write_depth_png(view.depth_image, target)
            self._note(frame, view, target)
            self.written += 1

    def _note(self, frame: FusedFrame, view: FusedView, image: Path) -> None:
        record = {
            "file": image.relative_to(self.index.parent).as_posix(),
            "lidar": frame.lidar_id,
            "sweep_ns": frame.timestamp_ns,
            "camera": view.camera_id,
            "image_ns": view.timestamp_ns,
        }
        with self.index.open("ab") as lines:
            lines.write(msgspec.json.encode(record) + b"\n")


@dataclass(slots=True)
class ImageSink:
    """Draws some of the sweeps for people to look at, and the drive as one cloud.

    Attributes:
        folder: of the images of the drive.
        folders: of the images of each lidar.
        chosen: numbers of the sweeps to draw.
        cloud: gathers the drive.
        ego_poses: the ego trajectory, drawn into the clouds; None where it is not known.
        written: files so far.
    """

    folder: Path
    folders: Mapping[Identifier, Path]
    chosen: frozenset[int]
    cloud: DriveCloud
    ego_poses: Poses | None = None
    written: int = 0

    def add(self, frame: FusedFrame) -> None:
        """Draw the sweep if it is chosen."""
        self.cloud.add(frame)
        if frame.index in self.chosen and frame.unfused is None:
            folder = self.folders[frame.lidar_id]
            self.written += len(save_images(frame, folder, frame.index, ego_poses=self.ego_poses))

    def finish(self) -> None:
        """Draw the drive."""
        self.written += len(self.cloud.save(self.folder, self.ego_poses))


def lidar_folders(folder: Path, scene: Scene) -> Mapping[Identifier, Path]:
    """Where the files of each lidar go: a folder of its own where there are several."""
    names = names_of(scene.lidars)
    return {lidar_id: folder / name if len(names) > 1 else folder for lidar_id, name in names.items()}


def names_of(sensors: Sequence[LidarSensor] | Sequence[CameraSensor]) -> Mapping[Identifier, str]:
    """The part of a file name that stands for each sensor."""
    ids: list[Identifier] = [sensor.id for sensor in sensors]
    return dict(zip(ids, file_stems(ids), strict=True))
