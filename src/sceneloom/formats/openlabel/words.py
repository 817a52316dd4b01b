"""The words of OpenLABEL that reading and writing share.

Source: ASAM OpenLABEL 1.0.0, "JSON schema", and the names of stream properties in its reference program VCD.
"""

import re
from collections.abc import Mapping
from types import MappingProxyType

SCHEMA_VERSION = "1.0.0"
WORLD, EGO = "world", "ego"
"""Names of the coordinate systems that we write."""

OURS = "sceneloom"
"""Name of what only we understand: a member of metadata and stream properties, and a text of objects."""

INTERPOLATED, CONFIRMED = "interpolated", "confirmed"
"""Flags inside of cuboids between key frames, and of boxes that are projections of cuboids."""

UID = re.compile(r"-?[0-9]+|[0-9a-fA-F]{8}-(?:[0-9a-fA-F]{4}-){3}[0-9a-fA-F]{12}")
"""What the schema takes as the key of an object, action, event, context, relation or tag."""

GEOMETRY = ("cuboid", "bbox", "rbbox", "poly2d", "poly3d", "point2d", "point3d")
"""Types of object data that have a location."""

PLAIN = ("text", "num", "boolean", "vec")
"""Types of data that are read as a plain value."""

KEPT_WHOLE = ("mat", "image", "binary", "mesh", "line_reference", "area_reference")
"""Types of data that are kept as they are."""

ELEMENTS: Mapping[str, str] = MappingProxyType(
    {"objects": "object", "actions": "action", "events": "event", "contexts": "context"}
)
"""What a file has lists of, and what one of each is called."""

ABSOLUTE, RELATIVE = "MODE_POLY2D_ABSOLUTE", "MODE_POLY2D_RELATIVE"
SENSOR_TYPES = ("camera", "lidar", "radar", "gps_imu", "other")
