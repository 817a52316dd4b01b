"""Bags of ROS 2 in SQLite files. Source: rosbag2_storage_sqlite3 of ROS 2."""

import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from threading import RLock
from typing import Any
from urllib.parse import quote

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.files import check_regular, file_faults
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.ros.bags import Connection

MAGIC = b"SQLite format 3\x00"


class SqliteBag:
    """The messages of one file, by their rows.

    Attributes:
        path: the file.
        connections: all streams.
    """

    def __init__(self, path: Path, ledger: Ledger) -> None:
        """Read which messages there are.

        Raises:
            DataError: the file is damaged, or no bag; a lenient reading takes what is whole.
        """
        self.path = path
        self._begin()
        try:
            self.connections, self._numbers = self._read_topics()
            self._rows = self._read_rows(ledger)
        except sqlite3.Error as error:
            self.close()
            raise DataError(path, "", f"cannot be read as a bag: {error}") from error
        except DataError:
            self.close()
            raise

    def _begin(self) -> None:
        self._database: sqlite3.Connection | None = None
        self._process = -1
        self._lock = RLock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("path", "connections", "_numbers", "_rows")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    def _opened(self) -> sqlite3.Connection:
        if self._database is None or self._process != os.getpid():
            with file_faults(self.path):
                check_regular(self.path)
            address = f"file:{quote(os.fspath(self.path.absolute()))}?mode=ro"
            self._database = sqlite3.connect(address, uri=True, check_same_thread=False)
            self._process = os.getpid()
        return self._database

    def _read_topics(self) -> tuple[tuple[Connection, ...], dict[int, int]]:
        database = self._opened()
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type='table'")}
        if not {"topics", "messages"} <= tables:
            raise DataError(
                self.path, "", f"tables {', '.join(sorted(tables)) or 'none'}; expected topics, messages"
            )
        definitions = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (form, text) for name, form, text in database.execute(query)}
        found: list[Connection] = []
        numbers: dict[int, int] = {}
        for identifier, name, kind, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            form, text = definitions.get(kind, ("ros2msg", ""))
            numbers[identifier] = len(found)
            found.append(Connection(name, kind, text or "", form or "ros2msg", encoding or "cdr"))
        return tuple(found), numbers

    def _read_rows(self, ledger: Ledger) -> list[tuple[Int64Array, Int64Array]]:
        """Ids and times of the messages of each connection."""
        rows: list[list[tuple[int, int]]] = [[] for _ in self.connections]
        lost = 0
        try:
            for identifier, topic, time_ns in self._opened().execute(
                "SELECT id, topic_id, timestamp FROM messages ORDER BY id"
            ):
                if topic in self._numbers:
                    rows[self._numbers[topic]].append((identifier, time_ns))
                else:
                    lost += 1
        except sqlite3.Error as error:
            count = sum(map(len, rows))
            problem = f"damaged after {count} messages, is it cut off?: {error}"
            ledger.fault("bag-cut-off", DataError(self.path, "messages", problem))
        if lost:
            problem = f"{lost} messages of topics that are not listed"
            ledger.fault("bag-damaged", DataError(self.path, "messages", problem), count=lost)
        arrays = [np.array(found, np.int64).reshape(-1, 2) for found in rows]
        return [(array[:, 0], array[:, 1]) for array in arrays]

    def received(self, number: int) -> Int64Array:
        """When the messages of a connection were recorded."""
        return self._rows[number][1]

    def data(self, number: int, k: int) -> memoryview:
        """The bytes of message `k` of a connection.

        Raises:
            DataError: the file is damaged there.
        """
        identifier = int(self._rows[number][0][k])
        with self._lock:
            try:
                row = self._opened().execute("SELECT data FROM messages WHERE id=?", (identifier,)).fetchone()
            except sqlite3.Error as error:
                raise self._fault(identifier, error) from error
        if row is None or not isinstance(row[0], bytes):
            raise self._fault(identifier, "no bytes")
        return memoryview(row[0])

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        """How each message of a connection begins."""
        for identifier in self._rows[number][0].tolist():
            with self._lock:
                try:
                    with self._opened().blobopen("messages", "data", identifier, readonly=True) as blob:
                        content = blob.read(size)
                except (sqlite3.Error, OverflowError) as error:
                    raise self._fault(identifier, error) from error
            yield content

    def _fault(self, identifier: int, problem: object) -> DataError:
        return DataError(self.path, f"messages: id {identifier}", f"cannot be read: {problem}")

    def close(self) -> None:
        """Release the file."""
        with self._lock:
            if self._database is not None and self._process == os.getpid():
                self._database.close()
            self._database = None
