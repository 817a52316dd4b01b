"""Bags of ROS 2 in MCAP files. Source: rosbag2_storage_mcap of ROS 2; MCAP format registry, profile "ros2"."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.mcap.index import McapIndex, read_index
from sceneloom.formats.ros.bags import Connection, full_type
from sceneloom.formats.topics.file_bytes import FileBytes


class McapBag:
    """The messages of one file.

    Attributes:
        connections: all streams.
    """

    def __init__(self, path: Path, ledger: Ledger) -> None:
        """Read which messages there are.

        Raises:
            DataError: the file was not finished, is cut off or damaged; a lenient reading takes what is whole.
        """
        file = FileBytes(path)
        try:
            index = read_index(file, ledger)
        except BaseException:
            file.close()
            raise
        self._messages = index.messages
        self.connections = tuple(_connection(index, number) for number in index.channels)
        self._entries = [index.messages.entries(number) for number in index.channels]

    def received(self, number: int) -> Int64Array:
        """When the messages of a connection were recorded."""
        return self._entries[number].log_times_ns

    def data(self, number: int, k: int) -> memoryview:
        """The bytes of message `k` of a connection."""
        return self._messages.data(self._entries[number], k)

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        """How each message of a connection begins."""
        entries = self._entries[number]
        return self._messages.heads(entries, np.arange(len(entries)), size)

    def close(self) -> None:
        """Release the file."""
        self._messages.file.close()


def _connection(index: McapIndex, number: int) -> Connection:
    channel = index.channels[number]
    schema = index.schemas.get(channel.schema_id)
    if schema is None:
        return Connection(channel.topic, "", "", "", channel.message_encoding)
    text = schema.data.decode("utf-8", "replace")
    return Connection(channel.topic, full_type(schema.name), text, schema.encoding, channel.message_encoding)
