"""Extrinsics of a lidar on the ego: hand-eye calibration of lidar odometry against a trajectory.

Both devices move as one. From one time to another the body moves by A and the sensor by B, each as seen by itself, and
the extrinsics X = body_from_sensor take one into the other: A X = X B. Rotations give R_A R_X = R_X R_B, so the
rotation vectors obey a = R_X b; translations give t_A + R_A t_X = R_X t_B + t_X. A car on a plane rotates about one
axis only: its rotations leave the rotation about that axis free, which its forward motion determines, and no motion of
it determines the height.

Source: Shiu and Ahmad 1989 for the equation; Park and Martin 1994 for rotation vectors and the closed form of the
rotation; Horaud and Dornaika 1995 for rotation and translation together; the weights are those of Holland and Welsch
1977, the covariance is the sandwich of Liang and Zeger 1986 with stretches of the drive as clusters.
"""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.calibrate.extrinsics import MountingEstimate, moved_by, step_between
from sceneloom.calibrate.frames import chosen_lidar
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import (
    RigidTransform,
    conjugate_quaternion,
    cross_matrix,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
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

_LEAST_MOTIONS, _STEPS = 6, 30
_LAGS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Seconds from one pose to the other of a pair: long ones rotate far, short ones have not drifted."""

_CAUCHY = 2.385  # the Cauchy weight that keeps 95 % of the efficiency on Gaussian errors (Holland and Welsch 1977)

_PRIOR = np.diag(np.array([*np.full(3, np.pi), *np.full(3, 3.0)]) ** -2.0)
"""Information of the guess: extrinsics are within about 180 degrees and 3 m; keeps what no motion determines."""

_LEAST_NOISE = np.array([np.radians(0.01), 5e-3])
"""No trajectory is better than this over a lag [rad], [m]: an error that all of a drive shares is not in its spread."""

_SYSTEMATIC = np.array([*np.full(3, np.radians(0.01)), *np.full(3, 0.01)])
"""Errors of odometry alike in all motions [rad], [m], which no spread shows: so much on simulated drives."""

_LEAST_ROTATION, _LEAST_LENGTH = np.radians(2.0), 1.0
"""A drive that rotates by less [rad] and goes less far [m] determines nothing above its noise."""

_GREATEST_OFFSET_NS = 1_000_000_000  # clocks of one drive are not farther apart than this [ns]


@dataclass(frozen=True, slots=True, eq=False)
class PairedMotions:
    """Motions of body and sensor between the same times.

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
    """The extrinsics that motions determine."""

    mounting: MountingEstimate  # `body_from_sensor`, covariance about the body's axes; the guess's where not observed
    motions: int  # pairs that were compared
    inliers: float  # share of them within three times the noise


@dataclass(frozen=True, slots=True, eq=False)
class LidarToEgo:
    """Estimated extrinsics of a lidar on the ego.

    Attributes:
        lidar_id: whose.
        trajectory: name of the ego trajectory that the lidar's was compared with.
        stated: `ego_from_lidar` as the scene has it, or None.
        found: by the motions; `found.mounting.a_from_b` is `ego_from_lidar`.
        clock: the lidar's clock against the trajectory's.
    """

    lidar_id: Identifier
    trajectory: str
    stated: RigidTransform | None
    found: _HandEye
    clock: ClockEstimate


def lidar_to_ego(
    scene: Scene, lidar_id: Identifier | None = None, *, trajectory: str | None = None, progress: Progress | None = None
) -> LidarToEgo:
    """Estimate `ego_from_lidar` by hand-eye calibration of the lidar's odometry against a trajectory of the ego.

    The search starts at the extrinsics of the scene, which also remain where the drive does not determine them.

    Args:
        lidar_id: the lidar; None for the first one with sweeps.
        trajectory: name of the ego trajectory, None for the scene's default.
        progress: reported after each sweep.

    Raises:
        OptionError: there is no such lidar, or the trajectory is the lidar's own.
        PoseError: there is no trajectory, or both trajectories have too little motion or time in common.
        DataError: a sweep cannot be read.
    """
    lidar = chosen_lidar(scene, lidar_id)
    if trajectory == LIDAR and LIDAR not in scene.trajectories:
        raise OptionError("trajectory 'lidar' is found from the lidar itself; expected one that other sensors reported")
    if lidar.points_frame is not PointsFrame.SENSOR:
        raise PoseError(
            f"{scene.source}: points of lidar {lidar.id!r} are in the {lidar.points_frame} frame already; "
            "expected its own frame, from which its extrinsics can be estimated"
        )
    if not scene.trajectories and not gnss_receivers(scene):
        raise PoseError(
            f"{scene.source}: no trajectory and no satellite fixes in it; expected an ego trajectory from other "
            "sensors than the lidar, to compare the lidar's own with"
        )
    # a trajectory that lidars took part in would report the stated extrinsics back
    others = tuple(sensor for sensor in scene.sensors if not isinstance(sensor, LidarSensor))
    ego = find_ego_motion(replace(scene, sensors=others), name=trajectory)
    # `start_from_lidar`; the stated extrinsics only tell odometry which way the lidar looks
    sensor = lidar_odometry(replace(scene, sensors=(lidar,)), progress=progress).trajectory.poses
    if lidar.mount is not None:
        seen = PoseSource(sensor, lidar.mount).at(sensor.timestamps_ns)
        sensor = Poses(sensor.timestamps_ns, seen.positions, seen.quaternions_xyzw)
    clock = _compared_clocks(ego.path, sensor, lidar.mount)
    off = clock.verdict is ClockVerdict.OFF and clock.offset_ns is not None
    shifted = replace(sensor, timestamps_ns=sensor.timestamps_ns - (round(clock.offset_ns or 0) if off else 0))
    found = align_motions(paired_motions(ego.path, shifted, _middles(shifted)), guess=lidar.mount)
    return LidarToEgo(lidar.id, ego.name, lidar.mount, found, clock)


def _middles(path: Poses) -> Int64Array:
    """Every second of the poses of odometry is the middle of a sweep; those between are means of two of them."""
    return path.timestamps_ns[1::2]


def _compared_clocks(ego: Poses, sensor: Poses, mount: RigidTransform | None) -> ClockEstimate:
    reference = Orientations.of_poses(ego.timestamps_ns, ego.quaternions_xyzw)
    middles = sensor.interpolate(_middles(sensor))
    stream = Orientations.of_poses(_middles(sensor), middles.quaternions_xyzw)
    rotation = None if mount is None else np.asarray(mount.rotation)
    return compare_rotations(reference, stream, reach_ns=_GREATEST_OFFSET_NS, reference_from_stream=rotation)


def paired_motions(body: Poses, sensor: Poses, times_ns: Int64Array) -> PairedMotions:
    """Give the motions of two trajectories between times, (M,) int64 [ns], that are one of the lags apart.

    Raises:
        PoseError: the trajectories have too little time in common.
    """
    times = np.unique(times_ns)
    both = [path.interpolate(times) for path in (body, sensor)]
    times = times[(both[0].coverage == 0) & (both[1].coverage == 0)]
    if len(times) < _LEAST_MOTIONS:
        raise PoseError(
            f"{len(times)} poses at which both trajectories are known; expected {_LEAST_MOTIONS} or more: "
            "are they on one clock?"
        )
    pairs = []
    for number, lag in enumerate(_LAGS):
        first = np.arange(len(times))
        after = np.searchsorted(times, times + int(lag * 1e9) - 1_000_000)
        first, after = first[after < len(times)], after[after < len(times)]
        near = (times[after] - times[first]) < 1.5e9 * lag
        pairs.append((first[near], after[near], np.full(int(near.sum()), number)))
    starts, stops, lags = (np.concatenate(column) for column in zip(*pairs, strict=True))
    if len(starts) < _LEAST_MOTIONS:
        raise PoseError(
            f"{(times[-1] - times[0]) * 1e-9:.2f} s in common; expected {_LAGS[0]} s and "
            f"{_LEAST_MOTIONS} motions or more"
        )

    def motions(path: Poses) -> tuple[Float64Array, Float64Array]:
        poses = path.interpolate(times)
        back = conjugate_quaternion(poses.quaternions_xyzw[starts])
        shifts = rotate_vectors(back, poses.positions[stops] - poses.positions[starts])
        return multiply_quaternions(back, poses.quaternions_xyzw[stops]), shifts

    stretch = max(2.0 * _LAGS[0], float(times[-1] - times[0]) * 1e-9 / 20.0)
    stretches = ((times[starts] - times[0]) * 1e-9 / stretch).astype(np.int64)
    shares = np.minimum(float(np.median(np.diff(times))) * 1e-9 / np.array(_LAGS), 1.0)
    return PairedMotions(*motions(body), *motions(sensor), lags, stretches, shares[lags])


def align_motions(motions: PairedMotions, *, guess: RigidTransform | None = None) -> _HandEye:
    """Solve A X = X B for all pairs at once, robustly.

    Args:
        guess: `body_from_sensor` as far as it is known: where the solution starts, and what is kept in directions
            that the motions do not determine. None: the closed form, and the origin for what they do not determine.

    Raises:
        PoseError: too few motions, or the drive neither rotates nor moves.
    """
    rotation = np.linalg.norm(rotation_vector_from_quaternion(motions.body_rotations), axis=1).max()
    length = np.linalg.norm(motions.body_shifts, axis=1).max()
    if rotation < _LEAST_ROTATION and length < _LEAST_LENGTH:
        raise PoseError(
            f"the ego rotates by {np.degrees(rotation):.2g} deg and moves by {length:.2g} m at most within "
            f"{_LAGS[-1]:.0f} s; expected {np.degrees(_LEAST_ROTATION):.0f} deg or {_LEAST_LENGTH:.0f} m: a stationary "
            "ego determines nothing"
        )
    closed = RigidTransform(_closed_rotation(motions), np.zeros(3) if guess is None else guess.translation)
    start = closed if guess is None else guess
    # a guess that is upside down must not keep the search in a wrong valley
    solutions = [_Solution(motions, begun, start) for begun in ((start,) if guess is None else (guess, closed))]
    best = min(solutions, key=lambda solution: solution.cost)
    inliers = float((best.squares.sum(axis=1) < 6 * 3.0**2 / 2).mean())
    mounting = MountingEstimate.of(best.mounting, best.covariance(), "ego")
    return _HandEye(mounting, len(motions), inliers)


def _closed_rotation(motions: PairedMotions) -> Float64Array:
    """The rotation that takes rotations of the sensor, and its translations where it hardly rotates, to the body's."""
    # Source: Park and Martin 1994; the orthogonal factor by singular values, Arun, Huang and Blostein 1987
    a = rotation_vector_from_quaternion(motions.body_rotations)
    b = rotation_vector_from_quaternion(motions.sensor_rotations)
    straight = (0.1 / (0.1 + np.linalg.norm(a, axis=1)))[:, None] ** 4
    shifts = straight * motions.body_shifts
    size = float(np.linalg.norm(a))
    scale = min(size / max(float(np.linalg.norm(shifts)), 1e-9) if size > 0 else 1.0, 1e3)
    return nearest_rotation(a.T @ b + scale**2 * shifts.T @ (straight * motions.sensor_shifts))[0]


class _Solution:
    """Gauss-Newton for `mounting` with weights made anew from the residuals in each step."""

    # `noise` (lags, 2) of rotations [rad] and translations [m] over each lag; `squares` (N, 2) of the residuals over
    # it; `cost`: its logarithm, summed

    def __init__(self, motions: PairedMotions, start: RigidTransform, guess: RigidTransform) -> None:
        self.motions, self.mounting = motions, start
        for _ in range(_STEPS):
            normal, pulls = self._linearised()
            step = -np.linalg.solve(normal, pulls.sum(axis=0) + _PRIOR @ step_between(guess, self.mounting))
            rotated = np.linalg.norm(step[:3])
            self.mounting = moved_by(self.mounting, step if rotated < 0.5 else step * 0.5 / rotated)
            if np.abs(step).max() < 1e-9:
                break
        self.normal, self.pulls = self._linearised()
        self.cost = float(np.log(self.noise[np.unique(motions.lags)]).sum())

    def _linearised(self) -> tuple[Float64Array, Float64Array]:
        """The normal equations: (6, 6), with the prior, and the weighted pull of each pair, (N, 6)."""
        # residuals (N, 6) of A X = X B are rotation, then translation; with R = exp(d) R0, R b changes by -[R0 b]x d;
        # noise is by the medians; the median of a chi-squared variable with three degrees of freedom is 2.366
        motions, mounting = self.motions, self.mounting
        rotated = mounting.rotate(rotation_vector_from_quaternion(motions.sensor_rotations))
        shifted, rotations = mounting.rotate(motions.sensor_shifts), matrix_from_quaternion(motions.body_rotations)
        rotation_errors = rotation_vector_from_quaternion(motions.body_rotations) - rotated
        shift_errors = motions.body_shifts + rotations @ mounting.translation - shifted - mounting.translation
        jacobian = np.zeros((len(motions), 6, 6))
        jacobian[:, :3, :3] = cross_matrix(rotated)
        jacobian[:, 3:, :3] = cross_matrix(shifted)
        jacobian[:, 3:, 3:] = rotations - np.eye(3)
        squares = np.stack([(errors**2).sum(axis=1) for errors in (rotation_errors, shift_errors)], axis=1)
        noise = np.ones((len(_LAGS), 2))
        for lag in np.unique(motions.lags):
            noise[lag] = np.sqrt(np.median(squares[motions.lags == lag], axis=0) / 2.366)
        self.noise = np.maximum(noise, _LEAST_NOISE)
        variances = self.noise[motions.lags] ** 2
        self.squares = squares / variances
        robust = 1.0 / (variances * (1.0 + squares / (3.0 * _CAUCHY**2 * variances)))
        weights = np.repeat(robust, 3, axis=1) * motions.shares[:, None]
        residuals = np.concatenate([rotation_errors, shift_errors], axis=1)
        normal = np.einsum("nki,nk,nkj->ij", jacobian, weights, jacobian) + _PRIOR
        return normal, np.einsum("nki,nk,nk->ni", jacobian, weights, residuals)

    def covariance(self) -> Float64Array:
        """(6, 6), by how differently the stretches of the drive pull, and by the model: few show little."""
        stretches = self.motions.stretches
        sums = np.zeros((int(stretches.max()) + 1, 6))
        np.add.at(sums, stretches, self.pulls)
        spread = sums.T @ sums * (len(sums) / max(len(sums) - 2, 1)) + self.normal + _PRIOR
        inverse = np.linalg.inv(self.normal)
        return np.asarray(inverse @ spread @ inverse + np.diag(_SYSTEMATIC**2), np.float64)
