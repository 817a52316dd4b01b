"""How well all frames agree with a candidate, by several measures, each summed over parts of the images.

Source: mutual information of intensity and grey: Pandey, McBride, Savarese and Eustice 2012, "Automatic Targetless
Extrinsic Calibration of a 3D Lidar and Camera by Maximizing Mutual Information"; over levels that are equally frequent
it is, but for a constant, the normalised information distance that Taylor and Nieto 2012 use. Linear B-splines as the
Parzen window: Unser and Thévenaz 2000.
"""

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.measures.candidate import Change
from sceneloom.calibrate.measures.features import TILES, FrameFeatures, extract, project_features
from sceneloom.calibrate.measures.images import LEVELS, MeasuredImage
from sceneloom.kernels.agreement import fill_histogram, sum_by_table, sum_edges

EDGES, EDGES_COARSE, INFORMATION = "edges", "edges-coarse", "information"
MEASURES = (EDGES, EDGES_COARSE, INFORMATION)
"""The measures; of all of them more is better."""

_WIDTHS = {EDGES: "fine", EDGES_COARSE: "coarse"}
_SMOOTHED_BINS = 0.7
_THINNED = 3
"""One feature of so many reports well enough where to look next."""
_LEAST_SHARE = 0.25
"""Of the features that fall into the images under the stated calibration, so many must do so under a candidate."""


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """What one candidate came to, by cells: tiles of the images of one view.

    Attributes:
        sums: (M, C) float64, by measure and cell.
        totals: (M, C) float64, weight of the features behind each sum.
    """

    sums: Float64Array
    totals: Float64Array

    def values(self, weights: Float64Array | None = None) -> Float64Array:
        """Give means by measure, (M,), or (B, M) for weights (B, C) of the cells; NaN where nothing was measured."""
        sums, totals = (
            (self.sums.sum(axis=1), self.totals.sum(axis=1))
            if weights is None
            else (weights @ self.sums.T, weights @ self.totals.T)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(totals > 0, sums / totals, np.nan))


class Agreement:
    """Scores candidates by all frames.

    Attributes:
        features: what was taken from the frames.
        views: (F,) int64, which frames show nearly the same.
        cells: number of cells.
    """

    def __init__(
        self,
        frames: Sequence[CalibrationFrame],
        views: Int64Array | None = None,
        *,
        images: Sequence[MeasuredImage | None] | None = None,
    ) -> None:
        """Take the features of the frames.

        Args:
            views: (F,) int64, which frames show nearly the same; None: each another.
            images: of the frames, where they were measured before.
        """
        measured = (None,) * len(frames) if images is None else images
        self.features: tuple[FrameFeatures, ...] = tuple(map(extract, frames, measured))
        self.views = np.arange(len(frames)) if views is None else views
        self.cells = TILES * (int(self.views.max(initial=0)) + 1)

    @cached_property
    def _stated_totals(self) -> Float64Array:
        totals: Float64Array = self._score(Change()).totals.sum(axis=1)
        return totals

    @cached_property
    def _thinned(self) -> "Agreement":
        """The same by some of the features, for a first look."""
        thinned = copy(self)
        thinned.features = tuple(features.thinned(_THINNED) for features in self.features)
        return thinned

    def score(
        self,
        change: Change,
        measures: Collection[str] = MEASURES,
        *,
        by_cells: bool = False,
        rough: bool = False,
    ) -> Score:
        """Score a candidate; a measure whose features have mostly left the images has no value.

        Args:
            measures: the only ones to be taken; the others have no value.
            by_cells: share out the information among the cells, which takes longer; else the first one has it all.
            rough: by some of the features only.
        """
        if rough:
            return self._thinned.score(change, measures, by_cells=by_cells)
        score = self._score(change, measures, by_cells=by_cells)
        few = score.totals.sum(axis=1) < _LEAST_SHARE * self._stated_totals
        if not few.any():
            return score
        return Score(np.where(few[:, None], 0.0, score.sums), np.where(few[:, None], 0.0, score.totals))

    def _score(
        self, change: Change, measures: Collection[str] = MEASURES, *, by_cells: bool = False
    ) -> Score:
        sums, totals = np.zeros((len(MEASURES), self.cells)), np.zeros((len(MEASURES), self.cells))
        placed = []
        histogram = np.zeros((LEVELS, LEVELS))
        for features, view in zip(self.features, self.views.tolist(), strict=True):
            own = slice(view * TILES, (view + 1) * TILES)
            placing = (
                change.camera_from_points(features.frame),
                change.camera_model(features.image.camera_model),
            )
            ids, pixels = project_features(features, features.edge_points, *placing)
            for row, name in enumerate(MEASURES):
                if name in _WIDTHS and name in measures:
                    sum_edges(
                        ids, pixels, features.edge_kinds, features.edge_weights, features.edge_cells,
                        features.image.edges[_WIDTHS[name]], sums[row, own], totals[row, own],
                    )  # fmt: skip
            if INFORMATION not in measures:
                continue
            ids, pixels = project_features(features, features.level_points, *placing)
            fill_histogram(ids, pixels, features.levels, features.image.levels, histogram)
            placed.append((features, own, ids, pixels))
        row = MEASURES.index(INFORMATION)
        table = pointwise_information(histogram)
        if not by_cells:
            # bins share points as the table shares its numbers, so that all points together need no second look
            sums[row, 0], totals[row, 0] = (histogram * table).sum(), histogram.sum()
            return Score(sums, totals)
        for features, own, ids, pixels in placed:
            sum_by_table(
                ids, pixels, features.levels, features.level_cells, features.image.levels, table,
                sums[row, own], totals[row, own],
            )  # fmt: skip
        return Score(sums, totals)


def pointwise_information(histogram: Float64Array) -> Float64Array:
    """Give log p(a, b) / (p(a) p(b)) [nat] from counts (B, B); its mean over the points is the mutual information."""
    total = histogram.sum()
    if total <= 0:
        return np.zeros_like(histogram)
    joint = ndimage.gaussian_filter(histogram, _SMOOTHED_BINS, mode="nearest") / total
    joint = (joint + 1e-6) / (joint + 1e-6).sum()
    table: Float64Array = np.log(joint / np.outer(joint.sum(axis=1), joint.sum(axis=0)))
    return table
