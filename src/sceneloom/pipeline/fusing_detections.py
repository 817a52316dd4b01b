"""Detection fusion of whole drives: boxes through the fusion system into JSON lines of table 10 or KITTI results.

And such files read again for tracking.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from heapq import merge
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.json import format_json, parse_json
from sceneloom.db34t.records import FusedDetections
from sceneloom.db34t.scene_objects import declared_columns
from sceneloom.db34t.types import Timestamp
from sceneloom.detections.detectors import DEFAULT
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import NO_BOX, DetectionAlgorithm, DetectionPair, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.base.files import file_faults, open_file
from sceneloom.formats.base.output import filling, replacing_together
from sceneloom.formats.base.text_tables import read_lines
from sceneloom.formats.kitti.benchmark_writer import write_labels
from sceneloom.formats.kitti.labels import NO_TRACK
from sceneloom.formats.kitti.oxts import PERIOD_NS
from sceneloom.formats.kitti.tracking_reader import KittiTracking
from sceneloom.fusion.algorithms import FusionType, algorithm, chosen_algorithm
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.system import FusedDetectionFrame, FusionSystem, SeenBoxes
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detected_drive import (
    DetectedCamera,
    DetectedDrive,
    KittiObjects,
    SweepPoints,
    kitti_drive,
    kitti_labels,
    poses_at,
    projection_settings,
)
from sceneloom.pipeline.detection_lists import DetectionInput
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import usual_period_ns
from sceneloom.scene.types import Identifier, Progress, reporting
from sceneloom.tracking.tracker import Observation, View
from sceneloom.warnings import DataWarning

_Classes = frozenset[str] | None  # those that a detector looks for; None for all that there are


@dataclass(frozen=True, slots=True, eq=False)
class _CoveringFusion:
    """Fusion by projection for detectors that look for different classes."""

    classes_2d: _Classes
    classes_3d: _Classes
    settings: ProjectionSettings

    def __call__(self, pair: DetectionPair) -> FusedBoxes:
        """Fuse the boxes that both could find, and take those that only one could find as they are."""
        in_space = _looked_for(pair.boxes_3d, self.classes_2d)
        in_image = _looked_for(pair.boxes_2d, self.classes_3d)
        parts = [_part(pair, in_space, in_image, self.settings)]
        none = np.zeros(len(pair.boxes_3d), np.bool_), np.zeros(len(pair.boxes_2d), np.bool_)
        if not in_space.all():
            parts.append(_part(pair, ~in_space, none[1], replace(self.settings, recall_2d=0.0)))
        if not in_image.all():
            parts.append(_part(pair, none[0], ~in_image, replace(self.settings, recall_3d=0.0)))
        return _together(parts)


def _looked_for(boxes: Boxes3D | Boxes2D, classes: _Classes) -> BoolArray:
    return np.array([classes is None or label in classes for label in boxes.labels], np.bool_)


def _part(pair: DetectionPair, in_space: BoolArray, in_image: BoolArray, settings: ProjectionSettings) -> FusedBoxes:
    """Fuse some of the boxes; rows are those among all."""
    if in_space.all() and in_image.all():
        return fuse_by_projection(pair, settings=settings)
    rows_3d, rows_2d = np.flatnonzero(in_space), np.flatnonzero(in_image)
    some = replace(pair, boxes_3d=pair.boxes_3d.select(rows_3d), boxes_2d=pair.boxes_2d.select(rows_2d))
    fused = fuse_by_projection(some, settings=settings)

    def of_all(rows: Int64Array, chosen: Int64Array) -> Int64Array:
        return np.array([NO_BOX if row == NO_BOX else chosen[row] for row in rows.tolist()], np.int64)

    return replace(fused, rows_3d=of_all(fused.rows_3d, rows_3d), rows_2d=of_all(fused.rows_2d, rows_2d))


def _together(parts: Sequence[FusedBoxes]) -> FusedBoxes:
    """Put the objects of one pair together, numbered anew; columns that only some have are left out."""
    if len(parts) == 1:
        return parts[0]
    filled = [part for part in parts if len(part)] or parts[:1]
    columns: dict[str, Any] = {}
    for f in fields(FusedBoxes):
        values = [getattr(part, f.name) for part in filled]
        if all(isinstance(value, np.ndarray) for value in values):
            columns[f.name] = np.concatenate(values)
        elif any(isinstance(value, np.ndarray) for value in values):
            columns[f.name] = None
    labels = tuple(label for part in filled for label in part.labels)
    return replace(filled[0], **{**columns, "labels": labels, "ids": np.arange(len(labels))})


def iter_fused_detections(
    drive: DetectedDrive,
    *,
    configuration: FusionConfiguration | None = None,
    settings: ProjectionSettings | None = None,
) -> Iterator[FusedDetectionFrame]:
    """Play what detectors found through the fusion system, as if it happened now.

    Args:
        settings: what fusion by projection takes for granted; None for the detectors that the configuration names, else
            for what is known of the drive's.

    Yields:
        The objects of each sweep and each image that belongs to it, in the order of the sweeps.

    Raises:
        OptionError: no algorithm has the name that the configuration says.
        CalibrationError: a camera model is unknown.
    """
    chosen = configuration or FusionConfiguration()
    named = chosen_algorithm(FusionType.DETECTIONS, chosen.detection_algorithm)
    detect: DetectionAlgorithm = algorithm(FusionType.DETECTIONS, named)
    if chosen.detection_algorithm == "projection":
        if settings is None and chosen.detectors != DEFAULT:
            settings = ProjectionSettings(detectors=chosen.detectors)
        wanted, found = projection_settings(drive, settings), frozenset(drive.labels)
        if all(classes is None or found <= classes for classes in (drive.classes_2d, drive.classes)):
            detect = partial(fuse_by_projection, settings=wanted)
        else:
            detect = _CoveringFusion(drive.classes_2d, drive.classes, wanted)
    system = FusionSystem(chosen, detect=detect if drive.points is None else _WithPoints(drive.points, detect))
    system.add_lidar(drive.lidar_id, drive.source, period_ns=drive.period_ns, location=drive.source)
    for index, (camera_id, camera) in enumerate(drive.cameras.items()):
        system.add_camera(camera_id, camera.source, index=index)
    for _, _, _, sensor_id, measurement in merge(*_streams(drive), key=lambda entry: entry[:3]):
        system.send(sensor_id, measurement)
        yield from iter(system.get_detections, None)
    system.flush()
    yield from iter(system.get_detections, None)


@dataclass(frozen=True, slots=True)
class _WithPoints:
    """Reads the points of a sweep, by which what images alone show is placed, when its boxes are fused."""

    points: SweepPoints
    detect: DetectionAlgorithm

    def __call__(self, pair: DetectionPair) -> FusedBoxes:
        if not len(pair.boxes_2d):
            return self.detect(pair)
        return self.detect(replace(pair, points_lidar=self.points.at(pair.boxes_3d.timestamp_ns)))


_Sent = tuple[int, int, int, Identifier, Boxes3D | SeenBoxes]


def _streams(drive: DetectedDrive) -> list[list[_Sent]]:
    """What each sensor's detector sends: time, order among sensors, number, sensor, boxes; images before sweeps."""
    streams: list[list[_Sent]] = [
        [
            (boxes.timestamp_ns, order, k, camera_id, SeenBoxes(boxes, camera.camera_model, extras={"seq": k}))
            for k, boxes in enumerate(camera.boxes)
        ]
        for order, (camera_id, camera) in enumerate(drive.cameras.items())
    ]
    streams.append(
        [(boxes.timestamp_ns, len(streams), k, drive.lidar_id, boxes) for k, boxes in enumerate(drive.boxes)]
    )
    return streams


def _detections_record(frame: FusedDetectionFrame, camera_model: Camera, *, camera_number: int) -> FusedDetections:
    """Give the record of table 10 of the objects of a sweep and an image, axes as the scene has them."""
    fused = frame.fused
    columns, _ = declared_columns(fused, _AS_IN_THE_SCENE, camera_model)
    box_ids = [
        tuple(None if row == NO_BOX else row for row in rows.tolist()) for rows in (fused.rows_3d, fused.rows_2d)
    ]
    return FusedDetections(
        timestamp=Timestamp.of(frame.timestamp_ns),
        image_seq=int(frame.image_extras["seq"]),
        points_seq=frame.index,
        camera_id=camera_number,
        lidar_id=0,
        id=fused.ids.astype(np.int32),
        class_names=fused.labels,
        box_3d_ids=box_ids[0],
        box_2d_ids=box_ids[1],
        motion_compensated=int(not frame.stationary),
        image_timestamp=Timestamp.of(frame.image_timestamp_ns),
        **columns,
    )


_AS_IN_THE_SCENE = read_only(np.eye(3))


def _fused_boxes_of(record: FusedDetections) -> FusedBoxes:
    """Give the objects of a record of table 10, whose numbers have 32 bits and whose corners are whole pixels."""
    directions = record.directions.astype(np.float64)
    vectors = record.velocity_vectors
    rows_3d, rows_2d = (
        np.array([NO_BOX if row is None else row for row in ids], np.int64)
        for ids in (record.box_3d_ids, record.box_2d_ids)
    )
    return FusedBoxes(
        timestamp_ns=record.timestamp.nanoseconds,
        centers=record.centers.astype(np.float64),
        center_covariances=record.center_covs.astype(np.float64),
        sizes_lwh=record.sizes_lwh.astype(np.float64),
        size_covariances=record.size_covs.astype(np.float64),
        yaws=np.arctan2(directions[:, 1], directions[:, 0]),
        velocities=None if vectors is None else vectors.astype(np.float64),
        scores=record.confidence.astype(np.float64),
        labels=record.class_names,
        corners_xyxy=record.corners_xyxy.astype(np.float64),
        ids=record.id.astype(np.int64),
        rows_3d=rows_3d,
        rows_2d=rows_2d,
    )


class _FusedDriveReport(msgspec.Struct, kw_only=True):
    """One drive or sequence; its counts grow while it is fused."""

    name: str
    file: str
    pairs: int = 0
    unpaired: int
    objects: int = 0
    both: int = 0
    sweeps_only: int = 0
    images_only: int = 0
    by_class: dict[str, int] = msgspec.field(default_factory=dict)
    warnings: tuple[DataWarning, ...] = ()

    @classmethod
    def of(cls, drive: DetectedDrive, file: Path) -> "_FusedDriveReport":
        return cls(name=drive.name, file=str(file), unpaired=len(drive.boxes), warnings=drive.all_warnings)

    def counted(self, frames: Iterable[FusedDetectionFrame]) -> Iterator[FusedDetectionFrame]:
        """Count the objects of each pair that passes."""
        sweep = -1
        for frame in frames:
            fused = frame.fused
            self.pairs += 1
            self.unpaired -= frame.index != sweep
            sweep = frame.index
            in_space, in_image = fused.rows_3d != NO_BOX, fused.rows_2d != NO_BOX
            self.both += int((in_space & in_image).sum())
            self.sweeps_only += int((in_space & ~in_image).sum())
            self.images_only += int((~in_space & in_image).sum())
            self.objects = self.both + self.sweeps_only + self.images_only
            for label in fused.labels:
                self.by_class[label] = self.by_class.get(label, 0) + 1
            yield frame


class DetectionFusionReport(msgspec.Struct, frozen=True, kw_only=True):
    """All drives or sequences of one call.

    Attributes:
        output: the file, or the folder of files.
    """

    source: str
    output: str
    drives: tuple[_FusedDriveReport, ...]
    seconds: float
    warnings: tuple[DataWarning, ...] = ()


def _kitti_objects(frame: FusedDetectionFrame) -> KittiObjects:
    fused = frame.fused
    return KittiObjects(
        frame.index,
        np.full(len(fused), NO_TRACK),
        fused.labels,
        fused.scores,
        fused.corners_xyxy,
        (fused.centers, fused.sizes_lwh, fused.yaws),
        frame.camera,
    )


_Fuse = Callable[[DetectedDrive], Iterator[FusedDetectionFrame]]
_SIDE_SUFFIX = ".frames.jsonl"
"""The name of the file that says for each line of results where lidar and camera were ends in this."""


def fuse_detections(
    path: str | Path, output: str | Path, *, chosen: DetectionInput | None = None, form: str = "jsonl",
    configuration: FusionConfiguration | None = None, settings: ProjectionSettings | None = None,
    lenient: bool = False, reading: Mapping[str, Any] | None = None, overwrite: bool = False,
    progress: Progress | None = None,
) -> DetectionFusionReport:  # fmt: skip
    """Fuse what detectors found in a drive, or in each sequence of a folder, into records of table 10.

    Beside each file of lines of JSON a second one, `.frames.jsonl`, says where lidar and camera were.

    Args:
        path: a folder laid out like KITTI's tracking benchmark, or a drive.
        output: the folder of files, or the file of lines of JSON.
        form: "jsonl", or of KITTI's folders "kitti" for its text, `NNNN.txt`, without tracks.
        settings: what fusion by projection takes for granted; None for what is known of the drive's detectors.
        lenient: leave out what is faulty, and count it.
        reading: further options of opening a drive, `start` and `stop` of a part among them.

    Raises:
        OptionError: an option does not concern such a path, or a value is not one that can be followed.
        DataError: a file is faulty, or a sequence is not there.
        OutputError: the output exists, or cannot be written.
        PoseError: it is not known where a sensor was.
    """
    begun, output, wanted = time.perf_counter(), Path(output), chosen or DetectionInput()
    fuse = partial(iter_fused_detections, configuration=configuration, settings=settings)
    tracking = wanted.tracking_folder(path, lenient=lenient, reading=reading)
    warnings: tuple[DataWarning, ...] = ()
    if tracking is not None:
        reports = _fuse_sequences(tracking, wanted.sequences, output, form, fuse, progress, overwrite=overwrite)
        source, warnings = str(tracking.path), tracking.warnings
    else:
        if form != "jsonl":
            raise OptionError(
                f"format {form!r} is written for folders laid out like KITTI's only; expected 'jsonl' for {path}"
            )
        with wanted.open_drive(path, lenient=lenient, reading=reading) as (drive, _):
            begun, source = time.perf_counter(), drive.name
            with replacing_together((output, _side_file(output)), overwrite=overwrite) as (draft, side):
                reports = [_fuse_into(drive, draft, side, output, fuse, progress)]
    return DetectionFusionReport(
        source=source,
        output=str(output),
        drives=tuple(reports),
        seconds=time.perf_counter() - begun,
        warnings=tuple(dict.fromkeys([*warnings, *(warning for one in reports for warning in one.warnings)])),
    )


def _fuse_sequences(
    tracking: KittiTracking,
    sequences: Sequence[str],
    output: Path,
    form: str,
    fuse: _Fuse,
    progress: Progress | None,
    *,
    overwrite: bool,
) -> list[_FusedDriveReport]:
    """Fuse some or all sequences of a folder; one or two files each."""
    if form not in {"jsonl", "kitti"}:
        raise OptionError(f"format {form!r}; expected 'jsonl' or 'kitti'")
    names, reports = tracking.chosen(sequences), list[_FusedDriveReport]()
    with filling(output, overwrite=overwrite) as folder:
        for name in reporting(names, progress, len(names)):
            sequence = tracking.sequence(name)
            drive = kitti_drive(sequence)
            if form == "kitti":
                reports.append(_FusedDriveReport.of(drive, output / f"{name}.txt"))
                fused = map(_kitti_objects, reports[-1].counted(fuse(drive)))
                write_labels(kitti_labels(fused, sequence.rectified_from_lidar), folder / f"{name}.txt")
            else:
                draft = folder / f"{name}.jsonl"
                reports.append(_fuse_into(drive, draft, _side_file(draft), output / draft.name, fuse))
    return reports


def _side_file(path: Path) -> Path:
    """The file beside one of results that says where the sensors were."""
    return path.with_name(f"{path.stem}{_SIDE_SUFFIX}")


def _fuse_into(
    drive: DetectedDrive, draft: Path, side: Path, output: Path, fuse: _Fuse, progress: Progress | None = None
) -> _FusedDriveReport:
    report = _FusedDriveReport.of(drive, output)
    numbers = {camera_id: k for k, camera_id in enumerate(drive.cameras, start=1)}
    with draft.open("w", encoding="utf-8", newline="\n") as lines, side.open("wb") as sides:
        for frame in report.counted(fuse(drive)):
            if progress is not None:
                progress(frame.index + 1, len(drive.boxes))
            camera_model = drive.cameras[frame.camera_id].camera_model
            record = _detections_record(frame, camera_model, camera_number=numbers[frame.camera_id])
            lines.write(f"{format_json(record)}\n")
            sides.write(msgspec.json.encode(_Placed.of(drive, frame)) + b"\n")
    return report


def fused_files(path: Path) -> tuple[Path, ...]:
    """The files of results that a path has: itself, or those in a folder; () for none.

    A file is known by its first line, so that one whose other file is missing is reported so.
    """
    found = []
    for file in sorted(path.glob("*.jsonl")) if path.is_dir() else [path] if path.is_file() else []:
        with file_faults(file), open_file(file) as content:
            if content.read(64).lstrip().startswith(b'{"detections"'):
                found.append(file)
    return tuple(found)


def read_fused(path: Path) -> tuple[DetectedDrive, tuple[Observation, ...]]:
    """Read what `fuse_drive_detections` wrote, for a tracker to go on with.

    Numbers have 32 bits there and corners are whole pixels, so that tracks differ a little from those of a drive that
    is fused and tracked at once.

    Returns:
        drive: without boxes; where its lidar and cameras were.
        observations: of each sweep.

    Raises:
        DataError: a file is missing or faulty, or they do not belong together.
    """
    side = _side_file(path)
    if not side.is_file():
        raise DataError(side, "", f"is missing; it says where the sensors of {path.name} were")
    records = [_record(path, number, line) for number, line in read_lines(path)]
    sides = [_placed(side, number, line) for number, line in read_lines(side)]
    if len(records) != len(sides):
        raise DataError(side, "", f"{len(sides)} lines; expected {len(records)}, as {path.name} has")
    by_time: dict[int, list[tuple[FusedDetections, _Placed]]] = {}
    for k, (record, placed) in enumerate(zip(records, sides, strict=True), start=1):
        if record.timestamp.nanoseconds != placed.timestamp_ns:
            problem = f"timestamp_ns {placed.timestamp_ns}; expected {record.timestamp.nanoseconds} as in {path.name}"
            raise DataError(side, f"line {k}", problem)
        by_time.setdefault(placed.timestamp_ns, []).append((record, placed))
    observations = tuple(_observation(by_time[t]) for t in sorted(by_time))
    return _drive(path, sides, sorted(by_time)), observations


class _CameraModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    model: str
    size_wh: tuple[int, int]
    fx_fy_cx_cy: tuple[float, float, float, float]
    coefficients: tuple[float, ...] = ()


_Time = Annotated[int, msgspec.Meta(ge=-(2**62), le=2**62)]
_Seven = tuple[float, float, float, float, float, float, float]  # x, y, z, then the quaternion x, y, z, w


class _Placed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where lidar and camera were, and which camera model it was: a line of the file beside the results."""

    timestamp_ns: _Time
    image_timestamp_ns: _Time
    lidar: Identifier
    camera: Identifier
    world_from_lidar: _Seven
    world_from_camera: _Seven
    camera_model: _CameraModel

    @classmethod
    def of(cls, drive: DetectedDrive, frame: FusedDetectionFrame) -> "_Placed":
        """Those of the sweep and the image of a result."""
        camera, model = drive.cameras[frame.camera_id], drive.cameras[frame.camera_id].camera_model
        poses = [
            poses_at(source, np.array([time_ns], np.int64))[0]
            for source, time_ns in ((drive.source, frame.timestamp_ns), (camera.source, frame.image_timestamp_ns))
        ]
        sevens: list[Any] = [(*pose.translation.tolist(), *pose.quaternion_xyzw.tolist()) for pose in poses]
        focal = (model.fx, model.fy, model.cx, model.cy)
        numbers = _CameraModel(model.model, (model.width, model.height), focal, tuple(model.coefficients))
        return cls(
            frame.timestamp_ns, frame.image_timestamp_ns, frame.lidar_id, frame.camera_id, sevens[0], sevens[1], numbers
        )

    @property
    def poses(self) -> tuple[RigidTransform, RigidTransform]:
        """`world_from_lidar` and `world_from_camera`."""
        lidar, camera = (
            RigidTransform.from_quaternion(np.array(seven[:3]), np.array(seven[3:]))
            for seven in (self.world_from_lidar, self.world_from_camera)
        )
        return lidar, camera

    @property
    def view(self) -> View:
        """The camera as a tracker knows it."""
        model, (world_from_lidar, world_from_camera) = self.camera_model, self.poses
        camera_model = Camera(model.model, *model.size_wh, *model.fx_fy_cx_cy, model.coefficients)
        return View(camera_model, world_from_camera.inverse() @ world_from_lidar)


def _record(path: Path, number: int, line: str) -> FusedDetections:
    try:
        record = parse_json(line)
        if not isinstance(record, FusedDetections):
            problem = f"a {type(record).__name__}; expected the detections of table 10"
            raise DataError("record", "", problem)  # noqa: TRY301 - its location is added below, as to all of them
    except DataError as error:
        raise DataError(path, ": ".join(filter(None, (f"line {number}", error.location))), error.problem) from error
    return record


def _placed(path: Path, number: int, line: str) -> _Placed:
    try:
        placed = msgspec.json.decode(line, type=_Placed)
        placed.view  # noqa: B018 - a camera model or a pose that is none raises here, where the line is known
    except (msgspec.DecodeError, SceneloomError, UnicodeError, RecursionError) as error:
        raise DataError(path, f"line {number}", f"{error}; expected where lidar and camera were") from error
    return placed


def _observation(same: list[tuple[FusedDetections, _Placed]]) -> Observation:
    return Observation(
        same[0][1].timestamp_ns,
        same[0][1].poses[0],
        {placed.camera: _fused_boxes_of(record) for record, placed in same},
        {placed.camera: placed.view for _, placed in same},
    )


def _drive(path: Path, sides: list[_Placed], times: list[int]) -> DetectedDrive:
    """The sensors as the lines report them, each on a way of its own."""
    lidar_id = sides[0].lidar if sides else "lidar"
    lidar = _trajectory({placed.timestamp_ns: placed.world_from_lidar for placed in sides})
    cameras = {}
    for camera_id in dict.fromkeys(placed.camera for placed in sides):
        own = [placed for placed in sides if placed.camera == camera_id]
        trajectory = _trajectory({placed.image_timestamp_ns: placed.world_from_camera for placed in own})
        cameras[camera_id] = DetectedCamera(own[0].view.camera, trajectory, ())
    return DetectedDrive(
        name=path.stem,
        lidar_id=lidar_id,
        source=lidar,
        boxes=tuple(Boxes3D.empty(t, sensor_id=lidar_id) for t in times),
        cameras=cameras,
        period_ns=usual_period_ns(np.array(times, np.int64)) if len(times) > 1 else PERIOD_NS,
    )


def _trajectory(poses: Mapping[int, _Seven]) -> PoseSource:
    if not poses:
        return PoseSource(Poses.identity(), RigidTransform.identity())
    times = sorted(poses)
    values = np.array([poses[t] for t in times], np.float64)
    path = Poses(np.array(times, np.int64), values[:, :3].copy(), values[:, 3:].copy())
    return PoseSource(path, RigidTransform.identity(), PERIOD_NS, own=True)
