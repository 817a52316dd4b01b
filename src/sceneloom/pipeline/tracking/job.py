"""Tracking: what detectors found in a drive becomes objects followed through time."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import DetectionAlgorithm, DetectionPair
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, algorithm, chosen_algorithm
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detections.detected import DetectedDrive, Moment, moments, projection_settings
from sceneloom.pipeline.tracking.tracked import TrackedDrive, joined_moments, moments_of
from sceneloom.scene.detections import Boxes2D
from sceneloom.scene.tracks import TrackedObjects
from sceneloom.scene.types import Progress
from sceneloom.tracking.drive import track_drive
from sceneloom.tracking.observation import Observation
from sceneloom.tracking.settings import TrackerSettings
from sceneloom.tracking.tracker import Tracker


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingSettings:
    """How a drive is tracked.

    Attributes:
        offline: whether states may look ahead: smoothed over the drive, gaps filled.
        algorithm: the algorithm of detection fusion: its name, "file.py:function", or a function that is called as
            `detections.DetectionAlgorithm`.
        fusion: what fusion by projection takes for granted; None for what is known of the drive's detectors.
        tracker: what the tracker takes for granted.
    """

    offline: bool = False
    algorithm: AlgorithmChoice = "projection"
    fusion: ProjectionSettings | None = None
    tracker: TrackerSettings = field(default_factory=TrackerSettings)


def track(
    drive: DetectedDrive,
    *,
    settings: TrackingSettings | None = None,
    progress: Progress | None = None,
) -> TrackedDrive:
    """Follow the objects of a drive.

    Classes that only one of both detectors looks for are followed on their own, so that the other one's silence does
    not count against them.

    Args:
        settings: how.
        progress: reported after each sweep.

    Raises:
        OptionError: no algorithm of detection fusion has that name.
        CalibrationError: a camera model is unknown.
    """
    wanted = settings or TrackingSettings()
    fusion = projection_settings(drive, wanted.fusion)
    parts, seconds = [], 0.0
    groups = tuple(_groups(drive))
    for k, (of_group, recalls) in enumerate(groups):
        own = replace(wanted, fusion=replace(fusion, **recalls), tracker=replace(wanted.tracker, **recalls))
        steps = _Steps(progress, k, len(groups), len(of_group.boxes))
        found, spent = _track_group(of_group, own, steps)
        parts.append(found)
        seconds += spent
    return TrackedDrive(drive, joined_moments(parts), seconds)


@dataclass(frozen=True, slots=True)
class _Steps:
    """Reports of the work of several groups of classes as of one."""

    reported: Progress | None
    group: int
    groups: int
    total: int

    def done(self, count: int) -> None:
        if self.reported is not None:
            self.reported(self.group * self.total + count, self.groups * self.total)


def _groups(drive: DetectedDrive) -> Iterator[tuple[DetectedDrive, dict[str, Any]]]:
    """The drive by classes that the same detectors look for, and which of them find nothing of it at all."""
    in_sweeps, in_images = drive.classes, drive.classes_2d
    found = frozenset(drive.labels) | (in_sweeps or frozenset()) | (in_images or frozenset())
    only_sweeps = frozenset() if in_images is None else found - in_images
    only_images = frozenset() if in_sweeps is None else found - in_sweeps - only_sweeps
    parts: tuple[tuple[frozenset[str], dict[str, Any]], ...] = (
        (found - only_sweeps - only_images, {}),
        (only_sweeps, {"recall_2d": 0.0}),
        (only_images, {"recall_3d": 0.0}),
    )
    for classes, recalls in parts:
        if classes == found:  # also where nothing was found at all, once
            yield drive, recalls
            return
        if classes:
            yield drive.of_classes(classes), recalls


def track_observations(
    drive: DetectedDrive,
    observations: Sequence[Observation],
    *,
    settings: TrackingSettings | None = None,
    progress: Progress | None = None,
) -> TrackedDrive:
    """Follow the objects of a drive whose detections were fused before.

    Args:
        drive: where the sensors were; of each observation's time.
        observations: in the order of time.
        settings: how.
        progress: reported after each sweep.
    """
    steps = _Steps(progress, 0, 1, len(observations))
    found, seconds = _track_all(drive, observations, settings or TrackingSettings(), steps)
    return TrackedDrive(drive, found, seconds)


def _track_group(
    drive: DetectedDrive, settings: TrackingSettings, steps: _Steps
) -> tuple[tuple[TrackedObjects, ...], float]:
    known = projection_settings(drive, settings.fusion)
    fuse = _fusion(settings.algorithm, known)
    lonely = partial(fuse_by_projection, settings=replace(known, recall_2d=0.0))
    prepared = tuple(moments(drive))
    seen = (_observation(drive, moment, fuse, lonely) for moment in prepared)
    return _track_all(drive, seen, settings, steps)


def _track_all(
    drive: DetectedDrive, observations: Iterable[Observation], settings: TrackingSettings, steps: _Steps
) -> tuple[tuple[TrackedObjects, ...], float]:
    """Track; and the time of the processor for that and for fusing, without what progress takes [s]."""
    tracker, seconds = Tracker(settings.tracker), 0.0
    online, seen = list[TrackedObjects](), list[Observation]()
    begun = time.thread_time()
    for count, observation in enumerate(observations, start=1):
        if settings.offline:
            seen.append(observation)
        else:
            online.append(tracker.step(observation))
        seconds += time.thread_time() - begun
        steps.done(count)
        begun = time.thread_time()
    if not settings.offline:
        return tuple(online), seconds
    tracks = track_drive(seen, settings=settings.tracker, offline=True)
    seconds += time.thread_time() - begun
    return moments_of(tracks, drive.timestamps_ns), seconds


def _fusion(chosen: AlgorithmChoice, known: ProjectionSettings) -> DetectionAlgorithm:
    if chosen == "projection":
        return partial(fuse_by_projection, settings=known)
    named = chosen_algorithm(FusionType.DETECTIONS, chosen)
    found: DetectionAlgorithm = algorithm(FusionType.DETECTIONS, named)
    return found


def _observation(
    drive: DetectedDrive, moment: Moment, fuse: DetectionAlgorithm, lonely: DetectionAlgorithm
) -> Observation:
    """What is seen at a moment; a sweep to which no image belongs counts as it is."""
    if moment.pairs:
        return Observation.of_pairs(moment.pairs_with_points(), moment.world_from_lidar, fuse=fuse)
    camera_id, camera = next(iter(drive.cameras.items()), (None, None))
    camera_model = _NO_CAMERA_MODEL if camera is None else camera.camera_model
    none = Boxes2D.empty(moment.timestamp_ns)
    fused = lonely(DetectionPair(moment.boxes_3d, none, camera_model, RigidTransform.identity()))
    return Observation(moment.timestamp_ns, moment.world_from_lidar, {camera_id or "": fused})


_NO_CAMERA_MODEL = Camera("pinhole", 1, 1, 1.0, 1.0, 0.0, 0.0)
"""Stands for a camera where there is none: nothing is found in its images, and nothing is expected."""
