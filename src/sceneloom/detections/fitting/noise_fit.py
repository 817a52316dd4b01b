"""How far off boxes are, fitted: deviations by score and range, and regions that hold what they promise."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.detections.classes import KINDS
from sceneloom.detections.detectors import BoxNoise, Detectors, ImageNoise, Reported
from sceneloom.detections.fitting.examples import Columns, SweepColumns
from sceneloom.detections.fitting.regression import fit_deviations, weighted_quantile
from sceneloom.detections.noise import (
    NEAREST,
    USUAL,
    box_covariances,
    image_sigmas,
    noise_table,
    radius_squared,
)
from sceneloom.detections.refinement import refine

_LEVEL = 0.95
_LEAST_ERRORS = 30
_UNKNOWN = BoxNoise(
    scores=(0.0, 0.0),
    center_base=(-1.0, -1.5, -1.5),
    center_by_score=(0.0, 0.0, 0.0),
    center_by_range=(0.5, 0.5, 0.5),
    size_base=(-1.0, -1.5, -1.5),
    size_by_score=(0.0, 0.0, 0.0),
    size_by_range=(0.5, 0.5, 0.5),
    yaw=(-2.0, 0.0, 0.0),
)
"""Deviations of 20 to 40 cm at 20 m, where too few errors are known."""
_PARTS = (slice(0, 3), slice(3, 6), slice(6, 7))


def fit_noise(columns: SweepColumns, reported: Reported, degrees_of_freedom: float) -> BoxNoise:
    """Fit scales of a Student distribution; `widened` makes covariances of them."""
    rows = np.isfinite(columns.errors).all(axis=1) & np.isfinite(columns.reported)
    if rows.sum() < _LEAST_ERRORS:
        return _UNKNOWN
    far = np.log(np.maximum(columns.distance[rows], NEAREST) / USUAL)
    held = np.clip(columns.reported[rows], reported.low, reported.high)
    features = np.column_stack([np.ones(len(held)), held, far])
    weights = _even(columns.group[rows])
    parts = [
        fit_deviations(
            features,
            columns.errors[rows][:, part],
            weights=weights,
            degrees_of_freedom=degrees_of_freedom,
        )
        for part in _PARTS
    ]
    numbers = [[tuple(column) for column in part.T.tolist()] for part in parts]
    return BoxNoise(
        scores=(reported.low, reported.high),
        center_base=numbers[0][0],
        center_by_score=numbers[0][1],
        center_by_range=numbers[0][2],
        size_base=numbers[1][0],
        size_by_score=numbers[1][1],
        size_by_range=numbers[1][2],
        yaw=(numbers[2][0][0], numbers[2][1][0], numbers[2][2][0]),
    )


def _even(groups: Int64Array) -> Float64Array:
    """Weights by which long drives count more than short ones, but not in proportion."""
    weights: Float64Array = 1.0 / np.sqrt(np.bincount(groups)[groups])
    return weights


def fit_image_noise(columns: SweepColumns) -> ImageNoise:
    """Fit how far partners are off the true outlines: robust deviations in four classes of size, on a line."""
    rows = np.isfinite(columns.apart).all(axis=1)
    if rows.sum() < _LEAST_ERRORS:
        return ImageNoise(across=(2.0, 0.03), upright=(2.0, 0.03), height=(2.0, 0.06))
    apart, sides = columns.apart[rows], columns.sides[rows]
    return ImageNoise(
        across=_line(apart[:, 0], sides[:, 0]),
        upright=_line(apart[:, 1], sides[:, 1]),
        height=_line(apart[:, 2], sides[:, 1]),
    )


_NORMAL = 1.4826
"""A Gaussian's deviation by its median absolute value."""
_LEAST_PX, _LEAST_SHARE = 0.5, 0.01


def _line(apart: Float64Array, sides: Float64Array) -> tuple[float, float]:
    order = np.array_split(np.argsort(sides), 4)
    middles = np.array([sides[rows].mean() for rows in order])
    sigmas = np.array([_NORMAL * np.median(np.abs(apart[rows])) for rows in order])
    share, least = np.polyfit(middles, sigmas, 1)
    share = max(share, _LEAST_SHARE)
    return float(max(np.mean(sigmas - share * middles), least, _LEAST_PX)), float(share)


def widened(columns: Columns, draft: Detectors) -> Detectors:
    """Scale covariances so that their regions hold what they promise, in groups that were left out.

    The squared radius is halfway, as a ratio, between those of a Student distribution and a Gaussian with the same
    covariances, so that neither reading of them is off by much.
    """
    promised = np.sqrt(
        radius_squared(_LEVEL, degrees_of_freedom=draft.degrees_of_freedom)
        * radius_squared(_LEVEL, degrees_of_freedom=float("inf"))
    )
    drafts = _left_out(columns, draft)
    alone = _distances(columns, drafts, by_image=False)
    first = {name: _ratios(columns, name, alone, promised, matched=False) for name in draft.classes}
    drafts = [_scaled(left, first) for left in drafts]
    both = _distances(columns, drafts, by_image=True)
    second = {name: _ratios(columns, name, both, promised, matched=True) for name in draft.classes}
    return _scaled(draft, first, agreed=second)


def _left_out(columns: Columns, draft: Detectors) -> list[Detectors]:
    """For each group what the others state; of a single group there are no others."""
    if len(columns.groups) < 2:
        return [draft]
    return [_refitted(columns.without(group), draft) for group in range(len(columns.groups))]


def _refitted(columns: Columns, draft: Detectors) -> Detectors:
    classes = {}
    for name, own in draft.classes.items():
        rows = columns.sweep.kind == list(KINDS).index(name)
        sweep = SweepColumns(*(column[rows] for column in columns.sweep))
        noise = fit_noise(sweep, own.sweep, draft.degrees_of_freedom)
        classes[name] = replace(own, noise=noise, image_noise=fit_image_noise(sweep))
    return replace(draft, classes=MappingProxyType(classes))


def _distances(columns: Columns, drafts: list[Detectors], *, by_image: bool) -> Float64Array:
    """Squared Mahalanobis distances of the errors of middles, sizes and headings, (N, 3), each by its own group."""
    tables = [noise_table(draft) for draft in drafts]
    found = np.full((len(columns.sweep.kind), 3), np.nan)
    for ready in columns.prepared:
        rows = slice(ready.first, ready.first + len(ready.boxes))
        kinds, reported = columns.sweep.kind[rows], columns.sweep.reported[rows]
        group = int(columns.sweep.group[ready.first]) if len(ready.boxes) else 0
        table = tables[min(group, len(tables) - 1)]
        boxes, none = ready.boxes.copy(), np.zeros((0, 7, 7))
        covariances, of_yaws, _ = box_covariances(boxes, reported, none, np.arange(len(boxes)), kinds, table)
        if by_image:
            refine(
                ready.pair.camera,
                ready.pair.camera_from_lidar,
                ready.outlines,
                boxes,
                covariances,
                ready.partners,
                ready.corners_xyxy,
                image_sigmas(table, kinds),
            )
        errors = columns.sweep.errors[rows].copy()
        _rotation(errors, boxes[:, 6])
        errors[:, :6] += boxes[:, :6] - ready.boxes[:, :6]
        for k, part in enumerate(_PARTS[:2]):
            solved = np.linalg.solve(covariances[:, part, part], errors[:, part, None])[..., 0]
            found[rows, k] = (errors[:, part] * solved).sum(axis=1)
        found[rows, 2] = errors[:, 6] ** 2 / of_yaws
    return found


def _rotation(errors: Float64Array, yaws: Float64Array) -> None:
    """Rotate errors along the axes of boxes into the frame of the boxes; changed."""
    along, across = errors[:, 0].copy(), errors[:, 1].copy()
    errors[:, 0] = np.cos(yaws) * along - np.sin(yaws) * across
    errors[:, 1] = np.sin(yaws) * along + np.cos(yaws) * across


Ratios = tuple[float, float, float]


def _ratios(
    columns: Columns, name: str, distances: Float64Array, promised: float, *, matched: bool
) -> Ratios:
    """By how much covariances of middles, sizes and headings are too small."""
    rows: BoolArray = (columns.sweep.kind == list(KINDS).index(name)) & np.isfinite(distances).all(axis=1)
    if matched:
        rows &= columns.sweep.matched
    if rows.sum() < _LEAST_ERRORS:
        return (1.0, 1.0, 1.0)
    weights, found = np.ones(int(rows.sum())), []
    for k in range(3):
        # of a single number the same rule of thumb, by a Gaussian's square
        limit = promised if k < 2 else promised / 3.0 * _OF_ONE
        found.append(max(weighted_quantile(distances[rows, k], weights, _LEVEL) / limit, _LEAST_RATIO))
    return (found[0], found[1], found[2])


_LEAST_RATIO = 0.01
_OF_ONE = 3.0 * 3.84 / 7.81
"""A Gaussian's 95 % of one number against those of three."""


def _scaled(
    draft: Detectors, ratios: Mapping[str, Ratios], *, agreed: Mapping[str, Ratios] | None = None
) -> Detectors:
    classes = {}
    for name, own in draft.classes.items():
        center, size, yaw = (np.log(ratio) / 2.0 for ratio in ratios[name])
        noise = replace(
            own.noise,
            center_base=_plus(own.noise.center_base, center),
            size_base=_plus(own.noise.size_base, size),
            yaw=(own.noise.yaw[0] + float(yaw), *own.noise.yaw[1:]),
        )
        if agreed is not None:
            noise = replace(noise, agreed=(agreed[name][0], agreed[name][1]))
        classes[name] = replace(own, noise=noise)
    return replace(draft, classes=MappingProxyType(classes))


def _plus(three: tuple[float, float, float], more: float) -> tuple[float, float, float]:
    return (three[0] + float(more), three[1] + float(more), three[2] + float(more))
