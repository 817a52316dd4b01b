"""States of tracked objects: motion model, existence probability, the table of objects, and their boxes in images.

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
with the probability s of its own moment, where π is the prior one, changes the odds of p by

    odds ← odds · ([s / (1 - s)] / [π / (1 - π)])ʷ,

and a moment without any box, where detectors had the chances D to find it, by

    odds ← odds · ((1 - D_2d) (1 - D_3d))ʷ.

The exponent w is below 1 since moments are not independent: what was mistaken or hidden once is likely to be again.

Source: Thrun, Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2 for log odds; Musicki, Evans and Stankovic 1994,
"Integrated Probabilistic Data Association", for existence that is lost with time and by missed detections.

A detector's box is not the outline of the box in space: arms and shadows, sizes and locations that are a little off.
How it differs changes slowly: its middle by shares of the outline's sides, its sides by factors. These four numbers are
filtered, so that the box in the next image is foreseen well, and so that one image's noise does not count in full.
"""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.colouring.box_outlines import widest_angle
from sceneloom.detections.projection import Outlines, project_outlines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import tracking
from sceneloom.scene.types import Identifier
from sceneloom.tracking.observation import View
from sceneloom.tracking.settings import TrackerSettings

SIZE, _MEASURED = tracking.SIZE, tracking.MEASURED

YAW, ROTATION = 6, 10

_FREEDOM = 4.0
"""Degrees of freedom of what boxes are off."""

_CLIMB = 0.3
"""Deviation of vertical accelerations [m/s²]."""

_SIZE_DRIFT = 0.02
"""How much sizes change as objects are seen from other sides [m after a second]."""

_VEHICLE_HEADING_DRIFT, _PERSON_HEADING_DRIFT = 0.02, 0.5
"""How much headings change beside rotating [rad after a second]."""

_ACROSS = 0.3
"""Acceleration of vehicles across their heading, as a share of that along it."""

_ROTATION_TIME = 1.0
"""Time after which a rotation has died down [s]."""


def wrapped(angles: Float64Array) -> Float64Array:
    """Angles as those from -π to π."""
    result: Float64Array = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return result


def predicted(
    means: Float64Array,
    covariances: Float64Array,
    vehicles: BoolArray,
    seconds: float,
    settings: TrackerSettings,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Move states on.

    Args:
        means, covariances: (N, 11) and (N, 11, 11).
        vehicles: (N,), whether they move as vehicles do.
        seconds: how long.
        settings: how strongly they change their motion.

    Returns:
        Means and covariances afterwards, and the slopes (N, 11, 11) of the means.
    """
    fast, slow = settings.vehicle_acceleration, settings.person_acceleration
    rotating = settings.yaw_acceleration
    deviations = np.array(
        [
            [slow, slow, _CLIMB, _SIZE_DRIFT, _PERSON_HEADING_DRIFT, rotating],
            [fast, _ACROSS * fast, _CLIMB, _SIZE_DRIFT, _VEHICLE_HEADING_DRIFT, rotating],
        ]
    )
    moved: tuple[Float64Array, Float64Array, Float64Array] = tracking.predict(
        means, covariances, vehicles, seconds, _ROTATION_TIME, deviations**2
    )
    return moved


def read(
    means: Float64Array,
    covariances: Float64Array,
    rows: Int64Array,
    measures: Float64Array,
    noises: Float64Array,
    columns: Int64Array,
) -> None:
    """Read of some states a box each, in place.

    Args:
        means, covariances: (N, 11) and (N, 11, 11).
        rows: (K,), which of them.
        measures, noises: (M, 7) and (M, 7, 7); headings off by more than a right angle are taken the other way round.
        columns: (K,), the box of each.
    """
    tracking.read_boxes(means, covariances, rows, measures, noises, columns, _FREEDOM)


def read_no_slip(
    means: Float64Array, covariances: Float64Array, vehicles: BoolArray, side_slip: float
) -> None:
    """Read of vehicles, in place, that they do not move across their heading, but for so much [m/s]."""
    tracking.read_no_slip(means, covariances, vehicles, side_slip**2)


def probabilities(log_odds: Float64Array) -> Float64Array:
    """Give logarithms of odds as probabilities."""
    shares: Float64Array = 1.0 / (1.0 + np.exp(-log_odds))
    return shares


def log_odds(share: float) -> float:
    """Give a probability between 0 and 1 as a logarithm of odds."""
    with np.errstate(divide="ignore"):
        return float(np.log(share) - np.log1p(-share))


def aged(odds: Float64Array, seconds: float, lifetime: float) -> Float64Array:
    """Logarithms of odds after so long without a look."""
    likely = probabilities(odds) * np.exp(-seconds / lifetime)
    older: Float64Array = np.log(likely / (1.0 - likely)) if seconds > 0.0 else odds
    return older


def missed(lines: Outlines, distances: Float64Array, settings: TrackerSettings) -> Float64Array:
    """How little it says of each object that neither detector finds it, by what one camera sees: logarithms of 1 - D.

    Args:
        lines: where the image shows the objects, and how openly.
        distances: (N,) float64 [m], from the lidar.
        settings: what the detectors find.

    Returns:
        (N, 2) float64, of images and of sweeps.
    """
    corners = lines.corners_xyxy
    tall = corners[:, 3] - corners[:, 1] >= settings.least_height_px
    near = distances < settings.farthest_3d
    recalls = np.column_stack([settings.recall_2d * tall, settings.recall_3d * near])
    chances: Float64Array = np.log1p(-recalls * lines.seen_shares[:, None])
    return chances


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
            means=np.zeros((0, SIZE)),
            covariances=np.zeros((0, SIZE, SIZE)),
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


_EDGE_PX, _EDGE_SHARE = 1.0, 0.02
"""Deviation of an edge of a detector's box: so many pixels, plus so much of its side."""

DRIFTS = (0.05, 0.3)
"""How much a box comes to differ from the outline, as shares of its sides: of vehicles and people [after a second]."""

UNKNOWN = 0.15**2
"""Variance of how they differ before anything is known of it."""


def outlines(
    numbers: Float64Array, likely: Float64Array, world_from_lidar: RigidTransform, view: View
) -> Outlines:
    """Where an image shows boxes of the world.

    Args:
        numbers: (N, 7), middle, length, width, height [m] and heading [rad].
        likely: (N,), how likely each is there, and hides what is behind it.
        world_from_lidar: where the lidar is.
        view: the camera.
    """
    rotation = world_from_lidar.rotation
    cosines, sines = np.cos(numbers[:, 6]), np.sin(numbers[:, 6])
    boxes = numbers.copy()
    boxes[:, :3] = (numbers[:, :3] - world_from_lidar.translation) @ rotation
    boxes[:, 6] = np.arctan2(
        rotation[0, 1] * cosines + rotation[1, 1] * sines, rotation[0, 0] * cosines + rotation[1, 0] * sines
    )
    in_view = _in_view(boxes, view)
    if in_view.all():
        return project_outlines(view.camera, view.camera_from_lidar, boxes, likely=likely)
    found = project_outlines(view.camera, view.camera_from_lidar, boxes[in_view], likely=likely[in_view])
    return Outlines(*(_spread(getattr(found, f.name), in_view) for f in fields(found)))


def _in_view(boxes: Float64Array, view: View) -> BoolArray:
    """Which boxes may be in the image: not those whose ball lies outside the cone that it shows.

    To find where such a box leaves the camera model, which it never enters, is slow.
    """
    middles = boxes[:, :3] @ view.camera_from_lidar.rotation.T + view.camera_from_lidar.translation
    away = np.sqrt((middles**2).sum(axis=1))
    reach = np.sqrt((boxes[:, 3:6] ** 2).sum(axis=1)) / 2.0
    angles = np.arctan2(np.hypot(middles[:, 0], middles[:, 1]), middles[:, 2])
    balls = np.arcsin(np.minimum(reach / np.maximum(away, 1e-9), 1.0))
    in_view: BoolArray = (angles - balls < widest_angle(view.camera)) | (reach >= away)
    return in_view


def _spread(rows: Float64Array, chosen: BoolArray) -> Float64Array:
    """Rows in their locations among all, zeros between them."""
    every = np.zeros((len(chosen), *rows.shape[1:]))
    every[chosen] = rows
    return every


def filtered(
    differing: Float64Array, variances: Float64Array, corners: Float64Array, outlined: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Read how boxes of an image differ from outlines.

    Args:
        differing, variances: (N, 4), what is known of it, NaN where nothing is.
        corners: (N, 4) [px], boxes of the detector, NaN where there are none.
        outlined: (N, 4) [px], zeros where there are none.
    """
    fresh = np.isnan(differing)
    means, variances = np.where(fresh, 0.0, differing), np.where(fresh, UNKNOWN, variances)
    seen = np.flatnonzero(has_area(corners) & has_area(outlined))
    apart = differences(corners[seen], outlined[seen])
    gains = variances[seen] / (variances[seen] + noises(corners[seen]))
    means[seen] += gains * (apart - means[seen])
    variances[seen] *= 1.0 - gains
    return means, variances


def differences(corners: Float64Array, outlined: Float64Array) -> Float64Array:
    """Shifts of the middles of boxes (N, 4) from those of outlines, and logarithms of the factors of their sides."""
    sides, usual = corners[:, 2:] - corners[:, :2], outlined[:, 2:] - outlined[:, :2]
    shifts = ((corners[:, :2] + corners[:, 2:]) - (outlined[:, :2] + outlined[:, 2:])) / (2.0 * usual)
    return np.concatenate([shifts, np.log(sides / usual)], axis=1)


def noises(corners: Float64Array) -> Float64Array:
    """Variances (N, 4) of the differences of a detector's boxes: of a middle half, of a side twice those of an edge."""
    edges = (_EDGE_PX / (corners[:, 2:] - corners[:, :2]) + _EDGE_SHARE) ** 2
    return np.concatenate([edges / 2.0, edges * 2.0], axis=1)


def applied(differing: Float64Array, outlined: Float64Array, width: int, height: int) -> Float64Array:
    """The boxes that differ so from outlines, cut at the image; NaN where there is no outline.

    Args:
        differing: (N, 4), NaN where nothing is known of it.
        outlined: (N, 4) [px].
        width, height: of the image [px].
    """
    known = np.where(np.isnan(differing), 0.0, differing)
    sides = outlined[:, 2:] - outlined[:, :2]
    middles = (outlined[:, :2] + outlined[:, 2:]) / 2.0 + known[:, :2] * sides
    halves = sides * np.exp(known[:, 2:]) / 2.0
    corners = np.concatenate([middles - halves, middles + halves], axis=1)
    corners = np.clip(corners, 0.0, (width, height, width, height))
    corners[~(has_area(outlined) & has_area(corners))] = np.nan
    boxes: Float64Array = corners
    return boxes


def has_area(corners: Float64Array) -> BoolArray:
    """Which boxes (N, 4) have an area; those with NaN have none."""
    area: BoolArray = (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])
    return area
