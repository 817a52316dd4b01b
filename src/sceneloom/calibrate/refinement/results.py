"""What refining a calibration comes to."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.calibrate.measures.candidate import Change, Parameter
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform

GROUPS: dict[str, tuple[Parameter, ...]] = {
    "rotation": (Parameter.PITCH, Parameter.YAW, Parameter.ROLL),
    "translation": (Parameter.RIGHT, Parameter.DOWN, Parameter.AHEAD),
    "time": (Parameter.LATER,),
    "focal": (Parameter.FOCAL,),
}
"""What can be refined, by the words of the command line."""


class RefinementVerdict(StrEnum):
    """What became of a calibration."""

    REFINED = "refined"
    KEPT = "kept"
    UNDETERMINED = "cannot determine"


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """What refining came to.

    Attributes:
        verdict: whether the calibration is another one now.
        reason: why.
        camera_from_lidar: the refined one; the stated one unless the verdict is `refined`.
        camera: the camera model with refined focal lengths, or the stated one.
        time_offset: seconds to be added to the camera's timestamps.
        change: what was found, whatever the verdict: rotate and shift about the camera's axes, focal length, time.
        parameters: the groups that were refined.
        held: groups that the drive does not report, and how well it would.
        free: (P,) int64, the numbers of the change that were searched.
        covariance: (P, P) of these, in rad, m, logarithm and s.
        gains: how much likelier the held-out frames of each fold are under what the others found.
        sharpness: how far the solution stands above others around it, in their standard deviations.
        frames: how many were used.
        views: how many of them show something different.
    """

    verdict: RefinementVerdict
    reason: str
    camera_from_lidar: RigidTransform
    camera: Camera
    time_offset: float = 0.0
    change: Change = field(default_factory=Change)
    parameters: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    free: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    covariance: Float64Array = field(default_factory=lambda: np.zeros((0, 0)))
    gains: tuple[float, ...] = ()
    sharpness: float = 0.0
    frames: int = 0
    views: int = 0

    @property
    def sigmas(self) -> dict[str, float]:
        """The standard deviation of each refined number, by its name in lower case: rad, m, logarithm, s."""
        roots = np.sqrt(np.diagonal(self.covariance))
        return {
            Parameter(k).name.lower(): float(root) for k, root in zip(self.free.tolist(), roots, strict=True)
        }

    @property
    def found_change(self) -> dict[str, float]:
        """What was found of each number that was searched, in the same units."""
        return {Parameter(k).name.lower(): self.change.numbers[k] for k in self.free.tolist()}
