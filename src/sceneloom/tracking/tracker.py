"""The multi-object tracker: states, observations, association and existence.

A state is x = (middle 3, size 3, heading, velocity 3, yaw rate), in the world. Between moments objects keep their
velocity, which of vehicles rotates with them, and their yaw rate, which dies down; white noise of the acceleration
makes that uncertain, so that one long step leaves as much doubt as many short ones. A box z of the middle, size and
heading is read by Kalman's update,

    K = P Hᵀ (H P Hᵀ + w R)⁻¹,   x' = x + K (z - H x),   P' = P - K H P,   w = max(1, (ν + d²) / (ν + 7)),

where d² is the square of Mahalanobis' distance of the box and ν degrees of freedom: a box that is far off is taken for
less sure. A vehicle moves along its heading: that its velocity across is 0 is one more thing that is read of it.

Source: Kalman 1960; Bar-Shalom, Li and Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation",
ch. 6.2 for the noise and ch. 11.7 for rotating; Lange, Little and Taylor 1989, "Robust Statistical Modeling Using the t
Distribution", for the weight.

The probability p that an object exists falls with time, as objects leave, p ← p exp(-t / lifetime). A box of the object
with the probability s of its own moment, where π is the prior one, changes the odds of p to

    odds ← max(odds · ([s / (1 - s)] / [π / (1 - π)])ʷ, s / (1 - s)),

and a moment without any box, where detectors had the chances D to find it, to

    odds ← odds · (1 - D_2d) (1 - D_3d).

The exponent w is below 1 since moments are not independent: what was mistaken once is likely to be again. That is why
p decides what is followed, but counts only by `_HISTORY` in the score that is stated, beside s of the last box and what
the moments since took from it. Of an object that is not seen it falls by how likely the stated place is off by more
than a third of the width, where boxes overlap by half.

Source: Thrun, Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2 for log odds; Musicki, Evans and Stankovic 1994,
"Integrated Probabilistic Data Association", for existence that is lost with time and by missed detections.

The box that people draw is not the outline of the box in space: they leave out arms. How it differs changes slowly: its
middle by shares of the outline's sides, its sides by factors. These four numbers return to what is usual within seconds
and vary around it by what is measured (`ImageNoise`) and what the state leaves open. They are filtered by the
detector's boxes, whose errors are measured likewise.

Poses of an ego leap where fixes correct them. No vehicle changes its velocity as quickly as that looks, so a step that
would need more than `_MOST_ACCELERATION` counts as the one before, and what is left of it moves the world.

A box z is rather of an object whose location x is foreseen than of anything else by the logarithm of

    t(z - x; S) / λ · s / (1 - s) · t(1 - o; σ) / t(1 - o₀; σ).

S is the covariance of both on the ground, t a distribution with tails like Student's, since detectors are sometimes far
off; λ is how many boxes of other things lie around; the odds of the box's own score s count where they are below 1; o
is the overlap of the box in the image with the one that is foreseen there, and o₀ the one that says nothing. So an
object that was not seen for long, whose location is vague, does not take every box around. Of all ways to pair boxes
with objects the one is taken whose logarithms add up to the most; what is below 0 is no pair.

Source: Reid 1979, "An Algorithm for Tracking Multiple Targets", eq. 16 for the ratio with the density; Bar-Shalom, Li
and Kirubarajan 2001, ch. 2.6; Lange, Little and Taylor 1989, "Robust Statistical Modeling Using the t Distribution".

Detectors know the axis of a box better than its front, and the outline in an image is the same both ways round. Each
box votes for its own heading, each moment of motion for its direction; the sum is remembered. Neighbours of the lane
whose heading is known are asked anew each time, and count only where the rest is undecided.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.special import erf

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_projection import widest_angle
from sceneloom.detections.detectors import KINDS, SAYS_NOTHING, kind_name
from sceneloom.detections.projection import Outlines, assign_pairs, differences, fuse_by_projection, project_outlines
from sceneloom.detections.results import NO_BOX, DetectionAlgorithm, DetectionPair, FusedBoxes
from sceneloom.detections.settings import existence_table, find_detectors, statistics_of
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import existence
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.overlaps import box_area, common_area
from sceneloom.kernels.signatures import inlined, part
from sceneloom.scene.detections import Support, TrackedObjects
from sceneloom.scene.types import Identifier
from sceneloom.tracking.settings import ImageBox, TrackerSettings


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


class _Statistics(NamedTuple):
    """What detectors are like with people and vehicles, a row each."""

    prior_log_odds: Float64Array  # (2,)
    recalls: Float64Array  # (2, 2), of images and sweeps
    least_heights: Float64Array  # (2,) [px]
    farthest: Float64Array  # (2,) [m]
    usual: Float64Array  # (2, 4) of `differences`
    spreads: Float64Array  # (2, 4), variances
    errors: Float64Array  # (2, 4), variances
    lasting: Float64Array  # (2, 6, 6), of covariances of middles and sizes


@lru_cache(maxsize=64)
def _statistics(settings: TrackerSettings) -> _Statistics:
    detectors, names = find_detectors(settings.detectors), ("pedestrian", "car")
    known = [statistics_of(detectors, name) for name in names]
    table = existence_table(detectors, recall_2d=settings.recall_2d, recall_3d=settings.recall_3d)
    table = table[[list(KINDS).index(name) for name in names]]
    weak, noises = table[:, existence.WEAK_SHARE], [own.image_noise for own in known]
    found_2d = (1.0 - weak) * table[:, existence.RECALL_2D] + weak * table[:, existence.WEAK_RECALL_2D]
    return _Statistics(
        table[:, existence.PRIOR],
        np.column_stack([found_2d, table[:, existence.RECALL_3D]]),
        table[:, existence.HIGH_PX],
        table[:, existence.FARTHEST_3D],
        np.array([n.usual for n in noises]),
        np.array([n.spread for n in noises]) ** 2,
        np.array([n.error for n in noises]) ** 2,
        np.array([np.kron(np.diag(own.noise.lasting), np.ones((3, 3))) for own in known]),
    )


_SUREST = 1e-4  # no single moment makes surer of what is there or not than this

UNKNOWN_VARIANCE = 1e4
"""Of what a box does not report."""

_VEHICLE_YAW_SIGMA, _PERSON_YAW_SIGMA = 0.1, 0.4  # deviation of headings whose fusion does not give it [rad]

_SEEN_ALONG = 9.0
"""Of a box of images alone: how often its variance along the ray is taken. The same guess of the object's height
errs the same way every time."""


@dataclass(frozen=True, slots=True, eq=False)
class _Observations:
    """The boxes of one moment."""

    measures: Float64Array  # (M, 7), middle [m], length, width, height [m] and heading [rad], world frame
    covariances: Float64Array  # (M, 7, 7) of these, with `UNKNOWN_VARIANCE` where it is not reported
    measured: BoolArray  # (M,), whether a box of the sweep is behind it
    log_odds: Float64Array  # (M,), of existence by this moment's boxes alone
    labels: tuple[str, ...]
    codes: Int64Array  # (M, 2), of the class and its family
    vehicles: BoolArray  # (M,)
    corners_xyxy: dict[Identifier, Float64Array]  # (M, 4) [px], NaN without a box of its image
    velocities: Float64Array  # (M, 3) [m/s], world frame, NaN where not reported

    def __len__(self) -> int:
        return len(self.measures)


def observed(observation: Observation) -> _Observations:
    """The boxes of all cameras' fusions in the world frame, those of the sweep once each."""
    parts = [(camera_id, fused, np.flatnonzero(_sound(fused))) for camera_id, fused in observation.fused.items()]
    parts = _each_once([part for part in parts if len(part[2])])
    columns = [_columns(fused, rows, observation.world_from_lidar) for _, fused, rows in parts]
    stacked: dict[str, Any] = {
        name: np.concatenate([empty, *(found[name] for found in columns)]) for name, empty in _EMPTY.items()
    }
    labels = tuple(fused.labels[k] for _, fused, rows in parts for k in rows.tolist())
    corners_xyxy, vehicles = _corners(parts, stacked.pop("rows_3d")), _is_vehicle(stacked["codes"])
    return _Observations(labels=labels, vehicles=vehicles, corners_xyxy=corners_xyxy, **stacked)


def _sound(fused: FusedBoxes) -> BoolArray:
    """Which boxes have a position, a size and covariances."""
    sound: BoolArray = (fused.sizes_lwh > 0.0).all(axis=1) & np.isfinite(fused.yaws)
    for values in (fused.centers, fused.sizes_lwh, fused.center_covariances, fused.size_covariances):
        sound &= np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    return sound


def _each_once(
    parts: list[tuple[Identifier, FusedBoxes, Int64Array]],
) -> list[tuple[Identifier, FusedBoxes, Int64Array]]:
    """Of every box of the sweep the one camera's fusion that knows most: one with a partner, else the most doubtful."""
    # a camera that should have seen an object and did not makes it doubtful; one that could not says nothing
    if len(parts) <= 1:
        return parts
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
    rows_of = (np.array(sorted(rows), np.int64) for rows in kept)
    return [(camera_id, fused, rows) for (camera_id, fused, _), rows in zip(parts, rows_of, strict=True)]


def _corners(
    parts: list[tuple[Identifier, FusedBoxes, Int64Array]], numbers: Int64Array
) -> dict[Identifier, Float64Array]:
    """Of each camera the boxes of its image, also of boxes of the sweep that another camera's fusion reports."""
    corners, start = {}, 0
    for camera_id, fused, rows in parts:
        boxes = np.full((len(numbers), 4), np.nan)
        paired = fused.rows_2d[rows] != NO_BOX
        boxes[start : start + len(rows)][paired] = fused.corners_xyxy[rows[paired]]
        start += len(rows)
        if len(parts) > 1:
            both = np.flatnonzero((fused.rows_3d != NO_BOX) & (fused.rows_2d != NO_BOX))
            row_of = {int(fused.rows_3d[k]): k for k in both.tolist()}
            for i, number in enumerate(numbers.tolist()):
                if number in row_of:
                    boxes[i] = fused.corners_xyxy[row_of[number]]
        corners[camera_id] = boxes
    return corners


def _columns(fused: FusedBoxes, rows: Int64Array, world_from_lidar: RigidTransform) -> dict[str, Any]:
    measured = fused.rows_3d[rows] != NO_BOX
    rotation, codes = world_from_lidar.rotation, _codes_of([fused.labels[k] for k in rows.tolist()])
    yaws, covariances = fused.yaws[rows], np.zeros((len(rows), 7, 7))
    centers = fused.center_covariances[rows]
    alone = np.flatnonzero(~measured)
    if len(alone):  # wider along the ray
        rays = fused.centers[rows[alone]]
        rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
        along = np.einsum("ni,nij,nj->n", rays, centers[alone], rays)
        centers[alone] += ((_SEEN_ALONG - 1.0) * along)[:, None, None] * (rays[:, :, None] * rays[:, None])
    covariances[:, :3, :3] = rotation @ centers @ rotation.T
    covariances[:, 3:6, 3:6] = fused.size_covariances[rows]
    covariances[:, 6, 6] = _yaw_variances(fused, rows, _is_vehicle(codes))
    covariances[alone, 6, 6] = UNKNOWN_VARIANCE
    scores = np.clip(np.nan_to_num(fused.scores[rows], nan=0.5), _SUREST, 1.0 - _SUREST)
    velocities = np.full((len(rows), 3), np.nan)
    if fused.velocities is not None:
        velocities[measured] = fused.velocities[rows[measured]] @ rotation.T
    measures = np.empty((len(rows), 7))
    measures[:, :3], measures[:, 3:6] = world_from_lidar.apply(fused.centers[rows]), fused.sizes_lwh[rows]
    measures[:, 6] = _rotated(yaws, rotation)
    return {
        "measures": measures,
        "covariances": covariances,
        "codes": codes,
        "measured": measured,
        "log_odds": np.log(scores / (1.0 - scores)),
        "velocities": velocities,
        "rows_3d": fused.rows_3d[rows],
    }


def _rotated(yaws: Float64Array, rotation: Float64Array) -> Float64Array:
    """Headings (N,) [rad] in the frame that a rotation leads to."""
    x, y = np.cos(yaws), np.sin(yaws)
    rotated: Float64Array = np.arctan2(rotation[1, 0] * x + rotation[1, 1] * y, rotation[0, 0] * x + rotation[0, 1] * y)
    return rotated


def _yaw_variances(fused: FusedBoxes, rows: Int64Array, vehicles: BoolArray) -> Float64Array:
    variances: Float64Array = np.where(vehicles, _VEHICLE_YAW_SIGMA, _PERSON_YAW_SIGMA) ** 2
    stated: Float64Array | None = getattr(fused, "yaw_variances", None)
    if stated is not None:
        sound = np.isfinite(stated[rows]) & (stated[rows] > 0.0)
        variances[sound] = stated[rows[sound]]
    return variances


_EMPTY: dict[str, Any] = {
    "measures": np.zeros((0, 7)),
    "covariances": np.zeros((0, 7, 7)),
    "codes": np.zeros((0, 2), np.int64),
    "measured": np.zeros(0, np.bool_),
    "log_odds": np.zeros(0),
    "velocities": np.zeros((0, 3)),
    "rows_3d": np.zeros(0, np.int64),
}

SIZE, _MEASURED = 11, 7
YAW, ROTATION = 6, 10

_FREEDOM = 4.0  # degrees of freedom of what boxes are off
_CLIMB = 0.15  # how much vertical velocities change [m/s after a second]
_SIZE_DRIFT = 0.02  # how much sizes change as objects are seen from other sides [m after a second]

_VEHICLE_HEADING_DRIFT, _PERSON_HEADING_DRIFT = 0.02, 0.5
"""How much headings change beside rotating [rad after a second]."""

_ACROSS = 0.3  # acceleration of vehicles across their heading, as a share of that along it
_ROTATION_TIME = 1.0  # time after which a rotation has died down [s]


def wrapped(angles: Float64Array) -> Float64Array:
    """Angles as those from -π to π."""
    result: Float64Array = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return result


def predicted(
    means: Float64Array, covariances: Float64Array, vehicles: BoolArray, seconds: float, settings: TrackerSettings
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Move states (N, 11) and their covariances (N, 11, 11) on by so many seconds.

    `vehicles` (N,) are those that move as vehicles do. Gives means and covariances afterwards, and the slopes (N, 11,
    11) of the means.
    """
    fast, slow = settings.vehicle_acceleration, settings.person_acceleration
    rotating = settings.yaw_acceleration
    deviations = np.array(
        [
            [slow, slow, _CLIMB, _SIZE_DRIFT, _PERSON_HEADING_DRIFT, rotating],
            [fast, _ACROSS * fast, _CLIMB, _SIZE_DRIFT, _VEHICLE_HEADING_DRIFT, rotating],
        ]
    )
    moved: tuple[Float64Array, Float64Array, Float64Array] = _predict(
        means, covariances, vehicles, seconds, _ROTATION_TIME, deviations**2
    )
    return moved


def probabilities(log_odds: Float64Array) -> Float64Array:
    """Give logarithms of odds as probabilities."""
    shares: Float64Array = 1.0 / (1.0 + np.exp(-log_odds))
    return shares


@lru_cache(maxsize=64)
def log_odds(share: float) -> float:
    """Give a probability between 0 and 1 as a logarithm of odds."""
    with np.errstate(divide="ignore"):
        return float(np.log(share) - np.log1p(-share))


def aged(odds: Float64Array, seconds: float, lifetime: float) -> Float64Array:
    """Logarithms of odds after so long without a look."""
    likely = probabilities(odds) * np.exp(-seconds / lifetime)
    older: Float64Array = np.log(likely / (1.0 - likely)) if seconds > 0.0 else odds
    return older


def missed(lines: Outlines, distances: Float64Array, vehicles: BoolArray, settings: TrackerSettings) -> Float64Array:
    """How little it says of each object that neither detector finds it, by what one camera sees: logarithms of 1 - D.

    `lines` are where the image shows the objects, `distances` (N,) [m] are from the lidar. Gives (N, 2) float64, of
    images and of sweeps.
    """
    known, corners, rows = _statistics(settings), lines.corners_xyxy, vehicles.astype(np.int64)
    tall = corners[:, 3] - corners[:, 1] >= known.least_heights[rows]
    recalls = known.recalls[rows]
    recalls[:, 0] *= tall
    recalls[:, 1] *= distances < known.farthest[rows]
    chances: Float64Array = np.log1p(-recalls * lines.seen_shares[:, None])
    return chances


_ByCamera = dict[Identifier, Float64Array]


@dataclass(slots=True, eq=False)
class _Population:
    """Objects, a row each. No array is written to once another moment begins."""

    ids: Int64Array  # (N,)
    means: Float64Array  # (N, 11) of `motion`
    covariances: Float64Array  # (N, 11, 11)
    log_odds: Float64Array  # (N,), of existence
    box_log_odds: Float64Array  # (N,), that the last box is right and still there
    hidden: Float64Array  # (N,), probability that something unknown hides them
    codes: Int64Array  # (N, 2), class and family
    vehicles: BoolArray  # (N,)
    seen_ns: Int64Array  # (N,) [ns], when a box was last theirs
    box_covariances: Float64Array  # (N, 6, 6), of middle and size of the last box
    heading_votes: Float64Array  # (N,), how much speaks for their heading and against its opposite
    votes: Float64Array  # (N, K), for each of K words
    supports: UInt8Array  # (N,) of `Support`
    differing: _ByCamera = field(default_factory=dict)  # (N, 4) of `differences`
    differing_variances: _ByCamera = field(default_factory=dict)  # (N, 4)
    corners_xyxy: _ByCamera = field(default_factory=dict)  # (N, 4) [px], detected at this moment, or NaN

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def empty(cls) -> "_Population":
        """No object."""
        return cls(
            ids=np.zeros(0, np.int64),
            means=np.zeros((0, SIZE)),
            covariances=np.zeros((0, SIZE, SIZE)),
            log_odds=np.zeros(0),
            box_log_odds=np.zeros(0),
            hidden=np.zeros(0),
            codes=np.zeros((0, 2), np.int64),
            vehicles=np.zeros(0, np.bool_),
            seen_ns=np.zeros(0, np.int64),
            box_covariances=np.zeros((0, 6, 6)),
            heading_votes=np.zeros(0),
            votes=np.zeros((0, 0)),
            supports=np.zeros(0, np.uint8),
        )

    def copied(self) -> "_Population":
        """The same objects, to be changed in place."""
        return replace(self, **{name: getattr(self, name).copy() for name in _IN_PLACE})

    def select(self, rows: Int64Array | BoolArray) -> "_Population":
        """Some of the objects."""
        kept: dict[str, Any] = {}
        for name in _COLUMNS:
            value = getattr(self, name)
            kept[name] = {k: v[rows] for k, v in value.items()} if isinstance(value, dict) else value[rows]
        return _Population(**kept)

    def joined(self, others: "_Population") -> "_Population":
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
        return _Population(**kept)


_COLUMNS = tuple(f.name for f in fields(_Population))
_IN_PLACE = tuple(name for name in _COLUMNS if name not in {"ids", "hidden", "codes", "vehicles"})  # is written to


def no_boxes(count: int) -> Float64Array:
    """(N, 4) float64 of NaN."""
    return np.full((count, 4), np.nan)


EDGE_PX = 1.0
"""Deviation of an edge of a detector's box beside what is a share of its sides [px]."""

RETURN_TIME = 2.0
"""After so long boxes in images differ from outlines as usual [s]."""


def outlines(numbers: Float64Array, likely: Float64Array, world_from_lidar: RigidTransform, view: View) -> Outlines:
    """Where an image shows boxes of the world.

    Args:
        numbers: (N, 7), middle, length, width, height [m] and heading [rad].
        likely: (N,), how likely each is there, and hides what is behind it.
    """
    boxes = numbers.copy()
    boxes[:, :3] = (numbers[:, :3] - world_from_lidar.translation) @ world_from_lidar.rotation
    boxes[:, 6] = _rotated(numbers[:, 6], world_from_lidar.rotation.T)
    in_view = _in_view(boxes, view)
    if in_view.all():
        return project_outlines(view.camera, view.camera_from_lidar, boxes, likely=likely)
    found = project_outlines(view.camera, view.camera_from_lidar, boxes[in_view], likely=likely[in_view])
    every = []
    for f in fields(found):  # zeros for boxes out of view
        rows = getattr(found, f.name)
        every.append(np.zeros((len(in_view), *rows.shape[1:])))
        every[-1][in_view] = rows
    return Outlines(*every)


def _in_view(boxes: Float64Array, view: View) -> BoolArray:
    """Which boxes may be in the image: not those whose ball lies outside the cone that it shows."""
    # to find where such a box leaves the camera model, which it never enters, is slow
    middles = boxes[:, :3] @ view.camera_from_lidar.rotation.T + view.camera_from_lidar.translation
    away = np.sqrt((middles**2).sum(axis=1))
    reach = np.sqrt((boxes[:, 3:6] ** 2).sum(axis=1)) / 2.0
    angles = np.arctan2(np.hypot(middles[:, 0], middles[:, 1]), middles[:, 2])
    balls = np.arcsin(np.minimum(reach / np.maximum(away, 1e-9), 1.0))
    in_view: BoolArray = (angles - balls < widest_angle(view.camera)) | (reach >= away)
    return in_view


def _across(means: Float64Array, covariances: Float64Array, eye: Float64Array) -> tuple[Float64Array, ...]:
    """How wide objects look [m], and variances of that [m²], of where they are across [m²], and of log distances."""
    apart = means[:, :2] - eye[..., :2]
    away = np.maximum(np.sqrt((apart**2).sum(axis=1)), 1.0)
    x, y = (apart / away[:, None]).T
    xx, yy, xy = covariances[:, 0, 0], covariances[:, 1, 1], 2.0 * x * y * covariances[:, 0, 1]
    along, across = x * x * xx + y * y * yy + xy, y * y * xx + x * x * yy - xy
    cosines = (np.cos(means[:, YAW]) * x + np.sin(means[:, YAW]) * y) ** 2
    wide = np.sqrt(1.0 - cosines) * means[:, 3] + np.sqrt(cosines) * means[:, 4]
    return wide, (1.0 - cosines) * covariances[:, 3, 3] + cosines * covariances[:, 4, 4], across, along / away**2


def usual_differences(
    means: Float64Array, covariances: Float64Array, vehicles: BoolArray, eye: Float64Array, settings: TrackerSettings
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """How boxes in images usually differ from outlines, seen from an eye (3,) or (N, 3): (N, 4), and variances.

    And how likely boxes are off by less than a third of their width, as the eye sees them, (N,).
    """
    known, rows, high = _statistics(settings), vehicles.astype(np.int64), means[:, 5] ** 2
    wide, of_widths, across, of_distances = _across(means, covariances, eye)
    spreads, broad = known.spreads[rows], wide**2
    spreads[:, 0] += across / broad
    spreads[:, 1] += covariances[:, 2, 2] / high
    spreads[:, 2] += of_widths / broad + of_distances
    spreads[:, 3] += covariances[:, 5, 5] / high + of_distances
    return known.usual[rows], spreads, erf(wide / 3.0 / np.sqrt(2.0 * np.maximum(across, 1e-12)))


def noises(corners: Float64Array, vehicles: BoolArray, settings: TrackerSettings) -> Float64Array:
    """Variances (N, 4) of the differences of a detector's boxes: of a middle half, of a side twice those of an edge."""
    edges = (EDGE_PX / (corners[:, 2:] - corners[:, :2])) ** 2
    variances: Float64Array = _statistics(settings).errors[vehicles.astype(np.int64)]
    variances[:, :2] += edges / 2.0
    variances[:, 2:] += edges * 2.0
    return variances


def left_view(supports: UInt8Array, shown_shares: Float64Array) -> BoolArray:
    """Which objects no detector sees since the image shows less than half of them, (N,)."""
    unseen: BoolArray = (supports == Support.PREDICTED) & (shown_shares < 0.5)
    return unseen


def applied(differing: Float64Array, outlined: Float64Array, width: int, height: int) -> Float64Array:
    """The boxes (N, 4) [px] that differ so from outlines, cut at the image; NaN where there is no outline.

    `differing` (N, 4) is NaN where nothing is known of it.
    """
    known = np.where(np.isnan(differing), 0.0, differing)
    sides = outlined[:, 2:] - outlined[:, :2]
    middles = (outlined[:, :2] + outlined[:, 2:]) / 2.0 + known[:, :2] * sides
    halves = sides * np.exp(known[:, 2:]) / 2.0
    corners = np.empty((len(outlined), 4))
    corners[:, :2], corners[:, 2:] = middles - halves, middles + halves
    np.minimum(np.maximum(corners, 0.0, out=corners), (width, height, width, height), out=corners)
    corners[~has_area(corners)] = np.nan
    return corners


def has_area(corners: Float64Array) -> BoolArray:
    """Which boxes (N, 4) have an area; those with NaN have none."""
    area: BoolArray = (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])
    return area


_OVERLAP_SIGMA = 0.25  # deviation of the share by which boxes in images fail to overlap that are one object's
_USUAL_OVERLAP = 0.6  # the overlap that speaks neither for nor against one object
_LEAST_OVERLAP = 0.3  # an object takes a box of an image alone that overlaps with its own by so much at least
_LEAST_SIGMA = 0.1  # no middle of a box is where it is expected to within less than this [m]

_AGREEMENT = 0.5 * (_FREEDOM + 1.0) * float(np.log1p(((1.0 - _USUAL_OVERLAP) / _OVERLAP_SIGMA) ** 2 / _FREEDOM))
"""What an image adds at most: where boxes are the same."""


def _candidates(
    objects: _Population, foreseen: _ByCamera, seen: _Observations, settings: TrackerSettings
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Which boxes may be of which objects, and logarithms of how much likelier that is than anything else, (K,)."""
    # `foreseen`: by camera, (N, 4) [px], where objects are expected in its image, NaN for nowhere
    density = np.where(objects.vehicles, settings.vehicle_density, settings.person_density)
    found: tuple[Int64Array, Int64Array, Float64Array] = gains_in_space(
        np.ascontiguousarray(objects.means[:, :3]),
        np.ascontiguousarray(objects.covariances[:, :3, :3]),
        objects.codes,
        np.log(density),
        np.ascontiguousarray(seen.measures[:, :3]),
        np.ascontiguousarray(seen.covariances[:, :3, :3]),
        seen.codes,
        np.minimum(seen.log_odds, 0.0),
        _LEAST_SIGMA**2,
        _FREEDOM,
        len(seen.corners_xyxy) * _AGREEMENT,
    )
    numbers = _OVERLAP_SIGMA, _USUAL_OVERLAP, _LEAST_OVERLAP, _FREEDOM
    for camera_id, corners in seen.corners_xyxy.items():
        if camera_id in foreseen:
            add_gains_in_image(*found, foreseen[camera_id], corners, seen.measured, *numbers)
    return found


_TWIN_OVERLAP = 0.5  # boxes in an image that overlap by more than this stand for one object
_TWIN_SHARE = 0.5  # so do boxes whose middles are nearer to each other than this share of a width
_LOCATION = [0, 1, 4]  # what says where a box is on the ground, and how wide

_SPEEDS = np.array([[10.0, 2.0], [1.5, 1.5]])
"""Deviation of the speed of what is seen for the first time, along and across its heading: vehicles, people [m/s]."""

_FIRST_CLIMB, _ROTATION = 0.3, 0.2  # the same of climbing [m/s] and rotating [rad/s]


def _unclaimed(seen: _Observations, free: BoolArray, objects: _Population, found: Int64Array) -> Int64Array:
    """Give rows of `free` boxes (M,), likely enough, that are no second box of an object found, nor of one another."""
    rows = np.flatnonzero(free)
    if not len(rows):
        return rows
    rows = rows[np.argsort(-seen.log_odds[rows], kind="stable")]
    known = {name: objects.corners_xyxy[name][found] for name in seen.corners_xyxy}
    kept: Int64Array = without_twins(
        rows,
        np.ascontiguousarray(seen.measures[:, _LOCATION]),
        seen.measured,
        _stacked(seen.corners_xyxy, len(seen)),
        np.ascontiguousarray(objects.means[found][:, _LOCATION]),
        objects.supports[found] != Support.IMAGE,
        _stacked(known, len(found)),
        _TWIN_SHARE,
        _TWIN_OVERLAP,
    )
    return kept


def _stacked(corners: _ByCamera, count: int) -> Float64Array:
    """Boxes of all images, (C, N, 4)."""
    return np.array(list(corners.values())).reshape(len(corners), count, 4)


def _states(seen: _Observations, rows: Int64Array) -> tuple[Float64Array, Float64Array]:
    """States of objects that are seen for the first time, (K, 11) and (K, 11, 11) of `tracking_states`."""
    means = np.zeros((len(rows), SIZE))
    covariances = np.zeros((len(rows), SIZE, SIZE))
    means[:, :7], covariances[:, :7, :7] = seen.measures[rows], seen.covariances[rows]
    covariances[:, 6, 6] = np.minimum(covariances[:, 6, 6], np.pi**2)
    reported = np.isfinite(seen.velocities[rows]).all(axis=1)
    means[reported, 7:10] = seen.velocities[rows[reported]]
    along, across = np.where(seen.vehicles[rows], *(_SPEEDS[..., None] ** 2))
    across = np.where(seen.measured[rows], across, along)
    cosines, sines = np.cos(means[:, 6]), np.sin(means[:, 6])
    covariances[:, 7, 7] = along * cosines**2 + across * sines**2
    covariances[:, 8, 8] = along * sines**2 + across * cosines**2
    covariances[:, 7, 8] = covariances[:, 8, 7] = (along - across) * cosines * sines
    covariances[:, 9, 9], covariances[:, 10, 10] = _FIRST_CLIMB**2, _ROTATION**2
    return means, covariances


_MOST_VOTES = 5.0  # so many looks at a heading are remembered
_MOVING = 1.5  # what is faster than this shows by its motion where it heads [m/s]
_SURE_HEADING = 1.0  # a heading with a larger variance than this says nothing [rad²]
_OUTVOTED = -1.0  # with fewer votes than this a heading is reversed
_NEIGHBOURS = 2.0  # so many votes have the neighbours together
_KNOWN = 3.0  # so many votes make a neighbour's heading known
_HALF_LANE, _AHEAD = 1.75, 50.0  # how far across and along its heading a neighbour of the same lane is [m]
_PARALLEL = 0.95  # least cosine between the axes of neighbours


def _rotation_round(objects: _Population, rows: Int64Array, seen: _Observations, columns: Int64Array) -> None:
    """Let the boxes seen of `rows`, motion and neighbours vote on headings, in place, and rotate the outvoted round."""
    sure = seen.covariances[columns, 6, 6] < _SURE_HEADING
    rows, columns = rows[sure], columns[sure]
    objects.heading_votes[rows] += np.cos(seen.measures[columns, 6] - objects.means[rows, YAW])
    headings = objects.means[:, YAW]
    forward = np.cos(headings) * objects.means[:, 7] + np.sin(headings) * objects.means[:, 8]
    objects.heading_votes += np.sign(forward) * (np.abs(forward) > _MOVING)
    np.minimum(np.maximum(objects.heading_votes, -_MOST_VOTES), _MOST_VOTES, out=objects.heading_votes)
    doubtful = np.flatnonzero(objects.vehicles & (objects.heading_votes < _OUTVOTED + _NEIGHBOURS))
    votes = objects.heading_votes[doubtful]
    wrong = ~objects.vehicles & (objects.heading_votes < _OUTVOTED)
    wrong[doubtful] = votes + _NEIGHBOURS * _of_neighbours(objects, doubtful) < _OUTVOTED
    objects.means[wrong, YAW] = wrapped(objects.means[wrong, YAW] + np.pi)
    objects.heading_votes[wrong] *= -1.0


def _of_neighbours(objects: _Population, rows: Int64Array) -> Float64Array:
    """How much vehicles of the same lane speak for the headings of some, (K,), from -1 to 1."""
    known = np.flatnonzero(objects.vehicles & (objects.heading_votes >= _KNOWN))
    apart = objects.means[known, :2] - objects.means[rows, None, :2]
    headings = objects.means[rows, YAW, None]
    cosines, sines = np.cos(headings), np.sin(headings)
    along = cosines * apart[..., 0] + sines * apart[..., 1]
    across = cosines * apart[..., 1] - sines * apart[..., 0]
    rotations = np.cos(objects.means[known, YAW] - headings)
    of_lane = (np.abs(across) < _HALF_LANE) & (np.abs(along) < _AHEAD) & (np.abs(rotations) > _PARALLEL)
    reported: Float64Array = np.clip(np.sum(rotations, axis=1, where=of_lane), -1.0, 1.0)
    return reported


DEFAULTS = TrackerSettings()

_MOST_ACCELERATION = 15.0  # tyres hold no vehicle that changes its velocity more quickly than this [m/s²]
_LEAST_LEAP, _MOST_LEAPS = 0.1, 3  # shorter leaps of poses do no harm [m]; more in a row are motion


class Moment(NamedTuple):
    """What a tracker knows at one moment, of objects that it reports and of others.

    Attributes:
        observation: what was seen.
        objects: all that may be there.
        predicted: those of the moment before, before the boxes of this one were read.
        slopes: (N, 11, 11), of their states with respect to those of the moment before.
        outlined: by camera, outlines of the boxes of `objects` in its image.
        words: the labels that the columns of `objects.votes` stand for.
        localized: (N,), how likely `objects` are off by less than a third of their width.
        leap: (3,) [m], by how much poses have leapt so far: takes states into the world of the poses.
    """

    observation: Observation
    objects: _Population
    predicted: _Population
    slopes: Float64Array
    outlined: Mapping[Identifier, Outlines]
    words: Sequence[str]
    localized: Float64Array
    leap: Float64Array


class Tracker:
    """Follows objects online.

    Each step takes the next moment. If time goes back, or leaps by more than the longest gap, all objects are
    forgotten; none gets a number that was given before.
    """

    def __init__(self, settings: TrackerSettings = DEFAULTS) -> None:
        self.settings = settings
        self._objects = _Population.empty()
        self._time_ns: int | None = None
        self._next_id = 1
        self._words: list[str] = []
        self._eye: Float64Array | None = None  # where the lidar was
        self._velocity: Float64Array | None = None  # its own [m/s]
        self._leap, self._leaps = np.zeros(3), 0

    def step(self, observation: Observation) -> TrackedObjects:
        """Take the boxes of the next moment, and report the objects that are there."""
        return _reported(self.advance(observation), self.settings)

    def advance(self, observation: Observation) -> Moment:
        """Take the boxes of the next moment, and give all that is known then."""
        seconds = self._elapsed(observation.timestamp_ns)
        observation = self._without_leaps(observation, seconds)
        seen = observed(observation)
        self._learn_words(seen)
        predicted, slopes = _predicted(self._objects, seconds, self.settings)
        foreseen, missed = _foreseen(predicted, observation, self.settings)
        found = _candidates(predicted, foreseen, seen, self.settings)
        rows, columns = assign_pairs(*found)
        objects = predicted.copied()
        unseen = predicted.hidden + (1.0 - predicted.hidden) * np.exp(missed)
        objects.log_odds += np.log(unseen)
        objects.box_log_odds += np.log(unseen)
        objects.hidden = predicted.hidden / unseen
        objects.hidden[rows] = 0.0
        self._read(objects, rows, seen, columns, predicted)
        objects.seen_ns[rows] = observation.timestamp_ns
        objects = self._with_newborn(objects, rows, seen, columns, observation.timestamp_ns)
        there = objects.log_odds > log_odds(self.settings.drop)
        there &= observation.timestamp_ns - objects.seen_ns <= self.settings.longest_gap * 1e9
        objects = objects if there.all() else objects.select(there)
        outlined, localized = _compare_with_outlines(objects, observation, seconds, self.settings)
        self._objects = objects
        return Moment(observation, objects, predicted, slopes, outlined, self._words, localized, self._leap)

    def _elapsed(self, timestamp_ns: int) -> float:
        before, self._time_ns = self._time_ns, timestamp_ns
        seconds = 0.0 if before is None else (timestamp_ns - before) / 1e9
        if 0.0 <= seconds <= self.settings.longest_gap:
            return seconds
        self._objects = _Population.empty()
        self._eye = self._velocity = None
        return 0.0

    def _without_leaps(self, observation: Observation, seconds: float) -> Observation:
        """What was seen from where the ego would be if its poses had not leapt."""
        pose = observation.world_from_lidar
        before, self._eye = self._eye, pose.translation
        if before is None:
            self._leap, self._leaps = np.zeros(3), 0
        elif seconds > 0.0:
            velocity = (pose.translation - before) / seconds
            apart = np.zeros(3) if self._velocity is None else velocity - self._velocity
            size = math.hypot(*apart.tolist())
            leaps = size > _MOST_ACCELERATION * seconds and size * seconds > _LEAST_LEAP and self._leaps < _MOST_LEAPS
            self._leaps = self._leaps + 1 if leaps else 0
            if leaps:
                self._leap, velocity = self._leap + apart * seconds, velocity - apart
            self._velocity = velocity
        if not self._leap.any():
            return observation
        return replace(observation, world_from_lidar=RigidTransform(pose.rotation, pose.translation - self._leap))

    def _learn_words(self, seen: _Observations) -> None:
        self._words += [word for word in dict.fromkeys(seen.labels) if word not in self._words]
        missing = len(self._words) - self._objects.votes.shape[1]
        if missing:
            self._objects.votes = np.pad(self._objects.votes, ((0, 0), (0, missing)))

    def _read(
        self, objects: _Population, rows: Int64Array, seen: _Observations, columns: Int64Array, predicted: _Population
    ) -> None:
        """Read of some objects the boxes that are theirs."""
        settings = self.settings
        read(objects.means, objects.covariances, rows, seen.measures, seen.covariances, columns)
        read_no_slip(objects.means, objects.covariances, objects.vehicles, settings.side_slip**2)
        own = seen.log_odds[columns]
        gained = own - _statistics(settings).prior_log_odds[objects.vehicles[rows].astype(np.int64)]
        objects.log_odds[rows] = np.maximum(predicted.log_odds[rows] + settings.trust * gained, own)
        objects.box_log_odds[rows] = own
        objects.box_covariances[rows] = seen.covariances[columns, :6, :6]
        objects.votes[rows] += self._votes(seen, columns)
        objects.supports[:] = Support.PREDICTED
        objects.supports[rows] = _supports(seen, columns)
        for camera_id, corners in seen.corners_xyxy.items():
            objects.corners_xyxy[camera_id] = no_boxes(len(objects))
            objects.corners_xyxy[camera_id][rows] = corners[columns]
        _rotation_round(objects, rows, seen, columns)

    def _votes(self, seen: _Observations, rows: Int64Array) -> Float64Array:
        """How much boxes speak for each of the words, (K, words)."""
        votes = np.zeros((len(rows), len(self._words)))
        numbers = [self._words.index(seen.labels[k]) for k in rows.tolist()]
        votes[np.arange(len(rows)), numbers] = probabilities(seen.log_odds[rows])
        return votes

    def _with_newborn(
        self, objects: _Population, rows: Int64Array, seen: _Observations, columns: Int64Array, timestamp_ns: int
    ) -> _Population:
        free = seen.log_odds > log_odds(self.settings.drop)
        free[columns] = False
        new = _unclaimed(seen, free, objects, rows)
        if not len(new):
            return objects
        means, covariances = _states(seen, new)
        newborn = _Population(
            ids=np.arange(self._next_id, self._next_id + len(new)),
            means=means,
            covariances=covariances,
            log_odds=seen.log_odds[new],
            box_log_odds=seen.log_odds[new],
            hidden=np.zeros(len(new)),
            codes=seen.codes[new],
            vehicles=seen.vehicles[new],
            seen_ns=np.full(len(new), timestamp_ns),
            box_covariances=seen.covariances[new, :6, :6],
            heading_votes=np.where(seen.measured[new], 1.0, 0.0),
            votes=self._votes(seen, new),
            supports=_supports(seen, new),
            corners_xyxy={camera_id: boxes[new] for camera_id, boxes in seen.corners_xyxy.items()},
        )
        self._next_id += len(new)
        return objects.joined(newborn)


def _predicted(objects: _Population, seconds: float, settings: TrackerSettings) -> tuple[_Population, Float64Array]:
    """The objects so much later, and the slopes of their states."""
    moved = replace(objects)
    moved.means, moved.covariances, slopes = predicted(
        objects.means, objects.covariances, objects.vehicles, seconds, settings
    )
    moved.log_odds = aged(objects.log_odds, seconds, settings.lifetime)
    moved.box_log_odds = aged(objects.box_log_odds, seconds, settings.lifetime)
    leaving, coming = np.exp(-seconds / settings.hidden_time), np.exp(-seconds / settings.open_time)
    moved.hidden = objects.hidden * leaving + (1.0 - objects.hidden) * (1.0 - coming)
    moved.corners_xyxy = {}
    return moved, slopes


def _foreseen(
    objects: _Population, observation: Observation, settings: TrackerSettings
) -> tuple[_ByCamera, Float64Array]:
    """The boxes that are expected in images, and how little it says if an object is not found, (N,) logarithms."""
    likely = probabilities(objects.log_odds)
    apart = np.sqrt(((objects.means[:, :3] - observation.world_from_lidar.translation) ** 2).sum(axis=1))
    foreseen: _ByCamera = {}
    misses = np.zeros((len(objects), 2))
    for camera_id, view in observation.views.items():
        lines = outlines(objects.means[:, :7], likely, observation.world_from_lidar, view)
        differing = objects.differing.get(camera_id, no_boxes(len(objects)))
        foreseen[camera_id] = applied(differing, lines.corners_xyxy, view.camera.width, view.camera.height)
        # every camera looks for itself, the lidar once
        of_camera = missed(lines, apart, objects.vehicles, settings)
        misses[:, 0] += of_camera[:, 0]
        misses[:, 1] = np.minimum(misses[:, 1], of_camera[:, 1])
    return foreseen, misses.sum(axis=1)


def _supports(seen: _Observations, rows: Int64Array) -> UInt8Array:
    """What boxes are, as `Support`."""
    shown = np.zeros(len(rows), np.bool_)
    for corners in seen.corners_xyxy.values():
        shown |= has_area(corners[rows])
    supports = np.where(shown, Support.BOTH, Support.SWEEP)
    return np.where(seen.measured[rows], supports, Support.IMAGE).astype(np.uint8)


def _compare_with_outlines(
    objects: _Population, observation: Observation, seconds: float, settings: TrackerSettings
) -> tuple[Mapping[Identifier, Outlines], Float64Array]:
    """Learn how boxes in images differ from the outlines of the objects, and give these, and `Moment.localized`."""
    likely, eye = probabilities(objects.log_odds), observation.world_from_lidar.translation
    usual, spreads, localized = usual_differences(objects.means, objects.covariances, objects.vehicles, eye, settings)
    kept, found = float(np.exp(-seconds / RETURN_TIME)), dict[Identifier, Outlines]()
    for camera_id, view in observation.views.items():
        found[camera_id] = outlines(objects.means[:, :7], likely, observation.world_from_lidar, view)
        outlined, unknown = found[camera_id].corners_xyxy, no_boxes(len(objects))
        before, variances = (
            by_camera.get(camera_id, unknown) for by_camera in (objects.differing, objects.differing_variances)
        )
        fresh = np.isnan(before)
        means = np.where(fresh, usual, usual + kept * (before - usual))
        variances = np.where(fresh, spreads, spreads + kept**2 * (variances - spreads))
        corners = objects.corners_xyxy.get(camera_id, unknown)
        seen = np.flatnonzero(has_area(corners) & has_area(outlined))
        noise = noises(corners[seen], objects.vehicles[seen], settings)
        gains = variances[seen] / (variances[seen] + noise)
        means[seen] += gains * (differences(corners[seen], outlined[seen]) - means[seen])
        variances[seen] *= 1.0 - gains
        objects.differing[camera_id], objects.differing_variances[camera_id] = means, variances
    return found, localized


_HISTORY = 0.3  # more of it orders what is stated better, and makes it too sure


def stated_covariances(
    covariances: Float64Array, boxes: Float64Array, vehicles: BoolArray, settings: TrackerSettings
) -> Float64Array:
    """Covariances (N, 10, 10) of states, with what errs alike in all boxes: (N, 6, 6) of the last ones."""
    stated = covariances[:, :10, :10].copy()
    stated[:, :6, :6] += _statistics(settings).lasting[vehicles.astype(np.int64)] * boxes
    return stated


def _reported(moment: Moment, settings: TrackerSettings) -> TrackedObjects:
    """The objects that are likely enough to be reported."""
    every = moment.objects
    there = (1.0 - every.hidden) * np.where(every.supports == Support.PREDICTED, moment.localized, 1.0)
    rows = np.flatnonzero(probabilities(every.log_odds) * there >= np.minimum(settings.report, 1.0 - _SUREST))
    means, supports, corners = every.means[rows], every.supports[rows], {}
    for camera_id, view in moment.observation.views.items():
        lines = moment.outlined[camera_id]
        differing = every.differing[camera_id][rows]
        if settings.image_box is ImageBox.PROJECTED:
            differing = np.zeros_like(differing)
        boxes = applied(differing, lines.corners_xyxy[rows], view.camera.width, view.camera.height)
        boxes[left_view(supports, lines.shown_shares[rows])] = np.nan
        corners[camera_id] = boxes
    return TrackedObjects(
        timestamp_ns=moment.observation.timestamp_ns,
        ids=every.ids[rows],
        labels=tuple(moment.words[k] for k in every.votes[rows].argmax(axis=1).tolist()) if len(rows) else (),
        centers=means[:, :3] + moment.leap,
        sizes_lwh=means[:, 3:6],
        yaws=means[:, YAW],
        velocities=means[:, 7:10],
        yaw_rates=means[:, ROTATION],
        covariances=stated_covariances(
            every.covariances[rows], every.box_covariances[rows], every.vehicles[rows], settings
        ),
        scores=probabilities(_HISTORY * every.log_odds[rows] + (1.0 - _HISTORY) * every.box_log_odds[rows])
        * there[rows],
        supports=supports,
        corners_xyxy=corners,
    )


@inlined
def _wrapped(angle):  # type: ignore[no-untyped-def]
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@part
def _move(mean, slope, vehicle, seconds, rotation_time):  # type: ignore[no-untyped-def]
    """Move one state on in place, and write its slopes."""
    slope[:] = 0.0
    for k in range(SIZE):
        slope[k, k] = 1.0
    x, y, rate = mean[7], mean[8], mean[ROTATION]
    angle = rate * seconds if vehicle else 0.0
    lever = seconds if vehicle else 0.0
    cosine, sine = np.cos(angle), np.sin(angle)
    rotated_x, rotated_y = cosine * x - sine * y, sine * x + cosine * y
    half = seconds / 2.0
    mean[0] += half * (x + rotated_x)
    mean[1] += half * (y + rotated_y)
    mean[2] += seconds * mean[9]
    mean[YAW] = _wrapped(mean[YAW] + rate * seconds)
    mean[7], mean[8] = rotated_x, rotated_y
    decay = np.exp(-seconds / rotation_time)
    mean[ROTATION] = rate * decay
    slope[0, 7], slope[0, 8] = half * (1.0 + cosine), -half * sine
    slope[1, 7], slope[1, 8] = half * sine, half * (1.0 + cosine)
    slope[0, ROTATION], slope[1, ROTATION] = -half * lever * rotated_y, half * lever * rotated_x
    slope[2, 9] = seconds
    slope[YAW, ROTATION] = seconds
    slope[7, 7], slope[7, 8], slope[7, ROTATION] = cosine, -sine, -lever * rotated_y
    slope[8, 7], slope[8, 8], slope[8, ROTATION] = sine, cosine, lever * rotated_x
    slope[ROTATION, ROTATION] = decay


@part
def _shake(covariance, heading, seconds, variances):  # type: ignore[no-untyped-def]
    """Add to one covariance what white noise of accelerations does in so long."""
    along, across, climb, sizes = variances[0], variances[1], variances[2], variances[3]
    yaw, turn = variances[4], variances[5]
    cosine, sine = np.cos(heading), np.sin(heading)
    xx = along * cosine * cosine + across * sine * sine
    yy = along * sine * sine + across * cosine * cosine
    xy = (along - across) * cosine * sine
    cubed, squared = seconds**3 / 3.0, seconds**2 / 2.0
    for i, j, value in ((0, 0, xx), (0, 1, xy), (1, 0, xy), (1, 1, yy), (2, 2, climb)):
        covariance[i, j] += value * cubed
        covariance[i, 7 + j] += value * squared
        covariance[7 + i, j] += value * squared
        covariance[7 + i, 7 + j] += value * seconds
    for k in range(3, 6):
        covariance[k, k] += sizes * seconds
    covariance[YAW, YAW] += yaw * seconds + turn * cubed
    covariance[YAW, ROTATION] += turn * squared
    covariance[ROTATION, YAW] += turn * squared
    covariance[ROTATION, ROTATION] += turn * seconds


@kernel(
    "Tuple((float64[:,::1], float64[:,:,::1], float64[:,:,::1]))(float64[:,::1], float64[:,:,::1], boolean[::1], "
    "float64, float64, float64[:,::1])"
)
def _predict(
    means: Float64Array, covariances: Float64Array, vehicles: BoolArray, seconds: float, rotation_time: float,
    variances: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Predict states `seconds` later, with the noise of that time.

    `means`, `covariances` (N, 11) and (N, 11, 11); `vehicles` (N,), whether their velocity rotates with them;
    `rotation_time` [s], after which rotation has died down; `variances` (2, 6), of people and of vehicles: densities of
    the noise of acceleration along the heading, across it and upwards, of sizes, of the heading and of rotation.
    Returns means and covariances afterwards, and the slopes (N, 11, 11) of the means.
    """
    count = len(means)
    moved, spread = means.copy(), np.zeros((count, SIZE, SIZE))
    slopes, half = np.empty((count, SIZE, SIZE)), np.empty((SIZE, SIZE))
    for n in range(count):
        noise = variances[1 if vehicles[n] else 0]
        _move(moved[n], slopes[n], vehicles[n], seconds, rotation_time)
        half[:] = 0.0
        for i in range(SIZE):
            for k in range(SIZE):
                if slopes[n, i, k] != 0.0:
                    for j in range(SIZE):
                        half[i, j] += slopes[n, i, k] * covariances[n, k, j]
        for j in range(SIZE):
            for k in range(SIZE):
                if slopes[n, j, k] != 0.0:
                    for i in range(SIZE):
                        spread[n, i, j] += half[i, k] * slopes[n, j, k]
        _shake(spread[n], means[n, YAW], seconds, noise)
    return moved, spread, slopes


@part
def _factored(matrix, root):  # type: ignore[no-untyped-def]
    """Write Cholesky's lower triangle of a matrix; False where it is not positive."""
    size = len(matrix)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = total / root[j, j]
            elif total > 0.0:
                root[i, i] = np.sqrt(total)
            else:
                return False
    return True


@part
def _solve(root, vector):  # type: ignore[no-untyped-def]
    """Solve L Lᵀ x = v in place."""
    size = len(vector)
    for i in range(size):
        for k in range(i):
            vector[i] -= root[i, k] * vector[k]
        vector[i] /= root[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= root[k, i] * vector[k]
        vector[i] /= root[i, i]


@part
def _weighed(covariance, noise, apart, root, spread, solved, freedom):  # type: ignore[no-untyped-def]
    """Factor the covariance of a box, wider for one that is far off; False where it is none."""
    wider = 1.0
    for attempt in range(2):
        for i in range(_MEASURED):
            for j in range(_MEASURED):
                spread[i, j] = covariance[i, j] + noise[i, j] * wider
        if not _factored(spread, root):
            return False
        if attempt == 0:
            # number by number: to assign a whole array takes the compiler three seconds, for its error's text
            for i in range(_MEASURED):
                solved[i] = apart[i]
            _solve(root, solved)
            off = 0.0
            for i in range(_MEASURED):
                off += apart[i] * solved[i]
            wider = (freedom + off) / (freedom + _MEASURED)
            if wider <= 1.0:
                break
    return True


@part
def _read(mean, covariance, apart, root, crossed, gain):  # type: ignore[no-untyped-def]
    """Kalman's update of one state, in place."""
    for i in range(SIZE):
        for j in range(_MEASURED):
            crossed[i, j] = gain[i, j] = covariance[i, j]
        _solve(root, gain[i])
        for j in range(_MEASURED):
            mean[i] += gain[i, j] * apart[j]
    for i in range(SIZE):
        for j in range(i + 1):
            for k in range(_MEASURED):
                covariance[i, j] -= gain[i, k] * crossed[j, k]
            covariance[j, i] = covariance[i, j]
    mean[YAW] = _wrapped(mean[YAW])


@kernel("void(float64[:,::1], float64[:,:,::1], int64[::1], float64[:,::1], float64[:,:,::1], int64[::1])")
def read(
    means: Float64Array, covariances: Float64Array, rows: Int64Array, measures: Float64Array, noises: Float64Array,
    columns: Int64Array,
) -> None:  # fmt: skip
    """Read a box of each of some states, in place.

    Headings that are off by more than a right angle are taken the other way round; boxes that are further off than
    their covariances state are taken for less sure, as under Student's distribution.

    `means`, `covariances` (N, 11) and (N, 11, 11), are changed; `rows` (K,), which of them; `measures`, `noises` (M, 7)
    and (M, 7, 7); `columns` (K,), the box of each.
    """
    root, spread = np.zeros((_MEASURED, _MEASURED)), np.empty((_MEASURED, _MEASURED))
    apart, solved = np.empty(_MEASURED), np.empty(_MEASURED)
    crossed, gain = np.empty((SIZE, _MEASURED)), np.empty((SIZE, _MEASURED))
    for k in range(len(rows)):
        n, m = rows[k], columns[k]
        for i in range(_MEASURED):
            apart[i] = measures[m, i] - means[n, i]
        turn = _wrapped(apart[YAW])
        apart[YAW] = turn - np.pi * np.round(turn / np.pi)
        if _weighed(covariances[n], noises[m], apart, root, spread, solved, _FREEDOM):
            _read(means[n], covariances[n], apart, root, crossed, gain)


@kernel("void(float64[:,::1], float64[:,:,::1], boolean[::1], float64)")
def read_no_slip(means: Float64Array, covariances: Float64Array, vehicles: BoolArray, variance: float) -> None:
    """Read of vehicles that their velocity across their heading is 0, in place.

    `means`, `covariances` (N, 11) and (N, 11, 11), are changed; `vehicles` (N,); `variance`: of that velocity [m²/s²].
    """
    spread = np.empty(SIZE)
    for n in range(len(means)):
        if not vehicles[n]:
            continue
        cosine, sine = np.cos(means[n, YAW]), np.sin(means[n, YAW])
        along = cosine * means[n, 7] + sine * means[n, 8]
        across = cosine * means[n, 8] - sine * means[n, 7]
        total = variance
        for i in range(SIZE):
            row = covariances[n, i]
            spread[i] = cosine * row[8] - sine * row[7] - along * row[YAW]
        total += cosine * spread[8] - sine * spread[7] - along * spread[YAW]
        for i in range(SIZE):
            means[n, i] -= spread[i] * across / total
            for j in range(SIZE):
                covariances[n, i, j] -= spread[i] * spread[j] / total
        means[n, YAW] = _wrapped(means[n, YAW])


@inlined
def _heavy(square, count, freedom):  # type: ignore[no-untyped-def]
    """Squares of deviations as heavy tails take them: near 0 as they are, far away as their logarithm."""
    return (freedom + count) * np.log1p(square / freedom)


@inlined
def _may_be_one(a, i, b, j):  # type: ignore[no-untyped-def]
    """Whether classes are equal, of one family, or one of them says nothing."""
    if a[i, 0] == b[j, 0] or a[i, 0] < 0 or b[j, 0] < 0:
        return True
    return a[i, 1] == b[j, 1] and a[i, 1] >= 0


@inlined
def _trace(matrices, i):  # type: ignore[no-untyped-def]
    return matrices[i, 0, 0] + matrices[i, 1, 1] + matrices[i, 2, 2]


@part
def _with_room(column, room):  # type: ignore[no-untyped-def]
    """The same numbers, and room for more behind them."""
    wider = np.empty(room, column.dtype)
    for k in range(len(column)):
        wider[k] = column[k]
    return wider


@kernel(
    "Tuple((int64[::1], int64[::1], float64[::1]))(float64[:,::1], float64[:,:,::1], int64[:,::1], float64[::1], "
    "float64[:,::1], float64[:,:,::1], int64[:,::1], float64[::1], float64, float64, float64)"
)
def gains_in_space(
    locations: Float64Array, spreads: Float64Array, codes: Int64Array, expected: Float64Array,
    seen_positions: Float64Array, seen_spreads: Float64Array, seen_codes: Int64Array, seen_doubts: Float64Array,
    least_variance: float, freedom: float, most: float,
) -> tuple[Int64Array, Int64Array, Float64Array]:  # fmt: skip
    """Compare where objects are expected with where boxes are.

    Args:
        locations, spreads: (N, 3) and (N, 3, 3) [m, m²], of objects.
        codes: (N, 2), class and family, -1 for none.
        expected: (N,), logarithm of how many boxes of other things lie around each [1/m²].
        seen_positions, seen_spreads, seen_codes: the same of M boxes.
        seen_doubts: (M,), what is added for each box.
        least_variance: is added along each axis [m²].
        freedom: degrees of freedom of Student's distribution.
        most: how much images can add later; pairs that will stay below 0 are left out.

    Returns:
        The pairs that may be one: (K,) int64 objects, rising, (K,) int64 boxes, and (K,) float64 logarithms of ratios
        of likelihoods on the ground.
    """
    count = len(seen_positions)
    xs, ys, zs = seen_positions[:, 0].copy(), seen_positions[:, 1].copy(), seen_positions[:, 2].copy()
    reach = np.empty(count)
    for j in range(count):
        reach[j] = _trace(seen_spreads, j) + 3.0 * least_variance
    room, found = 4 * (len(locations) + count), 0
    rows, columns, gains = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    near = np.empty(count, np.int64)
    for i in range(len(locations)):
        # no pair is worth more than one whose locations are known as well as can be; farther ones are hopeless
        best = most - expected[i] - np.log(2.0 * np.pi * least_variance)
        farthest = freedom * np.expm1(max(2.0 * best, 0.0) / (freedom + 3.0))
        own, nearby = _trace(spreads, i), 0
        for j in range(count):
            x, y, z = xs[j] - locations[i, 0], ys[j] - locations[i, 1], zs[j] - locations[i, 2]
            near[nearby] = j
            nearby += x * x + y * y + z * z <= farthest * (own + reach[j])
        if found + nearby > room:
            room = 2 * (found + nearby)
            rows, columns, gains = _with_room(rows, room), _with_room(columns, room), _with_room(gains, room)
        for k in range(nearby):
            j = near[k]
            if not _may_be_one(codes, i, seen_codes, j):
                continue
            x = seen_positions[j, 0] - locations[i, 0]
            y = seen_positions[j, 1] - locations[i, 1]
            z = seen_positions[j, 2] - locations[i, 2]
            a = spreads[i, 0, 0] + seen_spreads[j, 0, 0] + least_variance
            b = spreads[i, 0, 1] + seen_spreads[j, 0, 1]
            c = spreads[i, 0, 2] + seen_spreads[j, 0, 2]
            d = spreads[i, 1, 1] + seen_spreads[j, 1, 1] + least_variance
            e = spreads[i, 1, 2] + seen_spreads[j, 1, 2]
            f = spreads[i, 2, 2] + seen_spreads[j, 2, 2] + least_variance
            area = a * d - b * b
            # the adjugate of the symmetric matrix, row by row
            r, s, t = d * f - e * e, c * e - b * f, b * e - c * d
            whole = a * r + b * s + c * t
            square = x * x * r + y * y * (a * f - c * c) + z * z * area
            square += 2.0 * (x * y * s + x * z * t + y * z * (b * c - a * e))
            far = _heavy(square / whole, 3.0, freedom)
            gain = seen_doubts[j] - expected[i] - np.log(2.0 * np.pi) - 0.5 * (np.log(area) + far)
            if gain > -most:
                rows[found], columns[found], gains[found] = i, j, gain
                found += 1
    return rows[:found].copy(), columns[:found].copy(), gains[:found].copy()


@kernel(
    "void(int64[::1], int64[::1], float64[::1], float64[:,::1], float64[:,::1], boolean[::1], float64, float64, "
    "float64, float64)"
)
def add_gains_in_image(
    rows: Int64Array, columns: Int64Array, gains: Float64Array, foreseen: Float64Array, corners: Float64Array,
    measured: BoolArray, sigma: float, usual: float, least: float, freedom: float,
) -> None:  # fmt: skip
    """Add to gains what boxes in an image state.

    Args:
        rows, columns: (K,), pairs of objects and boxes.
        gains: (K,), are changed in place; -inf for what cannot be one.
        foreseen, corners: (N, 4) and (M, 4) [px], where objects are expected and where boxes are, NaN for none.
        measured: (M,), whether there is a box in space behind the one in the image.
        sigma: deviation of the share by which boxes of one object fail to overlap.
        usual: the share of overlap that says nothing.
        least: a box in the image alone that overlaps less is not of the object.
        freedom: degrees of freedom of Student's distribution.
    """
    neutral = _heavy(((1.0 - usual) / sigma) ** 2, 1.0, freedom)
    for k in range(len(gains)):
        i, j = rows[k], columns[k]
        own, area = box_area(foreseen, i), box_area(corners, j)
        if not area > 0.0:
            continue
        share = usual
        if own > 0.0:
            common = common_area(foreseen, i, corners, j)
            share = common / (own + area - common)
            gains[k] += 0.5 * (neutral - _heavy(((1.0 - share) / sigma) ** 2, 1.0, freedom))
        if not measured[j] and (share < least or not own > 0.0):
            gains[k] = -np.inf


@inlined
def _overlap_more(a, i, b, j, least):  # type: ignore[no-untyped-def]
    """Whether two boxes of an image overlap by more than a share; those with NaN do not."""
    common = common_area(a, i, b, j)
    return common > 0.0 and common > least * (box_area(a, i) + box_area(b, j) - common)


@kernel(
    "int64[::1](int64[::1], float64[:,::1], boolean[::1], float64[:,:,::1], float64[:,::1], boolean[::1], "
    "float64[:,:,::1], float64, float64)"
)
def without_twins(
    rows: Int64Array, locations: Float64Array, measured: BoolArray, corners: Float64Array,
    known_locations: Float64Array, known_measured: BoolArray, known_corners: Float64Array, share: float, overlap: float,
) -> Int64Array:  # fmt: skip
    """Leave out boxes that are second boxes of a thing that is known, or of a box before them that was kept.

    A box that a sweep placed is one of a thing if their middles are nearer to each other on the ground than a share of
    the thing's width. Where a sweep did not place both, they are one if their boxes in some image overlap; of two
    that sweeps place apart one may stand before the other, however they overlap there.

    `rows` (K,), which boxes, the surest first; `locations` (M, 3) [m], middles on the ground and widths of the boxes;
    `measured` (M,), whether a sweep placed them; `corners` (C, M, 4) [px], in each image; NaN where there is none;
    `known_locations`, `known_measured`, `known_corners`: the same of N things that are known; `share`: of a width;
    `overlap`: intersection over union. Returns those of the rows that are kept.
    """
    kept, count = np.empty(len(rows), np.int64), 0
    for k in range(len(rows)):
        row, is_new = rows[k], True
        for n in range(len(known_locations) + count):
            known = n < len(known_locations)
            i = n if known else kept[n - len(known_locations)]
            others, boxes = (known_locations, known_corners) if known else (locations, corners)
            placed = known_measured[i] if known else measured[i]
            if measured[row]:
                x, y = locations[row, 0] - others[i, 0], locations[row, 1] - others[i, 1]
                if x * x + y * y < (share * others[i, 2]) ** 2:
                    is_new = False
            if is_new and not (measured[row] and placed):
                for c in range(len(corners)):
                    if _overlap_more(corners[c], row, boxes[c], i, overlap):
                        is_new = False
            if not is_new:
                break
        if is_new:
            kept[count] = row
            count += 1
    return kept[:count].copy()
