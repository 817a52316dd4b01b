"""Tables of the nuScenes schema and of its dialect T4: their columns, and the types of their rows.

Source: "Schema Tables" of t4-devkit for what T4 adds.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any

import msgspec

Quaternion = tuple[float, float, float, float]
"""w, x, y, z."""

_Vector = tuple[float, float, float]
_Microseconds = Annotated[int, msgspec.Meta(ge=-9_000_000_000_000_000, le=9_000_000_000_000_000)]
"""A time; as nanoseconds it has to be within 64 bits."""

MICROSECOND = 1000
"""Nanoseconds in the unit of all times of the tables."""

KEY_FRAMES = "key_frames_us"
"""Extra field of a sensor that was read from nuScenes: the times of its key frames."""


T4_VECTORS = ("velocity", "acceleration")
"""What T4 may state of a box, in the world [m/s, m/s²]."""


class _Mask(msgspec.Struct):
    """A mask of T4: two sides of the image, and COCO's compressed runs in base64."""

    size: tuple[int, int]
    counts: str


def _texts(*names: str) -> list[tuple[str, Any, Any]]:
    return [(name, str, "") for name in names]


_POSE: list[Any] = [("translation", _Vector), ("rotation", Quaternion)]
_COLUMNS: dict[str, list[Any]] = {
    "scene": [
        ("name", str), *_texts("description", "log_token"), ("nbr_samples", int, 0),
        *_texts("first_sample_token", "last_sample_token"),
    ],
    "sample": [("timestamp", _Microseconds), ("scene_token", str), *_texts("next", "prev")],
    "sample_data": [
        *((f"{name}_token", str) for name in ("sample", "ego_pose", "calibrated_sensor")), ("filename", str),
        ("timestamp", _Microseconds), ("is_key_frame", bool), *_texts("fileformat"), ("width", int | None, None),
        ("height", int | None, None), *_texts("next", "prev"), ("is_valid", bool, True),
    ],
    # world from ego; T4 may leave the time to the frames
    "ego_pose": [*_POSE, ("timestamp", _Microseconds | None, None)],
    # ego from sensor; only cameras of T4 state a distortion
    "calibrated_sensor": [
        ("sensor_token", str), *_POSE, ("camera_intrinsic", list[_Vector], []),
        ("camera_distortion", list[float] | None, None),
    ],
    # `sensor_id` is ours, of channels that are not the sensor's own id
    "sensor": [("channel", str), ("modality", str), ("sensor_id", str | int | None, None)],
    "log": _texts("logfile", "vehicle", "date_captured", "location", "data_captured"),
    # `index` is the number of a class in the files of nuScenes-lidarseg
    "category": [("name", str), *_texts("description"), ("index", int | None, None)],
    "attribute": [("name", str), *_texts("description")],
    "visibility": [("level", str), *_texts("description")],
    "instance": [
        ("category_token", str), ("nbr_annotations", int, 0),
        *_texts("first_annotation_token", "last_annotation_token"),
    ],
    # a box of an object at a sample, in the world
    "sample_annotation": [
        ("sample_token", str), ("instance_token", str), ("translation", _Vector),
        ("size", _Vector),  # width, length, height
        ("rotation", Quaternion), ("attribute_tokens", list[str], []), *_texts("visibility_token"),
        ("num_lidar_pts", int, 0), ("num_radar_pts", int, 0), *_texts("next", "prev"),
        *((name, _Vector | None, None) for name in T4_VECTORS), ("automatic_annotation", bool, False),
    ],
    # a box of an object in an image: left, top, right, bottom
    "object_ann": [
        *((f"{name}_token", str) for name in ("sample_data", "instance", "category")),
        ("attribute_tokens", list[str], []), ("bbox", tuple[float, float, float, float]), ("mask", _Mask | None, None),
        ("automatic_annotation", bool, False), ("orientation", float | None, None), ("number", int | None, None),
    ],
    # an area of an image
    "surface_ann": [
        ("sample_data_token", str), ("category_token", str), ("mask", _Mask | None, None),
        ("automatic_annotation", bool, False),
    ],
    # the file with the classes of the points of a sweep
    "lidarseg": [("sample_data_token", str), ("filename", str)],
}  # fmt: skip
"""Columns with their types and, of those that may be missing, defaults; each table has a `token` besides."""

TABLES: Mapping[str, type[Any]] = MappingProxyType(
    {
        name: msgspec.defstruct(name, [("token", str), *columns], kw_only=True, module=__name__)
        for name, columns in _COLUMNS.items()
    }
)
"""The rows of each table, by the name of its file; `map` is left out."""

NEEDED = ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")
"""Tables without which no scene can be opened."""
