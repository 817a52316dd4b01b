"""A candidate calibration: the stated one, changed by a few numbers."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.frames import CalibrationFrame, moved_by


class Parameter(IntEnum):
    """The numbers of a change, in this order."""

    PITCH = 0
    YAW = 1
    ROLL = 2
    RIGHT = 3
    DOWN = 4
    AHEAD = 5
    FOCAL = 6
    LATER = 7


COUNT = len(Parameter)
ROTATION = (Parameter.PITCH, Parameter.YAW, Parameter.ROLL)
TRANSLATION = (Parameter.RIGHT, Parameter.DOWN, Parameter.AHEAD)

UNITS = np.array([*(np.radians(0.25),) * 3, 0.05, 0.05, 0.05, 0.01, 0.02])
"""What counts as about as much of each: 0.25 degrees, 5 cm, 1 % of the focal length, 20 ms."""


@dataclass(frozen=True, slots=True)
class Change:
    """What a candidate changes of the stated calibration.

    Attributes:
        numbers: eight: a rotation about the camera's x, y and z axes [rad] and a shift along them [m], of the cloud as
            the camera sees it; the logarithm of a factor on the focal lengths; how long after its timestamp an image
            was really taken [s].
    """

    numbers: tuple[float, ...] = (0.0,) * COUNT

    @classmethod
    def of(cls, numbers: Float64Array) -> "Change":
        """Take (8,) numbers."""
        return cls(tuple(float(number) for number in numbers))

    @classmethod
    def rotation(cls, rotation: Float64Array) -> "Change":
        """Rotate the cloud about the camera's axes by a rotation vector, (3,) [rad]."""
        return cls((*(float(number) for number in rotation), *(0.0,) * (COUNT - 3)))

    def camera_from_lidar(self, stated: Float64Array) -> Float64Array:
        """Change a `camera_from_lidar`, (4, 4)."""
        changed: Float64Array = moved_by(np.array(self.numbers[:6])) @ stated
        return changed

    def camera_from_points(self, frame: CalibrationFrame) -> Float64Array:
        """Give what takes the points of a frame into the camera, (4, 4)."""
        changed = self.camera_from_lidar(frame.camera_from_lidar.matrix)
        return frame.camera_from_points(changed, later=self.numbers[Parameter.LATER])

    def camera_model(self, intrinsics_vector: Float64Array) -> Float64Array:
        """Change the numbers of a camera model."""
        scale = np.exp(self.numbers[Parameter.FOCAL])
        if scale == 1.0:
            return intrinsics_vector
        changed = intrinsics_vector.copy()
        changed[:2] *= scale
        return changed
