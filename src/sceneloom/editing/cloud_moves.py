"""What becomes of the frames of sensors while their points change frames."""

from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.editing.chosen_points import CloudSensor
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.editing.moved_clouds import moved_frames
from sceneloom.editing.record import assumed, skipped
from sceneloom.scene.labelled import Renumbering
from sceneloom.scene.notices import Notice
from sceneloom.scene.types import Key, PointsFrame, key_of


@dataclass(slots=True)
class CloudMoves:
    """What becomes of the frames of a scene's sensors.

    Attributes:
        frames: the numbers of those that stay, by sensor, where some go.
        notices: what is to be told.
    """

    frames: dict[Key, Renumbering] = field(default_factory=dict)
    notices: list[Notice] = field(default_factory=list)

    def cloud(self, sensor: CloudSensor, change: FrameChange | None, frame: PointsFrame) -> CloudSensor:
        """Move the points of a sensor; note the frames that go."""
        if change is None:
            return replace(sensor, points_frame=frame)
        moved, numbers = moved_frames(sensor.frames, change)
        place = f"sensors[{sensor.id}].frames"
        if len(numbers) < len(sensor.frames):
            self.frames[key_of(sensor.id)] = Renumbering(numbers)
            what = "frames at whose time the way of the ego is not known"
            lost = len(sensor.frames) - len(numbers)
            self.notices.append(skipped("frames-beyond-the-way", place, what, count=lost))
        beyond = int(np.count_nonzero(change.at(moved.timestamps_ns).coverage == KNOWN))
        what = "frames beyond the ends of the way, placed as if it went on"
        self.notices.append(assumed("frames-extrapolated", place, what, count=beyond))
        return replace(sensor, frames=moved, points_frame=frame)
