"""Objects of whole sequences from files: KITTI labels, detection lists, fused objects and cuboids of scenes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.db34t.json import parse_json
from sceneloom.db34t.records import FusedDetections
from sceneloom.errors import ArrayError, DataError, OptionError
from sceneloom.evaluate.objects import ObjectTable, Similarity
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, open_file
from sceneloom.formats.base.registry import open_scenes
from sceneloom.formats.base.text_tables import read_lines
from sceneloom.formats.kitti.calibration import read_calibration
from sceneloom.formats.kitti.labels import (
    CENTRE_TO_CORNER,
    DetectionList,
    KittiLabels,
    lidar_boxes,
    read_boxes_2d_list,
    read_boxes_3d_list,
    read_labels,
)
from sceneloom.formats.kitti.text import sequences_called
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.annotations import AttributePath, CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame, cuboid_poses, not_in_world
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Coordinates, SensorType
from sceneloom.warnings import DataWarning, WarningKind


def fused_files(path: Path) -> list[Path]:
    """The files of lines of table 10 of DB34/T 4101 that a path has (itself, or in a folder), by their beginning."""
    files = sorted(path.glob("*.jsonl")) if path.is_dir() else [path] if path.suffix == ".jsonl" else []
    return [file for file in files if _begins_with_detections(file)]


def _begins_with_detections(file: Path) -> bool:
    with file_faults(file), open_file(file) as stream:
        return stream.read(64).lstrip().startswith(b'{"detections"')


def _fused_objects_read_fused(path: Path) -> ObjectTable:
    """Read lines of table 10, as `sceneloom fuse --type detection` writes them; the number of a cloud is its frame.

    Raises:
        DataError: the file cannot be read, a line is no such record, or a cloud comes twice.
    """
    tables: dict[int, ObjectTable] = {}
    for number, line in read_lines(path):
        try:
            record = parse_json(line)
        except DataError as error:
            raise DataError(path, f"line {number}", f"{error.location or 'record'}: {error.problem}") from error
        if not isinstance(record, FusedDetections):
            raise DataError(path, f"line {number}", "is no record of fused detections (table 10)")
        if record.points_seq in tables:
            problem = f"cloud {record.points_seq} comes twice; expected the objects of one camera"
            raise DataError(path, f"line {number}", problem)
        tables[record.points_seq] = _table_of_record(record)
    return ObjectTable.joined(list(tables.values()))


def _table_of_record(record: FusedDetections) -> ObjectTable:
    count = len(record.class_names)
    covariances = np.zeros((count, 7, 7))
    covariances[:, :3, :3], covariances[:, 3:6, 3:6] = record.center_covs, record.size_covs
    yaws = np.arctan2(record.directions[:, 1], record.directions[:, 0])
    columns = [record.centers, record.sizes_lwh, yaws]
    return ObjectTable(
        np.full(count, record.points_seq, np.int64),
        np.full(count, -1, np.int64),
        record.class_names,
        record.corners_xyxy.astype(np.float64) - CENTRE_TO_CORNER,
        np.column_stack(columns).astype(np.float64),
        scores=record.confidence.astype(np.float64),
        covariances=covariances,
    )


def _truth_in_lidar(labels: KittiLabels, calibration: Path) -> Float64Array:
    """Give the boxes of labels in the lidar's frame, (N, 7) as of `ObjectTable.boxes`.

    Raises:
        DataError: the calibration is missing or faulty.
    """
    rectified_from_lidar = read_calibration(calibration).rectified_from_lidar
    placed = lidar_boxes(labels.sizes_hwl, labels.bottoms, labels.rotations_y, rectified_from_lidar)
    return np.column_stack(placed)


_SCORES = ("existence", "score", "confidence")
"""Attributes of cuboids that state how sure they are; the first one that a cuboid has counts."""

_NO_LABEL = "object"
"""The class of cuboids that name none."""


def labelled_times(scene: Scene) -> Int64Array:
    """Times at which objects of a scene are compared: of its first lidar's frames, else the timestamps of its cuboids.

    Returns:
        (F,) int64 [ns], rising.
    """
    for sensor in scene.sensors:
        if sensor.type == SensorType.LIDAR and len(frame_times(sensor)):
            return np.unique(frame_times(sensor))
    timestamps = [cuboid.path.timestamps_ns for cuboid in _cuboids(scene)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *timestamps]))


def scene_objects(scene: Scene, times_ns: Int64Array) -> ObjectTable:
    """Give the cuboids of a scene at times (F,) [ns], which become its frames; boxes are in the scene's world.

    A cuboid is there from its first timestamp to its last, a stationary one always.

    Raises:
        OptionError: the scene has no cuboids, or they are not in the world.
    """
    cuboids = _cuboids(scene)
    if not cuboids:
        raise OptionError(f"{scene.source}: no cuboids; expected a scene with objects as boxes in space")
    if annotations_frame(scene) is not Coordinates.WORLD:
        raise not_in_world(scene.source)
    angles = CuboidAngles.of(scene)
    held = [_held_scores(cuboid) for cuboid in cuboids]
    tables = [_rows(cuboid, k, times_ns, angles, held[k]) for k, cuboid in enumerate(cuboids)]
    joined = ObjectTable.joined(tables).in_order()
    return joined if any(score is not None for score in held) else replace(joined, scores=None)


def _cuboids(scene: Scene) -> list[CuboidAnnotation]:
    return [annotation for annotation in scene.annotations if isinstance(annotation, CuboidAnnotation)]


def _rows(
    cuboid: CuboidAnnotation,
    number: int,
    times_ns: Int64Array,
    angles: CuboidAngles,
    held: AttributePath | None,
) -> ObjectTable:
    poses = cuboid_poses(cuboid, times_ns, angles=angles)
    frames = np.flatnonzero(poses.there).astype(np.int64)
    ahead = rotate_vectors(poses.quaternions_xyzw[frames], np.array([1.0, 0.0, 0.0]))
    boxes = (poses.centers_world[frames], poses.sizes_lwh[frames], np.arctan2(ahead[:, 1], ahead[:, 0]))
    return ObjectTable(
        frames,
        np.full(len(frames), number, np.int64),
        (cuboid.label or _NO_LABEL,) * len(frames),
        boxes=np.column_stack(boxes).astype(np.float64),
        scores=_scores(held, times_ns[frames]),
    )


def _held_scores(cuboid: CuboidAnnotation) -> AttributePath | None:
    """The attribute that says how sure a cuboid is, if its values are numbers."""
    for name in _SCORES:
        for attribute in cuboid.attributes:
            numbers = all(isinstance(value, int | float) for value in attribute.values)
            if attribute.name == name and attribute.values and numbers:
                return attribute
    return None


def _scores(held: AttributePath | None, times_ns: Int64Array) -> Float64Array:
    """How sure a cuboid is at times (M,) [ns]: a value holds until the next; 1 of cuboids that state nothing."""
    if held is None:
        return np.ones(len(times_ns))
    values = np.asarray(held.values, np.float64)
    if not held.is_timed or held.timestamps_ns is None:
        return np.full(len(times_ns), values[0])
    rows = np.searchsorted(held.timestamps_ns, times_ns, side="right") - 1
    return values[np.clip(rows, 0, len(values) - 1)]


_LABEL_FOLDERS = ("label_02", "label_2", "data")
"""Folders inside a given one in which KITTI and those who evaluate by its rules keep labels and results."""

_OBJECTS = "objects"
"""The name of the only sequence where each file is a frame, and of that of two scenes."""

_ObjectSequences = Mapping[str, ObjectTable]
"""Tables by name of the sequence."""


class _Kind(StrEnum):
    """What a path holds."""

    SEQUENCES = "a KITTI file for each sequence"
    FRAMES = "a KITTI file for each frame"
    LISTS = "a folder of lists of detections for each class"
    FUSED = "lines of fused detections"
    EMPTY = "empty files"
    SCENE = "taken for a scene"


@dataclass(frozen=True, slots=True)
class BothSides:
    """Results and truth of the same sequences.

    Attributes:
        results, truth: by name of the sequence.
        similarities: those in which both sides can be compared.
        from_scenes: whether they are cuboids of scenes, whose classes are anybody's.
        warnings: what is to be known about them.
    """

    results: _ObjectSequences
    truth: _ObjectSequences
    similarities: tuple[Similarity, ...]
    from_scenes: bool
    warnings: tuple[DataWarning, ...] = ()


def read_both(
    results: Path | str,
    truth: Path | str,
    *,
    sequences: Sequence[str] = (),
    lenient: bool = False,
    corrections: str = "apply",
) -> BothSides:
    """Read what is to be evaluated and what is true.

    Each is a file or folder of KITTI's text (a file for each sequence of the tracking benchmark, or for each frame of
    the object benchmark; the folder that holds `label_02` or `label_2` will do), or a scene with cuboids. Results may
    also be lists of detections, `CLASS/SEQUENCE.txt`, or lines of fused ones, `SEQUENCE.jsonl`, which are compared
    in the lidar's frame: the truth's folder has `calib` beside `label_02` then.

    Args:
        results, truth: where they are.
        sequences: those to take, leading zeros need not be stated; of scenes the one of a data set. [default: all of
            the truth]
        lenient: skip faulty lines of lists, and open damaged drives.
        corrections: "apply" or "ignore", as of `open_scene`; of scenes only.

    Raises:
        DataError: a file is missing or holds something wrong, or one side lacks a sequence.
        OptionError: one side is a scene and the other one is not, or a sequence that was asked for is not there.
    """
    ledger = Ledger(lenient=lenient)
    kinds = [_kind_of(path) for path in (results, truth)]
    if _Kind.SCENE in kinds:
        if kinds != [_Kind.SCENE, _Kind.SCENE]:
            raise OptionError(
                f"{results} is {kinds[0]}, {truth} is {kinds[1]}; expected two scenes, or KITTI's text on both sides: "
                "`sceneloom convert SCENE OUT --to kitti-tracking` writes a scene's boxes as such text, in "
                "OUT/training/label_02"
            )
        sides, sequences = _read_scenes(results, truth, sequences, ledger, corrections), ()
    else:
        sequences = _as_named(Path(truth), sequences)
        sides = _read_texts(Path(results), Path(truth), kinds, frozenset(sequences), ledger)
    _check_names(*sides, sequences, (results, truth))
    found, true = ({name: side[name] for name in sequences or sorted(sides[1])} for side in sides)
    _note_frames(found, true, ledger)
    if _same_location(results, truth):
        ledger.note(WarningKind.ASSUMED, "truth-against-itself", str(results), "results and truth are the same files")
    return BothSides(found, true, _comparable(found, true), _Kind.SCENE in kinds, ledger.warnings)


def classes_of(sides: BothSides, usual: Sequence[str]) -> tuple[str, ...]:
    """Of KITTI's text the usual classes that occur in the truth; of scenes, or where none of them does, all that do."""
    there = {label.lower() for table in sides.truth.values() for label in table.labels} - {"dontcare"}
    known = () if sides.from_scenes else tuple(label for label in usual if label in there)
    return known or tuple(sorted(there))


def check_classes(sides: BothSides, classes: Sequence[str]) -> None:
    """Refuse a class that occurs on neither side, whose figures would all be 0.

    Raises:
        OptionError: there is one.
    """
    tables = [*sides.results.values(), *sides.truth.values()]
    there = {label.lower() for table in tables for label in table.labels}
    for label in classes:
        if label.lower() not in there:
            reported = ", ".join(sorted(there)) or "none"
            raise OptionError(f"class {label!r} occurs neither in the results nor in the truth, which have {reported}")


def check_similarity(sides: BothSides, similarity: Similarity) -> None:
    """Refuse a similarity for which one side has no boxes.

    Raises:
        OptionError: it has none.
    """
    if similarity not in sides.similarities:
        reported = ", ".join(sides.similarities) or "nothing: results and truth have no boxes in common"
        raise OptionError(f"similarity {similarity.value!r}: one side has no such boxes; comparable: {reported}")


def _kind_of(path: Path | str) -> _Kind:
    if not isinstance(path, Path):
        return _Kind.SCENE
    if not path.exists():
        raise DataError(path, "", "no such file or folder")
    folder = _folder_of(path)
    if fused_files(path):
        return _Kind.FUSED
    if not folder.is_dir():
        return _kind_of_files([path]) if path.suffix.lower() == ".txt" else _Kind.SCENE
    files = sorted(folder.glob("*.txt"))
    if any(file.stem.isdigit() for file in files):
        return _kind_of_files(files)
    if any(file.stem.isdigit() for file in folder.glob("*/*.txt")):
        return _Kind.LISTS
    return _Kind.SCENE


def _kind_of_files(files: Iterable[Path]) -> _Kind:
    """Report files of frames, whose lines begin with a class, from those of sequences by the first line of all."""
    for file in files:
        with file_faults(file), open_file(file) as stream:
            word = next((line.split()[0] for line in stream if line.strip()), None)
        if word is not None:
            return _Kind.FRAMES if word[:1].isalpha() else _Kind.SEQUENCES
    return _Kind.EMPTY


def _folder_of(path: Path) -> Path:
    """The folder that holds the files, for the one that holds it."""
    inner = [path / name for name in _LABEL_FOLDERS if (path / name).is_dir()]
    return inner[0] if inner else path


def _read_scenes(
    results: Path | str, truth: Path | str, sequences: Sequence[str], ledger: Ledger, corrections: str
) -> tuple[_ObjectSequences, _ObjectSequences]:
    if len(sequences) > 1:
        raise OptionError(f"sequences {', '.join(sequences)}: two scenes are compared; state one sequence")
    chosen = {"sequence": sequences[0]} if sequences else {}
    with open_scenes((results, truth), {"lenient": ledger.lenient, "corrections": corrections, **chosen}) as opened:
        found, true = (scene.corrected() for scene in opened)
        for scene in (found, true):
            for warning in scene.correction_warnings:
                ledger.note(warning.kind, warning.code, f"{scene.source}: {warning.location}", warning.message)
        times_ns = labelled_times(true)
        return {_OBJECTS: scene_objects(found, times_ns)}, {_OBJECTS: scene_objects(true, times_ns)}


def _read_texts(
    results: Path, truth: Path, kinds: list[_Kind], wanted: frozenset[str], ledger: Ledger
) -> tuple[_ObjectSequences, _ObjectSequences]:
    reported = [kind for kind in kinds if kind in (_Kind.SEQUENCES, _Kind.FRAMES)]
    if len(set(reported)) > 1:
        raise OptionError(f"{results} is {kinds[0]}, {truth} is {kinds[1]}; expected the same on both sides")
    by_frame = reported[:1] == [_Kind.FRAMES]
    if kinds[1] in (_Kind.LISTS, _Kind.FUSED):
        raise OptionError(f"{truth} is {kinds[1]}, which has no truth; expected KITTI's labels")
    readers = {
        _Kind.LISTS: lambda path: _read_lists(path, wanted, ledger),
        _Kind.FUSED: lambda path: _read_fused(path, wanted),
    }
    in_lidar = kinds[0] is _Kind.FUSED
    true = _read_labels(truth, wanted, by_frame=by_frame, in_lidar=in_lidar)
    found = readers.get(kinds[0], lambda path: _read_labels(path, wanted, by_frame=by_frame))(results)
    sides = [found, true]
    if all(path.is_file() for path in (results, truth)):
        # two files are meant to be compared, whatever their names
        sides = [dict(zip(sides[1], side.values(), strict=True)) for side in sides]
    return sides[0], sides[1]


def _files_of(path: Path, wanted: frozenset[str]) -> list[Path]:
    if path.is_file():
        return [path]
    files = [file for file in sorted(_folder_of(path).glob("*.txt")) if file.stem.isdigit()]
    return [file for file in files if file.stem in wanted] if wanted else files


def _as_named(truth: Path, sequences: Sequence[str]) -> tuple[str, ...]:
    """Name sequences as the truth's files do, each once: leading zeros need not be stated."""
    names = [file.stem for file in _files_of(truth, frozenset())]
    return tuple(dict.fromkeys((sequences_called(names, name) or [name])[-1] for name in sequences))


def _read_labels(
    path: Path, wanted: frozenset[str], *, by_frame: bool, in_lidar: bool = False
) -> dict[str, ObjectTable]:
    if in_lidar:
        return {file.stem: _table_in_lidar(file) for file in _files_of(path, wanted)}
    if by_frame:
        tables = [_table(read_labels(file), file) for file in _files_of(path, frozenset())]
        return {_OBJECTS: ObjectTable.joined(tables)}
    return {file.stem: _table(read_labels(file), file) for file in _files_of(path, wanted)}


def _table(labels: KittiLabels, file: Path) -> ObjectTable:
    try:
        return ObjectTable.of_kitti(labels)
    except ArrayError as error:
        raise DataError(file, "", str(error)) from error


def _table_in_lidar(file: Path) -> ObjectTable:
    """The labels of a sequence in the lidar's frame, by the calibration in the folder beside theirs."""
    labels = read_labels(file)
    boxes = _truth_in_lidar(labels, file.parent.with_name("calib") / file.name)
    return replace(_table(labels, file), boxes=boxes)


def _read_fused(path: Path, wanted: frozenset[str]) -> dict[str, ObjectTable]:
    files = [file for file in fused_files(path) if not wanted or file.stem in wanted]
    return {file.stem: _fused_objects_read_fused(file) for file in files}


def _read_lists(path: Path, wanted: frozenset[str], ledger: Ledger) -> dict[str, ObjectTable]:
    tables: dict[str, list[ObjectTable]] = {}
    for file in sorted(path.glob("*/*.txt")):
        if file.stem.isdigit() and (not wanted or file.stem in wanted):
            tables.setdefault(file.stem, []).append(_table_of_list(file, ledger))
    return {name: ObjectTable.joined(parts) for name, parts in tables.items()}


def _table_of_list(file: Path, ledger: Ledger) -> ObjectTable:
    """The detections of one class and sequence; lists of boxes in space have more columns."""
    if _Kind.EMPTY is _kind_of_files([file]):
        return ObjectTable.empty()
    with file_faults(file), open_file(file) as stream:
        in_space = next(line for line in stream if line.strip()).count(b",") > 5
    if in_space:
        found = read_boxes_3d_list(file, None, ledger)
        heights, widths, lengths, right, down, forward, rotations = found.values[:, 7:14].T
        boxes = (forward, -right, heights / 2 - down, lengths, widths, heights, -rotations - np.pi / 2)
        return _detections(found, found.values[:, 2:6], found.values[:, 6], np.column_stack(boxes))
    found = read_boxes_2d_list(file, None, ledger)
    return _detections(found, found.values[:, 1:5], found.values[:, 5], None)


def _detections(
    found: DetectionList, corners_xyxy: Float64Array, scores: Float64Array, boxes: Float64Array | None
) -> ObjectTable:
    none = np.full(len(found.frames), -1, np.int64)
    return ObjectTable(found.frames, none, found.labels, corners_xyxy, boxes, scores=scores)


def _check_names(
    found: _ObjectSequences,
    true: _ObjectSequences,
    wanted: Sequence[str],
    paths: tuple[Path | str, Path | str],
) -> None:
    if not true and not wanted:
        raise DataError(paths[1], "", "no sequence; expected files such as 0000.txt")
    for path, side in zip(paths, (found, true), strict=True):
        missing = ", ".join(name or "''" for name in sorted(set(wanted) - set(side)))
        if missing:
            raise OptionError(f"{path}: no sequence {missing}, which `--sequence` asks for")
    for path, side, other in ((paths[0], found, true), (paths[1], true, found)):
        missing = ", ".join(sorted(set(other) - set(side)))
        if missing and not wanted:
            problem = f"no sequence {missing}, which the other side has; choose those of both with `--sequence`"
            raise DataError(path, "", problem)


def _same_location(results: Path | str, truth: Path | str) -> bool:
    if isinstance(results, Path) and isinstance(truth, Path):
        return _folder_of(results).resolve() == _folder_of(truth).resolve()
    return results == truth


def _note_frames(found: _ObjectSequences, true: _ObjectSequences, ledger: Ledger) -> None:
    for name, truth in true.items():
        last = int(truth.frames.max()) if len(truth) else -1
        beyond = np.unique(found[name].frames[found[name].frames > last])
        if len(beyond):
            ledger.note(
                WarningKind.ASSUMED,
                "results-beyond-truth",
                f"sequence {name}",
                "results in frames after the last one of the truth count as false",
                count=len(beyond),
            )


def _comparable(found: _ObjectSequences, true: _ObjectSequences) -> tuple[Similarity, ...]:
    """The similarities for which both sides have boxes that are larger than nothing, or no rows at all."""
    in_image = all(_have_images(side) for side in (found, true))
    in_space = all(_have_space(side) for side in (found, true))
    reported = [Similarity.IMAGE] if in_image else []
    return (*reported, *((Similarity.ABOVE, Similarity.SPACE, Similarity.DISTANCE) if in_space else ()))


def _have_images(side: _ObjectSequences) -> bool:
    filled = [table for table in side.values() if len(table)]
    return not filled or any(
        (table.corners_xyxy[:, 2:] > table.corners_xyxy[:, :2]).all(axis=1).any()
        for table in filled
        if table.corners_xyxy is not None
    )


def _have_space(side: _ObjectSequences) -> bool:
    filled = [table for table in side.values() if len(table)]
    return not filled or any((table.boxes[:, 3:6] > 0).all(axis=1).any() for table in filled if table.boxes is not None)
