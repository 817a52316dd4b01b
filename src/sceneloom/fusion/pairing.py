"""Which pictures belong to which sweep, and when that is known: the same for what a detector saw in them."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from sceneloom.scene import Identifier

_LONGEST_LAG_NS = 10_000_000_000
"""Sweeps that come, or are stamped, later than so long after their points were measured are not paired any more."""


class Timed(Protocol):
    """Something of one time: a picture, or the boxes that a detector saw in it."""

    @property
    def timestamp_ns(self) -> int:
        """When it was [ns]."""
        ...


Frame = TypeVar("Frame", bound=Timed)
"""Of a lidar: a sweep, or the boxes in it."""

Partner = TypeVar("Partner", bound=Timed)
"""Of a camera: a picture, or the boxes in it."""


@dataclass(slots=True)
class TimedQueue(Generic[Partner]):
    """What one camera has sent and a sweep may still ask for, in time order.

    Attributes:
        camera_id: the camera.
        most: how many are kept, the oldest are dropped; None for as many as come.
    """

    camera_id: Identifier
    most: int | None = None
    items: deque[Partner] = field(default_factory=deque)

    def add(self, item: Partner) -> int:
        """Keep one; one that comes late takes its place in time. Gives how many were dropped to make room."""
        late: list[Partner] = []
        while self.items and self.items[-1].timestamp_ns > item.timestamp_ns:
            late.append(self.items.pop())
        self.items.append(item)
        self.items.extend(reversed(late))
        dropped = 0 if self.most is None else max(len(self.items) - self.most, 0)
        for _ in range(dropped):
            self.items.popleft()
        return dropped

    def reaches(self, time_ns: int) -> bool:
        """Whether one at or after that time has come, so that the nearest one is known."""
        return bool(self.items) and self.items[-1].timestamp_ns >= time_ns

    def nearest(self, time_ns: int, tolerance_ns: int) -> Partner | None:
        """The one nearest in time, the earlier one of two equally near, None beyond the tolerance."""
        near = min(self.items, key=lambda item: abs(item.timestamp_ns - time_ns), default=None)
        if near is None or abs(near.timestamp_ns - time_ns) > tolerance_ns:
            return None
        return near

    def forget_before(self, time_ns: int) -> None:
        """Let go of what no sweep from that time on can be nearest to."""
        while len(self.items) > 1 and self.items[1].timestamp_ns <= time_ns:
            self.items.popleft()


@dataclass(frozen=True, slots=True)
class Waiting(Generic[Frame]):
    """A sweep that waits for pictures.

    Attributes:
        lidar_id: its lidar.
        index: its number in the lidar.
        frame: the sweep.
        reference_ns: the time that it is paired by [ns].
        tolerance_ns: how far a picture may be from it [ns].
    """

    lidar_id: Identifier
    index: int
    frame: Frame
    reference_ns: int
    tolerance_ns: int


@dataclass(slots=True)
class Pairing(Generic[Frame, Partner]):
    """Sweeps in the order in which they came, and the pictures that they may be paired with.

    A sweep is ready as soon as every camera has sent a picture at or after its reference time, or so much time has
    passed that none can come any more.

    Attributes:
        lateness_ns: how much later than its time a picture may arrive and still be waited for.
        most_waiting: sweeps that may wait; None for as many as come.
        queues: the pictures of each camera.
        waiting: the sweeps, oldest first.
    """

    lateness_ns: int = 0
    most_waiting: int | None = None
    queues: dict[Identifier, TimedQueue[Partner]] = field(default_factory=dict)
    waiting: deque[Waiting[Frame]] = field(default_factory=deque)
    _lags_ns: dict[Identifier, int] = field(default_factory=dict)
    _latest_ns: int | None = None

    def configure(self, lateness_ns: int, most: int | None) -> None:
        """Wait so long, and keep so many sweeps and pictures of each camera, from now on."""
        self.lateness_ns, self.most_waiting = lateness_ns, most
        for queue in self.queues.values():
            queue.most = most

    def add_camera(self, camera_id: Identifier, *, most: int | None = None) -> None:
        """Make a camera known; `most` of its pictures are kept."""
        self.queues[camera_id] = TimedQueue(camera_id, most)

    def add_frame(self, waiting: Waiting[Frame]) -> int:
        """Let a sweep wait; gives how many were dropped to make room."""
        stamp_ns = waiting.frame.timestamp_ns
        self.waiting.append(waiting)
        self._lags_ns[waiting.lidar_id] = min(max(stamp_ns - waiting.reference_ns, 0), _LONGEST_LAG_NS)
        self._note(stamp_ns)
        dropped = 0 if self.most_waiting is None else max(len(self.waiting) - self.most_waiting, 0)
        for _ in range(dropped):
            self.waiting.popleft()
        return dropped

    def add_partner(self, camera_id: Identifier, partner: Partner) -> int:
        """Keep a picture; gives how many were dropped to make room."""
        dropped = self.queues[camera_id].add(partner)
        self._note(partner.timestamp_ns)
        return dropped

    def ready(self, *, final: bool = False) -> Iterator[Waiting[Frame]]:
        """Yield the sweeps whose pictures are known, oldest first; with `final` all that wait.

        What no later sweep can ask for is forgotten once the one after is asked for.
        """
        while self.waiting and (final or self._is_ready(self.waiting[0])):
            waiting = self.waiting.popleft()
            yield waiting
            # sweeps come in order of their stamps; a later one can refer to any time from this stamp on, less the lag
            self._forget_before(waiting.frame.timestamp_ns - max(self._lags_ns.values()))
        if not self.waiting and self._latest_ns is not None:
            self._forget_before(self._latest_ns - _LONGEST_LAG_NS)

    def partner(self, waiting: Waiting[Frame], camera_id: Identifier) -> Partner | None:
        """A camera's picture for a sweep; None where none is near enough."""
        return self.queues[camera_id].nearest(waiting.reference_ns, waiting.tolerance_ns)

    def _note(self, time_ns: int) -> None:
        self._latest_ns = time_ns if self._latest_ns is None else max(self._latest_ns, time_ns)

    def _is_ready(self, waiting: Waiting[Frame]) -> bool:
        if all(queue.reaches(waiting.reference_ns) for queue in self.queues.values()):
            return True
        latest = waiting.reference_ns if self._latest_ns is None else self._latest_ns
        return latest > waiting.reference_ns + waiting.tolerance_ns + self.lateness_ns

    def _forget_before(self, time_ns: int) -> None:
        for queue in self.queues.values():
            queue.forget_before(time_ns)
