"""Whether image boxes lie where boxes of sweeps project: a wrong calibration shows as a common rotation.

A couple is x and y, tangents of the angles of what the sweep shows, how far the image has it from there, and how far
off it may be: five numbers. A rotation ω of what the lidar sees moves a ray r by ω × r, in tangents

    Δx = ω₂ (1 + x²) - ω₁ x y - ω₃ y,    Δy = ω₂ x y - ω₁ (1 + y²) + ω₃ x.

Votes find the rotation about which most couples agree, coarsely; least squares over those make it exact. Boxes of one
object err alike from image to image, so blocks of successive images are drawn anew to report how sure it is.

Source: votes for parameters: Duda and Hart 1972, "Use of the Hough Transformation to Detect Lines and Curves in
Images"; motion of the image under a rotation: Longuet-Higgins and Prazdny 1980, eq. 2; bootstrap over blocks: Künsch
1989, "The Jackknife and the Bootstrap for General Stationary Observations".

Of each image all couples of boxes are kept that may be one object: of one class and about as high. Most of them are
not one object, and their offsets are anywhere; those that are have the offset that errors of boxes and the calibration
leave.
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.colouring.cuboid_projection import CENTRE_TO_CORNER
from sceneloom.detections.detectors import numbers_of
from sceneloom.detections.projection import project_outlines
from sceneloom.detections.results import BoxRotation, DetectionPair
from sceneloom.kernels.box_fusion import boxes_with_area, boxes_with_position
from sceneloom.warnings import DataWarning, assumed

_LARGEST_DEG = 5.0  # rotates beyond are not looked for [°]
_LEAST_AGREEING = 20  # so many couples must agree

_NO_ROTATION = np.zeros(3)
_STEP_DEG = 0.5
_ROUNDS = 10
_BLOCKS, _REPLICATES, _REPLICATE_ROUNDS = 20, 100, 5

_CHANCES, _CHANCE_DEG = 48, (3.0, 8.0)
"""So many rotates, so far away from the one that was found, report what chance makes of couples."""

_SEED = 0


def _rotation_slopes(couples: Float64Array) -> Float64Array:
    """How a rotation moves tangents, (C, 2, 3)."""
    x, y = couples[:, 0], couples[:, 1]
    across = np.column_stack([-x * y, 1.0 + x * x, -y])
    down = np.column_stack([-(1.0 + y * y), x * y, x])
    return np.stack([across, down], axis=1)


def _agreeing_with(couples: Float64Array, jacobian: Float64Array, rotation: Float64Array) -> BoolArray:
    """Which couples, (C,), come together after a rotation [rad]."""
    left = couples[:, 2:4] - jacobian @ rotation
    found: BoolArray = np.hypot(left[:, 0], left[:, 1]) < couples[:, 4]
    return found


def _voted_rotation(couples: Float64Array, jacobian: Float64Array) -> Float64Array:
    """The rotation of a grid about which most couples agree; of equal ones the smallest."""
    angles = np.radians(np.arange(-_LARGEST_DEG, _LARGEST_DEG + _STEP_DEG / 2, _STEP_DEG))
    edges = np.append(angles - np.radians(_STEP_DEG) / 2, angles[-1] + np.radians(_STEP_DEG) / 2)
    best, found = -np.inf, _NO_ROTATION
    for roll in angles.tolist():
        left = couples[:, 2:4] - jacobian[:, :, 2] * roll
        votes = np.histogram2d(left[:, 0], -left[:, 1], bins=(edges, edges))[0]
        spread = votes.copy()
        spread[1:] += votes[:-1]
        spread[:-1] += votes[1:]
        spread[:, 1:], spread[:, :-1] = spread[:, 1:] + votes[:, :-1], spread[:, :-1] + votes[:, 1:]
        yaw, pitch = np.unravel_index(int(spread.argmax()), spread.shape)
        worth = float(spread[yaw, pitch]) - 1e-3 * abs(roll)
        if worth > best:
            best, found = worth, np.array([angles[pitch], angles[yaw], roll])
    return found


def _refined_rotation(couples: Float64Array, jacobian: Float64Array, rotation: Float64Array) -> Float64Array:
    """Least squares over the couples that agree, again and again."""
    for _ in range(_ROUNDS):
        rows = _agreeing_with(couples, jacobian, rotation)
        if rows.sum() < _LEAST_AGREEING:
            return rotation
        weights = 1.0 / couples[rows, 4]
        slopes = (jacobian[rows] * weights[:, None, None]).reshape(-1, 3)
        offsets = (couples[rows, 2:4] * weights[:, None]).ravel()
        rotation = np.linalg.lstsq(slopes, offsets, rcond=None)[0]
    return rotation


def _rotation_covariance(
    couples: Float64Array, jacobian: Float64Array, rotation: Float64Array, images: Int64Array
) -> Float64Array:
    """How the rotation scatters when blocks of successive images are drawn anew, (3, 3) [rad²]."""
    # couples (C, 5) have slopes (C, 2, 3) and are of `images` (C,)
    near = np.hypot(*(couples[:, 2:4] - jacobian @ rotation).T) < 3.0 * couples[:, 4]
    _, order = np.unique(images, return_inverse=True)
    count = min(int(order.max()) + 1, _BLOCKS)
    block = (order * count // (order.max() + 1))[near]
    generator = np.random.default_rng(_SEED)
    found = []
    for _ in range(_REPLICATES):
        drawn = np.bincount(generator.integers(count, size=count), minlength=count)
        found.append(_weighted_rotation(couples[near], jacobian[near], rotation, drawn[block].astype(np.float64)))
    return np.atleast_2d(np.cov(np.array(found).T))


def _weighted_rotation(
    couples: Float64Array, jacobian: Float64Array, rotation: Float64Array, counts: Float64Array
) -> Float64Array:
    """The rotation that couples agree about when each counts some times."""
    weights = counts / couples[:, 4] ** 2
    for _ in range(_REPLICATE_ROUNDS):
        chosen = np.where(_agreeing_with(couples, jacobian, rotation), weights, 0.0)
        weighted = jacobian * chosen[:, None, None]
        normal = np.einsum("cki,ckj->ij", weighted, jacobian)
        rotation = np.linalg.lstsq(normal, np.einsum("cki,ck->i", weighted, couples[:, 2:4]), rcond=None)[0]
    return rotation


def _chance_agreement(couples: Float64Array, jacobian: Float64Array, rotation: Float64Array) -> float:
    """The largest number of couples that agree about one of many rotates far away from the one that was found."""
    generator = np.random.default_rng(_SEED)
    away = generator.normal(size=(_CHANCES, 3)) * np.array([1.0, 1.0, 0.0])
    away *= (np.radians(generator.uniform(*_CHANCE_DEG, _CHANCES)) / np.linalg.norm(away, axis=1))[:, None]
    return float(max(_agreeing_with(couples, jacobian, rotation + step).sum() for step in away))


_MOST_COUPLES = 4000  # no more couples are kept
_ALIKE = 1.3  # boxes of one object are this much higher than one another at the most

_LEAST_PX, _BORDER_PX = 25.0, 3.0

_LEAST_DEPTH = 0.3  # cosine of the angle to the optical axis from which on tangents are of use
_BETTER = 1.2  # so many times more couples must agree about a rotation than about none


_TOLD_DEG = 1.0  # rotations below may be those of boxes and of motion between sweep and image [°]


class BoxResiduals:
    """Collects couples of boxes over the images of one camera."""

    def __init__(self) -> None:
        self._couples: list[Float64Array] = []
        self._count = 0

    def add(self, pair: DetectionPair) -> None:
        """Take the boxes of a pair, unless there are enough already.

        Raises:
            CalibrationError: the camera model is unknown.
        """
        if self._count >= _MOST_COUPLES or not len(pair.boxes_3d) or not len(pair.boxes_2d):
            return
        found = _couples(pair)
        self._couples.append(found)
        self._count += len(found)

    def rotation(self) -> BoxRotation | None:
        """Find the rotation about which most couples agree, and how sure it is; None where there are too few."""
        found = self._found()
        if found is None:
            return None
        couples, jacobian, rotation, agreeing = found
        images = np.repeat(np.arange(len(self._couples)), [len(each) for each in self._couples])
        return BoxRotation(
            rotation,
            _rotation_covariance(couples, jacobian, rotation, images),
            int(agreeing.sum()),
            int(_chance_agreement(couples, jacobian, rotation)),
            len(np.unique(images[agreeing])),
        )

    def warnings(self, camera_id: str) -> list[DataWarning]:
        """What there is to state of a camera's calibration: that another rotation fits clearly better."""
        found = self._found()
        if found is None:
            return []
        couples, jacobian, rotation, agrees = found
        agreeing, now = int(agrees.sum()), int(_agreeing_with(couples, jacobian, _NO_ROTATION).sum())
        angles = np.degrees(rotation)
        if agreeing < _LEAST_AGREEING or agreeing <= _BETTER * now or np.linalg.norm(angles) < _TOLD_DEG:
            return []
        message = (
            "the calibration was taken as it is, but boxes of sweeps and images come together after the former are "
            f"rotated by ({', '.join(f'{angle:+.1f}' for angle in angles)})° about the camera's axes: "
            f"{agreeing} couples fit then, {now} now"
        )
        return [assumed("calibration-off", camera_id, message)]

    def _found(self) -> tuple[Float64Array, Float64Array, Float64Array, BoolArray] | None:
        """All couples, their slopes, the rotation about which most agree, and which do; None where there are few."""
        if self._count < _LEAST_AGREEING:
            return None
        couples = np.concatenate(self._couples)
        jacobian = _rotation_slopes(couples)
        rotation = _refined_rotation(couples, jacobian, _voted_rotation(couples, jacobian))
        return couples, jacobian, rotation, _agreeing_with(couples, jacobian, rotation)


def _couples(pair: DetectionPair) -> Float64Array:
    """Couples of boxes that may be one object, (C, 5): x, y and offsets Δx, Δy of tangents, and what fits."""
    three, two, camera = pair.boxes_3d, pair.boxes_2d, pair.camera
    boxes, rows_3d = boxes_with_position(three.centers, three.sizes_lwh, three.yaws)
    corners, rows_2d = boxes_with_area(two.corners_xyxy)
    classes_3d, classes_2d = numbers_of(
        [three.labels[k] for k in rows_3d.tolist()], [two.labels[k] for k in rows_2d.tolist()]
    )
    shown = project_outlines(camera, pair.camera_from_lidar, boxes).corners_xyxy
    first, second = _whole(shown, camera), _whole(corners, camera)
    heights, others = (table[:, 3] - table[:, 1] for table in (shown, corners))
    alike = (classes_3d[first, None] == classes_2d[second]) & (
        np.abs(np.log(heights[first, None] / others[second])) < np.log(_ALIKE)
    )
    i, j = np.nonzero(alike)
    rays, seen = _tangents(camera, shown[first[i]]), _tangents(camera, corners[second[j]])
    # boxes are off by some pixels and a share of their size
    fits = (2.0 + 0.1 * heights[first[i]]) / camera.fy
    found = np.column_stack([rays, seen - rays, fits])
    sound: Float64Array = found[np.isfinite(found).all(axis=1)]
    return sound


def _whole(corners: Float64Array, camera: Camera) -> Int64Array:
    """Rows of boxes that the border does not cut, and which are not tiny."""
    inside = (corners[:, :2] > _BORDER_PX).all(axis=1) & (corners[:, 2] < camera.width - _BORDER_PX)
    inside &= (corners[:, 3] < camera.height - _BORDER_PX) & (corners[:, 3] - corners[:, 1] >= _LEAST_PX)
    return np.flatnonzero(inside)


def _tangents(camera: Camera, corners: Float64Array) -> Float64Array:
    """Tangents of the angles of the middles of boxes, (N, 2); NaN where they are of no use."""
    rays = unproject(camera, (corners[:, :2] + corners[:, 2:]) / 2.0 - CENTRE_TO_CORNER)
    depths = np.where(rays[:, 2] > _LEAST_DEPTH, rays[:, 2], np.nan)
    tangents: Float64Array = rays[:, :2] / depths[:, None]
    return tangents
