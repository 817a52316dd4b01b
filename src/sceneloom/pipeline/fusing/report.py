"""What a fusion did, in numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np

from sceneloom.colouring.results import FusedFrame
from sceneloom.formats.loss import LossReport
from sceneloom.motion.point_time_warnings import PointTimesStatistics
from sceneloom.scene.point_times import PointTimes
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import DataWarning, WarningKind


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
    def coloured_percent(self) -> float:
        """Share of all points that got a colour."""
        return _percent(self.coloured, self.points)


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else 0.0
