"""The fields of a Sensor Fusion Scene: names, kinds and units of each record."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType


class Kind(StrEnum):
    """What a field holds, in words for messages."""

    ANYTHING = "anything"
    IDENTIFIER = "an id: text or an integer"
    TEXT = "text"
    FLAG = "true or false"
    INTEGER = "an integer"
    NUMBER = "a number"
    TIME = "a timestamp: an integer"
    TIMES = "a list of timestamps"
    DURATION = "a duration: a number"
    DURATIONS = "a list of durations"
    LIST = "a list"
    ARRAY = "an array"
    POINT_TIMES = "an array of timestamps"
    RECORD = "an object"
    RECORDS = "a list of objects"
    RECORD_OR_RECORDS = "an object or a list of objects"
    RECORD_LISTS = "a list of lists of objects"
    RECORD_MAP = "an object of objects"


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a record.

    Attributes:
        required: whether a file without it is at fault.
        expected: whether the description requires it, though a file without it can be read.
        unit: "m", "px", "file" for the scene's time unit, …; for people.
        record: the record of a RECORD, RECORDS and the like.
        dtype: the dtype of an ARRAY.
        columns: how many numbers a row of an ARRAY has; 0 for a plain list of numbers.
        ours: whether it is our extension; one of another dtype is then a stranger's and kept as unknown.
    """

    name: str
    kind: Kind
    required: bool = False
    unit: str = ""
    record: str = ""
    dtype: str = ""
    columns: int = 0
    ours: bool = False
    expected: bool = False


def _expects(field: Field) -> Field:
    return replace(field, expected=True)


def _needs(name: str, kind: Kind, unit: str = "", record: str = "") -> Field:
    return Field(name, kind, required=True, unit=unit, record=record)


def _array(name: str, dtype: str, columns: int = 0, unit: str = "", *, required: bool = False) -> Field:
    return Field(name, Kind.ARRAY, required=required, unit=unit, dtype=dtype, columns=columns)


def _ours(field: Field) -> Field:
    return replace(field, ours=True)


_ID = _needs("id", Kind.IDENTIFIER)
_TYPE = _needs("type", Kind.TEXT)
_PARENT = Field("parent_id", Kind.IDENTIFIER)
_SENSOR = Field("sensor_id", Kind.IDENTIFIER)
_OF_SENSOR = _needs("sensor_id", Kind.IDENTIFIER)
_LABEL = Field("label", Kind.TEXT)
_STATIONARY = Field("stationary", Kind.FLAG)
_TIMESTAMPS = _needs("timestamps", Kind.TIMES, "file")
_VALUES = _needs("values", Kind.LIST)
_ATTRIBUTES = Field("attributes", Kind.RECORDS, record="attribute")
_POSES = Field("poses", Kind.RECORD, unit="m, x y z w", record="poses")
_COORDINATES = Field("coordinates", Kind.TEXT)
_POINT_TIMES = Field("timestamps", Kind.POINT_TIMES, unit="file")
_CUBOIDS = Field("cuboids", Kind.LIST, unit="m, angles")
_POSITIONS = _array("positions", "float32", 3, "m", required=True)
_INTRINSICS = (
    *(_needs(name, Kind.NUMBER, "px") for name in ("fx", "fy", "cx", "cy")),
    *(_needs(name, Kind.INTEGER, "px") for name in ("width", "height")),
)
_SENSOR_FIELDS = (_ID, _TYPE, _PARENT)
_MOVING_FIELDS = (*_SENSOR_FIELDS, _POSES, _COORDINATES)
_ANNOTATION_FIELDS = (_ID, _TYPE, _PARENT)
_LABELLED_FIELDS = (*_ANNOTATION_FIELDS, _LABEL, _ATTRIBUTES)
_OBJECT_FIELDS = (*_LABELLED_FIELDS, _STATIONARY)
_SHAPE_FIELDS = (*_OBJECT_FIELDS, _SENSOR, _needs("path", Kind.RECORD, record="path"))
_FLAT_SHAPE_FIELDS = (*_OBJECT_FIELDS, _OF_SENSOR, _needs("path", Kind.RECORD, record="path"))

_LABELED_POINTS_FIELDS = (
    *_ANNOTATION_FIELDS,
    _expects(_LABEL),
    _ATTRIBUTES,
    _expects(Field("is_instance", Kind.FLAG)),
    _needs("labeled_points", Kind.RECORDS, record="labeled_points_of_frame"),
)

SENSOR_RECORDS: Mapping[str, tuple[Field, ...]] = MappingProxyType({
    "points": (*_SENSOR_FIELDS, _needs("points", Kind.RECORD, record="map_points")),
    "lidar": (*_MOVING_FIELDS, _needs("frames", Kind.RECORDS, record="lidar_frame")),
    "radar": (*_MOVING_FIELDS, _needs("frames", Kind.RECORDS, record="radar_frame")),
    "camera": (
        *_MOVING_FIELDS, _needs("intrinsics", Kind.RECORD, record="intrinsics"),
        Field("video", Kind.RECORD, record="video"), Field("images", Kind.RECORDS, record="image"),
    ),
    "odometry": (*_SENSOR_FIELDS, replace(_POSES, required=True)),
    "imu": (*_SENSOR_FIELDS, _needs("streams", Kind.RECORD_MAP, record="samples")),
    "gnss": (
        *_SENSOR_FIELDS, _array("timestamps_ns", "int64", unit="ns", required=True),
        _array("positions_lla", "float64", 3, "deg, deg, m", required=True),
        _array("accuracies", "float64", unit="m", required=True),
        _array("vertical_accuracies", "float64", unit="m", required=True), _array("file_seconds", "float64", unit="s"),
        Field("mount", Kind.LIST, unit="rows of R, t [m]"),
    ),
})  # fmt: skip
"""The fields of each type of sensor; `imu` and `gnss` stand only under our metadata."""

ANNOTATION_RECORDS: Mapping[str, tuple[Field, ...]] = MappingProxyType({
    "cuboid": (
        *_OBJECT_FIELDS, _needs("path", Kind.RECORD, record="path"),
        Field("activations", Kind.RECORDS, record="activation"),
        Field("projections", Kind.RECORDS, record="projection"),
    ),
    **dict.fromkeys(("box_2d", "polyline_2d", "polygon_2d", "point_2d"), _FLAT_SHAPE_FIELDS),
    **dict.fromkeys(("polygon", "polygon_topdown"), _SHAPE_FIELDS),
    "polyline": (*_SHAPE_FIELDS, Field("is_closed", Kind.FLAG)),
    **dict.fromkeys(("point", "point_topdown"), _SHAPE_FIELDS),
    "points": (
        *_OBJECT_FIELDS, _SENSOR, Field("labels", Kind.LIST),
        _needs("paths", Kind.RECORD_OR_RECORDS, record="point_path"),
        Field("projections", Kind.RECORD_LISTS, record="point_projection"),
    ),
    "event": (
        *_LABELLED_FIELDS, _SENSOR, _needs("start", Kind.TIME, "file"), Field("duration", Kind.DURATION, unit="file"),
    ),
    "labeled_points": _LABELED_POINTS_FIELDS,
    "point_segmentation": _LABELED_POINTS_FIELDS,
    "localization_adjustment": (*_ANNOTATION_FIELDS, replace(_POSES, required=True)),
    "camera_calibration": (
        *_ANNOTATION_FIELDS, _OF_SENSOR, _POSES, Field("intrinsics", Kind.RECORD, record="intrinsics"),
        Field("time_offset", Kind.DURATION, unit="file"),
    ),
    "object": _LABELLED_FIELDS,
    "attributes": _LABELLED_FIELDS,
    "link": (
        *_ANNOTATION_FIELDS, _expects(_LABEL), _ATTRIBUTES, _SENSOR, _expects(Field("is_bidirectional", Kind.FLAG)),
        _needs("from_id", Kind.IDENTIFIER), _needs("to_id", Kind.IDENTIFIER),
    ),
    "group": _LABELLED_FIELDS,
})  # fmt: skip
"""The fields of each type of annotation."""

_PART_RECORDS: Mapping[str, tuple[Field, ...]] = {
    "poses": (_TIMESTAMPS, _VALUES),
    "path": (_TIMESTAMPS, _VALUES),
    "point_path": (Field("id", Kind.IDENTIFIER), _TIMESTAMPS, _VALUES),
    "attribute": (
        _needs("name", Kind.TEXT), _SENSOR, Field("static", Kind.FLAG), Field("point_index", Kind.INTEGER),
        _expects(Field("timestamps", Kind.TIMES, unit="file")), _expects(Field("values", Kind.LIST)),
    ),
    "activation": (_OF_SENSOR, _TIMESTAMPS, _expects(Field("durations", Kind.DURATIONS, unit="file")), _CUBOIDS),
    "projection": (
        _OF_SENSOR, _TIMESTAMPS, _expects(Field("boxes", Kind.LIST, unit="px")), Field("confirmed", Kind.LIST),
        _CUBOIDS,
    ),
    "point_projection": (
        _OF_SENSOR, _TIMESTAMPS, _expects(Field("points", Kind.LIST, unit="px")), Field("confirmed", Kind.LIST),
        Field("positions", Kind.LIST, unit="m"),
    ),
    "labeled_points_of_frame": (
        _OF_SENSOR, Field("sensor_frame", Kind.INTEGER), _array("point_ids", "uint32", required=True),
    ),
    "map_points": (_POSITIONS, _array("colors", "uint8", 3)),
    "lidar_frame": (_needs("timestamp", Kind.TIME, "file"), _needs("points", Kind.RECORD, record="lidar_points")),
    "lidar_points": (
        _POSITIONS, _array("colors", "uint8", 3), _array("intensities", "uint8"), _POINT_TIMES,
        _ours(_array("ring", "uint16")), _ours(_array("camera_index", "uint8")),
    ),
    "radar_frame": (_needs("timestamp", Kind.TIME, "file"), _needs("points", Kind.RECORD, record="radar_points")),
    "radar_points": (
        _POSITIONS, _array("directions", "float32", 3), _array("lengths", "float32", unit="m/s"), _POINT_TIMES,
    ),
    "intrinsics": (*_INTRINSICS, Field("distortion", Kind.RECORD, record="distortion")),
    "distortion": (_expects(Field("model", Kind.TEXT)), _expects(Field("params", Kind.LIST))),
    "video": (_TIMESTAMPS, _array("content", "uint8", required=True), _expects(Field("fps", Kind.NUMBER, unit="1/s"))),
    "image": (_needs("timestamp", Kind.TIME, "file"), _array("content", "uint8", required=True)),
    "unknown_frame": (Field("timestamp", Kind.TIME, unit="file"),),
    "unknown_sensor": (
        *_MOVING_FIELDS, Field("frames", Kind.RECORDS, record="unknown_frame"),
        Field("timestamps", Kind.TIMES, unit="file"),
    ),
    "samples": (
        _array("timestamps_ns", "int64", unit="ns", required=True),
        _array("values", "float64", columns=-1, required=True), _array("file_seconds", "float64", unit="s"),
    ),
    "trajectory": (
        _needs("name", Kind.TEXT), _SENSOR, _array("timestamps_ns", "int64", unit="ns"),
        _array("positions", "float64", 3, "m"), _array("quaternions_xyzw", "float64", 4),
        _array("file_seconds", "float64", unit="s"), _array("covariances", "float64", 36, "rad², rad m, m²"),
    ),
    "camera": (_needs("model", Kind.TEXT), *_INTRINSICS, _needs("coefficients", Kind.LIST)),
    "images_note": (
        Field("cameras", Kind.RECORDS, record="camera"), Field("camera_of_image", Kind.LIST),
        Field("mounts", Kind.LIST, unit="rows of R, t [m]"), Field("extras", Kind.LIST),
    ),
    "sensor_note": (
        _ID, Field("points_frame", Kind.TEXT), Field("model", Kind.TEXT),
        Field("mount", Kind.LIST, unit="rows of R, t [m]"), Field("poses_from_mount", Kind.FLAG),
        Field("poses_static", Kind.FLAG), Field("coordinates", Kind.TEXT),
        Field("camera", Kind.RECORD, record="camera"), Field("written_camera", Kind.RECORD, record="camera"),
        Field("images", Kind.RECORD, record="images_note"), Field("lengths", Kind.LIST, unit="m/s"),
    ),
    "unfused": (
        _OF_SENSOR, _needs("timestamp_ns", Kind.INTEGER, "ns"), _needs("reason", Kind.TEXT),
        _needs("points", Kind.RECORD, record="unfused_points"),
    ),
    "unfused_points": (
        _POSITIONS, _array("colors", "uint8", 3), _array("intensities", "uint8"),
        _array("timestamps_ns", "int64", unit="ns"), _array("ring", "uint16"),
    ),
    "exact_attribute": (
        Field("annotation_id", Kind.IDENTIFIER), _needs("index", Kind.INTEGER), _TIMESTAMPS, _VALUES,
        _needs("written", Kind.LIST),
    ),
    "warning": (
        _needs("kind", Kind.TEXT), _needs("code", Kind.TEXT), _needs("location", Kind.TEXT),
        _needs("message", Kind.TEXT), _needs("count", Kind.INTEGER),
    ),
    "sceneloom": (
        Field("layout", Kind.INTEGER), Field("time_shift_ns", Kind.INTEGER, unit="ns"), Field("euler_unit", Kind.TEXT),
        Field("euler_order", Kind.TEXT), Field("tangential", Kind.TEXT), Field("tangential_before", Kind.TEXT),
        Field("assumed_models", Kind.LIST), Field("sensor_notes", Kind.RECORDS, record="sensor_note"),
        Field("sensors", Kind.LIST), Field("annotations", Kind.LIST), _ATTRIBUTES,
        Field("trajectories", Kind.RECORDS, record="trajectory"), Field("unfused", Kind.RECORDS, record="unfused"),
        Field("exact_attributes", Kind.RECORDS, record="exact_attribute"),
        Field("warnings", Kind.RECORDS, record="warning"),
    ),
    "scene": (
        _needs("version", Kind.TEXT), Field("time_unit", Kind.TEXT), Field("time_offset", Kind.NUMBER, unit="file"),
        Field("sensors", Kind.LIST), Field("annotations", Kind.LIST), _ATTRIBUTES, Field("metadata", Kind.ANYTHING),
    ),
}  # fmt: skip


def _by_name(fields: Iterable[Field]) -> Mapping[str, Field]:
    return MappingProxyType({field.name: field for field in fields})


RECORDS: Mapping[str, Mapping[str, Field]] = MappingProxyType(
    {
        **{name: _by_name(fields) for name, fields in _PART_RECORDS.items()},
        **{f"sensor {name}": _by_name(fields) for name, fields in SENSOR_RECORDS.items()},
        **{f"annotation {name}": _by_name(fields) for name, fields in ANNOTATION_RECORDS.items()},
        "unknown_annotation": _by_name(
            replace(field, required=False) for record in ANNOTATION_RECORDS.values() for field in record
        ),
    }
)
"""Every record by name, its fields by name."""

SENSOR_ALIASES: Mapping[str, str] = MappingProxyType({"gps": "odometry", "odometer": "odometry"})
"""Names of sensor types that stand for another."""


def sensor_record(type_name: str) -> str:
    """Name the record of a type of sensor; an unknown type has one that demands nothing."""
    name = SENSOR_ALIASES.get(type_name, type_name)
    return f"sensor {name}" if name in SENSOR_RECORDS else "unknown_sensor"


def annotation_record(type_name: str) -> str:
    """Name the record of a type of annotation; an unknown type has one that demands nothing."""
    return f"annotation {type_name}" if type_name in ANNOTATION_RECORDS else "unknown_annotation"


COEFFICIENT_COUNTS: Mapping[str, int] = MappingProxyType({
    "brown_conrady": 10, "fisheye": 4, "mod_equi_fish": 4, "mod_kannala": 4, "cylindrical": 0, "equirectangular": 0,
    "omnidirectional": 9, "fisheye_rad_tan_prism": 12, "fisheye_radial_custom": 10, "ftheta": 5,
})  # fmt: skip
"""How many numbers each model has. Source: the SFS description and scale-sensor-fusion-io 0.5.4."""
