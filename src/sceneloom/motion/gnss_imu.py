"""GNSS/IMU smoothing: the ego trajectory that fits GNSS fixes, IMU samples and lidar odometry best.

The motion is a chain of states at some of the fixes' times, which the IMU's preintegrated samples tie together. All
states are estimated at once by Levenberg-Marquardt (`kernels.imu_chain`); the noise is estimated from the residuals.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.geodesy import FLATTENING, SEMI_MAJOR_AXIS, ecef_from_geodetic, enu_from_geodetic
from sceneloom.geometry.rigid import (
    cross_matrix,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    nearest_rotation,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
)
from sceneloom.kernels import imu_chain as kernels
from sceneloom.kernels.imu_chain import (
    ACCELEROMETER,
    DELTA_POSITION,
    DELTA_ROTATION,
    GYROSCOPE,
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    chain_covariances,
    preintegrate,
    solve_chain,
)
from sceneloom.motion.ego_trajectory import gnss_receivers, usable_fixes
from sceneloom.motion.imu import QUIET_FORCE, QUIET_RATE, WHITE, find_stationary, gaps_between, usable_samples
from sceneloom.scene.motion import ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.warnings import DataWarning, assumed, repaired, skipped

NAME = "gnss"
"""Name of the trajectory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SmootherSettings:
    """Settings of the smoother.

    Attributes:
        gyroscope_noise, accelerometer_noise: least densities of the white noise [rad/s/√Hz] and [m/s²/√Hz]; more is
            taken from the samples.
        gyroscope_walk, accelerometer_walk: densities of the biases' random walks [rad/s²/√Hz] and [m/s³/√Hz].
        gyroscope_bias, accelerometer_bias: standard deviations of the initial biases [rad/s] and [m/s²].
        acceleration: density of the acceleration of an ego without IMU [m/s²/√Hz].
        rotating: density of the angular velocity of an ego without IMU [rad/s/√Hz].
        fix_noise: initial standard deviation of a fix without reported accuracy [m].
        least_fix_noise: least standard deviation of a fix [m].
        slow_error: a stated accuracy across below this [m], 1.7 times that in height, is not believed of errors that
            fixes have in common for long: about that of code ranges with corrections. State less where it is trusted.
        gate: a fix is left out while it is more than so many standard deviations off.
        longest_interval: longest time between states [s].
        vehicle: whether the ego moves along one of its axes only, as cars do: True, False, or None to let the data
            decide.
        gravity: [m/s²]; None for that of the location.

    Raises:
        OptionError: a number is not positive.
    """

    gyroscope_noise: float = 5e-5
    accelerometer_noise: float = 5e-4
    gyroscope_walk: float = 5e-6
    accelerometer_walk: float = 5e-5
    gyroscope_bias: float = 0.003
    accelerometer_bias: float = 0.05
    acceleration: float = 2.0
    rotating: float = 0.5
    fix_noise: float = 2.0
    least_fix_noise: float = 1e-4
    slow_error: float = 0.33
    gate: float = 3.5
    longest_interval: float = 1.0
    vehicle: bool | None = None
    gravity: float | None = None

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if value is not None and not isinstance(value, bool) and not value > 0:
                raise OptionError(f"{name}: {value}; expected a number above 0")


DEFAULTS = SmootherSettings()
_Rows = TypeVar("_Rows", "Preintegrated", "Fixes", "RelativePoses", "BodySpeeds", "States")


def _rows(one: _Rows, rows: slice | Int64Array | BoolArray) -> _Rows:
    """The rows of each array of a dataclass."""
    return replace(one, **{f.name: getattr(one, f.name)[rows] for f in fields(one)})


_OfStates = TypeVar("_OfStates", "Fixes", "RelativePoses", "BodySpeeds")


def _within(one: _OfStates, first: int, last: int) -> _OfStates:
    """Measurements of the states `first` to `last`, without the latter, which are numbered from 0 then."""
    inside = _rows(one, (one.knots >= first) & (one.knots < last))
    return replace(inside, knots=inside.knots - first)


def _running_sums(values: Float64Array) -> Float64Array:
    """Sums (N + 1, K) of the first 0, 1, … N of (N, K) values."""
    return np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])


def _resampled(wanted_ns: Int64Array, times_ns: Int64Array, values: Float64Array) -> Float64Array:
    """Values (N, K) interpolated linearly at other times."""
    seconds, known = (wanted_ns - times_ns[0]) * 1e-9, (times_ns - times_ns[0]) * 1e-9
    return np.stack([np.interp(seconds, known, column) for column in values.T], axis=1)


_NOISE_SECONDS, _NOISE_SAMPLES = 2.0, 21  # time over which the noise is averaged, and the least number of samples


@dataclass(frozen=True, slots=True, eq=False)
class InertialSamples:
    """Samples of an IMU on the ego.

    Attributes:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 2.
        values: (N, 6) float64: angular velocity [rad/s], specific force [m/s²].
        gaps_ns: (G, 2) int64 [ns], between which samples are missing.
        left_out: number of samples that were not finite or not later than others.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    gaps_ns: Int64Array
    left_out: int = 0

    @classmethod
    def of(cls, gyroscope: VectorSamples, accelerometer: VectorSamples) -> "InertialSamples | None":
        """Resample both streams to the times of that with more samples; None where they do not overlap."""
        rate_times, rates, lost_rates = usable_samples(gyroscope)
        force_times, forces, lost_forces = usable_samples(accelerometer)
        if len(rate_times) < 2 or len(force_times) < 2:
            return None
        times = rate_times if len(rate_times) >= len(force_times) else force_times
        first, last = max(rate_times[0], force_times[0]), min(rate_times[-1], force_times[-1])
        times = times[(times >= first) & (times <= last)]
        if len(times) < 2:
            return None
        values = np.hstack(
            [
                own if np.array_equal(times, own_times) else _resampled(times, own_times, own)
                for own_times, own in ((rate_times, rates), (force_times, forces))
            ]
        )
        gaps = np.vstack([gaps_between(rate_times), gaps_between(force_times)])
        inside = (gaps[:, 1] > first) & (gaps[:, 0] < last)
        return cls(times, values, np.unique(gaps[inside], axis=0), lost_rates + lost_forces)

    @classmethod
    def of_scene(cls, scene: Scene) -> "InertialSamples | None":
        """Those of the first IMU of a scene that has both streams; None where there is none."""
        for sensor in scene.sensors:
            if isinstance(sensor, ImuSensor) and {"gyroscope", "accelerometer"} <= set(sensor.streams):
                samples = cls.of(sensor.streams["gyroscope"], sensor.streams["accelerometer"])
                if samples is not None:
                    return samples
        return None

    @property
    def period(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.timestamps_ns))) * 1e-9

    def is_measured(self, first_ns: Int64Array, last_ns: Int64Array, *, slack_ns: int = 0) -> BoolArray:
        """Which intervals lie within the samples, up to some slack at their ends, and contain no gap."""
        times = self.timestamps_ns
        measured = (first_ns >= times[0] - slack_ns) & (last_ns <= times[-1] + slack_ns)
        for start_ns, stop_ns in self.gaps_ns:
            measured &= (last_ns <= start_ns) | (first_ns >= stop_ns)
        return np.asarray(measured, np.bool_)

    @property
    def slack_ns(self) -> int:
        """Time beyond the samples in which the last one holds [ns]."""
        return round(1.5 * self.period * 1e9)

    def noise_densities(self, times_ns: Int64Array, settings: SmootherSettings) -> Float64Array:
        """The densities of the white noise around some times, (N, 2), (rad/s)²/Hz and (m/s²)²/Hz.

        They are taken from the distance of samples from the middle between their neighbours, whose variance is 1.5
        times that of white noise. Motion that a low rate does not resolve counts as noise: it is unknown between the
        samples, too.
        """
        least = [settings.gyroscope_noise**2, settings.accelerometer_noise**2]
        if len(self.timestamps_ns) < 3:
            return np.tile(least, (len(times_ns), 1))
        values = self.values
        apart = values[1:-1] - 0.5 * (values[:-2] + values[2:])
        squares = np.stack([(apart[:, :3] ** 2).mean(axis=1), (apart[:, 3:] ** 2).mean(axis=1)], axis=1) / 1.5
        width = min(max(_NOISE_SAMPLES, round(_NOISE_SECONDS / self.period)) | 1, len(squares))
        sums, first = _running_sums(squares), np.clip(np.arange(len(squares)) - width // 2, 0, len(squares) - width)
        smooth = np.maximum(sums[first + width] - sums[first], 0.0) / width * self.period
        found = np.stack([np.interp(times_ns, self.timestamps_ns[1:-1], smooth[:, k]) for k in range(2)], axis=1)
        return np.asarray(np.maximum(found, least), np.float64)

    def preintegrated(self, knots_ns: Int64Array, *, biases: Float64Array, densities: Float64Array) -> "Preintegrated":
        """Preintegrate the samples from each knot to the next.

        Between samples rate and force change linearly; the rotation is exact to the fourth order in the time between
        samples for such a rate, velocity and position are integrated by Simpson's rule.

        Args:
            knots_ns: (K,) int64 [ns], strictly increasing; they need not lie on samples.
            biases: (K - 1, 6) to subtract.
            densities: (K - 1, 2) of the white noise, (rad/s)²/Hz and (m/s²)²/Hz.
        """
        found = Preintegrated.nothing(np.ascontiguousarray(biases))
        preintegrate(
            self.timestamps_ns, self.values, knots_ns, found.biases, np.ascontiguousarray(densities), knots_ns[1:],
            np.arange(len(knots_ns) - 1), found.rotations, found.velocities, found.positions, found.slopes,
            found.covariances,
        )  # fmt: skip
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Preintegrated:
    """Preintegrated IMU samples of F intervals, in the body axes at the beginning of each.

    Source: Forster, Carlone, Dellaert and Scaramuzza 2017, "On-Manifold Preintegration for Real-Time Visual-Inertial
    Odometry".
    """

    rotations: Float64Array  # (F, 3, 3) float64, `first_from_second`
    velocities: Float64Array  # (F, 3) gain of velocity [m/s] without gravity
    positions: Float64Array  # (F, 3) distance [m] without gravity and without the initial velocity
    slopes: Float64Array  # (F, 9, 6) derivatives of rotation (on the right [rad]), velocity, position by the biases
    covariances: Float64Array  # (F, 9, 9) of rotation, velocity and position
    biases: Float64Array  # (F, 6) that were subtracted

    @classmethod
    def nothing(cls, biases: Float64Array) -> "Preintegrated":
        """Intervals without measured motion, for biases (F, 6)."""
        count = len(biases)
        rotations, covariances = np.tile(np.eye(3), (count, 1, 1)), np.tile(np.eye(9), (count, 1, 1))
        velocities, positions = np.zeros((count, 3)), np.zeros((count, 3))
        return cls(rotations, velocities, positions, np.zeros((count, 9, 6)), covariances, biases)


def _preintegrated_until(
    samples: InertialSamples, knots_ns: Int64Array, biases: Float64Array, times_ns: Int64Array, knots: Int64Array,
    *, sloping: bool,
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Rotations, velocities, positions and slopes as in `Preintegrated` from the knots (N,) to ascending times (N,)."""
    count = len(times_ns)
    found = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3)), np.empty((count * sloping, 9, 6))
    biases, no_noise = np.ascontiguousarray(biases), np.zeros((len(biases), 2))
    preintegrate(
        samples.timestamps_ns, samples.values, knots_ns, biases, no_noise, times_ns, knots, *found,
        np.empty((0, 9, 9)),
    )  # fmt: skip
    return found


_STARTING = 3.0  # largest acceleration of an ego that starts [m/s²]


def _measured_anew(times_ns: Int64Array, positions_lla: Float64Array) -> BoolArray:
    """(F,) whether fixes are measurements: one that repeats the one before is none, unless the ego is stationary.

    It is where the receiver measures anew at most times, and goes on from there as from a standstill.
    """
    anew = np.concatenate([[True], (np.diff(positions_lla[:, :2], axis=0) != 0).any(axis=1)])
    first = np.flatnonzero(anew)
    if np.median(np.diff(np.append(first, len(anew)))) > 1:
        return anew
    last = np.append(first[1:], len(anew)) - 1
    ecef = ecef_from_geodetic(np.nan_to_num(positions_lla))
    away = np.append(np.linalg.norm(ecef[first[1:]] - ecef[last[:-1]], axis=1), 0.0)
    step = np.append(times_ns[first[1:]] - times_ns[last[:-1]], 0) * 1e-9
    stationary = away <= 0.5 * _STARTING * step**2
    return np.asarray(anew | np.repeat(stationary, last - first + 1), np.bool_)


_FARTHEST = 100_000.0  # fixes farther than this from the central one [m] are left out

_VERTICAL = 1.7
"""Standard deviation of heights relative to that across, where not reported. Source: usual ratio of VDOP to HDOP."""

_UNKNOWN_HEIGHT = 1e5
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-3, 1e4


@dataclass(frozen=True, slots=True, eq=False)
class GnssFixes:
    """All fixes of a drive."""

    timestamps_ns: Int64Array  # (F,) int64 [ns], ascending
    positions: Float64Array  # (F, 3) [m] east, north, up of the origin
    sigmas: Float64Array  # (F, 3) [m], as reported or assumed
    reported: BoolArray  # (F,) bool, whether the receiver reported its accuracy
    levers: Float64Array  # (F, 3) [m], the antenna in the ego frame
    receivers: Int64Array  # (F,) int64, number of the receiver
    origin_lla: Float64Array  # (3,) latitude, longitude [deg], height [m]
    warnings: tuple[DataWarning, ...]  # what was left out

    @classmethod
    def of(cls, scene: Scene, settings: SmootherSettings) -> "GnssFixes":
        """Take the fixes of all receivers; there is at least one."""
        parts, warnings = [], []
        for number, receiver in enumerate(gnss_receivers(scene)):
            rows = np.flatnonzero(usable_fixes(receiver))
            rows = rows[np.unique(receiver.timestamps_ns[rows], return_index=True)[1]]
            rows = rows[_measured_anew(receiver.timestamps_ns[rows], receiver.positions_lla[rows])]
            lost = len(receiver.timestamps_ns) - len(rows)
            if lost:
                location = f"{scene.source}: sensors[{receiver.id}]"
                message = "fixes that are invalid, repeat a timestamp or repeat the fix before were left out"
                warnings.append(skipped("gnss-fixes-left-out", location, message, count=lost))
            locations = receiver.positions_lla[rows]
            across, up = receiver.accuracies[rows], receiver.vertical_accuracies[rows]
            reported, reported_up = (np.isfinite(sigma) & (sigma > 0) for sigma in (across, up))
            across = np.where(reported, across, settings.fix_noise)
            up = np.where(reported_up, up, _VERTICAL * across)
            sigmas = np.clip(np.stack([across, across, up], axis=1), _LEAST_SIGMA, _LARGEST_SIGMA)
            unknown = ~np.isfinite(locations[:, 2])
            sigmas[unknown, 2], locations[unknown, 2] = _UNKNOWN_HEIGHT, 0.0
            lever = np.zeros(3) if receiver.mount is None else receiver.mount.translation
            levers, numbers = np.tile(lever, (len(rows), 1)), np.full(len(rows), number)
            parts.append((receiver.timestamps_ns[rows], locations, sigmas, reported, levers, numbers))
        times, locations, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        ecef = ecef_from_geodetic(locations)
        # the fix nearest to the median, which itself may lie between two groups of fixes
        middle = ecef[np.linalg.norm(ecef - np.median(ecef, axis=0), axis=1).argmin()]
        near = np.linalg.norm(ecef - middle, axis=1) <= _FARTHEST
        if not near.all():
            message = f"fixes more than {_FARTHEST / 1000:.0f} km from the others were left out"
            lost = int((~near).sum())
            warnings.append(skipped("gnss-fixes-elsewhere", scene.source, message, count=lost))
        order = np.flatnonzero(near)[np.argsort(times[near], kind="stable")]
        origin = locations[order[0]]
        sigmas, reported, levers, numbers = (column[order] for column in columns)
        positions = enu_from_geodetic(locations[order], origin)
        return cls(times[order], positions, sigmas, reported, levers, numbers, origin, tuple(warnings))

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def carried(
        self,
        knots_ns: Int64Array,
        measured: BoolArray,
        samples: InertialSamples | None,
        *,
        biases: Float64Array,
        gravity: float,
        sigmas: Float64Array | None = None,
    ) -> "Fixes":
        """Relate each fix to the state before it by the IMU, or to the nearest one where that did not measure.

        Args:
            knots_ns: (K,) [ns], times of the states.
            measured: (K - 1,) between which of them the IMU measured.
            biases: (K - 1, 6) to subtract from the samples.
            gravity: [m/s²].
            sigmas: (F, 3) [m]; None for those of the fixes.
        """
        times, count = self.timestamps_ns, len(self)
        before = np.clip(np.searchsorted(knots_ns, times, side="right") - 1, 0, len(knots_ns) - 1)
        led = np.append(measured, False)[before] & (times >= knots_ns[0])
        after = np.clip(np.searchsorted(knots_ns, times), 1, len(knots_ns) - 1)
        nearest = after - (times - knots_ns[after - 1] <= knots_ns[after] - times)
        knots = np.where(led, before, nearest)
        seconds = np.asarray((times - knots_ns[knots]) * 1e-9, np.float64)
        levers, slopes, subtracted = self.levers.copy(), np.zeros((count, 3, 6)), np.zeros((count, 6))
        rows = np.flatnonzero(led & (seconds > 0))
        if samples is not None and len(rows):
            rotations, _, positions, by_biases = _preintegrated_until(
                samples, knots_ns, biases, times[rows], knots[rows], sloping=True
            )
            levers[rows] = np.einsum("nij,nj->ni", rotations, self.levers[rows]) + positions
            by_rotation = rotations @ -cross_matrix(self.levers[rows]) @ by_biases[:, DELTA_ROTATION]
            slopes[rows] = by_biases[:, DELTA_POSITION] + by_rotation
            subtracted[rows] = biases[knots[rows]]
        falls = np.where(led, 0.5 * gravity * seconds**2, 0.0)
        sigmas = self.sigmas if sigmas is None else sigmas
        return Fixes(
            times, knots, seconds, self.positions, levers, falls, slopes, subtracted, sigmas, self.receivers,
            np.where(self.reported[:, None], self.sigmas, 0.0),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Positions of antennas, measured by F fixes and related to states.

    A fix predicts the antenna at p + t v - fall up + R (lever + slope (b - bias)) for a state R, p, v, b, t before it.
    """

    timestamps_ns: Int64Array  # (F,) int64 [ns], ascending
    knots: Int64Array  # (F,) int64, ascending: the state before each fix, or the nearest where no IMU measured
    seconds: Float64Array  # (F,) from the state to the fix
    positions: Float64Array  # (F, 3) [m], world
    levers: Float64Array  # (F, 3) [m], the antenna at the fix's time in the body axes at the state, by the IMU's motion
    falls: Float64Array  # (F,) [m] of free fall until then; 0 where no IMU measured
    slopes: Float64Array  # (F, 3, 6) derivatives of `levers` by the biases of gyroscope and accelerometer
    biases: Float64Array  # (F, 6) that are subtracted in `levers`
    sigmas: Float64Array  # (F, 3) [m], standard deviations along the world's axes
    receivers: Int64Array  # (F,) int64, number of the receiver of each
    stated: Float64Array  # (F, 3) [m], as the receivers reported, 0 where they did not

    def __len__(self) -> int:
        return len(self.knots)

    def variances(self, rotations: Float64Array, own: Float64Array) -> Float64Array:
        """(F, 3) variances of the antenna positions, from the states' orientations and covariances (K, 15, 15)."""
        rotated = rotations[self.knots]
        slopes = np.zeros((len(self), 3, SIZE))
        slopes[:, :, ROTATION] = rotated @ -cross_matrix(self.levers)
        slopes[:, :, POSITION] = np.eye(3)
        slopes[:, :, VELOCITY] = self.seconds[:, None, None] * np.eye(3)
        slopes[:, :, VELOCITY.stop :] = rotated @ self.slopes
        return np.asarray(((slopes @ own[self.knots]) * slopes).sum(axis=2), np.float64)


_LONGEST_PERIOD = 1.0  # longest median time between IMU samples that determine the motion between them [s]
_LONGEST_STEP = 60.0  # longest median time between fixes without an IMU [s]


_EQUATOR_GRAVITY, _GRAVITY_FORMULA, _GRAVITY_RATIO = 9.7803253359, 0.00193185265241, 0.00344978650684


def _normal_gravity(latitude_deg: float, height: float) -> float:
    """Give the pull of the earth [m/s²], its rotating included, at a height above the ellipsoid [m].

    Source: NIMA TR8350.2, eq. 4-1 (Somigliana) and 4-3, with the constants of its tables 3.1 and 3.4.
    """
    sine2 = math.sin(math.radians(latitude_deg)) ** 2
    root = math.sqrt(1.0 - FLATTENING * (2.0 - FLATTENING) * sine2)
    on_ellipsoid = _EQUATOR_GRAVITY * (1.0 + _GRAVITY_FORMULA * sine2) / root
    flattened = 1.0 + FLATTENING + _GRAVITY_RATIO - 2.0 * FLATTENING * sine2
    above = height / SEMI_MAJOR_AXIS
    return on_ellipsoid * (1.0 - 2.0 * flattened * above + 3.0 * above * above)


def _check_times(location: str, fixes: GnssFixes, samples: InertialSamples | None) -> None:
    """Refuse times that are too far apart, such as milliseconds taken for seconds."""
    hint = "are the times in milliseconds, where seconds are expected?"
    if samples is not None and samples.period > _LONGEST_PERIOD:
        raise PoseError(
            f"{location}: samples of the IMU are {samples.period:.6g} s apart (median); expected at most "
            f"{_LONGEST_PERIOD:g} s: {hint}"
        )
    times = fixes.timestamps_ns
    step = float(np.median(np.diff(times))) * 1e-9
    if step > _LONGEST_STEP and (
        samples is None or not samples.is_measured(times[:-1], times[1:], slack_ns=samples.slack_ns).any()
    ):
        raise PoseError(
            f"{location}: GNSS fixes are {step:.6g} s apart (median), and no IMU measured between; expected at most "
            f"{_LONGEST_STEP:g} s: {hint}"
        )


_LEAST_PULL, _LARGEST_PULL = 0.7, 2.0  # what an accelerometer measures for most of a drive, over gravity


def _check_gravity(location: str, samples: InertialSamples | None, gravity: float) -> None:
    """Refuse accelerations in another unit, or without gravity, which the fixes would be bent to."""
    if samples is None:
        return
    measured = float(np.median(np.linalg.norm(samples.values[:, 3:], axis=1)))
    if not _LEAST_PULL <= measured / gravity <= _LARGEST_PULL:
        raise PoseError(
            f"{location}: the IMU's accelerations are {measured:.4g} m/s² long (median); expected about "
            f"{gravity:.4g}, gravity among them: are they in g (a rig's `accelerometer_unit`), or is gravity taken off?"
        )


_CLOSEST_NS = 20_000_000  # least time between states [ns]: over so short a time a fix is carried without loss
_LONGEST_NS = 86_400 * 1_000_000_000  # no drive is longer [ns]: a wrong time must not make millions of states

_CARRIED = 0.003
"""Noise [m] that the IMU may add to a fix on the way from the state before it."""

_LONGEST_CARRIED = 0.5
"""Longest time from the state before a fix [s]: errors of scales, axes and initial biases do not show as noise."""

_WEIGHT = 9.81  # acceleration [m/s²] that a wrong orientation misdirects


def knot_times(
    fix_times_ns: Int64Array, samples: InertialSamples | None, further_ns: Int64Array, settings: SmootherSettings
) -> Int64Array:
    """Choose the times of the states.

    Args:
        fix_times_ns: (F,) [ns], ascending.
        samples: of the IMU, whose first and last time and gaps get states.
        further_ns: times that should have one where there is none near them.

    Returns:
        (K,) int64 [ns], strictly increasing, K >= 2.

    Raises:
        PoseError: the times span more than a day.
    """
    marks = np.empty(0, np.int64)
    if samples is not None:
        marks = np.unique(np.concatenate([samples.timestamps_ns[[0, -1]], samples.gaps_ns.ravel()]))
    times = np.concatenate([marks, fix_times_ns])
    first_ns, last_ns = int(times.min()), int(times.max())
    if last_ns - first_ns > _LONGEST_NS:
        raise PoseError(
            f"fixes and IMU span {(last_ns - first_ns) / 1e9:.6g} s, from {first_ns / 1e9:.9g} to {last_ns / 1e9:.9g}; "
            f"expected at most {_LONGEST_NS / 1e9:g}: is a timestamp wrong?"
        )
    fixes = np.unique(fix_times_ns)
    thin = _spaced(marks, np.empty(0, np.int64), np.full(len(marks), _CLOSEST_NS))
    thin = _spaced(fixes, thin, _apart_ns(fixes, samples, settings))
    thin = _spaced(further_ns, thin, np.full(len(further_ns), _CLOSEST_NS))
    chunks = [thin[:1]]
    for start, stop in zip(thin[:-1].tolist(), thin[1:].tolist(), strict=True):
        count = max(1, int(np.ceil((stop - start) * 1e-9 / settings.longest_interval - 1e-6)))
        chunks.append(start + np.rint(np.arange(1, count + 1) * ((stop - start) / count)).astype(np.int64))
    knots: Int64Array = np.concatenate(chunks)
    return knots if len(knots) > 1 else np.array([knots[0], knots[0] + _CLOSEST_NS])


def _apart_ns(times_ns: Int64Array, samples: InertialSamples | None, settings: SmootherSettings) -> Int64Array:
    """How far fixes at times may be from the state before, (F,) [ns]: the IMU's noise has to stay small."""
    # Source: position by white noise of acceleration, n² t³ / 3, and angular velocity, (g n)² t⁵ / 20: Farrell 2008
    if samples is None:
        return np.full(len(times_ns), _CLOSEST_NS)
    rate, force = samples.noise_densities(times_ns, settings).T
    allowed = _CARRIED / np.sqrt(2.0)
    seconds = np.minimum((3.0 * allowed**2 / force) ** (1.0 / 3.0), (20.0 * allowed**2 / (_WEIGHT**2 * rate)) ** 0.2)
    apart = np.rint(np.minimum(seconds, _LONGEST_CARRIED) * 1e9).astype(np.int64)
    return np.where(samples.is_measured(times_ns, times_ns), np.maximum(apart, _CLOSEST_NS), _CLOSEST_NS)


def _spaced(times_ns: Int64Array, known_ns: Int64Array, apart_ns: Int64Array) -> Int64Array:
    """Known times and those of others that are far enough after the one before and not close before the next known."""
    ends = np.append(known_ns, np.iinfo(np.int64).max)
    kept: list[int] = []
    following = np.searchsorted(known_ns, times_ns).tolist()
    for time, apart, after in zip(times_ns.tolist(), apart_ns.tolist(), following, strict=True):
        before = [*kept[-1:], *known_ns[max(after - 1, 0) : after].tolist()]
        if int(ends[after]) - time >= _CLOSEST_NS and (not before or time - max(before) >= apart):
            kept.append(time)
    return np.union1d(known_ns, np.array(kept, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """K states."""

    rotations: Float64Array  # (K, 3, 3) `world_from_body`
    positions: Float64Array  # (K, 3) [m], world
    velocities: Float64Array  # (K, 3) [m/s], world
    biases: Float64Array  # (K, 6) of the gyroscope [rad/s] and of the accelerometer [m/s²]

    def __post_init__(self) -> None:
        for name in ("rotations", "positions", "velocities", "biases"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))

    def stepped(self, step: Float64Array) -> "States":
        """The states after steps (K, 15) in the order of `kernels.imu_chain`."""
        return States(
            self.rotations @ matrix_from_rotation_vector(step[:, ROTATION]),
            self.positions + step[:, POSITION],
            self.velocities + step[:, VELOCITY],
            self.biases + step[:, 9:],
        )


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoses:
    """Measured poses of states relative to the ones before, `earlier_from_later`."""

    knots: Int64Array  # (F,) int64, numbers of the earlier states
    rotations: Float64Array  # (F, 3, 3)
    translations: Float64Array  # (F, 3) [m]
    information: Float64Array  # (F, 6, 6) of rotation [rad] and translation


@dataclass(frozen=True, slots=True, eq=False)
class BodySpeeds:
    """Known speeds along body axes."""

    knots: Int64Array  # (F,) int64, numbers of the states
    axes: Float64Array  # (F, 3) unit vectors in the body frame
    speeds: Float64Array  # (F,) [m/s]
    sigmas: Float64Array  # (F,) [m/s]


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """All measurements of K states."""

    knots_ns: Int64Array  # (K,) int64 [ns], their times
    measured: BoolArray  # (K - 1,) bool, between which an IMU measured
    inertial: Preintegrated  # its measurements, for all K - 1 intervals; the others are ignored
    fixes: Fixes
    gravity: float  # [m/s²], down the world's z axis
    settings: SmootherSettings  # assumed noise
    relative: tuple[RelativePoses, ...] = ()
    speeds: tuple[BodySpeeds, ...] = ()
    information: Float64Array = field(init=False)  # (K - 1, 9, 9) of the IMU's measurements

    def __post_init__(self) -> None:
        information = np.zeros((len(self.measured), 9, 9))
        if self.measured.any():
            information[self.measured] = np.linalg.inv(self.inertial.covariances[self.measured])
        object.__setattr__(self, "information", information)

    @property
    def seconds(self) -> Float64Array:
        """(K - 1,) between the states."""
        return np.asarray(np.diff(self.knots_ns) * 1e-9, np.float64)

    def part(self, first: int, last: int) -> "Chain":
        """The measurements of states `first` to `last`, without the latter."""
        rows = slice(first, last - 1)
        return replace(
            self,
            knots_ns=self.knots_ns[first:last],
            measured=self.measured[rows],
            inertial=_rows(self.inertial, rows),
            fixes=_within(self.fixes, first, last),
            relative=tuple(_within(one, first, last - 1) for one in self.relative),
            speeds=tuple(_within(one, first, last) for one in self.speeds),
        )


_MAX_DAMPINGS = 12
_LARGEST_DAMPING = 1e3  # equations that are not solvable with this share of the diagonal added contain no numbers
_UNKNOWN_SPEED, _UNKNOWN_ROTATION, _TILT = 100.0, np.pi, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Normal equations around states: (K, 15, 15), (K - 1, 15, 15), (K, 15); the cost; fix residuals (F, 3) [m]."""

    blocks: Float64Array
    couplings: Float64Array
    right: Float64Array
    cost: float
    fix_residuals: Float64Array

    def solve(self, damping: float) -> tuple[bool, Float64Array, Float64Array, Float64Array]:
        """Whether they are positive definite; the solution (K, 15); factors and gains for the covariances."""
        factors, gains, solution = (np.empty_like(one) for one in (self.blocks, self.couplings, self.right))
        failed = solve_chain(self.blocks, self.couplings, self.right, damping, factors, gains, solution)
        return failed < 0, solution, factors, gains


def equations(chain: Chain, states: States, weights: Float64Array) -> _Equations:
    """Linearise all measurements around some states.

    Args:
        weights: (F,) of the fixes, 0 to 1.
    """
    count = len(states.positions)
    blocks, couplings = np.zeros((count, SIZE, SIZE)), np.zeros((count - 1, SIZE, SIZE))
    right = np.zeros((count, SIZE))
    normal = (blocks, couplings, right)
    cost = _add_priors(chain, states, blocks, right)
    cost += _add_motion(chain, states, normal)
    for relative in chain.relative:
        cost += kernels.add_relative_poses(
            states.rotations, states.positions, relative.knots, relative.rotations, relative.translations,
            relative.information, *normal,
        )  # fmt: skip
    for speeds in chain.speeds:
        cost += kernels.add_body_speeds(
            states.rotations, states.velocities, speeds.knots, speeds.axes, speeds.speeds, speeds.sigmas**-2.0,
            blocks, right,
        )  # fmt: skip
    fixes = chain.fixes
    fix_residuals = np.empty((len(fixes), 3))
    cost += kernels.add_fixes(
        states.rotations, states.positions, states.velocities, states.biases, fixes.knots, fixes.seconds,
        fixes.positions, fixes.levers, fixes.falls, fixes.slopes, fixes.biases,
        weights[:, None] * fixes.sigmas**-2.0, blocks, right, fix_residuals,
    )  # fmt: skip
    return _Equations(*normal, cost, fix_residuals)


def _add_priors(chain: Chain, states: States, blocks: Float64Array, right: Float64Array) -> float:
    """The prior of the first state; without an IMU, that it is about upright."""
    settings = chain.settings
    cost = 0.0
    for rows, value, sigma in (
        (VELOCITY, states.velocities[0], _UNKNOWN_SPEED),
        (GYROSCOPE, states.biases[0, :3], settings.gyroscope_bias),
        (ACCELEROMETER, states.biases[0, 3:], settings.accelerometer_bias),
    ):
        blocks[0, rows, rows] += np.eye(3) * sigma**-2
        right[0, rows] -= value * sigma**-2
        cost += float(value @ value) * sigma**-2
    blocks[0, ROTATION, ROTATION] += np.eye(3) * _UNKNOWN_ROTATION**-2
    if not chain.measured.any():
        k = next((int(one.knots[0]) for one in chain.relative if len(one.knots)), 0)
        slope = np.cross(states.rotations[k], [0.0, 0.0, -1.0])[:2]
        tilt = states.rotations[k][:2, 2]
        blocks[k, ROTATION, ROTATION] += slope.T @ slope * _TILT**-2
        right[k, ROTATION] -= slope.T @ tilt * _TILT**-2
        cost += float(tilt @ tilt) * _TILT**-2
    return cost


def _add_motion(chain: Chain, states: States, normal: tuple[Float64Array, Float64Array, Float64Array]) -> float:
    settings, seconds, inertial = chain.settings, chain.seconds, chain.inertial
    walks = np.repeat([settings.gyroscope_walk, settings.accelerometer_walk], 3)
    cost = kernels.add_walk(states.biases, 1.0 / (seconds[:, None] * walks**2), *normal)
    cost += kernels.add_inertial(
        states.rotations, states.positions, states.velocities, states.biases, seconds, chain.gravity,
        np.flatnonzero(chain.measured), inertial.rotations, inertial.velocities, inertial.positions, inertial.slopes,
        chain.information, inertial.biases, *normal,
    )  # fmt: skip
    coasting = np.flatnonzero(~chain.measured)
    if len(coasting):
        cost += kernels.add_coasting(
            states.positions, states.velocities, seconds, coasting, settings.acceleration**2, *normal
        )
        unrotated, unmoved = np.tile(np.eye(3), (len(coasting), 1, 1)), np.zeros((len(coasting), 3))
        information = np.zeros((len(coasting), 6, 6))
        information[:, :3, :3] = np.eye(3) / (settings.rotating**2 * seconds[coasting, None, None])
        cost += kernels.add_relative_poses(
            states.rotations, states.positions, coasting, unrotated, unmoved, information, *normal
        )
    return float(cost)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A step towards states that fit better."""

    states: States  # after the step
    equations: _Equations  # around these, with the weights of the step
    damping: float  # to begin the next step with


def step(
    chain: Chain, states: States, weights: Float64Array, damping: float, *, here: _Equations | None = None
) -> Step:
    """One step of Levenberg and Marquardt; the states stay where none reduces the cost.

    Args:
        here: equations around the states with these weights, where known.

    Source: Madsen, Nielsen and Tingleff 2004, "Methods for Non-Linear Least Squares Problems", 3.2.
    """
    here = equations(chain, states, weights) if here is None else here
    for _ in range(_MAX_DAMPINGS):
        definite, solution, _, _ = here.solve(damping)
        if definite and np.isfinite(solution).all():
            stepped = states.stepped(solution)
            there = equations(chain, stepped, weights)
            if there.cost <= here.cost * (1.0 + 1e-12) + 1e-12:
                return Step(stepped, there, 0.0 if damping < 1e-8 else damping / 10.0)
        damping = max(10.0 * damping, 1e-6)
    return Step(states, here, damping)


def inertial_residuals(chain: Chain, states: States) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Residuals of the IMU's measurements, (K - 1, 9), and slopes by both states, (K - 1, 9, 15).

    The slopes of the rotation leave out what is second order in its residual.
    """
    seconds, inertial = chain.seconds[:, None], chain.inertial
    changes = np.einsum("nij,nj->ni", inertial.slopes, states.biases[:-1] - inertial.biases)
    before, inverse = states.rotations[:-1], np.swapaxes(states.rotations[:-1], 1, 2)
    relative = inverse @ states.rotations[1:]
    predicted = inertial.rotations @ matrix_from_rotation_vector(changes[:, :3])
    apart = np.swapaxes(predicted, 1, 2) @ relative
    down = np.array([0.0, 0.0, -chain.gravity])
    gain = np.diff(states.velocities, axis=0) - seconds * down
    distance = np.diff(states.positions, axis=0) - seconds * states.velocities[:-1] - 0.5 * seconds**2 * down
    velocity, position = (np.einsum("nji,nj->ni", before, vector) for vector in (gain, distance))
    rotation = rotation_vector_from_matrix(apart)
    residuals = np.hstack([rotation, velocity - inertial.velocities, position - inertial.positions])
    residuals[:, 3:] -= changes[:, 3:]
    first, second = np.zeros((len(seconds), 9, SIZE)), np.zeros((len(seconds), 9, SIZE))
    first[:, :3, ROTATION], second[:, :3, ROTATION] = -np.swapaxes(relative, 1, 2), np.eye(3)
    first[:, 3:6, ROTATION], first[:, 6:9, ROTATION] = cross_matrix(velocity), cross_matrix(position)
    first[:, 3:6, VELOCITY], second[:, 3:6, VELOCITY] = -inverse, inverse
    first[:, 6:9, POSITION], second[:, 6:9, POSITION] = -inverse, inverse
    first[:, 6:9, VELOCITY] = -seconds[:, :, None] * inverse
    first[:, :, 9:] = -inertial.slopes
    return residuals, first, second


_HUBER = 1.5  # standard deviations from which on a fix loses weight while the states are still far off
_MOST_STEPS = 30
_CONVERGED = 1e-4  # relative change of the cost below which no further step is made

_MOST_ROUNDS, _FEW_STEPS, _MOST_CHANGES = 25, 4, 3
"""Rounds of rejecting and readmitting fixes, steps in each, and how often one fix may change."""

_READMITTED, _AROUND = 0.7, 2
"""A fix is readmitted well inside the gate; of so many neighbours on each side only the worst is rejected at a time."""

_MEDIAN_FLAT, _MEDIAN_UP, _MEDIAN_ROOT = 1.3863, 0.4549, 0.888
"""Medians of chi-square with two degrees of freedom, with one, and of the root of a third of it with three."""

_INSIDE_FLAT, _INSIDE_UP = 5.991, 3.841  # 95 % of chi-square with two degrees of freedom, and with one
_REPORTED_WORTH = 1.0  # the reported accuracy of a receiver counts as this many measurements of it
_INERTIAL_WORTH = 6.0  # the noise seen in the samples counts as this many measurements of it
_LEAST_SCALE, _LARGEST_SCALE = 1e-3, 1e3

_DRIFT_SECONDS, _DRIFT_WORTH, _RARE_DRIFT, _LEAST_DRIFT, _DRIFT_LASTS = 60.0, 0.3, 9.0, 1e-10, 10.0
"""Assumed time constant [s] of the fixes' slow errors, by which their drift begins; what this counts as in measurements
of it; the largest square that counts, in units of the expected; the least drift [m²]; and how long [s] one speed of the
drift lasts, about the time over which a receiver smooths."""

_NEAR_WORTH = 32.0
"""What the drift of a whole drive counts as in measurements of that within `_DRIFT_LASTS`: receivers drift more at some
times than at others, as signals come and go."""

_AXES = (slice(0, 2), slice(2, 3))  # across, and height


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """States that fit the measurements of a chain, with weights (F,) of the fixes, 0 to 1, and the cost."""

    chain: Chain
    states: States
    weights: Float64Array
    cost: float

    def equations(self) -> _Equations:
        """The equations around the states."""
        return equations(self.chain, self.states, self.weights)

    def covariances(self) -> tuple[Float64Array, Float64Array]:
        """The covariance of each state, (K, 15, 15), and with the next, (K - 1, 15, 15)."""
        here = self.equations()
        damping = 0.0
        while not (solved := here.solve(damping))[0]:
            if damping > _LARGEST_DAMPING:
                raise PoseError("the measurements do not determine the trajectory: their equations have no solution")
            damping = max(10.0 * damping, 1e-14)
        own, between = np.empty_like(here.blocks), np.empty_like(here.couplings)
        chain_covariances(*solved[2:], own, between)
        return own, between

    def fix_variances(self, own: Float64Array) -> tuple[Float64Array, Float64Array]:
        """(F, 3) residuals of the fixes [m], and variances of the antenna positions [m²] by `own` of the states."""
        variances = self.chain.fixes.variances(self.states.rotations, own)
        return self.equations().fix_residuals, variances


def _fit_robustly(chain: Chain, states: States) -> _Fit:
    """Fit with weights that fall off slowly (Huber 1964), so that no start is too far off."""
    damping, cost = 1e-4, np.inf
    weights = np.ones(len(chain.fixes))
    here = equations(chain, states, weights)
    for _ in range(_MOST_STEPS):
        roots = np.sqrt(np.maximum(_squares(chain.fixes, here) / 3.0, 1e-30))
        middle = float(np.median(roots)) if len(roots) else _MEDIAN_ROOT
        bend = _HUBER * max(middle / _MEDIAN_ROOT, _LEAST_SCALE)
        weights = np.minimum(1.0, bend / roots)
        made = step(chain, states, weights, damping)
        states, damping, here = made.states, made.damping, made.equations
        squares = _squares(chain.fixes, here)
        roots = np.sqrt(squares / 3.0)
        huber = np.where(roots <= bend, squares, 3.0 * (2.0 * bend * roots - bend**2))
        total = here.cost - float((weights * squares).sum()) + float(huber.sum())
        if abs(cost - total) <= _CONVERGED * total:
            break
        cost = total
    return _Fit(chain, states, weights, total)


def _squares(fixes: Fixes, here: _Equations) -> Float64Array:
    """(F,) squared distance of each fix in standard deviations."""
    return np.asarray(((here.fix_residuals / fixes.sigmas) ** 2).sum(axis=1), np.float64)


def _fit_rejecting(fit: _Fit, *, scaled: bool) -> _Fit:
    """Fit with weights 0 or 1: fixes that jump are rejected, worst first, and may return; `scaled`: noise is known."""
    # each fix is compared with the prediction from the others, so that one at an end or in a gap, which bends the
    # trajectory to itself, is found too; until the noise is scaled it comes from the median of these distances
    # Source: Baarda 1968, "A Testing Procedure for Use in Geodetic Networks"; in 2D, Rayleigh's distribution
    states, weights = fit.states, fit.weights
    changes = np.zeros(len(weights), np.int64)
    for number in range(_MOST_ROUNDS):
        if number or scaled:
            states = _fit_weighted(fit.chain, states, weights, _FEW_STEPS).states
        ratios = _gate_ratios(_Fit(fit.chain, states, weights, 0.0), scaled=scaled)
        allowed = changes < _MOST_CHANGES
        held = np.pad(np.where(weights > 0, ratios, -np.inf), _AROUND, constant_values=-np.inf)
        worst = held[_AROUND:-_AROUND] >= np.lib.stride_tricks.sliding_window_view(held, 2 * _AROUND + 1).max(axis=1)
        dropped = (ratios > 1.0) & (weights > 0) & worst & allowed
        taken = (ratios < _READMITTED) & (weights == 0) & allowed
        full = np.where(dropped, 0.0, np.where(taken | (weights > 0), 1.0, 0.0))
        if (number or scaled) and (full == weights).all():
            break
        changes += (full > 0) != (weights > 0)
        weights = full
    return _fit_weighted(fit.chain, states, weights, _MOST_STEPS)


def _fit_weighted(chain: Chain, states: States, weights: Float64Array, steps: int) -> _Fit:
    """Make steps with given weights until nothing changes."""
    damping = 0.0
    here = equations(chain, states, weights)
    for _ in range(steps):
        made = step(chain, states, weights, damping, here=here)
        converged = here.cost - made.equations.cost <= _CONVERGED * here.cost
        states, damping, here = made.states, made.damping, made.equations
        if converged:
            break
    return _Fit(chain, states, weights, here.cost)


def _gate_ratios(fit: _Fit, *, scaled: bool) -> Float64Array:
    """(F,) squared distances of the fixes from the predictions by the others, in units of the gate's."""
    fixes, weights = fit.chain.fixes, fit.weights
    residuals, spread = fit.fix_variances(fit.covariances()[0])
    known = np.where(weights[:, None] > 0, -weights[:, None] * spread, spread)
    apart = residuals**2 / np.maximum(fixes.sigmas**2 + known, 0.05 * fixes.sigmas**2)
    flat, up = apart[:, :2].sum(axis=1), apart[:, 2]
    rare = math.erfc(fit.chain.settings.gate / math.sqrt(2.0))
    ratios = np.empty(len(fixes))
    for receiver in np.unique(fixes.receivers):
        rows = fixes.receivers == receiver
        if not scaled:
            flat[rows] /= max(np.median(flat[rows]) / _MEDIAN_FLAT, _LEAST_SCALE**2)
            up[rows] /= max(np.median(up[rows]) / _MEDIAN_UP, _LEAST_SCALE**2)
        taken = np.clip(known[rows] / fixes.sigmas[rows] ** 2, -1.0, 0.0)
        free = (weights[rows, None] * (1.0 + taken)).sum(axis=0)
        across = _rarity(flat[rows], float(free[:2].sum()), 2, scaled=scaled)
        height = _rarity(up[rows], float(free[2]), 1, scaled=scaled)
        ratios[rows] = np.maximum(across, height) / -math.log(rare)
    # what is inside the 95 % region that a receiver reports is no jump
    inside = (residuals[:, :2] ** 2).sum(axis=1) < _INSIDE_FLAT * fixes.stated[:, 0] ** 2
    ratios[inside & (residuals[:, 2] ** 2 < _INSIDE_UP * fixes.stated[:, 2] ** 2)] = 0.0
    return ratios


def _rarity(distances: Float64Array, free: float, axes: int, *, scaled: bool) -> Float64Array:
    """How rare distances are, as minus the logarithm; for one axis as if it were two, which is nearly the same."""
    # Source: where the noise comes from the residuals, Pope 1976, "The Statistics of Residuals and the Detection of
    # Outliers", for two axes in closed form: one that jumps contributes to it, the more, the fewer there are
    if scaled and free > axes + 1.0:
        return np.asarray(-0.5 * (free - axes) * np.log(np.maximum(1.0 - distances / free, 1e-12)), np.float64)
    return 0.5 * distances


def _rescaled(fit: _Fit, own: Float64Array) -> _Fit:
    """Scale the fixes' noise to their residuals: the sum of squares over the redundancy (Förstner 1979)."""
    chain, fixes = fit.chain, fit.chain.fixes
    residuals, spread = fit.fix_variances(own)
    share = (fit.weights[:, None] / fixes.sigmas**2) * spread
    redundancy = fit.weights[:, None] * np.clip(1.0 - share, 0.0, 1.0)
    weighted = fit.weights[:, None] * (residuals / fixes.sigmas) ** 2
    factors = np.ones((len(fixes), 3))
    for receiver in np.unique(fixes.receivers):
        rows = fixes.receivers == receiver
        for axes in _AXES:
            total = weighted[rows, axes].sum() + _REPORTED_WORTH
            free = redundancy[rows, axes].sum() + _REPORTED_WORTH
            factors[rows, axes] = np.clip(np.sqrt(total / free), _LEAST_SCALE, _LARGEST_SCALE)
    sigmas = np.maximum(fixes.sigmas * factors, chain.settings.least_fix_noise)
    return replace(fit, chain=replace(chain, fixes=replace(fixes, sigmas=sigmas)))


def _inertial_noise(
    fit: _Fit, drifts: Float64Array, own: Float64Array, between: Float64Array
) -> tuple[float, Float64Array]:
    """The factor, at least 1, by which the gyroscope's noise exceeds the assumed one, and the drifts as they are."""
    # Source: Förstner 1979 as `_rescaled`; the drifts are added to the IMU's noise, so that their update is that of Rao
    # 1971, "Estimation of Variance and Covariance Components", one share of the expected squares at a time
    rows = np.flatnonzero(fit.chain.measured)
    if len(rows) == 0:
        return 1.0, drifts
    residuals, first, second = inertial_residuals(fit.chain, fit.states)
    covariances = fit.chain.inertial.covariances[rows]
    residuals, first, second = residuals[rows], first[rows], second[rows]
    crossed = first @ between[rows] @ second.swapaxes(1, 2)
    taken = first @ own[rows] @ first.swapaxes(1, 2) + second @ own[rows + 1] @ second.swapaxes(1, 2)
    left = covariances - taken - crossed - crossed.swapaxes(1, 2)
    whitened = np.linalg.inv(np.linalg.cholesky(covariances[:, :3, :3]))
    redundancy = np.clip(np.einsum("nij,njk,nik->ni", whitened, left[:, :3, :3], whitened), 0.0, 1.0)
    squares = np.einsum("nij,nj->ni", whitened, residuals[:, :3]) ** 2
    factor = math.sqrt((squares.sum() + _INERTIAL_WORTH) / (redundancy.sum() + _INERTIAL_WORTH))
    # velocity and position along each of the world's axes
    inverse = (fit.states.rotations[rows, None] @ np.linalg.inv(covariances)[:, 3:].reshape(-1, 2, 3, 9)).swapaxes(1, 2)
    weighted, expected = np.einsum("naij,nj->nai", inverse, residuals), inverse @ left[:, None] @ inverse.swapaxes(2, 3)
    drifts, seconds = drifts.copy(), fit.chain.knots_ns[rows] * 1e-9
    begins, ends = (np.searchsorted(seconds, seconds + sign * _DRIFT_LASTS) for sign in (-1.0, 1.0))
    for k, shape in enumerate(_drift_shapes(fit.chain.seconds[rows])):
        known = drifts[k, rows] * (shape[:, None] * expected).sum(axis=(2, 3))
        found = drifts[k, rows] * np.einsum("nai,nij,naj->na", weighted, shape, weighted)
        found = np.minimum(found, _RARE_DRIFT * np.maximum(known, 0.0))
        for axes in _AXES:
            squares = np.stack([found[:, axes].sum(axis=1), known[:, axes].sum(axis=1)], axis=1)
            total = squares.sum(axis=0) + _DRIFT_WORTH
            sums = _running_sums(squares)
            near = sums[ends] - sums[begins] + _NEAR_WORTH * total / total[1]
            drifts[k, :, axes] *= total[0] / total[1]
            drifts[k, rows, axes] *= (near[:, 0] / near[:, 1] * (total[1] / total[0]))[:, None]
    return min(max(1.0, factor), _LARGEST_SCALE), np.maximum(drifts, _LEAST_DRIFT)


def _drift_shapes(seconds: Float64Array) -> Float64Array:
    """(2, F, 2, 2) covariances of velocity and position by a drift of 1 m² in F intervals: rough, and smooth."""
    rough, one = np.zeros((len(seconds), 2, 2)), np.ones_like(seconds)
    rough[:, 1, 1] = 1.0
    smooth = np.array([[3.0 / seconds**2, 1.5 / seconds], [1.5 / seconds, one]])
    return np.stack([rough, np.moveaxis(smooth, 2, 0)])


def _drift_speeds(drifts: Float64Array, seconds: Float64Array) -> Float64Array:
    """(K, 3) variances of the speed with which the fixes drift at the states."""
    squares = 3.0 * _DRIFT_LASTS * drifts[1] / seconds[:, None] ** 3
    return np.asarray(np.maximum(np.vstack([squares, squares[-1:]]), np.vstack([squares[:1], squares])))


def _drifting(inertial: Preintegrated, rotations: Float64Array, seconds: Float64Array, drifts: Float64Array) -> None:
    """Let what receivers report drift against the IMU, by variances (2, F, 3) [m²] in intervals (F,) [s].

    Args:
        rotations: (F, 3, 3) orientations at their beginnings.
    """
    for drift, shape in zip(drifts, _drift_shapes(seconds), strict=True):
        turned = rotations.swapaxes(1, 2) @ (drift[:, :, None] * rotations)
        inertial.covariances[:, 3:, 3:] += np.einsum("nkm,nij->nkimj", shape, turned).reshape(-1, 6, 6)


_FIRST_DISTANCE, _FIRST_SECONDS, _FIRST_KNOTS = 30.0, 10.0, 12
"""The first part that is fitted is so long [m], [s], as far as there is as much."""

_SPAN = 1.0  # gains of velocity are compared over this time [s], so that the noise of velocities counts less
_QUARTERS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)

_SURELY_BETTER = 9.0
"""A start with another heading than that of the motion has to fit better by so much: three standard deviations."""


def _initial_states(chain: Chain, gyroscope_bias: Float64Array | None) -> States:
    """States at the fixes, level, heading east, without speed."""
    count, fixes, start_ns = len(chain.knots_ns), chain.fixes, chain.knots_ns[0]
    seconds, measured = (chain.knots_ns - start_ns) * 1e-9, (fixes.timestamps_ns - start_ns) * 1e-9
    positions = np.stack([np.interp(seconds, measured, column) for column in fixes.positions.T], axis=1)
    biases = np.zeros((count, 6))
    if gyroscope_bias is not None:
        biases[:, :3] = gyroscope_bias
    return States(np.tile(np.eye(3), (count, 1, 1)), positions, np.zeros((count, 3)), biases)


def _oriented(chain: Chain, coasting: States) -> _Fit:
    """Fit fixes and IMU: a first part from several headings, then more and more of the drive around it."""
    count = len(chain.knots_ns)
    first, last = _first_part(chain, coasting)
    fit = _best_of_headings(chain.part(first, last), _rows(coasting, slice(first, last)))
    while first > 0 or last < count:
        length = last - first
        earlier, later = max(first - length, 0), min(last + length, count)
        states = _extended(chain, coasting, fit.states, (earlier, first, last, later))
        fit = _fit_robustly(chain.part(earlier, later), states)
        first, last = earlier, later
    return fit


def _first_part(chain: Chain, states: States) -> tuple[int, int]:
    """The first knots over which the IMU measured without a gap and the ego moved far enough, else the longest."""
    seconds = np.concatenate([[0.0], np.cumsum(chain.seconds)])
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(states.positions, axis=0), axis=1))])
    longest = (0, min(2, len(seconds)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chain.measured, [False]]).astype(np.int8)))
    for first, stop in edges.reshape(-1, 2).tolist():
        last = stop + 1
        enough = (
            (distance[first:last] - distance[first] >= _FIRST_DISTANCE)
            & (seconds[first:last] - seconds[first] >= _FIRST_SECONDS)
            & (np.arange(last - first) >= _FIRST_KNOTS)
        )
        if enough.any():
            end = first + int(np.argmax(enough)) + 1
            start = int(np.searchsorted(distance, distance[end - 1] - 1.5 * _FIRST_DISTANCE))
            start = min(start, int(np.searchsorted(seconds, seconds[end - 1] - _FIRST_SECONDS)))
            return max(first, start), end
        if distance[last - 1] - distance[first] > distance[longest[1] - 1] - distance[longest[0]]:
            longest = (first, last)
    return longest


def _best_of_headings(chain: Chain, states: States) -> _Fit:
    """Try several headings; where they fit equally well, the ego heads where it moves."""
    # (K, 3, 3) `first_from_body` by the gyroscope alone
    rotations = np.tile(np.eye(3), (len(chain.knots_ns), 1, 1))
    for k, measured in enumerate(chain.measured):
        rotations[k + 1] = rotations[k] @ chain.inertial.rotations[k] if measured else rotations[k]
    level = _levelled(chain, states, rotations)
    ahead, speed = (level @ rotations)[:, :2, 0], states.velocities[:, :2]
    sine = (ahead[:, 0] * speed[:, 1] - ahead[:, 1] * speed[:, 0]).sum()
    along_motion = float(np.arctan2(sine, (ahead * speed).sum()))
    fits = [
        _fit_robustly(chain, replace(states, rotations=_about_up(angle) @ level @ rotations))
        for angle in (along_motion, *_QUARTERS)
    ]
    best = min(fits, key=lambda fit: fit.cost)
    return fits[0] if fits[0].cost <= best.cost + _SURELY_BETTER else best


def _levelled(chain: Chain, states: States, rotations: Float64Array) -> Float64Array:
    """The first knot's orientation by which the IMU's gains of velocity match those of the fixes, and gravity."""
    # Source: Wahba 1965, solved by singular values as in Markley 1988
    seconds, measured = chain.seconds, chain.measured
    of_imu = np.einsum("kij,kj->ki", rotations[:-1], chain.inertial.velocities)[measured]
    of_fixes = (np.diff(states.velocities, axis=0) + seconds[:, None] * [0.0, 0.0, chain.gravity])[measured]
    span = np.floor(np.cumsum(seconds[measured]) / _SPAN).astype(np.int64)
    sums = [np.stack([np.bincount(span, column) for column in one.T], axis=1) for one in (of_imu, of_fixes)]
    return nearest_rotation(sums[1].T @ sums[0])[0]


def _about_up(angle: float) -> Float64Array:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _extended(chain: Chain, coasting: States, known: States, edges: tuple[int, int, int, int]) -> States:
    """Continue orientations by the gyroscope beyond both ends of what is known; the rest comes from the fixes."""
    # `edges`: the wanted states begin at the first and end at the last, the known ones begin and end between
    earlier, first, last, later = edges
    before, after = _rows(coasting, slice(earlier, first)), _rows(coasting, slice(last, later))
    joined = States(*(np.concatenate([getattr(one, f.name) for one in (before, known, after)]) for f in fields(States)))
    rotations, biases = joined.rotations, joined.biases
    biases[: first - earlier], biases[last - earlier :] = known.biases[0], known.biases[-1]
    inside = slice(earlier, later - 1)
    changes = np.einsum("nij,nj->ni", chain.inertial.slopes[inside, :3], biases[:-1] - chain.inertial.biases[inside])
    between = chain.inertial.rotations[inside] @ matrix_from_rotation_vector(changes)
    between[~chain.measured[inside]] = np.eye(3)
    for k in range(last - 1 - earlier, later - 1 - earlier):
        rotations[k + 1] = rotations[k] @ between[k]
    for k in range(first - 1 - earlier, -1, -1):
        rotations[k] = rotations[k + 1] @ between[k].T
    return joined


_QUIET_SECONDS, _LEAST_SAMPLES = 1.0, 15  # the IMU is judged over so long, and so many samples at least
_YAW_RATE = 0.02  # largest mean angular velocity of a stationary ego, without the bias [rad/s]
_SPEED, _DEVIATIONS = 0.2, 3.0  # largest speed of a stationary ego by the fixes [m/s], plus so many standard deviations

_STILL_SPEED, _STILL_ROTATION, _STILL_DISTANCE = 0.02, 2e-4, 2e-3
"""Standard deviations of a stationary ego [m/s], and from one state to the next [rad] and [m]."""

_WIDE = 1.5  # excess of the variance over that of white noise by chance, with few samples


def _standstill(
    fit: _Fit, own: Float64Array, samples: InertialSamples, drifts: Float64Array
) -> tuple[tuple[BodySpeeds, ...], tuple[RelativePoses, ...]]:
    """Measurements of the states at which the ego is stationary; `own` (K, 15, 15) covariances of the states."""
    # IMU samples are white noise without sway, and fixes show no speed: a smooth even drive passes the first test alone
    # Source: Skog, Händel, Nilsson and Rantakokko 2010, "Zero-Velocity Detection - An Algorithm Evaluation"
    chain, states = fit.chain, fit.states
    still = _quiet(samples, chain.knots_ns, states.biases)
    still[:-1] &= chain.measured
    still[1:] &= chain.measured
    sigma = np.sqrt(np.einsum("kii->k", own[:, VELOCITY, VELOCITY]))
    still &= np.linalg.norm(states.velocities, axis=1) < _SPEED + _DEVIATIONS * sigma
    rows = np.flatnonzero(still)
    if len(rows) < 2:
        return (), ()
    count = 3 * len(rows)
    axes = np.tile(np.eye(3), (len(rows), 1))
    drifting = _drift_speeds(drifts, chain.seconds)
    sigmas = np.sqrt(_STILL_SPEED**2 + drifting[rows].ravel())
    speeds = BodySpeeds(np.repeat(rows, 3), axes, np.zeros(count), sigmas)
    knots = np.flatnonzero(still[:-1] & still[1:])
    unrotated, rotations = np.tile(np.eye(3), (len(knots), 1, 1)), states.rotations[knots]
    information = np.zeros((len(knots), 6, 6))
    information[:, :3, :3] = np.eye(3) * _STILL_ROTATION**-2
    distances = _STILL_DISTANCE**2 + drifts[0, knots] + chain.seconds[knots, None] ** 2 * drifting[knots]
    information[:, 3:, 3:] = rotations.swapaxes(1, 2) @ (rotations / distances[:, :, None])
    return (speeds,), (RelativePoses(knots, unrotated, np.zeros((len(knots), 3)), information),)


def _quiet(samples: InertialSamples, knots_ns: Int64Array, biases: Float64Array) -> BoolArray:
    """Whether the IMU is quiet around each state."""
    count = len(samples.timestamps_ns)
    width = max(round(_QUIET_SECONDS / samples.period), _LEAST_SAMPLES)
    if count <= width:
        return np.zeros(len(knots_ns), np.bool_)
    common = samples.values.mean(axis=0)
    values = samples.values - common
    sums, squares = _running_sums(values), _running_sums(values**2)
    steps = _running_sums(np.vstack([np.diff(values, axis=0) ** 2, np.zeros((1, 6))]))
    middle = np.searchsorted(samples.timestamps_ns, knots_ns)
    first = np.clip(middle - width // 2, 0, count - width)
    mean = (sums[first + width] - sums[first]) / width
    variance = np.maximum((squares[first + width] - squares[first]) / width - mean**2, 0.0)
    successive = (steps[first + width - 1] - steps[first]) / (width - 1)
    calm = (variance < np.repeat([QUIET_RATE**2, QUIET_FORCE**2], 3)).all(axis=1)
    white = (variance <= _WIDE * WHITE * successive / 2 + 1e-20).all(axis=1)
    rate = mean[:, :3] + common[:3] - biases[:, :3]
    return np.asarray(calm & white & (np.abs(rate) < _YAW_RATE).all(axis=1), np.bool_)


def _always_stands(drive: "_Drive", fit: _Fit) -> bool:
    """Whether nothing determines the heading: what drifting fixes of one antenna seem to report of it is noise."""
    samples, chain = drive.samples, fit.chain
    if samples is None or drive.lidar is not None or np.ptp(drive.fixes.levers, axis=0).any():
        return False
    measured = np.append(chain.measured, False) & np.insert(chain.measured, 0, False)
    fastest = np.linalg.norm(fit.states.velocities, axis=1).max()
    if not measured.any() or fastest >= (_SPEED if chain.settings.vehicle else _MOVING):
        return False
    return bool(_quiet(samples, chain.knots_ns, fit.states.biases)[measured].all())


def _about_up_anyhow(rotations: Float64Array) -> Float64Array:
    """(N, 3, 3) covariance, about the ego's axes, of a heading that may be any."""
    return np.asarray(math.pi**2 / 3.0 * rotations[:, 2, :, None] * rotations[:, 2, None, :], np.float64)


_EVERY = 1.0  # the vehicle constraint is used this often [s]: its errors are correlated over about so long

_SLIP, _AXIS, _LEVER = 0.1, 0.02, 0.5
"""Its errors: a slip [m/s], a share of the speed since the axis is not exactly the body's, and the angular velocity
times a lever [m], since the axle that does not slip is elsewhere."""

_MOVING = 2.0  # speed from which on a direction of motion counts [m/s]

_LEAST_ROTATION, _LEAST_KNOTS = np.radians(40.0), 8
"""To show that it holds, the ego has to rotate so far while it moves, over so many states."""

_FAST = 5.0  # or its mean speed is this [m/s], along its x axis
_LARGEST_SHARE = 0.3  # sideways speeds have to be known to be below this share of the speed
_LARGEST_MISFIT = 2.0  # largest mean square of sideways speeds in units of their standard deviations
_CONTRADICTED = 3.0  # mean square misfit of constraints, in standard deviations, from which on they are dropped


def _vehicle_speeds(
    fit: _Fit, own: Float64Array, samples: InertialSamples, drifts: Float64Array
) -> tuple[BodySpeeds, ...]:
    """No speed across the vehicle's axis as measurements, if the states show that it holds, or it is asked for."""
    # it has to show in rotations, or at speed along x: on a straight line every body moves along one axis
    # Source: Dissanayake, Sukkarieh, Nebot and Durrant-Whyte 2001, "The Aiding of a Low-Cost Strapdown IMU …"
    chain, states, asked = fit.chain, fit.states, fit.chain.settings.vehicle
    if asked is False:
        return ()
    velocities_body = np.einsum("nji,nj->ni", states.rotations, states.velocities)
    rates = _resampled(chain.knots_ns, samples.timestamps_ns, samples.values[:, :3]) - states.biases[:, :3]
    seconds = (chain.knots_ns - chain.knots_ns[0]) * 1e-9
    _, rows = np.unique(np.floor(seconds / _EVERY + 1e-6), return_index=True)
    speed, rate = np.linalg.norm(velocities_body[rows], axis=1), np.linalg.norm(rates[rows], axis=1)
    variances = _SLIP**2 + (_AXIS * speed) ** 2 + (_LEVER * rate) ** 2
    sigmas = np.repeat(np.sqrt(variances + _drift_speeds(drifts, chain.seconds)[rows, 0]), 2)
    # the body's own x axis, and that along which it moved most
    most = np.linalg.eigh(velocities_body.T @ velocities_body)[1][:, 2]
    for axis in (np.array([1.0, 0.0, 0.0]), most * np.sign(velocities_body.sum(axis=0) @ most or 1.0)):
        across = np.tile(np.linalg.svd(axis[None])[2][1:], (len(rows), 1))
        speeds = BodySpeeds(np.repeat(rows, 2), across, np.zeros(len(across)), sigmas)
        if asked or _holds(speeds, states, own, velocities_body):
            return (speeds,)
    return ()


def _holds(speeds: BodySpeeds, states: States, own: Float64Array, velocities_body: Float64Array) -> bool:
    """Whether states show that a body does not move across an axis."""
    knots, axes, velocities = speeds.knots, speeds.axes, velocities_body[speeds.knots]
    speed = np.linalg.norm(velocities, axis=1)
    moving = speed > _MOVING
    if moving.sum() < 2 * _LEAST_KNOTS:
        return False
    east, north, _ = states.velocities[np.unique(knots[moving])].T
    rotates = np.ptp(np.unwrap(np.arctan2(north, east))) >= _LEAST_ROTATION
    fast = speed[moving].mean() >= _FAST and abs(axes[:, 0]).max() < 1e-6
    if not (rotates or fast):
        return False
    slopes = np.zeros((len(knots), 15))
    slopes[:, ROTATION] = np.cross(axes, velocities)
    slopes[:, VELOCITY] = np.einsum("nij,nj->ni", states.rotations[knots], axes)
    variance = np.einsum("ni,nij,nj->n", slopes, own[knots], slopes)
    sideways = (axes * velocities).sum(axis=1)
    known = np.sqrt((sideways**2 + variance)[moving].mean()) < _LARGEST_SHARE * np.sqrt((speed[moving] ** 2).mean())
    agrees = (sideways**2 / (variance + speeds.sigmas**2))[moving].mean() < _LARGEST_MISFIT
    return bool(known and agrees)


def _misfit(speeds: BodySpeeds, states: States) -> float:
    """Mean squared residual of known speeds in standard deviations."""
    velocities = np.einsum("nji,nj->ni", states.rotations[speeds.knots], states.velocities[speeds.knots])
    apart = (speeds.axes * velocities).sum(axis=1) - speeds.speeds
    return float(((apart / speeds.sigmas) ** 2).mean())


_LIDAR_ROTATION, _LIDAR_DISTANCE = 3e-4, 5e-3
"""Least standard deviations of a step by odometry [rad] and [m]: the repeatability of a fit onto the map."""

_ALIGNMENT_ROUNDS = 8  # rounds of weighting the fixes by how they agree (L1)


def _lidar_steps(lidar: Trajectory, knots_ns: Int64Array) -> RelativePoses:
    """The steps from each state to the next within the odometry's trajectory, with the errors that they add."""
    found = lidar.poses.interpolate(knots_ns)
    inside = found.coverage == 0
    knots = np.flatnonzero(inside[:-1] & inside[1:])
    rotations = np.full((len(knots_ns), 3, 3), np.nan)
    rotations[inside] = matrix_from_quaternion(found.quaternions_xyzw[inside])
    before, after = rotations[knots], rotations[knots + 1]
    steps = found.positions[knots + 1] - found.positions[knots]
    added = _added_covariances(lidar, knots_ns, knots, steps)
    covariances = np.zeros((len(knots), 6, 6))
    covariances[:, :3, :3] = np.swapaxes(after, 1, 2) @ added[:, :3, :3] @ after
    covariances[:, 3:, 3:] = np.swapaxes(before, 1, 2) @ added[:, 3:, 3:] @ before
    covariances += np.diag(np.repeat([_LIDAR_ROTATION**2, _LIDAR_DISTANCE**2], 3))
    return RelativePoses(
        knots,
        np.swapaxes(before, 1, 2) @ after,
        np.einsum("nji,nj->ni", before, steps),
        np.asarray(np.linalg.inv(covariances), np.float64),
    )


def _added_covariances(lidar: Trajectory, knots_ns: Int64Array, knots: Int64Array, steps: Float64Array) -> Float64Array:
    """Growth of the odometry's covariance in each step beyond the propagated error before it, (F, 6, 6)."""
    if lidar.covariances is None:
        return np.zeros((len(knots), 6, 6))
    rows = np.clip(np.searchsorted(lidar.timestamps_ns, knots_ns), 0, len(lidar.timestamps_ns) - 1)
    known = lidar.covariances[rows]
    levers = np.tile(np.eye(6), (len(knots), 1, 1))
    levers[:, 3:, :3] = -cross_matrix(steps)
    grown = known[knots + 1] - levers @ known[knots] @ np.swapaxes(levers, 1, 2)
    values, axes = np.linalg.eigh(0.5 * (grown + np.swapaxes(grown, 1, 2)))
    return np.asarray((axes * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2), np.float64)


def _lidar_rotations(lidar: Trajectory, knots_ns: Int64Array, fixes: Fixes) -> Float64Array:
    """Orientations of the states, (K, 3, 3): the odometry's, its world rotated about up onto the fixes."""
    known = lidar.poses.held(knots_ns)
    here, there = known.positions[fixes.knots, :2], fixes.positions[:, :2]
    weights, rotation = np.ones(len(fixes)), np.eye(3)
    for _ in range(_ALIGNMENT_ROUNDS):
        share = weights / weights.sum()
        one, other = here - share @ here, there - share @ there
        dot = (share[:, None] * one * other).sum()
        cross = (share * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])).sum()
        rotation = _about_up(float(np.arctan2(cross, dot)))
        apart = np.hypot(*(one @ rotation[:2, :2].T - other).T)
        weights = 1.0 / np.maximum(apart, 0.1)
    return np.asarray(rotation @ matrix_from_quaternion(known.quaternions_xyzw), np.float64)


_SMOOTHER_ROUNDS = 10  # how often the noise is estimated anew from the residuals
_LARGEST_RATIO = 0.75  # largest ratio of successive changes that is believed when they are extrapolated


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    """The measurements of a drive."""

    fixes: GnssFixes  # at least two
    samples: InertialSamples | None
    lidar: Trajectory | None  # by lidar odometry
    gravity: float  # [m/s²]
    gyroscope_bias: Float64Array | None  # (3,) [rad/s], the initial one


def _smoothed(drive: _Drive, settings: SmootherSettings) -> _Fit:
    """Find the states that fit all measurements best."""
    fixes, samples, lidar = drive.fixes, drive.samples, drive.lidar
    further = np.empty(0, np.int64) if samples is not None or lidar is None else lidar.timestamps_ns
    knots = knot_times(fixes.timestamps_ns, samples, further, settings)
    count = len(knots) - 1
    biases, densities = np.zeros((count, 6)), np.zeros((count, 2))
    if drive.gyroscope_bias is not None:
        biases[:, :3] = drive.gyroscope_bias
    measured, inertial = np.zeros(count, np.bool_), Preintegrated.nothing(biases)
    variances = _resampled((knots[:-1] + knots[1:]) // 2, fixes.timestamps_ns, fixes.sigmas[:, [0, 0, 0]] ** 2)
    drifts = np.stack(2 * [np.diff(knots)[:, None] * 1e-9 / _DRIFT_SECONDS * variances])
    if samples is not None:
        measured = samples.is_measured(knots[:-1], knots[1:], slack_ns=samples.slack_ns)
        densities = samples.noise_densities((knots[:-1] + knots[1:]) // 2, settings)
        inertial = samples.preintegrated(knots, biases=biases, densities=densities)
        _drifting(inertial, np.tile(np.eye(3), (count, 1, 1)), np.diff(knots) * 1e-9, drifts)
    carried = fixes.carried(knots, measured, samples, biases=biases, gravity=drive.gravity)
    relative = () if lidar is None else (_lidar_steps(lidar, knots),)
    chain = Chain(knots, measured, inertial, carried, drive.gravity, settings, relative)
    coasting, chain = _coasted(drive, chain)
    if samples is not None:
        return _refined(_oriented(chain, coasting.states), fixes, samples, densities, drifts)
    fit = coasting
    if lidar is not None:
        rotations = _lidar_rotations(lidar, chain.knots_ns, chain.fixes)
        fit = _fit_robustly(chain, replace(coasting.states, rotations=rotations))
    fit = _fit_rejecting(fit, scaled=False)
    for _ in range(_SMOOTHER_ROUNDS):
        fit = _fit_rejecting(_rescaled(fit, fit.covariances()[0]), scaled=True)
    return fit


def _coasted(drive: _Drive, chain: Chain) -> tuple[_Fit, Chain]:
    """States by those fixes alone that have one, without an IMU, and the chain with the noise that these fixes show."""
    unmeasured = np.zeros_like(chain.measured)
    fixes = drive.fixes.carried(chain.knots_ns, unmeasured, None, biases=chain.inertial.biases, gravity=drive.gravity)
    near = np.abs(fixes.seconds) <= _CLOSEST_NS * 1e-9
    alone = replace(chain, measured=unmeasured, relative=(), fixes=_rows(fixes, near))
    fit = _fit_robustly(alone, _initial_states(alone, drive.gyroscope_bias))
    for _ in range(3):
        fit = _rescaled(fit, fit.covariances()[0])
        fit = _fit_robustly(fit.chain, fit.states)
    sigmas = chain.fixes.sigmas.copy()
    for receiver in np.unique(fixes.receivers[near]):
        rows = fixes.receivers == receiver
        found = fit.chain.fixes.sigmas[rows[near]]
        sigmas[rows] *= np.median(found / fixes.sigmas[near & rows], axis=0)
        sigmas[near & rows] = found
    return fit, replace(chain, fixes=replace(chain.fixes, sigmas=sigmas))


def _refined(
    fit: _Fit, fixes: GnssFixes, samples: InertialSamples, densities: Float64Array, drifts: Float64Array
) -> _Fit:
    """Fit again with estimated biases and noise, without fixes that jump, and with constraints on the ego's speed."""
    lidar = fit.chain.relative
    fit = _fit_rejecting(fit, scaled=False)
    earlier: list[tuple[Float64Array, Float64Array]] = []  # noise since it was extrapolated
    for number in range(_SMOOTHER_ROUNDS):
        own, between = fit.covariances()
        earlier.append((fit.chain.fixes.sigmas, drifts))
        factor, drifts = _inertial_noise(fit, drifts, own, between)
        densities = densities * [factor**2, 1.0]
        fit = _rescaled(fit, own)
        if len(earlier) == 2 and number < _SMOOTHER_ROUNDS - 2:
            # white noise and drift are hard to tell apart: rounds change them by little, but long in one direction
            sigmas, drifts = (_limit(*three) for three in zip(*earlier, (fit.chain.fixes.sigmas, drifts), strict=True))
            sigmas = np.maximum(sigmas, fit.chain.settings.least_fix_noise)
            fit = replace(fit, chain=replace(fit.chain, fixes=replace(fit.chain.fixes, sigmas=sigmas)))
            drifts = np.maximum(drifts, _LEAST_DRIFT)
            earlier.clear()
        chain, constrained = fit.chain, bool(fit.chain.speeds)
        if number >= _SMOOTHER_ROUNDS - 2:
            still, unmoved = _standstill(fit, own, samples, drifts)
            speeds = (*_vehicle_speeds(fit, own, samples, drifts), *still)
            chain = replace(chain, speeds=speeds, relative=(*lidar, *unmoved))
        knots, biases, again = chain.knots_ns, fit.states.biases[:-1], number in {0, _SMOOTHER_ROUNDS - 1}
        if again or factor > 1.0:
            undrifted = samples.preintegrated(knots, biases=biases, densities=densities)
            carried = fixes.carried(
                knots, chain.measured, samples, biases=biases, gravity=chain.gravity, sigmas=chain.fixes.sigmas
            )
            chain = replace(chain, fixes=carried)
        inertial = replace(undrifted, covariances=undrifted.covariances.copy())
        _drifting(inertial, fit.states.rotations[:-1], chain.seconds, drifts)
        fit = replace(fit, chain=replace(chain, inertial=inertial))
        if chain.speeds and not constrained:
            # fixes that bent the trajectory towards themselves show against the stiffer one
            fit = _fit_rejecting(_fit_robustly(fit.chain, fit.states), scaled=False)
        else:
            fit = _fit_rejecting(fit, scaled=True)
    believed = tuple(one for one in fit.chain.speeds if _misfit(one, fit.states) <= _CONTRADICTED)
    if len(believed) < len(fit.chain.speeds):
        fit = _fit_rejecting(replace(fit, chain=replace(fit.chain, speeds=believed, relative=lidar)), scaled=True)
    return fit


def _limit(first: Float64Array, second: Float64Array, third: Float64Array) -> Float64Array:
    """To what three successive positive values tend, if the changes of their logarithms keep their ratio."""
    # Source: Aitken 1926, "On Bernoulli's Numerical Solution of Algebraic Equations"
    change, last = np.log(second / first), np.log(third / second)
    ratio = np.clip(np.divide(last, change, out=np.zeros_like(last), where=change * last > 0), 0.0, _LARGEST_RATIO)
    return np.asarray(third * np.exp(last * ratio / (1.0 - ratio)), np.float64)


_COASTING_STEP_NS = 100_000_000  # longest time between poses where no IMU measured [ns]


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """The motion at N times: `world_from_body`, and velocities (N, 3) and biases (N, 6) as in `States`."""

    timestamps_ns: Int64Array
    rotations: Float64Array
    positions: Float64Array
    velocities: Float64Array
    biases: Float64Array


def _motion_between(chain: Chain, states: States, samples: InertialSamples | None) -> _Motion:
    """The motion from the first state to the last, at their times, those of the samples, and some without an IMU."""
    # from each state the IMU leads on; what is off at the next one is spread over the time between
    # Source: the mean of the integrated Brownian bridge, Barfoot 2017, "State Estimation for Robotics", 11.1.4
    times = [chain.knots_ns]
    if samples is not None:
        inside = samples.timestamps_ns
        times.append(inside[(inside >= chain.knots_ns[0]) & (inside <= chain.knots_ns[-1])])
    times += [
        np.arange(chain.knots_ns[k], chain.knots_ns[k + 1], _COASTING_STEP_NS, dtype=np.int64)
        for k in np.flatnonzero(~chain.measured)
    ]
    times_ns = np.unique(np.concatenate(times))
    knots = np.clip(np.searchsorted(chain.knots_ns, times_ns, side="right") - 1, 0, len(chain.measured) - 1)
    rotations, positions, velocities = _led_on(chain, states, samples, times_ns, knots)
    ends = _led_on(chain, states, samples, chain.knots_ns[1:], np.arange(len(chain.measured)))
    apart = np.swapaxes(ends[0], 1, 2) @ states.rotations[1:]
    error_rotation = rotation_vector_from_matrix(apart)
    error, error_speed = (states.positions[1:] - ends[1])[knots], (states.velocities[1:] - ends[2])[knots]
    length = chain.seconds[knots][:, None]
    share = np.asarray((times_ns - chain.knots_ns[knots]) * 1e-9, np.float64)[:, None] / length
    rotations = rotations @ matrix_from_rotation_vector(share * error_rotation[knots])
    positions += share**2 * (3.0 - 2.0 * share) * error + share**2 * (share - 1.0) * length * error_speed
    velocities += 6.0 * share * (1.0 - share) * error / length + share * (3.0 * share - 2.0) * error_speed
    biases = states.biases[knots] + share * (states.biases[knots + 1] - states.biases[knots])
    return _Motion(times_ns, rotations, positions, velocities, biases)


def _led_on(
    chain: Chain, states: States, samples: InertialSamples | None, times_ns: Int64Array, knots: Int64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Rotations, positions and velocities to which the IMU leads from the knots; evenly where there is none."""
    count, measured = len(times_ns), chain.measured[knots]
    rotations, gains, distances = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros((count, 3))
    if samples is not None:
        rotations, gains, distances, _ = _preintegrated_until(
            samples, chain.knots_ns, states.biases[:-1], times_ns, knots, sloping=False
        )
        rotations[~measured], gains[~measured], distances[~measured] = np.eye(3), 0.0, 0.0
    down = np.where(measured, -chain.gravity, 0.0)[:, None] * [0.0, 0.0, 1.0]
    start, t = states.rotations[knots], np.asarray((times_ns - chain.knots_ns[knots]) * 1e-9, np.float64)[:, None]
    speed = states.velocities[knots]
    positions = states.positions[knots] + t * speed + 0.5 * t**2 * down
    positions += np.einsum("nij,nj->ni", start, distances)
    return start @ rotations, positions, speed + t * down + np.einsum("nij,nj->ni", start, gains)


def _pose_covariances(fit: _Fit, own: Float64Array, times_ns: Int64Array) -> Float64Array:
    """Covariances (N, 6, 6) of rotation [rad] and translation [m], world axes; linear between states (at most 1 s)."""
    chain = fit.chain
    axes = np.zeros((len(own), 6, 6))
    axes[:, :3, :3], axes[:, 3:, 3:] = fit.states.rotations, np.eye(3)
    at_knots = axes @ own[:, :6, :6] @ np.swapaxes(axes, 1, 2)
    knots = np.clip(np.searchsorted(chain.knots_ns, times_ns, side="right") - 1, 0, len(own) - 2)
    share = ((times_ns - chain.knots_ns[knots]) * 1e-9 / chain.seconds[knots])[:, None, None]
    found: Float64Array = np.diff(at_knots, axis=0)[knots]
    found *= share
    found += at_knots[knots]
    return found


_STATED_TO, _STATED_TAIL = 0.4, 4.0
"""What a stated accuracy is worth: the logarithm of the true error over it follows Student's t of this scale and so
many degrees of freedom. No region serves all receivers whose errors do not show: one that holds 98 % of the errors of
honest receivers is 1.14 times as wide as stated, and holds 62 % of errors twice as large."""

_AROUND_SECONDS, _SECONDS_TO = 300.0, math.log(5.0)
"""Time constant of slow errors [s], and standard deviation of its logarithm. Source: Joerger and Pervan 2020,
"Multi-constellation ARAIM Exploiting Satellite Motion": 10 to 900 s for multipath of codes, 900 to 2700 s for the
troposphere."""

_SLOW_FACTORS = 2.0 ** np.arange(-3.0, 4.5, 0.5)  # sizes that are tried, in units of the stated accuracy
_SLOW_SECONDS = 5.0 * 3.0 ** np.arange(8.0)  # time constants that are tried [s]
_FORCE_WALKS = 10.0 ** np.arange(-4.0, -1.5)  # densities of the walk of the IMU's force error [m/s³/√Hz]
_SLOW_STEP, _MOST_SLOW_STEPS, _LEAST_SLOW_STEPS = 1.0, 1200, 12  # time between values [s], and how many there are


def _slow_factor(fit: _Fit, stated: float) -> float:
    """Expected size of the slow errors of the fixes across, given all that shows, over the stated accuracy [m].

    What shows is the noise of the fixes, which is a part of what they state, and their drift against the IMU; 0 where
    no IMU shows any.
    """
    noise = float(np.median(fit.chain.fixes.sigmas[:, 0])) ** 2
    factors, constants, walks = (one.ravel() for one in np.meshgrid(_SLOW_FACTORS, _SLOW_SECONDS, _FORCE_WALKS))
    slow = (stated * factors) ** 2
    evidence = _slow_evidence(fit, noise, slow, constants, walks)
    if evidence is None:
        return 0.0
    total = slow + noise
    worth = 0.5 * np.log(total / max(stated**2, noise))
    # the density of the total by the logarithm of the slow error, which is what is tried
    evidence += np.log(slow / total) - 0.5 * (_STATED_TAIL + 1.0) * np.log1p((worth / _STATED_TO) ** 2 / _STATED_TAIL)
    evidence -= 0.5 * (np.log(constants / _AROUND_SECONDS) / _SECONDS_TO) ** 2
    weights = np.exp(evidence - evidence.max())
    return float((weights * factors).sum() / weights.sum())


def _slow_evidence(
    fit: _Fit, noise: float, slow: Float64Array, constants: Float64Array, walks: Float64Array
) -> Float64Array | None:
    """Log-likelihoods (G,) of slow errors' variances [m²] and time constants [s], and of walks of the IMU's force.

    None where no IMU measured for long enough.
    """
    # the IMU leads from the first state; what the fixes are apart from there is the IMU's error, a velocity whose
    # acceleration walks, and the slow error, an Ornstein-Uhlenbeck process; evidences of its parameters by a Kalman
    # filter. Source: Brown and Hwang 2012, "Introduction to Random Signals and Applied Kalman Filtering", 5.6 and 9.2
    times, values, counts = _apart_from_imu(fit)
    if len(times) < _LEAST_SLOW_STEPS:
        return None
    size = len(slow)
    means, spread = np.zeros((size, 4, 2)), np.zeros((size, 4, 4))
    means[:, 0] = values[0]
    spread[:] = np.diag([noise, _FIRST_SPEED**2, _FIRST_FORCE**2, 0.0])
    spread[:, 3, 3], spread[:, 0, 0] = slow, spread[:, 0, 0] + slow
    spread[:, 0, 3] = spread[:, 3, 0] = -slow
    evidence, moved = np.zeros(size), np.tile(np.eye(4), (size, 1, 1))
    for step, value, count in zip(np.diff(times), values[1:], counts[1:], strict=True):
        kept = np.exp(-step / constants)
        moved[:, 0, 1] = moved[:, 1, 2] = step
        moved[:, 0, 2], moved[:, 3, 3] = 0.5 * step**2, kept
        means, spread = moved @ means, moved @ spread @ moved.swapaxes(1, 2)
        powers = step ** np.array([[5, 4, 3], [4, 3, 2], [3, 2, 1]]) / np.array([[20, 8, 6], [8, 3, 2], [6, 2, 1]])
        spread[:, :3, :3] += walks[:, None, None] ** 2 * powers
        spread[:, 3, 3] += slow * (1.0 - kept**2)
        across = spread[:, :, 0] + spread[:, :, 3]
        variance = across[:, 0] + across[:, 3] + noise / count
        apart = value - means[:, 0] - means[:, 3]
        squares = np.minimum((apart**2).sum(axis=1) / variance, _RARE_SLOW)
        evidence -= 0.5 * squares + np.log(variance)
        gain = across / variance[:, None]
        means += gain[:, :, None] * apart[:, None]
        spread -= gain[:, :, None] * across[:, None]
    return evidence


_FIRST_SPEED, _FIRST_FORCE = 10.0, 0.1  # standard deviations of the IMU's first errors [m/s], [m/s²]
_RARE_SLOW = 25.0  # largest square of a value that counts, in units of the expected


def _apart_from_imu(fit: _Fit) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Seconds, positions (N, 2) across by the fixes less those by the IMU's force alone [m], and counts of fixes.

    They are of the longest time in which the IMU measured without a gap.
    """
    chain, states, fixes = fit.chain, fit.states, fit.chain.fixes
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chain.measured, [False]]).astype(np.int8))).reshape(-1, 2)
    if not len(edges):
        return np.empty(0), np.empty((0, 2)), np.empty(0)
    first, last = edges[np.diff(chain.knots_ns[edges], axis=1).argmax()].tolist()
    rows, seconds = slice(first, last), chain.seconds[first:last, None]
    change = states.biases[rows] - chain.inertial.biases[rows]
    gains, ways = (
        np.einsum("nij,nj->ni", states.rotations[rows], one + np.einsum("nij,nj->ni", slopes, change))[:, :2]
        for one, slopes in (
            (chain.inertial.velocities[rows], chain.inertial.slopes[rows, 3:6]),
            (chain.inertial.positions[rows], chain.inertial.slopes[rows, 6:9]),
        )
    )
    speeds = states.velocities[first, :2] + _running_sums(gains)
    places = states.positions[first, :2] + _running_sums(seconds * speeds[:-1] + ways)
    inside = (fixes.knots >= first) & (fixes.knots <= last) & (fit.weights > 0)
    knots = fixes.knots[inside]
    levers = np.einsum("nij,nj->ni", states.rotations[knots], fixes.levers[inside])[:, :2]
    expected = places[knots - first] + fixes.seconds[inside, None] * speeds[knots - first] + levers
    times = (fixes.timestamps_ns[inside] - chain.knots_ns[first]) * 1e-9
    if not len(times):
        return np.empty(0), np.empty((0, 2)), np.empty(0)
    step = max(_SLOW_STEP, (times[-1] - times[0]) / _MOST_SLOW_STEPS)
    _, bins, counts = np.unique(np.floor(times / step), return_inverse=True, return_counts=True)
    columns = (times, *(fixes.positions[inside, :2] - expected).T)
    means = np.stack([np.bincount(bins, column) / counts for column in columns], axis=1)
    return means[:, 0], means[:, 1:], counts.astype(np.float64)


def _slow_variances(
    fit: _Fit, fixes: GnssFixes, times_ns: Int64Array, settings: SmootherSettings
) -> tuple[Float64Array, float]:
    """Variances (N, 3) of the slow errors of the fixes at some times, and the factor on the stated accuracy in them."""
    least = settings.slow_error * np.array([1.0, 1.0, _VERTICAL])
    variances = np.maximum(fixes.sigmas, least) ** 2
    # a height that no receiver knows is uncertain by itself
    variances[fixes.sigmas >= _UNKNOWN_HEIGHT] = least[2] ** 2
    factor = _slow_factor(fit, math.sqrt(float(np.median(variances[:, 0]))))
    # what outlasts the drive does not show: what is stated beyond the noise stays, and is all if a receiver is trusted
    # and slow errors do not seem larger than all that is stated
    expected = factor**2 * variances * (factor > 1.0 or settings.slow_error >= DEFAULTS.slow_error)
    stated = variances - np.minimum(fit.chain.fixes.sigmas, fixes.sigmas) ** 2
    variances = np.maximum(np.maximum(stated, least**2), expected)
    return _resampled(times_ns, fixes.timestamps_ns, variances), factor


_SLOW_FACTOR_REPORTED, _SLOW_FACTOR_DOUBTED = 1.5, 3.0  # the latter is beyond what receivers state falsely
_UNSURE_HEADING = np.radians(15.0)  # standard deviation of the heading from which on it counts as unknown


@dataclass(frozen=True, slots=True, eq=False)
class GnssImuRun:
    """The smoothed ego trajectory.

    Attributes:
        trajectory: `world_from_ego` under the name "gnss", at the IMU's rate, with covariances; without orientations
            where there is no IMU. The world's axes are east, north and up at the origin.
        origin_lla: (3,) the first fix: latitude, longitude [deg], height above the ellipsoid [m].
        velocities: (N, 3) [m/s], world.
        biases: (N, 6) of gyroscope [rad/s] and accelerometer [m/s²], ego frame.
        knots_ns: (K,) [ns], times of the states.
        covariances: (K, 15, 15) of the states: rotation about the ego's axes, position, velocity, the two biases.
        fixes: all of them.
        used: (F,) bool, which of them were not rejected as jumps.
        fix_sigmas: (F, 3) [m] east, north, up: their estimated noise.
        warnings: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    origin_lla: Float64Array
    velocities: Float64Array
    biases: Float64Array
    knots_ns: Int64Array
    covariances: Float64Array
    fixes: GnssFixes
    used: BoolArray
    fix_sigmas: Float64Array
    warnings: tuple[DataWarning, ...]


def gnss_imu_motion(
    scene: Scene, *, lidar: Trajectory | None = None, settings: SmootherSettings = DEFAULTS
) -> GnssImuRun:
    """Estimate the ego trajectory from GNSS fixes, and from an IMU where there is one.

    Args:
        lidar: the trajectory by lidar odometry, whose steps are used, too.

    Raises:
        PoseError: fewer than two fixes are usable.
    """
    if not gnss_receivers(scene):
        raise PoseError(f"{scene.source}: no usable GNSS fixes in it; expected two or more")
    fixes = GnssFixes.of(scene, settings)
    if len(fixes) < 2:
        raise PoseError(f"{scene.source}: {len(fixes)} usable GNSS fix; expected two or more")
    samples = InertialSamples.of_scene(scene)
    gravity = settings.gravity or _normal_gravity(float(fixes.origin_lla[0]), float(fixes.origin_lla[2]))
    _check_times(scene.source, fixes, samples)
    _check_gravity(scene.source, samples, gravity)
    bias = None
    if samples is not None:
        times, values = samples.timestamps_ns, samples.values
        stationary = find_stationary(times, values[:, :3], times, values[:, 3:])
        bias = None if stationary is None else stationary.rate
    drive = _Drive(fixes, samples, lidar, gravity, bias)
    fit = _smoothed(drive, settings)
    own, _ = fit.covariances()
    motion = _motion_between(fit.chain, fit.states, samples)
    poses = _pose_covariances(fit, own, motion.timestamps_ns)
    sigmas = fit.chain.fixes.sigmas
    slow, factor = _slow_variances(fit, fixes, motion.timestamps_ns, settings)
    poses[:, [3, 4, 5], [3, 4, 5]] += slow
    if _always_stands(drive, fit):
        poses[:, :3, :3] += _about_up_anyhow(motion.rotations)
        own[:, :3, :3] += _about_up_anyhow(fit.states.rotations)
    used = fit.weights > 0.5
    steps = _find_steps(drive, used, sigmas, motion)
    for times, vectors in steps:
        # the fixes are as right before all steps as after them: who comes back was away, who does not may be either
        levels = _running_sums(vectors)
        passed = np.searchsorted(times, motion.timestamps_ns, side="right")
        for level in (levels[0], levels[-1]):
            offsets = (levels - level)[passed]
            poses[:, 3:5, 3:5] += 0.5 * offsets[:, :, None] * offsets[:, None]
    rotations = None if samples is None and lidar is None else quaternion_from_matrix(motion.rotations)
    trajectory = Trajectory(NAME, motion.timestamps_ns, motion.positions, rotations, covariances=poses)
    notes = _notes(scene.source, drive, trajectory, used, sigmas, slow, factor)
    warnings = (*fixes.warnings, *notes, *_notes_of_steps(scene.source, steps))
    return GnssImuRun(
        trajectory, fixes.origin_lla, motion.velocities, motion.biases, fit.chain.knots_ns, own, fixes, used,
        sigmas, warnings,
    )  # fmt: skip


_STEP, _STEP_OF_USUAL, _STEP_OF_STATED = 6.0, 8.0, 2.0
"""A step of the fixes counts beyond so many standard deviations of their noise, of what such steps usually are in the
drive, and of what the receiver states."""

_STEP_FIXES, _STEP_SECONDS, _STEP_GAP = (2, 10), 2.0, 2.0
"""A step is measured by so many fixes before and after it, at least and at most, within so many seconds where there are
enough; none is where a second fix is farther than the last number of seconds from the first."""


def _find_steps(
    drive: _Drive, used: BoolArray, sigmas: Float64Array, motion: _Motion
) -> list[tuple[Int64Array, Float64Array]]:
    """Find where fixes step together and the IMU moves on: times (S,) [ns] and steps (S, 2) across [m], by receiver."""
    fixes, samples = drive.fixes, drive.samples
    if samples is None:
        return []
    from scipy.ndimage import maximum_filter1d

    # positions by the IMU alone, up to a velocity, which the fixes around a step have
    seconds = np.diff(samples.timestamps_ns)[:, None] * 1e-9
    near = np.clip(np.searchsorted(motion.timestamps_ns, samples.timestamps_ns), 0, len(motion.timestamps_ns) - 1)
    forces = samples.values[:, 3:] - motion.biases[near, 3:]
    accelerations = np.einsum("nij,nj->ni", motion.rotations[near], forces)[:-1] - [0.0, 0.0, drive.gravity]
    velocities = _running_sums(accelerations * seconds)
    moved = _running_sums((velocities[:-1] + 0.5 * accelerations * seconds) * seconds)
    found, (few, many) = [], _STEP_FIXES
    for receiver in np.unique(fixes.receivers):
        rows = np.flatnonzero(used & (fixes.receivers == receiver))
        if len(rows) < 2 * few:
            continue
        times = fixes.timestamps_ns[rows]
        near = np.clip(np.searchsorted(motion.timestamps_ns, times), 0, len(motion.timestamps_ns) - 1)
        antennas = np.einsum("nij,nj->ni", motion.rotations[near], fixes.levers[rows])
        apart = (fixes.positions[rows] - antennas - _resampled(times, samples.timestamps_ns, moved))[:, :2]
        gaps = np.diff(times) * 1e-9
        count = int(np.clip(_STEP_SECONDS / max(np.median(gaps), 1e-3), few, min(many, len(rows) // 2)))
        around = np.arange(2 * count) + np.arange(len(rows) - 2 * count + 1)[:, None]
        # a constant, a velocity, and the step
        columns = np.ones((*around.shape, 3))
        columns[:, :, 1] = (times[around] - times[around[:, count], None]) * 1e-9
        columns[:, :count, 2] = 0.0
        parts = np.linalg.pinv(columns)[:, 2]
        steps = np.einsum("nk,nkd->nd", parts, apart[around])
        sizes = np.linalg.norm(steps, axis=1)
        noise = np.sqrt((parts**2 * sigmas[rows, 0][around] ** 2).sum(axis=1))
        usual = 1.4826 * np.median(np.abs(steps))
        least = max(_STEP_OF_USUAL * usual, _STEP_OF_STATED * float(np.median(fixes.sigmas[rows, 0])))
        sizes[gaps[around[:, :-1]].max(axis=1) > _STEP_GAP] = 0.0
        sizes[~samples.is_measured(times[around[:, 0]], times[around[:, -1]], slack_ns=samples.slack_ns)] = 0.0
        beyond = sizes > np.maximum(_STEP * noise, least)
        # a step shows in all spans that contain it; it is where it is largest
        beyond &= sizes >= maximum_filter1d(sizes, 2 * count - 1, mode="nearest")
        if beyond.any():
            found.append((times[around[beyond, count]], steps[beyond]))
    return found


def _notes_of_steps(location: str, steps: list[tuple[Int64Array, Float64Array]]) -> Iterator[DataWarning]:
    """Warn of fixes that step together, which the trajectory follows."""
    if steps:
        largest = max(float(np.linalg.norm(vectors, axis=1).max()) for _, vectors in steps)
        first = min(int(times[0]) for times, _ in steps) * 1e-9
        message = (
            f"fixes step by {largest:.1f} m beyond what the IMU moved, first at {first:.3f} s; the trajectory follows "
            "them, and the steps are part of the covariances"
        )
        yield assumed("gnss-steps", location, message, count=sum(len(times) for times, _ in steps))


_WITH = {
    (False, False): " alone, without an IMU,",
    (True, False): " and the IMU",
    (False, True): " and the lidar's sweeps",
    (True, True): ", the IMU and the lidar's sweeps",
}


def _notes(
    location: str,
    drive: _Drive,
    trajectory: Trajectory,
    used: BoolArray,
    sigmas: Float64Array,
    slow: Float64Array,
    factor: float,
) -> Iterator[DataWarning]:
    """The warnings about a run."""
    samples = drive.samples
    sigma = np.median(sigmas[used], axis=0) if used.any() else sigmas[0]
    latitude, longitude, height = drive.fixes.origin_lla
    message = (
        f"{len(used)} fixes{_WITH[samples is not None, drive.lidar is not None]} gave the trajectory of "
        f"the ego; estimated noise of the fixes {sigma[0]:.2f} m across, {sigma[2]:.2f} m in height; the world's axes "
        f"are east, north and up at the first fix, {latitude:.7f}, {longitude:.7f}, {height:.2f} m"
    )
    yield assumed("trajectory-from-gnss", location, message)
    lost = int((~used).sum())
    if lost:
        message = f"{lost} of {len(used)} fixes left out, off the trajectory by more than the rest allows"
        yield skipped("gnss-jumps", location, message, count=lost)
    across, _, up = np.sqrt(np.median(slow, axis=0))
    message = (
        f"all fixes may be off together by {across:.2f} m across and {up:.2f} m in height (one standard deviation), "
        "which is part of the covariances"
    )
    if factor > _SLOW_FACTOR_REPORTED:
        message += f"; by their drift their errors are {factor:.1f} times the stated accuracy"
    if samples is not None and factor > _SLOW_FACTOR_DOUBTED:
        message += (
            ", unless the IMU contradicts them: compare their clocks (`sceneloom sync`), the IMU's units and axes, and "
            "the fixes' latitudes and longitudes"
        )
    yield assumed("gnss-slow-errors", location, message)
    if samples is not None and len(samples.gaps_ns):
        message = "the IMU has gaps; in them the motion was interpolated"
        yield assumed("imu-gaps", location, message, count=len(samples.gaps_ns))
    if samples is not None and samples.left_out:
        message = "samples that are not finite, or not later than the one before, were left out"
        yield repaired("imu-samples", location, message, count=samples.left_out)
    covariances = trajectory.covariances
    if samples is not None and covariances is not None and np.sqrt(covariances[:, 2, 2].min()) > _UNSURE_HEADING:
        message = (
            f"the ego moved too little to determine its heading, which is known to "
            f"{np.degrees(np.sqrt(covariances[:, 2, 2].min())):.0f} degrees at best; it was taken as that of the motion"
        )
        yield assumed("heading-unknown", location, message)
