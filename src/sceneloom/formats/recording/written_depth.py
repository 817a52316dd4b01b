"""The images of a depth camera for a lossless video: 16-bit steps, and the length of a step in every line."""

from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import Float32Array, UInt8Array, UInt16Array, check_array
from sceneloom.errors import OptionError
from sceneloom.formats.loss import Loss
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.shooting import Shot

DEPTH_STEPS = (0.001, 0.002, 0.005, 0.01)
"""Lengths of a step that are tried, the smallest first, where the source has no steps [m]."""
COLOR_FORMAT = "gray16"
"""What the vendor's software calls images of 16-bit steps."""

_LARGEST = 65535
_OFF_STEP = 0.01
"""Share of a step that a depth may be off and still be one: float32 holds 65535 steps to 0.004 of one."""


class SteppedDepth(NamedTuple):
    """A depth image in steps.

    Attributes:
        steps: (H, W) uint16, 0 for none.
        rounded: how many depths lie between steps.
        beyond: how many are more than 16 bits hold, or no number; they are 0.
    """

    steps: UInt16Array
    rounded: int
    beyond: int


def to_steps(depth: Float32Array, scale: float) -> SteppedDepth:
    """Round depths to steps; one too small for the first step becomes one step.

    Args:
        depth: (H, W) float32 [m], 0 for none.
        scale: length of a step [m].
    """
    exact = depth.astype(np.float64) / scale
    whole = np.rint(exact)
    whole[(exact > 0) & (whole == 0)] = 1
    holdable = (whole >= 0) & (whole <= _LARGEST)
    exact, whole = np.where(holdable, exact, 0.0), np.where(holdable, whole, 0.0)
    rounded = int(np.count_nonzero(np.abs(exact - whole) > _OFF_STEP))
    return SteppedDepth(whole.astype(np.uint16), rounded, int((~holdable).sum()))


def common_scale(sensor: DepthCameraSensor) -> float:
    """Find the length of a step for images that have none: the smallest one that holds the largest depth [m].

    Each image is decoded and let go.
    """
    largest = 0.0
    for frame in sensor.frames:
        if frame.scale is None:
            depth = frame.depth
            largest = max(largest, float(depth[np.isfinite(depth)].max(initial=0.0)))
    return next((scale for scale in DEPTH_STEPS if round(largest / scale) <= _LARGEST), DEPTH_STEPS[-1])


class DepthImages:
    """The images of a depth camera as 16-bit steps, and what is lost by that."""

    codec = "ffv1-gray16"

    def __init__(self, sensor: DepthCameraSensor) -> None:
        """Begin; no image is read."""
        self.width, self.height = sensor.camera.width, sensor.camera.height
        self.blank: UInt8Array | UInt16Array = np.zeros((self.height, self.width), np.uint16)
        self.losses: list[Loss] = []
        self._scales = DepthScales(sensor)
        self._field = f"sensors[{sensor.id}].frames[].depth"

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Name the kind of image, and the length of its steps."""
        return self._scales.fields(shot)

    def image(self, shot: Shot) -> UInt16Array | None:
        """Give an image in steps, (H, W) uint16; None of what is no depth image.

        Raises:
            OptionError: a step of the source has no length.
        """
        if not isinstance(shot, DepthFrame):
            return None
        depth, scale = shot.depth, self._scales.of(shot)
        check_array("depth", depth, (self.height, self.width), np.float32)
        found = to_steps(depth, scale)
        self._lose(f"rounded to steps of {scale:g} m", found.rounded)
        self._lose(f"left out: no number, negative, or beyond {_LARGEST * scale:g} m", found.beyond)
        return found.steps

    def _lose(self, what: str, count: int) -> None:
        if count:
            self.losses.append(Loss(field=self._field, what=what, count=count))


class DepthScales:
    """The length of a step of each image of a camera: its own, else one that suits them all."""

    def __init__(self, sensor: DepthCameraSensor) -> None:
        """Begin; images are looked through when the first asks that has no step of its own."""
        self._sensor = sensor
        self._common: float | None = None

    def of(self, frame: DepthFrame) -> float:
        """Give the length of an image's steps [m].

        Raises:
            OptionError: it is no length.
        """
        if frame.scale is None:
            if self._common is None:
                self._common = common_scale(self._sensor)
            return self._common
        if not 0 < frame.scale < np.inf:
            location = f"depth camera {self._sensor.id!r}: image at {frame.timestamp_ns} ns"
            raise OptionError(f"{location}: scale {frame.scale}; expected a length in metres")
        return frame.scale

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Name the kind of image, and the length of its steps."""
        if not isinstance(shot, DepthFrame):
            return {}
        return {"colorFormat": shot.extras.get("colorFormat", COLOR_FORMAT), "depthScale": self.of(shot)}
