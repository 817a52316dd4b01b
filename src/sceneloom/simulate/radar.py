"""A radar: few returns, coarse in angle, each with the radial speed of what it met against the radar itself.

`lengths` of a return is the rate at which its range grows, along `directions`, which point from the radar to the
target in the radar's frame: positive where the target recedes, and -v for a stationary thing straight ahead of a radar
that drives at v. With the radar's own velocity `v_radar` (lever arm included) in the radar's frame, the speed over
ground along the same line is `lengths + directions · v_radar`; the sensor does not report it.
"""

from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, read_only
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import RadarFrame, RadarPoints
from sceneloom.simulate.bounds import check_bounds, check_fan
from sceneloom.simulate.casting import (
    GROUND_INSTANCE,
    SKY_INSTANCE,
    Rays,
    bundles_by_direction,
    cast,
    instances_of,
    velocities_of,
)
from sceneloom.simulate.mounts import sensor_mount
from sceneloom.simulate.path import EgoPath
from sceneloom.simulate.randomness import Stream, generator_for
from sceneloom.simulate.shots import directions_at
from sceneloom.simulate.street import Street

FALSE_ALARM = SKY_INSTANCE
"""The instance of returns that come from nothing."""

_STEP_DEG = 0.3
"""Distance of the rays by which a radar looks for what is there: the narrow end of a car 50 m away meets 6 across."""
_FASTEST = 40.0
"""Greatest radial speed of a false alarm [m/s]."""


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
        bounds = (
            ("period_ns", self.period_ns, 1_000_000, 10**10),
            ("offset_ns", self.offset_ns, 0, self.period_ns - 1),
            ("range_sigma", self.range_sigma, 0.0, 10.0),
            ("azimuth_sigma_deg", self.azimuth_sigma_deg, 0.0, 30.0),
            ("elevation_sigma_deg", self.elevation_sigma_deg, 0.0, 30.0),
            ("speed_sigma", self.speed_sigma, 0.0, 10.0),
            ("detections_per_object", self.detections_per_object, 0.0, 1e4),
            ("ground_clutter", self.ground_clutter, 0.0, 1e5),
            ("false_alarms", self.false_alarms, 0.0, 1e5),
            ("min_range", self.min_range, 0.0, self.max_range),
            ("max_range", self.max_range, self.min_range, 1e4),
        )
        check_bounds("radar", bounds)
        check_fan("radar", "azimuth_deg", self.azimuth_deg, 180.0)
        check_fan("radar", "elevation_deg", self.elevation_deg, 90.0)


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
        ego = self.path.at(self.timestamps_ns[k : k + 1])
        return RigidTransform(ego.rotations[0], ego.positions[0]) @ self.spec.mount

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
        return RadarFrame(timestamp, points), _taken(truth, order)

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
        moving = velocities_of(self.street, hits.shapes[chosen], positions, times_ns.repeat(len(chosen)))
        over_ground = (moving * in_world).sum(axis=1)
        speeds = over_ground - in_world @ self.velocity_world(k)
        return RadarTruth(
            int(times_ns[0]), ranges, directions, speeds, over_ground, positions, instances[chosen]
        )

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


def _taken(truth: RadarTruth, order: Int64Array) -> RadarTruth:
    """The same returns in another order."""
    return RadarTruth(
        truth.timestamp_ns,
        truth.ranges[order],
        truth.directions[order],
        truth.speeds[order],
        truth.ground_speeds[order],
        truth.positions_world[order],
        truth.instances[order],
    )
