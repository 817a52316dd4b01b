"""The colour job: the points of a drive coloured from all its cameras, as one map or sweep by sweep.

Labels carried from images to points and back.
"""

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray
from sceneloom.colouring.exposure import ExposureGains, ExposureLinks
from sceneloom.colouring.moving_points import MovingBoxes, MovingPoints, lags_for
from sceneloom.colouring.results import LidarTrajectory
from sceneloom.colouring.visibility import VisibilitySettings
from sceneloom.errors import PoseError
from sceneloom.formats.base.label_images import LabelFolder
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.system import FusionSystem
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_trajectory import placeable_lidars
from sceneloom.pipeline.alignment import Aligned, align
from sceneloom.pipeline.coloured_sweeps import (
    ColouredSweep,
    ColourOutputs,
    ColourSettings,
    ColourSinks,
    SweepColouring,
    open_colour_sinks,
)
from sceneloom.pipeline.fusing import CameraReport, CameraStatistics, FusionStatistics, reported_once
from sceneloom.pipeline.play import Skips, build_system, check_has_lidar, play, telling
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.ego import lidar_position
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier, Progress
from sceneloom.visualization.canvas import counting_left_out
from sceneloom.warnings import DataWarning, WarningKind


class _ExposureReport(msgspec.Struct, frozen=True, kw_only=True):
    """How differently the cameras were exposed.

    Attributes:
        seam_before, seam_after: median difference [levels] of the colours of points that two cameras show at once;
            None where no two cameras do.
        seam_points: how many points that is of.
        alone: cameras that nothing links to another; they keep their mean brightness.
        unlinked: cameras whose images share nothing that can be compared; they keep their colours.
        factors: of each other camera, the least and the greatest factor of its images.
    """

    seam_before: float | None
    seam_after: float | None
    seam_points: int
    alone: tuple[Identifier, ...]
    unlinked: tuple[Identifier, ...]
    factors: dict[str, tuple[float, float]]

    @classmethod
    def of(cls, gains: ExposureGains, cameras: dict[int, Identifier]) -> "_ExposureReport":
        """Report what was found, by the cameras' ids instead of their indices."""
        found = {camera: logs for camera, logs in gains.log_gains.items() if len(logs)}
        return cls(
            seam_before=gains.seam_before if isfinite(gains.seam_before) else None,
            seam_after=gains.seam_after if isfinite(gains.seam_after) else None,
            seam_points=gains.seam_pairs,
            alone=tuple(cameras[camera] for camera in gains.alone if camera in found),
            unlinked=tuple(cameras[camera] for camera in gains.alone if camera not in found),
            factors={
                str(cameras[camera]): (
                    float(2.718281828459045 ** logs.min()),
                    float(2.718281828459045 ** logs.max()),
                )
                for camera, logs in found.items()
            },
        )


class _LabelReport(msgspec.Struct, frozen=True, kw_only=True):
    """What became of labels.

    Attributes:
        images: label images that were painted onto points.
        missing: images that no label image is of.
        points: points that got a label.
        drawn: label images that were made of labelled points.
        classes: how many different labels the points got, or the drawn images have.
    """

    images: int = 0
    missing: int = 0
    points: int = 0
    drawn: int = 0
    classes: int = 0


class ColourReport(msgspec.Struct, frozen=True, kw_only=True):
    """One colouring.

    Attributes:
        source: what was coloured.
        output: the map written, or None.
        trajectory: name of the ego trajectory that the map stands on, or None where the scene's own poses were used.
        blend: how the colours of several images became one.
        frames: sweeps that were read.
        fused: sweeps that are in the outputs.
        unfused: why the others are not, with counts.
        skipped: sweeps and images that could not be read, one line each.
        points: points of all fused sweeps.
        coloured_percent: share of them that got a colour.
        removed_in_boxes, removed_by_rays: points left out because they lie in boxes that move, and because rays of
            other sweeps pass through their locations.
        unjudged: sweeps of which it is not known from where they were measured, so that rays state nothing.
        written: points of the map.
        exposure: None where it was left as it is.
        labels: None where there are none.
        cameras: one report per camera.
        files: further files written, with counts by kind.
        seconds: how long it took.
        warnings: what was assumed, repaired or left out.
    """

    source: str
    output: str | None
    trajectory: str | None
    blend: str
    frames: int
    fused: int
    unfused: dict[str, int]
    skipped: tuple[str, ...]
    points: int
    coloured_percent: float
    removed_in_boxes: int
    removed_by_rays: int
    unjudged: int
    written: int
    exposure: _ExposureReport | None
    labels: _LabelReport | None
    cameras: tuple[CameraReport, ...]
    files: dict[str, int]
    seconds: float
    warnings: tuple[DataWarning, ...]


_MOST_COMPARED = 300
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
        every = max(1, -(-self._sweeps // _MOST_COMPARED))
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
        exposure=None if gains is None else _ExposureReport.of(gains, cameras),
        labels=_label_report(job, colouring, sinks),
        cameras=statistics.camera_reports,
        files=sinks.files,
        seconds=seconds,
        warnings=job.warnings(),
    )


def _label_report(job: _Job, colouring: SweepColouring, sinks: ColourSinks) -> _LabelReport | None:
    painted, drawn = colouring.labels, sinks.projection
    if painted is None and drawn is None:
        return None
    return _LabelReport(
        images=0 if painted is None else painted.used,
        missing=0 if painted is None else painted.missing,
        points=job.labelled,
        drawn=0 if drawn is None else drawn.written,
        classes=len(job.classes) if painted is not None or drawn is None else len(drawn.numbers),
    )
