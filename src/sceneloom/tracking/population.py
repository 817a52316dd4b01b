"""The objects that a tracker knows, as columns of one table."""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.scene.types import Identifier
from sceneloom.tracking import motion

ByCamera = dict[Identifier, Float64Array]


@dataclass(slots=True, eq=False)
class Population:
    """Objects, a row each. No array is written to once another moment begins.

    Attributes:
        ids: (N,) int64.
        means, covariances: (N, 11) and (N, 11, 11) of `motion`.
        log_odds: (N,) float64, of existence.
        hidden: (N,) float64, probability that something unknown hides them.
        codes: (N, 2) int64, class and family.
        vehicles: (N,) bool.
        seen_ns: (N,) int64 [ns], when a box was last theirs.
        heading_votes: (N,) float64, how much speaks for their heading and against its opposite.
        votes: (N, K) float64, for each of K words.
        supports: (N,) uint8 of `Support`.
        differing, differing_variances: by camera, (N, 4) of `image_boxes`.
        corners_xyxy: by camera, (N, 4) float64 [px], the detector's boxes of this moment, NaN where there are none.
    """

    ids: Int64Array
    means: Float64Array
    covariances: Float64Array
    log_odds: Float64Array
    hidden: Float64Array
    codes: Int64Array
    vehicles: BoolArray
    seen_ns: Int64Array
    heading_votes: Float64Array
    votes: Float64Array
    supports: UInt8Array
    differing: ByCamera = field(default_factory=dict)
    differing_variances: ByCamera = field(default_factory=dict)
    corners_xyxy: ByCamera = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def empty(cls) -> "Population":
        """No object."""
        return cls(
            ids=np.zeros(0, np.int64),
            means=np.zeros((0, motion.SIZE)),
            covariances=np.zeros((0, motion.SIZE, motion.SIZE)),
            log_odds=np.zeros(0),
            hidden=np.zeros(0),
            codes=np.zeros((0, 2), np.int64),
            vehicles=np.zeros(0, np.bool_),
            seen_ns=np.zeros(0, np.int64),
            heading_votes=np.zeros(0),
            votes=np.zeros((0, 0)),
            supports=np.zeros(0, np.uint8),
        )

    def copied(self) -> "Population":
        """The same objects, to be changed in place."""
        kept: dict[str, Any] = {}
        for name in _COLUMNS:
            value = getattr(self, name)
            kept[name] = dict(value) if isinstance(value, dict) else value.copy()
        return Population(**kept)

    def select(self, rows: Int64Array | BoolArray) -> "Population":
        """Some of the objects."""
        kept: dict[str, Any] = {}
        for name in _COLUMNS:
            value = getattr(self, name)
            kept[name] = {k: v[rows] for k, v in value.items()} if isinstance(value, dict) else value[rows]
        return Population(**kept)

    def joined(self, others: "Population") -> "Population":
        """These objects and others, whose words are the same."""
        kept: dict[str, Any] = {}
        for name in _COLUMNS:
            own, other = getattr(self, name), getattr(others, name)
            if isinstance(own, dict):
                kept[name] = {
                    k: np.concatenate([own.get(k, no_boxes(len(self))), other.get(k, no_boxes(len(others)))])
                    for k in {**own, **other}
                }
            else:
                kept[name] = np.concatenate([own, other])
        return Population(**kept)


_COLUMNS = tuple(f.name for f in fields(Population))


def no_boxes(count: int) -> Float64Array:
    """(N, 4) float64 of NaN."""
    return np.full((count, 4), np.nan)
