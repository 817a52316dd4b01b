"""Processes that work for this one, found and killed by what Linux reports them."""

import os
import random
import resource
import shutil
import signal
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from sceneloom.batch import Task


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


def alone(work: str, locations: list[str], folder: str, pipe) -> None:
    """Work without anything of a batch, once the other side says so; report what it took by clock and processor [s]."""
    from benchmarks.batch import fuse_job
    from sceneloom.batch.running import run_task

    out = Path(folder)
    job = fuse_job([Path(location) for location in locations])

    def fuse(location: str, k: int) -> None:
        draft = out / f"{k}" / "made.sfs"
        task = Task(number=k, attempt=1, call=job.call, location=location, draft=draft, options=job.options)
        assert not run_task(task).error

    def plain(location: str, k: int) -> None:
        values = np.random.default_rng(k + 1).random(1 << 20)
        for _ in range(3):
            values = np.sort(np.sin(values))
        shutil.copyfile(location, out / f"{k}.copy")

    do = {"fuse": fuse, "plain": plain}[work]
    do(locations[0], -1)  # imports and first touches
    pipe.send(None)
    pipe.recv()
    begun, busy = time.perf_counter(), time.process_time()
    for k, location in enumerate(locations):
        do(location, k)
    pipe.send((time.perf_counter() - begun, time.process_time() - busy))


def touch(_location, output, _options):
    """Do nothing with a drive: a verb of `batch`."""
    output.touch()
