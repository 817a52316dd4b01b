"""Extrinsics of a lidar on the ego: hand-eye calibration of lidar odometry against a trajectory.

Both devices move as one. From one time to another the body moves by A and the sensor by B, each as seen by itself, and
the mounting X = body_from_sensor takes one into the other: A X = X B. Rotations give R_A R_X = R_X R_B, so the rotation
vectors obey a = R_X b; translations give t_A + R_A t_X = R_X t_B + t_X. A car on a plane rotates about one axis only:
its rotations leave the rotation about that axis free, which its trajectory forward reports, and no motion of it reports
the height.

Source: Shiu and Ahmad 1989 for the equation; Park and Martin 1994 for rotation vectors and the closed form of the
rotation; Horaud and Dornaika 1995 for rotation and translation together; the weights are those of Holland and Welsch
1977, the covariance is the sandwich of Liang and Zeger 1986 with stretches of the drive as clusters.
"""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.calibrate.extrinsics import MountingEstimate, moved_by, step_between, unobserved_directions
from sceneloom.calibrate.frames import chosen_lidar
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.clock.comparison import ClockEstimate, ClockVerdict, compare_rotations
from sceneloom.motion.clock.signals import Orientations
from sceneloom.motion.ego_trajectory import LIDAR, find_ego_motion, gnss_receivers
from sceneloom.motion.odometry import lidar_odometry
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, PointsFrame, Progress

_LEAST_MOTIONS = 6

_LAGS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Seconds from one pose to the other of a pair: long ones rotate far, short ones have not drifted."""

_STEPS = 30

_CAUCHY = 2.385
"""The Cauchy weight that keeps 95 % of the efficiency on Gaussian errors (Holland and Welsch 1977)."""

_GUESS_SIGMAS = np.array([*np.full(3, np.pi), *np.full(3, 3.0)])
"""How far from the guess a mounting may be [rad], [m]: keeps what no motion reports where it was."""

_LEAST_NOISE = np.array([np.radians(0.01), 5e-3])
"""No way is reported better than this over a lag [rad], [m].

What is wrong in all of a drive alike is not in its spread.
"""

_SYSTEMATIC = np.array([*np.full(3, np.radians(0.01)), *np.full(3, 0.01)])
"""What odometry may be off by in all rotates alike [rad], [m], which no spread shows: so much on simulated drives."""

_LEAST_ROTATION, _LEAST_TRAJECTORY = np.radians(2.0), 1.0
"""A drive that rotations by less [rad] or goes less far [m] reports nothing that is above its noise."""


@dataclass(frozen=True, slots=True, eq=False)
class PairedMotions:
    """How body and sensor moved between the same times.

    Attributes:
        body_rotations, sensor_rotations: (N, 4) unit quaternions, earlier_from_later of each.
        body_shifts, sensor_shifts: (N, 3) [m], the same.
        lags: (N,) int64, which of the lags each pair has.
        stretches: (N,) int64, number of the stretch of the drive that each begins in.
        shares: (N,) float64, how much each counts: pairs of one lag overlap, and only as many as follow one another
            without overlap are independent.
    """

    body_rotations: Float64Array
    body_shifts: Float64Array
    sensor_rotations: Float64Array
    sensor_shifts: Float64Array
    lags: Int64Array
    stretches: Int64Array
    shares: Float64Array

    def __len__(self) -> int:
        return len(self.lags)


@dataclass(frozen=True, slots=True, eq=False)
class _HandEye:
    """What the motions report a mounting.

    Attributes:
        mounting: `body_from_sensor` with its covariance about the body's axes; what is not observed is the guess's.
        motions: how many pairs of motions were compared.
        inliers: share of them that fit within three times the noise.
        rotation_noise, shift_noise: how far the motions of half a second are off [rad], [m].
    """

    mounting: MountingEstimate
    motions: int
    inliers: float
    rotation_noise: float
    shift_noise: float


def paired_motions(body: Poses, sensor: Poses, times_ns: Int64Array) -> PairedMotions:
    """Take the motions of two paths between times, (M,) int64 [ns], that lie one of the lags apart.

    Raises:
        PoseError: the paths have too little time in common.
    """
    times = np.unique(times_ns)
    both = [path.interpolate(times) for path in (body, sensor)]
    times = times[(both[0].coverage == 0) & (both[1].coverage == 0)]
    if len(times) < _LEAST_MOTIONS:
        raise PoseError(
            f"{len(times)} poses at which both ways are known; expected {_LEAST_MOTIONS} or more: "
            "do they lie on one clock?"
        )
    starts, stops, lags = _pairs(times)
    if len(starts) < _LEAST_MOTIONS:
        raise PoseError(
            f"{(times[-1] - times[0]) * 1e-9:.2f} s in common; expected {_LAGS[0]} s and "
            f"{_LEAST_MOTIONS} motions or more"
        )
    moved = [_motions(path, times, starts, stops) for path in (body, sensor)]
    stretch = max(2.0 * _LAGS[0], float(times[-1] - times[0]) * 1e-9 / 20.0)
    stretches = ((times[starts] - times[0]) * 1e-9 / stretch).astype(np.int64)
    shares = np.minimum(float(np.median(np.diff(times))) * 1e-9 / np.array(_LAGS), 1.0)
    return PairedMotions(*moved[0], *moved[1], lags, stretches, shares[lags])


def _pairs(times_ns: Int64Array) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Which two times make each pair, and which lag it has."""
    starts, stops, lags = [], [], []
    for number, lag in enumerate(_LAGS):
        first = np.arange(len(times_ns))
        after = np.searchsorted(times_ns, times_ns + int(lag * 1e9) - 1_000_000)
        first, after = first[after < len(times_ns)], after[after < len(times_ns)]
        near = (times_ns[after] - times_ns[first]) < 1.5e9 * lag
        starts.append(first[near])
        stops.append(after[near])
        lags.append(np.full(int(near.sum()), number))
    return np.concatenate(starts), np.concatenate(stops), np.concatenate(lags)


def _motions(
    path: Poses, times_ns: Int64Array, starts: Int64Array, stops: Int64Array
) -> tuple[Float64Array, Float64Array]:
    poses = path.interpolate(times_ns)
    back = conjugate_quaternion(poses.quaternions_xyzw[starts])
    shifts = rotate_vectors(back, poses.positions[stops] - poses.positions[starts])
    return multiply_quaternions(back, poses.quaternions_xyzw[stops]), shifts


def align_motions(motions: PairedMotions, *, guess: RigidTransform | None = None, frame: str = "ego") -> _HandEye:
    """Solve A X = X B for all pairs at once, robustly.

    Args:
        guess: `body_from_sensor` as far as it is known: where the solution starts, and what is kept in directions
            that the motions do not report. None: the closed form, and the origin for what they do not report.
        frame: name of the body's frame, for the words about what is not observed.

    Raises:
        PoseError: too few motions, or the drive neither rotates nor moves.
    """
    _check_motion(motions)
    start = guess or RigidTransform(_closed_rotation(motions), np.zeros(3))
    solutions = [_solved(motions, start, start)]
    if guess is not None:
        # a guess that is upside down must not keep the search in a wrong valley
        solutions.append(_solved(motions, RigidTransform(_closed_rotation(motions), guess.translation), start))
    solution = min(solutions, key=lambda found: found.cost)
    covariance = _sandwich(motions, solution)
    unobserved = unobserved_directions(covariance, frame)
    mounting = MountingEstimate(solution.mounting, covariance, unobserved)
    inliers = float((solution.squares.sum(axis=1) < 6 * 3.0**2 / 2).mean())
    return _HandEye(mounting, len(motions), inliers, *solution.noise[0].tolist())


def _check_motion(motions: PairedMotions) -> None:
    rotation = np.linalg.norm(rotation_vector_from_quaternion(motions.body_rotations), axis=1).max()
    trajectory = np.linalg.norm(motions.body_shifts, axis=1).max()
    if rotation < _LEAST_ROTATION and trajectory < _LEAST_TRAJECTORY:
        raise PoseError(
            f"the ego rotates by {np.degrees(rotation):.2g} deg and moves by {trajectory:.2g} m at most within "
            f"{_LAGS[-1]:.0f} s; expected {np.degrees(_LEAST_ROTATION):.0f} deg or {_LEAST_TRAJECTORY:.0f} m: "
            "stationary states nothing"
        )


def _closed_rotation(motions: PairedMotions) -> Float64Array:
    """The rotation that takes rotations of the sensor, and its trajectories where it hardly rotates.

    Into those of the body.

    Source: Park and Martin 1994; the orthogonal factor by singular values, Arun, Huang and Blostein 1987.
    """
    a = rotation_vector_from_quaternion(motions.body_rotations)
    b = rotation_vector_from_quaternion(motions.sensor_rotations)
    straight = 0.1 / (0.1 + np.linalg.norm(a, axis=1))
    trajectories = straight[:, None] ** 4 * motions.body_shifts
    scale = np.linalg.norm(a) / max(float(np.linalg.norm(trajectories)), 1e-9) if np.linalg.norm(a) > 0 else 1.0
    u, _, vt = np.linalg.svd(
        a.T @ b + min(scale, 1e3) ** 2 * trajectories.T @ (straight[:, None] ** 4 * motions.sensor_shifts)
    )
    return np.asarray((u * [1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    mounting: RigidTransform
    noise: Float64Array  # (lags, 2) [rad], [m]
    squares: Float64Array  # (N, 2) of the residuals over their noise
    cost: float


def _solved(motions: PairedMotions, start: RigidTransform, guess: RigidTransform) -> _Solution:
    """Gauss-Newton with weights that are made anew from the residuals in each step."""
    mounting = start
    for _ in range(_STEPS):
        residuals, jacobian = _linearised(motions, mounting)
        noise, weights = _weights(motions, residuals)
        normal = np.einsum("nki,nk,nkj->ij", jacobian, weights, jacobian) + _prior()
        slope = np.einsum("nki,nk,nk->i", jacobian, weights, residuals)
        slope += _prior() @ step_between(guess, mounting)
        step = -np.linalg.solve(normal, slope)
        rotated = np.linalg.norm(step[:3])
        mounting = moved_by(mounting, step if rotated < 0.5 else step * 0.5 / rotated)
        if np.abs(step).max() < 1e-9:
            break
    residuals, _ = _linearised(motions, mounting)
    noise, _ = _weights(motions, residuals)
    squares = _squares(residuals) / noise[motions.lags] ** 2
    cost = float(np.log(noise[np.unique(motions.lags)]).sum())
    return _Solution(mounting, noise, squares, cost)


def _prior() -> Float64Array:
    return np.diag(_GUESS_SIGMAS**-2.0)


def _linearised(motions: PairedMotions, mounting: RigidTransform) -> tuple[Float64Array, Float64Array]:
    """Residuals (N, 6), rotate then shift, of A X = X B and their derivatives (N, 6, 6) by a small step of X.

    With R = exp(d) R0 the rotated vector R b changes by -[R0 b]x d; the matrix [v]x takes a vector w to v x w.
    """
    body_rotations = rotation_vector_from_quaternion(motions.body_rotations)
    rotated = mounting.rotate(rotation_vector_from_quaternion(motions.sensor_rotations))
    trajectories = mounting.rotate(motions.sensor_shifts)
    rotations = matrix_from_quaternion(motions.body_rotations)
    shift_errors = motions.body_shifts + rotations @ mounting.translation - trajectories - mounting.translation
    jacobian = np.zeros((len(motions), 6, 6))
    jacobian[:, :3, :3] = _cross_matrices(rotated)
    jacobian[:, 3:, :3] = _cross_matrices(trajectories)
    jacobian[:, 3:, 3:] = rotations - np.eye(3)
    return np.concatenate([body_rotations - rotated, shift_errors], axis=1), jacobian


def _cross_matrices(vectors: Float64Array) -> Float64Array:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _squares(residuals: Float64Array) -> Float64Array:
    return np.stack([(residuals[:, :3] ** 2).sum(axis=1), (residuals[:, 3:] ** 2).sum(axis=1)], axis=1)


def _weights(motions: PairedMotions, residuals: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The noise of rotations and shifts over each lag, by their medians, and the weight (N, 6) of each residual.

    Source: the median of a chi-squared variable with three degrees of freedom is 2.366.
    """
    squares = _squares(residuals)
    noise = np.ones((len(_LAGS), 2))
    for lag in np.unique(motions.lags):
        noise[lag] = np.sqrt(np.median(squares[motions.lags == lag], axis=0) / 2.366)
    noise = np.maximum(noise, _LEAST_NOISE)
    variances = noise[motions.lags] ** 2
    robust = 1.0 / (variances * (1.0 + squares / (3.0 * _CAUCHY**2 * variances)))
    return noise, np.repeat(robust, 3, axis=1) * motions.shares[:, None]


def _sandwich(motions: PairedMotions, solution: _Solution) -> Float64Array:
    """The covariance by how differently the stretches of the drive pull, and by the model: few report little."""
    residuals, jacobian = _linearised(motions, solution.mounting)
    _, weights = _weights(motions, residuals)
    normal = np.einsum("nki,nk,nkj->ij", jacobian, weights, jacobian) + _prior()
    pulls = np.einsum("nki,nk,nk->ni", jacobian, weights, residuals)
    sums = np.zeros((int(motions.stretches.max()) + 1, 6))
    np.add.at(sums, motions.stretches, pulls)
    spread = sums.T @ sums * (len(sums) / max(len(sums) - 2, 1)) + normal + _prior()
    inverse = np.linalg.inv(normal)
    return np.asarray(inverse @ spread @ inverse + np.diag(_SYSTEMATIC**2), np.float64)


_GREATEST_OFFSET_NS = 1_000_000_000
"""Clocks of one drive are not farther apart than this [ns]."""


@dataclass(frozen=True, slots=True, eq=False)
class LidarToEgo:
    """What was found of a lidar's mounting.

    Attributes:
        lidar_id: whose.
        trajectory: name of the ego trajectory that the lidar's was compared with.
        stated: `ego_from_lidar` as the scene has it, or None.
        found: what the motions report; `found.mounting.a_from_b` is `ego_from_lidar`.
        clock: the lidar's clock against the trajectory's.
    """

    lidar_id: Identifier
    trajectory: str
    stated: RigidTransform | None
    found: _HandEye
    clock: ClockEstimate


def lidar_to_ego(
    scene: Scene,
    lidar_id: Identifier | None = None,
    *,
    trajectory: str | None = None,
    progress: Progress | None = None,
) -> LidarToEgo:
    """Find `ego_from_lidar` by hand-eye alignment of the lidar's odometry and a trajectory of the ego.

    The mounting that the scene states is where the search starts, and what is kept where the drive does not report.

    Args:
        lidar_id: the lidar; None for the first one with sweeps.
        trajectory: name of the ego trajectory, None for the scene's default.
        progress: reported after each sweep.

    Raises:
        OptionError: there is no such lidar, or the trajectory is the lidar's own.
        PoseError: there is no trajectory, or both ways have too little motion or time in common.
        DataError: a sweep cannot be read.
    """
    lidar = chosen_lidar(scene, lidar_id)
    if trajectory == LIDAR and LIDAR not in scene.trajectories:
        raise OptionError("trajectory 'lidar' is found from the lidar itself; expected one that other sensors reported")
    if lidar.points_frame is not PointsFrame.SENSOR:
        raise PoseError(
            f"{scene.source}: points of lidar {lidar.id!r} are in the {lidar.points_frame} frame already; "
            "expected its own: its mounting cannot be found from them"
        )
    if not scene.trajectories and not gnss_receivers(scene):
        raise PoseError(
            f"{scene.source}: no trajectory and no satellite fixes in it; expected a ego trajectory that others "
            "than the lidar reported, to compare the lidar's own with"
        )
    ego = find_ego_motion(_without_lidars(scene), name=trajectory)
    sensor = _lidar_trajectory(scene, lidar, progress)
    clock = _compared_clocks(ego.path, sensor, lidar.mount)
    shifted = replace(sensor, timestamps_ns=sensor.timestamps_ns - _offset_ns(clock))
    found = align_motions(paired_motions(ego.path, shifted, _middles(shifted)), guess=lidar.mount)
    return LidarToEgo(lidar.id, ego.name, lidar.mount, found, clock)


def _without_lidars(scene: Scene) -> Scene:
    """A trajectory that lidars took part in would report the stated mounting back."""
    return replace(scene, sensors=tuple(sensor for sensor in scene.sensors if not isinstance(sensor, LidarSensor)))


def _lidar_trajectory(scene: Scene, lidar: LidarSensor, progress: Progress | None) -> Poses:
    """The lidar's own trajectory, `start_from_lidar`; its stated mounting only reports odometry which way it looks."""
    run = lidar_odometry(replace(scene, sensors=(lidar,)), progress=progress)
    path = run.trajectory.poses
    if lidar.mount is None:
        return path
    seen = PoseSource(path, lidar.mount).at(path.timestamps_ns)
    return Poses(path.timestamps_ns, seen.positions, seen.quaternions_xyzw)


def _middles(path: Poses) -> Int64Array:
    """Of the knots of odometry every second is the middle of a sweep; those between are means of two of them."""
    return path.timestamps_ns[1::2]


def _compared_clocks(ego: Poses, sensor: Poses, mount: RigidTransform | None) -> ClockEstimate:
    reference = Orientations.of_poses(ego.timestamps_ns, ego.quaternions_xyzw)
    middles = sensor.interpolate(_middles(sensor))
    stream = Orientations.of_poses(_middles(sensor), middles.quaternions_xyzw)
    rotation = None if mount is None else np.asarray(mount.rotation)
    return compare_rotations(reference, stream, reach_ns=_GREATEST_OFFSET_NS, reference_from_stream=rotation)


def _offset_ns(clock: ClockEstimate) -> int:
    if clock.verdict is not ClockVerdict.OFF or clock.offset_ns is None:
        return 0
    return round(clock.offset_ns)
