"""What the fusion system knows of each sensor."""

from collections import deque
from dataclasses import dataclass, field, replace

from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.point_times import RawTimes, TimesFound, timed_frame
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.shutter import GLOBAL, Shutter
from sceneloom.scene.types import Identifier

_MOST_SWEEPS = 3
"""So many sweeps are kept for boxes, which come later."""


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
