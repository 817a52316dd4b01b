"""The names by which our own MCAP files are known again."""

from types import MappingProxyType

NOTES = "sceneloom"
"""Name of the metadata record that holds what no message has a place for."""

NOTES_KEY = "scene"

SAMPLE_SCHEMA = "sceneloom.Sample"
"""Name of the JSON schema of what an IMU measures, which Foxglove has none for."""

SAMPLE_JSON = MappingProxyType(
    {
        "title": SAMPLE_SCHEMA,
        "description": "One measurement of an inertial unit; streams in m/s², rad/s, µT and K.",
        "type": "object",
        "properties": {
            "timestamp": {
                "type": "object",
                "title": "time",
                "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
            },
            "frame_id": {"type": "string"},
            "values": {
                "type": "object",
                "additionalProperties": {"type": "array", "items": {"type": "number"}},
            },
        },
        "required": ["timestamp", "frame_id", "values"],
    }
)
"""Source: MCAP format registry, schema encoding "jsonschema"."""

LABEL_KEYS = ("label", "class", "class_name", "category", "type")
"""Metadata of drawings that name the class of an object, the likeliest first."""

ID_KEYS = ("id", "track_id", "instance_id", "object_id")
"""Metadata of drawings that name an object, the likeliest first."""
