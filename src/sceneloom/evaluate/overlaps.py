"""How alike the objects of two tables are, in each frame: in the image, from above, in space, by distance."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.evaluate.objects import ObjectTable
from sceneloom.kernels import frame_overlaps, upright_overlaps


class Similarity(StrEnum):
    """What says how alike two boxes are, 0 to 1."""

    IMAGE = "2d"
    """Intersection over union of the boxes of the image."""
    ABOVE = "bev"
    """Intersection over union of the boxes as seen from above."""
    SPACE = "3d"
    """Intersection over union of the boxes in space."""
    DISTANCE = "distance"
    """1 - d / `ZERO_DISTANCE`, of the horizontal distance d of the middles."""


def similarity_named(name: Similarity | str) -> Similarity:
    """The similarity of that name.

    Raises:
        OptionError: there is none.
    """
    if name not in tuple(Similarity):
        raise OptionError(f"similarity {str(name)!r}; expected one of {', '.join(Similarity)}")
    return Similarity(name)


ZERO_DISTANCE = 4.0
"""Middles that are so far apart have nothing in common, half of it is a similarity of 0.5 [m]."""


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
        return cls(true_starts, found_starts, frame_overlaps.pair_starts(true_starts, found_starts))

    @property
    def locations(self) -> tuple[Int64Array, Int64Array, Int64Array]:
        """All three, as kernels take them."""
        return self.true_starts, self.found_starts, self.starts


def similarities(
    truth: ObjectTable, found: ObjectTable, pairs: FramePairs, similarity: Similarity
) -> Float64Array:
    """Report how alike the objects of each pair are.

    Args:
        truth, found: in order of frames.

    Returns:
        (P,) float64, 0 to 1.

    Raises:
        OptionError: one of both lacks the boxes that this needs.
    """
    column, compare = _COMPARED[similarity]
    sides = (
        _column(truth, column, similarity, "the truth"),
        _column(found, column, similarity, "the results"),
    )
    return compare(*sides, pairs)


def covered_by(found: ObjectTable, regions: Float64Array, pairs: FramePairs) -> Float64Array:
    """Report which share of each found box of the image lies in each region of its frame, (P,) float64.

    Args:
        regions: (R, 4) [px], left, top, right, bottom; the rows of `pairs`.
    """
    corners = _column(found, "corners_xyxy", Similarity.IMAGE, "the results")
    return frame_overlaps.image_shares(_plain(regions), corners, *pairs.locations)


def _column(objects: ObjectTable, name: str, similarity: Similarity, side: str) -> Float64Array:
    column: Float64Array | None = getattr(objects, name)
    if column is None:
        raise OptionError(f"similarity {similarity.value!r}: {side} without {name}")
    return _plain(column)


def _plain(column: AnyArray) -> Float64Array:
    """The same numbers as compiled loops take them: in one piece, and free to be written to."""
    return np.require(column, np.float64, ["C", "W"])


def _in_image(truth: Float64Array, found: Float64Array, pairs: FramePairs) -> Float64Array:
    return frame_overlaps.image_overlaps(truth, found, *pairs.locations)


def _from_above(truth: Float64Array, found: Float64Array, pairs: FramePairs) -> Float64Array:
    return upright_overlaps.overlaps_from_above(truth, found, *pairs.locations)


def _in_space(truth: Float64Array, found: Float64Array, pairs: FramePairs) -> Float64Array:
    return upright_overlaps.overlaps_in_space(truth, found, *pairs.locations)


def _near(truth: Float64Array, found: Float64Array, pairs: FramePairs) -> Float64Array:
    return frame_overlaps.nearnesses(
        _plain(truth[:, :2]), _plain(found[:, :2]), *pairs.locations, ZERO_DISTANCE
    )


_COMPARED: dict[Similarity, tuple[str, Callable[[Float64Array, Float64Array, FramePairs], Float64Array]]] = {
    Similarity.IMAGE: ("corners_xyxy", _in_image),
    Similarity.ABOVE: ("boxes", _from_above),
    Similarity.SPACE: ("boxes", _in_space),
    Similarity.DISTANCE: ("boxes", _near),
}
