"""Colours as Rerun takes them fastest: one number a point, and those of classes and clouds."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from zlib import crc32

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, UInt8Array
from sceneloom.images.annotations.figures import PALETTE
from sceneloom.images.colour_maps import colour_map
from sceneloom.scene.clouds import LidarPoints
from sceneloom.view.settings import ColourBy

Packed = np.ndarray[tuple[int, ...], np.dtype[np.uint32]]
"""Colours 0xRRGGBBAA."""

_UNSEEN = np.uint32(0x6E6E6EFF)
"""Of points that no camera saw."""
_NO_CAMERA = 255
_SPREAD = (1.0, 99.0)
"""Percentiles that the ends of a scale are put at: single bright or high points would leave the others alike."""


def packed(rgb: UInt8Array) -> Packed:
    """Pack (N, 3) uint8 red, green, blue."""
    wide = rgb.astype(np.uint32)
    shifted = (wide[:, 0] << 24) | (wide[:, 1] << 16) | (wide[:, 2] << 8) | np.uint32(255)
    return np.asarray(shifted, np.uint32)


def one_packed(rgb: tuple[int, int, int], *, alpha: int = 255) -> int:
    """Pack one colour."""
    return (rgb[0] << 24) | (rgb[1] << 16) | (rgb[2] << 8) | alpha


def colour_of_name(name: object) -> tuple[int, int, int]:
    """The colour of a class or an object, the same in every drive."""
    return PALETTE[crc32(str(name).encode()) % len(PALETTE)]


def scale_table() -> Packed:
    """The 256 colours of a scale from low (dark) to high (bright), for the dark ground of the viewer."""
    return np.ascontiguousarray(packed(colour_map("lagoon").table)[::-1])


@dataclass(slots=True)
class CloudPainter:
    """Gives the points of one sensor their colours; the ends of its scale are those of the first sweep.

    Attributes:
        wanted: what gives them, or None for the best that there is.
        used: what gave them, known after the first sweep.
    """

    wanted: ColourBy | None
    used: ColourBy | None = None
    _ends: tuple[float, float] | None = None
    _table: Packed = field(default_factory=scale_table)

    def paint(self, points: LidarPoints, heights: Callable[[], FloatArray]) -> Packed:
        """Give (N,) colours; `heights` gives (N,) heights [m] when they are asked for."""
        if self.used is None:
            self.used = self._choose(points)
        if self.used is ColourBy.COLOUR:
            return _own_colours(points)
        reported = _VALUES[self.used](points)
        values = np.asarray(heights() if reported is None else reported, np.float64)
        return self._table[self._steps(values)]

    def _choose(self, points: LidarPoints) -> ColourBy:
        wanted = ColourBy.COLOUR if self.wanted is None else self.wanted
        for trajectory in (wanted, ColourBy.INTENSITY):
            if _is_there(trajectory, points):
                return trajectory
        return ColourBy.HEIGHT

    def _steps(self, values: Float64Array) -> UInt8Array:
        finite = values[np.isfinite(values)]
        if self._ends is None and len(finite):
            low, high = np.percentile(finite, _SPREAD)
            self._ends = float(low), float(max(high, low + 1e-9))
        low, high = self._ends or (0.0, 1.0)
        shares = np.nan_to_num((values - low) / (high - low))
        return np.asarray(np.clip(shares, 0.0, 1.0) * 255, np.uint8)


def _is_there(trajectory: ColourBy, points: LidarPoints) -> bool:
    return trajectory is ColourBy.HEIGHT or getattr(points, _FIELDS[trajectory]) is not None


_FIELDS: Mapping[ColourBy, str] = MappingProxyType(
    {
        ColourBy.COLOUR: "colors",
        ColourBy.INTENSITY: "intensities",
        ColourBy.RING: "rings",
        ColourBy.TIME: "timestamps_ns",
    }
)


def _times(points: LidarPoints) -> Float64Array | None:
    timestamps = points.timestamps_ns
    if timestamps is None or len(timestamps) == 0:
        return np.zeros(len(points))
    since: Float64Array = (timestamps - timestamps.min()).astype(np.float64)
    return since


_VALUES: Mapping[ColourBy, Callable[[LidarPoints], FloatArray | UInt8Array | None]] = MappingProxyType(
    {
        ColourBy.INTENSITY: lambda points: _or_zeros(points.intensities, points),
        ColourBy.HEIGHT: lambda points: None,  # noqa: ARG005 - the caller knows which way is up
        ColourBy.RING: lambda points: _or_zeros(points.rings, points),
        ColourBy.TIME: _times,
    }
)


def _or_zeros(values: np.ndarray | None, points: LidarPoints) -> np.ndarray:
    return np.zeros(len(points)) if values is None else values


def _own_colours(points: LidarPoints) -> Packed:
    if points.colors is None:
        return np.full(len(points), _UNSEEN, np.uint32)
    colours = packed(points.colors)
    if points.camera_index is not None:
        colours[points.camera_index == _NO_CAMERA] = _UNSEEN
    return colours
