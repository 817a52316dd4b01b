"""Lidars without a rotating head: a small field of view, scanned by a mirror or by two prisms."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate.bounds import check_bounds, check_fan
from sceneloom.simulate.casting import Rays, bundles_by_direction
from sceneloom.simulate.mounts import sensor_mount
from sceneloom.simulate.shots import Shots, directions_at, repeating, scan_bounds


@dataclass(frozen=True, slots=True)
class Raster:
    """Rows swept by a mirror, several channels side by side, every so many rows in one pass from top to bottom.

    The mirror sweeps a row from left to right, the next one back. All channels share it: at one moment each shoots
    at the same location of its own field. Real mirrors swing like a pendulum; this one moves evenly.

    Attributes:
        azimuth_deg: from right to left, counter-clockwise from the sensor's x axis.
        elevation_deg: from the lowest to the highest row.
        rows: number of rows; ring 0 is the lowest.
        columns: shots of one channel in a row.
        channels: fields side by side, each `columns` wide.
        interleave: passes in a frame: the first takes rows 0, n, 2n, … from the top, the next 1, n + 1, ….

    Raises:
        OptionError: a number is out of bounds.

    Source: the defaults are the numbers of a RoboSense M1, which sends 630 packets of 25 moments with 5 channels in a
    frame of 0.1 s: 78,750 shots over 120 x 25 degrees. How it orders its rows is not public; interleaving is ours.
    """

    azimuth_deg: tuple[float, float] = (-60.0, 60.0)
    elevation_deg: tuple[float, float] = (-12.5, 12.5)
    rows: int = 126
    columns: int = 125
    channels: int = 5
    interleave: int = 2

    def __post_init__(self) -> None:
        counts = (
            ("rows", self.rows, 1, 65535),
            ("columns", self.columns, 1, 65535),
            ("channels", self.channels, 1, 64),
            ("interleave", self.interleave, 1, 65535),
        )
        check_bounds("raster", counts)
        check_fan("raster", "azimuth_deg", self.azimuth_deg, 180.0)
        check_fan("raster", "elevation_deg", self.elevation_deg, 90.0)

    def plan_shots(self, period_ns: int) -> Callable[[int], Shots]:
        """Give the shots, which are the same in each frame."""
        row, column = self._locations()
        moments = np.repeat(np.arange(len(row), dtype=np.int64), self.channels)
        rows = row[moments]
        across = column[moments] + self.columns * np.tile(np.arange(self.channels), len(row))
        directions = directions_at(self._azimuths()[across], self._elevations()[rows])
        rays = Rays.bundled(directions, bundles_by_direction(directions), pose_of_ray=moments)
        offsets = np.arange(len(row), dtype=np.int64) * period_ns // len(row)
        return repeating(Shots(rays, offsets, moments, rows.astype(np.uint16)))

    def _locations(self) -> tuple[Int64Array, Int64Array]:
        """The row, from the lowest, and the column in its channel, from the left, that each moment looks at."""
        from_top = np.concatenate(
            [np.arange(first, self.rows, self.interleave) for first in range(self.interleave)]
        )
        sweep = np.arange(self.columns)
        columns = np.where(np.arange(self.rows)[:, None] % 2 == 0, sweep, sweep[::-1])
        return np.repeat(self.rows - 1 - from_top, self.columns).astype(np.int64), columns.ravel()

    def _azimuths(self) -> Float64Array:
        """Azimuth of each column of all channels, from the left [rad]: the middles of equal cells."""
        right, left = np.radians(self.azimuth_deg)
        count = self.columns * self.channels
        azimuths: Float64Array = left - (left - right) * (np.arange(count) + 0.5) / count
        return azimuths

    def _elevations(self) -> Float64Array:
        elevations: Float64Array = np.radians(np.linspace(*self.elevation_deg, self.rows))
        return elevations


@dataclass(frozen=True, slots=True)
class Rosette:
    """One beam, bent by two prisms that rotation at rates without a common measure: the pattern never repeats.

    Each prism bends the beam by a fixed angle towards where its thick side is; the bends add up as vectors. As the
    prisms switch on from frame to frame, other locations are hit in each, and the gaps close over time.

    Attributes:
        fov_deg: angle across the round field of view [deg].
        shots_per_second: constant; a frame has as many as fall into its time.
        rotations_per_minute: of the first and of the second prism; the second counts the other way where negative.
        share: of the first prism in the greatest bend; 0.5 lets the beam pass through the middle.

    Raises:
        OptionError: a number is out of bounds.

    Source: the first-order formula of Risley prisms (Marshall 1999, "Risley prism scan patterns", Proc. SPIE 3787;
    Optical Engineering 50(11) 113002, 2011): the bends of thin prisms add. The defaults are of the size of a Livox
    Mid-40, of which Brazeal, Wilkinson and Hochmair 2021 (Sensors 21, 4722) give the exact optics.
    """

    fov_deg: float = 38.4
    shots_per_second: float = 100_000.0
    rotations_per_minute: tuple[float, float] = (7294.0, -4664.0)
    share: float = 0.5

    def __post_init__(self) -> None:
        check_bounds(
            "rosette",
            (
                ("fov_deg", self.fov_deg, 0.01, 170.0),
                ("shots_per_second", self.shots_per_second, 1.0, 1e7),
                ("rotations_per_minute[0]", self.rotations_per_minute[0], -1e6, 1e6),
                ("rotations_per_minute[1]", self.rotations_per_minute[1], -1e6, 1e6),
                ("share", self.share, 0.0, 1.0),
            ),
        )

    def plan_shots(self, period_ns: int) -> Callable[[int], Shots]:
        """Give the function that makes the shots of a frame that starts so many ns after the first."""
        count = max(1, int(period_ns * self.shots_per_second / 1e9))
        offsets = np.floor(np.arange(count) * (1e9 / self.shots_per_second)).astype(np.int64)
        return partial(self._shots, offsets)

    def _shots(self, offsets_ns: Int64Array, elapsed_ns: int) -> Shots:
        """The shots of a frame that starts so many ns after the first."""
        moments = np.arange(len(offsets_ns), dtype=np.int64)
        directions = self._directions(elapsed_ns + offsets_ns)
        rays = Rays.bundled(directions, bundles_by_direction(directions), pose_of_ray=moments)
        return Shots(rays, offsets_ns, moments, None)

    def _directions(self, elapsed_ns: Int64Array) -> Float64Array:
        """Where the beam points so long after the first frame's start, (N, 3)."""
        half = np.radians(self.fov_deg / 2)
        bends = half * np.array([self.share, 1.0 - self.share])
        rotated = 2 * np.pi / 60e9 * np.array(self.rotations_per_minute) * elapsed_ns[:, None]
        left, up = (np.cos(rotated) * bends).sum(axis=1), (np.sin(rotated) * bends).sum(axis=1)
        off_axis = np.hypot(left, up)
        aside = np.sinc(off_axis / np.pi)
        return np.column_stack([np.cos(off_axis), aside * left, aside * up])


@dataclass(frozen=True, slots=True, eq=False)
class SolidStateSpec:
    """A lidar that looks one way.

    Attributes:
        pattern: how it scans: a `Raster` or a `Rosette`.
        period_ns: time of a frame [ns].
        offset_ns: how much later than the drive the first frame starts [ns].
        range_sigma, drop_rate, min_range, max_range: as in `LidarSpec`.
        mount: `ego_from_lidar`; the lidar looks along its x axis.

    Raises:
        OptionError: a number is out of bounds.
    """

    pattern: Raster | Rosette = field(default_factory=Raster)
    period_ns: int = 100_000_000
    offset_ns: int = 0
    range_sigma: float = 0.03
    drop_rate: float = 0.01
    min_range: float = 0.5
    max_range: float = 150.0
    mount: RigidTransform = field(
        default_factory=lambda: sensor_mount(position=(0.62, -0.03, 1.55), yaw_deg=0.6, pitch_deg=1.4)
    )

    def __post_init__(self) -> None:
        check_bounds("lidar", scan_bounds(self))

    def plan_shots(self) -> Callable[[int], Shots]:
        """Give the function that makes the shots of a frame that starts so many ns after the first."""
        return self.pattern.plan_shots(self.period_ns)
