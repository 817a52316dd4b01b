"""Detection fusion of whole drives into lines of JSON, and the way back: what a tracker goes on with."""

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.files import file_faults, open_file
from sceneloom.formats.kitti.labels import write_labels
from sceneloom.formats.kitti.oxts import PERIOD_NS
from sceneloom.formats.kitti.tracking_folder import KittiTracking
from sceneloom.formats.output import filling, replacing_together
from sceneloom.formats.rig.csv_files import read_lines
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.detection_fusion import FusedDetectionFrame
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.json_form import format_json, parse_json
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detections.detected import (
    DetectedCamera,
    DetectedDrive,
    calibration_warnings,
    kitti_drive,
    poses_at,
)
from sceneloom.pipeline.detections.fused import detections_record, fused_boxes_of, iter_fused_detections
from sceneloom.pipeline.detections.kitti_objects import kitti_objects
from sceneloom.pipeline.detections.report import DetectionFusionReport, DetectionStatistics, FusedDriveReport
from sceneloom.scene.detections import Boxes3D
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.span import usual_period_ns
from sceneloom.scene.types import Identifier, Progress
from sceneloom.scene.warnings import DataWarning
from sceneloom.tracking.observation import Observation, View

SIDE_SUFFIX = ".frames.jsonl"
"""How the file is called that says of each line of results where lidar and camera were."""


def fuse_folder_detections(
    tracking: KittiTracking,
    output: str | Path,
    *,
    sequences: Iterable[str] = (),
    configuration: FusionConfiguration | None = None,
    settings: ProjectionSettings | None = None,
    form: str = "jsonl",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> DetectionFusionReport:
    """Fuse the detections of a folder laid out like KITTI's tracking benchmark; two files for each sequence.

    Args:
        tracking: the folder.
        output: the folder to write.
        sequences: which ones; none for all.
        configuration: settings of the fusion system.
        settings: what fusion by projection takes for granted; None for what is known of the drive's detectors.
        form: "jsonl", or "kitti" for one file of KITTI's text, `NNNN.txt`, without tracks.
        overwrite: whether files that exist may be replaced.
        progress: reported after each pair.

    Raises:
        DataError: a file is faulty, or a sequence is not there.
        OutputError: the folder has something in it, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    begun = time.perf_counter()
    if form not in {"jsonl", "kitti"}:
        raise OptionError(f"format {form!r}; expected 'jsonl' or 'kitti'")
    output, names = Path(output), tracking.chosen(sequences)
    reports = []
    with filling(output, overwrite=overwrite) as folder:
        for k, name in enumerate(names):
            sequence = tracking.sequence(name)
            drive = kitti_drive(sequence)
            if form == "kitti":
                file = folder / f"{name}.txt"
                fused = list(iter_fused_detections(drive, configuration=configuration, settings=settings))
                write_labels(kitti_objects(fused, sequence.rectified_from_lidar), file)
                reports.append(_drive_report(drive, output / file.name, DetectionStatistics.of(fused)))
            else:
                draft = folder / f"{name}.jsonl"
                report = _fuse_into(
                    drive, draft, side_file(draft), output / draft.name, configuration, settings
                )
                reports.append(report)
            if progress is not None:
                progress(k + 1, len(names))
    return _report(str(tracking.path), output, reports, tracking.warnings, begun)


def fuse_drive_detections(
    drive: DetectedDrive,
    output: str | Path,
    *,
    configuration: FusionConfiguration | None = None,
    settings: ProjectionSettings | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> DetectionFusionReport:
    """Fuse the detections of a drive into lines of JSON, and write beside them where lidar and camera were.

    Args:
        drive: what detectors found.
        output: the file of lines; the other one has its name with `.frames.jsonl`.
        configuration: settings of the fusion system.
        settings: what fusion by projection takes for granted; None for what is known of the drive's detectors.
        overwrite: whether files that exist may be replaced.
        progress: reported after each pair.

    Raises:
        OutputError: a file exists, or cannot be written.
        OptionError: a value is not one that can be followed.
        DataError: a time cannot stand in a record.
    """
    begun = time.perf_counter()
    output = Path(output)
    with replacing_together((output, side_file(output)), overwrite=overwrite) as (draft, side):
        report = _fuse_into(drive, draft, side, output, configuration, settings, progress)
    return _report(drive.name, output, [report], (), begun)


def side_file(path: Path) -> Path:
    """The file beside one of results that says where the sensors were."""
    return path.with_name(f"{path.stem}{SIDE_SUFFIX}")


def _fuse_into(
    drive: DetectedDrive,
    draft: Path,
    side: Path,
    output: Path,
    configuration: FusionConfiguration | None,
    settings: ProjectionSettings | None,
    progress: Progress | None = None,
) -> FusedDriveReport:
    statistics = DetectionStatistics()
    numbers = {camera_id: k for k, camera_id in enumerate(drive.cameras, start=1)}
    with draft.open("w", encoding="utf-8", newline="\n") as lines, side.open("wb") as sides:
        for frame in iter_fused_detections(drive, configuration=configuration, settings=settings):
            statistics.add(frame)
            if progress is not None:
                progress(frame.index + 1, len(drive.boxes))
            camera_model = drive.cameras[frame.camera_id].camera_model
            record = detections_record(frame, camera_model, camera_number=numbers[frame.camera_id])
            lines.write(f"{format_json(record)}\n")
            sides.write(msgspec.json.encode(_side(drive, frame, camera_model)) + b"\n")
    return _drive_report(drive, output, statistics)


def _drive_report(drive: DetectedDrive, output: Path, statistics: DetectionStatistics) -> FusedDriveReport:
    return FusedDriveReport(
        name=drive.name,
        file=str(output),
        pairs=statistics.pairs,
        unpaired=len(drive.boxes) - statistics.fused_sweeps,
        objects=statistics.both + statistics.sweeps_only + statistics.images_only,
        both=statistics.both,
        sweeps_only=statistics.sweeps_only,
        images_only=statistics.images_only,
        by_class=dict(statistics.by_class),
        warnings=(*drive.warnings, *calibration_warnings(drive)),
    )


def _side(drive: DetectedDrive, frame: FusedDetectionFrame, camera_model: Camera) -> dict[str, Any]:
    """Where lidar and camera were, which camera model it was, as one line."""
    camera = drive.cameras[frame.camera_id]
    (world_from_lidar,) = poses_at(drive.source, np.array([frame.timestamp_ns], np.int64))
    (world_from_camera,) = poses_at(camera.source, np.array([frame.image_timestamp_ns], np.int64))
    return {
        "timestamp_ns": frame.timestamp_ns,
        "image_timestamp_ns": frame.image_timestamp_ns,
        "lidar": frame.lidar_id,
        "camera": frame.camera_id,
        "world_from_lidar": _seven(world_from_lidar),
        "world_from_camera": _seven(world_from_camera),
        "camera_model": {
            "model": camera_model.model,
            "size_wh": [camera_model.width, camera_model.height],
            "fx_fy_cx_cy": [camera_model.fx, camera_model.fy, camera_model.cx, camera_model.cy],
            "coefficients": list(camera_model.coefficients),
        },
    }


def _seven(pose: RigidTransform) -> list[float]:
    """x, y, z, then the quaternion x, y, z, w."""
    return [*pose.translation.tolist(), *pose.quaternion_xyzw.tolist()]


def _report(
    source: str, output: Path, reports: list[FusedDriveReport], warnings: Iterable[DataWarning], begun: float
) -> DetectionFusionReport:
    return DetectionFusionReport(
        source=source,
        output=str(output),
        drives=tuple(reports),
        seconds=time.perf_counter() - begun,
        warnings=tuple(
            dict.fromkeys([*warnings, *(warning for report in reports for warning in report.warnings)])
        ),
    )


def fused_files(path: Path) -> tuple[Path, ...]:
    """The files of results that a path has: itself, or those in a folder; () for none.

    A file is known by its first line, so that one whose other file is missing is reported so.
    """
    found = sorted(path.glob("*.jsonl")) if path.is_dir() else [path] if path.is_file() else []
    return tuple(file for file in found if _begins_with_detections(file))


def _begins_with_detections(path: Path) -> bool:
    with file_faults(path), open_file(path) as file:
        return file.read(64).lstrip().startswith(b'{"detections"')


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
    side = side_file(path)
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
_Seven = tuple[float, float, float, float, float, float, float]


class _Placed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where lidar and camera were, as `_side` reports it."""

    timestamp_ns: _Time
    image_timestamp_ns: _Time
    lidar: Identifier
    camera: Identifier
    world_from_lidar: _Seven
    world_from_camera: _Seven
    camera_model: _CameraModel

    @property
    def view(self) -> View:
        """The camera as a tracker knows it."""
        camera_model = Camera(
            self.camera_model.model,
            *self.camera_model.size_wh,
            *self.camera_model.fx_fy_cx_cy,
            self.camera_model.coefficients,
        )
        return View(camera_model, _pose(self.world_from_camera).inverse() @ _pose(self.world_from_lidar))


def _record(path: Path, number: int, line: str) -> FusedDetections:
    try:
        record = parse_json(line)
        if not isinstance(record, FusedDetections):
            problem = f"a {type(record).__name__}; expected the detections of table 10"
            raise DataError("record", "", problem)  # noqa: TRY301 - its location is added below, as to all of them
    except DataError as error:
        raise DataError(
            path, ": ".join(filter(None, (f"line {number}", error.location))), error.problem
        ) from error
    return record


def _placed(path: Path, number: int, line: str) -> _Placed:
    try:
        placed = msgspec.json.decode(line, type=_Placed)
        placed.view  # noqa: B018 - a camera model or a pose that is none raises here, where the line is known
    except (msgspec.DecodeError, SceneloomError, UnicodeError, RecursionError) as error:
        raise DataError(path, f"line {number}", f"{error}; expected where lidar and camera were") from error
    return placed


def _pose(seven: _Seven) -> RigidTransform:
    return RigidTransform.from_quaternion(np.array(seven[:3]), np.array(seven[3:]))


def _observation(same: list[tuple[FusedDetections, _Placed]]) -> Observation:
    return Observation(
        same[0][1].timestamp_ns,
        _pose(same[0][1].world_from_lidar),
        {placed.camera: fused_boxes_of(record) for record, placed in same},
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
        period_ns=usual_period_ns(_times(times)) if len(times) > 1 else PERIOD_NS,
    )


def _times(times: Iterable[int]) -> Int64Array:
    return np.array(list(times), np.int64)


def _trajectory(poses: Mapping[int, _Seven]) -> PoseSource:
    if not poses:
        return PoseSource(Poses.identity(), RigidTransform.identity())
    times = sorted(poses)
    values = np.array([poses[t] for t in times], np.float64)
    path = Poses(_times(times), values[:, :3].copy(), values[:, 3:].copy())
    return PoseSource(path, RigidTransform.identity(), PERIOD_NS, own=True)
