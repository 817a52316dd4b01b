"""The machine: processors, memory, room for temporary files, programs that show things."""

import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

_GIGABYTE = 1e9
_BROWSERS = ("chromium", "google-chrome", "firefox", "open")
LEAST_TEMPORARY_BYTES = 1_000_000_000
"""Images and clouds are spooled; less room is soon filled."""


def python_line() -> str:
    """Which Python this is, and on what."""
    return f"{platform.python_version()} ({sys.executable}) on {platform.system()} {platform.machine()}"


def processor_line(available: int) -> str:
    """How many processors there are, and how many of them may be used."""
    return f"{available} of {os.cpu_count() or available} to use"


def memory_bytes() -> tuple[int, int] | None:
    """All memory and what of it is free [bytes]; None where the system does not report."""
    table = Path("/proc/meminfo")
    try:
        rows = dict(line.split(":", 1) for line in table.read_text("ascii").splitlines() if ":" in line)
        return tuple(1024 * int(rows[name].split()[0]) for name in ("MemTotal", "MemAvailable"))  # type: ignore[return-value]
    except (OSError, ValueError, KeyError):
        return None


def memory_line() -> str:
    """The memory in words."""
    known = memory_bytes()
    if known is None:
        return "not reported by this system"
    return f"{known[0] / _GIGABYTE:.1f} GB, {known[1] / _GIGABYTE:.1f} GB free"


def temporary_space() -> tuple[str, int]:
    """The folder of temporary files, and the room that is left there [bytes]."""
    folder = tempfile.gettempdir()
    return folder, shutil.disk_usage(folder).free


def programs() -> Iterator[tuple[str, str | None]]:
    """Programs that show results, with their locations; None where they are not there."""
    yield "rerun viewer", shutil.which("rerun", path=_search_path())
    yield "web browser", next(filter(None, map(shutil.which, _BROWSERS)), None)


def _search_path() -> str:
    """Where programs are looked for: beside this Python first, which need not be on the path."""
    return os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
