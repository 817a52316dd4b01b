"""A drive as coloured clouds: one map, sweeps by themselves, labels carried from images to points and back."""

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray
from sceneloom.colouring.exposure import ExposureGains, ExposureLinks
from sceneloom.colouring.lidar_trajectory import LidarTrajectory
from sceneloom.colouring.moving import MovingPoints, lags_for
from sceneloom.colouring.moving_boxes import MovingBoxes
from sceneloom.colouring.visibility import VisibilitySettings
from sceneloom.errors import PoseError
from sceneloom.formats.label_folders import LabelFolder
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.system import FusionSystem
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.images.canvas import counting_left_out
from sceneloom.motion.ego_motion import placeable_lidars
from sceneloom.pipeline.aligned.scene import Aligned, align
from sceneloom.pipeline.colouring.outputs import ColourSinks, open_colour_sinks
from sceneloom.pipeline.colouring.report import ColourReport, ExposureReport, LabelReport
from sceneloom.pipeline.colouring.settings import ColourOutputs, ColourSettings
from sceneloom.pipeline.colouring.sweeps import ColouredSweep, SweepColouring
from sceneloom.pipeline.fusing.report import CameraStatistics, FusionStatistics, reported_once
from sceneloom.pipeline.needed_lidar import check_has_lidar
from sceneloom.pipeline.play import Skips, build_system, play, telling
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import lidar_position
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Identifier, Progress
from sceneloom.scene.warnings import DataWarning, WarningKind

MOST_COMPARED = 300
"""Sweeps by which exposures are reported at most, spread over the drive."""


def colour(
    scene: Scene,
    output: str | Path | None = None,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    settings: ColourSettings | None = None,
    outputs: ColourOutputs | None = None,
    lenient: bool = False,
    progress: Progress | None = None,
) -> ColourReport:
    """Colour the points of a drive from all cameras that see them, and write them as one map, or sweep by sweep.

    Memory depends on the sweeps in flight and on the tiles of the map around them, not on the length of the drive.

    Args:
        output: the map to write; the same as `outputs.map`.
        trajectory: name of the ego trajectory; "identity" for an ego that is stationary; "lidar" to find it from the
            sweeps; None for the scene's default, which is found from the sweeps where the scene has none.
        heading: "motion" to derive orientations where the trajectory has positions only.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        settings: how to colour.
        outputs: where to write what.
        lenient: count sweeps and images that cannot be read, and go on.
        progress: reported after each sweep; those that exposures are reported by count, too.

    Returns:
        What was done, in numbers.

    Raises:
        PoseError: the sensors' motion is not known, or at the time of no sweep.
        DataError: there is no lidar, something cannot be read, or a label image does not fit its image.
        OutputError: an output exists, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    begun, chosen = time.perf_counter(), settings or ColourSettings()
    wanted = outputs or ColourOutputs()
    wanted = wanted if output is None else replace(wanted, map=Path(output))
    wanted.check()
    check_has_lidar(scene, "colouring needs")
    scene = scene.corrected()
    aligned = align(scene, trajectory=trajectory, heading=heading, start=start, stop=stop, lenient=lenient)
    job = _Job(aligned, scene, chosen, Skips() if lenient else None, progress)
    with telling(job.skips), counting_left_out() as left, ExitStack() as stack:
        labels = None if chosen.labels is None else LabelFolder.of(chosen.labels, scene.cameras)
        gains = job.compare_exposures() if chosen.exposure and len(scene.cameras) else None
        colouring = SweepColouring(scene, chosen.blend, gains, labels)
        rest = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sceneloom-map-")))
        sinks = open_colour_sinks(aligned, wanted, chosen, colouring, stack, rest)
        job.run(colouring, sinks)
        sinks.finish()
    report = _report(job, wanted, colouring, sinks, gains, seconds=time.perf_counter() - begun)
    return msgspec.structs.replace(report, warnings=(*report.warnings, *left.warnings))


@dataclass(slots=True)
class _Job:
    """One colouring under way."""

    aligned: Aligned
    source: Scene
    settings: ColourSettings
    skips: Skips | None
    progress: Progress | None
    statistics: FusionStatistics = field(init=False)
    boxes: MovingBoxes = field(init=False)
    removed_in_boxes: int = 0
    removed_by_rays: int = 0
    unjudged: int = 0
    guessed: int = 0
    coloured: int = 0
    labelled: int = 0
    classes: set[int] = field(default_factory=set)
    _done: int = 0
    _ahead: int = 0

    def __post_init__(self) -> None:
        scene, ego = self.aligned.scene, self.aligned.ego
        stands = ego is not None and ego.path.static
        moving = [] if stands else placeable_lidars(scene)
        self.statistics = FusionStatistics(
            {camera.id: CameraStatistics(len(camera.images)) for camera in scene.cameras},
            frozenset(lidar.id for lidar in moving),
        )
        self.boxes = MovingBoxes.of(scene)

    def compare_exposures(self) -> ExposureGains:
        """Look at the drive a first time, for what images show both."""
        every = max(1, -(-self._sweeps // MOST_COMPARED))
        scene = self.aligned.scene
        thinned = replace(
            scene,
            sensors=tuple(
                replace(sensor, frames=sensor.frames[::every]) if sensor in scene.lidars else sensor
                for sensor in scene.sensors
            ),
        )
        self._ahead = sum(len(lidar.frames) for lidar in thinned.lidars)
        index = {camera.id: k for k, camera in enumerate(scene.cameras)}
        links = ExposureLinks()
        for frame in play(thinned, self._system(), skips=self.skips):
            if frame.views:
                points_world = frame.views[0].points_world
                links.add(points_world, frame.views, [index[view.camera_id] for view in frame.views])
            self._step()
        return links.solve()

    def run(self, colouring: SweepColouring, sinks: ColourSinks) -> None:
        """Colour every sweep and give it to the outputs."""
        locations = self._locations() if self.settings.remove_moving else {}
        finders: dict[Identifier, MovingPoints[ColouredSweep]] = {}
        lags = {lidar.id: lags_for(len(lidar.frames)) for lidar in self.aligned.scene.lidars}
        for frame in play(self.aligned.scene, self._system(), skips=self.skips):
            self.statistics.add(frame)
            self._step()
            if frame.unfused is not None:
                continue
            if sinks.projection is not None:
                sinks.projection.add(frame)
            sweep = colouring.colour(frame)
            self._count(sweep)
            if not self.settings.remove_moving:
                self._give(sweep, np.ones(len(sweep.points), np.bool_), sinks)
                continue
            finder = finders.setdefault(frame.lidar_id, MovingPoints(lags[frame.lidar_id]))
            self._give_judged(
                finder.add(sweep, sweep.frame.points.positions, self._trajectory(sweep, locations)), sinks
            )
        for finder in finders.values():
            self._give_judged(finder.flush(), sinks)
        if self.statistics.unfused and not self.statistics.fused:
            reasons = ", ".join(
                f"{reason} ({count} times)" for reason, count in self.statistics.unfused.items()
            )
            raise PoseError(
                f"{self.source.source}: none of {self.statistics.frames} sweeps could be placed: {reasons}"
            )

    def _give_judged(self, judged: Iterator[tuple[ColouredSweep, BoolArray]], sinks: ColourSinks) -> None:
        for sweep, moving in judged:
            times, positions = sweep.points["time_ns"], sweep.points["position"]
            in_boxes = self.boxes.inside(np.ascontiguousarray(positions), np.ascontiguousarray(times))
            self.removed_in_boxes += int(in_boxes.sum())
            self.removed_by_rays += int((moving & ~in_boxes).sum())
            self._give(sweep, ~(moving | in_boxes), sinks)

    def _give(self, sweep: ColouredSweep, kept: BoolArray, sinks: ColourSinks) -> None:
        if self.settings.only_coloured:
            kept = kept & (sweep.points["weight"] > 0)
        for sink in sinks.all:
            sink.add(sweep, kept)

    def _count(self, sweep: ColouredSweep) -> None:
        self.coloured += int((sweep.points["camera"] != 255).sum())
        if self.settings.labels is not None:
            stated = sweep.points["label"][sweep.points["label"] != 65535]
            self.labelled += len(stated)
            self.classes.update(np.unique(stated).tolist())

    def _trajectory(
        self, sweep: ColouredSweep, locations: dict[Identifier, PoseSource | None]
    ) -> LidarTrajectory | None:
        location = locations[sweep.frame.lidar_id]
        frame = LidarFrame(sweep.frame.timestamp_ns, sweep.frame.points)
        trajectory = None if location is None else LidarTrajectory.of(frame, location)
        self.unjudged += trajectory is None
        return trajectory

    def _locations(self) -> dict[Identifier, PoseSource | None]:
        """From where the lidars measured; the middle of the cameras stands for one that is not known."""
        scene, ego, reach_ns = self.aligned.scene, self.aligned.ego, scene_period_ns(self.aligned.scene)
        mounts = [camera.mount.translation for camera in scene.cameras if camera.mount is not None]
        locations = {lidar.id: lidar_position(scene, lidar, ego, reach_ns=reach_ns) for lidar in scene.lidars}
        for lidar_id, location in locations.items():
            if location is None and ego is not None and mounts:
                middle = RigidTransform(np.eye(3), np.mean(mounts, axis=0))
                locations[lidar_id] = PoseSource(ego.path, middle, reach_ns)
                self.guessed += 1
        return locations

    def _system(self) -> FusionSystem:
        configuration = FusionConfiguration(visibility=VisibilitySettings(threads=self.settings.threads))
        system = build_system(self.aligned.scene, self.aligned.ego, configuration)
        if self.skips is not None:
            system.on_unreadable = self.skips.add
        return system

    @property
    def _sweeps(self) -> int:
        return sum(len(lidar.frames) for lidar in self.aligned.scene.lidars)

    def _step(self) -> None:
        self._done += 1
        if self.progress is not None:
            self.progress(self._done, self._ahead + self._sweeps)

    def warnings(self) -> tuple[DataWarning, ...]:
        """What had to be assumed, beyond what the scene and the sweeps report."""
        reported = reported_once(self.aligned.scene.warnings, self.statistics.warnings())
        found = (
            (
                "moving-points-unjudged",
                self.unjudged,
                (
                    "sweeps of which it is not known from where they were measured; their moving points stay, but for "
                    "those in annotated boxes"
                ),
            ),
            (
                "lidar-location-guessed",
                self.guessed,
                (
                    "it is not known where a lidar is, whose points come in the ego's frame; the middle of the cameras "
                    "stands for it where moving points are looked for"
                ),
            ),
        )
        location, kind = "sensors[]", WarningKind.ASSUMED
        return (
            *reported,
            *(
                DataWarning(kind=kind, code=code, location=location, message=message, count=count)
                for code, count, message in found
                if count
            ),
        )


def _report(
    job: _Job,
    wanted: ColourOutputs,
    colouring: SweepColouring,
    sinks: ColourSinks,
    gains: ExposureGains | None,
    *,
    seconds: float,
) -> ColourReport:
    statistics, ego = job.statistics, job.aligned.ego
    cameras = {k: camera.id for k, camera in enumerate(job.source.cameras)}
    return ColourReport(
        source=job.source.source,
        output=None if wanted.map is None else str(wanted.map),
        trajectory=None if ego is None else ego.name,
        blend=job.settings.blend,
        frames=statistics.frames,
        fused=statistics.fused,
        unfused=statistics.unfused,
        skipped=() if job.skips is None else tuple(job.skips.reasons),
        points=statistics.points,
        coloured_percent=100.0 * job.coloured / statistics.points if statistics.points else 0.0,
        removed_in_boxes=job.removed_in_boxes,
        removed_by_rays=job.removed_by_rays,
        unjudged=job.unjudged,
        written=0 if sinks.map is None else sinks.map.written,
        exposure=None if gains is None else ExposureReport.of(gains, cameras),
        labels=_label_report(job, colouring, sinks),
        cameras=tuple(camera.report(camera_id) for camera_id, camera in statistics.cameras.items()),
        files=sinks.files,
        seconds=seconds,
        warnings=job.warnings(),
    )


def _label_report(job: _Job, colouring: SweepColouring, sinks: ColourSinks) -> LabelReport | None:
    painted, drawn = colouring.labels, sinks.projection
    if painted is None and drawn is None:
        return None
    return LabelReport(
        images=0 if painted is None else painted.used,
        missing=0 if painted is None else painted.missing,
        points=job.labelled,
        drawn=0 if drawn is None else drawn.written,
        classes=len(job.classes) if painted is not None or drawn is None else len(drawn.numbers),
    )
