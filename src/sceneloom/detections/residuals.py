"""Whether the boxes of pictures lie where those of sweeps say: a calibration that is wrong shows as a common turn.

Of each picture all couples of boxes are kept that may be one object: of one class and about as high. Most of them are
not one object, and their offsets are anywhere; those that are have the offset that errors of boxes and the calibration
leave. A turn ω of what the lidar sees moves a ray r by ω × r, in tangents (x, y) of the angles

    Δx = ω₂ (1 + x²) - ω₁ x y - ω₃ y,    Δy = ω₂ x y - ω₁ (1 + y²) + ω₃ x.

Votes find the turn about which most couples agree, coarsely; least squares over those make it exact.

Source: votes for parameters: Duda and Hart 1972, "Use of the Hough Transformation to Detect Lines and Curves in
Pictures"; motion of the picture under a turn: Longuet-Higgins and Prazdny 1980, eq. 2.
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.detections.classes import numbers_of
from sceneloom.detections.outlines import project_outlines
from sceneloom.detections.results import DetectionPair
from sceneloom.kernels import sound_boxes
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.visibility.outlines import CENTRE_TO_CORNER

LARGEST_DEG = 5.0
"""Turns beyond are not looked for [°]."""
WORTH_TELLING_DEG = 1.0
"""Turns below may be those of boxes and of motion between sweep and picture [°]."""
LEAST_AGREEING = 20
"""So many couples must agree."""
MOST_COUPLES = 4000
"""No more couples are kept."""
_STEP_DEG = 0.5
_ALIKE = 1.3
"""Boxes of one object are this much higher than one another at the most."""
_LEAST_PX, _BORDER_PX = 25.0, 3.0
_LEAST_DEPTH = 0.3
"""Cosine of the angle to the optical axis from which on tangents are of use."""
_ROUNDS = 10
_BETTER = 1.2
"""So many times more couples must agree about a turn than about none."""


@dataclass(frozen=True, slots=True)
class Misalignment:
    """By what turn of what the lidar sees it comes together with the picture.

    Attributes:
        rotation_deg: rotation vector in the camera's frame; `camera_from_lidar` after this turn fits best [°].
        agreeing: couples of boxes that fit after it.
        agreeing_now: couples that fit without it.
    """

    rotation_deg: tuple[float, float, float]
    agreeing: int
    agreeing_now: int

    @property
    def angle_deg(self) -> float:
        """How large the turn is [°]."""
        return float(np.linalg.norm(self.rotation_deg))

    @property
    def is_wrong(self) -> bool:
        """Whether the calibration is at fault."""
        return (
            self.agreeing >= LEAST_AGREEING
            and self.agreeing > _BETTER * self.agreeing_now
            and self.angle_deg >= WORTH_TELLING_DEG
        )


class BoxResiduals:
    """Collects couples of boxes over the pictures of one camera."""

    def __init__(self) -> None:
        self._couples: list[Float64Array] = []
        self._count = 0

    def add(self, pair: DetectionPair) -> None:
        """Take the boxes of a pair, unless there are enough already.

        Raises:
            CalibrationError: the lens is unknown.
        """
        if self._count >= MOST_COUPLES or not len(pair.boxes_3d) or not len(pair.boxes_2d):
            return
        found = _couples(pair)
        self._couples.append(found)
        self._count += len(found)

    def misalignment(self) -> Misalignment | None:
        """Find the turn about which most couples agree; None where there are too few."""
        if self._count < LEAST_AGREEING:
            return None
        couples = np.concatenate(self._couples)
        jacobian = _jacobian(couples)
        turn = _refined(couples, jacobian, _voted(couples, jacobian))
        agreeing = _agreeing(couples, jacobian, turn)
        x, y, z = np.degrees(turn).tolist()
        return Misalignment((x, y, z), int(agreeing.sum()), int(_agreeing(couples, jacobian, _NO_TURN).sum()))

    def notices(self, camera_id: str) -> list[Notice]:
        """What there is to say of a camera's calibration."""
        found = self.misalignment()
        if found is None or not found.is_wrong:
            return []
        turn = ", ".join(f"{angle:+.1f}" for angle in found.rotation_deg)
        return [
            Notice(
                kind=NoticeKind.ASSUMED,
                code="calibration-off",
                place=camera_id,
                message=f"the calibration was taken as it is, but boxes of pictures and sweeps come together after a "
                f"turn of camera_from_lidar by ({turn})° about the camera's axes: {found.agreeing} couples fit then, "
                f"{found.agreeing_now} now",
            )
        ]


_NO_TURN = np.zeros(3)


def _couples(pair: DetectionPair) -> Float64Array:
    """Couples of boxes that may be one object, (C, 5): x, y and offsets Δx, Δy of tangents, and what fits."""
    three, two, camera = pair.boxes_3d, pair.boxes_2d, pair.camera
    boxes, rows_3d = sound_boxes.boxes_with_place(three.centers, three.sizes_lwh, three.yaws)
    corners, rows_2d = sound_boxes.boxes_with_area(two.corners_xyxy)
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


def _jacobian(couples: Float64Array) -> Float64Array:
    """How a turn moves tangents, (C, 2, 3)."""
    x, y = couples[:, 0], couples[:, 1]
    across = np.column_stack([-x * y, 1.0 + x * x, -y])
    down = np.column_stack([-(1.0 + y * y), x * y, x])
    return np.stack([across, down], axis=1)


def _agreeing(couples: Float64Array, jacobian: Float64Array, turn: Float64Array) -> BoolArray:
    left = couples[:, 2:4] - jacobian @ turn
    found: BoolArray = np.hypot(left[:, 0], left[:, 1]) < couples[:, 4]
    return found


def _voted(couples: Float64Array, jacobian: Float64Array) -> Float64Array:
    """The turn of a grid about which most couples agree; of equal ones the smallest."""
    angles = np.radians(np.arange(-LARGEST_DEG, LARGEST_DEG + _STEP_DEG / 2, _STEP_DEG))
    edges = np.append(angles - np.radians(_STEP_DEG) / 2, angles[-1] + np.radians(_STEP_DEG) / 2)
    best, found = -np.inf, _NO_TURN
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


def _refined(couples: Float64Array, jacobian: Float64Array, turn: Float64Array) -> Float64Array:
    """Least squares over the couples that agree, again and again."""
    for _ in range(_ROUNDS):
        rows = _agreeing(couples, jacobian, turn)
        if rows.sum() < LEAST_AGREEING:
            return turn
        weights = 1.0 / couples[rows, 4]
        slopes = (jacobian[rows] * weights[:, None, None]).reshape(-1, 3)
        offsets = (couples[rows, 2:4] * weights[:, None]).ravel()
        turn = np.linalg.lstsq(slopes, offsets, rcond=None)[0]
    return turn
