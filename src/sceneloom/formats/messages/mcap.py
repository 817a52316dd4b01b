"""MCAP files with Foxglove's schemas: as a log of topics, as a scene, and written from one."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO
from urllib.parse import quote

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import replacing
from sceneloom.formats.messages.file_bytes import Entries, FileBytes
from sceneloom.formats.messages.foxglove import (
    NOTES,
    NOTES_KEY,
    READERS,
    SAMPLE_JSON,
    SAMPLE_SCHEMA,
    encode,
    foxglove_type,
    head_timestamp,
    parse_json,
    parse_protobuf,
    schema_bytes,
)
from sceneloom.formats.messages.mcap_files import McapIndex, McapWriter, read_index
from sceneloom.formats.messages.reader import scene_from_topics
from sceneloom.formats.messages.records import AnyRecord, Dialect, Kind, Topic, merged
from sceneloom.formats.messages.writer import SceneStreams, check_images
from sceneloom.scene.scene import Scene, with_assumed_models
from sceneloom.version import __version__


def _topic_part(identifier: str | int) -> str:
    """An id as one part of a topic's name; `_id_of_part` is its inverse for texts."""
    return quote(str(identifier), safe="") or "%"


_DIALECT = Dialect(
    name="MCAP",
    world="world",
    ego="ego",
    part=_topic_part,
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
    plan = SceneStreams(scene, _DIALECT, images=images)
    shift_ns = max(0, -plan.start_ns)
    records = FoxgloveWriter(writer, shift_ns)
    for time_ns, topic, record in merged(plan.streams):
        records.add(time_ns, topic, record)
    writer.add_metadata(NOTES, {NOTES_KEY: json.dumps(plan.notes)})
    writer.finish()
    return LossReport.of(plan.losses.all)


_HEAD_BYTES = 512

_LOOKED_AT = 8
"""Messages of a topic in compressed chunks whose own times are compared with those of the index."""

_PARSERS = MappingProxyType({"protobuf": parse_protobuf, "json": parse_json})


def open_mcap(
    path: Path | str,
    *,
    lenient: bool = False,
    assume_model: bool = False,
    timestamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
) -> Scene:
    """Open a file: its index and all small messages are read, images and points when they are asked for.

    Args:
        path: of the file; or its URL.
        lenient: read what is whole of a file that was not finished, is cut off or damaged; leave out topics and
            messages that are at fault; go by receive times where timestamps are of another clock.
        assume_model: allow computing with camera models whose formulas nothing confirms.
        timestamps: which time of a message counts: "header", what it says itself, or "receive", when it was recorded;
            None: what it says itself.
        ego, world: names of the frames that are to be the ego and the world; None: chosen from the transforms.

    Raises:
        DataError: the file is damaged, or a message is wrong.
        OptionError: a frame is not there, or `timestamps` is none of the two.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        log = _open_log(path, ledger)
        reported = {"profile": log.index.profile, "library": log.index.library}
        scene = scene_from_topics(
            log, ledger, form="mcap", metadata=reported, timestamps=timestamps, ego=ego, world=world
        )
    return with_assumed_models(scene) if assume_model else scene


@dataclass(frozen=True, slots=True, eq=False)
class McapLog:
    """The topics of a file.

    Attributes:
        index: what is where in it.
        topics: all channels.
        entries: of each topic, by number.
    """

    index: McapIndex
    topics: tuple[Topic, ...]
    entries: Mapping[int, Entries]

    @property
    def name(self) -> str:
        """The file's path."""
        return str(self.index.file.path)

    @property
    def notes(self) -> str | None:
        """What our writer left."""
        return next((values.get(NOTES_KEY) for name, values in self.index.metadata if name == NOTES), None)

    def receive_times(self, topic: Topic) -> Int64Array:
        """When each message was recorded, (N,) int64 [ns]."""
        return self.entries[topic.number].log_times_ns

    def timestamps(self, topic: Topic) -> tuple[Int64Array, bool]:
        """The time that each message says itself.

        In compressed chunks some messages are looked at. Where all of these state the time that the index has, so do
        the others; else all are.
        """
        entries = self.entries[topic.number]
        if len(entries) > _LOOKED_AT and self.index.messages.compressed(entries).any():
            rows = np.unique(np.linspace(0, len(entries) - 1, _LOOKED_AT).astype(np.int64))
            if np.array_equal(self._timestamps_of(topic, rows), entries.log_times_ns[rows]):
                return entries.log_times_ns, False
        return self._timestamps_of(topic, np.arange(len(entries))), True

    def _timestamps_of(self, topic: Topic, rows: Int64Array) -> Int64Array:
        entries = self.entries[topic.number]
        json = self._encoding(topic) != "protobuf"
        found: list[int | None] = (
            [None] * len(rows)
            if json
            else [head_timestamp(head) for head in self.index.messages.heads(entries, rows, _HEAD_BYTES)]
        )
        return np.array(
            [
                self.read(topic, row)[0].timestamp_ns if timestamp is None else timestamp
                for row, timestamp in zip(rows.tolist(), found, strict=True)
            ],
            np.int64,
        )

    def _encoding(self, topic: Topic) -> str:
        return self.index.channels[topic.number].message_encoding

    def read(self, topic: Topic, k: int) -> Sequence[AnyRecord]:
        """What message `k` says.

        Raises:
            DataError: it is no message of its schema.
        """
        content = self.index.messages.data(self.entries[topic.number], k)
        try:
            found = _PARSERS[self._encoding(topic)](topic.schema, content)
        except (ValueError, OverflowError) as error:
            raise DataError(self.name, f"{topic.name}[{k}]", str(error)) from error
        return found

    def close(self) -> None:
        """Release the file."""
        self.index.file.close()


def _open_log(path: Path | str, ledger: Ledger) -> McapLog:
    """Read the index of a file.

    Raises:
        DataError: it is no MCAP file, or damaged.
    """
    file = FileBytes(path)
    try:
        index = read_index(file, ledger)
        entries = {number: index.messages.entries(number) for number in index.channels}
        topics = tuple(_topic(index, number, len(entries[number])) for number in index.channels)
    except BaseException:
        file.close()
        raise
    return McapLog(index, topics, MappingProxyType(entries))


def _topic(index: McapIndex, number: int, count: int) -> Topic:
    channel = index.channels[number]
    schema = index.schemas.get(channel.schema_id)
    name = "" if schema is None else schema.name
    kind = Kind.SAMPLE if name == SAMPLE_SCHEMA and channel.message_encoding == "json" else None
    kind = READERS[name][0] if name in READERS else kind
    if kind is not None and channel.message_encoding not in _PARSERS:
        why = f"in the encoding {channel.message_encoding!r}; expected protobuf or json"
        return Topic(number, channel.topic, name, None, count, why)
    if schema is None:
        return Topic(number, channel.topic, f"{channel.message_encoding or 'bytes'} without a schema", None, count)
    return Topic(number, channel.topic, name, kind, count)
