"""Detections of a drive become tracks: objects by timestamp, of several trackers together.

And as annotations of the scene.
"""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import DetectionAlgorithm, DetectionPair
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.formats.base.losses import LossReport
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, algorithm, chosen_algorithm
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detected_drive import DetectedDrive, Moment, moments, projection_settings
from sceneloom.scene.detections import Boxes2D, Track, TrackedObjects, Tracks
from sceneloom.scene.ego import EgoMotion, needs_ego
from sceneloom.scene.poses import Poses, Trajectory, same_direction
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Progress
from sceneloom.tracking.labels import Labelled, label_tracks
from sceneloom.tracking.settings import TrackerSettings
from sceneloom.tracking.smoother import gathered, track_drive
from sceneloom.tracking.tracker import Observation, Tracker
from sceneloom.warnings import DataWarning


class TrackedReport(msgspec.Struct, frozen=True, kw_only=True):
    """One drive or sequence.

    Attributes:
        name: of it.
        file: where its objects are.
        frames: sweeps.
        tracks: objects, by class.
        states: how often one was reported.
        seconds: of the processor, for fusing and tracking.
        warnings: what was assumed or is missing.
    """

    name: str
    file: str
    frames: int
    tracks: Mapping[str, int]
    states: int
    seconds: float
    warnings: tuple[DataWarning, ...] = ()

    @property
    def ms_per_frame(self) -> float:
        """What a sweep takes [ms]."""
        return self.seconds * 1e3 / self.frames if self.frames else 0.0


class TrackReport(msgspec.Struct, frozen=True, kw_only=True):
    """All drives or sequences of one call.

    Attributes:
        source: what was read.
        output: the file, or the folder of files.
        form: "kitti", "sfs" or "jsonl".
        drives: one by one.
        ms_per_frame: what a sweep takes, over all of them [ms].
        seconds: the whole call.
        stages: how much of that by stage: reading, tracking, writing …
        warnings: of all of them.
        losses: what the form has no field for.
    """

    source: str
    output: str
    form: str
    drives: tuple[TrackedReport, ...]
    ms_per_frame: float
    seconds: float
    warnings: tuple[DataWarning, ...] = ()
    losses: LossReport = LossReport()
    stages: Mapping[str, float] = msgspec.field(default_factory=dict)


_COLUMNS = tuple(
    f.name for f in fields(TrackedObjects) if f.name not in ("timestamp_ns", "ids", "labels", "corners_xyxy")
)
"""The columns of states that tracks and objects of a moment share, without boxes in images."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedDrive:
    """The objects of a drive.

    Attributes:
        drive: what they were found in.
        moments: the objects at each sweep.
        seconds: of the processor, for fusing and tracking.
    """

    drive: DetectedDrive
    moments: tuple[TrackedObjects, ...]
    seconds: float

    @property
    def tracks(self) -> Tracks:
        """The same by object."""
        return gathered(list(self.moments))


def _moments_of(tracks: Iterable[Track], timestamps_ns: Int64Array) -> tuple[TrackedObjects, ...]:
    """Give the objects at each time; states of tracks at other times are left out.

    Args:
        tracks: of a drive.
        timestamps_ns: (N,) int64 [ns], rising.
    """
    tracks = tuple(tracks)
    counts = [len(track) for track in tracks]
    times = _joined([track.timestamps_ns for track in tracks], (0,), np.int64)
    ids = np.repeat(np.array([track.id for track in tracks], np.int64), counts)
    labels = [track.label for track in tracks for _ in range(len(track))]
    empty = _NOBODY
    columns = {
        name: _joined(
            [getattr(track, name) for track in tracks], getattr(empty, name).shape, getattr(empty, name).dtype
        )
        for name in _COLUMNS
    }
    cameras = dict.fromkeys(camera_id for track in tracks for camera_id in track.corners_xyxy)
    corners = {
        camera_id: _joined([_corners(track, camera_id, len(track)) for track in tracks], (0, 4), np.float64)
        for camera_id in cameras
    }
    order = np.lexsort((ids, times))
    first, stop = (np.searchsorted(times[order], timestamps_ns, side=side) for side in ("left", "right"))
    found = []
    for k, time_ns in enumerate(timestamps_ns.tolist()):
        rows = order[first[k] : stop[k]]
        states: dict[str, Any] = {name: values[rows] for name, values in columns.items()}
        boxes = {camera_id: values[rows] for camera_id, values in corners.items()}
        words = tuple(labels[row] for row in rows.tolist())
        found.append(TrackedObjects(time_ns, ids[rows], words, corners_xyxy=boxes, **states))
    return tuple(found)


def _joined_moments(parts: Sequence[Sequence[TrackedObjects]]) -> tuple[TrackedObjects, ...]:
    """Put the objects of several trackers of the same moments together; ids of later ones begin behind the others'."""
    if len(parts) == 1:
        return tuple(parts[0])
    shifts, next_id = [], 0
    for part in parts:
        largest = max((int(m.ids.max()) for m in part if len(m)), default=-1)
        shifts.append(next_id)
        next_id += largest + 1
    return tuple(_together(same, shifts) for same in zip(*parts, strict=True))


def _together(same: Sequence[TrackedObjects], shifts: Sequence[int]) -> TrackedObjects:
    columns: dict[str, Any] = {name: np.concatenate([getattr(m, name) for m in same]) for name in _COLUMNS}
    cameras = dict.fromkeys(camera_id for m in same for camera_id in m.corners_xyxy)
    return TrackedObjects(
        same[0].timestamp_ns,
        np.concatenate([m.ids + shift for m, shift in zip(same, shifts, strict=True)]),
        tuple(label for m in same for label in m.labels),
        corners_xyxy={
            camera_id: np.concatenate([_corners(m, camera_id, len(m)) for m in same]) for camera_id in cameras
        },
        **columns,
    )


def _corners(states: Track | TrackedObjects, camera_id: Identifier, count: int) -> Float64Array:
    found: Mapping[Identifier, Float64Array] = states.corners_xyxy
    return found[camera_id] if camera_id in found else np.full((count, 4), np.nan)


def _joined(parts: Sequence[AnyArray], shape: tuple[int, ...], dtype: Any) -> Any:
    return np.concatenate(parts) if parts else np.zeros(shape, dtype)


_NOBODY = TrackedObjects(
    0,
    np.zeros(0, np.int64),
    (),
    np.zeros((0, 3)),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros((0, 10, 10)),
    np.zeros(0),
    np.zeros(0, np.uint8),
)
"""A moment without objects."""


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
    drive: DetectedDrive, *, settings: TrackingSettings | None = None, progress: Progress | None = None
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
    return TrackedDrive(drive, _joined_moments(parts), seconds)


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
    return _moments_of(tracks, drive.timestamps_ns), seconds


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

FOLLOWED = "tracking"
"""Name of a ego trajectory that the scene does not have itself, but tracking went by."""


def label_drive(scene: Scene, drive: DetectedDrive, tracks: Tracks) -> Labelled:
    """Put the tracks of a drive into its scene.

    The trajectory that tracking went by becomes the scene's default one: one of its own, or the one that was found from
    sweeps or satellites. So the labels are in the world of the file that is written.

    Args:
        scene: the drive's.
        drive: as it was tracked.
        tracks: in its world.

    Raises:
        OptionError: the scene's annotations are in the ego's frame, or have the ids of labels.
        DataError: a sensor's frame cannot be read.
    """
    if not needs_ego(scene) or drive.source.own:
        return label_tracks(scene, tracks)
    ego = EgoMotion(FOLLOWED, drive.source.path)
    return label_tracks(_following(scene, ego.path), tracks, trajectory=ego)


def _following(scene: Scene, path: Poses) -> Scene:
    """The scene with this ego trajectory as its default one; an ego that is stationary has none."""
    if path.static:
        return scene
    known = next(
        (name for name, trajectory in scene.trajectories.items() if same_direction(trajectory, path)), None
    )
    followed = Trajectory(FOLLOWED, path.timestamps_ns, path.positions, path.quaternions_xyzw)
    first = {FOLLOWED: followed} if known is None else {known: scene.trajectories[known]}
    return replace(scene, trajectories=MappingProxyType({**first, **scene.trajectories}))
