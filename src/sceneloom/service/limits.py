"""How much one caller may ask of the service."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from sceneloom.errors import DataError

MEBIBYTE = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceLimits:
    """Limits of the service and of each of its sessions.

    Attributes:
        most_sessions: sessions at once.
        idle_minutes: a session that nobody used for so long is ended.
        most_open_requests: requests of one session at once, those that wait for results among them.
        most_bytes_waiting: of one session: requests that are being read, records that wait to be fused, and, counted
            by themselves, results that wait to be fetched [byte].
        most_queue_length: what the properties queue_length and result_queue_length can be set to.
        largest_message: a request or a record [byte].
        most_calls: calls at once, of all sessions.
        drain_seconds: how long a server that ends waits for those who fetch results.
    """

    most_sessions: int = 16
    idle_minutes: float = 30.0
    most_open_requests: int = 64
    most_bytes_waiting: int = 1024 * MEBIBYTE
    most_queue_length: int = 256
    largest_message: int = 256 * MEBIBYTE
    most_calls: int = 1024
    drain_seconds: float = 10.0

    @classmethod
    def of(cls, table: Mapping[str, Any], *, file: object = "limits", location: str = "") -> Self:
        """Read limits from a table of a configuration file.

        Raises:
            DataError: a limit is not known, or no positive number.
        """
        known = {field.name: field.type for field in fields(cls)}
        for name, value in table.items():
            where = f"{location}.{name}" if location else name
            if name not in known:
                raise DataError(file, where, f"unknown; expected one of {', '.join(known)}")
            whole = known[name] is int
            if (
                isinstance(value, bool)
                or not isinstance(value, int if whole else int | float)
                or not value > 0
            ):
                wanted = "a whole number above 0" if whole else "a number above 0"
                raise DataError(file, where, f"{value!r}; expected {wanted}")
        return cls(**table)
