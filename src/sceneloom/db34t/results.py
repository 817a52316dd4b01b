"""Results of the fusion system as records of tables 9 and 10, in the coordinate frames that the session declares."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.records import FusedDetections
from sceneloom.db34t.scene_objects import whole_corners
from sceneloom.db34t.setting import Setting
from sceneloom.detections.results import FusedBoxes
from sceneloom.fusion.system import FusedDetectionFrame
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.box_fusion import single_precision


@dataclass(frozen=True, slots=True, eq=False)
class FoundObjects:
    """The objects of a sweep and an image, and where the lidar was.

    Attributes:
        frame: the objects, in the lidar's frame of the standard axes.
        world_from_lidar: at the time of the sweep; the identity where the ego trajectory did not count.
        origin: (3,) float64 [m], where that world's origin is in the world of the vehicle's trajectory.
        setting: the configuration in force when the sweep came.
    """

    frame: FusedDetectionFrame
    world_from_lidar: RigidTransform
    origin: Float64Array
    setting: Setting


def tracked_detections_record(
    record: FusedDetections, fused: FusedBoxes, setting: Setting, camera: Camera
) -> FusedDetections:
    """The record of a sweep and an image with tracks (in the lidar's standard axes) instead of its objects.

    Boxes are cut to the size of the camera's image.
    """
    columns, _ = declared_columns(fused, setting.declared_from_standard, camera)
    none: tuple[None, ...] = (None,) * len(fused)
    numbers = (fused.ids & (2**31 - 1)).astype(np.int32)
    return replace(record, id=numbers, class_names=fused.labels, box_3d_ids=none, box_2d_ids=none, **columns)


def declared_columns(
    fused: FusedBoxes, declared_from_standard: Float64Array, camera: Camera
) -> tuple[dict[str, Any], bool]:
    """The columns of numbers of objects as records of table 10 have them, and whether all of them make sense.

    Scores are cut to 0 to 1, covariances made symmetric, and boxes rounded outwards to whole pixels within the camera's
    image. Objects make sense where all numbers are finite, no size or variance is below 0, no box is inside out, and
    what a lidar saw has a size.

    Args:
        declared_from_standard: (3, 3) float64, a signed permutation: from the standard axes of the lidar to those of
            the record.
    """
    velocities = np.zeros((len(fused), 3)) if fused.velocities is None else fused.velocities
    *numbers, sound = single_precision(
        fused.scores,
        fused.centers,
        fused.center_covariances,
        fused.sizes_lwh,
        fused.size_covariances,
        fused.yaws,
        velocities,
        fused.rows_3d,
        np.ascontiguousarray(declared_from_standard),
    )
    columns: dict[str, Any] = dict(zip(_COLUMNS, numbers, strict=True))
    corners = whole_corners(fused.corners_xyxy, (camera.width, camera.height))
    sound = sound and bool((corners[:, :2] <= corners[:, 2:]).all())
    # what is cut off at the image's edge is beside the view, and has no outline
    corners[~(corners[:, 2:] > corners[:, :2]).all(axis=1)] = 0
    columns["corners_xyxy"] = corners
    if fused.velocities is None:
        columns["velocity_vectors"] = None
    return columns, sound


_COLUMNS = (
    *("confidence", "centers", "center_covs", "sizes_lwh", "size_covs", "directions"),
    *("velocities", "velocity_vectors"),
)  # what `single_precision` gives
