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
    lidar_boxes,
    read_boxes_2d_list,
    read_boxes_3d_list,
    read_labels,
)
from sceneloom.geometry.rigid import rotate_vectors
from sceneloom.scene.annotations import AttributePath, CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame, cuboid_poses, not_in_world
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Coordinates, SensorType
from sceneloom.warnings import DataWarning, WarningKind

_LABEL_FOLDERS = ("label_02", "label_2", "data")
"""Folders inside a given one in which KITTI and evaluations by its rules keep labels and results."""

_OBJECTS = "objects"  # the name of the only sequence where each file is a frame, and of that of two scenes

_SCORES = ("existence", "score", "confidence")
"""Attributes of cuboids that state how sure they are; the first one that a cuboid has counts."""

_NO_LABEL = "object"  # the class of cuboids that name none

_ObjectSequences = Mapping[str, ObjectTable]  # tables by name of the sequence


class _Kind(StrEnum):
    """The content of a path."""

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
        from_scenes: whether they are cuboids of scenes, whose classes can be any.
        warnings: about both.
    """

    results: _ObjectSequences
    truth: _ObjectSequences
    similarities: tuple[Similarity, ...]
    from_scenes: bool
    warnings: tuple[DataWarning, ...] = ()

    def classes(self, asked: Sequence[str], *, usual: Sequence[str]) -> tuple[str, ...]:
        """The classes asked for; none: of KITTI's text the usual ones in the truth, else all in the truth.

        Raises:
            OptionError: a class occurs on neither side, so that all its metrics would be 0.
        """
        true, found = (
            {label.lower() for table in side.values() for label in table.labels} for side in (self.truth, self.results)
        )
        for label in asked:
            if label.lower() not in true | found:
                both = ", ".join(sorted(true | found)) or "none"
                raise OptionError(f"class {label!r} occurs neither in the results nor in the truth, which have {both}")
        there = true - {"dontcare"}
        known = () if self.from_scenes else tuple(label for label in usual if label in there)
        return tuple(asked) or known or tuple(sorted(there))

    def check_similarity(self, similarity: Similarity) -> None:
        """Refuse a similarity for which one side has no boxes.

        Raises:
            OptionError: it has none.
        """
        if similarity not in self.similarities:
            listed = ", ".join(self.similarities) or "nothing: results and truth have no boxes in common"
            raise OptionError(f"similarity {similarity.value!r}: one side has no such boxes; comparable: {listed}")


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
    the object benchmark; the folder with `label_02` or `label_2` will do), or a scene with cuboids. Results may
    also be lists of detections, `CLASS/SEQUENCE.txt`, or lines of fused ones, `SEQUENCE.jsonl`, which are compared
    in the lidar's frame: the truth's folder has `calib` beside `label_02` then.

    Args:
        results, truth: where they are.
        sequences: those to take, leading zeros need not be stated; of scenes the one of a data set. [default: all of
            the truth]
        lenient: skip faulty lines of lists, and open damaged drives.
        corrections: "apply" or "ignore", as of `open_scene`; of scenes only.

    Raises:
        DataError: a file is missing or has something wrong, or one side lacks a sequence.
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
        # leading zeros need not be stated
        names = {file.stem.lstrip("0"): file.stem for file in _files_of(Path(truth))}
        sequences = tuple(dict.fromkeys(names.get(name.lstrip("0"), name) if name else name for name in sequences))
        sides = _read_texts(Path(results), Path(truth), kinds, frozenset(sequences), ledger)
    _check_names(*sides, sequences, (results, truth))
    found, true = ({name: side[name] for name in sequences or sorted(sides[1])} for side in sides)
    for name, table in true.items():
        last = int(table.frames.max()) if len(table) else -1
        beyond = np.unique(found[name].frames[found[name].frames > last])
        if len(beyond):
            problem = "results in frames after the last one of the truth count as false"
            ledger.note(WarningKind.ASSUMED, "results-beyond-truth", f"sequence {name}", problem, count=len(beyond))
    if _are_same(results, truth):
        ledger.note(WarningKind.ASSUMED, "truth-against-itself", str(results), "results and truth are the same files")
    return BothSides(found, true, _comparable(found, true), _Kind.SCENE in kinds, ledger.warnings)


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
    return _Kind.LISTS if any(file.stem.isdigit() for file in folder.glob("*/*.txt")) else _Kind.SCENE


def _kind_of_files(files: Iterable[Path]) -> _Kind:
    """Distinguish files of frames, whose lines begin with a class, from those of sequences by the first line of all."""
    for file in files:
        with file_faults(file), open_file(file) as stream:
            word = next((line.split()[0] for line in stream if line.strip()), None)
        if word is not None:
            return _Kind.FRAMES if word[:1].isalpha() else _Kind.SEQUENCES
    return _Kind.EMPTY


def fused_files(path: Path) -> list[Path]:
    """The files of lines of table 10 of DB34/T 4101 that a path has (itself, or in a folder), by their beginning."""
    files = sorted(path.glob("*.jsonl")) if path.is_dir() else [path] if path.suffix == ".jsonl" else []
    found = []
    for file in files:
        with file_faults(file), open_file(file) as stream:
            if stream.read(64).lstrip().startswith(b'{"detections"'):
                found.append(file)
    return found


def _folder_of(path: Path) -> Path:
    """The folder with the files, for the one that it is in."""
    return next((path / name for name in _LABEL_FOLDERS if (path / name).is_dir()), path)


def _files_of(path: Path, wanted: frozenset[str] = frozenset()) -> list[Path]:
    """Files of KITTI's text: of the wanted names, or all."""
    if path.is_file():
        return [path]
    files = [file for file in sorted(_folder_of(path).glob("*.txt")) if file.stem.isdigit()]
    return [file for file in files if not wanted or file.stem in wanted]


def _are_same(results: Path | str, truth: Path | str) -> bool:
    if isinstance(results, Path) and isinstance(truth, Path):
        return _folder_of(results).resolve() == _folder_of(truth).resolve()
    return results == truth


def _check_names(
    found: _ObjectSequences, true: _ObjectSequences, wanted: Sequence[str], paths: tuple[Path | str, Path | str]
) -> None:
    if not true and not wanted:
        raise DataError(paths[1], "", "no sequence; expected files such as 0000.txt")
    for path, side, other in ((paths[0], found, true), (paths[1], true, found)):
        missing = ", ".join(name or "''" for name in sorted(set(wanted or other) - set(side)))
        if missing and wanted:
            raise OptionError(f"{path}: no sequence {missing}, which `--sequence` asks for")
        if missing:
            problem = f"no sequence {missing}, which the other side has; choose those of both with `--sequence`"
            raise DataError(path, "", problem)


def _comparable(found: _ObjectSequences, true: _ObjectSequences) -> tuple[Similarity, ...]:
    """The similarities for which both sides have boxes that are larger than nothing, or no rows at all."""

    def have(side: _ObjectSequences, column: str) -> bool:
        filled = [getattr(table, column) for table in side.values() if len(table)]
        if column == "boxes":
            sizes = [boxes[:, 3:6] for boxes in filled if boxes is not None]
        else:
            sizes = [corners[:, 2:] - corners[:, :2] for corners in filled if corners is not None]
        return not filled or any((size > 0).all(axis=1).any() for size in sizes)

    in_image, in_space = (have(found, column) and have(true, column) for column in ("corners_xyxy", "boxes"))
    image = (Similarity.IMAGE,) if in_image else ()
    return (*image, *((Similarity.ABOVE, Similarity.SPACE, Similarity.DISTANCE) if in_space else ()))


def _read_texts(
    results: Path, truth: Path, kinds: list[_Kind], wanted: frozenset[str], ledger: Ledger
) -> tuple[_ObjectSequences, _ObjectSequences]:
    stated = [kind for kind in kinds if kind in (_Kind.SEQUENCES, _Kind.FRAMES)]
    if len(set(stated)) > 1:
        raise OptionError(f"{results} is {kinds[0]}, {truth} is {kinds[1]}; expected the same on both sides")
    if kinds[1] in (_Kind.LISTS, _Kind.FUSED):
        raise OptionError(f"{truth} is {kinds[1]}, which has no truth; expected KITTI's labels")
    by_frame = stated[:1] == [_Kind.FRAMES]
    true = _read_labels(truth, wanted, by_frame=by_frame, in_lidar=kinds[0] is _Kind.FUSED)
    if kinds[0] is _Kind.FUSED:
        files = [file for file in fused_files(results) if not wanted or file.stem in wanted]
        found = {file.stem: _read_fused(file) for file in files}
    elif kinds[0] is _Kind.LISTS:
        tables: dict[str, list[ObjectTable]] = {}
        for file in sorted(results.glob("*/*.txt")):
            if file.stem.isdigit() and (not wanted or file.stem in wanted):
                tables.setdefault(file.stem, []).append(_read_list(file, ledger))
        found = {name: ObjectTable.joined(parts) for name, parts in tables.items()}
    else:
        found = _read_labels(results, wanted, by_frame=by_frame)
    if results.is_file() and truth.is_file():
        # two files are meant to be compared, whatever their names
        found = dict(zip(true, found.values(), strict=True))
    return found, true


def _read_labels(
    path: Path, wanted: frozenset[str], *, by_frame: bool, in_lidar: bool = False
) -> dict[str, ObjectTable]:
    """Labels by sequence; boxes in the lidar's frame by the calibration in the folder beside theirs."""
    tables = {}
    for file in _files_of(path, frozenset() if by_frame and not in_lidar else wanted):
        labels = read_labels(file)
        try:
            tables[file.stem] = ObjectTable.of_kitti(labels)
        except ArrayError as error:
            raise DataError(file, "", str(error)) from error
        if in_lidar:
            rectified_from_lidar = read_calibration(file.parent.with_name("calib") / file.name).rectified_from_lidar
            placed = lidar_boxes(labels.sizes_hwl, labels.bottoms, labels.rotations_y, rectified_from_lidar)
            tables[file.stem] = replace(tables[file.stem], boxes=np.column_stack(placed))
    return {_OBJECTS: ObjectTable.joined(list(tables.values()))} if by_frame and not in_lidar else tables


def _read_list(file: Path, ledger: Ledger) -> ObjectTable:
    """The detections of one class and sequence; lists of boxes in space have more columns."""
    if _kind_of_files([file]) is _Kind.EMPTY:
        return ObjectTable.empty()
    with file_faults(file), open_file(file) as stream:
        in_space = next(line for line in stream if line.strip()).count(b",") > 5
    found = read_boxes_3d_list(file, None, ledger) if in_space else read_boxes_2d_list(file, None, ledger)
    none, values, first = np.full(len(found.frames), -1, np.int64), found.values, 2 if in_space else 1
    boxes = None
    if in_space:
        heights, widths, lengths, right, down, forward, rotations = values[:, 7:14].T
        columns = (forward, -right, heights / 2 - down, lengths, widths, heights, -rotations - np.pi / 2)
        boxes = np.column_stack(columns)
    corners, scores = values[:, first : first + 4], values[:, first + 4]
    return ObjectTable(found.frames, none, found.labels, corners, boxes, scores=scores)


def _read_fused(path: Path) -> ObjectTable:
    """Read lines of table 10, as `sceneloom fuse --type detection` writes them; a cloud's number is its frame."""
    tables: dict[int, ObjectTable] = {}
    for number, line in read_lines(path):
        where = f"line {number}"
        try:
            record = parse_json(line)
        except DataError as error:
            raise DataError(path, where, f"{error.location or 'record'}: {error.problem}") from error
        if not isinstance(record, FusedDetections):
            raise DataError(path, where, "is no record of fused detections (table 10)")
        if record.points_seq in tables:
            raise DataError(path, where, f"cloud {record.points_seq} comes twice; expected the objects of one camera")
        count = len(record.class_names)
        covariances = np.zeros((count, 7, 7))
        covariances[:, :3, :3], covariances[:, 3:6, 3:6] = record.center_covs, record.size_covs
        yaws = np.arctan2(record.directions[:, 1], record.directions[:, 0])
        tables[record.points_seq] = ObjectTable(
            np.full(count, record.points_seq, np.int64),
            np.full(count, -1, np.int64),
            record.class_names,
            record.corners_xyxy.astype(np.float64) - CENTRE_TO_CORNER,
            np.column_stack([record.centers, record.sizes_lwh, yaws]).astype(np.float64),
            scores=record.confidence.astype(np.float64),
            covariances=covariances,
        )
    return ObjectTable.joined(list(tables.values()))


def _read_scenes(
    results: Path | str, truth: Path | str, sequences: Sequence[str], ledger: Ledger, corrections: str
) -> tuple[_ObjectSequences, _ObjectSequences]:
    if len(sequences) > 1:
        raise OptionError(f"sequences {', '.join(sequences)}: two scenes are compared; give one sequence")
    chosen = {"sequence": sequences[0]} if sequences else {}
    with open_scenes((results, truth), {"lenient": ledger.lenient, "corrections": corrections, **chosen}) as opened:
        found, true = (scene.corrected() for scene in opened)
        for scene in (found, true):
            for warning in scene.correction_warnings:
                ledger.note(warning.kind, warning.code, f"{scene.source}: {warning.location}", warning.message)
        times_ns = labelled_times(true)
        return {_OBJECTS: scene_objects(found, times_ns)}, {_OBJECTS: scene_objects(true, times_ns)}


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
    angles, any_scores, tables = CuboidAngles.of(scene), False, []
    for number, cuboid in enumerate(cuboids):
        poses, stated = cuboid_poses(cuboid, times_ns, angles=angles), _stated_scores(cuboid)
        frames = np.flatnonzero(poses.there).astype(np.int64)
        ahead = rotate_vectors(poses.quaternions_xyzw[frames], np.array([1.0, 0.0, 0.0]))
        boxes = (poses.centers_world[frames], poses.sizes_lwh[frames], np.arctan2(ahead[:, 1], ahead[:, 0]))
        any_scores |= stated is not None
        tables.append(
            ObjectTable(
                frames,
                np.full(len(frames), number, np.int64),
                (cuboid.label or _NO_LABEL,) * len(frames),
                boxes=np.column_stack(boxes).astype(np.float64),
                scores=_scores_at(stated, times_ns[frames]),
            )
        )
    joined = ObjectTable.joined(tables).in_order()
    return joined if any_scores else replace(joined, scores=None)


def _cuboids(scene: Scene) -> list[CuboidAnnotation]:
    return [annotation for annotation in scene.annotations if isinstance(annotation, CuboidAnnotation)]


def _stated_scores(cuboid: CuboidAnnotation) -> AttributePath | None:
    """The attribute that states how sure a cuboid is, if its values are numbers."""
    for name in _SCORES:
        for attribute in cuboid.attributes:
            numbers = all(isinstance(value, int | float) for value in attribute.values)
            if attribute.name == name and attribute.values and numbers:
                return attribute
    return None


def _scores_at(stated: AttributePath | None, times_ns: Int64Array) -> Float64Array:
    """Scores of a cuboid at times (M,) [ns]: a value holds until the next; 1 of cuboids without any."""
    if stated is None:
        return np.ones(len(times_ns))
    values = np.asarray(stated.values, np.float64)
    if not stated.is_timed or stated.timestamps_ns is None:
        return np.full(len(times_ns), values[0])
    rows = np.searchsorted(stated.timestamps_ns, times_ns, side="right") - 1
    return values[np.clip(rows, 0, len(values) - 1)]
