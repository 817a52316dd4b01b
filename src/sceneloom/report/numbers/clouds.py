"""What lidars and radars measure: points by range, ring, height and direction, over some sweeps of the drive."""

from dataclasses import dataclass, field

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, FloatArray
from sceneloom.scene.clouds import LidarPoints
from sceneloom.scene.types import Identifier

RANGE_EDGES = (0.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 75.0, 100.0, 150.0, 200.0)
"""Borders of the ranges that points are counted by [m]; farther ones are counted by themselves."""
MOST_RINGS = 256
SECTORS = 72
"""Parts of the horizon that are looked at, 5 degrees each."""
_FINE = 360
_STEP, _STEPS = 0.5, 600
_FAR_SHARE = 0.95


class CloudCoverage(msgspec.Struct, frozen=True, kw_only=True):
    """What one lidar or radar measures, on the average of the sweeps that were looked at.

    Attributes:
        sensor, type: the sensor.
        sweeps: how many were looked at, and `of` how many.
        points_mean, points_least, points_most: points of a sweep.
        range_edges: borders of ranges [m].
        range_counts: mean points of a sweep between each two borders, and beyond the last one.
        range_median, range_95, range_max: of all points [m].
        rings: mean points of a sweep by number of the laser; empty where points do not name it.
        lowest_deg, highest_deg: elevation that 98 % of the points lie between [deg], seen level from the sensor.
        sectors: mean points of a sweep in each sector, counter-clockwise from straight ahead.
        reaches: how far 95 % of the points of each sector lie [m]; 0 where there are none.
        horizon_share: of the sectors, those with points.
        non_finite_share: of the points, those that are not finite or at the sensor itself.
        with_times, with_intensities, with_colours: whether points have them.
    """

    sensor: Identifier
    type: str
    sweeps: int
    of: int
    points_mean: float
    points_least: int
    points_most: int
    range_edges: tuple[float, ...] = RANGE_EDGES
    range_counts: tuple[float, ...] = ()
    range_median: float = 0.0
    range_95: float = 0.0
    range_max: float = 0.0
    rings: tuple[float, ...] = ()
    lowest_deg: float = 0.0
    highest_deg: float = 0.0
    sectors: tuple[float, ...] = ()
    reaches: tuple[float, ...] = ()
    horizon_share: float = 0.0
    non_finite_share: float = 0.0
    with_times: bool = False
    with_intensities: bool = False
    with_colours: bool = False


@dataclass(slots=True)
class CloudStatistics:
    """Counts points of one sensor while its sweeps pass, in bounded memory."""

    counts: list[int] = field(default_factory=list)
    nowhere: int = 0
    farthest: float = 0.0
    with_times: bool = False
    with_intensities: bool = False
    with_colours: bool = False
    _ranges: Float64Array = field(default_factory=lambda: np.zeros(len(RANGE_EDGES)))
    _rings: Float64Array = field(default_factory=lambda: np.zeros(MOST_RINGS))
    _by_direction: Float64Array = field(default_factory=lambda: np.zeros((_FINE, _STEPS)))
    _elevations: Float64Array = field(default_factory=lambda: np.zeros(1800))

    def add(self, points_level: FloatArray, points: LidarPoints | None = None) -> None:
        """Count one sweep.

        Args:
            points_level: (N, 3) [m] from the sensor, z up, x ahead.
            points: what else is known of them.
        """
        points_level = points_level.astype(np.float64)  # squares of float32 end at 2e19 m
        ranges = np.linalg.norm(points_level, axis=1)
        known = np.isfinite(ranges) & (ranges > 1e-6)
        self.counts.append(len(ranges))
        self.nowhere += int(len(ranges) - known.sum())
        self._add_known(points_level[known], ranges[known])
        if points is None:
            return
        self.with_times |= points.timestamps_ns is not None
        self.with_intensities |= points.intensities is not None
        self.with_colours |= points.colors is not None
        if points.rings is not None:
            self._rings += np.bincount(np.minimum(points.rings, MOST_RINGS - 1), minlength=MOST_RINGS)

    def _add_known(self, points_level: Float64Array, ranges: Float64Array) -> None:
        if len(ranges) == 0:
            return
        self.farthest = max(self.farthest, float(ranges.max()))
        rows = np.searchsorted(RANGE_EDGES, ranges, side="right") - 1
        self._ranges += np.bincount(rows, minlength=len(RANGE_EDGES))
        degrees = np.degrees(np.arctan2(points_level[:, 1], points_level[:, 0]))
        directions = np.floor(degrees).astype(np.int64) % _FINE
        steps = np.minimum(ranges / _STEP, _STEPS - 1).astype(np.int64)
        flat = np.bincount(directions * _STEPS + steps, minlength=_FINE * _STEPS)
        self._by_direction += flat.reshape(_FINE, _STEPS)
        heights = np.degrees(np.arcsin(np.clip(points_level[:, 2] / ranges, -1.0, 1.0)))
        self._elevations += np.bincount(
            np.clip(((heights + 90.0) * 10.0).astype(np.int64), 0, 1799), minlength=1800
        )

    def coverage(self, sensor: Identifier, kind: str, *, of: int) -> CloudCoverage:
        """Give the averages; `of` so many sweeps in all."""
        sweeps = len(self.counts)
        reported = CloudCoverage(
            sensor=sensor,
            type=kind,
            sweeps=sweeps,
            of=of,
            points_mean=float(np.mean(self.counts)) if sweeps else 0.0,
            points_least=min(self.counts, default=0),
            points_most=max(self.counts, default=0),
            non_finite_share=self.nowhere / max(sum(self.counts), 1),
            with_times=self.with_times,
            with_intensities=self.with_intensities,
            with_colours=self.with_colours,
        )
        if sweeps == 0 or not self._ranges.any():
            return reported
        by_range = self._by_direction.sum(axis=0)
        sectors = self._by_direction.reshape(SECTORS, _FINE // SECTORS, _STEPS).sum(axis=1)
        low, high = (_quantile(self._elevations, share) / 10.0 - 90.0 for share in (0.01, 0.99))
        last_ring = np.flatnonzero(self._rings)
        return msgspec.structs.replace(
            reported,
            range_counts=tuple((self._ranges / sweeps).round(2).tolist()),
            range_median=_STEP * _quantile(by_range, 0.5),
            range_95=_STEP * _quantile(by_range, _FAR_SHARE),
            range_max=self.farthest,
            rings=tuple((self._rings[: last_ring[-1] + 1] / sweeps).round(2).tolist())
            if len(last_ring)
            else (),
            lowest_deg=low,
            highest_deg=high,
            sectors=tuple((sectors.sum(axis=1) / sweeps).round(2).tolist()),
            reaches=tuple(_STEP * _quantile(sector, _FAR_SHARE) for sector in sectors),
            horizon_share=float((sectors.sum(axis=1) > 0).mean()),
        )


def _quantile(counts: Float64Array, share: float) -> float:
    """Where a share of what was counted lies below, in bins, straight within a bin; 0 where nothing was."""
    total = counts.sum()
    if total == 0:
        return 0.0
    sums = np.cumsum(counts)
    k = int(np.searchsorted(sums, share * total))
    before = sums[k - 1] if k else 0.0
    return float(k + (share * total - before) / max(counts[k], 1e-12))
