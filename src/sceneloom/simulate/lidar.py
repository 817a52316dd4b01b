"""Lidars: every shot leaves from where the sensor is at the shot's own time.

`LidarSpec` rotates about its axis; `sceneloom.simulate.solid_state` has those that look one way. All are made here.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints
from sceneloom.simulate.bounds import check_bounds
from sceneloom.simulate.casting import (
    Hits,
    Paint,
    Rays,
    cast,
    instances_of,
    paint,
    reflectivities_of,
    silhouettes,
    velocities_of,
)
from sceneloom.simulate.mounts import sensor_mount
from sceneloom.simulate.path import EgoPath
from sceneloom.simulate.randomness import Stream, generator_for
from sceneloom.simulate.shots import ScanSpec, Shots, directions_at, repeating, scan_bounds
from sceneloom.simulate.street import Street

_BUNDLE_COLUMNS, _BUNDLE_BEAMS = 16, 8
"""Shots that are culled together: about as wide as high at the default resolution."""


DEFAULT_MOUNT = sensor_mount(position=(0.25, 0.02, 1.78), yaw_deg=0.8, pitch_deg=-0.5, roll_deg=0.3)
"""`ego_from_lidar` on the roof, a little off square, so that no one can take it for the identity."""


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
        clockwise: the trajectory it rotates, seen from above.
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
    mount: RigidTransform = DEFAULT_MOUNT
    offset_ns: int = 0

    def __post_init__(self) -> None:
        own = (("beams", self.beams, 1, 65535), ("steps", self.steps, 1, self.period_ns))
        check_bounds("lidar", (*scan_bounds(self), *own, *self._angles()))
        if (count := len(self.elevations_deg)) not in {2, self.beams}:
            raise OptionError(
                f"lidar.elevations_deg: {count} angles; expected 2, or {self.beams} for as many beams"
            )

    def _angles(self) -> Iterator[tuple[str, float, float, float]]:
        """Bounds of the angles: ring 0 is the lowest."""
        least = -90.0
        for number, elevation in enumerate(self.elevations_deg):
            yield f"elevations_deg[{number}]", elevation, least, 90.0
            least = elevation
        yield "start_azimuth_deg", self.start_azimuth_deg, -360.0, 360.0

    def plan_shots(self) -> Callable[[int], Shots]:
        """Give the shots, which are the same in each rotation."""
        offsets = np.arange(self.steps, dtype=np.int64) * self.period_ns // self.steps
        column, beam = (grid.ravel() for grid in np.mgrid[: self.steps, : self.beams])
        return repeating(Shots(_rays(self, column, beam), offsets, column, beam.astype(np.uint16)))


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
        shots_after: makes the shots of a sweep that starts so many ns after the first.
    """

    spec: ScanSpec
    street: Street
    path: EgoPath
    seed: int
    number: int
    timestamps_ns: Int64Array
    shots_after: Callable[[int], Shots]

    @classmethod
    def of(
        cls,
        spec: ScanSpec,
        street: Street,
        path: EgoPath,
        *,
        seed: int,
        timestamps_ns: Int64Array,
        number: int = 0,
    ) -> "ScanningLidar":
        """Set up the shots of a sweep."""
        return cls(spec, street, path, seed, number, timestamps_ns, spec.plan_shots())

    def frame(self, k: int) -> LidarFrame:
        """What the sensor reports of sweep k."""
        return self.sweep(k).frame

    def shots(self, k: int) -> Shots:
        """Where and when sweep k shoots."""
        return self.shots_after(int(self.timestamps_ns[k] - self.timestamps_ns[0]))

    def sweep(self, k: int) -> Sweep:
        """Make sweep k with its truth; the same every time."""
        shots = self.shots(k)
        times_ns = self.timestamps_ns[k] + shots.offsets_ns
        rotations, origins = self._poses(times_ns)
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
            velocities_of(self.street, hits.shapes[kept], ends, times_ns[moments]),
        )

    def silhouettes(self, k: int) -> Int64Array:
        """Count the shots of sweep k that each object would meet if it were alone, by instance number - 1."""
        shots = self.shots(k)
        times_ns = self.timestamps_ns[k] + shots.offsets_ns
        rotations, origins = self._poses(times_ns)
        return silhouettes(self.street, shots.rays, rotations, origins, times_ns, reach=self.spec.max_range)

    def _poses(self, timestamps_ns: Int64Array) -> tuple[Float64Array, Float64Array]:
        """`world_from_lidar` at each time: (M, 3, 3) rotations and (M, 3) positions."""
        ego = self.path.at(timestamps_ns)
        mount = self.spec.mount
        return ego.rotations @ mount.rotation, ego.positions + ego.rotations @ mount.translation

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


def _intensities(street: Street, hits: Hits, look: Paint) -> UInt8Array:
    """Strength of each return: the material, how light its surface is, and the angle at which it is met."""
    lightness = look.colors.astype(np.float32).mean(axis=1) / 255.0
    strength = reflectivities_of(street, hits) * (0.25 + 0.75 * lightness) * np.sqrt(look.facings)
    levels: UInt8Array = np.rint(255.0 * np.minimum(1.0, strength)).astype(np.uint8)
    return levels
