"""What a fusion is asked to write, and the opening of it."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import check_output, filling
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.images.drive_cloud import MOST_SWEEPS, DriveCloud
from sceneloom.pipeline.aligned.provenance import provenance
from sceneloom.pipeline.aligned.scene import Aligned, output_scene
from sceneloom.pipeline.fusing.sinks import DepthSink, ImageSink, SceneSink, Sink, lidar_folders, names_of
from sceneloom.pipeline.play import Skips
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import scene_period_ns, time_span

IMAGES_PER_DRIVE = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionOutputs:
    """Where a fusion writes what; None: not at all.

    Attributes:
        scene: the `.sfs` file.
        depth: folder of depth images, one per sweep and image.
        depth_format: "png" (16 bit, metres times 256) or "npz" (float32 metres).
        images: folder of images for people.
        images_every: draw every Nth sweep; None: eight spread over the drive.
        profile: "sfs", or "scale" for a file that Scale's own library accepts.
        time_unit: "microseconds" or "nanoseconds", of the scene file.
        overwrite: whether outputs that exist may be replaced.
    """

    scene: Path | None = None
    depth: Path | None = None
    depth_format: str = "png"
    images: Path | None = None
    images_every: int | None = None
    profile: str = "sfs"
    time_unit: str = "microseconds"
    overwrite: bool = False


def checked_outputs(outputs: FusionOutputs, output: str | Path | None) -> FusionOutputs:
    """Join the two ways to name the scene file, and refuse outputs that cannot be.

    Raises:
        OptionError: a value is not one that can be followed.
        OutputError: an output exists, or its folder is missing.
    """
    wanted = outputs if output is None else replace(outputs, scene=Path(output))
    if wanted.depth_format not in {"png", "npz"}:
        raise OptionError(f"depth_format {wanted.depth_format!r}; expected 'png' or 'npz'")
    if wanted.images_every is not None and wanted.images_every < 1:
        raise OptionError(f"images_every {wanted.images_every}; expected 1 or more")
    if wanted.scene is not None and wanted.scene.suffix.lower() != ".sfs":
        raise OptionError(f"{wanted.scene}: fusing writes scene files; expected a name that ends in .sfs")
    folders = [folder.absolute() for folder in (wanted.depth, wanted.images) if folder is not None]
    if wanted.scene is not None and wanted.scene.absolute() in folders:
        raise OptionError(f"{wanted.scene}: named for a file and for a folder; expected two names")
    # the ego trajectory may take long to find: an output that cannot be is reported before
    for location in (wanted.scene, wanted.depth, wanted.images):
        if location is not None:
            check_output(location, overwrite=wanted.overwrite)
    return wanted


@dataclass(slots=True)
class Sinks:
    """The open outputs of a fusion."""

    scene: SceneSink | None = None
    depth: DepthSink | None = None
    images: ImageSink | None = None

    @property
    def all(self) -> list[Sink]:
        """Those that take every result."""
        return [sink for sink in (self.scene, self.depth, self.images) if sink is not None]

    @property
    def files(self) -> dict[str, int]:
        """How many files of which kind were written."""
        kinds = {"depth images": self.depth, "images": self.images}
        return {kind: sink.written for kind, sink in kinds.items() if sink is not None}

    def finish(self) -> LossReport:
        """Complete them; give what the scene file could not hold."""
        if self.images is not None:
            self.images.finish()
        return LossReport() if self.scene is None else self.scene.finish()


def open_sinks(aligned: Aligned, wanted: FusionOutputs, stack: ExitStack, skips: Skips | None) -> Sinks:
    """Open every wanted output; what goes wrong later takes all of them away again.

    Raises:
        OutputError: an output exists, or cannot be made.
        DataError: something that goes into the scene file at once cannot be read.
    """
    sinks = Sinks()
    if wanted.depth is not None:
        folder = stack.enter_context(filling(wanted.depth, overwrite=wanted.overwrite))
        sinks.depth = DepthSink(
            lidar_folders(folder, aligned.scene),
            names_of(aligned.scene.cameras),
            wanted.depth_format,
            folder / "index.jsonl",
        )
    if wanted.images is not None:
        folder = stack.enter_context(filling(wanted.images, overwrite=wanted.overwrite))
        sinks.images = ImageSink(
            folder,
            lidar_folders(folder, aligned.scene),
            _frames_to_draw(aligned.scene, wanted.images_every),
            DriveCloud(spread(aligned.scene, MOST_SWEEPS)),
            None if aligned.ego is None else aligned.ego.path,
        )
    if wanted.scene is not None:
        sinks.scene = open_scene_sink(aligned, wanted, wanted.scene, stack, skips)
    return sinks


def open_scene_sink(
    aligned: Aligned, wanted: FusionOutputs, target: Path, stack: ExitStack, skips: Skips | None
) -> SceneSink:
    """Begin a scene file with everything of a drive but its sweeps, which follow."""
    scene, sources = output_scene(aligned, reach_ns=scene_period_ns(aligned.scene))
    spans_ns = [span_ns for span_ns in map(time_span, (aligned.scene, scene)) if span_ns is not None]
    writer = stack.enter_context(
        SceneWriter(
            target,
            overwrite=wanted.overwrite,
            profile=wanted.profile,
            time_unit=wanted.time_unit,
            first_ns=min((first_ns for first_ns, _ in spans_ns), default=None),
            frame_count=sum(len(lidar.frames) for lidar in aligned.scene.lidars),
        )
    )
    if skips is None:
        writer.add_scene(scene)
    else:
        _add_readable(writer, scene, skips)
    writer.set_metadata(provenance(aligned))
    return SceneSink(writer, sources, wanted.time_unit, aligned.scene.source, skips)


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


def _frames_to_draw(scene: Scene, every: int | None) -> frozenset[int]:
    """Numbers of the sweeps to draw: every Nth, or some spread over the drive."""
    return (
        spread(scene, IMAGES_PER_DRIVE) if every is None else frozenset(range(0, _most_sweeps(scene), every))
    )


def spread(scene: Scene, most: int) -> frozenset[int]:
    """Numbers of at most so many sweeps, spread over the drive."""
    count = _most_sweeps(scene)
    return frozenset(np.linspace(0, count - 1, min(most, count)).astype(int).tolist())


def _most_sweeps(scene: Scene) -> int:
    return max((len(lidar.frames) for lidar in scene.lidars), default=0)
