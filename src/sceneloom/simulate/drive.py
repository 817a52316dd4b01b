"""A simulated drive: its sensors, the scene as a reader would give it, and the truth behind it."""

import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.geometry.geodesy import geodetic_from_enu
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import CuboidAnnotation, CuboidPath
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses, PoseSource, Trajectory
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.time_range import select_rows
from sceneloom.scene.types import NO_FIELDS, Identifier, SensorType
from sceneloom.simulate.camera import CameraSpec, ImageTruth, RenderedCamera, camera_mount
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast
from sceneloom.simulate.lidar_radar import LidarSpec, RadarSpec, ScanningLidar, ScanSpec, SimulatedRadar, Sweep
from sceneloom.simulate.parameters import Stream, check_bounds, generator_for
from sceneloom.simulate.street import BoxTruth, Mover, Street, StreetObject, TrafficSpec, boxes_of
from sceneloom.simulate.trajectory import EgoPath, PathSpec

GRAVITY = 9.80665
"""[m/s²], down the world's z axis, wherever on earth a receiver puts the world's origin. Source: CGPM 1901, standard
gravity."""


@dataclass(frozen=True, slots=True)
class ImuSpec:
    """An inertial unit whose axes are the ego's.

    Attributes:
        rate_hz: samples a second.
        accelerometer_noise: density of the white noise [m/s²/√Hz]; a sample's deviation is this times √rate.
        gyroscope_noise: the same [rad/s/√Hz].
        accelerometer_bias_sigma: deviation from which the constant bias of each axis is drawn [m/s²].
        gyroscope_bias_sigma: the same [rad/s].

    Raises:
        OptionError: a number is out of bounds.
    """

    rate_hz: float = 200.0
    accelerometer_noise: float = 0.001
    gyroscope_noise: float = 0.0001
    accelerometer_bias_sigma: float = 0.02
    gyroscope_bias_sigma: float = 0.001

    def __post_init__(self) -> None:
        sigmas = (f"{name}_{what}" for name in ("accelerometer", "gyroscope") for what in ("noise", "bias_sigma"))
        check_bounds("imu", self, rate_hz=(1.0, 10_000.0), **dict.fromkeys(sigmas, (0.0, 1e3)))


@dataclass(frozen=True, slots=True, eq=False)
class ImuTruth:
    """What the unit would report without errors, and its constant errors.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        specific_forces: (N, 3) float64 [m/s²], ego frame; at rest it points up.
        angular_rates: (N, 3) float64 [rad/s], ego frame.
        accelerometer_bias: (3,) float64 [m/s²].
        gyroscope_bias: (3,) float64 [rad/s].
    """

    timestamps_ns: Int64Array
    specific_forces: Float64Array
    angular_rates: Float64Array
    accelerometer_bias: Float64Array
    gyroscope_bias: Float64Array


def imu_truth(spec: ImuSpec, path: EgoPath, timestamps_ns: Int64Array, *, seed: int) -> ImuTruth:
    """Derive the unit's signals from the exact motion."""
    states = path.at(timestamps_ns)
    pulled = states.accelerations + np.array([0.0, 0.0, GRAVITY])
    return ImuTruth(
        timestamps_ns,
        np.einsum("nji,nj->ni", states.rotations, pulled),
        states.angular_rates,
        spec.accelerometer_bias_sigma * generator_for(seed, Stream.ACCELEROMETER, 0).standard_normal(3),
        spec.gyroscope_bias_sigma * generator_for(seed, Stream.GYROSCOPE, 0).standard_normal(3),
    )


def imu_sensor(spec: ImuSpec, truth: ImuTruth, *, seed: int) -> ImuSensor:
    """Add bias and white noise to the true signals."""
    signals = (
        ("accelerometer", truth.specific_forces + truth.accelerometer_bias, spec.accelerometer_noise),
        ("gyroscope", truth.angular_rates + truth.gyroscope_bias, spec.gyroscope_noise),
    )
    streams = {}
    for name, values, density in signals:
        normals = generator_for(seed, Stream[name.upper()], 1).standard_normal(values.shape)
        streams[name] = VectorSamples(truth.timestamps_ns, values + np.sqrt(spec.rate_hz) * density * normals)
    return ImuSensor("imu", streams)


@dataclass(frozen=True, slots=True)
class GnssSpec:
    """A satellite receiver; the world's x, y and z are east, north and up at its origin.

    Attributes:
        rate_hz: fixes a second.
        horizontal_sigma, vertical_sigma: standard deviation of each fix [m], the first for east and for north.
        correlated_sigma: standard deviation of a further, slow error [m] for east and for north; in height it is larger
            by the ratio of the two above.
        correlation_time: time constant of its exponential correlation [s].
        origin_lla: where the world's origin lies: latitude, longitude [deg], altitude above the ellipsoid [m].

    Raises:
        OptionError: a number is out of bounds.
    """

    rate_hz: float = 10.0
    horizontal_sigma: float = 0.4
    vertical_sigma: float = 0.8
    correlated_sigma: float = 0.0
    correlation_time: float = 60.0
    origin_lla: tuple[float, float, float] = (60.1708, 24.9375, 14.0)

    def __post_init__(self) -> None:
        check_bounds("gnss", self, rate_hz=(0.01, 1000.0), horizontal_sigma=(0.0, 1e4), vertical_sigma=(0.0, 1e4))
        check_bounds("gnss", self, correlated_sigma=(0.0, 1e4), correlation_time=(1e-3, 1e6))
        check_bounds("gnss", self, origin_lla=((-90.0, 90.0), (-180.0, 180.0), (-1e4, 1e5)))


def gnss_sensor(spec: GnssSpec, path: EgoPath, timestamps_ns: Int64Array, *, seed: int) -> GnssSensor:
    """Give noisy fixes at (N,) int64 times [ns], ascending; their accuracy is stated with all errors."""
    sigmas = np.array([spec.horizontal_sigma, spec.horizontal_sigma, spec.vertical_sigma])
    drawn = generator_for(seed, Stream.GNSS).standard_normal((2, len(timestamps_ns), 3))
    noise = sigmas * drawn[0]
    if spec.correlated_sigma:
        ratio = spec.vertical_sigma / spec.horizontal_sigma if spec.horizontal_sigma else 1.0
        slow = spec.correlated_sigma * np.array([1.0, 1.0, ratio])
        # Source: Rasmussen and Williams 2006, B.2.1: the Ornstein-Uhlenbeck process at steps of any length
        kept = np.exp(-np.diff(timestamps_ns, prepend=timestamps_ns[:1]) * 1e-9 / spec.correlation_time)
        error = drawn[1, 0] if len(drawn[1]) else np.zeros(3)
        for k, share in enumerate(kept):
            error = share * error + np.sqrt(1.0 - share**2) * drawn[1, k]
            noise[k] += slow * error
        sigmas = np.hypot(sigmas, slow)
    positions = geodetic_from_enu(path.at(timestamps_ns).positions + noise, np.array(spec.origin_lla))
    across, up = (np.full(len(noise), sigma) for sigma in sigmas[1:])
    return GnssSensor("gnss", timestamps_ns, positions, across, up)


_MARGIN_NS = 200_000_000  # how far trajectory, IMU and GNSS reach beyond the first and the last measurement
_LONGEST_PERIOD_NS = 1_000_000_000
"""Longest frame of a further lidar, which ends so much later than the drive at most: so far traffic goes on, too."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """The devices on the ego, and the clock of the drive: the periods of its first lidar.

    Attributes:
        lidars, cameras, radars: the devices by id, in order.
        frames: periods of the first lidar.
        start_ns: start of the drive [ns].
    """

    lidars: Mapping[str, ScanSpec]
    cameras: Mapping[str, CameraSpec]
    radars: Mapping[str, RadarSpec]
    frames: int
    start_ns: int

    @classmethod
    def of(
        cls,
        lidars: Sequence[ScanSpec],
        cameras: Sequence[CameraSpec],
        radars: Sequence[RadarSpec],
        *,
        frames: int,
        start_ns: int,
    ) -> "Rig":
        """Name the devices: "lidar", or "lidar0", "lidar1", … where there are several; "camera0", …; "radar0", ….

        Raises:
            OptionError: there is no lidar, or a device's times do not fit the others'.
        """
        if not lidars:
            raise OptionError("lidars: none; expected one at least, whose sweeps are the clock of the drive")
        rig = cls(
            {"lidar" if len(lidars) == 1 else f"lidar{index}": spec for index, spec in enumerate(lidars)},
            {f"camera{index}": spec for index, spec in enumerate(cameras)},
            {f"radar{index}": spec for index, spec in enumerate(radars)},
            frames,
            start_ns,
        )
        offsets, period_ns = [spec.offset_ns for spec in cameras], rig.period_ns
        if offsets and (min(offsets) < -period_ns or max(offsets) > 2 * period_ns):
            raise OptionError(
                f"camera offsets {offsets} ns; expected {-period_ns} to {2 * period_ns}, a sweep's period before the "
                "sweep and after it"
            )
        for name, spec in list(rig.lidars.items())[1:]:
            if spec.period_ns > _LONGEST_PERIOD_NS:
                raise OptionError(f"{name}.period_ns: {spec.period_ns}; expected at most {_LONGEST_PERIOD_NS}")
        return rig

    @property
    def period_ns(self) -> int:
        """Time from one sweep of the first lidar to the next [ns]."""
        return next(iter(self.lidars.values())).period_ns

    @property
    def sweep_starts_ns(self) -> Int64Array:
        """(F,) int64 [ns], the periods of the drive, by which images are taken."""
        starts: Int64Array = self.start_ns + self.period_ns * np.arange(self.frames, dtype=np.int64)
        return starts

    @property
    def trajectory_span_ns(self) -> tuple[int, int]:
        """First and last time that the first lidar and the cameras need [ns], with a margin.

        The street is laid out for this, so that further lidars and radars do not change it.
        """
        offsets = [0, self.period_ns, *(spec.offset_ns for spec in self.cameras.values())]
        starts = self.sweep_starts_ns
        return int(starts[0]) + min(offsets) - _MARGIN_NS, int(starts[-1]) + max(offsets) + _MARGIN_NS

    @property
    def traffic_span_ns(self) -> tuple[int, int]:
        """First and last time at which what moves has to be somewhere [ns], whatever further sensors there are."""
        first, last = self.trajectory_span_ns
        return first, max(last + _LONGEST_PERIOD_NS, self.span_ns[1])

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time that any sensor needs [ns], with a margin."""
        first, last = self.trajectory_span_ns
        ends = [self.frame_starts_ns(spec)[-1:] + spec.period_ns for spec in self.lidars.values()]
        ends += [self.frame_starts_ns(spec)[-1:] for spec in self.radars.values()]
        latest = np.concatenate(ends).max(initial=last - _MARGIN_NS)
        return first, int(latest) + _MARGIN_NS

    def frame_starts_ns(self, spec: ScanSpec | RadarSpec) -> Int64Array:
        """Starts of all frames of a device that begin within the drive, (F,) int64 [ns].

        The first lidar has one in each of its periods.
        """
        length_ns = self.frames * self.period_ns
        count = max(0, -(-(length_ns - spec.offset_ns) // spec.period_ns))
        starts: Int64Array = self.start_ns + spec.offset_ns + spec.period_ns * np.arange(count, dtype=np.int64)
        return starts

    def truth(self, street: Street, path: EgoPath, imu: ImuTruth, *, seed: int) -> "Truth":
        """Put the devices on their way."""
        lidars = {
            name: ScanningLidar(spec, street, path, seed, number, self.frame_starts_ns(spec))
            for number, (name, spec) in enumerate(self.lidars.items())
        }
        cameras = {}
        for number, (name, camera) in enumerate(self.cameras.items()):
            times_ns = self.sweep_starts_ns + camera.offset_ns
            cameras[name] = RenderedCamera.of(camera, street, path, timestamps_ns=times_ns, seed=seed, number=number)
        radars = {
            name: SimulatedRadar(radar, street, path, seed, number, self.frame_starts_ns(radar))
            for number, (name, radar) in enumerate(self.radars.items())
        }
        return Truth(street, path, lidars, cameras, radars, imu)


def _sensors_of(truth: "Truth", ego: Poses) -> Iterator[LidarSensor | CameraSensor | RadarSensor]:
    """Give the sensors as a reader would: frames that are made when asked for, poses along the ego's, mountings."""

    def poses(mount: RigidTransform) -> Poses:
        along = PoseSource(ego, mount).at(ego.timestamps_ns)
        return Poses(ego.timestamps_ns, along.positions, along.quaternions_xyzw)

    for name, lidar in truth.lidars.items():
        mount, sweeps = lidar.spec.mount, LazyFrames(lidar.timestamps_ns, lidar.frame)
        yield LidarSensor(name, sweeps, poses=poses(mount), mount=mount, model="simulated")
    for name, camera in truth.cameras.items():
        spec, times = camera.spec, camera.timestamps_ns
        yield CameraSensor(
            name,
            spec.camera,
            LazyFrames(times, camera.image),
            poses=poses(spec.mount),
            mount=spec.mount,
            fps=1e9 / float(times[1] - times[0]) if len(times) > 1 else None,
            extras=_shutter_fields(spec),
        )
    for name, radar in truth.radars.items():
        mount, cycles = radar.spec.mount, LazyFrames(radar.timestamps_ns, radar.frame)
        yield RadarSensor(name, cycles, poses=poses(mount), mount=mount)


def _shutter_fields(spec: CameraSpec) -> Mapping[str, Any]:
    """What `calibration.json` of a recording says of a rolling shutter, where its reader would keep it.

    Source: `shutterRollTimeSeconds` in docs/formats/recording.md.
    """
    if spec.readout_ns == 0:
        return NO_FIELDS
    entry: dict[str, Any] = {"shutterRollTimeSeconds": spec.readout_ns / 1e9}
    if spec.left_to_right:
        entry["rollingShutterLeftToRight"] = True
    return {"calibration": entry}


_BEYOND = 1.0  # how far past a point its line of sight is followed [m]: enough to find the surface that it lies on


@dataclass(frozen=True, slots=True, eq=False)
class CleanPoints:
    """Where the returns of a sweep come from, in the order of the frame's points, without noise.

    Attributes:
        positions_world: (N, 3) float64 [m].
        instances: (N,) int32, what was hit; 0 is the ground.
        colors: (N, 3) uint8, colour of the bare surface there, which an image shows averaged over a pixel.
        ranges: (N,) float64 [m], from the lidar at the point's own time.
        velocities: (N, 3) float64 [m/s], world frame, of what was hit, at the point; zero where it is stationary.
    """

    positions_world: Float64Array
    instances: AnyArray
    colors: UInt8Array
    ranges: Float64Array
    velocities: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class OcclusionTruth:
    """What hides objects in an image; those that no pixel's centre would show are left out.

    Attributes:
        instances: (I,) int64, rising.
        visible_px: (I,) int64, pixels whose centres show the object.
        alone_px: (I,) int64, pixels that would show it if nothing else were there.
    """

    instances: Int64Array
    visible_px: Int64Array
    alone_px: Int64Array

    @property
    def hidden(self) -> Float64Array:
        """Which share of each object is hidden, (I,) float64, 0 to 1."""
        shares: Float64Array = 1.0 - self.visible_px / self.alone_px
        return shares


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is exactly so in a simulated drive. Images are rendered when asked for, nothing is kept.

    Attributes:
        street: everything that stands in it and that moves.
        path: the ego trajectory as a curve.
        lidars: the lidars by id, with their noise apart.
        cameras: the cameras by id.
        radars: the radars by id, with their noise apart.
        imu: the inertial unit's signals without errors, and its bias.
    """

    street: Street
    path: EgoPath
    lidars: Mapping[str, ScanningLidar]
    cameras: Mapping[str, RenderedCamera]
    radars: Mapping[str, SimulatedRadar]
    imu: ImuTruth

    @property
    def lidar(self) -> ScanningLidar:
        """The first lidar."""
        return next(iter(self.lidars.values()))

    @property
    def objects(self) -> tuple[StreetObject, ...]:
        """What stands in the street; object k has instance number k + 1."""
        return self.street.objects

    @property
    def movers(self) -> tuple[Mover, ...]:
        """What moves; instance numbers go on after those of the objects."""
        return self.street.movers.things

    def boxes(self, timestamps_ns: ArrayLike) -> BoxTruth:
        """Boxes and velocities of all that stands and moves, at (T,) times [ns]."""
        return boxes_of(self.street, np.asarray(timestamps_ns, np.int64))

    def world_from_ego(self, timestamps_ns: Int64Array) -> Poses:
        """Exact ego poses at strictly increasing times [ns]."""
        return self.path.poses(timestamps_ns)

    def world_from_camera(self, camera_id: str, k: int) -> RigidTransform:
        """Exact pose of a camera at the time of its image k; of a rolling shutter, that of its middle."""
        return self._camera(camera_id).pose(k)

    def image(self, camera_id: str, k: int) -> ImageTruth:
        """Depths, instances and colours of image k in one go.

        Raises:
            OptionError: there is no such camera.
        """
        return self._camera(camera_id).truth(k)

    def depth(self, camera_id: str, k: int) -> Float32Array:
        """Depth z at the pixels' centres, (H, W) float32 [m]; 0 for the sky."""
        return self.image(camera_id, k).depths

    def instances(self, camera_id: str, k: int) -> AnyArray:
        """What the pixels' centres show, (H, W) int32; 0 the ground, -1 the sky."""
        return self.image(camera_id, k).instances

    def colors(self, camera_id: str, k: int) -> UInt8Array:
        """Colour along the ray through each pixel's centre, (H, W, 3) uint8, whatever the exposure was."""
        return self.image(camera_id, k).colors

    def exposure(self, camera_id: str, k: int) -> float:
        """By what image k is brighter than the true colours, in its middle; 1.0 where nothing changes it."""
        return self._camera(camera_id).gain(k)

    def edges(self, camera_id: str, k: int, *, within_px: int = 2) -> BoolArray:
        """Which pixels lie near an outline, (H, W) bool; `edge_mask` says what an outline is."""
        return edge_mask(self.image(camera_id, k), within_px=within_px)

    def occlusion(self, camera_id: str, k: int) -> OcclusionTruth:
        """How much of each object image k shows, and how much it would show if nothing stood before it."""
        camera = self._camera(camera_id)
        alone = camera.silhouettes(k)
        shown = self.instances(camera_id, k)
        visible = np.bincount(shown[shown > 0], minlength=len(alone) + 1)[1:]
        inside = np.flatnonzero(alone)
        return OcclusionTruth(inside + 1, visible[inside], alone[inside])

    def visible(self, camera_id: str, k: int, points_world: ArrayLike, *, tolerance: float = 0.01) -> BoolArray:
        """Report for each surface point whether nothing stands between it and the camera, when its line is taken.

        Whether it falls into the image is another question.

        Args:
            points_world: (N, 3) float [m], on surfaces, such as `clean_points_world` gives.
            tolerance: how far from the first surface on its line of sight a point may lie and be seen [m].

        Returns:
            (N,) bool.
        """
        camera, points = self._camera(camera_id), np.asarray(points_world, np.float64).reshape(-1, 3)
        lines, (_, origins) = camera.lines_seeing(k, points), camera.line_poses(k)
        apart = points - origins[lines]
        distances = np.linalg.norm(apart, axis=1)
        directions = apart / np.maximum(1e-12, distances)[:, None]
        rays = Rays.bundled(directions, bundles_by_direction(directions), pose_of_ray=lines)
        reach = float(distances.max(initial=0.0)) + _BEYOND
        upright = np.tile(np.eye(3), (len(origins), 1, 1))
        hits = cast(self.street, rays, upright, origins, camera.line_times_ns(k), reach=reach)
        free: BoolArray = (hits.ranges == 0.0) | (hits.ranges > distances - tolerance)
        return free

    def sweep(self, k: int, lidar_id: str | None = None) -> Sweep:
        """Sweep k of a lidar, by default the first, with everything that is known about it.

        Raises:
            OptionError: there is no such lidar.
        """
        if lidar_id is None:
            return self.lidar.sweep(k)
        if lidar_id not in self.lidars:
            raise OptionError(f"lidar {lidar_id!r}; expected one of {', '.join(map(repr, self.lidars))}")
        return self.lidars[lidar_id].sweep(k)

    def clean_points_world(self, k: int, lidar_id: str | None = None) -> CleanPoints:
        """Where the points of frame k of a lidar, by default the first, come from, without noise.

        Raises:
            OptionError: there is no such lidar.
        """
        sweep = self.sweep(k, lidar_id)
        return CleanPoints(sweep.points_world, sweep.instances, sweep.colors, sweep.ranges, sweep.velocities)

    def _camera(self, camera_id: str) -> RenderedCamera:
        if camera_id not in self.cameras:
            raise OptionError(f"camera {camera_id!r}; expected one of {', '.join(map(repr, self.cameras))}")
        return self.cameras[camera_id]


_TRAJECTORY = "groundTruth"  # name of the trajectory that is exactly the ego trajectory
_ANNOTATED = frozenset({"car", "bin", "tree", "pole"})
"""Classes of objects that get a box in the scene's annotations; `Truth.objects` knows all."""

_EVERY_NS = 50_000_000
"""Distance of the samples of a moving box [ns].

Between them lines miss an acceleration a by a dt² / 8: 3 mm at 10 m/s², a car in the tightest bend, and 0.04 degrees
at 2 rad/s².
"""

_IMU_SHIFT_NS = 1_300_000  # keeps the IMU's timestamps from falling on those of other sensors, as two clocks would
_Interval = tuple[int, int]  # `[start_ns, stop_ns)` on the true clock [ns]


class PointTimes(StrEnum):
    """What a driver can make of the times of a lidar's or a radar's points."""

    RIGHT = "right"
    """They are what they should be."""
    MISSING = "missing"
    """The points have no times at all."""
    ZERO = "zero"
    """All are 0."""
    FRAME = "frame"
    """All are the timestamp of their frame."""
    RELATIVE = "relative"
    """They count from the timestamp of their frame [ns]."""
    MICROSECONDS = "microseconds"
    """They are the right times in microseconds, handed on as nanoseconds."""
    RELATIVE_MICROSECONDS = "relative_microseconds"
    """They count from the timestamp of their frame in microseconds, handed on as nanoseconds."""
    STRETCHED = "stretched"
    """Their distance from the timestamp of their frame is 1000 times too long: nanoseconds read as microseconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFaults:
    """What is wrong with one sensor. Frame numbers count its true frames (samples of an IMU or a GNSS) from 0.

    Attributes:
        rotation_deg: rotation vector [deg] in the sensor's axes by which the stated mounting is rotated from the true
            one: `ego_from_stated = ego_from_true @ error`.
        shift: the error's translation [m] in the sensor's axes.
        time_offset_ns: added to all its timestamps [ns].
        clock_skew_ppm: its clock runs so much too fast, from the first timestamp on.
        lost_share: share of frames that are lost at random.
        lost_frames: numbers of frames that are lost.
        drop_outs: intervals from which no frame comes.
        blind: intervals whose frames are there but empty; images are black.
        stuck: intervals whose frames repeat the content of the first one in them.
        swapped: pairs of frame numbers that come in each other's place, timestamps included.
        point_times: what the times of the points are.
        intensity_scale: factor on the intensities, which stay within 0 to 255.
        focal_scale: factor on the focal lengths that the scene states.

    Raises:
        OptionError: a number is out of bounds.
    """

    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset_ns: int = 0
    clock_skew_ppm: float = 0.0
    lost_share: float = 0.0
    lost_frames: tuple[int, ...] = ()
    drop_outs: tuple[_Interval, ...] = ()
    blind: tuple[_Interval, ...] = ()
    stuck: tuple[_Interval, ...] = ()
    swapped: tuple[tuple[int, int], ...] = ()
    point_times: PointTimes = PointTimes.RIGHT
    intensity_scale: float = 1.0
    focal_scale: float = 1.0

    def __post_init__(self) -> None:
        check_bounds(
            "faults",
            self,
            rotation_deg=(-180.0, 180.0),
            shift=(-1e3, 1e3),
            time_offset_ns=(-(10**15), 10**15),
            clock_skew_ppm=(-1e5, 1e5),
            lost_share=(0.0, 1.0),
            intensity_scale=(0.0, 1e3),
            focal_scale=(0.1, 10.0),
        )
        for name in ("drop_outs", "blind", "stuck"):
            for interval in getattr(self, name):
                if len(interval) != 2 or interval[0] >= interval[1]:
                    raise OptionError(f"faults.{name}: {interval}; expected (start_ns, stop_ns), start first")
        numbers = [number for pair in self.swapped for number in pair]
        if any(len(pair) != 2 for pair in self.swapped) or len(set(numbers)) != len(numbers):
            raise OptionError(f"faults.swapped: {self.swapped}; expected pairs, each frame in one of them")

    @property
    def error(self) -> RigidTransform:
        """`true_from_stated` of the mounting, in the sensor's axes."""
        vector = np.radians(np.array(self.rotation_deg, np.float64))
        half = float(np.linalg.norm(vector)) / 2
        scale = 0.5 * np.sinc(half / np.pi)  # sin(half) / (2 half), also for no rotation
        quaternion_xyzw = np.array([*(scale * vector), math.cos(half)])
        return RigidTransform.from_quaternion(np.array(self.shift, np.float64), quaternion_xyzw)

    @property
    def named(self) -> frozenset[str]:
        """Names of the faults that are there, as those of the fields."""
        return frozenset(
            name for name in self.__dataclass_fields__ if getattr(self, name) != getattr(_NOTHING_WRONG, name)
        )


_NOTHING_WRONG = SensorFaults()
_STREAM_FAULTS = frozenset(
    {"time_offset_ns", "clock_skew_ppm", "lost_share", "lost_frames", "drop_outs", "stuck", "swapped"}
)
_CLOUD_FAULTS = _STREAM_FAULTS | {"rotation_deg", "shift", "blind", "point_times"}
_POSSIBLE_FAULTS: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        SensorType.LIDAR: _CLOUD_FAULTS | {"intensity_scale"},
        SensorType.RADAR: _CLOUD_FAULTS,
        SensorType.CAMERA: _STREAM_FAULTS | {"rotation_deg", "shift", "blind", "focal_scale"},
        SensorType.IMU: _STREAM_FAULTS | {"rotation_deg"},
        SensorType.GNSS: _STREAM_FAULTS,
    }
)
"""Which faults mean something for which sensors."""


@dataclass(frozen=True, slots=True)
class Faults:
    """What is wrong with a drive.

    Attributes:
        sensors: faults by the id of the sensor.
        seed: another number loses other frames.
    """

    sensors: Mapping[Identifier, SensorFaults] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise OptionError(f"faults.seed: {self.seed}; expected a number that is not negative")


@dataclass(frozen=True, slots=True, eq=False)
class _FramePlan:
    """Which frames come, of what and when."""

    contents: Int64Array  # (F,) int64, number of the true frame that each one shows
    true_ns: Int64Array  # (F,) int64 [ns], when the frame should be of
    stated_ns: Int64Array  # (F,) int64 [ns], the timestamp that it gets
    blind: BoolArray  # (F,) bool, nothing is in it


@dataclass(frozen=True, slots=True, eq=False)
class _Injection:
    """The faults of one sensor, whose first timestamp is `first_ns`, and what its random losses start from."""

    wrong: SensorFaults
    first_ns: int
    seed: int
    sensor_id: Identifier

    def stated(self, timestamps_ns: AnyArray) -> Int64Array:
        """What the sensor's clock says at true times [ns]: an offset, and a drift from the first timestamp on."""
        times = np.asarray(timestamps_ns, np.int64)
        drift = np.rint((times - self.first_ns) * (self.wrong.clock_skew_ppm * 1e-6)).astype(np.int64)
        stated: Int64Array = times + self.wrong.time_offset_ns + drift
        return stated

    def plan(self, timestamps_ns: Int64Array) -> _FramePlan:
        """Work the faults out for true timestamps (N,) int64 [ns]."""
        wrong, count = self.wrong, len(timestamps_ns)
        named = [*wrong.lost_frames, *(number for pair in wrong.swapped for number in pair)]
        beyond = [number for number in named if not 0 <= number < count]
        if beyond:
            raise OptionError(f"faults of sensor {self.sensor_id!r}: frame {beyond[0]}; expected 0 to {count - 1}")
        contents, order = np.arange(count), np.arange(count)
        for interval in wrong.stuck:
            inside = np.flatnonzero(_within(timestamps_ns, (interval,)))
            contents[inside] = contents[inside[:1]]
        for one, other in wrong.swapped:
            order[[one, other]] = other, one
        key = zlib.crc32(repr(self.sensor_id).encode())
        lost = generator_for(self.seed, Stream.FAULTS, key).random(count) < wrong.lost_share
        lost[list(wrong.lost_frames)] = True
        lost |= _within(timestamps_ns, wrong.drop_outs)
        order = order[~lost[order]]
        true_ns = timestamps_ns[order]
        return _FramePlan(contents[order], true_ns, self.stated(true_ns), _within(true_ns, wrong.blind))

    def placement(self, sensor: LidarSensor | RadarSensor | CameraSensor) -> dict[str, Any]:
        """The mounting and the poses that the scene states, where they are wrong."""
        if not self.wrong.named & {"rotation_deg", "shift"}:
            return {}
        poses, error = sensor.poses, self.wrong.error
        if poses is not None:
            stated = PoseSource(poses, error).at(poses.timestamps_ns)
            poses = replace(poses, positions=stated.positions, quaternions_xyzw=stated.quaternions_xyzw)
        return {"poses": poses, "mount": None if sensor.mount is None else sensor.mount @ error}


def _within(timestamps_ns: Int64Array, intervals: tuple[_Interval, ...]) -> BoolArray:
    """Which times lie in one of the intervals."""
    inside = np.zeros(len(timestamps_ns), np.bool_)
    for start, stop in intervals:
        inside |= (timestamps_ns >= start) & (timestamps_ns < stop)
    return inside


_POINT_TIMES: Mapping[PointTimes, tuple[int, int, int]] = MappingProxyType(
    {
        PointTimes.RIGHT: (1, 1, 1),
        PointTimes.ZERO: (0, 0, 1),
        PointTimes.FRAME: (0, 1, 1),
        PointTimes.RELATIVE: (1, 0, 1),
        PointTimes.MICROSECONDS: (1, 1, 1000),
        PointTimes.RELATIVE_MICROSECONDS: (1, 0, 1000),
        PointTimes.STRETCHED: (1000, 1, 1),
    }
)
"""Factor on the time within the frame, factor on the frame's timestamp, divisor of their sum; others have no times."""


def _faulty_cloud(frames: LazyFrames[Any], plan: _FramePlan, injection: _Injection, index: int) -> Any:
    """Read one of the frames of a lidar or radar that come."""
    wrong, stated_ns = injection.wrong, int(plan.stated_ns[index])
    frame: LidarFrame | RadarFrame = frames[int(plan.contents[index])]
    points: Any = frame.points
    if plan.blind[index]:
        arrays = {f.name: getattr(points, f.name) for f in fields(points) if f.name != "extras"}
        extras = {name: array[:0] if len(array) == len(points) else array for name, array in points.extras.items()}
        empty = {name: None if array is None else array[:0] for name, array in arrays.items()}
        points = replace(points, **empty, extras=extras)
    times = None
    if points.timestamps_ns is not None and wrong.point_times in _POINT_TIMES:
        late_ns = int(plan.true_ns[index]) - frame.timestamp_ns
        within, timestamp, divisor = _POINT_TIMES[wrong.point_times]
        stated = injection.stated(points.timestamps_ns + late_ns) - stated_ns
        times = read_only((within * stated + timestamp * stated_ns) // divisor)
    points = replace(points, timestamps_ns=times)
    if wrong.intensity_scale != 1.0 and points.intensities is not None:
        scaled = np.clip(np.rint(points.intensities * wrong.intensity_scale), 0, 255)
        points = replace(points, intensities=read_only(scaled, np.uint8))
    changed: Any = replace(frame, timestamp_ns=stated_ns, points=points)
    return changed


def _faulty_image(images: LazyFrames[CameraImage], plan: _FramePlan, injection: _Injection, index: int) -> CameraImage:
    """Read one of the images that come."""
    image = images[int(plan.contents[index])]
    camera, mount = _refocused(image.camera, injection.wrong.focal_scale), image.mount
    mount = None if mount is None else mount @ injection.wrong.error
    changed = replace(image, timestamp_ns=int(plan.stated_ns[index]), camera=camera, mount=mount)
    if not plan.blind[index]:
        return changed
    return replace(changed, decode=partial(_black, camera.height, camera.width), encoded=None)


def _black(height: int, width: int) -> UInt8Array:
    return np.zeros((height, width, 3), np.uint8)


def _refocused(camera: Camera, scale: float) -> Camera:
    """The same camera model with its focal lengths scaled."""
    return camera if scale == 1.0 else replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)


def _injected(sensor: Any, injection: _Injection) -> tuple[Any, Int64Array]:
    """Give a sensor with its faults, and which true frame each of its frames shows."""
    wrong = injection.wrong
    match sensor:
        case LidarSensor() | RadarSensor():
            plan = injection.plan(sensor.frames.timestamps_ns)
            frames: Any = LazyFrames(plan.stated_ns, partial(_faulty_cloud, sensor.frames, plan, injection))
            return replace(sensor, frames=frames, **injection.placement(sensor)), plan.contents
        case CameraSensor():
            plan = injection.plan(sensor.images.timestamps_ns)
            images = LazyFrames(plan.stated_ns, partial(_faulty_image, sensor.images, plan, injection))
            camera, placed = _refocused(sensor.camera, wrong.focal_scale), injection.placement(sensor)
            return replace(sensor, camera=camera, images=images, video=None, **placed), plan.contents
        case ImuSensor():
            plans = {name: injection.plan(samples.timestamps_ns) for name, samples in sensor.streams.items()}
            streams = {}
            for name, plan in plans.items():
                # a rotated unit whose frame counts as the ego's; only vectors of space rotate
                values = sensor.streams[name].values[plan.contents]
                rotated = wrong.error.rotate(values) if values.shape[1] == 3 else values
                streams[name] = VectorSamples(plan.stated_ns, rotated)
            contents = max((plan.contents for plan in plans.values()), key=len, default=np.zeros(0, np.int64))
            return replace(sensor, streams=streams), contents
    plan = injection.plan(sensor.timestamps_ns)
    fixes: GnssSensor = replace(select_rows(sensor, plan.contents), timestamps_ns=plan.stated_ns, file_seconds=None)
    return fixes, plan.contents


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDrive:
    """A drive that never happened.

    Attributes:
        scene: what sensors recorded of it; sweeps and images are made when asked for.
        truth: what was really there; injected faults change nothing in it.
        faults: what was injected in the scene.
        true_frames: for each sensor with faults, (F,) int64: which frame of the truth each of its frames shows.
    """

    scene: Scene
    truth: Truth
    faults: Faults = field(default_factory=Faults)
    true_frames: Mapping[Identifier, Int64Array] = field(default_factory=dict)


def simulate_street(
    seed: int = 0,
    *,
    frames: int = 30,
    lidar: ScanSpec | None = None,
    lidars: Sequence[ScanSpec] | None = None,
    cameras: Sequence[CameraSpec] | None = None,
    radars: Sequence[RadarSpec] = (),
    imu: ImuSpec | None = None,
    gnss: GnssSpec | None = None,
    path: PathSpec | None = None,
    traffic: TrafficSpec | None = None,
    faults: Faults | None = None,
    trajectory_hz: float = 100.0,
    start_ns: int = 1_000_000_000,
) -> SimulatedDrive:
    """Drive through a synthetic street.

    Args:
        seed: another number is another street, trajectory and noise.
        frames: sweeps of the (first) lidar; each camera takes one image in each.
        lidar: the lidar, a `LidarSpec` or a `SolidStateSpec`; by default 64 beams and 1800 steps at 10 Hz on the roof.
        lidars: several instead; the further ones have as many sweeps as begin before the first has ended its
            last. A single lidar's id is "lidar", of several they are "lidar0", "lidar1", …
        cameras: by default one of 1242x375 pixels, looking ahead; ids are "camera0", "camera1", …
        radars: none by default; ids are "radar0", "radar1", …
        imu, gnss: the inertial unit and the satellite receiver.
        path: how the ego drives: speeds, bends, stops.
        traffic: what moves besides the ego; None for nothing.
        faults: what is wrong with the scene; None for nothing.
        trajectory_hz: samples of the trajectory a second; 100 keeps interpolation within 0.1 mm and 0.001 degrees
            on the default trajectory, and within 1 mm and 0.01 degrees on the fastest one.
        start_ns: time of the first sweep [ns].

    Returns:
        The drive; the same for the same arguments, whatever is asked of it and in which order.

    Raises:
        OptionError: a number is out of bounds.
        CalibrationError: a camera model cannot be used.
    """
    if seed < 0:
        raise OptionError(f"seed {seed}; expected a number that is not negative")
    if frames < 1 or not 10.0 <= trajectory_hz <= 10_000.0:
        raise OptionError(f"{frames} frames at {trajectory_hz} poses a second; expected >= 1, 10 to 10000")
    if lidar is not None and lidars is not None:
        raise OptionError("lidar and lidars: both are given; expected one of them")
    imu, gnss = imu or ImuSpec(), gnss or GnssSpec()
    rig = Rig.of(
        (lidar or LidarSpec(),) if lidars is None else tuple(lidars),
        (CameraSpec(),) if cameras is None else tuple(cameras),
        tuple(radars),
        frames=frames,
        start_ns=start_ns,
    )
    span_ns = rig.span_ns
    duration = (rig.trajectory_span_ns[1] - start_ns) * 1e-9
    trajectory = (path or PathSpec()).plan(generator_for(seed, Stream.PATH), start_ns=start_ns, duration=duration)
    street = Street.of(trajectory, generator_for(seed, Stream.STREET))
    if traffic is not None:
        generator = generator_for(seed, Stream.TRAFFIC)
        movers = traffic.plan(generator, trajectory, street, span_ns=rig.traffic_span_ns)
        street = replace(street, movers=movers)
    inertial = imu_truth(imu, trajectory, _timestamps(span_ns, imu.rate_hz) + _IMU_SHIFT_NS, seed=seed)
    truth = rig.truth(street, trajectory, inertial, seed=seed)
    ego = trajectory.poses(_timestamps(span_ns, trajectory_hz))
    scene = Scene(
        (
            *_sensors_of(truth, ego),
            imu_sensor(imu, inertial, seed=seed),
            gnss_sensor(gnss, trajectory, _timestamps(span_ns, gnss.rate_hz), seed=seed),
        ),
        annotations=_annotations_of(street, start_ns=int(truth.lidar.timestamps_ns[0])),
        trajectories={_TRAJECTORY: Trajectory(_TRAJECTORY, ego.timestamps_ns, ego.positions, ego.quaternions_xyzw)},
        metadata={"sceneloom": {"euler_unit": "degrees", "euler_order": "xyz", "seed": seed}},
        source=f"simulated street {seed}",
        format="simulated",
    )
    drive = SimulatedDrive(scene, truth)
    return drive if faults is None else inject(drive, faults)


def _annotations_of(street: Street, *, start_ns: int) -> tuple[CuboidAnnotation, ...]:
    """Give a box for each object of the annotated classes; angles in degrees.

    What moves has a path while it is in the street, sampled every 50 ms: between samples a line stays within 1 cm, up
    to an acceleration of 30 m/s², and the shortest arc within 0.1 degrees of the truth. Samples lie on `start_ns` and
    all multiples of their distance.
    """
    annotations = []
    for thing in street.objects:
        if thing.label in _ANNOTATED:
            row = [(*thing.center_world, thing.yaw)]
            annotations.append(_annotation(thing, np.array([start_ns], np.int64), row, stands=True))
    for k, mover in enumerate(street.movers.things):
        timestamps = np.array([start_ns], np.int64)
        if not mover.stands:
            first, last = -(-(mover.first_ns - start_ns) // _EVERY_NS), (mover.last_ns - start_ns) // _EVERY_NS
            inner = start_ns + _EVERY_NS * np.arange(first, last + 1, dtype=np.int64)
            timestamps = np.union1d([mover.first_ns, mover.last_ns], inner).astype(np.int64)
        states = street.movers.states(np.full(len(timestamps), k), timestamps)
        heights = np.full(len(timestamps), 0.5 * mover.size_lwh[2])
        rows = np.column_stack([states.positions[:, :2], heights, states.yaws])
        annotations.append(_annotation(mover, timestamps, rows, stands=mover.stands))
    return tuple(annotations)


def _annotation(
    thing: StreetObject | Mover, timestamps: Int64Array, x_y_z_yaw: ArrayLike, *, stands: bool
) -> CuboidAnnotation:
    """A box at (T,) times from x, y, z and yaw (T, 4)."""
    rows = np.asarray(x_y_z_yaw, np.float64)
    values = np.zeros((len(timestamps), 9))
    values[:, :3], values[:, 3:6], values[:, 8] = thing.size_lwh, rows[:, :3], np.degrees(rows[:, 3])
    path = CuboidPath(timestamps, values)
    return CuboidAnnotation(f"{thing.label}-{thing.instance}", path, label=thing.label, stationary=stands)


def inject(drive: SimulatedDrive, faults: Faults) -> SimulatedDrive:
    """Make the scene of a drive wrong; its truth stays as it is.

    Raises:
        OptionError: the drive has faults already, there is no such sensor or frame, or a fault means nothing for
            that kind of sensor.
    """
    if drive.faults.sensors:
        raise OptionError(f"{drive.scene.source}: has faults already; inject all of them at once")
    for sensor_id, wrong in faults.sensors.items():
        sensor = drive.scene.sensor(sensor_id)
        possible = _POSSIBLE_FAULTS.get(str(sensor.type), frozenset())
        if strange := sorted(wrong.named - possible):
            raise OptionError(
                f"faults of sensor {sensor.id!r}: {', '.join(strange)}; a sensor of type {sensor.type} can have "
                f"{', '.join(sorted(possible)) or 'none'}"
            )
    sensors: list[Sensor] = []
    true_frames: dict[Identifier, Int64Array] = {}
    for sensor in drive.scene.sensors:
        changed = sensor
        if sensor.id in faults.sensors and str(sensor.type) in _POSSIBLE_FAULTS:
            first_ns = int(frame_times(sensor).min(initial=np.iinfo(np.int64).max))
            injection = _Injection(faults.sensors[sensor.id], first_ns, faults.seed, sensor.id)
            changed, true_frames[sensor.id] = _injected(sensor, injection)
        sensors.append(changed)
    scene = replace(drive.scene, sensors=tuple(sensors))
    return replace(drive, scene=scene, faults=faults, true_frames=true_frames)


def demo_drive(seed: int = 0, *, frames: int = 30) -> SimulatedDrive:
    """A small drive for a first look: two cameras of different models with smooth outlines, a lidar that looks up."""
    ahead = Camera("brown_conrady", 800, 400, 430.0, 430.0, 399.5, 190.0, (-0.12, 0.04, 0.0004, -0.0003, -0.006))
    aside = Camera("fisheye", 640, 400, 250.0, 250.0, 319.5, 190.0, (0.03, -0.008, 0.002, -0.0004))
    cameras = (
        CameraSpec(ahead, camera_mount(pitch_deg=0.6), supersampling=2),
        CameraSpec(
            aside, camera_mount(position=(0.35, 0.25, 1.6), yaw_deg=62.0, pitch_deg=2.0), 45_000_000, supersampling=2
        ),
    )
    return simulate_street(
        seed, frames=frames, lidar=LidarSpec(elevations_deg=(-25.0, 15.0), steps=1200), cameras=cameras
    )


def _timestamps(span_ns: tuple[int, int], rate_hz: float) -> Int64Array:
    """Times at a constant rate over a span, (N,) int64 [ns]."""
    count = int((span_ns[1] - span_ns[0]) * 1e-9 * rate_hz) + 2
    timestamps: Int64Array = span_ns[0] + np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    return timestamps


def edge_mask(truth: ImageTruth, *, within_px: int = 2) -> BoolArray:
    """Mark the pixels near an outline.

    An outline lies between two neighbouring pixels that show different objects, or depths that differ by more than
    a plane could explain: 5 % of the depth and more than double the step on either side.

    Args:
        within_px: how far from an outline pixels are still marked, along rows, columns and diagonals.

    Returns:
        (H, W) bool.
    """
    edges = np.zeros(truth.depths.shape, np.bool_)
    for axis in (0, 1):
        instances, depths = (np.moveaxis(array, axis, 0) for array in (truth.instances, truth.depths))
        view = np.moveaxis(edges, axis, 0)
        change = (instances[1:] != instances[:-1]) | _jumps(depths.astype(np.float64))
        view[1:] |= change
        view[:-1] |= change
    return _grown(edges, within_px - 1)


def _jumps(depths: Float64Array) -> BoolArray:
    """Where the depth leaps between rows, (H - 1, W)."""
    steps = np.abs(np.diff(depths, axis=0))
    beside = np.zeros_like(steps)
    beside[1:] = steps[:-1]
    beside[:-1] = np.maximum(beside[:-1], steps[1:])
    leaps: BoolArray = (steps > 0.05 * np.minimum(depths[1:], depths[:-1])) & (steps > 2.0 * beside)
    return leaps


def _grown(mask: BoolArray, by_px: int) -> BoolArray:
    """The mask and all pixels at most `by_px` rows and columns from it."""
    grown = mask
    for axis in (0, 1):
        source = grown.copy()
        for step in range(1, by_px + 1):
            view, old = np.moveaxis(grown, axis, 0), np.moveaxis(source, axis, 0)
            view[step:] |= old[:-step]
            view[:-step] |= old[step:]
    return grown
