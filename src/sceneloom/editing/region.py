"""A part of space, and which points and annotations lie in it."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, FloatArray, Int64Array
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.errors import OptionError
from sceneloom.scene.clouds import LidarFrame, RadarFrame
from sceneloom.scene.types import PointsFrame


@dataclass(frozen=True, slots=True)
class Region:
    """A box along the axes of a frame, or a ball around its origin, or what is in both.

    Attributes:
        frame: whose axes and origin.
        box: least x, y, z and greatest x, y, z [m], the faces included; None for all of space.
        reach: greatest distance from the origin [m]; None for any.
    """

    frame: PointsFrame
    box: tuple[float, ...] | None = None
    reach: float | None = None

    def __post_init__(self) -> None:
        if self.box is not None:
            fits = len(self.box) == 6 and all(
                low <= high for low, high in zip(self.box[:3], self.box[3:], strict=True)
            )
            if not fits:
                raise OptionError(
                    f"box {self.box}; expected xmin,ymin,zmin,xmax,ymax,zmax, each minimum at most the maximum"
                )
        if self.reach is not None and not self.reach > 0:
            raise OptionError(f"range {self.reach}; expected a positive number of metres")

    def holds(self, points: FloatArray) -> BoolArray:
        """Report which points (..., 3) [m] of the frame lie in it; one that is not finite lies nowhere."""
        inside: BoolArray = np.asarray(np.isfinite(points).all(axis=-1))
        if self.box is not None:
            inside &= (points >= self.box[:3]).all(axis=-1) & (points <= self.box[3:]).all(axis=-1)
        if self.reach is not None:
            inside &= np.einsum("...i,...i->...", points, points) <= self.reach**2
        return inside


Placed = tuple[Region, FrameChange | None]
"""A region, and what takes locations into its frame; None where they are in it."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameChoice:
    """Chooses the points of frames that lie in all of some regions."""

    regions: tuple[Placed, ...]

    def __call__(self, frame: LidarFrame | RadarFrame) -> Int64Array:
        """The rows that stay of a frame, at whose time the changes are known."""
        return np.flatnonzero(held_at(self.regions, frame.timestamp_ns, frame.points.positions))


def held_at(regions: tuple[Placed, ...], timestamp_ns: int, locations: FloatArray) -> BoolArray:
    """Report which locations (N, 3) [m] lie in all regions at a time at which the changes are known."""
    exact = np.asarray(locations, np.float64)
    inside = np.ones(len(exact), np.bool_)
    for region, change in regions:
        inside &= region.holds(exact if change is None else change.transform(timestamp_ns).apply(exact))
    return inside


def ever_held(
    alternatives: tuple[tuple[Placed, ...], ...], times_ns: Int64Array, locations: FloatArray
) -> BoolArray:
    """Report at which times a thing lies in all regions of any alternative.

    Args:
        alternatives: regions around the world, the ego, or one sensor each.
        times_ns: (M,) int64 [ns].
        locations: (M, V, 3) [m], of its V vertices at each time; NaN where it is not there.

    Returns:
        (M,) bool, where any vertex lies inside; not where a change is not known.
    """
    found = np.zeros(len(times_ns), np.bool_)
    for regions in alternatives:
        inside = np.ones(locations.shape[:2], np.bool_)
        for region, change in regions:
            if change is None:
                inside &= region.holds(locations)
            else:
                known = change.at(times_ns).coverage <= KNOWN
                inside &= region.holds(change.locations(times_ns, locations)) & known[:, None]
        found |= inside.any(axis=1)
    return found
