"""Processes that work for this one, found and killed by what Linux tells of them."""

import os
import random
import resource
import signal
from contextlib import suppress
from pathlib import Path


def workers() -> list[int]:
    """Processes that work for this one: those of the pool, and those of dask on this machine."""
    ours = _children("self")
    forked = [worker for child in ours if b"forkserver" in _command(child) for worker in _children(child)]
    return forked + [child for child in ours if b"spawn_main" in _command(child)]


def _children(process: int | str) -> list[int]:
    with suppress(OSError):
        threads = list(Path(f"/proc/{process}/task").iterdir())
        return [int(child) for thread in threads for child in (thread / "children").read_text().split()]
    return []


def _command(process: int) -> bytes:
    with suppress(OSError):
        return Path(f"/proc/{process}/cmdline").read_bytes()
    return b""


def kill_workers(generator: random.Random, count: int = 1) -> list[int]:
    """Kill random workers; give which."""
    found = workers()
    chosen = generator.sample(found, min(count, len(found)))
    for process in chosen:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return chosen


def processor_seconds() -> float:
    """How long this process and those that it has seen end were busy [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def touch(_place, output, _options):
    """Do nothing with a drive: a verb of `batch`."""
    output.touch()
