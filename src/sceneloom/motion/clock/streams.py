"""The streams of a drive that have a clock, the trajectories that they measure, and the comparison of two of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.errors import SceneloomError
from sceneloom.geometry.rigid import matrix_from_quaternion, rotate_vectors
from sceneloom.motion.clock.comparison import (
    LEVER_SIGMA,
    REACH_NS,
    TOLERANCE_NS,
    ClockEstimate,
    ClockVerdict,
    compare_rotations,
    compare_trajectories,
)
from sceneloom.motion.clock.signals import (
    LEAST_KNOTS,
    Fixes,
    Orientations,
    RotationCurve,
    SmoothedTrajectory,
    TrajectorySamples,
    from_above,
)
from sceneloom.motion.imu import ACCELEROMETER, GYROSCOPE, usable_samples
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier, PointsFrame, Progress

_KNOWN_LEVER_SIGMA = 0.05  # standard deviation of a known antenna position on each axis [m]


class StreamKind(StrEnum):
    """What a stream is."""

    IMU = "imu"
    TRAJECTORY = "trajectory"
    LIDAR = "lidar"
    CAMERA = "camera"
    GNSS = "gnss"


class Method(StrEnum):
    """By what two streams were compared."""

    ROTATION = "rotation"
    TRAJECTORY = "trajectory"
    NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """The ego's motion as a stream measures it."""

    orientations: Orientations | None = None  # of the body, or None
    fixes: Fixes | None = None  # positions, or None
    trajectory: Callable[[int], SmoothedTrajectory] | None = None  # with times in seconds after its argument [ns]
    ego_from_body: Float64Array | None = None  # (3, 3), as far as known
    location: Float64Array | None = None  # (3,) [m], where on the ego the fixes are measured, or None
    why_not: str = ""  # why there is no motion


@dataclass(slots=True, eq=False)
class Stream:
    """One stream of a drive.

    Attributes:
        name: id of the sensor, or name of the trajectory; prefixed with its kind where two have the same name.
        kind: what it is.
        source: the sensor or the trajectory.
        scene: the drive.
    """

    name: str
    kind: StreamKind
    source: Any
    scene: Scene
    _motion: _Motion | None = field(default=None)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """First and last timestamp [ns]; None where it has none."""
        source = self.source.streams[GYROSCOPE] if self.kind is StreamKind.IMU else self.source
        times = source.timestamps_ns if hasattr(source, "timestamps_ns") else frame_times(source)
        return (int(times.min()), int(times.max())) if len(times) else None

    def motion(self, progress: Progress | None = None) -> _Motion:
        """The motion that it measures; computed once, which takes long for images and sweeps.

        Args:
            progress: called with the number of frames done.
        """
        if self._motion is None:
            try:
                self._motion = _MOTIONS[self.kind](self, progress)
            except SceneloomError as error:
                self._motion = _Motion(why_not=str(error))
        return self._motion


def streams_of(scene: Scene) -> tuple[Stream, ...]:
    """The streams of a drive: IMUs with a gyroscope, trajectories, lidars, cameras and GNSS receivers."""
    imus = [s for s in scene.sensors if isinstance(s, ImuSensor) and GYROSCOPE in s.streams]
    found: list[tuple[StreamKind, Identifier, Any]] = [
        *((StreamKind.IMU, imu.id, imu) for imu in imus),
        *((StreamKind.TRAJECTORY, name, trajectory) for name, trajectory in scene.trajectories.items()),
        *((StreamKind.LIDAR, lidar.id, lidar) for lidar in scene.lidars if len(lidar.frames)),
        *((StreamKind.CAMERA, camera.id, camera) for camera in scene.cameras if len(camera.images)),
        *((StreamKind.GNSS, sensor.id, sensor) for sensor in scene.sensors if isinstance(sensor, GnssSensor)),
    ]
    names = [str(name) for _, name, _ in found]
    return tuple(
        Stream(name if names.count(name) == 1 else f"{kind}:{name}", kind, source, scene)
        for (kind, _, source), name in zip(found, names, strict=True)
    )


def _imu_motion(stream: Stream, _: Progress | None) -> _Motion:
    imu: ImuSensor = stream.source
    rates, forces = imu.streams[GYROSCOPE], imu.streams.get(ACCELEROMETER)
    orientations = Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3])
    if forces is None:
        return _Motion(orientations)
    return _Motion(
        orientations, trajectory=lambda origin_ns: DeadReckonedTrajectory(ImuSamples.of(rates, forces), origin_ns)
    )


def _trajectory_motion(trajectory: Trajectory) -> _Motion:
    rotations = trajectory.quaternions_xyzw
    return _Motion(
        None if rotations is None else Orientations.of_poses(trajectory.timestamps_ns, rotations),
        Fixes.of_trajectory(trajectory),
        lambda origin_ns: TrajectoryCurve(trajectory, origin_ns),
    )


def _lidar_motion(stream: Stream, progress: Progress | None) -> _Motion:
    from sceneloom.motion.odometry import lidar_odometry

    lidar: LidarSensor = stream.source
    if lidar.points_frame is PointsFrame.WORLD:
        return _Motion(why_not="its points are in world coordinates; the clock of that transform is unknown")
    alone = replace(stream.scene, sensors=(lidar,), annotations=(), attributes=())
    return _trajectory_motion(lidar_odometry(alone, progress=progress, lenient=True).trajectory)


def _camera_motion(stream: Stream, progress: Progress | None) -> _Motion:
    from sceneloom.motion.camera_rotation import camera_rotation

    mount = stream.source.mount
    orientations = camera_rotation(stream.source, progress=progress)
    return _Motion(orientations, ego_from_body=None if mount is None else mount.rotation)


def _receiver_motion(stream: Stream, _: Progress | None) -> _Motion:
    mount = stream.source.mount
    return _Motion(fixes=Fixes.of_receiver(stream.source), location=None if mount is None else mount.translation)


_MOTIONS: Mapping[StreamKind, Callable[[Stream, Progress | None], _Motion]] = MappingProxyType(
    {
        StreamKind.IMU: _imu_motion,
        StreamKind.TRAJECTORY: lambda stream, _: _trajectory_motion(stream.source),
        StreamKind.LIDAR: _lidar_motion,
        StreamKind.CAMERA: _camera_motion,
        StreamKind.GNSS: _receiver_motion,
    }
)


def compare_streams(
    reference: Stream,
    stream: Stream,
    *,
    reach_ns: int = REACH_NS,
    tolerance_ns: int = TOLERANCE_NS,
    lever_sigma: float = LEVER_SIGMA,
    progress: Progress | None = None,
) -> tuple[Method, ClockEstimate]:
    """Estimate offset and skew of a stream's clock against that of a reference.

    By the rotation of the ego, where both measure it; else by its positions.

    Args:
        reach_ns: largest offset that is searched [ns].
        tolerance_ns: largest offset that counts as in step [ns].
        lever_sigma: standard deviation of the antenna's position on the ego on each axis, where it is unknown [m].
        progress: called while images or sweeps are processed.
    """
    spans = [span for span in (reference.span_ns, stream.span_ns) if span is not None]
    if len(spans) < 2 or max(first for first, _ in spans) > min(last for _, last in spans) + reach_ns:
        return Method.NONE, ClockEstimate.unknown("their timestamps have no time in common")
    first, second = reference.motion(progress), stream.motion(progress)
    for name, motion in ((reference.name, first), (stream.name, second)):
        if motion.why_not:
            return Method.NONE, ClockEstimate.unknown(f"{name}: {motion.why_not}")
    by_rotation: ClockEstimate | None = None
    if first.orientations is not None and second.orientations is not None:
        ego_from_stream, ego_from_reference = (
            np.eye(3) if motion.ego_from_body is None else motion.ego_from_body for motion in (second, first)
        )
        by_rotation = compare_rotations(
            first.orientations,
            second.orientations,
            reach_ns=reach_ns,
            tolerance_ns=tolerance_ns,
            reference_from_stream=ego_from_reference.T @ ego_from_stream,
        )
        if by_rotation.verdict is not ClockVerdict.NOT_OBSERVABLE:
            return Method.ROTATION, by_rotation
    by_trajectory = _by_trajectory(first, second, reach_ns, tolerance_ns, lever_sigma)
    if by_trajectory is not None and (by_rotation is None or by_trajectory.verdict is not ClockVerdict.NOT_OBSERVABLE):
        return Method.TRAJECTORY, by_trajectory
    if by_rotation is not None:
        return Method.ROTATION, by_rotation
    return Method.NONE, ClockEstimate.unknown("one measures only positions, the other only rotation")


def _by_trajectory(
    reference: _Motion, stream: _Motion, reach_ns: int, tolerance_ns: int, lever_sigma: float
) -> ClockEstimate | None:
    """Compare fixes with a trajectory, where one stream has fixes and the other a trajectory."""
    for measured, trajectory, fixes_are_reference in (
        (stream, reference.trajectory, False),
        (reference, stream.trajectory, True),
    ):
        fixes, lever = measured.fixes, measured.location
        if fixes is not None and trajectory is not None and len(fixes):
            origin_ns = int(fixes.timestamps_ns[0])
            return compare_trajectories(
                fixes,
                trajectory(origin_ns),
                origin_ns=origin_ns,
                fixes_are_reference=fixes_are_reference,
                reach_ns=reach_ns,
                tolerance_ns=tolerance_ns,
                lever=lever,
                lever_sigma=lever_sigma if lever is None else min(lever_sigma, _KNOWN_LEVER_SIGMA),
            )
    return None


class TrajectoryCurve:
    """A recorded trajectory, which may drift slowly: cubic splines through its poses."""

    degree, window, model_sigma = 1, 30.0, 0.0

    def __init__(self, trajectory: Trajectory, origin_ns: int) -> None:
        """Fit the splines; times are seconds after `origin_ns`."""
        from scipy.interpolate import CubicSpline

        times, rotations = trajectory.timestamps_ns, trajectory.quaternions_xyzw
        level = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        orientations = Orientations.of_poses(times, level if rotations is None else rotations)
        self._chunks = [
            CubicSpline(seconds, trajectory.positions[rows, :2], extrapolate=False)
            for rows in orientations.parts
            if len(seconds := (times[rows] - origin_ns) * 1e-9) >= LEAST_KNOTS
        ]
        self._rotation = None if rotations is None else RotationCurve(orientations, origin_ns)

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Evaluate at (N,) times [s]; the window does not matter."""
        del window
        locations, velocities = np.full((2, len(seconds)), np.nan, np.complex128)
        for curve in self._chunks:
            inside = (seconds >= curve.x[0]) & (seconds <= curve.x[-1])
            locations[inside] = from_above(curve(seconds[inside]))
            velocities[inside] = from_above(curve(seconds[inside], 1))
        axes = np.zeros((len(seconds), 3), np.complex128)
        if self._rotation is not None:
            axes = from_above(matrix_from_quaternion(self._rotation.orientations(seconds)[0]))
        no_drifts = np.zeros((len(seconds), 0), np.complex128)
        return TrajectorySamples(locations, velocities, axes, no_drifts, no_drifts, np.zeros(0))

    def finer(self, amounts: Float64Array) -> None:
        """None: it is the same for all windows."""
        del amounts


_MARGIN = 6.0  # dead reckoning extends so far beyond a window on both sides, so that offsets can be tried [s]
_GRAVITY = 9.8
_FORCE_BIAS, _RATE_BIAS = 0.5, 0.05  # standard deviations of the biases [m/s², rad/s]

_FORCE_NOISE, _RATE_NOISE = 3e-4, 3e-5
"""Least densities assumed [m/s²/√Hz, rad/s/√Hz]: slow wander does not show from sample to sample."""

_FORCE_STEP, _RATE_STEP = 2.0, 4.0  # seconds between the kicks that stand for the noise of forces and rates

_COMPONENTS = 24
"""Principal components kept of the effects of all kicks in a window; the 24th is a hundred times smaller than the
first."""

_GRID = 1.0  # seconds between the knots of the effects of noise
_LONG_WINDOW = 60.0  # seconds of the longer windows: doubling them would improve the offset by a twentieth
_RATE_BIASES = slice(3, 6)  # the drifts over long windows that are the gyroscope's biases

_Curve = Callable[..., AnyArray]
"""Gives values, or with a second argument derivatives, (N, C) at (N,) times [s]; NaN outside its span."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Samples of an IMU.

    Attributes:
        rates, forces: samples of the gyroscope and of the accelerometer.
        bias: (3,) subtracted from the rates [rad/s].
        force_noise, rate_noise: noise densities [m/s²/√Hz, rad/s/√Hz].
    """

    rates: VectorSamples
    forces: VectorSamples
    bias: Float64Array
    force_noise: float
    rate_noise: float

    @classmethod
    def of(cls, rates: VectorSamples, forces: VectorSamples) -> "ImuSamples":
        """Take samples, and estimate their noise."""
        orientations = Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3])
        power = orientations.rate_noise() if len(orientations) else np.zeros(3)
        rate_noise = float(np.sqrt(np.where(np.isfinite(power), power, 0.0).mean()))
        times, values, _ = usable_samples(forces)
        force_noise = 0.0
        if len(times) >= LEAST_KNOTS:
            deviations = 1.4826 * np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0) / np.sqrt(6.0)
            force_noise = float(np.sqrt((deviations**2).mean() * np.median(np.diff(times)) * 1e-9))
        return cls(rates, forces, np.zeros(3), max(force_noise, _FORCE_NOISE), max(rate_noise, _RATE_NOISE))


@dataclass(frozen=True, slots=True, eq=False)
class _DeadReckoning:
    """One window: velocity and position with the effects of errors in the columns after the first, and of noise."""

    chunk: int
    level_from_start: Float64Array
    velocity: _Curve
    position: _Curve
    noise: _Curve


class DeadReckonedTrajectory:
    """The trajectory from an IMU: integrated twice, anew in each window.

    The vertical is taken from the mean force in the window. Over short windows the remaining errors, biases and
    initial motion are a cubic polynomial. Over long ones each error is modelled by itself: tilt, biases, and noise,
    which kicks velocity, tilt and heading every few seconds; of the effects of all kicks in a window the largest
    principal components are kept.

    Source: Groves 2013, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 5.2, 5.7 and
    14.2: the mechanisation, the growth of errors with the second and third power of the time, and their equations;
    Loève 1948, "Fonctions aléatoires du second ordre": few components describe a process that is mostly slow.
    """

    def __init__(self, imu: ImuSamples, origin_ns: int, *, long: bool = False, rounds: int = 2) -> None:
        """Integrate the angular velocities; times are seconds after `origin_ns`.

        `long`: whether for long windows; `rounds`: how often estimated biases may still be subtracted.
        """
        self.degree, self.window = (1, _LONG_WINDOW) if long else (3, 20.0)
        # measured on synthetic streets with fixes of a centimetre, where nothing else is left
        self.model_sigma = 0.0005 if long else 0.004
        self._imu, self._origin_ns, self._long, self._rounds = imu, origin_ns, long, rounds
        rates = imu.rates
        self._rotation = RotationCurve(
            Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3] - imu.bias), origin_ns
        )
        times, self._forces, _ = usable_samples(imu.forces)
        self._seconds = np.asarray((times - origin_ns) * 1e-9, np.float64)
        self._known: dict[tuple[float, float], _DeadReckoning | None] = {}

    def finer(self, amounts: Float64Array) -> "DeadReckonedTrajectory | None":
        """The trajectory over long windows, from rates without the biases that were estimated, (W, E)."""
        if not self._long:
            return DeadReckonedTrajectory(self._imu, self._origin_ns, long=True)
        if not self._rounds:
            return None
        imu = replace(self._imu, bias=self._imu.bias + np.median(amounts[:, _RATE_BIASES], axis=0))
        return DeadReckonedTrajectory(imu, self._origin_ns, long=True, rounds=self._rounds - 1)

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Evaluate at (N,) times [s] in and around a window."""
        if window not in self._known:
            self._known[window] = self._integrate(window)
        known, sigmas = self._known[window], self._drift_sigmas(window)
        if known is None:
            nothing = np.full((len(seconds), max(len(sigmas), 3)), np.nan, np.complex128)
            drifts = nothing[:, : len(sigmas)]
            return TrajectorySamples(nothing[:, 0], nothing[:, 0], nothing[:, :3], drifts, drifts, sigmas)
        rotations, chunks = self._rotation.orientations(seconds)
        velocities, positions = known.velocity(seconds), known.position(seconds)
        positions[chunks != known.chunk] = np.nan
        axes = from_above(known.level_from_start @ matrix_from_quaternion(rotations))
        drifts = np.hstack([positions[:, 1:], known.noise(seconds)])
        drift_velocities = np.hstack([velocities[:, 1:], known.noise(seconds, 1)])
        return TrajectorySamples(positions[:, 0], velocities[:, 0], axes, drifts, drift_velocities, sigmas)

    def _drift_sigmas(self, window: tuple[float, float]) -> Float64Array:
        if not self._long:
            return np.full(3, np.inf)
        kicks = 2 * len(_kick_times(window, _FORCE_STEP)) + 3 * len(_kick_times(window, _RATE_STEP))
        return np.repeat([_FORCE_BIAS, _RATE_BIAS, np.inf, 1.0], [3, 3, 2, min(kicks, _COMPONENTS)])

    def _integrate(self, window: tuple[float, float]) -> _DeadReckoning | None:
        from scipy.interpolate import CubicSpline

        rows = slice(*np.searchsorted(self._seconds, [window[0] - _MARGIN, window[1] + _MARGIN]))
        seconds, forces = self._seconds[rows], self._forces[rows]
        rotations, chunks = self._rotation.orientations(seconds)
        within = chunks[(seconds >= window[0]) & (seconds < window[1])]
        if len(within) < LEAST_KNOTS or within[len(within) // 2] < 0:
            return None
        chunk = int(within[len(within) // 2])
        inside = chunks == chunk
        seconds = seconds[inside]
        forces_start = rotate_vectors(rotations[inside], forces[inside])
        up = forces_start.mean(axis=0)
        if len(forces_start) < LEAST_KNOTS or not up.any():
            return None
        level_from_start = _levelling(up)
        bodies = level_from_start @ matrix_from_quaternion(rotations[inside])
        errors = _long_errors if self._long else _short_errors
        columns = errors(seconds - 0.5 * sum(window), forces_start @ level_from_start.T, bodies)
        velocity = CubicSpline(seconds, columns, extrapolate=False).antiderivative()
        position = velocity.antiderivative()
        knots = np.linspace(seconds[0], seconds[-1], max(4, round(float(seconds[-1] - seconds[0]) / _GRID) + 1))
        effects = np.zeros((len(knots), 0), np.complex128)
        if self._long:
            effects = self._noise_effects(window, knots, velocity, position)
        noise = CubicSpline(knots, effects, extrapolate=False)
        return _DeadReckoning(chunk, level_from_start, velocity, position, noise)

    def _noise_effects(
        self, window: tuple[float, float], seconds: Float64Array, velocity: _Curve, position: _Curve
    ) -> AnyArray:
        """Principal components of the positions after kicks of velocity, tilt and heading as large as the noise."""
        force, rate = (_kick_times(window, step) for step in (_FORCE_STEP, _RATE_STEP))
        force_size, rate_size = (
            noise * np.sqrt((window[1] - window[0]) / len(times))
            for noise, times in ((self._imu.force_noise, force), (self._imu.rate_noise, rate))
        )
        after_force, after_rate = (np.maximum(seconds[:, None] - at, 0.0) for at in (force, rate))
        moved, tilted = force_size * after_force, rate_size * 0.5 * _GRAVITY * after_rate**2
        inside = np.clip(rate, seconds[0], seconds[-1])
        since_kick = position(seconds)[:, :1] - position(inside)[:, 0] - velocity(inside)[:, 0] * after_rate
        rotated = rate_size * 1j * since_kick * (after_rate > 0)
        kicks = np.hstack([moved, 1j * moved, tilted, 1j * tilted, rotated])
        vectors, sizes, _ = np.linalg.svd(np.vstack([kicks.real, kicks.imag]), full_matrices=False)
        columns = np.zeros((2 * len(seconds), min(kicks.shape[1], _COMPONENTS)))
        kept = min(len(sizes), columns.shape[1])
        columns[:, :kept] = vectors[:, :kept] * sizes[:kept]
        return np.asarray(columns[: len(seconds)] + 1j * columns[len(seconds) :])


def _kick_times(window: tuple[float, float], step: float) -> Float64Array:
    """When kicks begin, evenly in a window, about `step` seconds apart."""
    length = window[1] - window[0]
    count = max(1, round(length / step))
    return np.asarray(window[0] + length / count * np.arange(count), np.float64)


def _short_errors(since: Float64Array, forces: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), and the effects of two force biases and of a rate bias about the vertical."""
    accelerations, axes = from_above(forces), from_above(bodies)
    return np.stack([accelerations, axes[:, 0], axes[:, 1], 1j * since * accelerations], axis=1)


def _long_errors(since: Float64Array, forces: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), and the effects of three force biases, three rate biases subtracted, and two tilts."""
    # a small rotation ψ subtracted from the orientation adds f x ψ to the force f
    accelerations, up, axes = from_above(forces), forces[:, 2:], from_above(bodies)
    rotated, spun = _integral(since, axes), _integral(since, bodies[:, 2])
    rates = 1j * (up * rotated - spun * accelerations[:, None])
    return np.hstack([accelerations[:, None], axes, rates, up, 1j * up])


def _integral(seconds: Float64Array, values: AnyArray) -> AnyArray:
    """The integral of (N, K) values from time 0, by the trapezoidal rule."""
    steps = 0.5 * np.diff(seconds)[:, None] * (values[1:] + values[:-1])
    total = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
    return np.asarray(total - total[int(np.argmin(np.abs(seconds)))])


def _levelling(up: Float64Array) -> Float64Array:
    """The smallest rotation (3, 3) that takes a direction to z."""
    unit = up / np.linalg.norm(up)
    half = np.array([unit[1], -unit[0], 0.0, 1.0 + unit[2]])
    if half[3] < 1e-9:
        half = np.array([1.0, 0.0, 0.0, 0.0])
    return matrix_from_quaternion(half / np.linalg.norm(half))
