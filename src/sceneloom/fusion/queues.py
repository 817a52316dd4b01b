"""What a session's worker has to do, in order and bounded."""

import threading
from collections import Counter, deque
from dataclasses import dataclass, field

from sceneloom.fusion.intake import Admitted, RefusedError
from sceneloom.fusion.outcome import Cause, refused
from sceneloom.scene.poses import PosePath


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """The vehicle's way of the last while is known anew.

    Attributes:
        path: that way, from an origin of its own.
        sent: the piece of it that came now.
    """

    path: PosePath
    sent: PosePath


@dataclass(frozen=True, slots=True, eq=False)
class Flushed:
    """What waits is to be fused with what has come.

    Attributes:
        done: set when it is.
    """

    done: threading.Event = field(default_factory=threading.Event)


Task = Admitted | Moved | Flushed
"""What a worker does."""


@dataclass(slots=True)
class TaskQueue:
    """Tasks in the order in which they came; of each sensor's records only so many wait."""

    _tasks: deque[Task] = field(default_factory=deque)
    _waiting: Counter[tuple[str, int]] = field(default_factory=Counter)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    closed: bool = False

    def __len__(self) -> int:
        return len(self._tasks)

    def put(self, task: Task, *, most: int, refuses: bool) -> list[Admitted]:
        """Append a task; gives the older records of the same stream that were dropped to make room.

        Args:
            most: how many records of one stream may wait.
            refuses: whether the record is refused rather than an older one dropped.

        Raises:
            RefusedError: there is no room.
        """
        dropped: list[Admitted] = []
        with self._changed:
            if isinstance(task, Admitted):
                full = self._waiting[task.stream] >= most
                if full and refuses:
                    reason = f"{most} records of {task.kind} {task.sensor_id} wait already (queue_length)"
                    raise RefusedError(refused(Cause.QUEUE_FULL, reason))
                while self._waiting[task.stream] >= most:
                    dropped.append(self._drop_oldest(task.stream))
                self._waiting[task.stream] += 1
            self._tasks.append(task)
            self._changed.notify()
        return dropped

    def get(self, timeout_s: float) -> Task | None:
        """Take the oldest task, waiting for one; None where none came or the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._tasks or self.closed, timeout_s)
            if not self._tasks:
                return None
            task = self._tasks.popleft()
            if isinstance(task, Admitted):
                self._waiting[task.stream] -= 1
            return task

    def close(self) -> None:
        """Let the worker end once it has done what is there."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _drop_oldest(self, stream: tuple[str, int]) -> Admitted:
        k, oldest = next(
            (k, task)
            for k, task in enumerate(self._tasks)
            if isinstance(task, Admitted) and task.stream == stream
        )
        del self._tasks[k]
        self._waiting[stream] -= 1
        return oldest
