"""Whether the boxes of images lie where those of sweeps state: a calibration that is wrong shows as a common rotate.

Of each image all couples of boxes are kept that may be one object: of one class and about as high. Most of them are
not one object, and their offsets are anywhere; those that are have the offset that errors of boxes and the calibration
leave.
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.detections.classes import numbers_of
from sceneloom.detections.common_rotation import (
    LEAST_AGREEING,
    NO_ROTATION,
    agreeing_with,
    chance_agreement,
    refined_rotation,
    rotation_covariance,
    rotation_slopes,
    voted_rotation,
)
from sceneloom.detections.outlines import boxes_with_area, boxes_with_position, project_outlines
from sceneloom.detections.results import DetectionPair
from sceneloom.scene.warnings import DataWarning, WarningKind
from sceneloom.visibility.outlines import CENTRE_TO_CORNER

WORTH_TELLING_DEG = 1.0
"""Rotates below may be those of boxes and of motion between sweep and image [°]."""
MOST_COUPLES = 4000
"""No more couples are kept."""
_ALIKE = 1.3
"""Boxes of one object are this much higher than one another at the most."""
_LEAST_PX, _BORDER_PX = 25.0, 3.0
_LEAST_DEPTH = 0.3
"""Cosine of the angle to the optical axis from which on tangents are of use."""
_BETTER = 1.2
"""So many times more couples must agree about a rotation than about none."""


@dataclass(frozen=True, slots=True)
class Misalignment:
    """By what rotate of what the lidar sees it comes together with the image.

    Attributes:
        rotation_deg: rotation vector in the camera's frame; `camera_from_lidar` after this rotation fits best [°].
        agreeing: couples of boxes that fit after it.
        agreeing_now: couples that fit without it.
    """

    rotation_deg: tuple[float, float, float]
    agreeing: int
    agreeing_now: int

    @property
    def angle_deg(self) -> float:
        """How large the rotation is [°]."""
        return float(np.linalg.norm(self.rotation_deg))

    @property
    def is_wrong(self) -> bool:
        """Whether the calibration is at fault."""
        return (
            self.agreeing >= LEAST_AGREEING
            and self.agreeing > _BETTER * self.agreeing_now
            and self.angle_deg >= WORTH_TELLING_DEG
        )


@dataclass(frozen=True, slots=True, eq=False)
class BoxRotation:
    """The rotation about which boxes of images and sweeps agree, and how sure that is.

    Attributes:
        rotation: (3,) rotation vector in the camera's frame; `camera_from_lidar` after this rotation fits best [rad].
        covariance: (3, 3), of it, by chance alone: what boxes of one detector have in common is not in it [rad²].
        agreeing: couples of boxes that fit after it.
        by_chance: couples that fit after the best of many other rotations.
        images: that show couples which fit.
    """

    rotation: Float64Array
    covariance: Float64Array
    agreeing: int
    by_chance: int
    images: int


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
        if self._count >= MOST_COUPLES or not len(pair.boxes_3d) or not len(pair.boxes_2d):
            return
        found = _couples(pair)
        self._couples.append(found)
        self._count += len(found)

    def misalignment(self) -> Misalignment | None:
        """Find the rotation about which most couples agree; None where there are too few."""
        if self._count < LEAST_AGREEING:
            return None
        couples = np.concatenate(self._couples)
        jacobian = rotation_slopes(couples)
        rotation = refined_rotation(couples, jacobian, voted_rotation(couples, jacobian))
        agreeing = agreeing_with(couples, jacobian, rotation)
        x, y, z = np.degrees(rotation).tolist()
        return Misalignment(
            (x, y, z), int(agreeing.sum()), int(agreeing_with(couples, jacobian, NO_ROTATION).sum())
        )

    def rotation(self) -> BoxRotation | None:
        """Find the rotation about which most couples agree, and how sure it is; None where there are too few."""
        if self._count < LEAST_AGREEING:
            return None
        couples = np.concatenate(self._couples)
        images = np.repeat(np.arange(len(self._couples)), [len(found) for found in self._couples])
        jacobian = rotation_slopes(couples)
        rotation = refined_rotation(couples, jacobian, voted_rotation(couples, jacobian))
        agreeing = agreeing_with(couples, jacobian, rotation)
        return BoxRotation(
            rotation,
            rotation_covariance(couples, jacobian, rotation, images),
            int(agreeing.sum()),
            int(chance_agreement(couples, jacobian, rotation)),
            len(np.unique(images[agreeing])),
        )

    def warnings(self, camera_id: str) -> list[DataWarning]:
        """What there is to state of a camera's calibration."""
        found = self.misalignment()
        if found is None or not found.is_wrong:
            return []
        rotation = ", ".join(f"{angle:+.1f}" for angle in found.rotation_deg)
        return [
            DataWarning(
                kind=WarningKind.ASSUMED,
                code="calibration-off",
                location=camera_id,
                message=f"the calibration was taken as it is, but boxes of images and sweeps come together after a "
                f"rotate of camera_from_lidar by ({rotation})° about the camera's axes: {found.agreeing} couples fit "
                f"then, "
                f"{found.agreeing_now} now",
            )
        ]


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
