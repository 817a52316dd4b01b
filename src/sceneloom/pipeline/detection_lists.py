"""Detection files beside a drive: JSON lines of the standard, KITTI text, nuScenes JSON; and the drive they make.

In this order: a reader for each form; the table of forms; which files and sensors; the drive.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.db34t.json import from_json
from sceneloom.db34t.records import RECORD_KINDS, Box2d, Box3d, Boxes2d, Boxes3d, join_boxes
from sceneloom.db34t.scene_objects import boxes_2d_of, boxes_3d_of
from sceneloom.detections.results import BoxFrame
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
    class_word,
    lidar_boxes,
    read_boxes_2d_list,
    read_boxes_3d_list,
    read_labels,
)
from sceneloom.formats.kitti.tracking_reader import KittiTracking, is_tracking_folder, open_tracking_folder
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion
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
        timestamps_ns: of its sweeps or images, (N,) int64 [ns], ascending; frames are numbered by them.
        number: `sensor_id` of the records that are its own; None for all.
        others: numbers of other known sensors, whose records are skipped without a warning.
        source: `world_from_sensor`, for boxes in the world; None where it is not known.
        sensor_from_camera: takes the rectified camera's frame into the sensor's, for KITTI's boxes in space; None where
            it is not known.
        label: class of all boxes of a list that states none; None for that of its folder's name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    number: int | None = None
    others: frozenset[int] = frozenset()
    source: PoseSource | None = None
    sensor_from_camera: RigidTransform | None = None
    label: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _List:
    """A file of boxes that is being read: boxes in space, else in images."""

    path: Path
    context: ListContext
    ledger: Ledger
    in_space: bool

    def empty(self, time_ns: int) -> Any:
        """The boxes of a frame in which nothing was found."""
        return (Boxes3D if self.in_space else Boxes2D).empty(time_ns, sensor_id=self.context.sensor_id)

    def fault(self, location: str, problem: str) -> DataError:
        return DataError(self.path, location, problem)


_JSON_RECORDS: Mapping[bool, tuple[Any, Any, Callable[..., Any]]] = {
    True: (Boxes3d, Box3d, boxes_3d_of),
    False: (Boxes2d, Box2d, boxes_2d_of),
}  # of boxes in space and in images: the record of a frame, that of one box, and what converts the former


def _read_json_lines(file: _List) -> Iterable[Any]:
    boxes_of = _JSON_RECORDS[file.in_space][2]
    lists = [replace(boxes_of(record, sensor_id=file.context.sensor_id), ids=None) for record in _records(file)]
    # a detector that writes bare boxes cannot state that it found nothing in a frame
    if lists:
        known, times = {boxes.timestamp_ns for boxes in lists}, file.context.timestamps_ns
        missing = [t for t in times.tolist() if min(known) <= t <= max(known) and t not in known]
        half_step_ns = int(np.diff(times).min()) // 2 if len(times) > 1 else 0
        lists += [file.empty(t) for t in missing if min(abs(t - one) for one in known) > half_step_ns]
    return lists


def _records(file: _List) -> Iterator[Any]:
    """The frames' records of boxes in a file; bare boxes of one frame are put together, wherever they stand."""
    several, single, _ = _JSON_RECORDS[file.in_space]
    lone: list[Any] = []
    others = 0
    for number, line in read_lines(file.path):
        try:
            record = _parse_record(line)
            if not isinstance(record, several | single):
                problem = f"a {type(record).__name__}; expected {several.__name__} or {single.__name__}"
                raise DataError("record", "", problem)  # noqa: TRY301 - its location is added below, as to all of them
        except DataError as error:
            location = ": ".join(filter(None, (f"line {number}", error.location)))
            file.ledger.fault("faulty-detections", file.fault(location, error.problem))
            continue
        if isinstance(record, single):
            lone.append(record)
        elif file.context.number is None or record.sensor_id == file.context.number:
            yield record
        elif record.sensor_id not in file.context.others:
            others += 1
    if others:
        message = "lists whose sensor_id is that of no sensor here"
        file.ledger.note(WarningKind.SKIPPED, "other-sensors", str(file.path), message, count=others)

    def frame_of(box: Box3d | Box2d) -> tuple[Any, int]:
        return box.timestamp, box.points_seq if isinstance(box, Box3d) else box.image_seq

    lone.sort(key=frame_of)  # stable: within a frame, the order of the file
    for _, same in groupby(lone, key=frame_of):
        yield join_boxes([box.alone(file.context.number or 0) for box in same])


def _parse_record(line: str) -> Any:
    """The record of a line: under the name of its kind, or bare."""
    try:
        content = msgspec.json.decode(line)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise DataError("record", "", f"no JSON: {error}") from error
    if not isinstance(content, Mapping):
        raise DataError("record", "", "no JSON object; expected a record of boxes")
    if len(content) == 1 and (name := next(iter(content))) in RECORD_KINDS:
        return from_json(name, content[name])
    if "boxes" in content:
        inner = content["boxes"]
        space = isinstance(inner, list) and any(
            isinstance(box, Mapping) and ("X" in box or "x" in box) for box in inner
        )
        return from_json("boxes_3d" if space else "boxes_2d", content)
    space = any(name in content for name in ("X", "x", "points_seq"))
    return from_json("box_3d" if space else "box_2d", content)


def _read_kitti_lists(file: _List) -> Iterable[Any]:
    label = file.context.label
    if not label and (not file.in_space or file.path.parent.name in TYPES.values()):
        label = class_word(file.path.resolve().parent.name)
    if not file.in_space:
        found = read_boxes_2d_list(file.path, label, file.ledger)
        scores, corners_xyxy = found.values[:, 5], found.values[:, 1:5] + CENTRE_TO_CORNER
        return _kitti_boxes(file, found.frames, found.labels, scores, ScoreForm.PROBABILITY, corners_xyxy)
    found = read_boxes_3d_list(file.path, label, file.ledger)
    values = found.values
    placed = _from_camera(file, values[:, 7:10], values[:, 10:13], values[:, 13])
    return _kitti_boxes(file, found.frames, found.labels, values[:, 6], ScoreForm.LOGIT, *placed)


def _read_kitti_results(file: _List) -> Iterable[Any]:
    """Labels or results; without scores they are certain, and scores beyond 0 to 1 are logits."""
    results = read_labels(file.path)
    results = results.select(np.array([word != DONT_CARE for word in results.types], np.bool_))
    columns: tuple[Float64Array, ...]
    if file.in_space:
        results = results.select(results.have_position)
        columns = _from_camera(file, results.sizes_hwl, results.bottoms, results.rotations_y)
    else:
        columns = (results.corners_xyxy + CENTRE_TO_CORNER,)
    scores = np.ones(len(results)) if results.scores is None else results.scores
    return _kitti_boxes(file, results.frames, results.types, scores, _score_form(scores), *columns)


def _from_camera(
    file: _List, sizes_hwl: Float64Array, bottoms: Float64Array, rotations_y: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Centres, sizes and yaws in the sensor's frame of boxes in the camera's frame."""
    sensor_from_camera = file.context.sensor_from_camera
    if sensor_from_camera is None:
        if len(bottoms):
            raise file.fault(
                "", "its boxes are in the camera's frame, and no camera is known; expected one, or `--camera ID`"
            )
        sensor_from_camera = RigidTransform.identity()
    message = "its boxes are taken to be in the frame of the camera that was chosen"
    file.ledger.note(WarningKind.ASSUMED, "boxes-in-camera-frame", str(file.path), message)
    return lidar_boxes(sizes_hwl, bottoms, rotations_y, sensor_from_camera.inverse())


def _kitti_boxes(
    file: _List,
    frames: Int64Array,
    labels: Sequence[str],
    scores: Float64Array,
    score_form: ScoreForm,
    *columns: Float64Array,
) -> list[Any]:
    """The boxes of each frame of the sensor in the order of the file; `columns` begin those of the result."""
    times = file.context.timestamps_ns.tolist()
    for frame in (int(frames.min()), int(frames.max())) if len(frames) else ():
        if not 0 <= frame < len(times):
            known = f"0 to {len(times) - 1}, as sensor {file.context.sensor_id!r} has them"
            raise file.fault("", f"frame {frame}; expected {known}")
    found, kind = [], cast("Any", Boxes3D if file.in_space else Boxes2D)
    for number, time_ns in enumerate(times):
        rows = np.flatnonzero(frames == number)
        found.append(
            kind(
                time_ns,
                *(column[rows] for column in (*columns, scores)),
                tuple(labels[row] for row in rows.tolist()),
                score_form=score_form,
                sensor_id=file.context.sensor_id,
            )
        )
    return found


def _score_form(scores: Float64Array) -> ScoreForm:
    within = len(scores) == 0 or (scores.min() >= 0.0 and scores.max() <= 1.0)
    return ScoreForm.PROBABILITY if within else ScoreForm.LOGIT


def _read_nuscenes(file: _List) -> Iterable[Boxes3D]:
    """Read boxes in space, and bring them into the sensor's frame."""
    # Source: "Detection: results format" of the nuScenes devkit: translation [m] x, y, z; size [m] width, length,
    # height; rotation w, x, y, z; velocity [m/s] x, y; all in the global frame
    source = file.context.source
    if not file.in_space:
        raise file.fault("", "is of the form nuscenes, which has no boxes in images")
    if source is None:
        raise file.fault("", "its boxes are in the world, and it is not known where the lidar was")
    try:
        content = msgspec.json.decode(read_bytes(file.path))
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise file.fault("", f"no JSON: {error}") from error
    results = content.get("results") if isinstance(content, Mapping) else None
    if not isinstance(results, Mapping):
        raise file.fault("results", "expected an object: by token of a sample its boxes")
    for token, boxes in results.items():
        if not isinstance(boxes, list):
            raise file.fault(f"results.{token}", f"{str(boxes)[:40]}; expected a list of boxes")
    times, lists = _sample_times(file, results), []
    for token, boxes in results.items():
        if token not in times:
            message = "samples that are not of this drive"
            file.ledger.note(WarningKind.SKIPPED, "other-samples", f"{file.path}: results.{token}", message)
            continue
        rows = []
        for k, box in enumerate(boxes):
            try:
                rows.append(_nuscenes_row(file, f"results.{token}[{k}]", box))
            except DataError as error:
                file.ledger.fault("faulty-detections", error)
        values = np.array([row for row, _ in rows], np.float64).reshape(len(rows), 11)
        center, size, yaw, velocity, score = (part.copy() for part in np.split(values, (3, 6, 7, 10), axis=1))
        placed = Boxes3D(
            times[token],
            center,
            size,
            yaw[:, 0],
            score[:, 0],
            tuple(label for _, label in rows),
            velocities=velocity,
            frame=PointsFrame.WORLD,
            score_form=_score_form(score),
            sensor_id=file.context.sensor_id,
        )
        (world_from_sensor,) = poses_at(source, np.array([times[token]], np.int64))
        lists.append(placed.moved(world_from_sensor.inverse(), PointsFrame.SENSOR))
    return lists


def _sample_times(file: _List, results: Mapping[str, Any]) -> dict[str, int]:
    """The time of each sample of the drive [ns]: of the table `sample.json`, or of tokens that are times themselves."""
    if all(token.isascii() and token.isdigit() for token in results):
        times = {token: int(token) * 1000 for token in results}
    else:
        beside = (file.path.parent / "sample.json", file.path.parent.parent / "sample.json")
        table = next((path for path in beside if path.is_file()), None)
        if table is None:
            table_needed = "put nuScenes' table sample.json (token, timestamp) beside it"
            raise file.fault("", f"the times of its samples are not known; {table_needed}")
        try:
            rows = msgspec.json.decode(read_bytes(table))
            times = {row["token"]: int(row["timestamp"]) * 1000 for row in rows}
        except (msgspec.DecodeError, RecursionError, TypeError, KeyError, ValueError) as error:
            raise DataError(table, "", f"{error}; expected a list of objects with token and timestamp [µs]") from error
    own = file.context.timestamps_ns
    if not len(own):
        return {}
    first, last = int(own[0]) - 10**9, int(own[-1]) + 10**9
    return {token: t for token, t in times.items() if token in results and first <= t <= last}


def _nuscenes_row(file: _List, location: str, box: Any) -> tuple[list[float], str]:
    """Centre, length, width, height, yaw, velocity and score of a box, (11,), and its class."""
    if not isinstance(box, Mapping):
        raise file.fault(location, f"{str(box)[:40]}; expected an object")
    numbers: dict[str, list[float]] = {}
    for name, count in (("translation", 3), ("size", 3), ("rotation", 4)):
        value = box.get(name)
        sound = isinstance(value, list) and len(value) == count
        if not sound or not all(isinstance(one, int | float) and abs(one) < 1e9 for one in value or ()):
            raise file.fault(f"{location}.{name}", f"{str(value)[:60]}; expected {count} finite numbers")
        numbers[name] = list(map(float, value or ()))
    width, length, height = numbers["size"]
    w, x, y, z = numbers["rotation"]
    if min(numbers["size"]) <= 0:
        raise file.fault(f"{location}.size", f"{numbers['size']}; expected sizes above 0")
    if not 0.99 < float(np.linalg.norm([w, x, y, z])) < 1.01:
        raise file.fault(f"{location}.rotation", f"{[w, x, y, z]}; expected w, x, y, z of length 1")
    heading = matrix_from_quaternion([x, y, z, w])[:, 0]
    velocity = box.get("velocity") or [0.0, 0.0]  # NaN or null where it is not known
    known = [0.0 if one is None else one for one in velocity[:2]] if isinstance(velocity, list) else []
    if len(known) < 2 or not all(isinstance(one, int | float) for one in known):
        raise file.fault(f"{location}.velocity", f"{str(velocity)[:60]}; expected two numbers")
    velocity_xy = np.nan_to_num(np.array(known, np.float64))
    label, score = box.get("detection_name"), box.get("detection_score")
    if not isinstance(label, str) or not label:
        raise file.fault(f"{location}.detection_name", f"{label!r}; expected the name of a class")
    if isinstance(score, bool) or not isinstance(score, int | float) or not np.isfinite(score):
        raise file.fault(f"{location}.detection_score", f"{score!r}; expected a finite number")
    yaw = float(np.arctan2(heading[1], heading[0]))
    return [*numbers["translation"], length, width, height, yaw, *velocity_xy.tolist(), 0.0, score], label


def _first_words(head: str, separator: str | None) -> list[str]:
    return head.split("\n", 1)[0].split(separator)


@dataclass(frozen=True, slots=True)
class _ListForm:
    """One form of lists: what it looks like, the frame of its boxes in space, what recognises and what reads it."""

    name: str
    looks_like: str
    frame: BoxFrame
    recognises: Callable[[str], bool]
    read: Callable[[_List], Iterable[Any]]


_FORMS: tuple[_ListForm, ...] = (
    _ListForm(
        "json-lines",
        "lines of JSON, each a record of table 7 or 8 of DB34/T 4101, or a frame's list of them",
        BoxFrame.LIDAR,
        lambda head: head.startswith("{") and '"results"' not in head[:20_000].split("[", 1)[0],
        _read_json_lines,
    ),
    _ListForm(
        "nuscenes",
        'a JSON object with "results" by sample, as nuScenes has detections',
        BoxFrame.WORLD,
        lambda head: head.startswith("{") and '"results"' in head,
        _read_nuscenes,
    ),
    _ListForm(
        "kitti-lists",
        "lines of 6 or 15 numbers with commas, a frame's number first",
        BoxFrame.CAMERA,
        lambda head: (
            len(words := _first_words(head, ",")) in {len(COLUMNS_2D), len(COLUMNS_3D)}
            and words[0].strip().lstrip("-").isdigit()
        ),
        _read_kitti_lists,
    ),
    _ListForm(
        "kitti-results",
        "KITTI's text of labels or results, 15 to 18 words a line",
        BoxFrame.CAMERA,
        lambda head: (
            len(words := _first_words(head, None)) in {15, 16, 17, 18} and any(word[:1].isalpha() for word in words[:3])
        ),
        _read_kitti_results,
    ),
)  # all forms; at most one of them recognises a file
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
        context: what the file does not state itself.
        ledger: collects assumptions, and in a lenient reading faults.

    Raises:
        DataError: the file cannot be read, is of no form that has such boxes, or is faulty.
        UnknownFormatError: no form recognises it.
    """
    return _read_boxes(_List(Path(path), context, ledger, in_space=True))


def read_boxes_2d(path: Path | str, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    """Read the boxes of a camera's detector, by image, in the order of time; as `read_boxes_3d`."""
    return _read_boxes(_List(Path(path), context, ledger, in_space=False))


def _read_boxes(file: _List) -> list[Any]:
    form = form_of(file.path)
    if form is None:
        return list(map(file.empty, file.context.timestamps_ns.tolist()))
    return sorted(form.read(file), key=lambda boxes: boxes.timestamp_ns)


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
                    lists = "the boxes come from the lists of --boxes3d and --boxes2d"
                    why = lists if self.has_lists else "it is no folder of KITTI's sequences"
                    raise OptionError(f"{path}: {flag} {stated} does not count here: {why}")
            return None
        files = self.files
        useless: tuple[tuple[str, object], ...] = (
            ("--lidar", files.lidar is not None),
            ("--camera", files.cameras),
            ("--trajectory", files.trajectory),
            ("--orientation-from", files.heading),
        )
        for flag, is_stated in useless:
            if is_stated:
                why = "it is a folder of KITTI's sequences, whose sensors and trajectory are known"
                raise OptionError(f"{path}: {flag} does not count here: {why}")
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
                f"{path}: --sequence {' --sequence '.join(self.sequences)}: one drive is opened at a time; give one"
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
    images of the first camera take their place.

    Args:
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
        lidar = _chosen_lidar(scene, files.lidar)
        ego = None
        if needs_ego(scene):
            ego = find_ego_motion(scene, name=files.trajectory, heading=files.heading, lenient=lenient)
        cameras = _cameras(scene, files, ego, ledger)
        source = sensor_source(scene, lidar, ego, reach_ns=scene_period_ns(scene))
        sweeps = _reference_times(lidar)
        context = ListContext(
            lidar.id,
            sweeps if files.whole is None else _reference_times(_chosen_lidar(files.whole, lidar.id)),
            source=source,
            sensor_from_camera=_sensor_from_camera(scene, lidar, ego, files),
        )
        lists = [read_boxes_3d(path, context, ledger) for path in files.boxes_3d]
        drive = DetectedDrive(
            name=Path(scene.source).stem or "drive",
            lidar_id=lidar.id,
            source=source,
            boxes=tuple(_joined(lists) if lists else (Boxes3D.empty(t, sensor_id=lidar.id) for t in sweeps.tolist())),
            cameras=cameras,
            classes=None if files.boxes_3d else frozenset(),
            period_ns=sweep_period_ns(lidar),
            stated_in=frozenset(form.frame for path in files.boxes_3d if (form := form_of(path)) is not None),
            points=SweepPoints.of(scene, lidar.id, source),
            warnings=(*scene.warnings, *ledger.warnings),
        )
    if files.whole is None or not len(sweeps):
        return drive
    margin_ns = drive.period_ns // 2  # detectors timestamp what they find at any time of a sweep
    return drive.between((int(sweeps[0]) - margin_ns, int(sweeps[-1]) + margin_ns))


def _chosen_lidar(scene: Scene, chosen: Identifier | None) -> LidarSensor:
    listed = ", ".join(repr(lidar.id) for lidar in scene.lidars)
    if not listed:
        raise OptionError(f"{scene.source}: it has no lidar, by whose sweeps objects are found")
    found = [lidar for lidar in scene.lidars if chosen is None or lidar.id == chosen]
    if not found:
        raise OptionError(f"{scene.source}: lidar {chosen!r}; it has {listed}")
    if chosen is None and len(found) > 1:
        raise OptionError(f"{scene.source}: it has {listed} as lidars; choose one with `--lidar ID`")
    return found[0]


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
    reach_ns = scene_period_ns(scene)
    detected: dict[Identifier, DetectedCamera] = {}
    if not files.boxes_2d:
        for camera in [_camera(scene, camera_id) for camera_id in files.cameras] or scene.cameras:
            source = sensor_source(scene, camera, ego, reach_ns=reach_ns)
            none = tuple(Boxes2D.empty(t, sensor_id=camera.id) for t in camera.images.timestamps_ns.tolist())
            detected[camera.id] = DetectedCamera(camera.camera, source, none, frozenset())
        return detected
    lists: dict[Identifier, list[Sequence[Boxes2D]]] = {}
    first = len(scene.lidars)
    numbers = frozenset(range(first, first + len(scene.cameras)))
    for path, camera, number in _assigned(scene, files):
        whole = camera if files.whole is None else _camera(files.whole, camera.id)
        context = ListContext(camera.id, whole.images.timestamps_ns, number=number, others=numbers)
        lists.setdefault(camera.id, []).append(read_boxes_2d(path, context, ledger))
    for camera_id, found in lists.items():
        camera = _camera(scene, camera_id)
        source = sensor_source(scene, camera, ego, reach_ns=reach_ns)
        detected[camera_id] = DetectedCamera(camera.camera, source, tuple(_joined(found)))
    return detected


def _assigned(scene: Scene, files: DetectionFiles) -> list[tuple[Path, CameraSensor, int | None]]:
    """Each file with its camera and the number of that in records, by which `send` counts: lidars first, from 0."""
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


def _joined(lists: Iterable[Sequence[Any]]) -> list[Any]:
    """The boxes of several files by time; of the fields of one time's boxes those that all of them have."""
    by_time: dict[int, list[Any]] = {}
    for found in lists:
        for boxes in found:
            by_time.setdefault(boxes.timestamp_ns, []).append(boxes)
    joined = []
    for time_ns, same in sorted(by_time.items()):
        parts = [boxes for boxes in same if len(boxes)] or same[:1]
        if len({boxes.score_form for boxes in parts}) > 1:
            raise DataError("boxes", "", f"scores of several forms at {time_ns} ns; expected logits or probabilities")
        columns: dict[str, Any] = {"labels": tuple(label for boxes in parts for label in boxes.labels)}
        for one in fields(parts[0]):
            values = [getattr(boxes, one.name) for boxes in parts]
            arrays = [value for value in values if isinstance(value, np.ndarray)]
            if arrays:
                columns[one.name] = np.concatenate(arrays) if len(arrays) == len(values) else None
        joined.append(parts[0] if len(parts) == 1 else replace(parts[0], **columns))
    return joined
