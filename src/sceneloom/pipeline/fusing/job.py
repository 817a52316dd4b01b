"""The main job: one scene in, one fused scene out."""

import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import PoseError
from sceneloom.formats.loss import LossReport
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, chosen_algorithm
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.images.canvas import counting_left_out
from sceneloom.motion.ego_motion import placeable_lidars
from sceneloom.pipeline.aligned.scene import Aligned, align
from sceneloom.pipeline.fusing.outputs import FusionOutputs, Sinks, checked_outputs, open_sinks
from sceneloom.pipeline.fusing.report import CameraStatistics, FusionReport, FusionStatistics, reported_once
from sceneloom.pipeline.needed_lidar import check_has_lidar
from sceneloom.pipeline.play import Skips, build_system, play, telling
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Progress
from sceneloom.stages import stage, timed


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
    wanted = checked_outputs(outputs or FusionOutputs(), output)
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
        sinks = open_sinks(aligned, wanted, stack, skips)
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


def _write(sinks: Sinks, frame: FusedFrame) -> None:
    with stage("writing"):
        for sink in sinks.all:
            sink.add(frame)


def _report(
    aligned: Aligned,
    wanted: FusionOutputs,
    statistics: FusionStatistics,
    sinks: Sinks,
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
        cameras=tuple(camera.report(camera_id) for camera_id, camera in statistics.cameras.items()),
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
