"""What waits to be written into a log: a thread of its own writes it, so that those who tell it need not wait."""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from sceneloom.errors import SceneloomError

LOG = logging.getLogger(__name__)

MOST_BYTES = 512 << 20
"""Of records and results that wait to be written: some one and a half seconds of 10 Hz of 1080p and 250,000 points."""

MOST_ENTRIES = 20_000
"""Entries that may wait, however small they are."""

KEPT_BACK_S = 1.0
"""How long what was written may wait for the disk."""

Step = Callable[[int], None]
"""Writes an entry; told when it happened [ns]."""


class NotLoggedError(SceneloomError):
    """Something is not in the log: the disk was too slow or failed."""


class _Entry(NamedTuple):
    step: Step
    session: str
    size: int
    time_ns: int


@dataclass(eq=False)
class LogQueue:
    """Entries in the order in which they came, written by one thread; full, it leaves out and says so.

    Once there is no room, everything is left out until half of what waits is written: so the log has long parts that
    are whole, and not pictures without their sweeps.

    Attributes:
        flush: takes what was written to the disk.
        gap: writes that so many entries of a session are missing.
        most_bytes: what may wait.
        most_entries: how many entries may.
        kept_back_s: how long what was written may wait for the disk; 0: `put` returns when it is there.
        clock_ns: the time that entries are stamped with.
        lost: by session, how many entries are not in the log.
    """

    flush: Callable[[], None]
    gap: Callable[[str, int, int], None]
    most_bytes: int = MOST_BYTES
    most_entries: int = MOST_ENTRIES
    kept_back_s: float = KEPT_BACK_S
    clock_ns: Callable[[], int] = time.time_ns
    lost: Counter[str] = field(default_factory=Counter)
    _entries: deque[_Entry] = field(default_factory=deque)
    _bytes: int = 0
    _unsaid: Counter[str] = field(default_factory=Counter)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _closed: bool = False
    _full: bool = False
    _writing: bool = False
    _cut: bool = False

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    @property
    def pressed(self) -> bool:
        """Whether so much waits that only what cannot be made again should be written."""
        return 2 * self._bytes > self.most_bytes

    def put(self, step: Step, *, session: str = "", size: int = 0) -> None:
        """Let something be written after all that came before.

        Args:
            session: that it is of.
            size: how much memory it keeps [byte].

        Raises:
            NotLoggedError: it will not be: there is no room, or the log has ended.
        """
        with self._changed:
            if self._closed or self._cut or not self._has_room(size):
                self._leave_out(session)
            for name, count in self._unsaid.items():
                self._append(self._gap_step(name, count), name, 0)
            self._unsaid.clear()
            self._append(step, session, size)
            self._changed.notify_all()
            if self.kept_back_s <= 0:
                self._changed.wait_for(self._is_done)

    def cut(self) -> None:
        """Leave out everything from now on: the file cannot be written any more."""
        with self._changed:
            self._cut = True
            while self._entries:
                self.lost[self._take().session] += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Return when all is written."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _has_room(self, size: int) -> bool:
        waiting = len(self._entries) + self._writing
        share = 0.5 if self._full else 1.0
        fits = self._bytes + size <= share * self.most_bytes and waiting < share * self.most_entries
        self._full = waiting > 0 and not fits
        return not self._full

    def _leave_out(self, session: str) -> None:
        if not self._unsaid and not self._cut and not self._closed:
            waiting = {
                "session": session,
                "waiting_bytes": self._bytes,
                "waiting_entries": len(self._entries),
            }
            LOG.warning(
                "the disk is slower than what is to be logged: the log has a gap", extra={"fields": waiting}
            )
        self.lost[session] += 1
        self._unsaid[session] += 1
        raise NotLoggedError("the log has ended" if self._cut or self._closed else "the log has no room")

    def _gap_step(self, session: str, count: int) -> Step:
        return lambda time_ns: self.gap(session, count, time_ns)

    def _append(self, step: Step, session: str, size: int) -> None:
        self._entries.append(_Entry(step, session, size, self.clock_ns()))
        self._bytes += size

    def _take(self) -> _Entry:
        entry = self._entries.popleft()
        self._bytes -= entry.size
        return entry

    def _is_done(self) -> bool:
        return not self._entries and not self._writing

    def _work(self) -> None:
        unflushed_since_s: float | None = None
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._entries or self._closed, self._patience_s(unflushed_since_s)
                )
                if not self._entries and self._closed:
                    break
                entry = self._entries.popleft() if self._entries else None
                self._writing = entry is not None
            if entry is not None:
                self._write(entry)
                unflushed_since_s = time.monotonic() if unflushed_since_s is None else unflushed_since_s
            if unflushed_since_s is not None and self._patience_s(unflushed_since_s) == 0:
                self.flush()
                unflushed_since_s = None
            with self._changed:
                self._writing = False
                self._bytes -= 0 if entry is None else entry.size
                self._changed.notify_all()
        for session, count in self._unsaid.items():
            self._write(_Entry(self._gap_step(session, count), session, 0, self.clock_ns()))

    def _patience_s(self, since_s: float | None) -> float | None:
        """How long what is written may still wait for the disk [s]; None where nothing does."""
        return None if since_s is None else max(since_s + self.kept_back_s - time.monotonic(), 0.0)

    def _write(self, entry: _Entry) -> None:
        try:
            entry.step(entry.time_ns)
            if self._cut:
                self.lost[entry.session] += 1
        except Exception as error:  # noqa: BLE001 - one entry that cannot be said must not end the log
            LOG.error("an entry cannot be logged", extra={"fields": {"error": repr(error)}})  # noqa: TRY400
            with self._changed:
                self.lost[entry.session] += 1
                self._unsaid[entry.session] += 1
