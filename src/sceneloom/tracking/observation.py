"""What a tracker observes at one moment: fused boxes in the world, image boxes, and where the sensors were."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.detections.detectors import KINDS, SAYS_NOTHING, kind_name
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import NO_BOX, DetectionAlgorithm, DetectionPair, FusedBoxes
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera at one moment.

    Attributes:
        camera: its camera model.
        camera_from_lidar: takes the lidar's frame at the time of the sweep into the camera's at that of its image.
    """

    camera: Camera
    camera_from_lidar: RigidTransform


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What was seen at one moment.

    Attributes:
        timestamp_ns: of the sweep [ns].
        world_from_lidar: takes the lidar's frame at that time into a world that is stationary, z up.
        fused: by camera, the objects behind the boxes of the sweep and those of that camera's image. A box of the
            sweep is in each of them, and known by its number in `rows_3d`. Nothing was looked at where it is empty.
        views: the cameras by which boxes are put into images. A camera of `fused` without one has no images: what
            is stated for its sweep counts, and no box in an image is given.
    """

    timestamp_ns: int
    world_from_lidar: RigidTransform
    fused: Mapping[Identifier, FusedBoxes] = field(default_factory=dict)
    views: Mapping[Identifier, View] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "fused", MappingProxyType(dict(self.fused)))
        object.__setattr__(self, "views", MappingProxyType(dict(self.views)))

    @classmethod
    def of_pairs(
        cls,
        pairs: Mapping[Identifier, DetectionPair],
        world_from_lidar: RigidTransform,
        *,
        fuse: DetectionAlgorithm = fuse_by_projection,
    ) -> Self:
        """Fuse the boxes of one sweep with those of each camera's image.

        Args:
            pairs: by camera, the same boxes of the sweep with those of its image; one at least.
            world_from_lidar: where the lidar was at the time of the sweep.
            fuse: how.

        Raises:
            OptionError: the boxes of the sweep are not in the lidar's frame.
        """
        return cls(
            next(iter(pairs.values())).boxes_3d.timestamp_ns,
            world_from_lidar,
            {camera_id: fuse(pair) for camera_id, pair in pairs.items()},
            {camera_id: View(pair.camera, pair.camera_from_lidar) for camera_id, pair in pairs.items()},
        )


_FAMILIES = {family: k for k, family in enumerate(dict.fromkeys(kind.family for kind in KINDS.values()))}

_VEHICLES = _FAMILIES[KINDS["car"].family]

_ANY = -1

_numbers: dict[str, int] = {}


@lru_cache(maxsize=4096)
def _code(label: str) -> tuple[int, int]:
    name = kind_name(label)
    if name in SAYS_NOTHING:
        return _ANY, _ANY
    kind = KINDS.get(name)
    return _numbers.setdefault(name, len(_numbers)), _ANY if kind is None else _FAMILIES[kind.family]


def _codes_of(labels: Sequence[str]) -> Int64Array:
    """Give classes as (N, 2) int64: a number of the class and one of its family, -1 for none."""
    return np.array([_code(label) for label in labels], np.int64).reshape(-1, 2)


def _is_vehicle(codes: Int64Array) -> BoolArray:
    """Which classes move along their heading as cars do, (N,) bool of (N, 2) codes."""
    vehicles: BoolArray = codes[:, 1] == _VEHICLES
    return vehicles


SUREST = 1e-4
"""No single moment makes surer of what is there or not than this."""

UNKNOWN_VARIANCE = 1e4
"""Of what a box does not report."""

_VEHICLE_YAW_SIGMA, _PERSON_YAW_SIGMA = 0.1, 0.4
"""Deviation of headings whose fusion does not give it [rad]."""

_SEEN_ALONG = 9.0
"""Of a box of images alone: how often its variance along the visibility is taken. The same guess of the object's height
errs the same way every time."""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The boxes of one moment.

    Attributes:
        measures: (M, 7) float64, middle [m], length, width, height [m] and heading [rad], world frame.
        covariances: (M, 7, 7) float64 of these, with `UNKNOWN_VARIANCE` where it is not reported.
        measured: (M,) bool, whether a box of the sweep is behind it.
        log_odds: (M,) float64, of existence by this moment's boxes alone.
        labels: M classes.
        codes: (M, 2) int64, of the class and its family.
        vehicles: (M,) bool.
        corners_xyxy: by camera, (M, 4) float64 [px], NaN where no box of its image is behind it.
        velocities: (M, 3) float64 [m/s], world frame, NaN where not reported.
    """

    measures: Float64Array
    covariances: Float64Array
    measured: BoolArray
    log_odds: Float64Array
    labels: tuple[str, ...]
    codes: Int64Array
    vehicles: BoolArray
    corners_xyxy: dict[Identifier, Float64Array]
    velocities: Float64Array

    def __len__(self) -> int:
        return len(self.measures)


def visibility(observation: Observation) -> Observations:
    """Give the boxes of all cameras' fusions in the world frame, those of the sweep once each."""
    parts = [
        (camera_id, fused, np.flatnonzero(_sound(fused))) for camera_id, fused in observation.fused.items()
    ]
    parts = [part for part in parts if len(part[2])]
    if not parts:
        return _observations([], observation.world_from_lidar)
    rows = _each_once(parts)
    return _observations(
        [(camera_id, fused, kept) for (camera_id, fused, _), kept in zip(parts, rows, strict=True)],
        observation.world_from_lidar,
        {camera_id: fused for camera_id, fused, _ in parts},
    )


def _sound(fused: FusedBoxes) -> BoolArray:
    """Which boxes have a location, a size and covariances."""
    numbers = np.concatenate(
        [
            fused.centers,
            fused.sizes_lwh,
            fused.yaws[:, None],
            fused.center_covariances.reshape(-1, 9),
            fused.size_covariances.reshape(-1, 9),
        ],
        axis=1,
    )
    sound: BoolArray = np.isfinite(numbers).all(axis=1) & (fused.sizes_lwh > 0.0).all(axis=1)
    return sound


_Part = tuple[Identifier, FusedBoxes, Int64Array]


def _each_once(parts: list[_Part]) -> list[Int64Array]:
    """Of every box of the sweep the one camera's fusion that knows most: one with a partner, else the most doubtful.

    A camera that should have seen an object and did not makes it doubtful; one that could not says nothing.
    """
    if len(parts) == 1:
        return [parts[0][2]]
    best: dict[int, tuple[tuple[bool, float, int], int]] = {}
    kept: list[list[int]] = [[] for _ in parts]
    for p, (_, fused, rows) in enumerate(parts):
        for row in rows.tolist():
            number = int(fused.rows_3d[row])
            if number == NO_BOX:
                kept[p].append(row)
                continue
            rank = (fused.rows_2d[row] == NO_BOX, float(fused.scores[row]), p)
            if number not in best or rank < best[number][0]:
                best[number] = rank, row
    for rank, row in best.values():
        kept[rank[2]].append(row)
    return [np.array(sorted(rows), np.int64) for rows in kept]


def _observations(
    parts: list[_Part],
    world_from_lidar: RigidTransform,
    all_fused: dict[Identifier, FusedBoxes] | None = None,
) -> Observations:
    columns = [_columns(fused, rows, world_from_lidar) for _, fused, rows in parts]
    labels = tuple(fused.labels[k] for _, fused, rows in parts for k in rows.tolist())
    stacked: dict[str, Any] = {
        name: np.concatenate([c[name] for c in columns]) if columns else empty
        for name, empty in _EMPTY.items()
    }
    numbers = stacked.pop("rows_3d")
    codes = _codes_of(labels)
    return Observations(
        labels=labels,
        codes=codes,
        vehicles=_is_vehicle(codes),
        corners_xyxy=_corners(parts, numbers, all_fused or {}),
        **stacked,
    )


def _corners(
    parts: list[_Part], numbers: Int64Array, all_fused: dict[Identifier, FusedBoxes]
) -> dict[Identifier, Float64Array]:
    """Of each camera the boxes of its image, also of boxes of the sweep that another camera's fusion reports."""
    corners, start = {}, 0
    for camera_id, _, rows in parts:
        fused = all_fused[camera_id]
        boxes = np.full((len(numbers), 4), np.nan)
        paired = fused.rows_2d[rows] != NO_BOX
        boxes[start : start + len(rows)][paired] = fused.corners_xyxy[rows[paired]]
        start += len(rows)
        if len(parts) > 1:
            both = np.flatnonzero((fused.rows_3d != NO_BOX) & (fused.rows_2d != NO_BOX))
            location = {int(fused.rows_3d[k]): k for k in both.tolist()}
            for i, number in enumerate(numbers.tolist()):
                if number in location:
                    boxes[i] = fused.corners_xyxy[location[number]]
        corners[camera_id] = boxes
    return corners


def _columns(fused: FusedBoxes, rows: Int64Array, world_from_lidar: RigidTransform) -> dict[str, Any]:
    measured = fused.rows_3d[rows] != NO_BOX
    rotation = world_from_lidar.rotation
    yaws, covariances = fused.yaws[rows], np.zeros((len(rows), 7, 7))
    centers = fused.center_covariances[rows]
    alone = np.flatnonzero(~measured)
    if len(alone):
        centers[alone] = _stretched(centers[alone], fused.centers[rows[alone]])
    covariances[:, :3, :3] = rotation @ centers @ rotation.T
    covariances[:, 3:6, 3:6] = fused.size_covariances[rows]
    covariances[:, 6, 6] = _yaw_variances(fused, rows)
    covariances[alone, 6, 6] = UNKNOWN_VARIANCE
    directions = np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(len(yaws))]) @ rotation.T
    scores = np.clip(np.nan_to_num(fused.scores[rows], nan=0.5), SUREST, 1.0 - SUREST)
    velocities = np.full((len(rows), 3), np.nan)
    if fused.velocities is not None:
        velocities[measured] = fused.velocities[rows[measured]] @ rotation.T
    return {
        "measures": np.column_stack(
            [
                world_from_lidar.apply(fused.centers[rows]),
                fused.sizes_lwh[rows],
                np.arctan2(directions[:, 1], directions[:, 0]),
            ]
        ),
        "covariances": covariances,
        "measured": measured,
        "log_odds": np.log(scores / (1.0 - scores)),
        "velocities": velocities,
        "rows_3d": fused.rows_3d[rows],
    }


def _stretched(covariances: Float64Array, centers: Float64Array) -> Float64Array:
    """The covariances, wider along the visibility."""
    rays = centers / np.maximum(np.linalg.norm(centers, axis=1, keepdims=True), 1e-9)
    along = np.einsum("ni,nij,nj->n", rays, covariances, rays)
    wider: Float64Array = covariances + ((_SEEN_ALONG - 1.0) * along)[:, None, None] * (
        rays[:, :, None] * rays[:, None]
    )
    return wider


def _yaw_variances(fused: FusedBoxes, rows: Int64Array) -> Float64Array:
    vehicles = _is_vehicle(_codes_of([fused.labels[k] for k in rows.tolist()]))
    variances: Float64Array = np.where(vehicles, _VEHICLE_YAW_SIGMA, _PERSON_YAW_SIGMA) ** 2
    stated: Float64Array | None = getattr(fused, "yaw_variances", None)
    if stated is not None:
        sound = np.isfinite(stated[rows]) & (stated[rows] > 0.0)
        variances[sound] = stated[rows[sound]]
    return variances


_EMPTY: dict[str, Any] = {
    "measures": np.zeros((0, 7)),
    "covariances": np.zeros((0, 7, 7)),
    "measured": np.zeros(0, np.bool_),
    "log_odds": np.zeros(0),
    "velocities": np.zeros((0, 3)),
    "rows_3d": np.zeros(0, np.int64),
}
