"""Labels, results and lists of detections of the tracking and object benchmarks, and their boxes in other frames."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, check_array, read_only
from sceneloom.errors import ArrayError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.kitti.text import Line, as_table, read_lines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.warnings import WarningKind

NUMBERS = (*("truncated", "occluded", "alpha", "x1", "y1", "x2", "y2"), *("h", "w", "l", "x", "y", "z", "ry"))
"""The numbers behind the class of an object; a score may follow."""

NO_TRACK = -1
"""The track of an object of which none is reported."""

DONT_CARE = "DontCare"
"""The class of regions in which nothing counts."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiLabels:
    """Labels or results, in KITTI's own terms: rectified camera frame, pixels counted from the centre of the first.

    Attributes:
        frames: (N,) int64.
        track_ids: (N,) int64, `NO_TRACK` where there is none.
        types: N classes.
        truncations: (N,) float64: how much of the object leaves the image; -1 where nothing is reported.
        occlusions: (N,) int64: 0 seen whole, 1 partly, 2 largely hidden, 3 unknown; -1 where nothing is reported.
        alphas: (N,) float64 [rad], observation angle; -10 where nothing is reported.
        corners_xyxy: (N, 4) float64 [px], left, top, right, bottom.
        sizes_hwl: (N, 3) float64 [m], height, width, length; not above 0 where nothing is reported.
        bottoms: (N, 3) float64 [m], middle of the box's bottom.
        rotations_y: (N,) float64 [rad], about the camera's y axis.
        scores: (N,) float64, or None for labels.

    Raises:
        ArrayError: shapes or dtypes are wrong.
    """

    frames: Int64Array
    track_ids: Int64Array
    types: tuple[str, ...]
    truncations: Float64Array
    occlusions: Int64Array
    alphas: Float64Array
    corners_xyxy: Float64Array
    sizes_hwl: Float64Array
    bottoms: Float64Array
    rotations_y: Float64Array
    scores: Float64Array | None = None

    def __post_init__(self) -> None:
        count = check_array("labels.frames", self.frames, (None,), np.int64)
        check_array("labels.track_ids", self.track_ids, (count,), np.int64)
        for name, (column, dtype) in _COLUMNS.items():
            shape = (count,) if isinstance(column, int) else (count, column.stop - column.start)
            check_array(f"labels.{name}", getattr(self, name), shape, dtype, optional=name == "scores")
        if len(self.types) != count:
            raise ArrayError(f"labels.types: {len(self.types)}; expected {count}")
        for name in ("frames", "track_ids", *_COLUMNS):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, read_only(value))

    @classmethod
    def of(
        cls, frames: Sequence[int], track_ids: Sequence[int], types: Sequence[str], values: Float64Array
    ) -> "KittiLabels":
        """Labels of rows of numbers, (N, 14) float64 in the order of `NUMBERS`, or (N, 15) with a score."""
        columns: dict[str, Any] = {
            name: None if name == "scores" and values.shape[1] == len(NUMBERS) else values[:, column].astype(dtype)
            for name, (column, dtype) in _COLUMNS.items()
        }
        return cls(np.array(frames, np.int64), np.array(track_ids, np.int64), tuple(types), **columns)

    @property
    def values(self) -> Float64Array:
        """The numbers of all rows, as `of` takes them."""
        columns = [value for name in _COLUMNS if (value := getattr(self, name)) is not None]
        return np.column_stack(columns).astype(np.float64)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def have_position(self) -> BoolArray:
        """(N,) bool, whether a box in space is reported."""
        have: BoolArray = np.all(self.sizes_hwl > 0, axis=1)
        return have

    @property
    def have_outline(self) -> BoolArray:
        """(N,) bool, whether it is reported where an image shows the object."""
        have: BoolArray = np.any(self.corners_xyxy != NO_OUTLINE, axis=1)
        return have

    def with_frames(self, numbers: Sequence[int]) -> "KittiLabels":
        """The same with other numbers of frames, by the old ones."""
        return replace(self, frames=np.array([numbers[k] for k in self.frames.tolist()], np.int64))

    def select(self, rows: ArrayLike) -> "KittiLabels":
        """Keep some: (M,) numbers of rows, or (N,) bool."""
        picked = np.asarray(rows)
        chosen = np.arange(len(self))[picked if picked.dtype == np.bool_ else picked.astype(np.int64)]
        types = [self.types[k] for k in chosen.tolist()]
        return KittiLabels.of(self.frames[chosen], self.track_ids[chosen], types, self.values[chosen])


NO_OUTLINE = -1.0
"""All four edges of a box of a drive that has no camera; KITTI's own labels have none such."""

_COLUMNS: Mapping[str, tuple[int | slice, type]] = MappingProxyType(
    {
        "truncations": (0, np.float64),
        "occlusions": (1, np.int64),
        "alphas": (2, np.float64),
        "corners_xyxy": (slice(3, 7), np.float64),
        "sizes_hwl": (slice(7, 10), np.float64),
        "bottoms": (slice(10, 13), np.float64),
        "rotations_y": (13, np.float64),
        "scores": (14, np.float64),
    }
)
"""Fields of labels: their columns among `NUMBERS`, which a score may follow, and dtypes."""


def read_labels(path: Path | str) -> KittiLabels:
    """Read labels or results of the tracking benchmark (one file a sequence) or of the object benchmark (one a frame).

    A line of tracking begins with frame and track; of an object file, the frame is the number in the file's name, else
    0. An empty file holds none.

    Raises:
        DataError: the file cannot be read, or a line is cut off, too long, or holds something that is no number.

    Source: the readme files of KITTI's development kits for objects and tracking.
    """
    path = Path(path)
    lines = read_lines(path)
    tracked = bool(lines) and len(lines[0].words) > 2 and lines[0].words[0].lstrip("-").isdigit()
    frame = int(path.stem) if path.stem.isascii() and path.stem.isdigit() and len(path.stem) < 19 else 0
    heads: list[tuple[int, int, str]] = []
    numbers: list[list[float]] = []
    scored = None
    for line in lines:
        head, first = _head(line) if tracked else ((frame, NO_TRACK, _word(line, 0)), 1)
        values = _values(line, first)
        if scored is not None and scored != len(values):
            raise line.fault(f"{len(line.words)} values where others have {scored + first}; expected as many")
        scored = len(values)
        heads.append(head)
        numbers.append(values)
    frames, tracks, types = zip(*heads, strict=True) if heads else ((), (), ())
    return KittiLabels.of(frames, tracks, types, as_table(numbers, scored or len(NUMBERS)))


def _head(line: Line) -> tuple[tuple[int, int, str], int]:
    if len(line.words) < 3:
        raise line.fault(f"{len(line.words)} values; expected 17 or 18: frame, track, class, {', '.join(NUMBERS)}")
    return (line.whole_at(0, "frame"), line.whole_at(1, "track", low=NO_TRACK), _word(line, 2)), 3


def _word(line: Line, column: int) -> str:
    word = line.words[column] if line.words else ""
    if not word or not word[0].isalpha():
        raise line.fault(f"class {word[:40]!r}; expected a word, as Car")
    return word


def _values(line: Line, first: int) -> list[float]:
    count = len(NUMBERS) + first
    line.check_count((count, count + 1), f"class, {', '.join(NUMBERS)}, and a score of results")
    values = line.floats(first, [*NUMBERS, "score"][: len(line.words) - first])
    for name, value in zip(NUMBERS[7:10], values[7:10], strict=True):
        if value <= 0 and value not in (-1.0, -1000.0):
            raise line.fault(f"{name} {value:g}; expected a size above 0, or -1 or -1000 where it is not reported")
    if values[1] != int(values[1]):
        raise line.fault(f"occluded {values[1]:g}; expected a whole number")
    return values


def joined_labels(parts: Sequence[KittiLabels]) -> KittiLabels:
    """Put labels together, in the order of the parts; scores are kept where all of them have some."""
    filled = [part for part in parts if len(part)]
    width = min((part.values.shape[1] for part in filled), default=len(NUMBERS))
    values = np.concatenate([np.zeros((0, width)), *(part.values[:, :width] for part in filled)])
    return KittiLabels.of(
        [frame for part in filled for frame in part.frames.tolist()],
        [track for part in filled for track in part.track_ids.tolist()],
        [word for part in filled for word in part.types],
        values,
    )


CENTRE_TO_CORNER = 0.5
"""KITTI counts pixels from the centre of the first one, boxes here from the image's own corner [px]."""


def lidar_boxes(
    sizes_hwl: Float64Array, bottoms: Float64Array, rotations_y: Float64Array, rectified_from_lidar: RigidTransform
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Give boxes in the lidar's frame.

    Args:
        sizes_hwl: (N, 3) float64 [m], height, width, length.
        bottoms: (N, 3) float64 [m], middles of the boxes' bottoms, rectified camera frame.
        rotations_y: (N,) float64 [rad], about the camera's y axis; 0 along its x axis.
        rectified_from_lidar: how the frames lie.

    Returns:
        centers: (N, 3) float64 [m].
        sizes_lwh: (N, 3) float64 [m].
        yaws: (N,) float64 [rad].

    Source: the readme of KITTI's development kit for objects.
    """
    centers = bottoms - np.array([0.0, 0.5, 0.0]) * sizes_hwl[:, :1]
    headings = np.column_stack([np.cos(rotations_y), np.zeros(len(rotations_y)), -np.sin(rotations_y)])
    lidar_from_rectified = rectified_from_lidar.inverse()
    rotated = lidar_from_rectified.rotate(headings)
    return (lidar_from_rectified.apply(centers), sizes_hwl[:, ::-1].copy(), np.arctan2(rotated[:, 1], rotated[:, 0]))


def observation_angles(bottoms: Float64Array, rotations_y: Float64Array) -> Float64Array:
    """Under which angle the camera sees objects, KITTI's alpha: (N,) float64 [rad], -π to π."""
    angles = rotations_y - np.arctan2(bottoms[:, 0], bottoms[:, 2])
    wrapped: Float64Array = np.arctan2(np.sin(angles), np.cos(angles))
    return wrapped


COLUMNS_2D = ("frame", "x1", "y1", "x2", "y2", "score")

COLUMNS_3D = (*("frame", "type", "x1", "y1", "x2", "y2", "score"), *("h", "w", "l", "x", "y", "z", "ry", "alpha"))
"""What the numbers of a line are."""

TYPES: Mapping[int, str] = MappingProxyType({1: "Pedestrian", 2: "Car", 3: "Cyclist"})
"""Classes by their number in lists of boxes in space. Source: the lists that come with AB3DMOT."""

_CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
"""KITTI's own words. Source: the readme of its development kits."""

_BEYOND = 0.01  # scores beyond 0 to 1 by no more than this are rounding, and cut; others are no probabilities


@dataclass(frozen=True, slots=True, eq=False)
class DetectionList:
    """The detections of one sequence, by frame.

    Attributes:
        frames: (N,) int64, not falling.
        values: (N, K) float64, the numbers of the lines, as `COLUMNS_2D` or `COLUMNS_3D` call them.
        labels: N classes.
        classes: that have a list, be it empty: those that the detector looks for.
    """

    frames: Int64Array
    values: Float64Array
    labels: tuple[str, ...]
    classes: frozenset[str] = frozenset()

    def of(self, frame: int) -> tuple[Float64Array, tuple[str, ...]]:
        """The numbers and classes of one frame, in the order of the file."""
        first, stop = np.searchsorted(self.frames, (frame, frame + 1)).tolist()
        return self.values[first:stop], self.labels[first:stop]

    @classmethod
    def joined(cls, lists: Sequence["DetectionList"], columns: Sequence[str]) -> "DetectionList":
        """The lists of several classes together; within a frame they keep their order."""
        values = np.concatenate([np.zeros((0, len(columns))), *(one.values for one in lists)])
        classes = frozenset[str]().union(*(one.classes for one in lists))
        return _by_frame(values, [label for one in lists for label in one.labels], classes)

    @property
    def frame_count(self) -> int:
        """One more than the last frame in which something was found."""
        return int(self.frames[-1]) + 1 if len(self.frames) else 0


def read_boxes_2d_list(path: Path, label: str | None, ledger: Ledger) -> DetectionList:
    """Read a list of boxes in images: `frame,x1,y1,x2,y2,score`.

    Args:
        label: class of all of them.
        ledger: takes warnings of boxes without an area, which are left out, and in a lenient reading of faulty lines.

    Raises:
        DataError: a line has another number of values, one is no number, or a score is no probability.
    """
    rows = []
    for line, row in _sound_rows(path, COLUMNS_2D, ("frame",), ledger):
        if not -_BEYOND <= row[5] <= 1 + _BEYOND:
            problem = f"score {row[5]:g}; expected a probability from 0 to 1"
            ledger.fault("faulty-detections", line.fault(problem))
            continue
        if row[3] <= row[1] or row[4] <= row[2]:
            location = f"{path}: line {line.number}"
            ledger.note(WarningKind.SKIPPED, "boxes-without-area", location, "boxes without an area")
            continue
        row[5] = min(max(row[5], 0.0), 1.0)
        rows.append(row)
    own = label or class_word(path.parent.name)
    return _by_frame(as_table(rows, len(COLUMNS_2D)), [own] * len(rows), frozenset({own}))


def read_boxes_3d_list(path: Path, label: str | None, ledger: Ledger) -> DetectionList:
    """Read a list of boxes in space: `frame,type,x1,y1,x2,y2,score,h,w,l,x,y,z,ry,alpha`.

    Args:
        label: class of all of them; None, or no word of KITTI's, where the numbers in the lines state it.
        ledger: takes warnings of faulty lines in a lenient reading.

    Raises:
        DataError: a line has another number of values, one is no number, a size is not above 0, or the type is unknown,
            or another one than the class.
    """
    rows, labels = [], []
    for line, row in _sound_rows(path, COLUMNS_3D, ("frame", "type"), ledger):
        try:
            labels.append(_checked_label(line, row, label))
        except DataError as error:
            ledger.fault("faulty-detections", error)
            continue
        rows.append(row)
    classes = frozenset(labels) or frozenset({label} if label else ())
    return _by_frame(as_table(rows, len(COLUMNS_3D)), labels, classes)


def _checked_label(line: Line, row: Sequence[float], label: str | None) -> str:
    for name, value in zip(COLUMNS_3D[7:10], row[7:10], strict=True):
        if value <= 0:
            raise line.fault(f"{name} {value:g}; expected a size above 0")
    known = TYPES.get(int(row[1]))
    listed = ", ".join(f"{number} {name}" for number, name in TYPES.items())
    if label is None:
        if known is None:
            raise line.fault(f"type {row[1]:g}; expected one of {listed}")
        return known
    if known is not None and label not in _CLASSES:  # a folder of any name: the line says more
        return known
    if label in TYPES.values() and known != label:
        raise line.fault(f"type {row[1]:g} in the folder {label}; the types are {listed}")
    return label


def _by_frame(values: Float64Array, labels: Sequence[str], classes: frozenset[str]) -> DetectionList:
    frames = values[:, 0].astype(np.int64)
    order = np.argsort(frames, kind="stable")
    return DetectionList(frames[order], values[order], tuple(labels[k] for k in order.tolist()), classes)


def class_word(name: str) -> str:
    """KITTI's word for a class, whatever its case; others are kept."""
    return next((word for word in _CLASSES if word.lower() == name.lower()), name)


def _sound_rows(
    path: Path, names: Sequence[str], whole: Sequence[str], ledger: Ledger
) -> Iterator[tuple[Line, list[float]]]:
    """The numbers of each line, some of them whole; a faulty line raises, or is left out in a lenient reading."""
    for line in read_lines(path, separator=","):
        try:
            line.check_count((len(names),), ",".join(names))
            row = line.floats(0, names)
            for name in whole:
                line.whole_at(names.index(name), name)
        except DataError as error:
            ledger.fault("faulty-detections", error)
            continue
        yield line, row
