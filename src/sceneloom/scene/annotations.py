"""Annotations of the Sensor Fusion Scene format: attributes, cuboids, 2D boxes, shapes, keypoints, labelled points.

Relations and corrections.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import (
    Float64Array,
    Int64Array,
    UInt32Array,
    as_array,
    check_array,
    check_count,
    hold_arrays,
    hold_timestamp,
)
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class AttributePath:
    """The values of one attribute; each holds until the next.

    Attributes:
        name: what is stated.
        values: one per timestamp: text, a number, or a tuple of texts; whatever else a file has is kept as it is.
        timestamps_ns: (N,) int64 [ns], or None where the file gives none. Files may have more or fewer of them than
            values; both are kept, and `validate` reports it.
        sensor_id: of the only sensor that it holds for, or None.
        static: whether it holds at all times; None where not stated.
        point_index: of the only point of a points annotation that it holds for, or None.
        extras: further fields of the file, by name.

    Source: "Attribute Path" of the SFS description; `point_index` is that of "Points Annotation / Keypoints".
    """

    name: str
    values: tuple[Any, ...]
    timestamps_ns: Int64Array | None = None
    sensor_id: Identifier | None = None
    static: bool | None = None
    point_index: int | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(self, "attribute", {"timestamps_ns?": (np.int64, "N")})

    @property
    def is_timed(self) -> bool:
        """Whether each value has its own time."""
        timestamps = self.timestamps_ns
        return timestamps is not None and not self.static and len(timestamps) == len(self.values)


@dataclass(frozen=True, slots=True, eq=False)
class CuboidPath:
    """A box over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        values: (N, 9) float64, rows `dx dy dz px py pz roll pitch yaw` exactly as stored: sizes and position [m] in
            the scene's world; the unit and order of the angles are the scene's `metadata["sceneloom"]` euler entries.
        extras: further fields of the file, by name.

    Source: "Cuboid Annotation" of the SFS description.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(self, "cuboid.path", {"timestamps_ns": (np.int64, "N"), "values": (np.float64, "N", 9)})


@dataclass(frozen=True, slots=True, eq=False)
class Activation:
    """When one sensor sees a cuboid, in scenes without frames.

    Attributes:
        sensor_id: the sensor.
        timestamps_ns: (N,) int64 [ns], when each begins.
        durations_ns: how long each lasts [ns], N integers (a float where a file says a part of a nanosecond), or
            None where the file says nothing.
        cuboids: (N, 9) float64 as in `CuboidPath`, or None.
        extras: further fields of the file, by name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    durations_ns: tuple[float, ...] | None = None
    cuboids: Float64Array | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_arrays(self, "", {"timestamps_ns": (np.int64, "N"), "cuboids?": (np.float64, "N", 9)})
        check_count("durations_ns", self.durations_ns, count)


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Where one camera sees a cuboid.

    Attributes:
        sensor_id: the camera.
        timestamps_ns: (N,) int64 [ns], of its images.
        boxes: (N, 4) float64 [px], rows `x y width height` in the corner convention; a row of NaN where the box could
            not be projected or was deleted; None where the file says nothing.
        confirmed: N times whether a person confirmed it (None where one of them is not stated), or None.
        cuboids: (N, 9) float64 as in `CuboidPath`, rows of NaN for null, or None.
        extras: further fields of the file, by name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    boxes: Float64Array | None = None
    confirmed: tuple[bool | None, ...] | None = None
    cuboids: Float64Array | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_arrays(
            self,
            "",
            {"timestamps_ns": (np.int64, "N"), "boxes?": (np.float64, "N", 4), "cuboids?": (np.float64, "N", 9)},
        )
        check_count("confirmed", self.confirmed, count)


@dataclass(frozen=True, slots=True, eq=False)
class CuboidAnnotation:
    """An object as a box.

    Attributes:
        id: unique among the scene's annotations.
        path: the box over time.
        label: the object's class, or None.
        stationary: whether the object is stationary; None where not stated.
        parent_id: id of the parent annotation, or None.
        attributes: what is stated about it.
        activations: when sensors see it, one entry per sensor.
        projections: where cameras see it, one entry per camera.
        extras: every other field of the file, by name.
    """

    id: Identifier
    path: CuboidPath
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    activations: tuple[Activation, ...] = ()
    projections: tuple[Projection, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[str] = "cuboid"

    @classmethod
    def of(
        cls,
        id: Identifier,
        timestamps_ns: ArrayLike,
        centers: ArrayLike,
        sizes_lwh: ArrayLike,
        yaws: ArrayLike,
        *,
        label: str | None = None,
    ) -> "CuboidAnnotation":
        """Make an upright box over time of where it is, how large, and where it heads.

        ```python
        car = CuboidAnnotation.of(7, [0, 100_000_000], [[10, 2, 0.8], [11, 2, 0.8]], (4.5, 1.8, 1.6), 0.0, label="Car")
        ```

        Args:
            id: unique among the scene's annotations.
            timestamps_ns: (N,) [ns], one per row.
            centers: (N, 3) [m], middles of the box, in the scene's world (z up).
            sizes_lwh: (3,) or (N, 3) [m], length, width and height.
            yaws: one or (N,) [rad], heading about z, counter-clockwise from x.
            label: the object's class.

        Raises:
            ArrayError: shapes differ.
        """
        times = np.atleast_1d(np.asarray(timestamps_ns, np.int64))
        given = {"centers": (centers, 3), "sizes_lwh": (sizes_lwh, 3), "yaws": (np.asarray(yaws)[..., None], 1)}
        columns = {}
        for name, (value, width) in given.items():
            column = np.asarray(value, np.float64)
            if column.shape not in {(width,), (1, width), (len(times), width)}:
                raise ArrayError(f"{name}: {column.shape}; expected {(width,)} or {(len(times), width)}")
            columns[name] = np.broadcast_to(column, (len(times), width))
        # angles of a scene that names no unit are degrees
        angles = np.column_stack([np.zeros((len(times), 2)), np.degrees(columns["yaws"])])
        values = np.hstack([columns["sizes_lwh"], columns["centers"], angles])
        return cls(id, CuboidPath(times, values), label=label)


@dataclass(frozen=True, slots=True, eq=False)
class BoxPath:
    """A box in an image over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        values: (N, 4) float64 [px], rows `left top width height` in the corner convention: the image's corner is
            (0, 0).
        extras: further fields of the file, by name.

    Source: "2D Box Annotation" of the SFS description.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(self, "path", {"timestamps_ns": (np.int64, "N"), "values": (np.float64, "N", 4)})


@dataclass(frozen=True, slots=True, eq=False)
class Box2DAnnotation:
    """An object as a box in the images of one camera; fields as in `CuboidAnnotation`.

    Attributes:
        sensor_id: the camera.
        path: the box over time.
    """

    id: Identifier
    sensor_id: Identifier
    path: BoxPath
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[str] = "box_2d"


class ShapeType(StrEnum):
    """The shapes of the format, in its words; `point` and `point_topdown` are those of Scale's library."""

    POLYLINE_2D = "polyline_2d"
    POLYGON_2D = "polygon_2d"
    POINT_2D = "point_2d"
    POLYGON = "polygon"
    POLYGON_TOPDOWN = "polygon_topdown"
    POLYLINE = "polyline"
    POINT = "point"
    POINT_TOPDOWN = "point_topdown"


DIMENSIONS: Mapping[ShapeType, int] = MappingProxyType(
    {kind: 2 if kind.value.endswith("_2d") else 3 for kind in ShapeType}
)
"""How many numbers a vertex has: pixels in an image, or a location in the world."""


@dataclass(frozen=True, slots=True, eq=False)
class VertexPath:
    """The vertices of a shape over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        vertices: N arrays (V, D) float64, V of each its own: pixels in the corner convention [px] (D = 2), or locations
            in the scene's world [m] (D = 3).
        extras: further fields of the file, by name.

    Source: "AnnotationPath" of the SFS description, whose rows are these vertices one after another.
    """

    timestamps_ns: Int64Array
    vertices: tuple[Float64Array, ...]
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_arrays(self, "path", {"timestamps_ns": (np.int64, "N")})
        check_count("path.vertices", self.vertices, count)
        if not all(isinstance(vertices, np.ndarray) for vertices in self.vertices):
            held = tuple(as_array("path.vertices", v, (None, None), np.float64) for v in self.vertices)
            object.__setattr__(self, "vertices", held)


@dataclass(frozen=True, slots=True, eq=False)
class ShapeAnnotation:
    """A line, an area or a point; other fields as in `CuboidAnnotation`.

    Attributes:
        type: which shape.
        path: its vertices over time.
        sensor_id: the camera of a shape in images (then required), or the only sensor that one in space is for.
        is_closed: whether the last vertex of a `polyline` is joined to the first; None where not stated.
    """

    id: Identifier
    type: ShapeType
    path: VertexPath
    sensor_id: Identifier | None = None
    is_closed: bool | None = None
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        columns = DIMENSIONS[self.type]
        for k, vertices in enumerate(self.path.vertices):
            check_array(f"path.vertices[{k}]", vertices, (None, columns), np.float64)
        if columns == 2 and self.sensor_id is None:
            raise ArrayError(f"sensor_id: missing; a {self.type} is drawn in the images of a camera")

    @property
    def dimensions(self) -> int:
        """2 in images, 3 in the world."""
        return DIMENSIONS[self.type]


@dataclass(frozen=True, slots=True, eq=False)
class PointPath:
    """One point over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        values: (N, 3) float64 [m], in the scene's world; in files whose rows hold several points, (N, 3 V).
        id: unique within the annotation, or None (old files).
        extras: further fields of the file, by name.

    Source: "Points Annotation / Keypoints" of the SFS description.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(self, "", {"timestamps_ns": (np.int64, "N"), "values": (np.float64, "N", None)})


def locations_of(values: Float64Array) -> Float64Array:
    """Cut the rows of a point path, (M, 3 V), into the locations of its V points, (M, V, 3)."""
    return values.reshape(len(values), values.shape[1] // 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class PointProjection:
    """Where one camera sees one point.

    Attributes:
        sensor_id: the camera.
        timestamps_ns: (N,) int64 [ns], of its images.
        points: (N, 2) float64 [px] in the corner convention; a row of NaN where the point could not be projected or
            was deleted; None where the file says nothing.
        confirmed: N times whether a person confirmed it (None where one of them is not stated), or None.
        positions: (N, 3) float64 [m], rows of NaN for null, or None.
        extras: further fields of the file, by name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    points: Float64Array | None = None
    confirmed: tuple[bool | None, ...] | None = None
    positions: Float64Array | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_arrays(
            self,
            "",
            {"timestamps_ns": (np.int64, "N"), "points?": (np.float64, "N", 2), "positions?": (np.float64, "N", 3)},
        )
        check_count("confirmed", self.confirmed, count)


@dataclass(frozen=True, slots=True, eq=False)
class PointsAnnotation:
    """Points of an object, or points on a map; other fields as in `CuboidAnnotation`.

    Attributes:
        paths: one per point.
        labels: one per point, or None.
        projections: one entry per point, in it one per camera.
        sensor_id: the only sensor that it is for, or None.
    """

    id: Identifier
    paths: tuple[PointPath, ...]
    labels: tuple[str, ...] | None = None
    projections: tuple[tuple[PointProjection, ...], ...] = ()
    sensor_id: Identifier | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[str] = "points"


@dataclass(frozen=True, slots=True, eq=False)
class LabeledPoints:
    """Which points of one sensor, or of one of its frames.

    Attributes:
        sensor_id: the sensor.
        point_ids: (N,) uint32, rows of its points.
        sensor_frame: number of the frame; None: the whole sensor, as for a map.
        extras: further fields of the file, by name.
    """

    sensor_id: Identifier
    point_ids: UInt32Array
    sensor_frame: int | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_arrays(self, "", {"point_ids": (np.uint32, "N")})


@dataclass(frozen=True, slots=True, eq=False)
class LabeledPointsAnnotation:
    """An object or a class as the points that belong to it; other fields as in `CuboidAnnotation`.

    Attributes:
        labeled_points: by sensor and frame.
        is_instance: whether it is one object and not a class; None where not stated.
        type: `labeled_points`, or `point_segmentation`, Scale's other word for it.

    Source: "Labeled Points Annotation" of the SFS description.
    """

    id: Identifier
    labeled_points: tuple[LabeledPoints, ...]
    label: str | None = None
    is_instance: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    type: str = "labeled_points"

    def __post_init__(self) -> None:
        if self.type not in _LABELED_POINTS_TYPES:
            raise ArrayError(f"type {self.type!r}; expected one of {', '.join(_LABELED_POINTS_TYPES)}")


_LABELED_POINTS_TYPES = ("labeled_points", "point_segmentation")  # the words that files have for such an annotation
_OBJECT_TYPES = ("object", "attributes")
"""The words that files have for an annotation that is nothing but its attributes; the second is Scale's library's."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectAnnotation:
    """An object to which other annotations belong; fields as in `CuboidAnnotation`.

    Attributes:
        type: `object`, or `attributes`.
    """

    id: Identifier
    label: str | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    type: str = "object"

    def __post_init__(self) -> None:
        if self.type not in _OBJECT_TYPES:
            raise ArrayError(f"type {self.type!r}; expected one of {', '.join(_OBJECT_TYPES)}")


@dataclass(frozen=True, slots=True, eq=False)
class GroupAnnotation:
    """A group to which other annotations belong by their `parent_id`; fields as in `CuboidAnnotation`."""

    id: Identifier
    label: str | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[str] = "group"


@dataclass(frozen=True, slots=True, eq=False)
class LinkAnnotation:
    """A relation between two annotations; other fields as in `CuboidAnnotation`.

    Attributes:
        from_id: the annotation that it leads from.
        to_id: the one that it leads to.
        is_bidirectional: whether it holds both ways; None where not stated.
        sensor_id: the only sensor that it is for, or None.
    """

    id: Identifier
    from_id: Identifier
    to_id: Identifier
    label: str | None = None
    is_bidirectional: bool | None = None
    sensor_id: Identifier | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    type: ClassVar[str] = "link"


@dataclass(frozen=True, slots=True, eq=False)
class EventAnnotation:
    """Something that happens; other fields as in `CuboidAnnotation`.

    Attributes:
        start_ns: when it begins [ns].
        duration_ns: how long it lasts [ns], or None.
        sensor_id: the only sensor that it is for, or None.
    """

    id: Identifier
    start_ns: int
    duration_ns: int | float | None = None
    label: str | None = None
    sensor_id: Identifier | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_timestamp(self, "start_ns")

    type: ClassVar[str] = "event"


@dataclass(frozen=True, slots=True, eq=False)
class PlainAnnotation:
    """An annotation of an unknown type, its fields as the file has them, times in nanoseconds.

    Attributes:
        id: unique among the scene's annotations.
        type: the file's own word.
        fields: all fields but `id` and `type`.
    """

    id: Identifier
    type: str
    fields: Mapping[str, Any]

    @property
    def parent_id(self) -> Identifier | None:
        """Id of the parent annotation, or None."""
        return self.fields.get("parent_id")


@dataclass(frozen=True, slots=True, eq=False)
class LocalizationAdjustment:
    """Poses A(t) that repair a scene's localisation, or lead from ego to world: p' = A(t) p.

    Attributes:
        id: unique among the scene's annotations.
        poses: `corrected_from_given` over time; a single pose holds at all times.
        parent_id: id of the parent annotation, or None.
        extras: every other field of the file, by name.

    Source: "Localization Adjustment Annotation" of the SFS description.
    """

    id: Identifier
    poses: Poses
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        object.__setattr__(self, "poses", _held(self.poses))

    type: ClassVar[str] = "localization_adjustment"


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """What repairs a camera: world_from_camera' = world_from_camera D(t), another camera model, other times.

    Attributes:
        id: unique among the scene's annotations.
        sensor_id: the camera.
        poses: D(t), `camera_from_calibrated_camera`, or None; a single pose holds at all times.
        intrinsics: the calibrated camera model, or None.
        time_offset_ns: to be added to the camera's times [ns], or None.
        parent_id: id of the parent annotation, or None.
        extras: every other field of the file, by name; those of `poses` and `intrinsics` under these names.

    Source: "Camera Calibration Annotation" of the SFS description.
    """

    id: Identifier
    sensor_id: Identifier
    poses: Poses | None = None
    intrinsics: Camera | None = None
    time_offset_ns: int | float | None = None
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        if self.poses is not None:
            object.__setattr__(self, "poses", _held(self.poses))

    type: ClassVar[str] = "camera_calibration"


def effect_of(correction: LocalizationAdjustment | CameraCalibration) -> str:
    """Report what a correction changes, in figures."""
    if isinstance(correction, LocalizationAdjustment):
        return f"all poses and points in the world change, {_size(correction.poses)}"
    parts = []
    if correction.poses is not None:
        parts.append(f"extrinsics change, {_size(correction.poses)}")
    if correction.intrinsics is not None:
        parts.append("intrinsics are replaced")
    if correction.time_offset_ns:
        parts.append(f"timestamps change by {correction.time_offset_ns / 1e6:+g} ms")
    return f"camera {correction.sensor_id!r}: {'; '.join(parts) or 'nothing changes'}"


def _size(poses: Poses) -> str:
    farthest = float(np.linalg.norm(poses.positions, axis=1).max())
    cosine = np.clip(np.abs(poses.quaternions_xyzw[:, 3]), 0.0, 1.0)
    return f"by at most {farthest:.3g} m and {float(np.degrees(2.0 * np.arccos(cosine)).max()):.3g} deg"


def _held(poses: Poses) -> Poses:
    """A file cannot state that a single pose holds at one time only, and nothing could be corrected by it."""
    return replace(poses, static=True) if len(poses.timestamps_ns) == 1 else poses


Annotation = (
    CuboidAnnotation
    | Box2DAnnotation
    | ShapeAnnotation
    | PointsAnnotation
    | EventAnnotation
    | LabeledPointsAnnotation
    | LocalizationAdjustment
    | CameraCalibration
    | ObjectAnnotation
    | LinkAnnotation
    | GroupAnnotation
    | PlainAnnotation
)
