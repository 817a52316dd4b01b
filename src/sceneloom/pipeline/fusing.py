"""The fuse job: one scene in, one fused scene, depth images and visualisations out; its outputs, counts and report."""

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.colouring.results import FusedFrame
from sceneloom.editing.references import assumed, skipped
from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import check_output, filling
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, chosen_algorithm
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.motion.deskew import PointTimesStatistics
from sceneloom.motion.ego_trajectory import placeable_lidars
from sceneloom.pipeline.alignment import Aligned, align
from sceneloom.pipeline.outputs import DepthFolder, SceneSink, lidar_folders, spread
from sceneloom.pipeline.play import Skips, build_system, check_any_placed, check_has_lidar, play, reported_once, telling
from sceneloom.scene.point_times import PointTimes
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Progress
from sceneloom.stages import stage, timed
from sceneloom.visualization.canvas import counting_left_out
from sceneloom.visualization.fused_frames import MOST_SWEEPS, DriveCloud, save_images
from sceneloom.warnings import DataWarning


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


@dataclass(slots=True)
class _CameraStatistics:
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

    cameras: dict[Identifier, _CameraStatistics]
    moving: frozenset[Identifier] = frozenset()
    frames: int = 0
    fused: int = 0
    extrapolated: int = 0
    points: int = 0
    coloured: int = 0
    times: PointTimesStatistics = field(default_factory=PointTimesStatistics)
    timeless: int = 0
    non_finite: int = 0
    unfused: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, aligned: Aligned) -> "FusionStatistics":
        """Nothing counted yet of a drive."""
        stationary = aligned.ego is not None and aligned.ego.path.static
        moving = [] if stationary else placeable_lidars(aligned.scene)
        cameras = {camera.id: _CameraStatistics(len(camera.images)) for camera in aligned.scene.cameras}
        return cls(cameras, frozenset(lidar.id for lidar in moving))

    def add(self, frame: FusedFrame) -> None:
        """Count one sweep."""
        self.frames += 1
        self.points += len(frame.points)
        self.non_finite += int(np.count_nonzero(~np.isfinite(frame.points.positions).all(axis=1)))
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
        if frame.points.camera_index is not None:
            by_index = np.bincount(frame.points.camera_index, minlength=256)[:255].tolist()
            for statistics, count in zip(self.cameras.values(), by_index, strict=False):
                statistics.coloured += count
            self.coloured += sum(by_index)

    def warnings(self) -> tuple[DataWarning, ...]:
        """What had to be assumed about the sweeps."""
        return (*self.times.warnings(), *(warning for warning in self._found() if warning.count))

    def _found(self) -> tuple[DataWarning, DataWarning]:
        timeless = (
            "points have no times of their own; they were taken as measured at their sweep's time, and what the ego "
            "moved during a sweep stays in them"
        )
        non_finite = "points without finite coordinates were kept as they are; they get no colour and no depth"
        points = "sensors[].frames[].points"
        return (
            assumed("no-point-times", f"{points}.timestamps", timeless, count=self.timeless),
            skipped("points-not-finite", f"{points}.positions", non_finite, count=self.non_finite),
        )

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
    """Join the two ways to name the scene file, and refuse outputs that cannot be."""
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
    begun = time.perf_counter()
    with timed() as stages:
        settings = _configured(configuration, algorithm)
        check_has_lidar(scene, "fusing needs")
        wanted = _checked_outputs(outputs or FusionOutputs(), output)
        steps, skips = _Steps(progress), Skips() if lenient else None
        aligned = align(
            scene,
            trajectory=trajectory,
            heading=heading,
            start=start,
            stop=stop,
            lenient=lenient,
            progress=steps.estimating,
        )
        system = build_system(aligned.scene, aligned.ego, settings, skips)
        statistics = FusionStatistics.of(aligned)
        with telling(skips), stage("writing"), counting_left_out() as left, ExitStack() as stack:
            sinks = _Sinks.open(aligned, wanted, stack, skips)
            with stage("fusing"):
                for frame in play(aligned.scene, system, skips=skips):
                    statistics.add(frame)
                    with stage("writing"):
                        sinks.add(frame)
                    steps.fusing(statistics.frames, aligned.sweeps)
            check_any_placed(aligned.scene, statistics.unfused, statistics.frames, "fused")
            losses = sinks.finish()
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
        seconds=time.perf_counter() - begun,
        stages=dict(stages),
        losses=losses,
        warnings=(*reported_once(aligned.scene.warnings, statistics.warnings()), *left.warnings),
    )


def _configured(configuration: FusionConfiguration | None, algorithm: AlgorithmChoice | None) -> FusionConfiguration:
    settings = configuration or FusionConfiguration()
    chosen = settings.fusion_algorithm if algorithm is None else algorithm
    return replace(settings, fusion_algorithm=chosen_algorithm(FusionType.SENSOR_DATA, chosen))


@dataclass(slots=True)
class _Sinks:
    """The open outputs of a fusion."""

    scene: SceneSink | None = None
    depth: DepthFolder | None = None
    images: "_ImageSink | None" = None

    @classmethod
    def open(cls, aligned: Aligned, wanted: FusionOutputs, stack: ExitStack, skips: Skips | None) -> "_Sinks":
        """Open every wanted output; an error later removes all of them again."""
        sinks = cls()
        if wanted.depth is not None:
            folder = stack.enter_context(filling(wanted.depth, overwrite=wanted.overwrite))
            sinks.depth = DepthFolder.of(folder, aligned.scene, wanted.depth_format)
        if wanted.images is not None:
            folder = stack.enter_context(filling(wanted.images, overwrite=wanted.overwrite))
            sinks.images = _ImageSink(
                folder,
                lidar_folders(folder, aligned.scene),
                spread(aligned.scene, _IMAGES_PER_DRIVE, every=wanted.images_every),
                DriveCloud(spread(aligned.scene, MOST_SWEEPS)),
                None if aligned.ego is None else aligned.ego.path,
            )
        if wanted.scene is not None:
            sinks.scene = SceneSink.open(
                aligned,
                wanted.scene,
                stack,
                skips,
                profile=wanted.profile,
                time_unit=wanted.time_unit,
                overwrite=wanted.overwrite,
            )
        return sinks

    def add(self, frame: FusedFrame) -> None:
        """Take one result."""
        if self.scene is not None:
            self.scene.add(frame)
        if self.depth is not None:
            for view in frame.views:
                self.depth.write(frame, view, view.depth_image)
        if self.images is not None:
            self.images.add(frame)

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


@dataclass(slots=True)
class _ImageSink:
    """Draws some of the sweeps for people to look at, and the drive as one cloud.

    Attributes:
        ego_poses: the ego trajectory, drawn into the clouds; None where it is not known.
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


@dataclass(slots=True)
class _Steps:
    """Reports two passes over the sweeps as one: estimating the ego trajectory, if it must be, and fusing."""

    reported: Progress | None
    estimated: int = 0

    def estimating(self, done: int, total: int) -> None:
        self.estimated = total
        if self.reported is not None:
            self.reported(done, 2 * total)

    def fusing(self, done: int, total: int) -> None:
        if self.reported is not None:
            self.reported(self.estimated + done, self.estimated + total)
