"""What becomes of the frames of sensors while their points change frames."""

from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.editing.chosen_points import CloudSensor
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.editing.moved_clouds import moved_frames
from sceneloom.editing.record import assumed, skipped
from sceneloom.scene.labelled import Renumbering
from sceneloom.scene.types import Key, PointsFrame, key_of
from sceneloom.scene.warnings import DataWarning


@dataclass(slots=True)
class CloudMoves:
    """What becomes of the frames of a scene's sensors.

    Attributes:
        frames: the numbers of those that stay, by sensor, where some go.
        warnings: what is to be reported.
    """

    frames: dict[Key, Renumbering] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def cloud(self, sensor: CloudSensor, change: FrameChange | None, frame: PointsFrame) -> CloudSensor:
        """Move the points of a sensor; note the frames that go."""
        if change is None:
            return replace(sensor, points_frame=frame)
        moved, numbers = moved_frames(sensor.frames, change)
        location = f"sensors[{sensor.id}].frames"
        if len(numbers) < len(sensor.frames):
            self.frames[key_of(sensor.id)] = Renumbering(numbers)
            what = "frames at whose time the ego trajectory is not known"
            lost = len(sensor.frames) - len(numbers)
            self.warnings.append(skipped("frames-beyond-the-trajectory", location, what, count=lost))
        beyond = int(np.count_nonzero(change.at(moved.timestamps_ns).coverage == KNOWN))
        what = "frames beyond the ends of the trajectory, placed as if it went on"
        self.warnings.append(assumed("frames-extrapolated", location, what, count=beyond))
        return replace(sensor, frames=moved, points_frame=frame)
