"""A scene as an MCAP file with Foxglove's schemas."""

import json
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

import msgspec

from sceneloom.formats.loss import LossReport
from sceneloom.formats.mcap.foxglove_writing import encode
from sceneloom.formats.mcap.schemas import (
    NOTES,
    NOTES_KEY,
    SAMPLE_JSON,
    SAMPLE_SCHEMA,
    foxglove_type,
    schema_bytes,
)
from sceneloom.formats.mcap.writer import McapWriter
from sceneloom.formats.output import replacing
from sceneloom.formats.topics.dialect import Dialect
from sceneloom.formats.topics.names import topic_part
from sceneloom.formats.topics.records import AnyRecord
from sceneloom.formats.topics.scene_streams import SceneStreams
from sceneloom.formats.topics.streams import merged
from sceneloom.formats.topics.written_images import check_images
from sceneloom.scene.scene import Scene
from sceneloom.version import __version__

DIALECT = Dialect(
    name="MCAP",
    world="world",
    ego="ego",
    part=topic_part,
    fisheye="kannala_brandt",
    camera_model_topic="calibration",
    sample_topics=MappingProxyType({"": "imu"}),
    videos=True,
    covariances=False,
)


class FoxgloveWriter:
    """Writes records to an MCAP file; schemas and channels are added when they are first needed."""

    def __init__(self, writer: McapWriter, shift_ns: int) -> None:
        """Begin.

        Args:
            writer: of the file.
            shift_ns: what is added to times to give log times, which cannot be negative.
        """
        self._writer, self._shift_ns = writer, shift_ns
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def add(self, time_ns: int, topic: str, record: AnyRecord) -> None:
        """Write a record as a message."""
        schema, parts = encode(record)
        self._writer.add_message(self._channel(topic, schema), time_ns + self._shift_ns, parts)

    def _channel(self, topic: str, schema: str) -> int:
        known = self._channels.get((topic, schema))
        if known is not None:
            return known
        is_json = schema == SAMPLE_SCHEMA
        if schema not in self._schemas:
            data = msgspec.json.encode(dict(SAMPLE_JSON)) if is_json else schema_bytes(foxglove_type(schema))
            encoding = "jsonschema" if is_json else "protobuf"
            self._schemas[schema] = self._writer.add_schema(schema, encoding, data)
        channel = self._writer.add_channel(topic, "json" if is_json else "protobuf", self._schemas[schema])
        self._channels[topic, schema] = channel
        return channel


def write_mcap(
    scene: Scene, path: Path, *, overwrite: bool = False, compression: str = "none", images: str = "copy"
) -> LossReport:
    """Write a scene; one message is in memory at a time.

    Args:
        scene: the drive.
        path: of the file.
        overwrite: whether a file that is there may be replaced.
        compression: of chunks: "none", "lz4" or "zstd".
        images: "copy" hands on videos packet by packet and JPEG files as they are, and encodes the rest as JPEG;
            "jpeg", "png" and "raw" write all images in one form.

    Raises:
        OptionError: there is no such compression, or way of writing images.
        OutputError: the file exists, or cannot be written.
    """
    check_images(images)
    with replacing(path, overwrite=overwrite) as draft, draft.open("wb") as stream:
        return _write(scene, stream, compression, images)


def _write(scene: Scene, stream: BinaryIO, compression: str, images: str) -> LossReport:
    writer = McapWriter(stream, library=f"sceneloom {__version__}", compression=compression, large_apart=True)
    plan = SceneStreams(scene, DIALECT, images=images)
    shift_ns = max(0, -plan.start_ns)
    records = FoxgloveWriter(writer, shift_ns)
    for time_ns, topic, record in merged(plan.streams):
        records.add(time_ns, topic, record)
    writer.add_metadata(NOTES, {NOTES_KEY: json.dumps(plan.notes)})
    writer.finish()
    return LossReport.of(plan.losses.all)
