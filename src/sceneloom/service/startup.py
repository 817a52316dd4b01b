"""What a server needs before it starts: the extra `serve`, a free port, limits per caller, and a log of JSON lines.

Nothing here imports gRPC or compiles.
"""

import json
import logging
import socket
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from importlib import import_module
from typing import Any, Self

from sceneloom.errors import DataError, MissingExtraError, OptionError, how_to_install

for _name in ("google.protobuf", "grpc", "grpc_health", "grpc_reflection"):
    try:
        import_module(_name)
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('serve')}") from missing

_MEBIBYTE = 1 << 20


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
    most_bytes_waiting: int = 1024 * _MEBIBYTE
    most_queue_length: int = 256
    largest_message: int = 256 * _MEBIBYTE
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
            if isinstance(value, bool) or not isinstance(value, int if whole else int | float) or not value > 0:
                wanted = "a whole number above 0" if whole else "a number above 0"
                raise DataError(file, where, f"{value!r}; expected {wanted}")
        return cls(**table)


def check_port(host: str, port: int, *, option: str = "port") -> None:
    """Check that a server may listen at an address; `option` names the port in the message.

    Raises:
        OptionError: this machine does not have the address, or another program listens there.
    """
    reasons: list[str] = []
    try:
        found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        problem = "no such host; expected an address or a name of this machine"
        raise OptionError(f"cannot listen at {host}:{port}: {problem}") from error
    for family, _, _, _, address in found:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # what just closed is no hindrance
            try:
                probe.bind(address)
            except OSError as error:
                reported = (error.strerror or str(error)).lower()
                advice = f"choose another {option} (0 for a free one), or an address of this machine"
                reasons.append(f"{reported}; {advice}")
            else:
                return
    raise OptionError(f"cannot listen at {host}:{port}: {reasons[0]}")


def log_to_standard_error(*, quiet: bool = False, verbose: bool = False) -> logging.Logger:
    """Let the service log to standard error as lines of JSON."""
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines())
    logger = logging.getLogger("sceneloom.service")
    logger.handlers[:] = [handler]
    logger.setLevel(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
    logger.propagate = False
    return logger


class JsonLines(logging.Formatter):
    """Writes a record of a log as one line of JSON: time, level, where, what, and the fields that belong to it."""

    def format(self, record: logging.LogRecord) -> str:
        """Give the line."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "event": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            line["trace"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)
