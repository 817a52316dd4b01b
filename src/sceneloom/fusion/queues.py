"""What a session's worker has to do, in order and bounded."""

import threading
from collections import Counter, deque
from dataclasses import dataclass, field

from sceneloom.fusion.accepted import Accepted
from sceneloom.fusion.ledger import Stream
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
