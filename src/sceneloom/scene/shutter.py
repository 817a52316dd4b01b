"""When the lines of an image are taken: all at once, or one after the other."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.scene.cameras import CameraSensor

LONGEST_ROLL_S = 1.0
"""What takes longer from an image's first line to its last is no shutter, but another unit [s]."""


@dataclass(frozen=True, slots=True)
class Shutter:
    """How long an image's lines are taken one after the other, and which way.

    Attributes:
        seconds: from the first edge of the image to the last; 0 where all lines are taken at once.
        over_columns: the lines are columns, from the left, instead of rows from the top.
    """

    seconds: float = 0.0
    over_columns: bool = False

    @classmethod
    def of(cls, camera: CameraSensor) -> "Shutter":
        """Take what the calibration says of it: `shutterRollTimeSeconds`, `rollingShutterLeftToRight`."""
        entry = camera.extras.get("calibration")
        if not isinstance(entry, dict):
            return cls()
        seconds = entry.get("shutterRollTimeSeconds")
        if not isinstance(seconds, int | float) or not 0 <= seconds <= LONGEST_ROLL_S:
            return cls()
        return cls(float(seconds), entry.get("rollingShutterLeftToRight") is True)

    def line_count(self, camera: Camera) -> int:
        """How many lines an image has."""
        return camera.width if self.over_columns else camera.height

    def delays(self, lines: FloatArray, camera: Camera) -> Float64Array:
        """When lines are taken after the image's time [s]; those beyond the image's edges as those at the edges.

        Args:
            lines: (N,) rows or columns [px], also between two.

        Source: "One clock" in docs/CONVENTIONS.md: row r of H is taken at t + ((r + 0.5)/H - 0.5) · roll time.
        """
        shares = (np.asarray(lines, np.float64) + 0.5) / self.line_count(camera) - 0.5
        delays: Float64Array = np.clip(shares, -0.5, 0.5) * self.seconds
        return delays

    def knots_ns(self, timestamp_ns: int, count: int) -> Int64Array:
        """Times evenly spread over an image from its first edge to its last, (count,) int64 [ns]."""
        spread = np.linspace(-0.5, 0.5, count) * (self.seconds * 1e9)
        knots: Int64Array = timestamp_ns + np.rint(spread).astype(np.int64)
        return knots


GLOBAL = Shutter()
"""Takes all lines at once."""
