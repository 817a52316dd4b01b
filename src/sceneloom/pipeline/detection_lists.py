"""Detection files beside a drive: JSON lines of the standard, KITTI text, nuScenes JSON; and the drive they make.

In this order: a reader for each form; the table of forms; which files and sensors; the drive.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.db34t.json import from_json
from sceneloom.db34t.records import RECORD_KINDS, Box2d, Box3d, Boxes2d, Boxes3d, join_boxes
from sceneloom.db34t.scene_objects import boxes_2d_of, boxes_3d_of
from sceneloom.editing.crop import crop_scene
from sceneloom.errors import DataError, OptionError, UnknownFormatError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, open_file, read_bytes
from sceneloom.formats.base.registry import PART, open_scene
from sceneloom.formats.base.text_tables import read_lines
from sceneloom.formats.kitti.labels import (
    CENTRE_TO_CORNER,
    COLUMNS_2D,
    COLUMNS_3D,
    DONT_CARE,
    TYPES,
    DetectionList,
    class_word,
    lidar_boxes,
    read_boxes_2d_list,
    read_boxes_3d_list,
    read_labels,
)
from sceneloom.formats.kitti.tracking_reader import KittiTracking, is_tracking_folder, open_tracking_folder
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.motion.ego_trajectory import find_ego_motion
from sceneloom.pipeline.detected_drive import DetectedCamera, DetectedDrive, SweepPoints, poses_at
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.ego import EgoMotion, needs_ego, sensor_source
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns, sweep_period_ns
from sceneloom.scene.types import Identifier, PointsFrame
from sceneloom.warnings import WarningKind


@dataclass(frozen=True, slots=True, eq=False)
class ListContext:
    """The sensor whose detector wrote a list.

    Attributes:
        sensor_id: the lidar, or the camera.
        timestamps_ns: of its sweeps or images, (N,) int64 [ns], rising: by them, frames are numbered.
        number: `sensor_id` of the records that are its own; None for all.
        others: those of other sensors that are known, whose records are no matter.
        source: `world_from_sensor`, for boxes in the world; None where it is not known.
        sensor_from_camera: takes the rectified camera's frame into the sensor's, for KITTI's boxes in space; None where
            it is not known.
        label: class of all boxes of a list that has none; None for that of its folder's name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    number: int | None = None
    others: frozenset[int] = frozenset()
    source: PoseSource | None = None
    sensor_from_camera: RigidTransform | None = None
    label: str | None = None

    def time_of(self, frame: int, path: Path, location: str) -> int:
        """When a frame was [ns].

        Raises:
            DataError: the sensor has no frame of that number.
        """
        if not 0 <= frame < len(self.timestamps_ns):
            raise DataError(
                path,
                location,
                f"frame {frame}; expected 0 to {len(self.timestamps_ns) - 1}, as sensor {self.sensor_id!r} has them",
            )
        return int(self.timestamps_ns[frame])


_Read3D = Callable[[Path, ListContext, Ledger], Sequence[Boxes3D]]
_Read2D = Callable[[Path, ListContext, Ledger], Sequence[Boxes2D]]


@dataclass(frozen=True, slots=True)
class _ListForm:
    """One form of lists.

    Attributes:
        read_2d: reads boxes in images; None where the form has none.
    """

    name: str
    looks_like: str
    recognises: Callable[[str], bool]
    read_3d: _Read3D
    read_2d: _Read2D | None = None


def _sorted_by_time(lists: Sequence[Boxes3D] | Sequence[Boxes2D]) -> list[int]:
    """The numbers of lists in the order of their times."""
    times = np.array([boxes.timestamp_ns for boxes in lists], np.int64)
    order: list[int] = np.argsort(times, kind="stable").tolist()
    return order


def _is_json_lines(head: str) -> bool:
    return head.startswith("{") and '"results"' not in head[:20_000].split("[", 1)[0]


def _read_json_3d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    lists = [
        replace(boxes_3d_of(record, sensor_id=context.sensor_id), ids=None)
        for record in _records(path, context, ledger, (Boxes3d, Box3d))
    ]
    return _complete(lists, context, Boxes3D.empty)


def _read_json_2d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    lists = [
        replace(boxes_2d_of(record, sensor_id=context.sensor_id), ids=None)
        for record in _records(path, context, ledger, (Boxes2d, Box2d))
    ]
    return _complete(lists, context, Boxes2D.empty)


def _complete(lists: list[Any], context: ListContext, empty: Any) -> list[Any]:
    """In the order of time, with lists of nothing for frames of the sensor between the first and last that have none.

    A detector that writes bare boxes cannot state that it found nothing.
    """
    if lists:
        known = {boxes.timestamp_ns for boxes in lists}
        first, last = min(known), max(known)
        missing = [t for t in context.timestamps_ns.tolist() if first <= t <= last and t not in known]
        tick_ns = _half_step(context)
        near = sorted(known)
        lists += [empty(t, sensor_id=context.sensor_id) for t in missing if min(abs(t - one) for one in near) > tick_ns]
    return [lists[k] for k in _sorted_by_time(lists)]


def _half_step(context: ListContext) -> int:
    steps = context.timestamps_ns[1:] - context.timestamps_ns[:-1]
    return int(steps.min()) // 2 if len(steps) else 0


def _records(path: Path, context: ListContext, ledger: Ledger, wanted: tuple[type[Any], type[Any]]) -> Iterator[Any]:
    """The lists of boxes of a file; bare boxes of one frame are put together, wherever they stand."""
    single = wanted[1]
    lone: list[Any] = []
    others = 0
    for number, line in read_lines(path):
        try:
            record = _record(line, wanted)
        except DataError as error:
            location = ": ".join(filter(None, (f"line {number}", error.location)))
            ledger.fault("faulty-detections", DataError(path, location, error.problem))
            continue
        if isinstance(record, single):
            lone.append(record)
        elif context.number is None or record.sensor_id == context.number:
            yield record
        elif record.sensor_id not in context.others:
            others += 1
    if others:
        message = "lists whose sensor_id is that of no sensor here"
        ledger.note(WarningKind.SKIPPED, "other-sensors", str(path), message, count=others)
    lone.sort(key=_frame_of)  # stable: within a frame, the order of the file
    for _, same in groupby(lone, key=_frame_of):
        yield join_boxes([box.alone(context.number or 0) for box in same])


def _frame_of(box: Box3d | Box2d) -> tuple[Any, int]:
    return box.timestamp, box.points_seq if isinstance(box, Box3d) else box.image_seq


def _record(line: str, wanted: tuple[type[Any], type[Any]]) -> Any:
    """The record of a line, of one of two types."""
    record = _any_record(line)
    if not isinstance(record, wanted):
        kinds = " or ".join(kind.__name__ for kind in wanted)
        raise DataError("record", "", f"a {type(record).__name__}; expected {kinds}")
    return record


def _any_record(line: str) -> Any:
    """The record of a line: under the name of its kind, or bare."""
    try:
        content = msgspec.json.decode(line)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise DataError("record", "", f"no JSON: {error}") from error
    if not isinstance(content, Mapping):
        raise DataError("record", "", "no JSON object; expected a record of boxes")
    if len(content) == 1 and (name := next(iter(content))) in RECORD_KINDS:
        return from_json(name, content[name])
    space = any(name in content for name in ("X", "x", "points_seq"))
    if "boxes" in content:
        inner = content["boxes"]
        space = isinstance(inner, list) and any(
            isinstance(box, Mapping) and ("X" in box or "x" in box) for box in inner
        )
        return from_json("boxes_3d" if space else "boxes_2d", content)
    return from_json("box_3d" if space else "box_2d", content)


def _has_commas(head: str) -> bool:
    words = head.split("\n", 1)[0].split(",")
    return len(words) in (len(COLUMNS_2D), len(COLUMNS_3D)) and words[0].strip().lstrip("-").isdigit()


def _has_blanks(head: str) -> bool:
    words = head.split("\n", 1)[0].split()
    return len(words) in (15, 16, 17, 18) and any(word[:1].isalpha() for word in words[:3])


class _KittiRows(NamedTuple):
    """Boxes of KITTI's text, whichever form it has.

    Attributes:
        frames: (N,) int64, the number of each box's frame.
        corners_xyxy: (N, 4) float64 [px], pixels counted from the centre of the first one; of boxes in images.
        placed: sizes (N, 3), bottoms (N, 3) and rotations (N,), as KITTI has them; of boxes in space.
    """

    frames: Int64Array
    labels: Sequence[str]
    scores: Float64Array
    score_form: ScoreForm
    corners_xyxy: Float64Array
    placed: tuple[Float64Array, Float64Array, Float64Array]


def _list_rows(found: DetectionList, *, in_space: bool) -> _KittiRows:
    values = found.values
    score_form, score = (ScoreForm.LOGIT, 6) if in_space else (ScoreForm.PROBABILITY, 5)
    placed = values[:, 7:10], values[:, 10:13], values[:, 13:14].reshape(-1)
    return _KittiRows(found.frames, found.labels, values[:, score], score_form, values[:, 1:5], placed)


def _result_rows(path: Path, *, in_space: bool) -> _KittiRows:
    """Labels or results; without scores they are certain, and scores beyond 0 to 1 are logits."""
    results = read_labels(path)
    results = results.select(np.array([word != DONT_CARE for word in results.types], np.bool_))
    if in_space:
        results = results.select(results.have_position)
    scores = np.ones(len(results)) if results.scores is None else results.scores
    placed = results.sizes_hwl, results.bottoms, results.rotations_y
    return _KittiRows(results.frames, results.types, scores, _score_form(scores), results.corners_xyxy, placed)


def _read_lists_3d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    label = context.label or (_folder_label(path) if path.parent.name in TYPES.values() else None)
    rows = _list_rows(read_boxes_3d_list(path, label, ledger), in_space=True)
    return _kitti_boxes_3d(rows, path, context, ledger)


def _read_lists_2d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    found = read_boxes_2d_list(path, context.label or _folder_label(path), ledger)
    return _kitti_boxes_2d(_list_rows(found, in_space=False), path, context)


def _folder_label(path: Path) -> str:
    return class_word(path.resolve().parent.name)


def _read_results_3d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    return _kitti_boxes_3d(_result_rows(path, in_space=True), path, context, ledger)


def _read_results_2d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    del ledger
    return _kitti_boxes_2d(_result_rows(path, in_space=False), path, context)


def _kitti_boxes_3d(rows: _KittiRows, path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    """Boxes of the camera's frame, brought into the sensor's."""
    sensor_from_camera = context.sensor_from_camera
    if sensor_from_camera is None:
        if len(rows.frames):
            problem = "its boxes are in the camera's frame, and no camera is known; expected one, or `--camera ID`"
            raise DataError(path, "", problem)
        sensor_from_camera = RigidTransform.identity()
    message = "its boxes are taken to be in the frame of the camera that was chosen"
    ledger.note(WarningKind.ASSUMED, "boxes-in-camera-frame", str(path), message)
    centers, sizes, yaws = lidar_boxes(*rows.placed, sensor_from_camera.inverse())
    return [
        Boxes3D(
            time_ns,
            centers[kept],
            sizes[kept],
            yaws[kept],
            rows.scores[kept],
            tuple(rows.labels[k] for k in kept.tolist()),
            score_form=rows.score_form,
            sensor_id=context.sensor_id,
        )
        for time_ns, kept in _rows_by_frame(rows.frames, context, path)
    ]


def _kitti_boxes_2d(rows: _KittiRows, path: Path, context: ListContext) -> Sequence[Boxes2D]:
    return [
        Boxes2D(
            time_ns,
            rows.corners_xyxy[kept] + CENTRE_TO_CORNER,
            rows.scores[kept],
            tuple(rows.labels[k] for k in kept.tolist()),
            score_form=rows.score_form,
            sensor_id=context.sensor_id,
        )
        for time_ns, kept in _rows_by_frame(rows.frames, context, path)
    ]


def _rows_by_frame(frames: Int64Array, context: ListContext, path: Path) -> list[tuple[int, Int64Array]]:
    """For each frame of the sensor its time and the rows of its boxes, in the order of the file."""
    if len(frames):
        context.time_of(int(frames.min()), path, "")
        context.time_of(int(frames.max()), path, "")
    return [(time_ns, np.flatnonzero(frames == frame)) for frame, time_ns in enumerate(context.timestamps_ns.tolist())]


def _score_form(scores: Float64Array) -> ScoreForm:
    within = len(scores) == 0 or (scores.min() >= 0.0 and scores.max() <= 1.0)
    return ScoreForm.PROBABILITY if within else ScoreForm.LOGIT


def _is_nuscenes(head: str) -> bool:
    return head.startswith("{") and '"results"' in head


def _nuscenes_read_3d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    """Read boxes in space, and bring them into the sensor's frame.

    Source: "Detection: results format" of the nuScenes devkit: translation [m] x, y, z; size [m] width, length, height;
    rotation w, x, y, z; velocity [m/s] x, y; all in the global frame.
    """
    if context.source is None:
        raise DataError(path, "", "its boxes are in the world, and it is not known where the lidar was")
    results = _nuscenes_results(path)
    timestamps = _sample_times(path, results, context)
    lists = []
    for token, boxes in results.items():
        time_ns = timestamps.get(token)
        if time_ns is None:
            message = "samples that are not of this drive"
            ledger.note(WarningKind.SKIPPED, "other-samples", f"{path}: results.{token}", message)
            continue
        rows = []
        for k, box in enumerate(boxes):
            location = f"results.{token}[{k}]"
            try:
                rows.append(_row(path, location, box))
            except DataError as error:
                ledger.fault("faulty-detections", error)
        lists.append(_boxes(rows, time_ns, context.source, context.sensor_id))
    return [lists[k] for k in _sorted_by_time(lists)]


def _nuscenes_results(path: Path) -> Mapping[str, Sequence[Any]]:
    try:
        content = msgspec.json.decode(read_bytes(path))
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise DataError(path, "", f"no JSON: {error}") from error
    results = content.get("results") if isinstance(content, Mapping) else None
    if not isinstance(results, Mapping):
        raise DataError(path, "results", "expected an object: by token of a sample its boxes")
    for token, boxes in results.items():
        if not isinstance(boxes, list):
            raise DataError(path, f"results.{token}", f"{str(boxes)[:40]}; expected a list of boxes")
    return results


def _sample_times(path: Path, results: Mapping[str, Any], context: ListContext) -> dict[str, int]:
    """The time of each sample [ns]: of the table `sample.json`, or of tokens that are times themselves."""
    if all(token.isascii() and token.isdigit() for token in results):
        micros = {token: int(token) * 1000 for token in results}
        return {token: t for token, t in micros.items() if _in_drive(t, context)}
    beside = (path.parent / "sample.json", path.parent.parent / "sample.json")
    table = next((file for file in beside if file.is_file()), None)
    if table is None:
        problem = "the times of its samples are not known; put nuScenes' table sample.json (token, timestamp) beside it"
        raise DataError(path, "", problem)
    try:
        rows = msgspec.json.decode(read_bytes(table))
        times = {row["token"]: int(row["timestamp"]) * 1000 for row in rows}
    except (msgspec.DecodeError, RecursionError, TypeError, KeyError, ValueError) as error:
        raise DataError(table, "", f"{error}; expected a list of objects with token and timestamp [µs]") from error
    return {token: t for token, t in times.items() if token in results and _in_drive(t, context)}


def _in_drive(time_ns: int, context: ListContext) -> bool:
    times = context.timestamps_ns
    return bool(len(times)) and int(times[0]) - 10**9 <= time_ns <= int(times[-1]) + 10**9


_NUMBERS = {"translation": 3, "size": 3, "rotation": 4}


def _row(path: Path, location: str, box: Any) -> tuple[Float64Array, str]:
    """Middle, length, width, height, yaw, velocity and score of a box, (11,), and its class."""
    if not isinstance(box, Mapping):
        raise DataError(path, location, f"{str(box)[:40]}; expected an object")
    numbers = {name: _vector(path, location, box, name, count) for name, count in _NUMBERS.items()}
    if (numbers["size"] <= 0).any():
        raise DataError(path, f"{location}.size", f"{numbers['size'].tolist()}; expected sizes above 0")
    w, x, y, z = numbers["rotation"]
    if not 0.99 < float(np.linalg.norm(numbers["rotation"])) < 1.01:
        raise DataError(path, f"{location}.rotation", f"{[w, x, y, z]}; expected w, x, y, z of length 1")
    heading = matrix_from_quaternion([x, y, z, w])[:, 0]
    velocity = np.nan_to_num(_velocity(path, location, box))
    label, score = box.get("detection_name"), box.get("detection_score")
    if not isinstance(label, str) or not label:
        raise DataError(path, f"{location}.detection_name", f"{label!r}; expected the name of a class")
    if isinstance(score, bool) or not isinstance(score, int | float) or not np.isfinite(score):
        raise DataError(path, f"{location}.detection_score", f"{score!r}; expected a finite number")
    yaw = np.arctan2(heading[1], heading[0])
    width, length, height = numbers["size"]
    return np.array([*numbers["translation"], length, width, height, yaw, *velocity, 0.0, score]), label


def _vector(path: Path, location: str, box: Mapping[str, Any], name: str, count: int) -> Float64Array:
    value = box.get(name)
    sound = isinstance(value, list) and len(value) == count
    if not sound or not all(isinstance(one, int | float) and abs(one) < 1e9 for one in value or ()):
        raise DataError(path, f"{location}.{name}", f"{str(value)[:60]}; expected {count} finite numbers")
    return np.array(value, np.float64)


def _velocity(path: Path, location: str, box: Mapping[str, Any]) -> Float64Array:
    """Of a box [m/s], x and y; a JSON may state NaN or null where it is not known, which stands for 0."""
    value = box.get("velocity") or [0.0, 0.0]
    if not isinstance(value, list) or len(value) < 2:
        raise DataError(path, f"{location}.velocity", f"{str(value)[:60]}; expected two numbers")
    known = [0.0 if one is None else one for one in value[:2]]
    if not all(isinstance(one, int | float) for one in known):
        raise DataError(path, f"{location}.velocity", f"{str(value)[:60]}; expected two numbers")
    return np.array(known, np.float64)


def _boxes(
    rows: Sequence[tuple[Float64Array, str]], time_ns: int, source: PoseSource, sensor_id: Identifier
) -> Boxes3D:
    """Boxes of the world at one time, in the sensor's frame; velocities stay over ground."""
    values = np.array([row for row, _ in rows], np.float64).reshape(len(rows), 11)
    boxes = Boxes3D(
        time_ns,
        values[:, :3].copy(),
        values[:, 3:6].copy(),
        values[:, 6].copy(),
        values[:, 10].copy(),
        tuple(label for _, label in rows),
        velocities=values[:, 7:10].copy(),
        frame=PointsFrame.WORLD,
        score_form=_score_form(values[:, 10]),
        sensor_id=sensor_id,
    )
    (world_from_sensor,) = poses_at(source, np.array([time_ns], np.int64))
    return boxes.moved(world_from_sensor.inverse(), PointsFrame.SENSOR)


_FORMS: tuple[_ListForm, ...] = (
    _ListForm(
        "json-lines",
        "lines of JSON, each a record of table 7 or 8 of DB34/T 4101, or a frame's list of them",
        _is_json_lines,
        _read_json_3d,
        _read_json_2d,
    ),
    _ListForm(
        "nuscenes",
        'a JSON object with "results" by sample, as nuScenes has detections',
        _is_nuscenes,
        _nuscenes_read_3d,
    ),
    _ListForm(
        "kitti-lists",
        "lines of 6 or 15 numbers with commas, a frame's number first",
        _has_commas,
        _read_lists_3d,
        _read_lists_2d,
    ),
    _ListForm(
        "kitti-results",
        "KITTI's text of labels or results, 15 to 18 words a line",
        _has_blanks,
        _read_results_3d,
        _read_results_2d,
    ),
)
"""All forms; at most one of them recognises a file."""

_HEAD = 65536


def form_of(path: Path) -> _ListForm | None:
    """The form of a file; None for an empty one, in which nothing was found.

    Raises:
        DataError: it cannot be read.
        UnknownFormatError: no form recognises it.
    """
    with file_faults(path), open_file(path) as file:
        head = file.read(_HEAD).decode("utf-8-sig", "replace").lstrip()
    if not head:
        return None
    for form in _FORMS:
        if form.recognises(head):
            return form
    known = "; ".join(f"{form.name}, {form.looks_like}" for form in _FORMS)
    raise UnknownFormatError(path, "line 1", f"{head.splitlines()[0][:60]!r}; expected a list of boxes: {known}")


def read_boxes_3d(path: Path | str, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    """Read the boxes in space of a lidar's detector, by sweep, in the order of time and in the lidar's frame.

    Args:
        path: a file of any of the forms.
        context: what it does not state itself.
        ledger: reported what was assumed, and in a lenient reading of faults.

    Raises:
        DataError: the file cannot be read, or is faulty.
        UnknownFormatError: no form recognises it.
    """
    path = Path(path)
    form = form_of(path)
    if form is None:
        return [Boxes3D.empty(t, sensor_id=context.sensor_id) for t in context.timestamps_ns.tolist()]
    return form.read_3d(path, context, ledger)


def read_boxes_2d(path: Path | str, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    """Read the boxes of a camera's detector, by image, in the order of time.

    Args:
        path, context, ledger: as of `read_boxes_3d`.

    Raises:
        DataError: the file cannot be read, is of no form that has such boxes, or is faulty.
    """
    path = Path(path)
    form = form_of(path)
    if form is None:
        return [Boxes2D.empty(t, sensor_id=context.sensor_id) for t in context.timestamps_ns.tolist()]
    if form.read_2d is None:
        raise DataError(path, "", f"is of the form {form.name}, which has no boxes in images")
    return form.read_2d(path, context, ledger)


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionFiles:
    """Which files of boxes belong to which sensors of a scene.

    Attributes:
        boxes_3d: of the detector of sweeps; several are put together.
        boxes_2d: of detectors of images.
        lidar: whose boxes they are; None for the only one.
        cameras: whose boxes each file of `boxes_2d` has, in the same order; one for all; empty for the only camera, or
            for those that the records of the files name.
        trajectory, heading: the ego trajectory, as for `fuse`.
        whole: the drive that the scene is a part of, where it is one: lists number its frames.
    """

    boxes_3d: Sequence[Path] = ()
    boxes_2d: Sequence[Path] = ()
    lidar: Identifier | None = None
    cameras: Sequence[Identifier] = ()
    trajectory: str | None = None
    heading: str | None = None
    whole: Scene | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionInput:
    """What of a path is fused or tracked.

    Attributes:
        files: lists of boxes beside a drive.
        detector_2d, detector_3d: which folders of lists, in one laid out like KITTI's tracking benchmark.
        sequences: which of its sequences, empty for all; with lists, the one drive of a data set that they are of.
    """

    files: DetectionFiles = field(default_factory=DetectionFiles)
    detector_2d: str | None = None
    detector_3d: str | None = None
    sequences: Sequence[str] = ()

    @property
    def has_lists(self) -> bool:
        """Whether there are lists of boxes beside a drive."""
        return bool(self.files.boxes_3d or self.files.boxes_2d)

    def tracking_folder(
        self, path: str | Path, *, lenient: bool, reading: Mapping[str, Any] | None
    ) -> KittiTracking | None:
        """The folder laid out like KITTI's tracking benchmark that a path is; None for anything else.

        Raises:
            OptionError: an option does not concern such a path.
        """
        if self.has_lists or not is_tracking_folder(Path(path)):
            for flag, stated in (("--det2d", self.detector_2d), ("--det3d", self.detector_3d)):
                if stated:
                    why = (
                        "the boxes come from the lists of --boxes3d and --boxes2d"
                        if self.has_lists
                        else "it is no folder of KITTI's sequences"
                    )
                    raise OptionError(f"{path}: {flag} {stated} does not count here: {why}")
            return None
        useless = {
            "--lidar": self.files.lidar is not None,
            "--camera": self.files.cameras,
            "--trajectory": self.files.trajectory,
            "--orientation-from": self.files.heading,
        }
        for flag in [flag for flag, stated in useless.items() if stated]:
            raise OptionError(
                f"{path}: {flag} does not count here: it is a folder of KITTI's sequences, whose sensors and "
                "trajectory are known"
            )
        self.refuse_part(path, reading)
        return open_tracking_folder(path, detector_2d=self.detector_2d, detector_3d=self.detector_3d, lenient=lenient)

    @staticmethod
    def refuse_part(path: str | Path, reading: Mapping[str, Any] | None) -> None:
        """Refuse reading options for a part of a drive whose files number frames from the beginning.

        Raises:
            OptionError: there is one.
        """
        if not (reading or {}).keys().isdisjoint(PART):
            raise OptionError(
                f"{path}: its files number frames from the beginning, so that it is done whole; --start and --stop "
                "take a part of drives with lists of boxes beside them, --boxes3d and --boxes2d"
            )

    @contextmanager
    def open_drive(
        self, path: str | Path, *, lenient: bool, reading: Mapping[str, Any] | None
    ) -> Iterator[tuple[DetectedDrive, Scene]]:
        """Open a drive, or the chosen part of it, with its lists of boxes, which are of the whole."""
        if len(self.sequences) > 1:
            raise OptionError(
                f"{path}: --sequence {' --sequence '.join(self.sequences)}: one drive is opened at a time; state one"
            )
        options = {**(reading or {}), **({"lenient": True} if lenient else {})}
        if self.sequences:
            options["sequence"] = self.sequences[0]
        part = {name: options.pop(name) for name in PART if name in options}
        with open_scene(path, **options) as opened:
            scene = opened.corrected()
            files = _with_known_ids(scene, self.files)
            if part:
                scene, files = crop_scene(scene, **part), replace(files, whole=scene)
            yield scene_drive(scene, files, lenient=lenient), scene


def _with_known_ids(scene: Scene, files: DetectionFiles) -> DetectionFiles:
    """The same files, with ids of sensors as the scene has them: `7` may be a number there, but a text here."""

    def known(stated: Identifier) -> Identifier:
        ids = [sensor.id for sensor in scene.sensors]
        return next((found for found in ids if stated not in ids and str(found) == stated), stated)

    lidar = None if files.lidar is None else known(files.lidar)
    return replace(files, lidar=lidar, cameras=tuple(map(known, files.cameras)))


def scene_drive(scene: Scene, files: DetectionFiles, *, lenient: bool = False) -> DetectedDrive:
    """Read the boxes of a scene's detectors; of a part of a drive those of its time.

    Without boxes of sweeps, the sweeps of the lidar are those in which nothing was looked for; without a lidar, the
    images of the first camera take their location.

    Args:
        scene: the drive.
        files: which boxes.
        lenient: leave out what is faulty, and count it.

    Raises:
        OptionError: there are no files, or several sensors and none was chosen, or a chosen one is not there.
        DataError: a file is faulty.
        PoseError: it is not known where a sensor was.
    """
    if not files.boxes_3d and not files.boxes_2d:
        raise OptionError(f"{scene.source}: no boxes; name files of them with --boxes3d, --boxes2d or both")
    scene = scene.corrected()
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        lidar = _chosen(scene, files.lidar)
        ego = None
        if needs_ego(scene):
            ego = find_ego_motion(scene, name=files.trajectory, heading=files.heading, lenient=lenient)
        cameras = _cameras(scene, files, ego, ledger)
        source = sensor_source(scene, lidar, ego, reach_ns=scene_period_ns(scene))
        sweeps = _reference_times(lidar)
        context = ListContext(
            lidar.id,
            sweeps if files.whole is None else _reference_times(_chosen(files.whole, lidar.id)),
            source=source,
            sensor_from_camera=_sensor_from_camera(scene, lidar, ego, files),
        )
        lists = [read_boxes_3d(path, context, ledger) for path in files.boxes_3d]
        boxes = (
            _together(lists, _joined_3d) if lists else [Boxes3D.empty(t, sensor_id=lidar.id) for t in sweeps.tolist()]
        )
        drive = DetectedDrive(
            name=Path(scene.source).stem or "drive",
            lidar_id=lidar.id,
            source=source,
            boxes=tuple(boxes),
            cameras=cameras,
            classes=None if files.boxes_3d else frozenset(),
            period_ns=sweep_period_ns(lidar),
            points=SweepPoints.of(scene, lidar.id, source),
            warnings=(*scene.warnings, *ledger.warnings),
        )
    if files.whole is None or not len(sweeps):
        return drive
    margin_ns = drive.period_ns // 2  # detectors timestamp what they find at any time of a sweep
    return drive.between((int(sweeps[0]) - margin_ns, int(sweeps[-1]) + margin_ns))


def _chosen(scene: Scene, chosen: Identifier | None) -> LidarSensor:
    listed = ", ".join(repr(lidar.id) for lidar in scene.lidars)
    if not listed:
        raise OptionError(f"{scene.source}: it has no lidar, by whose sweeps objects are found")
    if chosen is None and len(scene.lidars) == 1:
        return scene.lidars[0]
    for lidar in scene.lidars:
        if lidar.id == chosen:
            return lidar
    if chosen is not None:
        raise OptionError(f"{scene.source}: lidar {chosen!r}; it has {listed}")
    raise OptionError(f"{scene.source}: it has {listed} as lidars; choose one with `--lidar ID`")


def _reference_times(lidar: LidarSensor) -> Int64Array:
    """The times of each sweep's boxes: the middle of its points, as far after its timestamp as in the first sweep."""
    times = lidar.frames.timestamps_ns
    if not len(times):
        return times
    first = lidar.frames[0]
    return times + (first.reference_ns - first.timestamp_ns)


def _camera(scene: Scene, camera_id: Identifier) -> CameraSensor:
    for camera in scene.cameras:
        if camera.id == camera_id:
            return camera
    listed = ", ".join(repr(camera.id) for camera in scene.cameras) or "none"
    raise OptionError(f"{scene.source}: camera {camera_id!r}; it has {listed}")


def _cameras(
    scene: Scene, files: DetectionFiles, ego: EgoMotion | None, ledger: Ledger
) -> Mapping[Identifier, DetectedCamera]:
    """The cameras that are looked at, with their boxes."""
    if not files.boxes_2d:
        chosen = [_camera(scene, camera_id) for camera_id in files.cameras] or [*scene.cameras]
        return {camera.id: _detected(scene, camera, None, ego) for camera in chosen}
    lists: dict[Identifier, list[Sequence[Boxes2D]]] = {}
    for path, camera, number in _assigned(scene, files):
        whole = camera if files.whole is None else _camera(files.whole, camera.id)
        context = ListContext(camera.id, whole.images.timestamps_ns, number=number, others=_numbers(scene))
        lists.setdefault(camera.id, []).append(read_boxes_2d(path, context, ledger))
    return {
        camera_id: _detected(scene, _camera(scene, camera_id), _together(found, _joined_2d), ego)
        for camera_id, found in lists.items()
    }


def _assigned(scene: Scene, files: DetectionFiles) -> list[tuple[Path, CameraSensor, int | None]]:
    """Each file with the camera whose boxes it has, and the number by which its records name that camera.

    Records number the sensors of a scene as `send` does: lidars first, then cameras, from 0.
    """
    named = [_camera(scene, camera_id) for camera_id in files.cameras]
    if len(named) == len(files.boxes_2d):
        return [(path, camera, None) for path, camera in zip(files.boxes_2d, named, strict=True)]
    if len(named) == 1 or (not named and len(scene.cameras) == 1):
        only = named[0] if named else scene.cameras[0]
        return [(path, only, None) for path in files.boxes_2d]
    if named:
        raise OptionError(
            f"{len(files.boxes_2d)} files of boxes in images and {len(named)} cameras; expected one for each file"
        )
    if not scene.cameras:
        raise OptionError(f"{scene.source}: boxes in images, and no camera in it")
    first = len(scene.lidars)
    return [(path, camera, first + k) for path in files.boxes_2d for k, camera in enumerate(scene.cameras)]


def _numbers(scene: Scene) -> frozenset[int]:
    """How records name the cameras of a scene."""
    first = len(scene.lidars)
    return frozenset(range(first, first + len(scene.cameras)))


def _detected(
    scene: Scene, camera: CameraSensor, boxes: Sequence[Boxes2D] | None, ego: EgoMotion | None
) -> DetectedCamera:
    source = sensor_source(scene, camera, ego, reach_ns=scene_period_ns(scene))
    if boxes is None:
        none = tuple(Boxes2D.empty(t, sensor_id=camera.id) for t in camera.images.timestamps_ns.tolist())
        return DetectedCamera(camera.camera, source, none, frozenset())
    return DetectedCamera(camera.camera, source, tuple(boxes))


def _sensor_from_camera(
    scene: Scene, lidar: LidarSensor, ego: EgoMotion | None, files: DetectionFiles
) -> RigidTransform | None:
    """Takes the frame of the first chosen camera, else of the only one, into the lidar's, at the first sweep."""
    cameras = [_camera(scene, camera_id) for camera_id in files.cameras[:1]] or list(scene.cameras)
    if len(cameras) != 1 or not len(lidar.frames):
        return None
    reach_ns = scene_period_ns(scene)
    time_ns = lidar.frames.timestamps_ns[:1]
    (world_from_camera,) = poses_at(sensor_source(scene, cameras[0], ego, reach_ns=reach_ns), time_ns)
    (world_from_lidar,) = poses_at(sensor_source(scene, lidar, ego, reach_ns=reach_ns), time_ns)
    return world_from_lidar.inverse() @ world_from_camera


_Boxes = TypeVar("_Boxes", Boxes2D, Boxes3D)


def _together(lists: Iterable[Sequence[_Boxes]], join: Callable[[list[_Boxes]], _Boxes]) -> list[_Boxes]:
    """The boxes of several files by time."""
    by_time: dict[int, list[_Boxes]] = {}
    for found in lists:
        for boxes in found:
            by_time.setdefault(boxes.timestamp_ns, []).append(boxes)
    return [same[0] if len(same) == 1 else join(same) for _, same in sorted(by_time.items())]


def _joined_3d(parts: Sequence[Boxes3D]) -> Boxes3D:
    """Boxes of one time put together; what only some of them have is left out."""
    parts = [boxes for boxes in parts if len(boxes)] or parts[:1]
    if len({boxes.score_form for boxes in parts}) > 1:
        raise DataError(
            "boxes", "", f"scores of several forms at {parts[0].timestamp_ns} ns; expected logits or probabilities"
        )
    velocities = [boxes.velocities for boxes in parts if boxes.velocities is not None]
    first = parts[0]
    return Boxes3D(
        first.timestamp_ns,
        np.concatenate([boxes.centers for boxes in parts]),
        np.concatenate([boxes.sizes_lwh for boxes in parts]),
        np.concatenate([boxes.yaws for boxes in parts]),
        np.concatenate([boxes.scores for boxes in parts]),
        tuple(label for boxes in parts for label in boxes.labels),
        velocities=np.concatenate(velocities) if len(velocities) == len(parts) else None,
        frame=first.frame,
        score_form=first.score_form,
        sensor_id=first.sensor_id,
    )


def _joined_2d(parts: Sequence[Boxes2D]) -> Boxes2D:
    """Boxes of one image put together."""
    first = parts[0]
    return Boxes2D(
        first.timestamp_ns,
        np.concatenate([boxes.corners_xyxy for boxes in parts]),
        np.concatenate([boxes.scores for boxes in parts]),
        tuple(label for boxes in parts for label in boxes.labels),
        score_form=first.score_form,
        sensor_id=first.sensor_id,
    )
