"""What the service does, as lines of JSON for machines that gather logs."""

import json
import logging
from datetime import UTC, datetime


def log_to_standard_error(*, quiet: bool = False, verbose: bool = False) -> logging.Logger:
    """Let the service log to standard error as lines of JSON.

    Args:
        quiet: warnings only.
        verbose: what helps to find faults, too.
    """
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
