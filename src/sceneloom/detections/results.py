"""What detection fusion takes and gives: the boxes of a sweep and of an image, and the objects behind them."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, check_array, hold_arrays
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D

NO_BOX = -1
"""In an array of numbers of boxes: none."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectionPair:
    """The boxes of one sweep and of one image.

    Attributes:
        boxes_3d: in the lidar's frame (x forward, y left, z up) at the time of the sweep.
        boxes_2d: in the image.
        camera: its camera model.
        camera_from_lidar: takes the lidar's frame at the time of the sweep into the camera's at that of the image.
        points_lidar: (N, 3) float32 [m], points of the sweep in the lidar's frame at its time, or None: boxes of the
            image alone are placed by them.

    Raises:
        ArrayError: the points are no such array.
    """

    boxes_3d: Boxes3D
    boxes_2d: Boxes2D
    camera: Camera
    camera_from_lidar: RigidTransform
    points_lidar: Float32Array | None = None

    def __post_init__(self) -> None:
        check_array("pair.points_lidar", self.points_lidar, (None, 3), np.float32, optional=True)


@dataclass(frozen=True, slots=True, eq=False)
class FusedBoxes:
    """The objects behind the boxes of one sweep and one image.

    Attributes:
        timestamp_ns: of the sweep [ns].
        centers: (N, 3) float64 [m], lidar frame.
        center_covariances: (N, 3, 3) float64 [m²], lidar frame.
        sizes_lwh: (N, 3) float64 [m].
        size_covariances: (N, 3, 3) float64 [m²], length, width, height.
        yaws: (N,) float64 [rad], heading about z, counter-clockwise from x.
        velocities: (N, 3) float64 [m/s], lidar frame, or None.
        scores: (N,) float64, probability that the object exists.
        labels: N classes.
        corners_xyxy: (N, 4) float64 [px], corner convention, as in `Boxes2D`; zeros where the image does not show it.
        ids: (N,) int64, numbers of the objects in this pair.
        rows_3d: (N,) int64, which box of the sweep, or NO_BOX.
        rows_2d: (N,) int64, which box of the image, or NO_BOX.
        yaw_variances: (N,) float64 [rad²], or None.
        degrees_of_freedom: of the Student distribution of errors with these covariances
            (`noise.radius_squared`), infinite for a Gaussian one, or None where nothing is known of it.
        by_points: (N,) bool, whether points of the sweep behind a box of the image alone placed the object, or None
            where none were given.

    Raises:
        ArrayError: shapes or dtypes are wrong.

    Source: DB34/T 4101-2022, table 10.
    """

    timestamp_ns: int
    centers: Float64Array
    center_covariances: Float64Array
    sizes_lwh: Float64Array
    size_covariances: Float64Array
    yaws: Float64Array
    velocities: Float64Array | None
    scores: Float64Array
    labels: tuple[str, ...]
    corners_xyxy: Float64Array
    ids: Int64Array
    rows_3d: Int64Array
    rows_2d: Int64Array
    yaw_variances: Float64Array | None = None
    degrees_of_freedom: float | None = None
    by_points: BoolArray | None = None

    def __post_init__(self) -> None:
        count = hold_arrays(
            self,
            "fused",
            {
                "centers": (np.float64, "N", 3),
                "center_covariances": (np.float64, "N", 3, 3),
                "sizes_lwh": (np.float64, "N", 3),
                "size_covariances": (np.float64, "N", 3, 3),
                "yaws": (np.float64, "N"),
                "velocities?": (np.float64, "N", 3),
                "scores": (np.float64, "N"),
                "yaw_variances?": (np.float64, "N"),
                "corners_xyxy": (np.float64, "N", 4),
                "by_points?": (np.bool_, "N"),
                "ids": (np.int64, "N"),
                "rows_3d": (np.int64, "N"),
                "rows_2d": (np.int64, "N"),
            },
            frozen=True,
        )
        if len(self.labels) != count:
            raise ArrayError(f"fused.labels: {len(self.labels)}; expected {count}")

    def __len__(self) -> int:
        return len(self.centers)


class DetectionAlgorithm(Protocol):
    """How an algorithm of detection fusion is called."""

    def __call__(self, pair: DetectionPair, /) -> FusedBoxes:
        """Fuse the boxes of one sweep with those of one image."""
        ...


class BoxFrame(StrEnum):
    """The frame in which a detector's list states its boxes in space.

    Brought into the lidar's frame and back into the image by one stated transform, boxes show nothing of it: those of
    `CAMERA` and `WORLD` are the same pixels whatever the extrinsics of the lidar.
    """

    LIDAR = "lidar"
    CAMERA = "camera"
    WORLD = "world"


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
