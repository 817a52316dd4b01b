r"""Several cameras and one sweep: the objects that each image and the sweep gave, as one list.

A box of the sweep is one object, however many images show it. Given what is there, images err independently of one
another, so each adds what it changed in the logarithm of odds that the sweep alone gave,

    log odds(e | sweep, images) = log odds(e | sweep) + Σ [log odds(e | sweep, image c) - log odds(e | sweep)].

An image that does not show its location adds nothing. The object is where the image says that knows its middle best.

Objects of images alone are one where two images may be seeing the same thing: classes may be the same, and the
locations agree within their covariances (Mahalanobis' distance, the best assignment camera by camera). Their distances
are guesses by the same usual height, so they err alike, and their locations are joined as if nothing were known of
that:

    P⁻¹ = w A⁻¹ + (1 - w) B⁻¹,   P⁻¹ x = w A⁻¹ a + (1 - w) B⁻¹ b,   w that makes P smallest.

That the sweep has no box there counts once: odds(both) = odds(a) odds(b) / [odds(π) (1 - D)], D the share of such
objects that a sweep shows. Objects of one camera are never joined.

Source: Julier and Uhlmann 1997, "A Non-divergent Estimation Algorithm in the Presence of Unknown Correlations", for the
locations; Bayes' theorem under conditional independence for the odds.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, read_only
from sceneloom.detections.detectors import FAMILIES, UNLISTED, numbers_of, table_rows
from sceneloom.detections.results import NO_BOX, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings, tables_of
from sceneloom.errors import OptionError
from sceneloom.kernels import existence as kernels_existence
from sceneloom.scene.detections import Boxes3D, ScoreForm
from sceneloom.scene.types import Identifier

DEFAULTS = ProjectionSettings()

FARTHEST_SQUARED = 11.34
"""Locations whose Mahalanobis' distance squared is more than this are two: 1 in 100 of one object in two images is.

Source: chi-square distribution with 3 degrees of freedom.
"""
_OF_SWEEP = False
_SUREST = 1e-9
_WEIGHTS = np.linspace(0.05, 0.95, 19)
_LEAST_VARIANCE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class MergedBoxes:
    """The objects behind the boxes of one sweep and several images.

    Attributes:
        objects: those of the sweep in the order of its boxes, then those of images alone. `corners_xyxy` and
            `rows_2d` are of the image that `cameras` names.
        cameras: (N,) int64, of which camera's image the box is by which an object is known best, as its location in
            `rows`; NO_BOX where no image has a box of it.
        rows: by camera (N,) int64, which object of that camera's `FusedBoxes` it is, NO_BOX for none.
    """

    objects: FusedBoxes
    cameras: Int64Array
    rows: Mapping[Identifier, Int64Array]

    def __len__(self) -> int:
        return len(self.objects)


def merge_views(
    boxes_3d: Boxes3D, views: Mapping[Identifier, FusedBoxes], *, settings: ProjectionSettings = DEFAULTS
) -> MergedBoxes:
    """Make one list of the objects that a sweep and several images show.

    Args:
        views: by camera, what came of fusing these boxes with those of its image; one at least.
        settings: those by which that was done.

    Raises:
        OptionError: there is no view.
    """
    if not views:
        raise OptionError("no views; expected the fused boxes of one camera or more")
    found = tuple(views.values())
    existence = tables_of(settings).existence
    numbers, sweep = _rows_of_sweep(found)
    alone = _rows_of_images(found)
    rows = np.concatenate([sweep, alone.rows], axis=1)
    best = np.concatenate([_best_of_sweep(found, sweep), alone.best])
    of_sweep = _scores_of_sweep(boxes_3d, numbers, found, sweep, existence)
    picked, first = _picked(found, rows, best), len(numbers)
    objects = replace(
        picked,
        scores=np.concatenate([of_sweep, _scores_of_images(found, alone, existence)]),
        ids=np.arange(rows.shape[1]),
        centers=np.concatenate([picked.centers[:first], alone.centers]),
        center_covariances=np.concatenate([picked.center_covariances[:first], alone.covariances]),
    )
    cameras = np.where(objects.rows_2d == NO_BOX, NO_BOX, best)
    by_camera = {camera_id: read_only(rows[c]) for c, camera_id in enumerate(views)}
    return MergedBoxes(objects, read_only(cameras), MappingProxyType(by_camera))


def _rows_of_sweep(views: tuple[FusedBoxes, ...]) -> tuple[Int64Array, Int64Array]:
    """(N,) int64, the boxes of the sweep, and (C, N), which object of each view they are, NO_BOX for none."""
    numbers = np.unique(np.concatenate([view.rows_3d for view in views]))
    numbers = numbers[numbers != NO_BOX]
    rows = np.full((len(views), len(numbers)), NO_BOX)
    for c, view in enumerate(views):
        of_sweep = np.flatnonzero(view.rows_3d != NO_BOX)
        rows[c, np.searchsorted(numbers, view.rows_3d[of_sweep])] = of_sweep
    return numbers, rows


def _best_of_sweep(views: tuple[FusedBoxes, ...], rows: Int64Array) -> Int64Array:
    """(N,) int64, the view that knows the middle of each object best, one with a box of it before all others."""
    spread = np.full(rows.shape, np.inf)
    for c, view in enumerate(views):
        known = rows[c] != NO_BOX
        kept = rows[c, known]
        traces = np.trace(view.center_covariances[kept], axis1=1, axis2=2)
        # those without a box in the image are behind all that have one, however large
        spread[c, known] = np.where(view.rows_2d[kept] != NO_BOX, -1.0 / (traces + _LEAST_VARIANCE), traces)
    best: Int64Array = np.argmin(spread, axis=0)
    return best


def _scores_of_sweep(
    boxes: Boxes3D, numbers: Int64Array, views: tuple[FusedBoxes, ...], rows: Int64Array, table: Float64Array
) -> Float64Array:
    """(N,) float64, how likely the objects of the sweep are by all images."""
    kinds = table_rows(numbers_of([boxes.labels[k] for k in numbers.tolist()], [])[0])
    is_logit = boxes.score_form is ScoreForm.LOGIT
    own = kernels_existence.reported_odds(boxes.scores, numbers, is_logit, _OF_SWEEP, kinds, table)[1]
    total = own.copy()
    for c, view in enumerate(views):
        known = rows[c] != NO_BOX
        total[known] += _log_odds(view.scores[rows[c, known]]) - own[known]
    return _probabilities(total)


@dataclass(frozen=True, slots=True, eq=False)
class _Alone:
    """Objects of images alone."""

    rows: Int64Array  # (C, M), which object of each view they are
    best: Int64Array  # (M,), the view that knows their location best
    centers: Float64Array  # (M, 3) [m]
    covariances: Float64Array  # (M, 3, 3) [m²]
    labels: tuple[str, ...]


def _rows_of_images(views: tuple[FusedBoxes, ...]) -> _Alone:
    """Join the objects of images alone, camera by camera."""
    count = len(views)
    joined = _Alone(np.zeros((count, 0), np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), ())
    for c, view in enumerate(views):
        joined = _with_view(joined, c, view, np.flatnonzero(view.rows_3d == NO_BOX))
    return joined


def _with_view(joined: _Alone, camera: int, view: FusedBoxes, rows: Int64Array) -> _Alone:
    """Join what has been found with the objects of one more image, and append those that are new."""
    labels = tuple(view.labels[k] for k in rows.tolist())
    centers, covariances = view.centers[rows], view.center_covariances[rows]
    gains = _agreement(joined, centers, covariances, labels)
    first, second = linear_sum_assignment(gains, maximize=True)
    paired = gains[first, second] > 0.0
    first, second = first[paired], second[paired]
    of_known, best = joined.rows.copy(), joined.best.copy()
    known_centers, known_covariances = joined.centers.copy(), joined.covariances.copy()
    of_known[camera, first] = rows[second]
    for i, k in zip(first.tolist(), second.tolist(), strict=True):
        if np.linalg.det(covariances[k]) < np.linalg.det(known_covariances[i]):
            best[i] = camera
        known_centers[i], known_covariances[i] = _intersected(
            known_centers[i], known_covariances[i], centers[k], covariances[k]
        )
    new = np.setdiff1d(np.arange(len(rows)), second)
    of_new = np.full((len(of_known), len(new)), NO_BOX)
    of_new[camera] = rows[new]
    return _Alone(
        np.concatenate([of_known, of_new], axis=1),
        np.concatenate([best, np.full(len(new), camera)]),
        np.concatenate([known_centers, centers[new]]),
        np.concatenate([known_covariances, covariances[new]]),
        (*joined.labels, *(labels[k] for k in new.tolist())),
    )


def _agreement(
    joined: _Alone, centers: Float64Array, covariances: Float64Array, labels: tuple[str, ...]
) -> Float64Array:
    """(M, K) float64, 0 to 1: how well locations agree; 0 where they or the classes are not of one object."""
    if not len(joined.labels) or not len(labels):
        return np.zeros((len(joined.labels), len(labels)))
    apart = joined.centers[:, None] - centers
    spread = joined.covariances[:, None] + covariances + _LEAST_VARIANCE * np.eye(3)
    squares = (apart * np.linalg.solve(spread, apart[..., None])[..., 0]).sum(axis=-1)
    one = _may_be_one(joined.labels, labels) & (squares < FARTHEST_SQUARED)
    gains: Float64Array = np.where(one, 1.0 - squares / FARTHEST_SQUARED, 0.0)
    return gains


def _may_be_one(labels: tuple[str, ...], others: tuple[str, ...]) -> BoolArray:
    """(M, K) bool: classes that are the same, or of one family, or one of which is in no table."""
    first, second = numbers_of(labels, others)
    families, of_others = FAMILIES[table_rows(first)], FAMILIES[table_rows(second)]
    unknown = (first[:, None] >= UNLISTED) | (second >= UNLISTED)
    same: BoolArray = (first[:, None] == second) | (families[:, None] == of_others) | unknown
    return same


def _intersected(
    one: Float64Array, of_one: Float64Array, other: Float64Array, of_other: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """A location by two whose errors may be the same, and its covariance."""
    floor = _LEAST_VARIANCE * np.eye(3)
    first, second = np.linalg.inv(of_one + floor), np.linalg.inv(of_other + floor)
    weights = _WEIGHTS[:, None, None]
    information = weights * first + (1.0 - weights) * second
    k = int(np.argmax(np.linalg.det(information)))
    covariance = np.linalg.inv(information[k])
    reported = _WEIGHTS[k] * first @ one + (1.0 - _WEIGHTS[k]) * second @ other
    return covariance @ reported, (covariance + covariance.T) / 2.0


def _scores_of_images(views: tuple[FusedBoxes, ...], alone: _Alone, table: Float64Array) -> Float64Array:
    """(M,) float64, how likely objects of images alone are by all that show them."""
    kinds = table_rows(numbers_of(alone.labels, [])[0])
    distances = np.linalg.norm(alone.centers, axis=1)
    near = distances <= table[kinds, kernels_existence.FARTHEST_3D]
    # what several images have in common: that such a location is empty, and that the sweep has no box there
    common = table[kinds, kernels_existence.PRIOR] + np.where(
        near, np.log1p(-table[kinds, kernels_existence.RECALL_3D]), 0.0
    )
    total = common.copy()
    for c, view in enumerate(views):
        known = alone.rows[c] != NO_BOX
        total[known] += _log_odds(view.scores[alone.rows[c, known]]) - common[known]
    return _probabilities(total)


def _picked(views: tuple[FusedBoxes, ...], rows: Int64Array, best: Int64Array) -> FusedBoxes:
    """The objects as the view reports that knows each best."""
    chosen = rows[best, np.arange(len(best))]
    starts = np.cumsum([0, *(len(view) for view in views)])[:-1]
    locations = starts[best] + chosen
    columns: dict[str, Any] = {}
    for name in _COLUMNS:
        values = [getattr(view, name) for view in views]
        given = all(value is not None for value in values)
        columns[name] = np.concatenate(values)[locations] if given else None
    labels = [label for view in views for label in view.labels]
    freedom = [view.degrees_of_freedom for view in views if view.degrees_of_freedom is not None]
    return FusedBoxes(
        timestamp_ns=views[0].timestamp_ns,
        labels=tuple(labels[k] for k in locations.tolist()),
        degrees_of_freedom=min(freedom) if freedom else None,
        **columns,
    )


_COLUMNS = (
    *("centers", "center_covariances", "sizes_lwh", "size_covariances", "yaws", "velocities", "scores"),
    *("corners_xyxy", "ids", "rows_3d", "rows_2d", "yaw_variances", "by_points"),
)


def _log_odds(shares: Float64Array) -> Float64Array:
    kept = np.clip(np.where(np.isnan(shares), 0.5, shares), _SUREST, 1.0 - _SUREST)
    odds: Float64Array = np.log(kept / (1.0 - kept))
    return odds


def _probabilities(odds: Float64Array) -> Float64Array:
    shares: Float64Array = 1.0 / (1.0 + np.exp(-odds))
    return shares
