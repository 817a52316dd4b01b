"""Queues of a session: tasks for its worker, results that wait to be fetched.

And the events that an observer is told.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from sceneloom.db34t.properties import Snapshot
from sceneloom.db34t.received_records import Accepted, Counters, Stream
from sceneloom.db34t.records import ResultRecord, SentRecord
from sceneloom.db34t.results import FoundObjects
from sceneloom.db34t.types import Outcome
from sceneloom.scene.poses import Poses


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """The vehicle's trajectory of the last while is known anew.

    Attributes:
        path: that way, from an origin of its own.
        sent: the piece of it that came now.
    """

    path: Poses
    sent: Poses


@dataclass(frozen=True, slots=True, eq=False)
class Flushed:
    """What waits is to be fused with what has come.

    Attributes:
        done: set when it is.
        final: whether nothing comes after it.
    """

    done: threading.Event = field(default_factory=threading.Event)
    final: bool = False


Task = Accepted | Moved | Flushed
"""What a worker does."""

_PIXEL_BYTES = 7
"""What a pixel takes while its image is fused: red, green, blue, and a depth of 32 bits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueLimits:
    """What waits in one system at most, whatever its properties state.

    Attributes:
        most_length: what the properties queue_length and result_queue_length can be set to.
        most_bytes: of records that are not fused yet; and of results of each type that wait to be fetched.
    """

    most_length: int = 2**32 - 1
    most_bytes: int = 2**63

    @property
    def most_pixels(self) -> int:
        """How many pixels all cameras may have together: a sweep is fused with an image of each at once."""
        return self.most_bytes // _PIXEL_BYTES


QUEUE_PROPERTIES = ("queue_length", "result_queue_length")
"""Those that `QueueLimits.most_length` bounds."""


@dataclass(slots=True)
class TaskQueue:
    """Tasks in the order in which they came; of each sensor's records only so many wait.

    Attributes:
        closed: whether the worker may end.
        busy: whether the worker does a task that it took; the worker says when it does not any more.
        moves: how many chunks of the vehicle's trajectory wait.
    """

    _tasks: deque[Task] = field(default_factory=deque)
    _waiting: Counter[Stream] = field(default_factory=Counter)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    closed: bool = False
    busy: bool = False
    moves: int = 0
    _woken: bool = False

    def __len__(self) -> int:
        return len(self._tasks)

    @property
    def idle(self) -> bool:
        """Whether nothing is being done or to be done."""
        return not self._tasks and not self.busy

    def put(self, task: Task, *, most: int) -> list[Accepted]:
        """Append a task; gives the older records of the same stream that were dropped to make room.

        Args:
            most: how many records of one stream may wait.
        """
        dropped: list[Accepted] = []
        with self._changed:
            if isinstance(task, Accepted):
                while self._waiting[task.stream] >= most:
                    dropped.append(self._drop_oldest(task.stream))
                self._waiting[task.stream] += 1
            self.moves += isinstance(task, Moved)
            self._tasks.append(task)
            self._changed.notify()
        return dropped

    def get(self, timeout_s: float) -> Task | None:
        """Take the oldest task, waiting for one; None where none came, it was woken, or it is closed and empty."""
        with self._changed:
            if not self._tasks:
                self._changed.wait_for(lambda: self._tasks or self.closed or self._woken, timeout_s)
            self._woken = False
            if not self._tasks:
                return None
            self.busy = True  # before the queue is empty: whoever looks at both never finds it idle
            task = self._tasks.popleft()
            if isinstance(task, Accepted):
                self._waiting[task.stream] -= 1
            self.moves -= isinstance(task, Moved)
            return task

    def wake(self) -> None:
        """Let the worker look at the time: something other than a task waits now."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    def close(self) -> None:
        """Let the worker end once it has done what is there."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _drop_oldest(self, stream: Stream) -> Accepted:
        k, oldest = next(
            (k, task)
            for k, task in enumerate(self._tasks)
            if isinstance(task, Accepted) and task.stream == stream
        )
        del self._tasks[k]
        self._waiting[stream] -= 1
        return oldest


_Item = TypeVar("_Item")


@dataclass(slots=True)
class ResultQueue(Generic[_Item]):
    """A bounded queue from threads that fuse to several that fetch."""

    _bytes: int = 0
    _items: deque[tuple[_Item, int]] = field(default_factory=deque)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _closed: bool = False

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: _Item, *, size: int, most: int, most_bytes: int) -> int:
        """Append a result, drop the oldest ones beyond the limits, and give how many were dropped.

        Args:
            size: of the item [byte].
            most: how many may wait.
            most_bytes: how large they may be together; the newest one stays in any case.
        """
        dropped = 0
        with self._changed:
            self._items.append((item, size))
            self._bytes += size
            while len(self._items) > 1 and (len(self._items) > most or self._bytes > most_bytes):
                self._take()
                dropped += 1
            self._changed.notify()
        return dropped

    def put_back(self, item: _Item, *, size: int, before: Callable[[_Item], bool]) -> None:
        """Take back an item that was fetched, to its location: in front of all that it comes before."""
        with self._changed:
            location = next(
                (k for k, (other, _) in enumerate(self._items) if before(other)), len(self._items)
            )
            self._items.insert(location, (item, size))
            self._bytes += size
            self._changed.notify()

    def get(self, timeout_s: float = 0.0) -> _Item | None:
        """Fetch the oldest result, waiting for one up to `timeout_s`; None where none came or the queue is closed."""
        with self._changed:
            if not self._items and timeout_s > 0.0:
                self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._take() if self._items else None

    def _take(self) -> _Item:
        item, size = self._items.popleft()
        self._bytes -= size
        return item

    def close(self) -> None:
        """Let all who wait go; what is there can still be fetched."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One result, as clause 5.7 gives it.

    Attributes:
        number: among the results of its type, from 0 on; a gap where results were dropped.
        record: of table 9, or the records of table 10 of one pair.
        configuration: the properties in force when its sweep came; all calibrations among them.
        found: of records of table 10 in the process that fused them, what they report.
    """

    number: int
    record: ResultRecord
    configuration: Snapshot
    found: FoundObjects | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Refused:
    """A record that was not taken, and why.

    Attributes:
        record: as it was sent.
        outcome: the answer.
    """

    record: SentRecord
    outcome: Outcome


@dataclass(frozen=True, slots=True, eq=False)
class Dropped:
    """A record that had been taken and was dropped before it was fused, because too many waited.

    Attributes:
        accepted: the record.
    """

    accepted: Accepted


Event = Accepted | Refused | Dropped | Moved | Flushed | Result
"""What an observer is reported, in the order in which it counts."""

Observer = Callable[[Event], None]


class Announcer:
    """Reports an observer what happens, one call at a time, from any thread.

    Attributes:
        observed: whether somebody looks on.
    """

    def __init__(self, observer: Observer | None, counters: Counters) -> None:
        """Report an observer, or nobody; an observer that fails is counted."""
        self.observed = observer is not None
        self._observer = observer
        self._counters = counters
        self._telling = threading.Lock()

    def notify(self, event: Event) -> None:
        """Report what happened."""
        if self._observer is None:
            return
        with self._telling:
            try:
                self._observer(event)
            except Exception as error:  # noqa: BLE001 - who only looks on must not end the session
                self._counters.add(f"errors.observer.{type(error).__name__}")
