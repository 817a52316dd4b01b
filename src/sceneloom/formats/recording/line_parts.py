"""The parts of a large file of lines, read by several processes, given in the order of the file."""

import json
import multiprocessing
import os
import pickle
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Condition, Thread

from sceneloom.errors import OptionError
from sceneloom.formats.processors import processors
from sceneloom.formats.recording.line_worker import ReadPart, command, read_part

PROCESSES = "SCENELOOM_PROCESSES"
"""Name of the environment variable that says how many processes read a large file."""

PART = 2 << 20
SMALL_FILE = 32 << 20
"""Below this, one process is as fast [bytes]."""

_MOST_BY_ITSELF = 4
_AHEAD = 8
"""How many parts for each process may wait for those before them."""

_ASKED_AT_ONCE = 2
"""How many parts a process has to read: when it is done with one, it need not wait to hear of the next."""

_LOST = (OSError, EOFError, ValueError, pickle.UnpicklingError, MemoryError)
"""What goes wrong with a process that is no more."""


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
    return 1 if multiprocessing.parent_process() is not None else min(processors(), _MOST_BY_ITSELF)


def _runs_python() -> bool:
    """Whether this process was started by a Python program that can be started again."""
    name = Path(sys.executable or "").name.lower()
    return not getattr(sys, "frozen", False) and name.startswith(("python", "pypy"))


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
        self._parts: dict[int, ReadPart | Path | None] = {}
        self._given, self._wanted, self._closed = 0, 0, False
        self._changed = Condition()
        self._folder = _new_folder()
        others = processes - 1 if self._folder is not None else 0
        self._workers = [worker for _ in range(others) if (worker := _start(path)) is not None]
        self._threads = [Thread(target=self._serve, args=(worker,), daemon=True) for worker in self._workers]
        for thread in self._threads:
            thread.start()

    def __iter__(self) -> Iterator[tuple[tuple[int, int], ReadPart | None]]:
        """Give where each part begins and ends, and what it says; None for parts that have to be read once more."""
        for place, bounds in enumerate(self._bounds):
            part = self._take(place)
            yield bounds, _load(part) if isinstance(part, Path) else part

    def close(self) -> None:
        """End the other processes."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for worker in self._workers:
            worker.kill()
        for thread in self._threads:
            thread.join()
        for worker in self._workers:
            _release(worker)
        if self._folder is not None:
            self._folder.cleanup()

    def _take(self, place: int) -> ReadPart | Path | None:
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

    def _next_of_others(self, *, wait: bool) -> int | None:
        """Give another process the next part, if need be as soon as there is one; None where there is none."""
        with self._changed:
            while not self._closed and self._given < len(self._bounds):
                place = self._next()
                if place is not None or not wait:
                    return place
                self._changed.wait()
        return None

    def _serve(self, worker: "subprocess.Popen[bytes]") -> None:
        """Have a process read parts until there are no more; those that it leaves unread are to be read once more."""
        asked: deque[int] = deque()
        with suppress(*_LOST):
            _told(worker)
            while True:
                while len(asked) < _ASKED_AT_ONCE:
                    place = self._next_of_others(wait=not asked)
                    if place is None:
                        break
                    asked.append(place)
                    _ask(worker, self._bounds[place], self._file(place))
                if not asked:
                    return
                found = self._file(asked[0]) if _told(worker) else None
                self._put(asked.popleft(), found)
        for place in asked:
            self._put(place, None)

    def _put(self, place: int, part: Path | None) -> None:
        with self._changed:
            self._parts[place] = part
            self._changed.notify_all()

    def _file(self, place: int) -> Path:
        """Where another process puts a part."""
        return Path("" if self._folder is None else self._folder.name, str(place))


def _new_folder() -> "tempfile.TemporaryDirectory[str] | None":
    """Make a folder for the parts; None where there is no place for one, and this process reads alone."""
    with suppress(OSError):
        return tempfile.TemporaryDirectory(prefix="sceneloom-", ignore_cleanup_errors=True)
    return None


def _start(path: Path) -> "subprocess.Popen[bytes] | None":
    """Start a process; None where the system does not let us, and others do its work."""
    with suppress(OSError):
        return subprocess.Popen(  # noqa: S603 - this very program, and a module of ours
            command(path),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    return None


def _ask(worker: "subprocess.Popen[bytes]", bounds: tuple[int, int], target: Path) -> None:
    if worker.stdin is None:
        raise EOFError
    worker.stdin.write(json.dumps([*bounds, str(target)]).encode() + b"\n")
    worker.stdin.flush()


def _told(worker: "subprocess.Popen[bytes]") -> int:
    """Wait for the number that a process says next."""
    text = worker.stdout.readline() if worker.stdout is not None else b""
    if not text.endswith(b"\n"):
        raise EOFError
    return int(text)


def _load(file: Path) -> ReadPart | None:
    """Read what another process put into a file, and remove that; None where it is not whole."""
    with suppress(*_LOST):
        part = pickle.loads(file.read_bytes())  # noqa: S301 - our own process made it
        file.unlink()
        return part if isinstance(part, ReadPart) else None
    return None


def _release(worker: "subprocess.Popen[bytes]") -> None:
    for pipe in (worker.stdin, worker.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    worker.wait()
