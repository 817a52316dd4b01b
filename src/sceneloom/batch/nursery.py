"""A process that imports once what all workers need, and that they are forked from: each by itself takes seconds.

Where processes cannot be forked, or the program has such a process of its own already, workers start afresh.
"""

import multiprocessing
import multiprocessing.forkserver
import os
import signal
import sys
import threading
from collections.abc import Sequence
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.util import get_temp_dir
from typing import Final

_FORK: Final = "forkserver"
_AFRESH: Final = "spawn"
_LONGEST = 80
"""Longest name of the temporary folder: that of a socket in it may have 107 bytes."""
_FREE = threading.Lock()
"""Python has one such process for a whole program: it is held from the first worker until the last one has ended."""


class Nursery:
    """Where workers come from."""

    def __init__(self, modules: Sequence[str]) -> None:
        """Nothing is started yet.

        Args:
            modules: what workers need; they must start no threads when they are imported.
        """
        self._modules = list(modules)
        self._held = False
        self.method: str = _AFRESH

    def open(self) -> SpawnContext | ForkServerContext:
        """Give what starts workers; the first of them decides about the environment of all."""
        if not self._held and _can_fork() and _FREE.acquire(blocking=False):
            self._held, self.method = True, _FORK
        if self._held:
            multiprocessing.get_context(_FORK).set_forkserver_preload(self._modules)
            return multiprocessing.get_context(_FORK)
        return multiprocessing.get_context(_AFRESH)

    def close(self) -> None:
        """End it, once all workers have ended."""
        if self._held:
            self._held, self.method = False, _AFRESH
            # nothing public ends it, and the next run may have another environment; it has nothing to leave in order,
            # which would take half a second
            process_id = _process_id()
            if process_id is not None:
                os.kill(process_id, signal.SIGKILL)
            getattr(_server(), "_stop")()  # noqa: B009 - unknown to type checkers
            _FREE.release()


def _server() -> multiprocessing.forkserver.ForkServer:
    return multiprocessing.forkserver._forkserver  # noqa: SLF001 - see above


def _process_id() -> int | None:
    return getattr(_server(), "_forkserver_pid", None)


def _can_fork() -> bool:
    if sys.platform != "linux" or _process_id() is not None:
        return False
    return len(os.fsencode(get_temp_dir())) < _LONGEST
