"""The fuse job: one scene in, one fused scene, depth images and visualisations out.

Outputs, sinks and report stand here, too.
"""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np

from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.formats.base.images import write_depth_npz, write_depth_png
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import check_output, file_stems, filling
from sceneloom.formats.sfs.clock import TICKS_NS
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, chosen_algorithm
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.motion.deskew import PointTimesStatistics
from sceneloom.motion.ego_trajectory import placeable_lidars
from sceneloom.pipeline.alignment import Aligned, align, output_scene, provenance
from sceneloom.pipeline.play import Skips, build_system, check_has_lidar, play, telling
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import sensor_path
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import PointTimes
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns, time_span
from sceneloom.scene.types import Identifier, Progress
from sceneloom.stages import stage, timed
from sceneloom.visualization.canvas import counting_left_out
from sceneloom.visualization.fused_frames import MOST_SWEEPS, DriveCloud, save_images
from sceneloom.warnings import DataWarning, WarningKind


class CameraReport(msgspec.Struct, frozen=True, kw_only=True):
    """One camera's part in a fusion.

    Attributes:
        camera: its id.
        images: how many the scene has.
        paired: sweeps that were fused with one of its images.
        unpaired: sweeps without an image near enough in time.
        unposed: sweeps whose image lies beyond the reach of the trajectory.
        in_image_percent: share of all points of the paired sweeps that fall into the image.
        hidden_percent: share of those that lie behind a nearer surface.
        coloured: points that got their colour from this camera.
    """

    camera: Identifier
    images: int
    paired: int
    unpaired: int
    unposed: int
    in_image_percent: float
    hidden_percent: float
    coloured: int


class FusionReport(msgspec.Struct, frozen=True, kw_only=True):
    """One fusion.

    Attributes:
        source: what was fused.
        output: the scene file written, or None.
        trajectory: name of the ego trajectory that the scene stands on, or None where its own poses were used.
        frames: sweeps that were read.
        fused: sweeps that were fused, and that the scene file, where one is written, can hold.
        extrapolated: sweeps that needed poses beyond the trajectory's ends.
        unfused: why the others were not fused, with counts.
        skipped: sweeps and images that could not be read, and sweeps that the file cannot hold, one line each.
        points: points of all sweeps.
        coloured_percent: share of them that got a colour.
        cameras: one report per camera.
        files: further files written, with counts by kind.
        depth_beyond_range: pixels too far for the depth image's format.
        seconds: how long it took.
        stages: how much of that by stage: reading, fusing, writing …
        losses: what the scene file could not hold.
        warnings: what was assumed, repaired or left out on reading and fusing.
    """

    source: str
    output: str | None
    trajectory: str | None
    frames: int
    fused: int
    extrapolated: int
    unfused: dict[str, int]
    skipped: tuple[str, ...]
    points: int
    coloured_percent: float
    cameras: tuple[CameraReport, ...]
    files: dict[str, int]
    depth_beyond_range: int
    seconds: float
    stages: Mapping[str, float]
    losses: LossReport
    warnings: tuple[DataWarning, ...]

    @property
    def frames_per_second(self) -> float:
        """Sweeps a second."""
        return self.frames / self.seconds if self.seconds > 0 else 0.0


def reported_once(before: tuple[DataWarning, ...], own: tuple[DataWarning, ...]) -> tuple[DataWarning, ...]:
    """Add notes on the sweeps to those that were made before, but for what the odometry has stated already."""
    stated = {warning.code for warning in before}
    return (*before, *(warning for warning in own if warning.code not in stated))


@dataclass(slots=True)
class CameraStatistics:
    """Counts of one camera while frames pass."""

    images: int
    paired: int = 0
    unpaired: int = 0
    unposed: int = 0
    points: int = 0
    in_image: int = 0
    hidden: int = 0
    coloured: int = 0

    def add(self, in_image: int, hidden: int, points: int) -> None:
        """Count one view of a sweep: its points in the image, hidden ones among them, and all its points."""
        self.paired += 1
        self.points += points
        self.in_image += in_image
        self.hidden += hidden

    def report(self, camera_id: Identifier) -> CameraReport:
        """The counts as shares."""
        return CameraReport(
            camera=camera_id,
            images=self.images,
            paired=self.paired,
            unpaired=self.unpaired,
            unposed=self.unposed,
            in_image_percent=_percent(self.in_image, self.points),
            hidden_percent=_percent(self.hidden, self.in_image),
            coloured=self.coloured,
        )


@dataclass(slots=True)
class FusionStatistics:
    """Counts while frames pass.

    Attributes:
        cameras: by id, in the scene's order.
        moving: lidars whose points the ego carries along, so that the time of each counts.
    """

    cameras: dict[Identifier, CameraStatistics]
    moving: frozenset[Identifier] = frozenset()
    frames: int = 0
    fused: int = 0
    extrapolated: int = 0
    points: int = 0
    coloured: int = 0
    times: PointTimesStatistics = field(default_factory=PointTimesStatistics)
    timeless: int = 0
    nowhere: int = 0
    unfused: dict[str, int] = field(default_factory=dict)

    def add(self, frame: FusedFrame) -> None:
        """Count one sweep."""
        self.frames += 1
        self.points += len(frame.points)
        self.nowhere += int(np.count_nonzero(~np.isfinite(frame.points.positions).all(axis=1)))
        self.times.add(frame.times)
        self.timeless += frame.times.kind is PointTimes.ABSENT and frame.lidar_id in self.moving
        if frame.unfused is not None:
            reason = frame.unfused.split(":", maxsplit=1)[0]
            self.unfused[reason] = self.unfused.get(reason, 0) + 1
            return
        self.fused += 1
        self.extrapolated += frame.extrapolated
        self._add_cameras(frame)

    def _add_cameras(self, frame: FusedFrame) -> None:
        for view in frame.views:
            hidden = int(np.count_nonzero(~view.visible))
            self.cameras[view.camera_id].add(len(view.point_ids), hidden, len(frame.points))
        for camera_id in frame.unpaired:
            self.cameras[camera_id].unpaired += 1
        for camera_id in frame.unposed:
            self.cameras[camera_id].unposed += 1
        if frame.points.camera_index is None:
            return
        by_index = np.bincount(frame.points.camera_index, minlength=256)[:255].tolist()
        for statistics, count in zip(self.cameras.values(), by_index, strict=False):
            statistics.coloured += count
        self.coloured += sum(by_index)

    def warnings(self) -> tuple[DataWarning, ...]:
        """What had to be assumed about the sweeps."""
        return (*self.times.warnings(), *self._timeless_warning(), *self._non_finite_warning())

    def _non_finite_warning(self) -> list[DataWarning]:
        if not self.nowhere:
            return []
        message = "points whose location is not finite were kept as they are; they get no colour and no depth"
        location, kind = "sensors[].frames[].points.positions", WarningKind.SKIPPED
        return [
            DataWarning(
                kind=kind, code="points-not-finite", location=location, message=message, count=self.nowhere
            )
        ]

    def _timeless_warning(self) -> list[DataWarning]:
        if not self.timeless:
            return []
        message = (
            "points have no times of their own; they were taken as measured at their sweep's time, "
            "and what the ego moved during a sweep stays in them"
        )
        location, kind = "sensors[].frames[].points.timestamps", WarningKind.ASSUMED
        return [
            DataWarning(
                kind=kind, code="no-point-times", location=location, message=message, count=self.timeless
            )
        ]

    @property
    def camera_reports(self) -> tuple[CameraReport, ...]:
        """A report for each camera."""
        return tuple(camera.report(camera_id) for camera_id, camera in self.cameras.items())

    @property
    def coloured_percent(self) -> float:
        """Share of all points that got a colour."""
        return _percent(self.coloured, self.points)


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 0.0


class _Sink(Protocol):
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
class _DepthSink:
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
class _ImageSink:
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


_IMAGES_PER_DRIVE = 8


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


def _checked_outputs(outputs: FusionOutputs, output: str | Path | None) -> FusionOutputs:
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
class _Sinks:
    """The open outputs of a fusion."""

    scene: SceneSink | None = None
    depth: _DepthSink | None = None
    images: _ImageSink | None = None

    @property
    def all(self) -> list[_Sink]:
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


def _open_sinks(aligned: Aligned, wanted: FusionOutputs, stack: ExitStack, skips: Skips | None) -> _Sinks:
    """Open every wanted output; what goes wrong later takes all of them away again.

    Raises:
        OutputError: an output exists, or cannot be made.
        DataError: something that goes into the scene file at once cannot be read.
    """
    sinks = _Sinks()
    if wanted.depth is not None:
        folder = stack.enter_context(filling(wanted.depth, overwrite=wanted.overwrite))
        sinks.depth = _DepthSink(
            lidar_folders(folder, aligned.scene),
            names_of(aligned.scene.cameras),
            wanted.depth_format,
            folder / "index.jsonl",
        )
    if wanted.images is not None:
        folder = stack.enter_context(filling(wanted.images, overwrite=wanted.overwrite))
        sinks.images = _ImageSink(
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
        spread(scene, _IMAGES_PER_DRIVE) if every is None else frozenset(range(0, _most_sweeps(scene), every))
    )


def spread(scene: Scene, most: int) -> frozenset[int]:
    """Numbers of at most so many sweeps, spread over the drive."""
    count = _most_sweeps(scene)
    return frozenset(np.linspace(0, count - 1, min(most, count)).astype(int).tolist())


def _most_sweeps(scene: Scene) -> int:
    return max((len(lidar.frames) for lidar in scene.lidars), default=0)


def iter_fused(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    algorithm: AlgorithmChoice | None = None,
    configuration: FusionConfiguration | None = None,
) -> Iterator[FusedFrame]:
    """Fuse a scene sweep by sweep without writing anything.

    Args:
        trajectory: name of the ego trajectory; "identity" for an ego that is stationary; "lidar" to find it from the
            sweeps; None for the scene's default, which is found from the sweeps where the scene has none.
        heading: "motion" to derive orientations where the trajectory has positions only.
        algorithm: a function that is called as `colouring.FusionAlgorithm`, the name of an installed algorithm, or
            "file.py:function"; None for what the configuration says.
        configuration: settings of the fusion system.

    Yields:
        One result per sweep: world points relative to the ego's first position, colours, views.

    Raises:
        PoseError: the sensors' motion is not known.
        DataError: a sweep or an image cannot be read.
        OptionError: an algorithm is not there, or does not give what it should.
    """
    settings = _configured(configuration, algorithm)
    aligned = align(scene, trajectory=trajectory, heading=heading)
    yield from play(aligned.scene, build_system(aligned.scene, aligned.ego, settings))


def fuse(
    scene: Scene,
    output: str | Path | None = None,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    algorithm: AlgorithmChoice | None = None,
    outputs: FusionOutputs | None = None,
    configuration: FusionConfiguration | None = None,
    lenient: bool = False,
    progress: Progress | None = None,
) -> FusionReport:
    """Fuse lidar and cameras of a scene and write the fused scene, depth images and images.

    Args:
        output: the `.sfs` file to write; the same as `outputs.scene`.
        trajectory: name of the ego trajectory; "identity" for an ego that is stationary; "lidar" to find it from the
            sweeps; None for the scene's default, which is found from the sweeps where the scene has none.
        heading: "motion" to derive orientations where the trajectory has positions only.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        outputs: where to write what, and how.
        algorithm: a function that is called as `colouring.FusionAlgorithm`, the name of an installed algorithm, or
            "file.py:function"; None for what the configuration says.
        configuration: settings of the fusion system.
        lenient: count sweeps and images that cannot be read, and go on.
        progress: reported after each sweep; each counts twice where the ego trajectory is found from the sweeps first.

    Returns:
        What was done, in numbers, with all losses and warnings.

    Raises:
        PoseError: the sensors' motion is not known, or at the time of no sweep.
        DataError: there is no lidar, or a sweep or an image cannot be read.
        OutputError: an output exists, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    with timed() as stages:
        report = _fuse(
            scene,
            output,
            trajectory=trajectory,
            heading=heading,
            start=start,
            stop=stop,
            outputs=outputs,
            configuration=_configured(configuration, algorithm),
            lenient=lenient,
            progress=progress,
        )
    return msgspec.structs.replace(report, stages=dict(stages))


def _configured(
    configuration: FusionConfiguration | None, algorithm: AlgorithmChoice | None
) -> FusionConfiguration:
    settings = configuration or FusionConfiguration()
    chosen = settings.fusion_algorithm if algorithm is None else algorithm
    return replace(settings, fusion_algorithm=chosen_algorithm(FusionType.SENSOR_DATA, chosen))


def _fuse(
    scene: Scene,
    output: str | Path | None,
    *,
    trajectory: str | None,
    heading: str | None,
    start: float | None,
    stop: float | None,
    outputs: FusionOutputs | None,
    configuration: FusionConfiguration,
    lenient: bool,
    progress: Progress | None,
) -> FusionReport:
    begun = time.perf_counter()
    check_has_lidar(scene, "fusing needs")
    wanted = _checked_outputs(outputs or FusionOutputs(), output)
    steps = _Steps(progress)
    aligned = align(
        scene,
        trajectory=trajectory,
        heading=heading,
        start=start,
        stop=stop,
        lenient=lenient,
        progress=steps.finding,
    )
    skips = Skips() if lenient else None
    system = build_system(aligned.scene, aligned.ego, configuration)
    if skips is not None:
        system.on_unreadable = skips.add
    frames = play(aligned.scene, system, skips=skips)
    return _write_fused(aligned, wanted, frames, skips, begun=begun, progress=steps.fusing)


def _write_fused(
    aligned: Aligned,
    wanted: FusionOutputs,
    frames: Iterable[FusedFrame],
    skips: Skips | None,
    *,
    begun: float,
    progress: Progress | None = None,
) -> FusionReport:
    """Write fused sweeps, in the order in which they come, and everything else of the drive.

    Args:
        aligned: the drive.
        wanted: where to write what, checked before.
        frames: the sweeps.
        skips: what could not be read is or will be in there; None where that is an error.
        begun: when the work began, by `time.perf_counter` [s].
        progress: reported after each sweep.

    Raises:
        PoseError: no sweep could be fused.
        DataError: something cannot be read.
        OutputError: an output exists, or cannot be written.
    """
    statistics = _statistics(aligned)
    total = sum(len(lidar.frames) for lidar in aligned.scene.lidars)
    with telling(skips), stage("writing"), counting_left_out() as left, ExitStack() as stack:
        sinks = _open_sinks(aligned, wanted, stack, skips)
        with stage("fusing"):
            for done, frame in enumerate(frames, start=1):
                statistics.add(frame)
                _write(sinks, frame)
                if progress is not None:
                    progress(done, total)
        _refuse_nothing_fused(aligned.scene, statistics)
        losses = sinks.finish()
    seconds = time.perf_counter() - begun
    report = _report(aligned, wanted, statistics, sinks, skips, seconds=seconds, losses=losses)
    return msgspec.structs.replace(report, warnings=(*report.warnings, *left.warnings))


def _write(sinks: _Sinks, frame: FusedFrame) -> None:
    with stage("writing"):
        for sink in sinks.all:
            sink.add(frame)


def _report(
    aligned: Aligned,
    wanted: FusionOutputs,
    statistics: FusionStatistics,
    sinks: _Sinks,
    skips: Skips | None,
    *,
    seconds: float,
    losses: LossReport,
) -> FusionReport:
    return FusionReport(
        source=aligned.scene.source,
        output=None if wanted.scene is None else str(wanted.scene),
        trajectory=None if aligned.ego is None else aligned.ego.name,
        frames=statistics.frames,
        fused=statistics.fused - (0 if sinks.scene is None else sinks.scene.left_out),
        extrapolated=statistics.extrapolated,
        unfused=statistics.unfused,
        skipped=() if skips is None else tuple(skips.reasons),
        points=statistics.points,
        coloured_percent=statistics.coloured_percent,
        cameras=statistics.camera_reports,
        files=sinks.files,
        depth_beyond_range=0 if sinks.depth is None else sinks.depth.beyond_range,
        seconds=seconds,
        stages={},
        losses=losses,
        warnings=reported_once(aligned.scene.warnings, statistics.warnings()),
    )


def _statistics(aligned: Aligned) -> FusionStatistics:
    stands = aligned.ego is not None and aligned.ego.path.static
    carried = [] if stands else placeable_lidars(aligned.scene)
    return FusionStatistics(
        {camera.id: CameraStatistics(len(camera.images)) for camera in aligned.scene.cameras},
        frozenset(lidar.id for lidar in carried),
    )


def _refuse_nothing_fused(scene: Scene, statistics: FusionStatistics) -> None:
    if statistics.unfused and not statistics.fused:
        reasons = ", ".join(f"{reason} ({count} times)" for reason, count in statistics.unfused.items())
        raise PoseError(
            f"{scene.source}: none of {statistics.frames} sweeps could be fused: {reasons}; expected a trajectory on "
            f"the "
            "clock of the sweeps; `sceneloom info` reports both spans, and `--trajectory lidar` needs none"
        )


@dataclass(slots=True)
class _Steps:
    """Reports of two passes over the sweeps as of one: finding the ego trajectory, where it must be found.

    And fusing.
    """

    reported: Progress | None
    found: int = 0

    def finding(self, done: int, total: int) -> None:
        self.found = total
        if self.reported is not None:
            self.reported(done, 2 * total)

    def fusing(self, done: int, total: int) -> None:
        if self.reported is not None:
            self.reported(self.found + done, self.found + total)
