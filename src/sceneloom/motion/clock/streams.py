"""The streams of a drive that have a clock, and the comparison of two of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.errors import SceneloomError
from sceneloom.geometry.rotations import matrix_from_quaternion, rotate_vectors
from sceneloom.motion.clock.comparison import (
    LEVER_SIGMA,
    REACH_NS,
    ClockEstimate,
    ClockVerdict,
    compare_rotations,
    compare_trajectories,
    rate_noise,
)
from sceneloom.motion.clock.signals import (
    LEAST_KNOTS,
    Fixes,
    Orientations,
    RotationCurve,
    SmoothedTrajectory,
    TrajectorySamples,
    chunk_slices,
    number_chunks,
    on_ground,
)
from sceneloom.motion.imu import ACCELEROMETER, GYROSCOPE, usable_samples
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier, PointsFrame, Progress


class TrajectoryCurve:
    """A trajectory, which may drift slowly."""

    degree, window, model_sigma = 1, 30.0, 0.0

    def __init__(self, trajectory: Trajectory, origin_ns: int) -> None:
        """Lay cubic splines through positions and orientations; times are seconds after `origin_ns`."""
        from scipy.interpolate import CubicSpline

        times = trajectory.timestamps_ns
        self._chunks = [
            CubicSpline(seconds, trajectory.positions[piece, :2], extrapolate=False)
            for piece in chunk_slices(number_chunks(times))
            if len(seconds := (times[piece] - origin_ns) * 1e-9) >= LEAST_KNOTS
        ]
        rotations = trajectory.quaternions_xyzw
        self._rotating = (
            None if rotations is None else RotationCurve(Orientations.of_poses(times, rotations), origin_ns)
        )

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Give the trajectory at (N,) times [s]; the window does not matter."""
        del window
        locations, velocities = np.full((2, len(seconds)), np.nan, np.complex128)
        for curve in self._chunks:
            inside = (seconds >= curve.x[0]) & (seconds <= curve.x[-1])
            locations[inside] = on_ground(curve(seconds[inside]))
            velocities[inside] = on_ground(curve(seconds[inside], 1))
        no_drifts = np.zeros((len(seconds), 0), np.complex128)
        return TrajectorySamples(locations, velocities, self._axes(seconds), no_drifts, no_drifts, np.zeros(0))

    def finer(self, amounts: Float64Array) -> None:
        """Give none: it is the same for all windows."""
        del amounts

    def _axes(self, seconds: Float64Array) -> AnyArray:
        if self._rotating is None:
            return np.zeros((len(seconds), 3), np.complex128)
        rotations, _ = self._rotating.orientations(seconds)
        return _axes_from_above(rotations)


def _axes_from_above(quaternions_xyzw: Float64Array) -> AnyArray:
    matrices = matrix_from_quaternion(quaternions_xyzw)
    return np.asarray(matrices[:, 0] + 1j * matrices[:, 1])


_AROUND = 6.0
"""A dead_reckoning reaches so far beyond a window on both sides, so that offsets can be tried [s]."""


_GRAVITY = 9.8


_FORCE_BIAS, _RATE_BIAS = 0.5, 0.05
"""How large biases may be [m/s², rad/s]."""


_FORCE_NOISE, _RATE_NOISE = 3e-4, 3e-5
"""No unit is taken to be better [m/s²/√Hz, rad/s/√Hz]: what wanders slowly does not show from sample to sample."""


_FORCE_STEP, _RATE_STEP = 2.0, 4.0
"""Noise of forces and rates is known by one kick in so many seconds."""


_COMPONENTS = 24
"""All kicks in a window are reported by so many principal components of what they make of the trajectory.

The 24th is a hundred
times smaller than the first."""


_GRID = 1.0
"""What noise makes of the trajectory is known by a smooth curve through locations so many seconds apart."""


_LONG = 60.0
"""Seconds of the longer windows: twice as long ones know the offset a twentieth better."""


_Curve = Callable[..., AnyArray]
"""Gives values, or with a second argument derivatives, (N, C) at (N,) times [s]; NaN outside of its span."""


@dataclass(frozen=True, slots=True, eq=False)
class Unit:
    """What an IMU measured.

    Attributes:
        rates, forces: samples of the gyroscope and of the accelerometer.
        bias: (3,) taken off the rates [rad/s].
        force_noise, rate_noise: density of what its samples jump about [m/s²/√Hz, rad/s/√Hz].
    """

    rates: VectorSamples
    forces: VectorSamples
    bias: Float64Array
    force_noise: float
    rate_noise: float

    @classmethod
    def of(cls, rates: VectorSamples, forces: VectorSamples) -> "Unit":
        """Take samples, and report their noise."""
        rotating = Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3])
        rate_power = rate_noise(rotating) if len(rotating) else np.zeros(3)
        return cls(
            rates,
            forces,
            np.zeros(3),
            max(_force_noise(forces), _FORCE_NOISE),
            max(float(np.sqrt(np.where(np.isfinite(rate_power), rate_power, 0.0).mean())), _RATE_NOISE),
        )


def _force_noise(forces: VectorSamples) -> float:
    """The density of the white noise in forces, from second differences as `rate_noise` does."""
    times, values, _ = usable_samples(forces)
    if len(times) < LEAST_KNOTS:
        return 0.0
    deviations = 1.4826 * np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0) / np.sqrt(6.0)
    return float(np.sqrt((deviations**2).mean() * np.median(np.diff(times)) * 1e-9))


class DeadReckonedTrajectory:
    """What an IMU reports the trajectory: twice integrated, anew in each window.

    Where down is comes from the mean force in the window. Over short windows, what that leaves, as biases and the
    motion before, is a polynomial of third degree; over long ones each error is known by itself: tilt, biases, and
    noise, which kicks the velocity, the tilt and the heading every few seconds; of what all kicks of a window make of
    the trajectory, the largest principal components are taken.

    Source: Groves 2013, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 5.2, 5.7 and
    14.2: the mechanisation, the growth of errors with the second and third power of the time, and their equations;
    Loève 1948, "Fonctions aléatoires du second ordre": few components report a process that is mostly slow.
    """

    def __init__(self, unit: Unit, origin_ns: int, *, long: bool = False, rounds: int = 2) -> None:
        """Integrate the angular velocities; times are seconds after `origin_ns`.

        Args:
            long: whether for long windows.
            rounds: how often the biases that are found may be taken off.
        """
        self.degree, self.window = (1, _LONG) if long else (3, 20.0)
        # measured on synthetic streets with fixes of a centimetre, where nothing else is left
        self.model_sigma = 0.0005 if long else 0.004
        self._unit, self._origin_ns, self._long, self._rounds = unit, origin_ns, long, rounds
        rates = unit.rates
        rotating = Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3] - unit.bias)
        self._rotating = RotationCurve(rotating, origin_ns)
        times, self._forces, _ = usable_samples(unit.forces)
        self._seconds = np.asarray((times - origin_ns) * 1e-9, np.float64)
        self._known: dict[tuple[float, float], _DeadReckoning | None] = {}

    def finer(self, amounts: Float64Array) -> "DeadReckonedTrajectory | None":
        """Give the trajectory over long windows, of rates without the biases that came out, (W, E)."""
        if not self._long:
            return DeadReckonedTrajectory(self._unit, self._origin_ns, long=True)
        if not self._rounds:
            return None
        found = np.median(amounts[:, _RATE_BIASES], axis=0)
        unit = replace(self._unit, bias=self._unit.bias + found)
        return DeadReckonedTrajectory(unit, self._origin_ns, long=True, rounds=self._rounds - 1)

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Give the trajectory at (N,) times [s] in and around a window."""
        if window not in self._known:
            self._known[window] = self._dead_reckoned(window)
        dead_reckoning = self._known[window]
        held = self._held(window)
        if dead_reckoning is None:
            nothing = np.full((len(seconds), max(len(held), 3)), np.nan, np.complex128)
            drifts = nothing[:, : len(held)]
            return TrajectorySamples(nothing[:, 0], nothing[:, 0], nothing[:, :3], drifts, drifts, held)
        rotations, chunks = self._rotating.orientations(seconds)
        velocities, values = dead_reckoning.velocity(seconds), dead_reckoning.trajectory(seconds)
        values[chunks != dead_reckoning.piece] = np.nan
        axes = _across(dead_reckoning.level_from_start @ matrix_from_quaternion(rotations))
        drifts = np.hstack([values[:, 1:], dead_reckoning.noise(seconds)])
        drift_velocities = np.hstack([velocities[:, 1:], dead_reckoning.noise(seconds, 1)])
        return TrajectorySamples(values[:, 0], velocities[:, 0], axes, drifts, drift_velocities, held)

    def _held(self, window: tuple[float, float]) -> Float64Array:
        if not self._long:
            return np.full(3, np.inf)
        kicks = 2 * len(_kick_times(window, _FORCE_STEP)) + 3 * len(_kick_times(window, _RATE_STEP))
        parts = [(3, _FORCE_BIAS), (3, _RATE_BIAS), (2, np.inf), (min(kicks, _COMPONENTS), 1.0)]
        return np.concatenate([np.full(count, sigma) for count, sigma in parts])

    def _noise(
        self,
        window: tuple[float, float],
        span: tuple[float, float],
        velocity: _Curve,
        trajectory: _Curve,
    ) -> _Curve:
        """What the noise of the samples may make of the trajectory, as columns whose amounts are expected to be 1."""
        from scipy.interpolate import CubicSpline

        seconds = np.linspace(*span, max(4, round((span[1] - span[0]) / _GRID) + 1))
        if not self._long:
            return CubicSpline(seconds, np.zeros((len(seconds), 0), np.complex128), extrapolate=False)
        kicks = self._kicks(window, seconds, velocity, trajectory)
        vectors, sizes, _ = np.linalg.svd(np.vstack([kicks.real, kicks.imag]), full_matrices=False)
        columns = np.zeros((2 * len(seconds), min(kicks.shape[1], _COMPONENTS)))
        kept = min(len(sizes), columns.shape[1])
        columns[:, :kept] = vectors[:, :kept] * sizes[:kept]
        reported = columns[: len(seconds)] + 1j * columns[len(seconds) :]
        return CubicSpline(seconds, reported, extrapolate=False)

    def _kicks(
        self, window: tuple[float, float], seconds: Float64Array, velocity: _Curve, trajectory: _Curve
    ) -> AnyArray:
        """What kicks of velocity, tilt and heading, as large as the noise makes them, make of the trajectory later."""
        force, rate = (_kick_times(window, step) for step in (_FORCE_STEP, _RATE_STEP))
        force_size, rate_size = (
            noise * np.sqrt((window[1] - window[0]) / len(times))
            for noise, times in ((self._unit.force_noise, force), (self._unit.rate_noise, rate))
        )
        after_force, after_rate = (np.maximum(seconds[:, None] - at, 0.0) for at in (force, rate))
        moved, tilted = force_size * after_force, rate_size * 0.5 * _GRAVITY * after_rate**2
        inside = np.clip(rate, seconds[0], seconds[-1])
        since_kick = trajectory(seconds)[:, :1] - trajectory(inside)[:, 0] - velocity(inside)[:, 0] * after_rate
        rotated = rate_size * 1j * since_kick * (after_rate > 0)
        return np.hstack([moved, 1j * moved, tilted, 1j * tilted, rotated])

    def _dead_reckoned(self, window: tuple[float, float]) -> "_DeadReckoning | None":
        from scipy.interpolate import CubicSpline

        rows = slice(*np.searchsorted(self._seconds, [window[0] - _AROUND, window[1] + _AROUND]))
        seconds, forces = self._seconds[rows], self._forces[rows]
        rotations, chunks = self._rotating.orientations(seconds)
        within = chunks[(seconds >= window[0]) & (seconds < window[1])]
        if len(within) < LEAST_KNOTS or within[len(within) // 2] < 0:
            return None
        piece = int(within[len(within) // 2])
        inside = chunks == piece
        felt = rotate_vectors(rotations[inside], forces[inside])
        up = felt.mean(axis=0)
        if len(felt) < LEAST_KNOTS or not up.any():
            return None
        level_from_start = _levelling(up)
        since = seconds[inside] - 0.5 * sum(window)
        bodies = level_from_start @ matrix_from_quaternion(rotations[inside])
        errors = _long_errors if self._long else _short_errors
        columns = errors(since, felt @ level_from_start.T, bodies)
        velocity = CubicSpline(seconds[inside], columns, extrapolate=False).antiderivative()
        trajectory = velocity.antiderivative()
        span = float(seconds[inside][0]), float(seconds[inside][-1])
        return _DeadReckoning(
            piece, level_from_start, velocity, trajectory, self._noise(window, span, velocity, trajectory)
        )


def _kick_times(window: tuple[float, float], step: float) -> Float64Array:
    """When kicks begin, evenly in a window, about so many seconds apart."""
    length = window[1] - window[0]
    count = max(1, round(length / step))
    return np.asarray(window[0] + length / count * np.arange(count), np.float64)


_RATE_BIASES = slice(3, 6)
"""Which drifts over long windows are those of the gyroscope's biases."""


def _short_errors(since: Float64Array, felt: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), what biases of the forces along two axes add, and a bias of the rate about the vertical."""
    accelerations, axes = on_ground(felt), _across(bodies)
    return np.stack([accelerations, axes[:, 0], axes[:, 1], 1j * since * accelerations], axis=1)


def _long_errors(since: Float64Array, felt: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), and what biases of three forces and of three rates taken off, and a tilt about two axes, add.

    A small rotation ψ taken off the orientation adds f × ψ to the force f.
    """
    accelerations, up, axes = on_ground(felt), felt[:, 2:], _across(bodies)
    rotated, spun = _integral(since, axes), _integral(since, bodies[:, 2])
    rates = 1j * (up * rotated - spun * accelerations[:, None])
    return np.hstack([accelerations[:, None], axes, rates, up, 1j * up])


def _integral(seconds: Float64Array, values: AnyArray) -> AnyArray:
    """The integral of (N, K) values from the time 0 on, by trapezia."""
    steps = 0.5 * np.diff(seconds)[:, None] * (values[1:] + values[:-1])
    total = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
    return np.asarray(total - total[int(np.argmin(np.abs(seconds)))])


@dataclass(frozen=True, slots=True, eq=False)
class _DeadReckoning:
    """A window: velocity and trajectory as curves with the effect of errors and noise, and their frame."""

    piece: int
    level_from_start: Float64Array
    velocity: _Curve
    trajectory: _Curve
    noise: _Curve


def _across(bodies: Float64Array) -> AnyArray:
    """The axes (N, 3) of bodies (N, 3, 3) seen from above."""
    return np.asarray(bodies[:, 0] + 1j * bodies[:, 1])


def _levelling(up: Float64Array) -> Float64Array:
    """The smallest rotation (3, 3) that takes a direction to z."""
    unit = up / np.linalg.norm(up)
    half = np.array([unit[1], -unit[0], 0.0, 1.0 + unit[2]])
    if half[3] < 1e-9:
        half = np.array([1.0, 0.0, 0.0, 0.0])
    return matrix_from_quaternion(half / np.linalg.norm(half))


class StreamKind(StrEnum):
    """What a stream is."""

    IMU = "imu"
    TRAJECTORY = "trajectory"
    LIDAR = "lidar"
    CAMERA = "camera"
    GNSS = "gnss"


@dataclass(frozen=True, slots=True, eq=False)
class _ReportedMotion:
    """What a stream reports the ego's motion.

    Attributes:
        rotating: how it rotated, or None.
        fixes: where it was, or None.
        trajectory: makes the trajectory from the time that its seconds count from, or None.
        ego_from_body: (3, 3), the rotation from the body that becomes the ego's frame, as far as it is known.
        location: (3,) [m], where on the ego the fixes are of, where that is known.
        why_not: why it reports neither.
    """

    rotating: Orientations | None = None
    fixes: Fixes | None = None
    trajectory: Callable[[int], SmoothedTrajectory] | None = None
    ego_from_body: Float64Array | None = None
    location: Float64Array | None = None
    why_not: str = ""


@dataclass(slots=True, eq=False)
class Stream:
    """One stream of a drive.

    Attributes:
        name: id of the sensor, or name of the trajectory; with its kind before it where two are named alike.
        kind: what it is.
        source: the sensor or the trajectory.
        scene: the drive that it is of.
    """

    name: str
    kind: StreamKind
    source: Any
    scene: Scene
    _reported: _ReportedMotion | None = field(default=None)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Its first and last timestamp [ns]; None where it has none."""
        source = self.source.streams[GYROSCOPE] if self.kind is StreamKind.IMU else self.source
        times = source.timestamps_ns if hasattr(source, "timestamps_ns") else frame_times(source)
        return (int(times.min()), int(times.max())) if len(times) else None

    def meets(self, other: "Stream", reach_ns: int) -> bool:
        """Whether the timestamps of both have time in common, if one is shifted by so much at most [ns]."""
        mine, others = self.span_ns, other.span_ns
        if mine is None or others is None:
            return False
        return max(mine[0], others[0]) <= min(mine[1], others[1]) + reach_ns

    def reported(self, progress: Progress | None = None) -> _ReportedMotion:
        """What it reports the motion; worked out once, which for images and sweeps takes long.

        Args:
            progress: reported how many frames have been looked at.
        """
        if self._reported is None:
            try:
                self._reported = _TELLERS[self.kind](self, progress)
            except SceneloomError as error:
                self._reported = _ReportedMotion(why_not=str(error))
        return self._reported


def streams_of(scene: Scene) -> tuple[Stream, ...]:
    """The streams of a drive: IMUs with a gyroscope, trajectories, lidars, cameras and satellite receivers."""
    found: list[tuple[StreamKind, Identifier, Any]] = [
        *(
            (StreamKind.IMU, sensor.id, sensor)
            for sensor in scene.sensors
            if isinstance(sensor, ImuSensor) and GYROSCOPE in sensor.streams
        ),
        *((StreamKind.TRAJECTORY, name, trajectory) for name, trajectory in scene.trajectories.items()),
        *((StreamKind.LIDAR, lidar.id, lidar) for lidar in scene.lidars if len(lidar.frames)),
        *((StreamKind.CAMERA, camera.id, camera) for camera in scene.cameras if len(camera.images)),
        *((StreamKind.GNSS, sensor.id, sensor) for sensor in scene.sensors if isinstance(sensor, GnssSensor)),
    ]
    texts = [str(name) for _, name, _ in found]
    return tuple(
        Stream(text if texts.count(text) == 1 else f"{kind}:{text}", kind, source, scene)
        for (kind, _, source), text in zip(found, texts, strict=True)
    )


def _of_imu(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    del progress
    imu: ImuSensor = stream.source
    rates, forces = imu.streams[GYROSCOPE], imu.streams.get(ACCELEROMETER)
    rotating = Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3])
    if forces is None:
        return _ReportedMotion(rotating)
    return _ReportedMotion(
        rotating, trajectory=lambda origin_ns: DeadReckonedTrajectory(Unit.of(rates, forces), origin_ns)
    )


def _of_trajectory(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    del progress
    return _trajectory_reported(stream.source)


def _trajectory_reported(trajectory: Trajectory) -> _ReportedMotion:
    rotations = trajectory.quaternions_xyzw
    return _ReportedMotion(
        None if rotations is None else Orientations.of_poses(trajectory.timestamps_ns, rotations),
        Fixes.of_trajectory(trajectory),
        lambda origin_ns: TrajectoryCurve(trajectory, origin_ns),
    )


def _of_lidar(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    from sceneloom.motion.odometry import lidar_odometry

    lidar: LidarSensor = stream.source
    if lidar.points_frame is PointsFrame.WORLD:
        return _ReportedMotion(why_not="its points are in the world already, by a clock that is not reported")
    alone = replace(stream.scene, sensors=(lidar,), annotations=(), attributes=())
    return _trajectory_reported(lidar_odometry(alone, progress=progress, lenient=True).trajectory)


def _of_camera(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    from sceneloom.motion.clock.camera_rotation import camera_rotation

    camera: CameraSensor = stream.source
    rotating = camera_rotation(camera, progress=progress)
    return _ReportedMotion(rotating, ego_from_body=None if camera.mount is None else camera.mount.rotation)


def _of_receiver(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    del progress
    receiver: GnssSensor = stream.source
    return _ReportedMotion(
        fixes=Fixes.of_receiver(receiver),
        location=None if receiver.mount is None else receiver.mount.translation,
    )


_TELLERS: Mapping[StreamKind, Callable[[Stream, Progress | None], _ReportedMotion]] = MappingProxyType(
    {
        StreamKind.IMU: _of_imu,
        StreamKind.TRAJECTORY: _of_trajectory,
        StreamKind.LIDAR: _of_lidar,
        StreamKind.CAMERA: _of_camera,
        StreamKind.GNSS: _of_receiver,
    }
)
"""How each kind of stream reports the motion."""

_KNOWN_LEVER_SIGMA = 0.05
"""How well a stated mounting of an antenna is known on each axis [m]."""


class Method(StrEnum):
    """By what two streams were compared."""

    ROTATION = "rotation"
    TRAJECTORY = "trajectory"
    NONE = "none"


def compare_streams(
    reference: Stream,
    stream: Stream,
    *,
    reach_ns: int = REACH_NS,
    lever_sigma: float = LEVER_SIGMA,
    progress: Progress | None = None,
) -> tuple[Method, ClockEstimate]:
    """Find how the clock of one stream goes against that of another.

    By how the ego rotated, where both report it; else by where it was.

    Args:
        reach_ns: offsets up to this are looked for [ns].
        lever_sigma: how far from the ego's origin a receiver's antenna may be on each axis, where no mounting is
            stated [m].
        progress: reported while images or sweeps are looked at.
    """
    if not stream.meets(reference, reach_ns):
        return Method.NONE, ClockEstimate.unknown("their timestamps have no time in common")
    first, second = reference.reported(progress), stream.reported(progress)
    for name, reported in ((reference.name, first), (stream.name, second)):
        if reported.why_not:
            return Method.NONE, ClockEstimate.unknown(f"{name}: {reported.why_not}")
    by_rotation: ClockEstimate | None = None
    if first.rotating is not None and second.rotating is not None:
        by_rotation = compare_rotations(
            first.rotating, second.rotating, reach_ns=reach_ns, reference_from_stream=_between(first, second)
        )
        if by_rotation.verdict is not ClockVerdict.NOT_OBSERVABLE:
            return Method.ROTATION, by_rotation
    by_trajectory = _by_trajectory(first, second, reach_ns=reach_ns, lever_sigma=lever_sigma)
    if by_trajectory is not None and (by_rotation is None or by_trajectory.verdict is not ClockVerdict.NOT_OBSERVABLE):
        return Method.TRAJECTORY, by_trajectory
    if by_rotation is not None:
        return Method.ROTATION, by_rotation
    return Method.NONE, ClockEstimate.unknown("the one reports only where it was, the other only how it rotated")


def _between(reference: _ReportedMotion, stream: _ReportedMotion) -> Float64Array:
    """The rotation from the stream's body into the reference's, as far as their mountings state it."""
    identity = np.eye(3)
    into_ego = identity if stream.ego_from_body is None else stream.ego_from_body
    from_ego = identity if reference.ego_from_body is None else reference.ego_from_body.T
    return np.asarray(from_ego @ into_ego, np.float64)


def _by_trajectory(
    reference: _ReportedMotion, stream: _ReportedMotion, *, reach_ns: int, lever_sigma: float
) -> ClockEstimate | None:
    """Compare fixes with a trajectory, where one has the one and the other the other."""
    for reported, trajectory_from, fixes_are_reference in (
        (stream, reference.trajectory, False),
        (reference, stream.trajectory, True),
    ):
        fixes = reported.fixes
        if fixes is not None and trajectory_from is not None and len(fixes):
            origin_ns = int(fixes.timestamps_ns[0])
            return compare_trajectories(
                fixes,
                trajectory_from(origin_ns),
                origin_ns=origin_ns,
                fixes_are_reference=fixes_are_reference,
                reach_ns=reach_ns,
                lever=reported.location,
                lever_sigma=lever_sigma if reported.location is None else min(lever_sigma, _KNOWN_LEVER_SIGMA),
            )
    return None


def gyroscope_against_trajectory(
    gyroscope: VectorSamples, trajectory: Trajectory, *, reach_ns: int = REACH_NS
) -> ClockEstimate:
    """Find how the timestamps of a trajectory lie against those of the gyroscope that rides along.

    Args:
        gyroscope: angular velocities (N, 3) [rad/s] in the ego's frame; rows that are no numbers are left out.
        trajectory: `world_from_ego`.
        reach_ns: offsets up to this are looked for [ns].

    Returns:
        The trajectory's clock against the gyroscope's. A minute of 100 Hz takes a few tenths of a second.
    """
    if trajectory.quaternions_xyzw is None:
        return ClockEstimate.unknown(f"trajectory {trajectory.name!r} has no orientations")
    rates = Orientations.of_rates(gyroscope.timestamps_ns, gyroscope.values[:, :3])
    orientations = Orientations.of_poses(trajectory.timestamps_ns, trajectory.quaternions_xyzw)
    return compare_rotations(rates, orientations, reach_ns=reach_ns)
