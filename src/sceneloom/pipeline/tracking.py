"""The track job: what detectors found becomes tracks, written as KITTI results, JSON lines or scenes with annotations.

In this order: settings and report; tracking; annotations; the files of results; visualisations; the job.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, spread_rows
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_projection import FINE, box_extents
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import DetectionAlgorithm, DetectionPair
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import OptionError, check_choice
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import check_output, file_stem, filling, replacing
from sceneloom.formats.base.registry import write_scene
from sceneloom.formats.kitti.benchmark_writer import write_labels
from sceneloom.formats.kitti.tracking_reader import KittiSequence
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, algorithm, chosen_algorithm
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detected_drive import (
    DetectedDrive,
    KittiObjects,
    SweepPoints,
    kitti_drive,
    kitti_labels,
    moments,
    poses_at,
    projection_settings,
)
from sceneloom.pipeline.detection_lists import DetectionInput
from sceneloom.pipeline.fusing_detections import fused_files, read_fused
from sceneloom.scene.detections import Boxes2D, Boxes3D, Support, Track, TrackedObjects, Tracks
from sceneloom.scene.ego import EgoMotion, needs_ego
from sceneloom.scene.poses import Poses, Trajectory, same_direction
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, PointsFrame, Progress
from sceneloom.stages import stage, timed
from sceneloom.tracking.labels import Labelled, label_tracks
from sceneloom.tracking.settings import ImageBox, TrackerSettings
from sceneloom.tracking.smoother import gathered, track_drive
from sceneloom.tracking.tracker import Observation, Tracker
from sceneloom.visualization.canvas import PilImage, counting_left_out
from sceneloom.visualization.clouds import EgoPosition
from sceneloom.visualization.fused_frames import save_image
from sceneloom.visualization.objects import draw_objects_above, draw_objects_in_image
from sceneloom.warnings import DataWarning


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


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOutputs:
    """What tracks are written as.

    Attributes:
        form: "kitti", "jsonl" or "sfs"; None for the form of the output's suffix, else KITTI's results.
        box2d: which boxes in the image are written.
        images: folder into which some moments are drawn, below it one for each of several drives; None for none.
        scene_options: how scenes are written, `profile` and `time_unit` as of `write_scene`; of "sfs" only.
    """

    form: str | None = None
    box2d: ImageBox = ImageBox.IMAGE
    images: Path | None = None
    overwrite: bool = False
    scene_options: Mapping[str, Any] = field(default_factory=dict)

    def form_of(self, output: Path) -> str:
        """The form that was asked for, else the one of the output's suffix, else KITTI's.

        Raises:
            OptionError: there is no such form, a suffix belongs to none, or there are options of another form.
        """
        form = self.form or ("kitti" if not output.suffix else _form_of_suffix(output))
        if form is None:
            known = ", ".join(f"{suffix} ({name})" for name, (suffix, _) in _FORMS.items())
            raise OptionError(
                f"{output}: suffix {output.suffix!r} belongs to no form of tracks; expected one of: {known}"
            )
        check_choice("format", form, _FORMS)
        if self.scene_options and form != "sfs":
            flags = " and ".join(f"--{name.replace('_', '-')}" for name in self.scene_options)
            raise OptionError(f"{flags}: only of scenes, but {form!r} is written; it needs --format sfs")
        return form


class _TrackedReport(msgspec.Struct, frozen=True, kw_only=True):
    """One drive or sequence."""

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
        output: the file, or the folder of files.
        form: "kitti", "sfs" or "jsonl".
        ms_per_frame: what a sweep takes, over all of them [ms].
        stages: how much of that by stage: reading, tracking, writing …
    """

    source: str
    output: str
    form: str
    drives: tuple[_TrackedReport, ...]
    ms_per_frame: float
    seconds: float
    warnings: tuple[DataWarning, ...] = ()
    losses: LossReport = LossReport()
    stages: Mapping[str, float] = msgspec.field(default_factory=dict)


_COLUMNS = tuple(
    f.name for f in fields(TrackedObjects) if f.name not in ("timestamp_ns", "ids", "labels", "corners_xyxy")
)  # the columns of states that tracks and objects of a moment share, without boxes in images


def _moments_of(tracks: Sequence[Track], timestamps_ns: Int64Array) -> tuple[TrackedObjects, ...]:
    """The objects at each time (N,) int64 [ns], rising; states of tracks at other times are left out."""
    nobody = TrackedObjects(
        0, np.zeros(0, np.int64), (), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0),
        np.zeros((0, 10, 10)), np.zeros(0), np.zeros(0, np.uint8),
    )  # fmt: skip
    times = np.concatenate([np.zeros(0, np.int64), *(track.timestamps_ns for track in tracks)])
    ids = np.repeat(np.array([track.id for track in tracks], np.int64), [len(track) for track in tracks])
    labels = [track.label for track in tracks for _ in range(len(track))]
    columns = {
        name: np.concatenate([getattr(nobody, name), *(getattr(track, name) for track in tracks)]) for name in _COLUMNS
    }
    cameras = dict.fromkeys(camera_id for track in tracks for camera_id in track.corners_xyxy)
    corners = {
        camera_id: np.concatenate([_corners(track, camera_id, len(track)) for track in tracks]) for camera_id in cameras
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


_Moments = tuple[TrackedObjects, ...]  # the objects of a drive at each of its sweeps


def track(
    drive: DetectedDrive, *, settings: TrackingSettings | None = None, progress: Progress | None = None
) -> tuple[_Moments, float]:
    """Follow the objects of a drive; give them with the time of the processor that this took [s].

    Classes that only one of both detectors looks for are followed on their own, so that the other one's silence does
    not count against them.

    Raises:
        OptionError: no algorithm of detection fusion has that name.
        CalibrationError: a camera model is unknown.
    """
    wanted = settings or TrackingSettings()
    fusion = projection_settings(drive, wanted.fusion)
    parts, seconds = [], 0.0
    groups = tuple(_groups(drive))
    for k, (of_group, recalls) in enumerate(groups):
        known = replace(fusion, **recalls)
        tracker = replace(wanted.tracker, detectors=known.detectors, **recalls)
        steps = _share(progress, k, len(groups), len(of_group.boxes))
        observations = _observations(of_group, wanted.algorithm, known)
        found, spent = _track_all(of_group, observations, wanted.offline, tracker, steps)
        parts.append(found)
        seconds += spent
    return _joined_moments(parts), seconds


def _share(progress: Progress | None, k: int, count: int, total: int) -> Progress | None:
    """Progress of one part of several of `total` steps each."""
    if progress is None:
        return None
    return lambda done, of: progress(k * total + done * total // max(of, 1), count * total)


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


def _track_all(
    drive: DetectedDrive,
    observations: Iterable[Observation],
    offline: bool,  # noqa: FBT001 - of the settings
    settings: TrackerSettings,
    progress: Progress | None,
) -> tuple[_Moments, float]:
    """Track; and the time of the processor for that and for fusing, without what progress takes [s]."""
    tracker, seconds = Tracker(settings), 0.0
    online, seen = list[TrackedObjects](), list[Observation]()
    begun = time.thread_time()
    for count, observation in enumerate(observations, start=1):
        if offline:
            seen.append(observation)
        else:
            online.append(tracker.step(observation))
        seconds += time.thread_time() - begun
        if progress is not None:
            progress(count, len(drive.boxes))
        begun = time.thread_time()
    if not offline:
        return tuple(online), seconds
    tracks = track_drive(seen, settings=settings, offline=True)
    seconds += time.thread_time() - begun
    return _moments_of(tuple(tracks), drive.timestamps_ns), seconds


def _observations(drive: DetectedDrive, chosen: AlgorithmChoice, known: ProjectionSettings) -> Iterator[Observation]:
    """What is seen at each moment; a sweep to which no image belongs counts as it is."""
    fuse: DetectionAlgorithm = partial(fuse_by_projection, settings=known)
    if chosen != "projection":
        fuse = algorithm(FusionType.DETECTIONS, chosen_algorithm(FusionType.DETECTIONS, chosen))
    lonely = partial(fuse_by_projection, settings=replace(known, recall_2d=0.0))
    camera_id, camera = next(iter(drive.cameras.items()), (None, None))
    camera_model = _NO_CAMERA_MODEL if camera is None else camera.camera_model
    for moment in tuple(moments(drive)):
        if moment.pairs:
            yield Observation.of_pairs(moment.pairs_with_points(), moment.world_from_lidar, fuse=fuse)
            continue
        none = Boxes2D.empty(moment.timestamp_ns)
        fused = lonely(DetectionPair(moment.boxes_3d, none, camera_model, RigidTransform.identity()))
        yield Observation(moment.timestamp_ns, moment.world_from_lidar, {camera_id or "": fused})


_NO_CAMERA_MODEL = Camera("pinhole", 1, 1, 1.0, 1.0, 0.0, 0.0)
"""Stands for a camera where there is none: nothing is found in its images, and nothing is expected."""
FOLLOWED = "tracking"
"""Name of an ego trajectory that tracking used and the scene does not have itself."""


def label_drive(scene: Scene, drive: DetectedDrive, tracks: Tracks) -> Labelled:
    """Put the tracks of a drive into its scene.

    The trajectory that tracking used becomes the scene's default one, so that the labels are in the world of the file
    that is written.

    Args:
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
    known = next((name for name, trajectory in scene.trajectories.items() if same_direction(trajectory, path)), None)
    followed = Trajectory(FOLLOWED, path.timestamps_ns, path.positions, path.quaternions_xyzw)
    first = {FOLLOWED: followed} if known is None else {known: scene.trajectories[known]}
    return replace(scene, trajectories=MappingProxyType({**first, **scene.trajectories}))


@dataclass(frozen=True, slots=True, eq=False)
class _TrackableDrive:
    """A drive with all that its files of results need."""

    drive: DetectedDrive
    scene: Scene
    rectified_from_lidar: RigidTransform | None = None  # into the frame of KITTI's boxes; None: the camera's
    observations: tuple[Observation, ...] | None = None  # fused before, of each sweep; None where it has to be

    @classmethod
    def of_fused(cls, path: Path) -> "_TrackableDrive":
        """A file that `fuse_detections` wrote; its scene has no sensors."""
        drive, observations = read_fused(path)
        return cls(drive, Scene((), source=str(path), format="detections"), observations=observations)

    @classmethod
    def of_sequence(cls, sequence: KittiSequence, source: str) -> "_TrackableDrive":
        """A sequence of KITTI's tracking benchmark; its scene has the ego trajectory and the camera, without images."""
        scene = sequence.scene(source=f"{source}/{sequence.name}")
        return cls(kitti_drive(sequence), scene, sequence.rectified_from_lidar)


_Write = Callable[[_Moments, _TrackableDrive, Path, TrackOutputs], LossReport]


def _write_kitti(tracked: _Moments, source: _TrackableDrive, path: Path, outputs: TrackOutputs) -> LossReport:
    drive = source.drive
    if len(drive.cameras) != 1:
        raise OptionError(
            f"{drive.name}: {len(drive.cameras)} cameras ({', '.join(map(str, drive.cameras))}); KITTI's results are "
            "of one: choose it with `--camera`"
        )
    ((camera_id, camera),) = drive.cameras.items()
    rectified_from_lidar = source.rectified_from_lidar
    if rectified_from_lidar is None:
        rectified_from_lidar = camera.source.mount.inverse() @ drive.source.mount
    poses = zip(drive.locations(), poses_at(camera.source, drive.timestamps_ns), strict=True)
    found = []
    for frame, (objects, (world_from_lidar, world_from_camera)) in enumerate(zip(tracked, poses, strict=True)):
        boxes = _in_lidar(objects, world_from_lidar)
        camera_from_lidar = world_from_camera.inverse() @ world_from_lidar
        corners = _image_boxes(objects, boxes, camera_id, camera.camera_model, camera_from_lidar, outputs.box2d)
        placed = boxes.centers, boxes.sizes_lwh, boxes.yaws
        found.append(
            KittiObjects(frame, objects.ids, objects.labels, objects.scores, corners, placed, camera.camera_model)
        )
    write_labels(kitti_labels(found, rectified_from_lidar), path)
    return LossReport()


def _write_lines(tracked: _Moments, source: _TrackableDrive, path: Path, outputs: TrackOutputs) -> LossReport:
    del source, outputs
    with path.open("wb") as file:
        file.writelines(line + b"\n" for line in track_lines(tracked))
    return LossReport()


def _write_scene(tracked: _Moments, source: _TrackableDrive, path: Path, outputs: TrackOutputs) -> LossReport:
    labelled = label_drive(source.scene, source.drive, gathered(list(tracked)))
    return write_scene(labelled.scene, path, format="sfs", **outputs.scene_options)


_FORMS: Mapping[str, tuple[str, _Write]] = MappingProxyType(
    {"kitti": (".txt", _write_kitti), "jsonl": (".jsonl", _write_lines), "sfs": (".sfs", _write_scene)}
)  # the suffix of each form's files, and what writes one


def _form_of_suffix(path: Path) -> str | None:
    return next((name for name, (suffix, _) in _FORMS.items() if suffix == path.suffix.lower()), None)


_NEAR = 0.1  # boxes all of whose corners are nearer than this in front of the camera have no outline [m]


def _in_lidar(objects: TrackedObjects, world_from_lidar: RigidTransform) -> Boxes3D:
    """The boxes of objects in the lidar's frame; of headings the horizontal part there counts."""
    boxes = Boxes3D(
        objects.timestamp_ns,
        objects.centers,
        objects.sizes_lwh,
        objects.yaws,
        objects.scores,
        objects.labels,
        frame=PointsFrame.WORLD,
    )
    return boxes.moved(world_from_lidar.inverse(), PointsFrame.SENSOR)


def _image_boxes(
    objects: TrackedObjects,
    boxes: Boxes3D,
    camera_id: Identifier,
    camera_model: Camera,
    camera_from_lidar: RigidTransform,
    box2d: ImageBox,
) -> Float64Array:
    """A box in the image for each object, (N, 4) float64 [px] in the corner convention; zeros where none shows."""
    corners = projected_boxes(boxes, camera_model, camera_from_lidar)
    own = objects.corners_xyxy.get(camera_id)
    if own is not None:
        reported = np.isfinite(own).all(axis=1)
        corners[~reported & np.isin(objects.supports, (Support.PREDICTED, Support.INTERPOLATED))] = 0.0
        if box2d is ImageBox.IMAGE:
            corners[reported] = own[reported]
    return corners


def projected_boxes(boxes: Boxes3D, camera_model: Camera, camera_from_lidar: RigidTransform) -> Float64Array:
    """Outlines of boxes in the lidar's frame, (N, 4) float64 [px], cut at the image; zeros where none shows."""
    corners_camera = camera_from_lidar.apply(boxes.corners)
    found = np.zeros((len(boxes), 4))
    # a box around the camera has no outline; one that reaches behind it has that of its part in front
    ahead = np.flatnonzero(corners_camera[:, :, 2].max(axis=1) > _NEAR)
    if not len(ahead):
        return found
    extents, _ = box_extents(camera_model, corners_camera[ahead], steps=FINE)
    shown = np.isfinite(extents).all(axis=1) & (extents[:, 2] > extents[:, 0]) & (extents[:, 3] > extents[:, 1])
    found[ahead[shown]] = extents[shown]
    return found


_BLOCKS = {"center_cov": slice(0, 3), "size_cov": slice(3, 6), "velocity_cov": slice(7, 10)}
"""Which rows and columns of the covariance of a state each 3x3 block has."""


def track_lines(moments: Iterable[TrackedObjects]) -> Iterator[bytes]:
    """Give a line for each moment, without its end.

    Each is `{"timestamp_ns", "objects": [{"id", "class", "confidence", "center", "center_cov", "size_lwh", "size_cov",
    "yaw", "yaw_rate", "yaw_var", "velocity", "velocity_cov", "support", "boxes_2d": {camera: [x1, y1, x2, y2]}}]}`:
    world frame, metres, seconds and radians, 3x3 covariances row by row, pixels counted from the image's corner.
    """
    for moment in moments:
        rows = [_object(moment, k) for k in range(len(moment))]
        yield msgspec.json.encode({"timestamp_ns": moment.timestamp_ns, "objects": rows})


def _object(moment: TrackedObjects, k: int) -> dict[str, Any]:
    covariance = moment.covariances[k]
    reported: dict[str, Any] = {
        "id": int(moment.ids[k]),
        "class": moment.labels[k],
        "confidence": float(moment.scores[k]),
        "center": moment.centers[k].tolist(),
        "size_lwh": moment.sizes_lwh[k].tolist(),
        "yaw": float(moment.yaws[k]),
        "yaw_rate": float(moment.yaw_rates[k]),
        "yaw_var": float(covariance[6, 6]),
        "velocity": moment.velocities[k].tolist(),
        "support": Support(int(moment.supports[k])).name.lower(),
    }
    reported |= {name: covariance[block, block].reshape(-1).tolist() for name, block in _BLOCKS.items()}
    reported["boxes_2d"] = {
        str(camera_id): corners[k].tolist()
        for camera_id, corners in moment.corners_xyxy.items()
        if np.isfinite(corners[k]).all()
    }
    return reported


_REACH = 40.0  # from the middle of the map to its upper edge [m]
_TRAIL = 20  # so many sweeps back the trajectories of objects are drawn


def save_tracking_images(
    scene: Scene, drive: DetectedDrive, moments: Sequence[TrackedObjects], folder: Path, *, count: int = 12
) -> list[Path]:
    """Draw at most `count` moments of a tracked drive into a folder, evenly spread over it; give the paths written.

    `<number>_above.png`, and `<number>_<camera>.png` for each camera with an image within half a sweep. What the scene
    does not have is not drawn; files of the same names are replaced.

    Raises:
        OutputError: a file cannot be written.
        DataError: a sweep or image cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return [
        save_image(image, folder / name, overwrite=True)
        for row in spread_rows(len(moments), count).tolist()
        for name, image in _drawn(scene, drive, moments, row)
    ]


def _drawn(
    scene: Scene, drive: DetectedDrive, moments: Sequence[TrackedObjects], row: int
) -> Iterator[tuple[str, PilImage]]:
    objects = moments[row]
    (world_from_lidar,) = poses_at(drive.source, np.array([objects.timestamp_ns], np.int64))
    forward = world_from_lidar.rotation[:, 0] * (1.0, 1.0, 0.0)
    length = float(np.linalg.norm(forward))
    forward = forward / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    points = SweepPoints.of(scene, drive.lidar_id, drive.source)
    cloud = None if points is None else points.at(objects.timestamp_ns)
    seen = np.zeros((0, 3)) if cloud is None else world_from_lidar.apply(cloud.astype(np.float64))
    trails: dict[int, list[Float64Array]] = {}
    for moment in moments[max(row - _TRAIL, 0) : row + 1]:
        for number, center in zip(moment.ids.tolist(), moment.centers, strict=True):
            trails.setdefault(number, []).append(center)
    yield (
        f"{row:06d}_above.png",
        draw_objects_above(
            seen,
            objects,
            ego=EgoPosition(world_from_lidar.translation, forward),
            trails={number: np.array(found) for number, found in trails.items()},
            reach=_REACH,
        ),
    )
    for camera in scene.cameras:
        location, times_ns = drive.cameras.get(camera.id), camera.images.timestamps_ns
        if location is None or not len(times_ns):
            continue
        k = int(np.abs(times_ns - objects.timestamp_ns).argmin())
        if abs(int(times_ns[k]) - objects.timestamp_ns) > drive.period_ns // 2:
            continue
        image = camera.images[k]
        (world_from_camera,) = poses_at(location.source, np.array([image.timestamp_ns], np.int64))
        drawn = draw_objects_in_image(image, objects, world_from_camera, camera.id)
        yield f"{row:06d}_{file_stem(camera.id)}.png", drawn


def track_objects(
    path: str | Path,
    output: str | Path,
    *,
    chosen: DetectionInput | None = None,
    settings: TrackingSettings | None = None,
    lenient: bool = False,
    reading: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    **outputs: Any,
) -> TrackReport:
    """Follow objects through a drive, or through each sequence of a folder.

    Args:
        path: a folder laid out like KITTI's tracking benchmark, whose labels are never read, a drive, or what
            `fuse_detections` wrote.
        output: the folder of files, or the file.
        lenient: leave out what is faulty, and count it.
        reading: further options of opening a drive, `start` and `stop` of a part among them.
        outputs: the fields of `TrackOutputs`.

    Raises:
        OptionError: an option does not concern such a path, or a value is not one that can be followed.
        DataError: a file is faulty.
        OutputError: the output exists, or cannot be written.
        PoseError: it is not known where a sensor was.
    """
    wanted = chosen or DetectionInput()
    job = _Job(Path(output), TrackOutputs(**outputs), settings or TrackingSettings(), progress)
    with timed() as stages:
        report = job.track_path(path, wanted, lenient=lenient, reading=reading)
    return msgspec.structs.replace(report, stages=dict(stages))


@dataclass(slots=True)
class _Job:
    """One call: where tracks go, what is written, and how it is tracked."""

    output: Path
    outputs: TrackOutputs
    settings: TrackingSettings
    progress: Progress | None
    begun: float = field(default_factory=time.perf_counter)
    drives: list[_TrackedReport] = field(default_factory=list)
    losses: LossReport = field(default_factory=LossReport)

    def __post_init__(self) -> None:
        tracker = replace(self.settings.tracker, image_box=self.outputs.box2d)
        self.settings = replace(self.settings, tracker=tracker)

    def track_path(
        self, path: str | Path, wanted: DetectionInput, *, lenient: bool, reading: Mapping[str, Any] | None
    ) -> TrackReport:
        """Track what a path is: sequences of KITTI's benchmark, detections that were fused before, or a drive."""
        tracking = wanted.tracking_folder(path, lenient=lenient, reading=reading)
        if tracking is not None:
            source = str(tracking.path)

            def read(name: str) -> _TrackableDrive:
                return _TrackableDrive.of_sequence(tracking.sequence(name), source)

            report = self._track_many([partial(read, name) for name in tracking.chosen(wanted.sequences)], source)
            return msgspec.structs.replace(report, warnings=(*tracking.warnings, *report.warnings))
        found = () if wanted.has_lists else fused_files(Path(path))
        if found:
            wanted.refuse_part(path, reading)
            if wanted.sequences:
                raise OptionError(f"{path}: --sequence does not count here: all that was fused is followed")
            if Path(path).is_dir():
                return self._track_many([partial(_TrackableDrive.of_fused, file) for file in found], str(path))
            return self._track_one(_TrackableDrive.of_fused(found[0]))
        with wanted.open_drive(path, lenient=lenient, reading=reading) as (drive, scene):
            return self._track_one(_TrackableDrive(drive, scene))

    def _track_many(self, drives: Sequence[Callable[[], _TrackableDrive]], source: str) -> TrackReport:
        """Track several drives, each read when it is its turn, a file each, named after it."""
        outputs, output = self.outputs, self.output
        form = replace(outputs, form=outputs.form or "kitti").form_of(output)
        named = _form_of_suffix(output)
        if named is not None and named != outputs.form:
            raise OptionError(
                f"{output}: a folder is written, a file for each drive; expected a name without {output.suffix!r}, and "
                f"--format {named} for such files"
            )
        with ExitStack() as stack:
            folder = stack.enter_context(filling(output, overwrite=outputs.overwrite))
            drawn = None
            if outputs.images is not None:
                drawn = stack.enter_context(filling(outputs.images, overwrite=outputs.overwrite))
            for k, read in enumerate(drives):
                drive = read()
                name = f"{drive.drive.name}{_FORMS[form][0]}"
                images = None if drawn is None else drawn / drive.drive.name
                progress = _share(self.progress, k, len(drives), 1000)
                self._track(drive, form, folder / name, output / name, images, progress)
        return self._report(source, form)

    def _track_one(self, drive: _TrackableDrive) -> TrackReport:
        """Track one drive into a file."""
        outputs, output = self.outputs, self.output
        form = outputs.form_of(output)
        check_output(output, overwrite=outputs.overwrite)
        with ExitStack() as stack:
            draft = stack.enter_context(replacing(output, overwrite=outputs.overwrite))
            images = None
            if outputs.images is not None:
                images = stack.enter_context(filling(outputs.images, overwrite=outputs.overwrite))
            self._track(drive, form, draft, output, images, self.progress)
        return self._report(drive.scene.source, form)

    def _track(
        self, source: _TrackableDrive, form: str, draft: Path, file: Path, images: Path | None, steps: Progress | None
    ) -> None:
        with stage("tracking"):
            fused = source.observations
            if fused is None:
                tracked, seconds = track(source.drive, settings=self.settings, progress=steps)
            else:
                offline, tracker = self.settings.offline, self.settings.tracker
                if self.settings.fusion is not None:
                    tracker = replace(tracker, detectors=self.settings.fusion.detectors)
                tracked, seconds = _track_all(source.drive, fused, offline, tracker, steps)
        with stage("writing"):
            losses = _FORMS[form][1](tracked, source, draft, self.outputs)
        with counting_left_out() as left:
            if images is not None:
                save_tracking_images(source.scene, source.drive, tracked, images)
        labels = {number: label for m in tracked for number, label in zip(m.ids.tolist(), m.labels, strict=True)}
        report = _TrackedReport(
            name=source.drive.name,
            file=str(file),
            frames=len(tracked),
            tracks=dict(sorted(Counter(labels.values()).items())),
            states=sum(map(len, tracked)),
            seconds=seconds,
            warnings=(*source.drive.all_warnings, *left.warnings),
        )
        self.drives.append(report)
        self.losses = LossReport.of([*self.losses, *losses])

    def _report(self, source: str, form: str) -> TrackReport:
        frames = sum(one.frames for one in self.drives)
        return TrackReport(
            source=source,
            output=str(self.output),
            form=form,
            drives=tuple(self.drives),
            ms_per_frame=sum(one.seconds for one in self.drives) * 1e3 / frames if frames else 0.0,
            seconds=time.perf_counter() - self.begun,
            warnings=tuple(dict.fromkeys(warning for one in self.drives for warning in one.warnings)),
            losses=self.losses,
        )
