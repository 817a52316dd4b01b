"""The fuse job: one scene in, one fused scene, depth images and visualisations out; its outputs, counts and report."""

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import finite_rows
from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import check_output, filling
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, chosen_algorithm
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.motion.deskew import PointTimesStatistics
from sceneloom.motion.ego_trajectory import placeable_lidars
from sceneloom.pipeline.alignment import Aligned, align
from sceneloom.pipeline.outputs import DepthFolder, ImageSink, SceneSink
from sceneloom.pipeline.play import (
    Skips,
    build_system,
    check_any_placed,
    check_has_lidar,
    play,
    report_of,
    reported_once,
    telling,
)
from sceneloom.scene.point_times import PointTimes
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Progress
from sceneloom.stages import stage, timed
from sceneloom.visualization.canvas import counting_left_out
from sceneloom.warnings import DataWarning, assumed, skipped


class CameraReport(msgspec.Struct, frozen=True, kw_only=True):
    """One camera's part in a fusion.

    Attributes:
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
        output: the scene file written, or None.
        trajectory: name of the ego trajectory that the scene stands on, or None where its own poses were used.
        frames: sweeps that were read.
        fused: sweeps that were fused, and that the scene file, where one is written, can hold.
        extrapolated: sweeps that needed poses beyond the trajectory's ends.
        unfused: why the others were not fused, with counts.
        skipped: sweeps and images that could not be read, and sweeps that the file cannot hold, one line each.
        points: points of all sweeps.
        coloured_percent: share of them that got a colour.
        depth_beyond_range: pixels too far for the depth image's format.
        stages: how much of that by stage: reading, fusing, writing …
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
class FusionStatistics:
    """Counts while frames pass.

    Attributes:
        counts: of each camera by id, in the scene's order, under the names of `CameraReport` and for its shares.
        moving: lidars whose points the ego carries along, so that the time of each counts.
    """

    counts: dict[Identifier, Counter[str]]
    moving: frozenset[Identifier] = frozenset()
    frames: int = 0
    fused: int = 0
    extrapolated: int = 0
    points: int = 0
    times: PointTimesStatistics = field(default_factory=PointTimesStatistics)
    timeless: int = 0
    non_finite: int = 0
    unfused: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, aligned: Aligned) -> "FusionStatistics":
        """Nothing counted yet of a drive."""
        stationary = aligned.ego is not None and aligned.ego.path.static
        moving = [] if stationary else placeable_lidars(aligned.scene)
        counts = {camera.id: Counter(images=len(camera.images)) for camera in aligned.scene.cameras}
        return cls(counts, frozenset(lidar.id for lidar in moving))

    def add(self, frame: FusedFrame) -> None:
        """Count one sweep."""
        count = len(frame.points)
        self.frames += 1
        self.points += count
        self.non_finite += int(np.count_nonzero(~finite_rows(frame.points.positions)))
        self.times.add(frame.times)
        self.timeless += frame.times.kind is PointTimes.ABSENT and frame.lidar_id in self.moving
        if frame.unfused is not None:
            reason = frame.unfused.split(":", maxsplit=1)[0]
            self.unfused[reason] = self.unfused.get(reason, 0) + 1
            return
        self.fused += 1
        self.extrapolated += frame.extrapolated
        for view in frame.views:
            hidden = int(np.count_nonzero(~view.visible))
            seen = {"paired": 1, "points": count, "in_image": len(view.point_ids), "hidden": hidden}
            self.counts[view.camera_id].update(seen)
        for camera_id in frame.unpaired:
            self.counts[camera_id]["unpaired"] += 1
        for camera_id in frame.unposed:
            self.counts[camera_id]["unposed"] += 1
        if frame.points.camera_index is not None:
            by_index = np.bincount(frame.points.camera_index, minlength=256)[:255].tolist()
            for counts, coloured in zip(self.counts.values(), by_index, strict=False):
                counts["coloured"] += coloured

    def warnings(self) -> tuple[DataWarning, ...]:
        """What had to be assumed about the sweeps."""
        timeless = (
            "points have no times of their own; they were taken as measured at their sweep's time, and what the ego "
            "moved during a sweep stays in them"
        )
        non_finite = "points without finite coordinates were kept as they are; they get no colour and no depth"
        points = "sensors[].frames[].points"
        found = (
            assumed("no-point-times", f"{points}.timestamps", timeless, count=self.timeless),
            skipped("points-not-finite", f"{points}.positions", non_finite, count=self.non_finite),
        )
        return (*self.times.warnings(), *(warning for warning in found if warning.count))

    @property
    def cameras(self) -> tuple[CameraReport, ...]:
        """A report for each camera."""
        return tuple(
            CameraReport(
                camera=camera_id,
                in_image_percent=percent(counts["in_image"], counts["points"]),
                hidden_percent=percent(counts["hidden"], counts["in_image"]),
                **{name: counts[name] for name in ("images", "paired", "unpaired", "unposed", "coloured")},
            )
            for camera_id, counts in self.counts.items()
        )

    @property
    def coloured_percent(self) -> float:
        """Share of all points that got a colour."""
        return percent(sum(counts["coloured"] for counts in self.counts.values()), self.points)


def percent(part: int, whole: int) -> float:
    """A share in percent; 0 of nothing."""
    return 100.0 * part / whole if whole else 0.0


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
    """

    scene: Path | None = None
    depth: Path | None = None
    depth_format: str = "png"
    images: Path | None = None
    images_every: int | None = None
    profile: str = "sfs"
    time_unit: str = "microseconds"
    overwrite: bool = False

    def check(self) -> None:
        """Refuse outputs that cannot be, before much is done.

        Raises:
            OptionError: a value is not one that can be followed.
            OutputError: an output exists, or its folder is missing.
        """
        if self.depth_format not in {"png", "npz"}:
            raise OptionError(f"depth_format {self.depth_format!r}; expected 'png' or 'npz'")
        if self.images_every is not None and self.images_every < 1:
            raise OptionError(f"images_every {self.images_every}; expected 1 or more")
        if self.scene is not None and self.scene.suffix.lower() != ".sfs":
            raise OptionError(f"{self.scene}: fusing writes scene files; expected a name that ends in .sfs")
        folders = [folder.absolute() for folder in (self.depth, self.images) if folder is not None]
        if self.scene is not None and self.scene.absolute() in folders:
            raise OptionError(f"{self.scene}: named for a file and for a folder; expected two names")
        for location in (self.scene, self.depth, self.images):
            if location is not None:
                check_output(location, overwrite=self.overwrite)


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

    Yields:
        One result per sweep: world points relative to the ego's first position, colours, views.

    Raises:
        PoseError: the sensors' motion is not known.
        DataError: a sweep or an image cannot be read.
        OptionError: an algorithm is not there, or does not give what it should.
    """
    settings = _configured(configuration, algorithm)
    aligned = align(scene, trajectory=trajectory, heading=heading)
    skips = Skips(lenient=False)
    yield from play(aligned.scene, build_system(aligned.scene, aligned.ego, settings, skips), skips)


def fuse(
    scene: Scene, output: str | Path | None = None, *, trajectory: str | None = None, heading: str | None = None,
    start: float | None = None, stop: float | None = None, algorithm: AlgorithmChoice | None = None,
    outputs: FusionOutputs | None = None, configuration: FusionConfiguration | None = None, lenient: bool = False,
    progress: Progress | None = None,
) -> FusionReport:  # fmt: skip
    """Fuse lidar and cameras of a scene and write the fused scene, depth images and images.

    Args:
        output: the `.sfs` file to write; the same as `outputs.scene`.
        trajectory: name of the ego trajectory; "identity" for an ego that is stationary; "lidar" to find it from the
            sweeps; None for the scene's default, which is found from the sweeps where the scene has none.
        heading: "motion" to derive orientations where the trajectory has positions only.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        algorithm: a function that is called as `colouring.FusionAlgorithm`, the name of an installed algorithm, or
            "file.py:function"; None for what the configuration says.
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
        wanted = outputs or FusionOutputs()
        wanted = wanted if output is None else replace(wanted, scene=Path(output))
        wanted.check()  # estimating the trajectory may take long: an output that cannot be is reported before
        skips, estimated = Skips(lenient), 0

        def estimating(done: int, total: int) -> None:
            nonlocal estimated
            estimated = total
            if progress is not None:
                progress(done, 2 * total)

        chosen: dict[str, Any] = {"trajectory": trajectory, "heading": heading, "start": start, "stop": stop}
        aligned = align(scene, **chosen, lenient=lenient, progress=estimating)
        system = build_system(aligned.scene, aligned.ego, settings, skips)
        statistics = FusionStatistics.of(aligned)
        with telling(skips), stage("writing"), counting_left_out() as left, ExitStack() as stack:
            sinks = _open_sinks(aligned, wanted, stack, skips)
            with stage("fusing"):
                for frame in play(aligned.scene, system, skips):
                    statistics.add(frame)
                    with stage("writing"):
                        for sink in sinks.values():
                            sink.add(frame)
                    if progress is not None:
                        progress(estimated + statistics.frames, estimated + aligned.sweeps)
            check_any_placed(aligned.scene, statistics.unfused, statistics.frames, "fused")
            for sink in sinks.values():
                sink.finish()
    written, depth = sinks.pop("scene", None), sinks.get("depth images")
    return report_of(
        FusionReport,
        statistics,
        source=aligned.scene.source,
        output=None if wanted.scene is None else str(wanted.scene),
        trajectory=aligned.trajectory,
        fused=statistics.fused if written is None else written.written,
        skipped=skips.reasons,
        files={kind: sink.written for kind, sink in sinks.items()},
        depth_beyond_range=0 if depth is None else depth.beyond_range,
        seconds=time.perf_counter() - begun,
        stages=dict(stages),
        losses=LossReport() if written is None else written.losses,
        warnings=(*reported_once(aligned.scene.warnings, statistics.warnings()), *left.warnings),
    )


def _configured(configuration: FusionConfiguration | None, algorithm: AlgorithmChoice | None) -> FusionConfiguration:
    settings = configuration or FusionConfiguration()
    chosen = settings.fusion_algorithm if algorithm is None else algorithm
    return replace(settings, fusion_algorithm=chosen_algorithm(FusionType.SENSOR_DATA, chosen))


def _open_sinks(aligned: Aligned, wanted: FusionOutputs, stack: ExitStack, skips: Skips) -> dict[str, Any]:
    """Open every wanted output, by what it holds; an error later removes all of them again."""
    sinks: dict[str, Any] = {}
    if wanted.depth is not None:
        folder = stack.enter_context(filling(wanted.depth, overwrite=wanted.overwrite))
        sinks["depth images"] = DepthFolder(folder, aligned.scene, wanted.depth_format)
    if wanted.images is not None:
        sinks["images"] = ImageSink.open(
            aligned, wanted.images, stack, overwrite=wanted.overwrite, every=wanted.images_every
        )
    if wanted.scene is not None:
        own = {"profile": wanted.profile, "time_unit": wanted.time_unit, "overwrite": wanted.overwrite}
        sinks["scene"] = SceneSink.open(aligned, wanted.scene, stack, skips, **own)  # type: ignore[arg-type]
    return sinks
