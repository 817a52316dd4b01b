"""Which picture belongs to which sweep."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from sceneloom.scene import Identifier, Picture


@dataclass(slots=True)
class PictureQueue:
    """The pictures of one camera that a sweep may still ask for, in time order.

    Attributes:
        camera_id: the camera.
    """

    camera_id: Identifier
    pictures: deque[Picture] = field(default_factory=deque)

    def add(self, picture: Picture) -> None:
        """Keep a picture; one that comes late takes its place in time."""
        late: list[Picture] = []
        while self.pictures and self.pictures[-1].timestamp_ns > picture.timestamp_ns:
            late.append(self.pictures.pop())
        self.pictures.append(picture)
        self.pictures.extend(reversed(late))

    def reaches(self, time_ns: int) -> bool:
        """Whether a picture at or after that time has come, so that the nearest one is known."""
        return bool(self.pictures) and self.pictures[-1].timestamp_ns >= time_ns

    def nearest(self, time_ns: int, tolerance_ns: int) -> Picture | None:
        """The picture nearest in time, the earlier one of two equally near, None beyond the tolerance."""
        near = min(self.pictures, key=lambda picture: abs(picture.timestamp_ns - time_ns), default=None)
        if near is None or abs(near.timestamp_ns - time_ns) > tolerance_ns:
            return None
        return near

    def forget_before(self, time_ns: int) -> None:
        """Let go of pictures that no sweep from that time on can be nearest to."""
        while len(self.pictures) > 1 and self.pictures[1].timestamp_ns <= time_ns:
            self.pictures.popleft()


def all_reach(queues: Iterable[PictureQueue], time_ns: int) -> bool:
    """Whether every camera has sent a picture at or after that time."""
    return all(queue.reaches(time_ns) for queue in queues)
