"""What the fusion system gives, as records: fused sensor data and fused detections."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, UInt8Array, UInt32Array
from sceneloom.fusion.messages.basic_types import shown
from sceneloom.fusion.messages.boxes import COLUMNS_3D, check_corners
from sceneloom.fusion.messages.columns import Column, ColumnChecks, settle_classes, settle_ids, settled
from sceneloom.fusion.messages.encodings import ENCODINGS, check_pixels
from sceneloom.fusion.messages.sensor_data import check_fields, check_point_count
from sceneloom.fusion.messages.tables import FUSED_DETECTION, FUSED_DETECTIONS, SENSOR_FUSION
from sceneloom.fusion.messages.timestamps import Timestamp

DEPTH_KINDS = ("z", "range")
"""What a depth image can hold: the distance along the optical axis, or along the ray."""

POINT_FRAMES = ("lidar", "camera")
"""The frames that the points of a result can be in."""

COLUMNS_FUSED = (
    *COLUMNS_3D,
    Column("center_covs", ("center_cov",), shape=(3, 3)),
    Column("size_covs", ("size_cov",), shape=(3, 3)),
    Column("corners_xyxy", ("x1", "y1", "x2", "y2"), np.uint32, (4,)),
)
"""The columns of `FusedDetections`."""

_CHECKS = ColumnChecks(FUSED_DETECTION, COLUMNS_FUSED, group="detections")

_ASYMMETRY = 1e-3
"""How much a covariance of 32-bit numbers may differ from its transpose, of its largest number."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SensorFusionData:
    """A point cloud and an image after fusion.

    Attributes:
        timestamp: of the point cloud.
        image_seq, points_seq: numbers of the image and of the cloud.
        camera_id, lidar_id: 0 to 255.
        height, width: of the image [px].
        encoding: a name out of `ENCODINGS`.
        image_channel: values per pixel.
        image_data: uint8, height * width * image_channel values; kept flat and read-only.
        image_depth: float32 [m], height * width values, 0 where no point is seen; kept flat and read-only.
        point_num: how many points.
        point_fields: what each point has; x, y and z among it.
        fields_number: how many fields.
        point_data: float32, point_num * fields_number values; kept flat and read-only.
        class_name: empty; `class` in the standard.
        depth_kind: one of `DEPTH_KINDS`; None where it was not stated.
        point_frame: one of `POINT_FRAMES`; None where it was not stated.
        motion_compensated: 1 where the ego trajectory was taken into account.
        image_timestamp: of the image; None where it was not stated.

    Raises:
        DataError: a field is missing, of another type or out of range, or they do not belong together.

    Source: DB34/T 4101-2022, table 9.
    """

    timestamp: Timestamp
    image_seq: int
    points_seq: int
    camera_id: int
    lidar_id: int
    height: int
    width: int
    encoding: str
    image_channel: int
    image_data: UInt8Array
    image_depth: Float32Array
    point_num: int
    point_fields: tuple[str, ...]
    fields_number: int
    point_data: Float32Array
    class_name: str = ""
    depth_kind: str | None = None
    point_frame: str | None = None
    motion_compensated: int = 0
    image_timestamp: Timestamp | None = None

    def __post_init__(self) -> None:
        SENSOR_FUSION.settle(self)
        check_pixels(
            SENSOR_FUSION,
            self.encoding,
            size_hwc=(self.height, self.width, self.image_channel),
            length=self.image_data.size,
            channel_name="image_channel",
            data_name="image_data",
        )
        if self.image_depth.size != self.height * self.width:
            expected = f"{self.height * self.width} (width * height)"
            raise SENSOR_FUSION.fault("image_depth", f"{self.image_depth.size} values; expected {expected}")
        check_fields(SENSOR_FUSION, "point_fields", self.point_fields, self.fields_number)
        check_point_count(
            SENSOR_FUSION,
            names=("point_num", "point_data"),
            number=self.point_num,
            fields_number=self.fields_number,
            length=self.point_data.size,
        )
        for name, known in (("depth_kind", DEPTH_KINDS), ("point_frame", POINT_FRAMES)):
            word = getattr(self, name)
            if word is not None and word not in known:
                raise SENSOR_FUSION.fault(name, f"{shown(word)}; expected one of {', '.join(known)}")

    @property
    def pixels(self) -> UInt8Array | None:
        """The image, (height, width, image_channel) uint8, a view; None of a file, which wants decoding."""
        if ENCODINGS[self.encoding].is_file:
            return None
        return self.image_data.reshape(self.height, self.width, self.image_channel)

    @property
    def depths(self) -> Float32Array:
        """The depth image, (height, width) float32 [m], a view."""
        return self.image_depth.reshape(self.height, self.width)

    @property
    def points(self) -> Float32Array:
        """The points, (point_num, fields_number) float32, a view."""
        return self.point_data.reshape(self.point_num, self.fields_number)


@dataclass(frozen=True, slots=True, kw_only=True)
class FusedDetection:
    """One object, found in space, in an image, or in both.

    Attributes:
        id: number of the detection, an int32.
        confidence: probability that the object exists, 0 to 1.
        timestamp: time of the detection.
        class_name: class of the object; `class` in the standard.
        X, Y, Z: middle of the box [m], lidar frame.
        center_cov: 9 numbers [m²], 3x3 row-major.
        length, width, height: of the box [m]; more than 0 where there is a 3D box.
        size_cov: 9 numbers [m²], 3x3 row-major: length, width, height.
        direction: where it heads, lidar frame; not 0 where there is a 3D box.
        velocity: speed along the direction [m/s], negative for reversing.
        x1, y1, x2, y2: left, upper, right and lower edge in the image [px], uint32; all 0 of a detection that the
            image does not show: one behind the camera or beside its view.
        velocity_vector: velocity [m/s] along x, y, z, or None.
        box_3d_id, box_2d_id: the boxes it was made of; None for a sensor that did not see it.

    Raises:
        DataError: a field is missing, of another type or out of range, or they do not belong together.

    Source: DB34/T 4101-2022, table 10.
    """

    id: int
    confidence: float
    timestamp: Timestamp
    class_name: str
    X: float
    Y: float
    Z: float
    center_cov: tuple[float, ...]
    length: float
    width: float
    height: float
    size_cov: tuple[float, ...]
    direction: tuple[float, float, float]
    velocity: float
    x1: int
    y1: int
    x2: int
    y2: int
    velocity_vector: tuple[float, float, float] | None = None
    box_3d_id: int | None = None
    box_2d_id: int | None = None

    def __post_init__(self) -> None:
        FUSED_DETECTION.settle(self)
        check_corners(FUSED_DETECTION, np.array([[self.x1, self.y1, self.x2, self.y2]], np.uint32), group="")
        for name in ("center_cov", "size_cov"):
            _check_covariances(name, np.array(getattr(self, name), np.float32).reshape(1, 3, 3), group="")
        if self.box_3d_id is not None:
            sizes_lwh = np.array([[self.length, self.width, self.height]], np.float32)
            _check_seen_in_space(sizes_lwh, np.array([self.direction], np.float32), (0,), group="")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FusedDetections:
    """The fused detections of one point cloud and one image.

    Attributes:
        timestamp: of the point cloud.
        image_seq, points_seq: numbers of the image and of the cloud.
        camera_id, lidar_id: 0 to 255.
        id: (N,) int32.
        class_names: N classes.
        confidence: (N,) float32, 0 to 1.
        centers: (N, 3) float32 [m], lidar frame.
        center_covs: (N, 3, 3) float32 [m²], lidar frame.
        sizes_lwh: (N, 3) float32 [m]; more than 0 where there is a 3D box.
        size_covs: (N, 3, 3) float32 [m²]: length, width, height.
        directions: (N, 3) float32, lidar frame; not 0 where there is a 3D box.
        velocities: (N,) float32 [m/s] along the directions.
        corners_xyxy: (N, 4) uint32 [px]; zeros of a detection that the image does not show, see `in_image`.
        velocity_vectors: (N, 3) float32 [m/s], or None.
        box_3d_ids, box_2d_ids: the boxes that each was made of, None in them for a sensor that did not see it; None
            for N of None.
        motion_compensated: 1 where the ego trajectory was taken into account.
        image_timestamp: of the image; None where it was not stated.

    Raises:
        DataError: a field is missing, of another type or out of range; arrays have another shape or dtype.

    Source: DB34/T 4101-2022, table 10 and clause 5.7.
    """

    timestamp: Timestamp
    image_seq: int
    points_seq: int
    camera_id: int
    lidar_id: int
    id: AnyArray
    class_names: tuple[str, ...]
    confidence: Float32Array
    centers: Float32Array
    center_covs: Float32Array
    sizes_lwh: Float32Array
    size_covs: Float32Array
    directions: Float32Array
    velocities: Float32Array
    corners_xyxy: UInt32Array
    velocity_vectors: Float32Array | None = None
    box_3d_ids: tuple[int | None, ...] = None  # type: ignore[assignment]
    box_2d_ids: tuple[int | None, ...] = None  # type: ignore[assignment]
    motion_compensated: int = 0
    image_timestamp: Timestamp | None = None

    def __post_init__(self) -> None:
        FUSED_DETECTIONS.settle(self)
        count = _CHECKS.settle(self)
        settle_classes(self, FUSED_DETECTION, count, group="detections")
        for name in ("box_3d_id", "box_2d_id"):
            settle_ids(self, f"{name}s", FUSED_DETECTION.row(name), FUSED_DETECTION, count)
        check_corners(FUSED_DETECTION, self.corners_xyxy, group="detections")
        _check_covariances("center_cov", self.center_covs, group="detections")
        _check_covariances("size_cov", self.size_covs, group="detections")
        _check_seen_in_space(self.sizes_lwh, self.directions, self.box_3d_ids, group="detections")

    @classmethod
    def of_sound_numbers(cls, **fields: Any) -> "FusedDetections":
        """Make it of all its fields, whose numbers and shapes were checked already; they become read-only.

        Raises:
            DataError: a class is no name.
        """
        detections = settled(cls, COLUMNS_FUSED, fields)
        settle_classes(detections, FUSED_DETECTION, len(detections), group="detections")
        return detections

    @classmethod
    def empty(cls, timestamp: Timestamp, **pair: Any) -> "FusedDetections":
        """A pair in which nothing was found; `pair` are the fields that are not of one detection."""
        none: dict[str, Any] = {
            column.attribute: np.zeros((0, *column.shape), column.dtype)
            for column in COLUMNS_FUSED
            if not column.optional
        }
        return cls(timestamp=timestamp, class_names=(), **none, **pair)

    @property
    def in_image(self) -> BoolArray:
        """Which detections the image shows, (N,) bool: those whose outline has an area."""
        sides = self.corners_xyxy[:, 2:] > self.corners_xyxy[:, :2]
        shown: BoolArray = np.logical_and(sides[:, 0], sides[:, 1])
        return shown

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[FusedDetection]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> FusedDetection:
        X, Y, Z = self.centers[k].tolist()
        length, width, height = self.sizes_lwh[k].tolist()
        x1, y1, x2, y2 = self.corners_xyxy[k].tolist()
        vectors = self.velocity_vectors
        return FusedDetection(
            id=int(self.id[k]),
            confidence=float(self.confidence[k]),
            timestamp=self.timestamp,
            class_name=self.class_names[k],
            X=X,
            Y=Y,
            Z=Z,
            center_cov=tuple(self.center_covs[k].reshape(-1).tolist()),
            length=length,
            width=width,
            height=height,
            size_cov=tuple(self.size_covs[k].reshape(-1).tolist()),
            direction=tuple(self.directions[k].tolist()),
            velocity=float(self.velocities[k]),
            x1=x1,
            y1=y1,
            x2=x2,
            y2=y2,
            velocity_vector=None if vectors is None else tuple(vectors[k].tolist()),
            box_3d_id=self.box_3d_ids[k],
            box_2d_id=self.box_2d_ids[k],
        )


def _location(group: str, k: int, name: str) -> str:
    return f"{group}[{k}].{name}" if group else name


def _check_covariances(name: str, covariances: Float32Array, *, group: str) -> None:
    """Check that variances are not negative and covariances the same both ways."""
    mirrored = covariances.transpose(0, 2, 1)
    if (covariances == mirrored).all() and (covariances.reshape(-1, 9)[:, ::4] >= 0).all():
        return
    wide = covariances.astype(np.float64)
    asymmetry = np.abs(wide - wide.transpose(0, 2, 1)).max(axis=(1, 2))
    wrong = (asymmetry > _ASYMMETRY * np.abs(wide).max(axis=(1, 2))) | (
        wide.diagonal(axis1=1, axis2=2) < 0
    ).any(axis=1)
    if wrong.any():
        k = int(np.argmax(wrong))
        numbers = covariances[k].reshape(-1).tolist()
        expected = "expected a symmetric 3x3 matrix without negative variances"
        raise FUSED_DETECTION.fault(_location(group, k, name), f"{numbers}; {expected}")


def _check_seen_in_space(
    sizes_lwh: Float32Array, directions: Float32Array, box_3d_ids: tuple[int | None, ...], *, group: str
) -> None:
    """Check that what a lidar saw has a size and heads somewhere."""
    seen = np.array([number is not None for number in box_3d_ids], np.bool_)
    for j, name in enumerate(("length", "width", "height")):
        flat = seen & (sizes_lwh[:, j] <= 0)
        if flat.any():
            raise FUSED_DETECTION.fault(
                _location(group, int(np.argmax(flat)), name), "0.0; expected more than 0"
            )
    headless = seen & ~directions.any(axis=1)
    if headless.any():
        location = _location(group, int(np.argmax(headless)), "direction")
        raise FUSED_DETECTION.fault(location, "(0.0, 0.0, 0.0); expected a vector other than 0")
