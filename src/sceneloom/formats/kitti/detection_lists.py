"""Lists of detections of whole sequences: lines of numbers with commas, a frame's number first.

Lists of boxes in images have one file for each class and sequence (`Car/0000.txt`); those of boxes in space name the
class by a number in each line, too. A file may be empty: then nothing was found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.kitti.number_lines import Line, Parser, as_table, read_lines, sound_rows
from sceneloom.formats.ledger import Ledger
from sceneloom.scene.warnings import WarningKind

COLUMNS_2D = ("frame", "x1", "y1", "x2", "y2", "score")
COLUMNS_3D = (
    *("frame", "type", "x1", "y1", "x2", "y2", "score"),
    *("h", "w", "l", "x", "y", "z", "ry", "alpha"),
)
"""What the numbers of a line are."""

TYPES: Mapping[int, str] = MappingProxyType({1: "Pedestrian", 2: "Car", 3: "Cyclist"})
"""Classes by their number in lists of boxes in space. Source: the lists that come with AB3DMOT."""

CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
"""KITTI's own words. Source: the readme of its development kits."""

_BEYOND = 0.01
"""Scores beyond 0 to 1 by no more than this are rounding, and cut; others are no probabilities."""


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

    @property
    def frame_count(self) -> int:
        """One more than the last frame in which something was found."""
        return int(self.frames[-1]) + 1 if len(self.frames) else 0


def empty_list(columns: Sequence[str]) -> DetectionList:
    """A detector that found nothing."""
    return DetectionList(np.zeros(0, np.int64), np.zeros((0, len(columns))), ())


def read_boxes_2d_list(path: Path, label: str | None, ledger: Ledger) -> DetectionList:
    """Read a list of boxes in images: `frame,x1,y1,x2,y2,score`.

    Args:
        label: class of all of them.
        ledger: reported boxes without an area, which are left out, and in a lenient reading of faulty lines.

    Raises:
        DataError: a line has another number of values, one is no number, or a score is no probability.
    """
    parse = Parser(COLUMNS_2D, whole=("frame",))
    rows = []
    for line, row in sound_rows(read_lines(path, separator=","), parse, ledger, "faulty-detections"):
        if not -_BEYOND <= row[5] <= 1 + _BEYOND:
            problem = f"score {row[5]:g}; expected a probability from 0 to 1"
            ledger.fault("faulty-detections", line.fault(problem))
            continue
        if row[3] <= row[1] or row[4] <= row[2]:
            ledger.note(
                WarningKind.SKIPPED,
                "boxes-without-area",
                f"{path}: line {line.number}",
                "boxes without an area",
            )
            continue
        row[5] = min(max(row[5], 0.0), 1.0)
        rows.append(row)
    own = label or class_word(path.parent.name)
    return _by_frame(as_table(rows, len(COLUMNS_2D)), [own] * len(rows), frozenset({own}))


def read_boxes_3d_list(path: Path, label: str | None, ledger: Ledger) -> DetectionList:
    """Read a list of boxes in space: `frame,type,x1,y1,x2,y2,score,h,w,l,x,y,z,ry,alpha`.

    Args:
        label: class of all of them; None, or no word of KITTI's, where the numbers in the lines report.
        ledger: reported in a lenient reading of faulty lines.

    Raises:
        DataError: a line has another number of values, one is no number, a size is not above 0, or the type is unknown,
            or another one than the class.
    """
    parse = Parser(COLUMNS_3D, whole=("frame", "type"))
    rows, labels = [], []
    for line, row in sound_rows(read_lines(path, separator=","), parse, ledger, "faulty-detections"):
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
    if known is not None and label not in CLASSES:  # a folder of any name: the line says more
        return known
    if label in TYPES.values() and known != label:
        raise line.fault(f"type {row[1]:g} in the folder {label}; the types are {listed}")
    return label


def _by_frame(values: Float64Array, labels: Sequence[str], classes: frozenset[str]) -> DetectionList:
    frames = values[:, 0].astype(np.int64)
    order = np.argsort(frames, kind="stable")
    return DetectionList(frames[order], values[order], tuple(labels[k] for k in order.tolist()), classes)


def joined(lists: Sequence[DetectionList], columns: Sequence[str]) -> DetectionList:
    """Put the lists of several classes together; within a frame they keep their order."""
    if not lists:
        return empty_list(columns)
    values = np.concatenate([one.values for one in lists])
    classes = frozenset[str]().union(*(one.classes for one in lists))
    return _by_frame(values, [label for one in lists for label in one.labels], classes)


def class_word(name: str) -> str:
    """KITTI's word for a class, whatever its case; others are kept."""
    return next((word for word in CLASSES if word.lower() == name.lower()), name)


def find_detector(folder: Path, prefix: str, chosen: str | None) -> Path | None:
    """Find the folder of a detector's lists.

    Args:
        folder: of all sequences.
        prefix: with which the names of such folders begin, "det2d_" or "det3d_".
        chosen: name of the folder, with or without the prefix; None for the only one.

    Returns:
        The folder; None where there is none.

    Raises:
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    found = sorted(path for path in folder.glob(f"{prefix}*") if path.is_dir())
    names = ", ".join(path.name for path in found) or "none"
    if chosen is not None:
        for path in found:
            if chosen in (path.name, path.name.removeprefix(prefix)):
                return path
        raise OptionError(f"detector {chosen!r}; {folder} has {names} of the kind {prefix}*")
    if len(found) > 1:
        kind = prefix.rstrip("_")
        raise OptionError(f"{folder} has several detectors: {names}; choose one with `--{kind} NAME`")
    return found[0] if found else None
