"""Does what is due, in the order in which it came: fuses records, moves the vehicle, fuses what waits."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from sceneloom.fusion.accepted import Accepted
from sceneloom.fusion.algorithms import BUILT_IN, FusionType
from sceneloom.fusion.counters import Counters
from sceneloom.fusion.events import Announcer, Dropped
from sceneloom.fusion.ledger import Ledger
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.queues import Flushed, Moved, Task, TaskQueue
from sceneloom.fusion.rig import Rig, RigResult

_LONGEST_IDLE_S = 3600.0

_FEW_BOXES = 100
"""Lists of so many boxes are fused in less time than it takes to hand them to another thread and back."""

_MANY_LATER = 1000
"""After a longer list, a sweep or an image so many lists go to the thread, for they may be fused together."""


class Overdue(Protocol):
    """What else there is to do by the clock."""

    def __call__(self, now_s: float) -> float | None:
        """Do what is due now, and state when the next is, both by the monotonic clock [s]; None for never."""
        ...


class Worker:
    """Does tasks one at a time, and gives the results.

    They are done by a thread of its own, or with `inline` by those that hand them in. Small lists of boxes are always
    fused by who hands them in, if the thread has nothing to do.
    """

    def __init__(
        self,
        counters: Counters,
        ledger: Ledger,
        announcer: Announcer,
        give: Callable[[RigResult], None],
        *,
        inline: bool,
        overdue: Overdue,
    ) -> None:
        """Begin.

        Args:
            counters: where failures are counted.
            ledger: reported what became of each record.
            announcer: reported each task before it is done, and what was dropped.
            give: reported each result.
            inline: whether there is no thread.
            overdue: what the thread does while no task comes.
        """
        self._counters = counters
        self._ledger = ledger
        self._announcer = announcer
        self._give = give
        self._overdue = overdue
        self._rig = Rig(counters, ledger)
        self._tasks = TaskQueue()
        self._fusing = threading.Lock()
        self._latest_s = time.monotonic()
        self._idle_s = _LONGEST_IDLE_S
        self._wakes_s = 0.0
        self._later = 0
        self._thread = None if inline else threading.Thread(target=self._work, name="fusion", daemon=True)
        if self._thread is not None:
            self._thread.start()

    @property
    def inline(self) -> bool:
        """Whether there is no thread."""
        return self._thread is None

    @property
    def waiting_moves(self) -> int:
        """How many chunks of the vehicle's trajectory wait."""
        return self._tasks.moves

    def wake(self) -> None:
        """Let the thread look at what is overdue."""
        self._tasks.wake()

    def do(self, task: Task, *, most: int = 0) -> None:
        """Do a task, or let the thread do it; for one caller at a time.

        Args:
            most: how many records of one stream may wait; the oldest ones make room.
        """
        if self._thread is None:
            self._perform(task)
        elif not self._done_at_once(task):
            for accepted in self._tasks.put(task, most=most):
                self._announcer.notify(Dropped(accepted))
                self._ledger.settle(accepted.ticket, "dropped.queue-full")

    def close(self) -> None:
        """Do what is there, fuse what waits, and take nothing more; the thread goes on until that is done."""
        self._tasks.close()
        if self._thread is None:
            self._perform(Flushed(final=True))

    def join(self) -> None:
        """Wait until the thread has ended."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _done_at_once(self, task: Task) -> bool:
        """Fuse a small list of boxes here, if nothing is before it."""
        if not isinstance(task, Accepted):
            return False
        if not _is_small(task):
            self._later = _MANY_LATER
            return False
        if self._later > 0:
            self._later -= 1
            return False
        if self._announcer.observed or not self._fusing.acquire(blocking=False):
            return False
        try:
            if not self._tasks.idle:
                return False
            self._perform(task)
            if self._rig.waits and self._wakes_s > self._latest_s + self._idle_s:
                self._tasks.wake()
        finally:
            self._fusing.release()
        return True

    def _work(self) -> None:
        while True:
            task = self._tasks.get(self._patience_s())
            ended = task is None and self._tasks.closed and len(self._tasks) == 0
            if task is not None or ended:
                with self._fusing:
                    self._perform(task or Flushed(final=True))
                    self._tasks.busy = False
            if ended:
                return

    def _patience_s(self) -> float:
        """Do what is overdue, and give for how long nothing will be [s]."""
        again_s = self._overdue(time.monotonic())
        with self._fusing:
            now_s = time.monotonic()
            if self._rig.waits and self._tasks.idle:
                flush_s = self._latest_s + self._idle_s
                if now_s >= flush_s:
                    self._perform(Flushed())
                elif again_s is None or flush_s < again_s:
                    again_s = flush_s
            self._wakes_s = now_s + _LONGEST_IDLE_S if again_s is None else again_s
            return max(self._wakes_s - now_s, 0.0)

    def _perform(self, task: Task) -> None:
        self._announcer.notify(task)
        try:
            for result in self._results(task):
                self._give(result)
        except Exception as error:  # noqa: BLE001 - one record must not end the session
            self._counters.add(f"errors.{type(error).__name__}")
        finally:
            if isinstance(task, Flushed):
                task.done.set()
        self._latest_s = time.monotonic()

    def _results(self, task: Task) -> Iterator[RigResult]:
        if isinstance(task, Accepted):
            self._idle_s = task.setting.idle_s
            return self._rig.feed(task, task.ticket)
        if isinstance(task, Moved):
            self._rig.move(task.path, origin=task.sent.positions[-1])
            return iter(())
        return self._rig.end() if task.final else self._rig.flush()


def _is_small(accepted: Accepted) -> bool:
    """Whether its fusion takes no time to speak of: few boxes, and no algorithm of somebody else's."""
    record = accepted.record
    if not isinstance(record, Boxes3d | Boxes2d) or len(record) > _FEW_BOXES:
        return False
    return accepted.setting.properties.algorithms[FusionType.DETECTIONS] in BUILT_IN[FusionType.DETECTIONS]
