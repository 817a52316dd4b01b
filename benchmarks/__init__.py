"""Measurements of speed, each beside a peer that does the same work: `python -m benchmarks.NAME`.

Where a peer is not installed, a benchmark ends with what to install.
"""

import sys
from types import TracebackType

_PEERS = "pip install '.[dev,bench]'"


def _name_what_to_install(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    """End with one line where a peer is missing, and with the traceback otherwise."""
    name = error.name if isinstance(error, ModuleNotFoundError) else None
    if name is None or name.partition(".")[0] in {"sceneloom", "benchmarks"}:
        sys.__excepthook__(kind, error, traceback)
    else:
        sys.stderr.write(f"{name.partition('.')[0]} is not installed; install the peers with `{_PEERS}`\n")


sys.excepthook = _name_what_to_install
