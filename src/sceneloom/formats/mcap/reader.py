"""Reads an MCAP file with Foxglove's schemas as a scene: its channels as a log of topics, and the scene of these."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.mcap.foxglove_reading import READERS, head_timestamp, parse_json, parse_protobuf
from sceneloom.formats.mcap.index import McapIndex, read_index
from sceneloom.formats.mcap.schemas import NOTES, NOTES_KEY, SAMPLE_SCHEMA
from sceneloom.formats.topics.chunks import Entries
from sceneloom.formats.topics.file_bytes import FileBytes
from sceneloom.formats.topics.log import Topic
from sceneloom.formats.topics.records import AnyRecord, Kind
from sceneloom.formats.topics.scene_from_topics import scene_from_topics
from sceneloom.scene.assumed_camera_models import with_assumed_models
from sceneloom.scene.scene import Scene

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
        return Topic(
            number, channel.topic, f"{channel.message_encoding or 'bytes'} without a schema", None, count
        )
    return Topic(number, channel.topic, name, kind, count)
