"""Simulated rotating and solid-state lidars, and radar.

`LidarSpec` rotates about its axis, `SolidStateSpec` looks one way.

`lengths` of a return is the rate at which its range grows, along `directions`, which point from the radar to the
target in the radar's frame: positive where the target recedes, and -v for a stationary thing straight ahead of a radar
that drives at v. With the radar's own velocity `v_radar` (lever arm included) in the radar's frame, the speed over
ground along the same line is `lengths + directions · v_radar`; the sensor does not report it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, UInt8Array, UInt16Array, read_only
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame, RadarPoints
from sceneloom.simulate.casting import (
    GROUND_INSTANCE,
    SKY_INSTANCE,
    Hits,
    Paint,
    Rays,
    bundles_by_direction,
    cast,
    instances_of,
    paint,
    silhouettes,
)
from sceneloom.simulate.parameters import Stream, check_bounds, generator_for
from sceneloom.simulate.street import GRAIN, Street
from sceneloom.simulate.trajectory import EgoPath, sensor_mount

_BUNDLE_COLUMNS, _BUNDLE_BEAMS = 16, 8
"""Shots that are culled together: about as wide as high at the default resolution."""

_DEFAULT_MOUNT = sensor_mount(position=(0.25, 0.02, 1.78), yaw_deg=0.8, pitch_deg=-0.5, roll_deg=0.3)
"""`ego_from_lidar` on the roof, a little off square, so that no one can take it for the identity."""


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """All shots of one frame, in the order of their time.

    Attributes:
        rays: their directions in the lidar's frame; shot k answers in slot k; the pose of a ray is its moment.
        offsets_ns: (M,) int64 [ns], the moments at which the lidar shoots, after the start of the frame.
        moments: (S,) int64, which of `offsets_ns` each shot is fired at.
        rings: (S,) uint16, the row of each shot from the lowest, or None where the pattern has no rows.
    """

    rays: Rays
    offsets_ns: Int64Array
    moments: Int64Array
    rings: UInt16Array | None


_PlannedShots = Callable[[int], Shots]  # makes the shots of a frame that starts so many ns after the first


def _same(shots: Shots, _: int) -> Shots:
    return shots


def directions_at(azimuths: Float64Array, elevations: Float64Array) -> Float64Array:
    """Unit vectors (N, 3) at angles [rad], counter-clockwise from x and upwards."""
    flat = np.cos(elevations)
    return np.column_stack([flat * np.cos(azimuths), flat * np.sin(azimuths), np.sin(elevations)])


@dataclass(frozen=True, slots=True, eq=False)
class LidarSpec:
    """A lidar that rotates about its z axis.

    Attributes:
        beams: number of lasers; ring 0 is the lowest.
        elevations_deg: elevation of the lowest and of the highest laser, between which the others lie evenly; or that
            of each, rising.
        steps: shots of each laser in a rotation; `beams * steps` shots make a sweep.
        period_ns: time of a rotation [ns].
        offset_ns: how much later than the drive the first rotation starts [ns].
        clockwise: the direction in which it rotates, seen from above.
        start_azimuth_deg: where a rotation begins, counter-clockwise from the sensor's x axis; 180 looks back, so the
            sensor looks ahead in the middle of a sweep.
        range_sigma: standard deviation of the measured range [m].
        drop_rate: share of returns that are lost at random.
        min_range, max_range: no returns nearer or farther [m].
        mount: `ego_from_lidar`.

    Raises:
        OptionError: a number is out of bounds.
    """

    beams: int = 64
    elevations_deg: tuple[float, ...] = (-24.8, 2.0)
    steps: int = 1800
    period_ns: int = 100_000_000
    clockwise: bool = True
    start_azimuth_deg: float = 180.0
    range_sigma: float = 0.02
    drop_rate: float = 0.01
    min_range: float = 0.9
    max_range: float = 120.0
    mount: RigidTransform = _DEFAULT_MOUNT
    offset_ns: int = 0

    def __post_init__(self) -> None:
        _check_scan(self)
        check_bounds("lidar", self, beams=(1, 65535), steps=(1, self.period_ns), start_azimuth_deg=(-360.0, 360.0))
        # ring 0 is the lowest
        rising = tuple((least, 90.0) for least in (-90.0, *self.elevations_deg[:-1]))
        check_bounds("lidar", self, elevations_deg=rising)
        if (count := len(self.elevations_deg)) not in {2, self.beams}:
            raise OptionError(f"lidar.elevations_deg: {count} angles; expected 2, or {self.beams} for as many beams")

    def plan_shots(self) -> _PlannedShots:
        """Give the shots, which are the same in each rotation."""
        offsets = np.arange(self.steps, dtype=np.int64) * self.period_ns // self.steps
        column, beam = (grid.ravel() for grid in np.mgrid[: self.steps, : self.beams])
        return partial(_same, Shots(_rays(self, column, beam), offsets, column, beam.astype(np.uint16)))


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Everything about one sweep; the arrays hold its returns in the order of their time.

    Attributes:
        frame: what the sensor reports.
        ranges: (N,) float64 [m], without noise.
        directions: (N, 3) float64, unit, lidar frame.
        origins_world: (N, 3) float64 [m], where the lidar was.
        points_world: (N, 3) float64 [m], where the shots ended, without noise.
        instances: (N,) int32, what they hit.
        colors: (N, 3) uint8, its colour there.
        velocities: (N, 3) float64 [m/s], world frame, how it moves there.
    """

    frame: LidarFrame
    ranges: Float64Array
    directions: Float64Array
    origins_world: Float64Array
    points_world: Float64Array
    instances: AnyArray
    colors: UInt8Array
    velocities: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class ScanningLidar:
    """A lidar on its way through a street.

    Attributes:
        spec: the device.
        street, path: what it meets and how it moves.
        seed: of the drive.
        number: which of the drive's lidars it is.
        timestamps_ns: (F,) int64 [ns], start of each sweep.
    """

    spec: "ScanSpec"
    street: Street
    path: EgoPath
    seed: int
    number: int
    timestamps_ns: Int64Array
    _planned: _PlannedShots = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_planned", self.spec.plan_shots())

    def frame(self, k: int) -> LidarFrame:
        """What the sensor reports of sweep k."""
        return self.sweep(k).frame

    def shots(self, k: int) -> Shots:
        """Where and when sweep k shoots."""
        return self._planned(int(self.timestamps_ns[k] - self.timestamps_ns[0]))

    def sweep(self, k: int) -> Sweep:
        """Make sweep k with its truth; the same every time."""
        shots = self.shots(k)
        times_ns = self.timestamps_ns[k] + shots.offsets_ns
        rotations, origins = self.path.mounted(times_ns, self.spec.mount)
        hits = cast(self.street, shots.rays, rotations, origins, times_ns, reach=self.spec.max_range)
        look = paint(self.street, shots.rays, rotations, origins, hits)
        noise, kept = self._noise(k, hits)
        moments = shots.moments[kept]
        ranges, directions = hits.ranges[kept], shots.rays.spread()[kept]
        in_world = np.einsum("nij,nj->ni", rotations[moments], directions)
        positions = directions * np.maximum(0.0, ranges + noise[kept])[:, None]
        ends = origins[moments] + ranges[:, None] * in_world
        points = LidarPoints(
            read_only(positions, np.float32),
            intensities=read_only(_intensities(self.street, hits, look)[kept]),
            timestamps_ns=read_only(times_ns[moments]),
            rings=None if shots.rings is None else read_only(shots.rings[kept]),
        )
        return Sweep(
            LidarFrame(int(self.timestamps_ns[k]), points),
            ranges,
            directions,
            origins[moments],
            ends,
            instances_of(self.street, hits)[kept],
            look.colors[kept],
            _velocities_of(self.street, hits.shapes[kept], ends, times_ns[moments]),
        )

    def silhouettes(self, k: int) -> Int64Array:
        """Count the shots of sweep k that each object would meet if it were alone, by instance number - 1."""
        shots = self.shots(k)
        times_ns = self.timestamps_ns[k] + shots.offsets_ns
        poses = self.path.mounted(times_ns, self.spec.mount)
        return silhouettes(self.street, shots.rays, *poses, times_ns, reach=self.spec.max_range)

    def _noise(self, k: int, hits: Hits) -> tuple[Float64Array, Int64Array]:
        """Range errors (S,) [m] and the slots of the returns that arrive."""
        generator = generator_for(self.seed, Stream.LIDAR, k, sensor=self.number)
        noise = self.spec.range_sigma * generator.standard_normal(len(hits.ranges), dtype=np.float32)
        lost = generator.random(len(hits.ranges), dtype=np.float32) < self.spec.drop_rate
        kept = np.flatnonzero((hits.ranges >= self.spec.min_range) & ~lost)
        return noise.astype(np.float64), kept


def _rays(spec: LidarSpec, column: Int64Array, beam: Int64Array) -> Rays:
    """Directions of all shots, ordered by column, then by ring; each column has a pose of its own."""
    low, *_, high = spec.elevations_deg
    evenly = np.linspace(low, high, spec.beams)
    elevations = np.radians(spec.elevations_deg if len(spec.elevations_deg) == spec.beams else evenly)
    rotation = (-2.0 if spec.clockwise else 2.0) * np.pi / spec.steps
    azimuths = np.radians(spec.start_azimuth_deg) + rotation * np.arange(spec.steps)
    directions = directions_at(azimuths[column], elevations[beam])
    bundle = column // _BUNDLE_COLUMNS * spec.beams + beam // _BUNDLE_BEAMS
    return Rays.bundled(directions, bundle, pose_of_ray=column)


def _velocities_of(street: Street, shapes: AnyArray, points_world: Float64Array, times_ns: Int64Array) -> Float64Array:
    """Give the velocity of what was hit, (N,) shapes as of `Hits`, at points (N, 3) and times (N,), (N, 3) [m/s]."""
    velocities = np.zeros((len(shapes), 3))
    moving, first = np.flatnonzero(shapes >= len(street.shapes)), len(street.shapes)
    if len(moving):
        own = shapes[moving] - first
        velocities[moving] = street.movers.point_velocities(own, points_world[moving], times_ns[moving])
    return velocities


def reflectivities_of(street: Street, hits: Hits) -> Float64Array:
    """Give the reflectivity of each hit's material, (S,) float64, 0 for the sky."""
    values: Float64Array = np.append(street.bodies.reflectivities, [0.0, GRAIN])[hits.shapes]
    return values


def _intensities(street: Street, hits: Hits, look: Paint) -> UInt8Array:
    """Strength of each return: the material, how light its surface is, and the angle at which it is met."""
    lightness = look.colors.astype(np.float32).mean(axis=1) / 255.0
    strength = reflectivities_of(street, hits) * (0.25 + 0.75 * lightness) * np.sqrt(look.facings)
    levels: UInt8Array = np.rint(255.0 * np.minimum(1.0, strength)).astype(np.uint8)
    return levels


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
        counts = {"rows": (1, 65535), "columns": (1, 65535), "channels": (1, 64), "interleave": (1, 65535)}
        check_bounds("raster", self, **counts)
        _check_fans("raster", self, azimuth_deg=180.0, elevation_deg=90.0)

    def plan_shots(self, period_ns: int) -> _PlannedShots:
        """Give the shots, which are the same in each frame."""
        # the row, from the lowest, and the column in its channel, from the left, that each moment looks at
        from_top = np.concatenate([np.arange(first, self.rows, self.interleave) for first in range(self.interleave)])
        sweep = np.arange(self.columns)
        column = np.where(np.arange(self.rows)[:, None] % 2 == 0, sweep, sweep[::-1]).ravel()
        row = np.repeat(self.rows - 1 - from_top, self.columns).astype(np.int64)
        # the azimuth of each column of all channels, from the left: the middles of equal cells
        (right, left), count = np.radians(self.azimuth_deg), self.columns * self.channels
        azimuths = left - (left - right) * (np.arange(count) + 0.5) / count
        elevations = np.radians(np.linspace(*self.elevation_deg, self.rows))
        moments = np.repeat(np.arange(len(row), dtype=np.int64), self.channels)
        rows = row[moments]
        across = column[moments] + self.columns * np.tile(np.arange(self.channels), len(row))
        directions = directions_at(azimuths[across], elevations[rows])
        rays = Rays.bundled(directions, bundles_by_direction(directions), pose_of_ray=moments)
        offsets = np.arange(len(row), dtype=np.int64) * period_ns // len(row)
        return partial(_same, Shots(rays, offsets, moments, rows.astype(np.uint16)))


@dataclass(frozen=True, slots=True)
class Rosette:
    """One beam, bent by two prisms that rotate at rates without a common measure: the pattern never repeats.

    Each prism bends the beam by a fixed angle towards where its thick side is; the bends add up as vectors. As the
    prisms turn on from frame to frame, other places are hit in each, and the gaps close over time.

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
        check_bounds("rosette", self, fov_deg=(0.01, 170.0), shots_per_second=(1.0, 1e7), share=(0.0, 1.0))
        check_bounds("rosette", self, rotations_per_minute=(-1e6, 1e6))

    def plan_shots(self, period_ns: int) -> _PlannedShots:
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
        _check_scan(self)

    def plan_shots(self) -> _PlannedShots:
        """Give the function that makes the shots of a frame that starts so many ns after the first."""
        return self.pattern.plan_shots(self.period_ns)


ScanSpec = LidarSpec | SolidStateSpec
"""A lidar."""


def _check_scan(spec: ScanSpec) -> None:
    """Check the fields that every lidar has."""
    check_bounds(
        "lidar",
        spec,
        period_ns=(1, 10**12),
        offset_ns=(0, spec.period_ns - 1),
        range_sigma=(0.0, 10.0),
        drop_rate=(0.0, 1.0),
        min_range=(0.0, spec.max_range),
        max_range=(spec.min_range, 1e4),
    )


FALSE_ALARM = SKY_INSTANCE
"""The instance of returns that come from nothing."""

_STEP_DEG = 0.3
"""Distance of the rays by which a radar looks for what is there: the narrow end of a car 50 m away meets 6 across."""

_FASTEST = 40.0  # greatest radial speed of a false alarm [m/s]


@dataclass(frozen=True, slots=True, eq=False)
class RadarSpec:
    """A radar that looks along its x axis and measures everything at one moment.

    Attributes:
        mount: `ego_from_radar`.
        azimuth_deg, elevation_deg: the field of view: from right to left, from below to above.
        period_ns: time between two measurements [ns].
        offset_ns: how much later than the drive the first one is [ns].
        range_sigma, speed_sigma: standard deviations [m], [m/s].
        azimuth_sigma_deg, elevation_sigma_deg: standard deviations of the angles.
        detections_per_object: mean number of returns from each thing in view; no thing gives more than rays meet it.
        ground_clutter: mean number of returns from the ground.
        false_alarms: mean number of returns from nothing.
        min_range, max_range: no returns nearer or farther [m].

    Raises:
        OptionError: a number is out of bounds.
    """

    mount: RigidTransform = field(
        default_factory=lambda: sensor_mount(position=(2.1, 0.05, 0.6), yaw_deg=0.5, pitch_deg=-0.3)
    )
    azimuth_deg: tuple[float, float] = (-60.0, 60.0)
    elevation_deg: tuple[float, float] = (-10.0, 10.0)
    period_ns: int = 50_000_000
    offset_ns: int = 0
    range_sigma: float = 0.12
    azimuth_sigma_deg: float = 0.4
    elevation_sigma_deg: float = 1.0
    speed_sigma: float = 0.08
    detections_per_object: float = 2.5
    ground_clutter: float = 4.0
    false_alarms: float = 1.0
    min_range: float = 0.4
    max_range: float = 150.0

    def __post_init__(self) -> None:
        check_bounds(
            "radar",
            self,
            period_ns=(1_000_000, 10**10),
            offset_ns=(0, self.period_ns - 1),
            range_sigma=(0.0, 10.0),
            azimuth_sigma_deg=(0.0, 30.0),
            elevation_sigma_deg=(0.0, 30.0),
            speed_sigma=(0.0, 10.0),
            detections_per_object=(0.0, 1e4),
            ground_clutter=(0.0, 1e5),
            false_alarms=(0.0, 1e5),
            min_range=(0.0, self.max_range),
            max_range=(self.min_range, 1e4),
        )
        _check_fans("radar", self, azimuth_deg=180.0, elevation_deg=90.0)


@dataclass(frozen=True, slots=True, eq=False)
class RadarTruth:
    """What is behind the returns of one frame, in their order, without noise.

    Returns from nothing (`instances` is `FALSE_ALARM`) have no truth: their numbers are the reported ones, their
    positions lie where they seem to.

    Attributes:
        timestamp_ns: when it was measured [ns].
        ranges: (N,) float64 [m].
        directions: (N, 3) float64, unit, radar frame, from the radar to the target.
        speeds: (N,) float64 [m/s], rate at which the range grows.
        ground_speeds: (N,) float64 [m/s], the part of it that is the target's own motion over ground.
        positions_world: (N, 3) float64 [m], where the returns come from.
        instances: (N,) int32, what they come from; 0 is the ground.
    """

    timestamp_ns: int
    ranges: Float64Array
    directions: Float64Array
    speeds: Float64Array
    ground_speeds: Float64Array
    positions_world: Float64Array
    instances: AnyArray

    @property
    def real(self) -> BoolArray:
        """(N,) bool, which returns come from something."""
        real: BoolArray = self.instances != FALSE_ALARM
        return real


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRadar:
    """A radar on its way through a street.

    Attributes:
        spec: the device.
        street, path: what it meets and how it moves.
        seed: of the drive.
        number: which of the drive's radars it is.
        timestamps_ns: (F,) int64 [ns], time of each measurement.
    """

    spec: RadarSpec
    street: Street
    path: EgoPath
    seed: int
    number: int
    timestamps_ns: Int64Array

    def frame(self, k: int) -> RadarFrame:
        """What the sensor reports of measurement k; the same every time."""
        return self._measure(k)[0]

    def frame_truth(self, k: int) -> RadarTruth:
        """What is behind the returns of measurement k."""
        return self._measure(k)[1]

    def pose(self, k: int) -> RigidTransform:
        """Exact `world_from_radar` at measurement k."""
        rotations, positions = self.path.mounted(self.timestamps_ns[k : k + 1], self.spec.mount)
        return RigidTransform(rotations[0], positions[0])

    def velocity_world(self, k: int) -> Float64Array:
        """Velocity of the radar itself at measurement k, (3,) [m/s]: the ego's, and its rotating times the lever."""
        ego = self.path.at(self.timestamps_ns[k : k + 1])
        lever = np.cross(ego.angular_rates[0], self.spec.mount.translation)
        velocity: Float64Array = ego.velocities[0] + ego.rotations[0] @ lever
        return velocity

    def _measure(self, k: int) -> tuple[RadarFrame, RadarTruth]:
        generator = generator_for(self.seed, Stream.RADAR, k, sensor=self.number)
        truth = self._with_false_alarms(k, self._look(k, generator), generator)
        measured = self._noisy(truth, generator)
        order = np.argsort(measured[:, 0], kind="stable")
        ranges, directions, speeds = measured[order, 0], measured[order, 1:4], measured[order, 4]
        timestamp = truth.timestamp_ns
        points = RadarPoints(
            read_only(directions * ranges[:, None], np.float32),
            directions=read_only(directions, np.float32),
            lengths=read_only(speeds, np.float32),
            timestamps_ns=read_only(np.full(len(order), timestamp, np.int64)),
        )
        columns = (f.name for f in fields(RadarTruth) if f.name != "timestamp_ns")
        return RadarFrame(timestamp, points), replace(truth, **{name: getattr(truth, name)[order] for name in columns})

    def _look(self, k: int, generator: np.random.Generator) -> RadarTruth:
        """Find what gives returns, and how it moves."""
        spec, pose, times_ns = self.spec, self.pose(k), self.timestamps_ns[k : k + 1]
        rays = _fan(spec, generator.uniform(-0.5, 0.5, 2))
        rotations, origins = pose.rotation[None].copy(), pose.translation[None].copy()
        hits = cast(self.street, rays, rotations, origins, times_ns, reach=spec.max_range)
        instances = instances_of(self.street, hits)
        met = np.flatnonzero((hits.ranges >= spec.min_range) & (instances != SKY_INSTANCE))
        chosen = met[_choose(spec, instances[met], generator)]
        ranges, directions = hits.ranges[chosen], rays.spread()[chosen]
        in_world = pose.rotate(directions)
        positions = pose.translation + ranges[:, None] * in_world
        moving = _velocities_of(self.street, hits.shapes[chosen], positions, times_ns.repeat(len(chosen)))
        over_ground = (moving * in_world).sum(axis=1)
        speeds = over_ground - in_world @ self.velocity_world(k)
        return RadarTruth(int(times_ns[0]), ranges, directions, speeds, over_ground, positions, instances[chosen])

    def _with_false_alarms(self, k: int, truth: RadarTruth, generator: np.random.Generator) -> RadarTruth:
        """Add returns from nowhere, anywhere in the field of view, with any speed."""
        spec, count = self.spec, generator.poisson(self.spec.false_alarms)
        azimuths = np.radians(generator.uniform(spec.azimuth_deg[0], spec.azimuth_deg[1], count))
        elevations = np.radians(generator.uniform(spec.elevation_deg[0], spec.elevation_deg[1], count))
        ranges = generator.uniform(spec.min_range, spec.max_range, count)
        speeds = generator.uniform(-_FASTEST, _FASTEST, count)
        directions, pose = directions_at(azimuths, elevations), self.pose(k)
        over_ground = speeds + pose.rotate(directions) @ self.velocity_world(k)
        return RadarTruth(
            truth.timestamp_ns,
            np.concatenate([truth.ranges, ranges]),
            np.concatenate([truth.directions, directions]),
            np.concatenate([truth.speeds, speeds]),
            np.concatenate([truth.ground_speeds, over_ground]),
            np.concatenate([truth.positions_world, pose.apply(directions * ranges[:, None])]),
            np.concatenate([truth.instances, np.full(count, FALSE_ALARM, np.int32)]),
        )

    def _noisy(self, truth: RadarTruth, generator: np.random.Generator) -> Float64Array:
        """Range, direction and speed as measured, (N, 5); false alarms stay what they are."""
        spec = self.spec
        sigmas = [spec.range_sigma, *np.radians([spec.azimuth_sigma_deg, spec.elevation_sigma_deg])]
        errors = generator.standard_normal((len(truth.ranges), 4)) * [*sigmas, spec.speed_sigma]
        errors[~truth.real] = 0.0
        x, y, z = truth.directions.T
        azimuths, elevations = np.arctan2(y, x) + errors[:, 1], np.arcsin(z.clip(-1.0, 1.0)) + errors[:, 2]
        ranges = np.maximum(0.0, truth.ranges + errors[:, 0])
        return np.column_stack([ranges, directions_at(azimuths, elevations), truth.speeds + errors[:, 3]])


def _choose(spec: RadarSpec, instances: AnyArray, generator: np.random.Generator) -> Int64Array:
    """Choose the rays that give a return: a few of those on each thing, whichever."""
    chosen = [np.zeros(0, np.int64)]
    for instance in np.unique(instances).tolist():
        own = np.flatnonzero(instances == instance)
        mean = spec.ground_clutter if instance == GROUND_INSTANCE else spec.detections_per_object
        count = min(len(own), int(generator.poisson(mean)))
        chosen.append(generator.choice(own, count, replace=False))
    return np.concatenate(chosen)


def _fan(spec: RadarSpec, shift: Float64Array) -> Rays:
    """Rays all over the field of view, the whole grid moved by (2,) parts of a step."""
    azimuths, elevations = (
        _cells(fan, part) for fan, part in zip((spec.azimuth_deg, spec.elevation_deg), shift, strict=True)
    )
    across, up = (grid.ravel() for grid in np.meshgrid(azimuths, elevations))
    directions = directions_at(across, up)
    return Rays.bundled(directions, bundles_by_direction(directions))


def _cells(fan_deg: tuple[float, float], shift: float) -> Float64Array:
    """Angles in the middles of equal cells, moved by a part of a cell [rad]."""
    low, high = np.radians(fan_deg)
    count = max(1, round((fan_deg[1] - fan_deg[0]) / _STEP_DEG))
    angles: Float64Array = low + (high - low) * (np.arange(count) + 0.5 + shift) / count
    return angles


def _check_fans(device: str, spec: Any, **limits_deg: float) -> None:
    """Check that ranges of angles are rising and stay within a limit to either side [deg].

    Raises:
        OptionError: one does not.
    """
    for name, limit in limits_deg.items():
        low, high = getattr(spec, name)
        if not -limit <= low < high <= limit:
            raise OptionError(f"{device}.{name}: {(low, high)}; expected two rising angles within {limit} degrees")
