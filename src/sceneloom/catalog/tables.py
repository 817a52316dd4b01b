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
    ("latitude", Kind.NUMBER, "of the ego [deg, WGS84]"),
    ("longitude", Kind.NUMBER, "of the ego [deg, WGS84]"),
    ("ego_speed", Kind.NUMBER, "speed of the ego, over half a second [m/s]"),
)

TABLES: Mapping[str, tuple[Column, ...]] = MappingProxyType(
    {
        "scenes": _columns(
            ("path", Kind.TEXT, "where the drive is"),
            ("options", Kind.TEXT, "how it is read, as JSON"),
            ("format", Kind.TEXT, "name of its format"),
            ("start_ns", Kind.TIME, "its first timestamp [ns]"),
            ("duration", Kind.NUMBER, "from its first to its last timestamp [s]"),
            ("period", Kind.NUMBER, "usual time from one moment to the next [s]"),
            ("moments_of", Kind.TEXT, "the sensor whose frames are its moments"),
            ("metres", Kind.NUMBER, "length of the ego trajectory [m]"),
            ("latitude", Kind.NUMBER, "where it begins [deg, WGS84]"),
            ("longitude", Kind.NUMBER, "where it begins [deg, WGS84]"),
            ("sensors", Kind.COUNT, "how many sensors"),
            ("frames", Kind.COUNT, "how many frames of all sensors"),
            ("tracks", Kind.COUNT, "how many annotations"),
            ("boxes", Kind.COUNT, "how many rows of `annotations`"),
            ("findings", Kind.COUNT, "how many findings, each as often as it was met"),
            ("size_bytes", Kind.TIME, "bytes on disk"),
            ("fingerprint", Kind.TEXT, "names, sizes and times of its files, and how they were catalogued"),
        ),
        "sensors": _columns(
            ("sensor", Kind.TEXT, "its id"),
            ("type", Kind.TEXT, "lidar, camera, …"),
            ("count", Kind.COUNT, "frames, images, poses or samples"),
            ("rate_hz", Kind.NUMBER, "one over the median interval [Hz]"),
            ("start", Kind.NUMBER, "first timestamp, after the scene's first [s]"),
            ("stop", Kind.NUMBER, "last timestamp, after the scene's first [s]"),
            ("gaps", Kind.COUNT, "holes longer than 1.5 median intervals"),
            ("camera_model", Kind.TEXT, "projection model and image size"),
            ("video", Kind.TEXT, "codec"),
            ("mounted", Kind.FLAG, "whether its mounting on the ego is known"),
        ),
        "frames": _columns(
            ("sensor", Kind.TEXT, "id of the sensor"),
            ("type", Kind.TEXT, "its type"),
            ("reference", Kind.FLAG, "whether its frames are the scene's moments"),
            ("frame", Kind.COUNT, "number of the frame, from 0"),
            ("timestamp_ns", Kind.TIME, "its time [ns]"),
            ("seconds", Kind.NUMBER, "its time after the scene's first timestamp [s]"),
            ("x", Kind.NUMBER, "of the ego in the scene's world [m]"),
            ("y", Kind.NUMBER, "of the ego in the scene's world [m]"),
            ("z", Kind.NUMBER, "of the ego in the scene's world [m]"),
            *_EGO,
        ),
        "annotations": _columns(
            ("track", Kind.COUNT, "number of the annotation in its scene; leads to `tracks`"),
            ("annotation", Kind.TEXT, "its id"),
            ("type", Kind.TEXT, "cuboid or box_2d"),
            ("label", Kind.TEXT, "its class"),
            ("sensor", Kind.TEXT, "the camera of a box in images"),
            ("timestamp_ns", Kind.TIME, "the moment [ns]"),
            ("seconds", Kind.NUMBER, "the moment after the scene's first timestamp [s]"),
            ("x", Kind.NUMBER, "of the centre, in the frame of the scene's annotations [m]"),
            ("y", Kind.NUMBER, "of the centre [m]"),
            ("z", Kind.NUMBER, "of the centre [m]"),
            ("length", Kind.NUMBER, "[m]"),
            ("width", Kind.NUMBER, "[m]"),
            ("height", Kind.NUMBER, "[m]"),
            ("yaw", Kind.NUMBER, "direction of its forward axis, from x towards y [rad]"),
            ("speed", Kind.NUMBER, "of the centre [m/s]"),
            ("distance", Kind.NUMBER, "from the ego to the centre [m]"),
            ("left_px", Kind.NUMBER, "of a box in images [px]"),
            ("top_px", Kind.NUMBER, "of a box in images [px]"),
            ("width_px", Kind.NUMBER, "of a box in images [px]"),
            ("height_px", Kind.NUMBER, "of a box in images [px]"),
            *_EGO,
        ),
        "tracks": _columns(
            ("track", Kind.COUNT, "number of the annotation in its scene, from 0"),
            ("annotation", Kind.TEXT, "its id"),
            ("type", Kind.TEXT, "cuboid, box_2d, event, …"),
            ("label", Kind.TEXT, "its class"),
            ("parent", Kind.TEXT, "id of the annotation that it belongs to"),
            ("sensor", Kind.TEXT, "the only sensor that it is for"),
            ("stationary", Kind.FLAG, "whether it is marked as stationary"),
            ("boxes", Kind.COUNT, "rows of `annotations`"),
            ("start", Kind.NUMBER, "its first moment, after the scene's first timestamp [s]"),
            ("stop", Kind.NUMBER, "its last moment [s]"),
            ("metres", Kind.NUMBER, "length of its trajectory [m]"),
            ("nearest", Kind.NUMBER, "its least distance [m]"),
        ),
        "attributes": _columns(
            ("owner", Kind.TEXT, "whose it is: scene, sensor or annotation"),
            ("track", Kind.COUNT, "number of the annotation"),
            ("sensor", Kind.TEXT, "id of the sensor"),
            ("name", Kind.TEXT, "what is stated"),
            ("value", Kind.TEXT, "its value as text, a row for each of several"),
            ("number", Kind.NUMBER, "its value, where it is a number"),
            ("start_ns", Kind.TIME, "from when it holds [ns]; null: from the beginning"),
            ("stop_ns", Kind.TIME, "before when it holds [ns]; null: to the end"),
        ),
        "findings": _columns(
            ("rule", Kind.TEXT, "id of the rule of `validate`"),
            ("severity", Kind.TEXT, "error, warning or hint"),
            ("location", Kind.TEXT, "where in the drive"),
            ("message", Kind.TEXT, "what was found"),
            ("remedy", Kind.TEXT, "what to do about it"),
            ("count", Kind.COUNT, "how often"),
            ("fixable", Kind.FLAG, "whether `validate --fix` repairs it"),
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
