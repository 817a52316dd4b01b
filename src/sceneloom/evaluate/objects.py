"""Objects of a sequence as columns, and the similarity of true and found objects frame by frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import chain
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, check_array, hold_arrays, read_only
from sceneloom.errors import ArrayError, OptionError, check_choice
from sceneloom.formats.kitti.labels import KittiLabels
from sceneloom.kernels import overlaps

_FLOATS: dict[str, tuple[int, ...]] = {
    "corners_xyxy": (4,),
    "boxes": (7,),
    "truncations": (),
    "occlusions": (),
    "scores": (),
    "covariances": (7, 7),
}  # the columns that may be absent, and the shape of a row


KITTI_NEIGHBOURS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"car": ("van",), "pedestrian": ("person", "person_sitting")}
)
"""By class, the classes that are easily taken for it: their objects may be found, but need not be."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectTable:
    """The objects of one sequence, a row for each object in each frame, in any order.

    Attributes:
        frames: (N,) int64, 0 or more.
        ids: (N,) int64, of the objects, the same through the sequence; -1 for regions and detections, which have none.
        labels: N classes, compared without regard to capitals.
        corners_xyxy: (N, 4) float64 [px], left, top, right and bottom edge, or None.
        boxes: (N, 7) float64, middle [m], length, width, height [m] and heading about z [rad] in an upright frame that
            results and truth share, or None.
        truncations: (N,) float64, how much of each lies outside the image, or None.
        occlusions: (N,) float64, KITTI's 0 to 3, or None.
        scores: (N,) float64, higher for surer, or None.
        covariances: (N, 7, 7) float64 of the columns of `boxes`, or None.

    Raises:
        ArrayError: shapes or dtypes are wrong, a frame is negative, or a number is not finite.
    """

    frames: Int64Array
    ids: Int64Array
    labels: tuple[str, ...]
    corners_xyxy: Float64Array | None = None
    boxes: Float64Array | None = None
    truncations: Float64Array | None = None
    occlusions: Float64Array | None = None
    scores: Float64Array | None = None
    covariances: Float64Array | None = None

    def __post_init__(self) -> None:
        count = hold_arrays(self, "objects", {"frames": (np.int64, "N"), "ids": (np.int64, "N")})
        if len(self.labels) != count:
            raise ArrayError(f"objects.labels: {len(self.labels)}; expected {count}")
        for name, shape in _FLOATS.items():
            column: Float64Array | None = getattr(self, name)
            check_array(f"objects.{name}", column, (count, *shape), np.float64, optional=True)
            if column is not None:
                self._check_finite(name, column)
                object.__setattr__(self, name, read_only(column))
        if (self.frames < 0).any():
            raise ArrayError(f"objects.frames: {self.frames.min()}; expected 0 or more")
        object.__setattr__(self, "frames", read_only(self.frames))
        object.__setattr__(self, "ids", read_only(self.ids))

    def __len__(self) -> int:
        return len(self.frames)

    def _check_finite(self, name: str, column: Float64Array) -> None:
        sound = np.isfinite(column).all(axis=tuple(range(1, column.ndim)))
        if not sound.all():
            row = int(np.flatnonzero(~sound)[0])
            raise ArrayError(
                f"objects.{name}[{row}] (frame {self.frames[row]}): {column[row].tolist()}; expected finite numbers"
            )

    @classmethod
    def empty(cls) -> "ObjectTable":
        """A sequence without objects, which may be compared in any way."""
        none = np.zeros(0, np.int64)
        return cls(none, none, (), np.zeros((0, 4)), np.zeros((0, 7)), scores=np.zeros(0))

    @classmethod
    def of_kitti(cls, labels: KittiLabels) -> "ObjectTable":
        """Take the columns of KITTI's text; boxes get the frame x = camera's z, y = -x, z = -y.

        Source: the development kit of KITTI's tracking benchmark.
        """
        heights, widths, lengths = labels.sizes_hwl.T
        right, down, forward = labels.bottoms.T
        boxes = (forward, -right, heights / 2 - down, lengths, widths, heights, -labels.rotations_y - np.pi / 2)
        return cls(
            frames=labels.frames,
            ids=labels.track_ids,
            labels=tuple(labels.types),
            corners_xyxy=labels.corners_xyxy,
            boxes=np.column_stack(boxes).astype(np.float64),
            truncations=np.asarray(labels.truncations, np.float64),
            occlusions=np.asarray(labels.occlusions, np.float64),
            scores=labels.scores,
        )

    def are(self, *labels: str) -> BoolArray:
        """Report which rows are of one of these classes, (N,) bool."""
        asked = {label.lower() for label in labels}
        return np.fromiter((label.lower() in asked for label in self.labels), np.bool_, len(self.labels))

    def select(self, rows: ArrayLike) -> "ObjectTable":
        """Keep some rows: (M,) numbers of rows, or (N,) bool."""
        picked = np.arange(len(self))[np.asarray(rows)]
        columns = {name: getattr(self, name) for name in _FLOATS}
        kept = {name: None if column is None else column[picked] for name, column in columns.items()}
        return ObjectTable(
            self.frames[picked], self.ids[picked], tuple(self.labels[k] for k in picked.tolist()), **kept
        )

    def moved(self, frames: int) -> "ObjectTable":
        """The same rows so many frames later."""
        return replace(self, frames=self.frames + frames)

    @classmethod
    def joined(cls, tables: Sequence["ObjectTable"]) -> "ObjectTable":
        """The rows of several tables behind one another; columns that are absent from one with rows are absent."""
        filled = [table for table in tables if len(table)] or [cls.empty()]
        columns = {name: [getattr(table, name) for table in filled] for name in _FLOATS}
        return cls(
            np.concatenate([table.frames for table in filled]),
            np.concatenate([table.ids for table in filled]),
            tuple(chain.from_iterable(table.labels for table in filled)),
            **{
                name: None if any(part is None for part in parts) else np.concatenate(parts)
                for name, parts in columns.items()
            },
        )

    def in_order(self) -> "ObjectTable":
        """The same rows sorted by frame, those of a frame in the order in which they stood."""
        if (np.diff(self.frames) >= 0).all():
            return self
        return self.select(np.argsort(self.frames, kind="stable"))

    def frame_starts(self, frame_count: int) -> Int64Array:
        """Where the rows of each frame begin, (`frame_count` + 1,) int64; rows are in order."""
        return np.searchsorted(self.frames, np.arange(frame_count + 1)).astype(np.int64)


def check_sequences(results: Mapping[str, ObjectTable], truth: Mapping[str, ObjectTable]) -> None:
    """Refuse results and truth of different sequences.

    Raises:
        OptionError: they are not the same on both sides, or there is none.
    """
    if not truth:
        raise OptionError("the truth has no sequence")
    for side, names in (("results", set(truth) - set(results)), ("truth", set(results) - set(truth))):
        if names:
            raise OptionError(f"{side} without the sequences {', '.join(sorted(names))}")


_ZERO_DISTANCE = 4.0  # middles that are so far apart have nothing in common, half of it is a similarity of 0.5 [m]


class Similarity(StrEnum):
    """Measure of the similarity of two boxes, 0 to 1."""

    IMAGE = "2d"
    """Intersection over union of the boxes of the image."""
    ABOVE = "bev"
    """Intersection over union of the boxes as seen from above."""
    SPACE = "3d"
    """Intersection over union of the boxes in space."""
    DISTANCE = "distance"
    """1 - d / 4 m, of the horizontal distance d of the middles."""


def similarity_named(name: Similarity | str) -> Similarity:
    """The similarity of that name.

    Raises:
        OptionError: there is none.
    """
    check_choice("similarity", name, Similarity)
    return Similarity(name)


@dataclass(frozen=True, slots=True, eq=False)
class FramePairs:
    """All pairs of a true and a found object of one frame, frame after frame.

    Attributes:
        true_starts, found_starts: (F + 1,) int64, where the objects of each frame begin.
        starts: (F + 1,) int64, where its pairs begin; in a frame the true objects are rows, the found ones columns.
    """

    true_starts: Int64Array
    found_starts: Int64Array
    starts: Int64Array

    @classmethod
    def of(cls, true_starts: Int64Array, found_starts: Int64Array) -> "FramePairs":
        """Pair the objects of each frame."""
        return cls(true_starts, found_starts, overlaps.pair_starts(true_starts, found_starts))

    @property
    def locations(self) -> tuple[Int64Array, Int64Array, Int64Array]:
        """All three, as kernels take them."""
        return self.true_starts, self.found_starts, self.starts


def similarities(truth: ObjectTable, found: ObjectTable, pairs: FramePairs, similarity: Similarity) -> Float64Array:
    """Compute the similarity of each pair.

    Args:
        truth, found: in order of frames.

    Returns:
        (P,) float64, 0 to 1.

    Raises:
        OptionError: one of both lacks the boxes that this needs.
    """
    column = "corners_xyxy" if similarity is Similarity.IMAGE else "boxes"
    true = _column(truth, column, similarity, "the truth")
    ours = _column(found, column, similarity, "the results")
    if similarity is Similarity.IMAGE:
        return overlaps.image_overlaps(true, ours, *pairs.locations)
    if similarity is Similarity.ABOVE:
        return overlaps.overlaps_from_above(true, ours, *pairs.locations)
    if similarity is Similarity.SPACE:
        return overlaps.overlaps_in_space(true, ours, *pairs.locations)
    return overlaps.nearnesses(_plain(true[:, :2]), _plain(ours[:, :2]), *pairs.locations, _ZERO_DISTANCE)


def covered_by(found: ObjectTable, regions: Float64Array, pairs: FramePairs) -> Float64Array:
    """Compute the share of each found box of the image that lies in each region of its frame, (P,) float64.

    Args:
        regions: (R, 4) [px], left, top, right, bottom; the rows of `pairs`.
    """
    corners = _column(found, "corners_xyxy", Similarity.IMAGE, "the results")
    return overlaps.image_shares(_plain(regions), corners, *pairs.locations)


def _column(objects: ObjectTable, name: str, similarity: Similarity, side: str) -> Float64Array:
    column: Float64Array | None = getattr(objects, name)
    if column is None:
        raise OptionError(f"similarity {similarity.value!r}: {side} without {name}")
    return _plain(column)


def _plain(column: AnyArray) -> Float64Array:
    """The same numbers as compiled loops take them: contiguous and writable."""
    return np.require(column, np.float64, ["C", "W"])
