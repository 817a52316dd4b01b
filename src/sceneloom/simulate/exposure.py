"""Cameras that do not always expose alike: an automatic that wanders, sudden light, dark corners."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, UInt8Array
from sceneloom.errors import OptionError
from sceneloom.simulate.bounds import check_bounds
from sceneloom.simulate.randomness import Stream, generator_for

EXPOSURE_FIELD = "exposureTimeSeconds"
"""The recording format's word for how long an image was exposed [s]."""

_SECOND_WAVE = 0.382
"""The shorter of the two waves of the drift, as a share of `drift_period`: without a common measure with it."""


@dataclass(frozen=True, slots=True)
class ExposureSpec:
    """How the brightness of a camera's images changes. A stop is a factor of two.

    The gain is one number per image and multiplies its 8-bit values, which are then cut off at 255. Nothing is
    blurred, however long the exposure.

    Attributes:
        drift_stops: how far the automatic wanders to either side at most.
        drift_period: time of its slow wave [s].
        steps: sudden changes of the light: when, in seconds after the start of the drive, and by how many stops, such
            as (4.0, 1.5) for the way out of a shadow. The automatic takes each back.
        recovery: time in which it takes back 63 % of a step [s]; infinite: never.
        vignetting: share of the light that the corner farthest from the image's middle lacks; it falls off with the
            square of the distance.
        exposure_ns: how long each image is exposed [ns], as its `exposureTimeSeconds` says; 0: not stated.

    Raises:
        OptionError: a number is out of bounds.
    """

    drift_stops: float = 0.35
    drift_period: float = 7.0
    steps: tuple[tuple[float, float], ...] = ()
    recovery: float = 0.8
    vignetting: float = 0.0
    exposure_ns: int = 8_000_000

    def __post_init__(self) -> None:
        bounds = (
            ("drift_stops", self.drift_stops, 0.0, 8.0),
            ("drift_period", self.drift_period, 0.01, 1e6),
            ("recovery", self.recovery, 1e-6, float("inf")),
            ("vignetting", self.vignetting, 0.0, 1.0),
            ("exposure_ns", self.exposure_ns, 0, 10**9),
            *((f"steps[{k}] stops", stops, -8.0, 8.0) for k, (_, stops) in enumerate(self.steps)),
        )
        check_bounds("exposure", bounds)
        if not all(np.isfinite(seconds) for seconds, _ in self.steps):
            raise OptionError(f"exposure.steps: {self.steps}; expected finite times")


@dataclass(frozen=True, slots=True)
class Exposure:
    """The exposure of one camera on one drive.

    Attributes:
        spec: how it changes.
        start_ns: start of the drive [ns].
        phases: of the two waves of the drift [rad].
    """

    spec: ExposureSpec
    start_ns: int
    phases: tuple[float, float]

    @classmethod
    def of(cls, spec: ExposureSpec, *, start_ns: int, seed: int, camera: int) -> "Exposure":
        """Draw the drift of camera number `camera`."""
        first, second = generator_for(seed, Stream.EXPOSURE, sensor=camera).uniform(0.0, 2.0 * np.pi, 2)
        return cls(spec, start_ns, (float(first), float(second)))

    def gain(self, timestamp_ns: int) -> float:
        """The factor of a image at a time [ns]."""
        seconds, spec = (timestamp_ns - self.start_ns) * 1e-9, self.spec
        rotations = 2.0 * np.pi * seconds / spec.drift_period
        waves = 0.7 * np.sin(rotations + self.phases[0]) + 0.3 * np.sin(
            rotations / _SECOND_WAVE + self.phases[1]
        )
        stops = spec.drift_stops * waves
        for begin, step in spec.steps:
            if seconds >= begin:
                stops += step * np.exp((begin - seconds) / spec.recovery)
        return float(2.0**stops)

    def applied(self, rgb: UInt8Array, timestamp_ns: int) -> UInt8Array:
        """An image (H, W, 3) as the camera gives it at a time [ns], rounded and cut off at 255."""
        factor = self.gain(timestamp_ns) * self._falloff(rgb.shape[0], rgb.shape[1])
        exposed: UInt8Array = np.rint(np.minimum(255.0, rgb * factor[..., None])).astype(np.uint8)
        return exposed

    def _falloff(self, height: int, width: int) -> Float64Array:
        """Share of the light that each pixel gets, (H, W)."""
        v, u = np.mgrid[:height, :width]
        squared = (u - (width - 1) / 2) ** 2 + (v - (height - 1) / 2) ** 2
        share: Float64Array = 1.0 - self.spec.vignetting * squared / max(1.0, float(squared[0, 0]))
        return share
