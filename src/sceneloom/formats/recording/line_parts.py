"""The parts of a large file of lines, read by several processes, given in the order of the file."""

import json
import multiprocessing
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Condition, Thread

from sceneloom.errors import OptionError
from sceneloom.formats.recording.line_worker import LENGTH_BYTES, START, ReadPart, read_part

PROCESSES = "SCENELOOM_PROCESSES"
"""Name of the environment variable that says how many processes read a large file."""

PART = 4 << 20
SMALL_FILE = 32 << 20
"""Below this, one process is as fast [bytes]."""

_MOST_BY_ITSELF = 4
_AHEAD = 3
"""How many parts for each process may wait for those before them."""


def reading_processes(size: int) -> int:
    """Say how many processes read a file.

    The environment variable `SCENELOOM_PROCESSES` decides; without it, processors do, up to four, and a process that
    another one has started reads alone.

    Args:
        size: of the file [bytes].

    Raises:
        OptionError: the variable is no whole number from 1 on.
    """
    text = os.environ.get(PROCESSES)
    if text is not None and not (text.isdecimal() and int(text) > 0):
        raise OptionError(f"{PROCESSES} {text!r}; expected a whole number, 1 or more")
    if size < SMALL_FILE or not _runs_python():
        return 1
    if text is not None:
        return int(text)
    return 1 if multiprocessing.parent_process() is not None else min(_processors(), _MOST_BY_ITSELF)


def _runs_python() -> bool:
    """Whether this process was started by a Python program that can be started again."""
    name = Path(sys.executable or "").name.lower()
    return not getattr(sys, "frozen", False) and name.startswith(("python", "pypy"))


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class LineParts:
    """Reads parts of a file in this process and in others, which have ended when it is closed.

    The others are started as programs of their own, not as copies of this process: so a script needs no guard for
    them, threads of this process do no harm, and a process that may not have children of its own may use this.
    """

    def __init__(self, path: Path, size: int, processes: int) -> None:
        """Start the other processes.

        Args:
            path: the file.
            size: its length [bytes].
            processes: how many, this one included.
        """
        self._path = path
        self._bounds = [(start, min(start + PART, size)) for start in range(0, size, PART)]
        self._ahead = _AHEAD * processes
        self._parts: dict[int, ReadPart | None] = {}
        self._given, self._wanted, self._closed = 0, 0, False
        self._changed = Condition()
        self._workers = [_start(path) for _ in range(processes - 1)]
        self._threads = [
            Thread(target=self._serve, args=(worker,), daemon=True)
            for worker in self._workers
            if worker is not None
        ]
        for thread in self._threads:
            thread.start()

    def __iter__(self) -> Iterator[tuple[tuple[int, int], ReadPart | None]]:
        """Give where each part begins and ends, and what it says; None for parts that have to be read once more."""
        for place, bounds in enumerate(self._bounds):
            yield bounds, self._take(place)

    def close(self) -> None:
        """End the other processes."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for worker in self._workers:
            if worker is not None:
                worker.kill()
        for thread in self._threads:
            thread.join()
        for worker in self._workers:
            if worker is not None:
                _release(worker)

    def _take(self, place: int) -> ReadPart | None:
        with self._changed:
            self._wanted = place
            self._changed.notify_all()
        while True:
            with self._changed:
                if place in self._parts:
                    return self._parts.pop(place)
                mine = self._next()
                if mine is None:
                    self._changed.wait()
                    continue
            part = read_part(self._path, *self._bounds[mine])
            with self._changed:
                self._parts[mine] = part

    def _next(self) -> int | None:
        """Give the next part to read to whoever asks, None while too many wait, or where there are no more."""
        place = self._given
        if place >= len(self._bounds) or place > self._wanted + self._ahead:
            return None
        self._given += 1
        return place

    def _serve(self, worker: "subprocess.Popen[bytes]") -> None:
        """Have a process read parts until there are no more."""
        while True:
            with self._changed:
                place = self._next()
                while place is None and not self._closed and self._given < len(self._bounds):
                    self._changed.wait()
                    place = self._next()
                if place is None or self._closed:
                    return
            try:
                part = _ask(worker, self._bounds[place])
            except (OSError, EOFError, ValueError, pickle.UnpicklingError, MemoryError):
                part, lost = None, True
            else:
                lost = False
            with self._changed:
                self._parts[place] = part
                self._changed.notify_all()
            if lost:
                return


def _start(path: Path) -> "subprocess.Popen[bytes] | None":
    """Start a process; None where the system does not let us, and others do its work."""
    with suppress(OSError):
        return subprocess.Popen(  # noqa: S603 - this very program, and a module of ours
            [sys.executable, "-c", START, json.dumps(sys.path), str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    return None


def _ask(worker: "subprocess.Popen[bytes]", bounds: tuple[int, int]) -> ReadPart | None:
    if worker.stdin is None or worker.stdout is None:
        raise EOFError
    worker.stdin.write(json.dumps(bounds).encode() + b"\n")
    worker.stdin.flush()
    length = _exactly(worker, LENGTH_BYTES)
    part = pickle.loads(_exactly(worker, int.from_bytes(length, "little")))  # noqa: S301 - our own process made it
    return part if isinstance(part, ReadPart) else None


def _exactly(worker: "subprocess.Popen[bytes]", count: int) -> bytes:
    text = worker.stdout.read(count) if worker.stdout is not None else b""
    if len(text) != count:
        raise EOFError
    return text


def _release(worker: "subprocess.Popen[bytes]") -> None:
    for pipe in (worker.stdin, worker.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    worker.wait()
