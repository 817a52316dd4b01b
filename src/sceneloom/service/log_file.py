"""The file of a log: messages in chunks, there after a crash as far as they were written, complete once it is closed.

Source: the MCAP specification, mcap.dev/spec.
"""

import os
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from sceneloom.errors import DataError, OutputError
from sceneloom.formats.files import open_file
from sceneloom.formats.mcap.schemas import schema_bytes
from sceneloom.formats.mcap.writer import McapWriter
from sceneloom.formats.output import check_output
from sceneloom.fusion.messages.protobuf_form import parse_message
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.version import __version__

CHUNK_BYTES = 4 << 20
"""Of messages that are compressed and written together; the most that is kept in memory, beside the largest message."""

MOST_CHANNELS = 60_000
"""Channels of one file, of at most 65535 that the format counts."""

_UNFINISHED = ".unfinished"
_MAGIC_BYTES = 8
_OURS = fusion_pb2.DESCRIPTOR.package


def unfinished_path(path: Path) -> Path:
    """Where a log is until it is closed, and stays after a crash."""
    return path.with_name(f"{path.stem}{_UNFINISHED}{path.suffix}")


class LogWriter:
    """Writes messages of any number of channels; from several threads.

    Attributes:
        path: where the log is once it is closed.
        failure: why nothing is written any more; None while all is well.
    """

    def __init__(
        self,
        path: Path,
        *,
        overwrite: bool = False,
        on_failure: Callable[[Exception], None] | None = None,
    ) -> None:
        """Begin a log.

        Args:
            overwrite: replace a log that is there.
            on_failure: told once why nothing is written any more.

        Raises:
            OutputError: the log, or an unfinished one of its name, is there, or cannot be written.
        """
        check_output(path, overwrite=overwrite)
        self.path = path
        self.failure: Exception | None = None
        self._overwrite = overwrite
        self._on_failure = on_failure
        self._closed = False
        self._latest_ns = 0
        self._lock = threading.Lock()
        self._draft = unfinished_path(path)
        check_output(self._draft, overwrite=overwrite)
        try:
            self._stream: BinaryIO = self._draft.open("wb")
        except OSError as error:
            raise OutputError(f"{self._draft}: cannot be written: {error.strerror}") from error
        self._writer = McapWriter(
            self._stream, library=f"sceneloom {__version__}", compression="lz4", chunk_bytes=CHUNK_BYTES
        )
        self._stream.flush()
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write values that are no message."""
        with self._lock:
            self._attempt(lambda: self._writer.add_metadata(name, dict(values)))

    def add(
        self,
        topic: str,
        message_type: type[Any],
        content: bytes,
        *,
        session: str,
        what: str,
        timestamp_ns: int | None = None,
        log_time_ns: int | None = None,
    ) -> None:
        """Write a message.

        Args:
            topic: of its channel.
            message_type: its class.
            content: its bytes.
            session: that it is of.
            what: what it says, for those who read the log again.
            timestamp_ns: when what it says was measured; None for when it happened.
            log_time_ns: when it happened; None for now.
        """
        happened_ns = time.time_ns() if log_time_ns is None else log_time_ns
        with self._lock:
            # times never run backwards in the file, whatever the clock does: its order is what is played again
            self._latest_ns = max(happened_ns, self._latest_ns)
            published_ns = self._latest_ns if timestamp_ns is None else timestamp_ns
            self._attempt(lambda: self._write(topic, message_type, content, session, what, published_ns))

    def flush(self) -> None:
        """Hand what was added to the disk."""
        with self._lock:
            if not self._closed:
                self._attempt(self._writer.flush)

    def close(self) -> None:
        """Complete the log and give it its name.

        Raises:
            OutputError: it could not be written; what is there is beside it.
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._attempt(self._finish)
        if self.failure is not None:
            raise OutputError(f"{self.path}: cannot be written: {self.failure}; see {self._draft}")

    def _write(
        self,
        topic: str,
        message_type: type[Any],
        content: bytes,
        session: str,
        what: str,
        published_ns: int,
    ) -> None:
        channel = self._channel(topic, message_type, session, what)
        self._writer.add_message(channel, self._latest_ns, [content], published_ns)

    def _channel(self, topic: str, message_type: type[Any], session: str, what: str) -> int:
        name = message_type.DESCRIPTOR.full_name
        known = self._channels.get((topic, name, session))
        if known is not None:
            return known
        if len(self._channels) >= MOST_CHANNELS:
            raise OutputError(f"{MOST_CHANNELS} channels, as many as a log may have")
        if name not in self._schemas:
            self._schemas[name] = self._writer.add_schema(name, "protobuf", schema_bytes(message_type))
        metadata = {"session": session, "what": what}
        channel = self._writer.add_channel(topic, "protobuf", self._schemas[name], metadata)
        self._channels[topic, name, session] = channel
        return channel

    def _attempt(self, step: Callable[[], None]) -> None:
        """Do a step; a log that cannot be written must not end what it is a log of."""
        if self.failure is not None:
            return
        try:
            step()
        except Exception as error:  # noqa: BLE001 - whatever a full disk or a foreign writer does
            self.failure = error
            if self._on_failure is not None:
                self._on_failure(error)

    def _finish(self) -> None:
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        check_output(self.path, overwrite=self._overwrite)
        self._draft.replace(self.path)


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One message of a log.

    Attributes:
        session: that it is of.
        what: what it says.
        topic: of its channel.
        log_time_ns: when it was written.
        message: of our `.proto`.
    """

    session: str
    what: str
    topic: str
    log_time_ns: int
    message: Any


def is_log(path: Path) -> bool:
    """Whether a file begins as an MCAP file does."""
    if not path.is_file():
        return False
    with open_file(path) as file:
        return file.read(6) == b"\x89MCAP0"


def is_complete(path: Path) -> bool:
    """Whether a log was closed, rather than cut off by a crash."""
    if not is_log(path) or path.stat().st_size < 2 * _MAGIC_BYTES:
        return False
    with open_file(path) as file:
        start = file.read(_MAGIC_BYTES)
        file.seek(-_MAGIC_BYTES, os.SEEK_END)
        return file.read() == start


def read_log(path: Path) -> Iterator[LogEntry]:
    """Give the messages of our schemas in the order in which they were written; what a crash cut off ends it.

    Raises:
        DataError: the file is no MCAP file, or holds none of our messages.
    """
    from mcap.records import Channel, Schema
    from mcap.records import Message as Record

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    found = False
    for record in _records(path):
        if isinstance(record, Schema):
            schemas[record.id] = _message_type(record.name)
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Record):
            channel = channels[record.channel_id]
            message_type = schemas.get(channel.schema_id)
            if message_type is None or "what" not in channel.metadata:
                continue
            found = True
            told = channel.metadata
            yield LogEntry(
                told.get("session", ""),
                told["what"],
                channel.topic,
                record.log_time,
                parse_message(message_type, record.data),
            )
    if not found:
        raise DataError(path, "", f"no messages of {_OURS}; expected a log of this service")


def _message_type(schema: str) -> type[Any] | None:
    package, _, name = schema.rpartition(".")
    return getattr(fusion_pb2, name, None) if package == _OURS else None


def _records(path: Path) -> Iterator[Any]:
    """The records of a file up to its end, or to where it was cut off."""
    from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
    from mcap.stream_reader import StreamReader

    if not is_log(path):
        raise DataError(path, "", "no MCAP file")
    with open_file(path) as file:
        try:
            yield from StreamReader(file, record_size_limit=path.stat().st_size).records
        except (EndOfFile, RecordLengthLimitExceeded, struct.error):
            return  # it ends in the middle of a record
        except (McapError, RuntimeError, ValueError) as error:
            raise DataError(path, f"byte {file.tell()}", f"cannot be read: {error}") from error
