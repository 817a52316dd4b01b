"""The tables of a catalogue: names, types and meanings of their columns, and rows before they are written."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np


class Kind(StrEnum):
    """What a column holds; every one may be null."""

    TEXT = "text"
    TIME = "int64"
    COUNT = "int32"
    NUMBER = "float64"
    FLAG = "bool"


@dataclass(frozen=True, slots=True)
class Column:
    """A column.

    Attributes:
        name: in SQL.
        kind: what it holds.
        words: what it means, with the unit.
    """

    name: str
    kind: Kind
    words: str


def _columns(*rows: tuple[str, Kind, str]) -> tuple[Column, ...]:
    return tuple(Column(*row) for row in rows)


_EGO = (
    ("latitude", Kind.NUMBER, "ego [deg, WGS84]"),
    ("longitude", Kind.NUMBER, "ego [deg, WGS84]"),
    ("ego_speed", Kind.NUMBER, "over half a second [m/s]"),
)

TABLES: Mapping[str, tuple[Column, ...]] = MappingProxyType(
    {
        "scenes": _columns(
            ("path", Kind.TEXT, "drive"),
            ("options", Kind.TEXT, "reading options, JSON"),
            ("format", Kind.TEXT, "format"),
            ("start_ns", Kind.TIME, "first timestamp [ns]"),
            ("duration", Kind.NUMBER, "[s]"),
            ("period", Kind.NUMBER, "median time between moments [s]"),
            ("moments_of", Kind.TEXT, "sensor that defines the moments"),
            ("metres", Kind.NUMBER, "length of the ego trajectory [m]"),
            ("latitude", Kind.NUMBER, "start [deg, WGS84]"),
            ("longitude", Kind.NUMBER, "start [deg, WGS84]"),
            ("sensors", Kind.COUNT, "number"),
            ("frames", Kind.COUNT, "number, all sensors"),
            ("tracks", Kind.COUNT, "number of annotations"),
            ("boxes", Kind.COUNT, "rows of `annotations`"),
            ("findings", Kind.COUNT, "number, repetitions included"),
            ("size_bytes", Kind.TIME, "size on disk"),
            ("fingerprint", Kind.TEXT, "file names, sizes, times and settings, hashed"),
        ),
        "sensors": _columns(
            ("sensor", Kind.TEXT, "id"),
            ("type", Kind.TEXT, "lidar, camera, …"),
            ("count", Kind.COUNT, "frames, images, poses or samples"),
            ("rate_hz", Kind.NUMBER, "1 / median interval [Hz]"),
            ("start", Kind.NUMBER, "first timestamp, from the scene's first [s]"),
            ("stop", Kind.NUMBER, "last timestamp [s]"),
            ("gaps", Kind.COUNT, "intervals above 1.5 medians"),
            ("camera_model", Kind.TEXT, "model and image size"),
            ("video", Kind.TEXT, "codec"),
            ("mounted", Kind.FLAG, "extrinsics known"),
        ),
        "frames": _columns(
            ("sensor", Kind.TEXT, "id"),
            ("type", Kind.TEXT, "sensor type"),
            ("reference", Kind.FLAG, "defines the moments"),
            ("frame", Kind.COUNT, "number from 0"),
            ("timestamp_ns", Kind.TIME, "time [ns]"),
            ("seconds", Kind.NUMBER, "from the scene's first timestamp [s]"),
            ("x", Kind.NUMBER, "ego in the world [m]"),
            ("y", Kind.NUMBER, "[m]"),
            ("z", Kind.NUMBER, "[m]"),
            *_EGO,
        ),
        "annotations": _columns(
            ("track", Kind.COUNT, "key of `tracks`"),
            ("annotation", Kind.TEXT, "id"),
            ("type", Kind.TEXT, "cuboid or box_2d"),
            ("label", Kind.TEXT, "class"),
            ("sensor", Kind.TEXT, "camera of a 2D box"),
            ("timestamp_ns", Kind.TIME, "[ns]"),
            ("seconds", Kind.NUMBER, "from the scene's first timestamp [s]"),
            ("x", Kind.NUMBER, "centre, frame of the annotations [m]"),
            ("y", Kind.NUMBER, "[m]"),
            ("z", Kind.NUMBER, "[m]"),
            ("length", Kind.NUMBER, "[m]"),
            ("width", Kind.NUMBER, "[m]"),
            ("height", Kind.NUMBER, "[m]"),
            ("yaw", Kind.NUMBER, "heading, from x to y [rad]"),
            ("speed", Kind.NUMBER, "[m/s]"),
            ("distance", Kind.NUMBER, "from the ego [m]"),
            ("left_px", Kind.NUMBER, "2D box [px]"),
            ("top_px", Kind.NUMBER, "[px]"),
            ("width_px", Kind.NUMBER, "[px]"),
            ("height_px", Kind.NUMBER, "[px]"),
            *_EGO,
        ),
        "tracks": _columns(
            ("track", Kind.COUNT, "number from 0"),
            ("annotation", Kind.TEXT, "id"),
            ("type", Kind.TEXT, "cuboid, box_2d, event, …"),
            ("label", Kind.TEXT, "class"),
            ("parent", Kind.TEXT, "id of the parent annotation"),
            ("sensor", Kind.TEXT, "its only sensor"),
            ("stationary", Kind.FLAG, "marked stationary"),
            ("boxes", Kind.COUNT, "rows of `annotations`"),
            ("start", Kind.NUMBER, "from the scene's first timestamp [s]"),
            ("stop", Kind.NUMBER, "[s]"),
            ("metres", Kind.NUMBER, "length of its path [m]"),
            ("nearest", Kind.NUMBER, "smallest distance [m]"),
        ),
        "attributes": _columns(
            ("owner", Kind.TEXT, "scene, sensor or annotation"),
            ("track", Kind.COUNT, "annotation"),
            ("sensor", Kind.TEXT, "id"),
            ("name", Kind.TEXT, "attribute"),
            ("value", Kind.TEXT, "as text, a row per value"),
            ("number", Kind.NUMBER, "numeric value"),
            ("start_ns", Kind.TIME, "start of validity [ns]; null: always"),
            ("stop_ns", Kind.TIME, "end of validity [ns]; null: to the end"),
        ),
        "findings": _columns(
            ("rule", Kind.TEXT, "id"),
            ("severity", Kind.TEXT, "error, warning or hint"),
            ("location", Kind.TEXT, "path, or line"),
            ("message", Kind.TEXT, "finding"),
            ("remedy", Kind.TEXT, "remedy"),
            ("count", Kind.COUNT, "occurrences"),
            ("fixable", Kind.FLAG, "by `validate --fix`"),
        ),
    }
)
"""Columns by tables; every table has a further one before them, `scene`."""


@dataclass(frozen=True, slots=True)
class Repeated:
    """A column of text in which few words stand in many rows.

    Attributes:
        codes: (N,) integers, which word stands in each row.
        words: the words; None for null.
    """

    codes: np.ndarray[Any, Any]
    words: tuple[str | None, ...]


Values = np.ndarray[Any, Any] | list[Any] | Repeated
"""The rows of a column: NaN, None and counts below 0 are null."""

Rows = dict[str, Values]
"""The rows of a table, by columns."""
