"""Which images belong to which sweep, and when that is known; the same for the detections of a detector.

What the fusion system knows of each sensor stands here, too.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Generic, Protocol, TypeVar

from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.scene.cameras import GLOBAL, Shutter
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.point_times import RawTimes, TimesFound, timed_frame
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.types import NO_FIELDS, Identifier

_MOST_SWEEPS = 3  # so many sweeps are kept for boxes, which come later


@dataclass(slots=True)
class KnownLidar:
    """A lidar.

    Attributes:
        source: takes its points into the world; None where they come in world coordinates.
        location: `world_from_lidar`, whatever frame its points come in; None where that is not known.
        period_ns: the nominal time from sweep to sweep [ns].
        received: how many sweeps have come.
        received_boxes: how many lists of boxes have come.
        last_raw: times of the last sweep's points as they were read.
        latest: the last sweeps, from the first list of boxes on: their points location what images alone show.
    """

    source: PoseSource | None
    location: PoseSource | None
    period_ns: int
    received: int = 0
    received_boxes: int = 0
    last_raw: RawTimes | None = None
    latest: deque[LidarFrame] = field(default_factory=lambda: deque(maxlen=_MOST_SWEEPS))

    def remember(self, frame: LidarFrame) -> None:
        """Keep a sweep for the boxes that will come of it, if any have come so far."""
        if self.received_boxes:
            self.latest.append(frame)

    def sweep_at(self, time_ns: int) -> LidarFrame | None:
        """The sweep that is kept of a time [ns], within half a period; None where there is none."""
        near = [(abs(frame.reference_ns - time_ns), -k, frame) for k, frame in enumerate(self.latest)]
        if not near:
            return None
        away_ns, _, frame = min(near, key=lambda one: one[:2])
        return frame if away_ns <= self.period_ns // 2 else None

    def timed(self, frame: LidarFrame) -> tuple[LidarFrame, TimesFound]:
        """Bring the times of the points onto the scene's clock, and state what they were."""
        timed = timed_frame(frame, self.period_ns, previous=self.last_raw)
        self.last_raw = timed.raw
        return timed.frame, timed.found


@dataclass(slots=True)
class KnownCamera:
    """A camera.

    Attributes:
        id: the camera.
        index: what its points bear as `camera_index`.
        source: `world_from_camera`.
        shutter: when the lines of its images are taken.
    """

    id: Identifier
    index: int
    source: PoseSource
    shutter: Shutter = GLOBAL


STILL = Poses.identity()


def stationary(source: PoseSource | None) -> PoseSource | None:
    """The same sensor on an ego that does not move."""
    return None if source is None else replace(source, path=STILL)


_DEFAULTS = FusionConfiguration()

_LONGEST_LAG_NS = 10_000_000_000
"""Sweeps that come, or are timestamped, later than so long after their points were measured are not paired any more."""


class _TimedFrame(Protocol):
    """A sweep, or the boxes that a detector saw in it."""

    @property
    def timestamp_ns(self) -> int:
        """When it was [ns]."""
        ...


class Timed(Protocol):
    """Something of one time: an image, or the boxes that a detector saw in it."""

    @property
    def timestamp_ns(self) -> int:
        """When it was [ns]."""
        ...

    @property
    def extras(self) -> Mapping[str, Any]:
        """Further fields, by name."""
        ...


_Frame = TypeVar("_Frame", bound=_TimedFrame)  # of a lidar: a sweep, or the boxes in it

_Partner = TypeVar("_Partner", bound=Timed)  # of a camera: an image, or the boxes in it


class Leave(StrEnum):
    """Why something is not kept any more."""

    DONE = ""
    """Nothing can need it."""
    DROPPED = "dropped.waiting"
    """It had to make room for others."""


OnLeft = Callable[[Mapping[str, Any], Leave], None]
"""Reported the further fields of what is not kept any more, and why."""


def nobody(extras: Mapping[str, Any], leave: Leave) -> None:
    """Listen to nothing."""
    del extras, leave


@dataclass(slots=True)
class TimedQueue(Generic[_Partner]):
    """What one camera has sent and a sweep may still ask for, in time order.

    Attributes:
        camera_id: the camera.
        most: how many are kept, the oldest are dropped; None for as many as come.
        items: what is kept.
        on_left: called with what is not kept any more.
    """

    camera_id: Identifier
    most: int | None = None
    items: deque[_Partner] = field(default_factory=deque)
    on_left: OnLeft = nobody

    def add(self, item: _Partner) -> int:
        """Keep one; one that comes late takes its location in time. Gives how many were dropped to make room."""
        late: list[_Partner] = []
        while self.items and self.items[-1].timestamp_ns > item.timestamp_ns:
            late.append(self.items.pop())
        self.items.append(item)
        self.items.extend(reversed(late))
        dropped = 0 if self.most is None else max(len(self.items) - self.most, 0)
        for _ in range(dropped):
            self.on_left(self.items.popleft().extras, Leave.DROPPED)
        return dropped

    def reaches(self, time_ns: int) -> bool:
        """Whether one at or after that time has come, so that the nearest one is known."""
        return bool(self.items) and self.items[-1].timestamp_ns >= time_ns

    def nearest(self, time_ns: int, tolerance_ns: int) -> _Partner | None:
        """The one nearest in time, the earlier one of two equally near, None beyond the tolerance."""
        near = min(self.items, key=lambda item: abs(item.timestamp_ns - time_ns), default=None)
        return None if near is None or abs(near.timestamp_ns - time_ns) > tolerance_ns else near

    def forget_before(self, time_ns: int) -> None:
        """Let go of what no sweep from that time on can be nearest to."""
        while len(self.items) > 1 and self.items[1].timestamp_ns <= time_ns:
            self.on_left(self.items.popleft().extras, Leave.DONE)

    def forget_after(self, time_ns: int) -> None:
        """Let go of what is later than a time."""
        while self.items and self.items[-1].timestamp_ns > time_ns:
            self.on_left(self.items.pop().extras, Leave.DONE)


@dataclass(frozen=True, slots=True)
class Waiting(Generic[_Frame]):
    """A sweep that waits for images.

    Attributes:
        lidar_id: its lidar.
        index: its number in the lidar.
        frame: the sweep.
        reference_ns: the time that it is paired by [ns].
        tolerance_ns: how far an image may be from it [ns].
        algorithm: how it is to be fused.
        configuration: the settings in force when it came.
        extras: further fields, by name.
    """

    lidar_id: Identifier
    index: int
    frame: _Frame
    reference_ns: int
    tolerance_ns: int
    algorithm: Any = None
    configuration: FusionConfiguration = _DEFAULTS
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)


@dataclass(slots=True)
class Pairing(Generic[_Frame, _Partner]):
    """Sweeps in the order in which they came, and the images that they may be paired with.

    A sweep is ready as soon as every camera has sent an image at or after its reference time, and where images may
    come out of order one so near that no other is nearer; or when so much time has passed that none can come any more.

    Attributes:
        lateness_ns: how much later than its time an image may arrive and still be waited for.
        most_waiting: sweeps that may wait; None for as many as come.
        queues: the images of each camera.
        waiting: the sweeps, oldest first.
        on_left: called with what is not kept any more, but for sweeps that became ready.
    """

    lateness_ns: int = 0
    most_waiting: int | None = None
    queues: dict[Identifier, TimedQueue[_Partner]] = field(default_factory=dict)
    waiting: deque[Waiting[_Frame]] = field(default_factory=deque)
    on_left: OnLeft = nobody
    _lags_ns: dict[Identifier, int] = field(default_factory=dict)
    _retiring: dict[Identifier, Waiting[_Frame]] = field(default_factory=dict)
    _latest_ns: int | None = None

    def configure(self, lateness_ns: int, most: int | None) -> None:
        """Wait so long, and keep so many sweeps and images of each camera, from now on."""
        self.lateness_ns, self.most_waiting = lateness_ns, most
        for queue in self.queues.values():
            queue.most = most

    def add_camera(self, camera_id: Identifier, *, most: int | None = None) -> None:
        """Make a camera known; `most` of its images are kept."""
        self.queues[camera_id] = TimedQueue(camera_id, most, on_left=self.on_left)

    def expect(self, camera_ids: Collection[Identifier]) -> None:
        """Wait for these cameras alone from now on; sweeps that wait can have what the others have sent."""
        for camera_id in camera_ids:
            self._retiring.pop(camera_id, None)
            if camera_id not in self.queues:
                self.add_camera(camera_id, most=self.most_waiting)
        for camera_id in [known for known in self.queues if known not in camera_ids]:
            if self.waiting:
                self._retiring.setdefault(camera_id, self.waiting[-1])
            else:
                self._let_go(self.queues.pop(camera_id))

    def add_frame(self, waiting: Waiting[_Frame]) -> int:
        """Let a sweep wait; gives how many were dropped to make room."""
        timestamp_ns = waiting.frame.timestamp_ns
        self.waiting.append(waiting)
        self._lags_ns[waiting.lidar_id] = min(max(timestamp_ns - waiting.reference_ns, 0), _LONGEST_LAG_NS)
        self._latest_ns = max(timestamp_ns, timestamp_ns if self._latest_ns is None else self._latest_ns)
        dropped = 0 if self.most_waiting is None else max(len(self.waiting) - self.most_waiting, 0)
        for _ in range(dropped):
            oldest = self.waiting.popleft()
            self.on_left(oldest.extras, Leave.DROPPED)
            self._retire_after(oldest)
        return dropped

    def add_partner(self, camera_id: Identifier, partner: _Partner) -> int:
        """Keep an image; gives how many were dropped to make room."""
        time_ns = partner.timestamp_ns
        self._latest_ns = max(time_ns, time_ns if self._latest_ns is None else self._latest_ns)
        return self.queues[camera_id].add(partner)

    def ready(self, *, final: bool = False) -> Iterator[Waiting[_Frame]]:
        """Yield the sweeps whose images are known, oldest first; with `final` all that wait.

        What no later sweep can ask for is forgotten once the one after is asked for.
        """
        while self.waiting and (final or self._is_ready(self.waiting[0])):
            waiting = self.waiting.popleft()
            yield waiting
            self._retire_after(waiting)
            # a later one can refer to any time from this timestamp on, less the lag and what sweeps may be out of order
            lag_ns = max(self._lags_ns.values(), default=0) + waiting.configuration.disorder_ns
            for queue in self.queues.values():
                queue.forget_before(waiting.frame.timestamp_ns - lag_ns)
        if not self.waiting and self._latest_ns is not None:
            for queue in self.queues.values():
                queue.forget_before(self._latest_ns - _LONGEST_LAG_NS)

    def restart(self, time_ns: int) -> None:
        """Begin anew at a time, because clocks were set back; what is far later belongs to the time before."""
        for queue in self.queues.values():
            queue.forget_after(time_ns + _LONGEST_LAG_NS)
        kept = [queue.items[-1].timestamp_ns for queue in self.queues.values() if queue.items]
        self._latest_ns = max(kept, default=None)
        self._lags_ns.clear()

    def end(self) -> None:
        """Let go of all images."""
        for queue in self.queues.values():
            self._let_go(queue)

    def partner(self, waiting: Waiting[_Frame], camera_id: Identifier) -> _Partner | None:
        """A camera's image for a sweep; None where none is near enough."""
        queue = self.queues.get(camera_id)
        return None if queue is None else queue.nearest(waiting.reference_ns, waiting.tolerance_ns)

    def _retire_after(self, waiting: Waiting[_Frame]) -> None:
        """Forget the cameras that a sweep was the last one to know."""
        for camera_id in [known for known, last in self._retiring.items() if last is waiting]:
            del self._retiring[camera_id]
            self._let_go(self.queues.pop(camera_id))

    def _let_go(self, queue: TimedQueue[_Partner]) -> None:
        while queue.items:
            self.on_left(queue.items.popleft().extras, Leave.DONE)

    def _is_ready(self, waiting: Waiting[_Frame]) -> bool:
        time_ns, period_ns = waiting.reference_ns, waiting.configuration.image_period_ns
        expected = [queue for camera_id, queue in self.queues.items() if camera_id not in self._retiring]
        if all(
            queue.reaches(time_ns) and (period_ns is None or queue.nearest(time_ns, period_ns // 2) is not None)
            for queue in expected
        ):
            return True
        latest = time_ns if self._latest_ns is None else self._latest_ns
        return latest > time_ns + waiting.tolerance_ns + self.lateness_ns
