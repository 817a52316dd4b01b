"""What the smoother is given: settings, GNSS fixes, IMU samples, their preintegration, and the times of its states."""

from dataclasses import dataclass, fields, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.geodesy import ecef_from_geodetic, enu_from_geodetic
from sceneloom.kernels.imu_chain import (
    DELTA_POSITION,
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    preintegrate,
    preintegrate_until,
)
from sceneloom.kernels.imu_chain import DELTA_ROTATION as BY_ROTATION
from sceneloom.motion.ego_trajectory import gnss_receivers, usable_fixes
from sceneloom.motion.imu import ACCELEROMETER, GYROSCOPE, gaps_between, usable_samples
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.scene import Scene
from sceneloom.warnings import DataWarning, WarningKind


@dataclass(frozen=True, slots=True, kw_only=True)
class SmootherSettings:
    """What the smoother takes for granted.

    Attributes:
        gyroscope_noise, accelerometer_noise: least densities of the white noise [rad/s/√Hz] and [m/s²/√Hz]; the
            samples themselves report more.
        gyroscope_walk, accelerometer_walk: densities of what makes the biases wander [rad/s²/√Hz] and [m/s³/√Hz].
        gyroscope_bias, accelerometer_bias: how large the biases may be, one standard deviation [rad/s] and [m/s²].
        acceleration: density of the acceleration of an ego without IMU [m/s²/√Hz].
        rotating: density of the angular velocity of an ego without IMU [rad/s/√Hz].
        fix_noise: standard deviation of a fix that does not report its accuracy, to begin with [m].
        least_fix_noise: no fix is believed to be better [m].
        gate: a fix this many standard deviations off is left out, as long as it is.
        longest_interval: states lie no farther apart in time [s].
        vehicle: whether the ego moves along one axis of its own only, as cars do: True, False, or None to let the
            data report.
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
    least_fix_noise: float = 0.01
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

_FARTHEST = 100_000.0
"""Fixes farther than this from the one in the middle of all [m] are no locations of one drive."""

_VERTICAL = 1.7
"""Heights are worse by so much where the receiver does not report. Source: usual ratio of VDOP to HDOP."""

_UNKNOWN_HEIGHT = 1e5
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-3, 1e4


@dataclass(frozen=True, slots=True, eq=False)
class GnssFixes:
    """All fixes of a drive.

    Attributes:
        timestamps_ns: (F,) int64 [ns], ascending.
        positions: (F, 3) [m] east, north, up of the origin.
        sigmas: (F, 3) [m], as reported or assumed.
        reported: (F,) bool, whether the receiver reported its accuracy.
        levers: (F, 3) [m], the antenna in the ego.
        receivers: (F,) int64, number of the receiver.
        origin_lla: (3,) latitude, longitude [deg], height [m].
        warnings: what was left out.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    sigmas: Float64Array
    reported: BoolArray
    levers: Float64Array
    receivers: Int64Array
    origin_lla: Float64Array
    warnings: tuple[DataWarning, ...]

    @classmethod
    def of(cls, scene: Scene, settings: SmootherSettings) -> "GnssFixes":
        """Gather the fixes of all receivers; there is at least one."""
        receivers = gnss_receivers(scene)
        rows = [_chosen(receiver) for receiver in receivers]
        times = np.concatenate([r.timestamps_ns[k] for r, k in zip(receivers, rows, strict=True)])
        locations = np.vstack([r.positions_lla[k] for r, k in zip(receivers, rows, strict=True)])
        sigmas = np.vstack([_sigmas(r, k, settings) for r, k in zip(receivers, rows, strict=True)])
        reported = np.concatenate([_is_reported(r.accuracies[k]) for r, k in zip(receivers, rows, strict=True)])
        levers = np.vstack([np.tile(_lever(r), (len(k), 1)) for r, k in zip(receivers, rows, strict=True)])
        number = np.repeat(np.arange(len(receivers)), [len(k) for k in rows])
        flat = np.where(np.isfinite(locations[:, 2]), locations[:, 2], 0.0)
        locations = np.column_stack([locations[:, :2], flat])
        ecef = ecef_from_geodetic(locations)
        # the median itself may lie where there is no fix, between two locations that have as many each
        middle = ecef[np.linalg.norm(ecef - np.median(ecef, axis=0), axis=1).argmin()]
        near = np.linalg.norm(ecef - middle, axis=1) <= _FARTHEST
        order = np.flatnonzero(near)[np.argsort(times[near], kind="stable")]
        origin = locations[order[0]]
        warnings = [
            warning
            for receiver, kept in zip(receivers, rows, strict=True)
            for warning in _left_out(scene, receiver, len(kept))
        ]
        if not near.all():
            message = f"fixes more than {_FARTHEST / 1000:.0f} km from the others were left out"
            warnings.append(_skipped("gnss-fixes-elsewhere", scene.source, message, int((~near).sum())))
        return cls(
            times[order], enu_from_geodetic(locations[order], origin), sigmas[order], reported[order], levers[order],
            number[order], origin, tuple(warnings),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def check_times(self, location: str, samples: "InertialSamples | None") -> None:
        """Refuse times that are too far apart, such as milliseconds taken for seconds.

        Raises:
            PoseError: samples or fixes lie too far apart.
        """
        if samples is not None and samples.period > _LONGEST_PERIOD:
            raise PoseError(
                f"{location}: samples of the IMU lie {samples.period:.6g} s apart (median); expected at most "
                f"{_LONGEST_PERIOD:g} s: {_HINT}"
            )
        times = self.timestamps_ns
        step = float(np.median(np.diff(times))) * 1e-9
        if step <= _LONGEST_STEP:
            return
        if samples is not None and samples.is_measured(times[:-1], times[1:]).any():
            return
        raise PoseError(
            f"{location}: GNSS fixes lie {step:.6g} s apart (median), and no IMU measured between; expected at most "
            f"{_LONGEST_STEP:g} s: {_HINT}"
        )

    def carried(
        self,
        knots_ns: Int64Array,
        measured: BoolArray,
        samples: "InertialSamples | None",
        *,
        biases: Float64Array,
        gravity: float,
        sigmas: Float64Array | None = None,
    ) -> "Fixes":
        """Hold each fix against the state before it by what the IMU felt, and else against the nearest.

        Args:
            knots_ns: (K,) [ns], times of the states.
            measured: (K - 1,) between which of them the IMU measured.
            biases: (K - 1, 6) to take off what it measured.
            gravity: [m/s²].
            sigmas: (F, 3) [m]; None for those of the self.
        """
        times, count = self.timestamps_ns, len(self)
        before = np.clip(np.searchsorted(knots_ns, times, side="right") - 1, 0, len(knots_ns) - 1)
        led = np.append(measured, False)[before] & (times >= knots_ns[0])
        locations = np.where(led, before, _nearest_states(knots_ns, times))
        seconds = np.asarray((times - knots_ns[locations]) * 1e-9, np.float64)
        levers, slopes, taken = self.levers.copy(), np.zeros((count, 3, 6)), np.zeros((count, 6))
        rows = np.flatnonzero(led & (seconds > 0))
        if samples is not None and len(rows):
            rotations, trajectories = np.empty((len(rows), 3, 3)), np.empty((len(rows), 3))
            by_biases = np.empty((len(rows), 9, 6))
            preintegrate_until(
                samples.timestamps_ns, samples.values, knots_ns, np.ascontiguousarray(biases), times[rows],
                locations[rows],
                rotations, np.empty((len(rows), 3)), trajectories, by_biases,
            )  # fmt: skip
            levers[rows] = np.einsum("nij,nj->ni", rotations, self.levers[rows]) + trajectories
            slopes[rows] = (
                by_biases[:, DELTA_POSITION] + rotations @ crossed_with(self.levers[rows]) @ by_biases[:, BY_ROTATION]
            )
            taken[rows] = biases[locations[rows]]
        return Fixes(
            times, locations, seconds, self.positions, levers, np.where(led, 0.5 * gravity * seconds**2, 0.0), slopes,
            taken, self.sigmas if sigmas is None else sigmas, self.receivers,
        )  # fmt: skip


def _chosen(receiver: GnssSensor) -> Int64Array:
    """Rows of usable fixes, one per time; a fix that only says the one before again is none."""
    rows = np.flatnonzero(usable_fixes(receiver))
    _, first = np.unique(receiver.timestamps_ns[rows], return_index=True)
    rows = rows[first]
    same = (np.diff(receiver.positions_lla[rows, :2], axis=0) == 0).all(axis=1)
    chosen: Int64Array = rows[np.concatenate([[True], ~same])]
    return chosen


def _left_out(scene: Scene, receiver: GnssSensor, kept: int) -> list[DataWarning]:
    lost = len(receiver.timestamps_ns) - kept
    if lost == 0:
        return []
    message = "fixes that are no location, of a time that was there before, or the same as before were left out"
    return [_skipped("gnss-fixes-left-out", f"{scene.source}: sensors[{receiver.id}]", message, lost)]


def _skipped(code: str, location: str, message: str, count: int) -> DataWarning:
    return DataWarning(kind=WarningKind.SKIPPED, code=code, location=location, message=message, count=count)


def _is_reported(accuracies: Float64Array) -> BoolArray:
    reported: BoolArray = np.isfinite(accuracies) & (accuracies > 0)
    return reported


def _sigmas(receiver: GnssSensor, rows: Int64Array, settings: SmootherSettings) -> Float64Array:
    across, along_up = receiver.accuracies[rows], receiver.vertical_accuracies[rows]
    flat = np.where(_is_reported(across), across, settings.fix_noise)
    up = np.where(_is_reported(along_up), along_up, _VERTICAL * flat)
    sigmas: Float64Array = np.clip(np.stack([flat, flat, up], axis=1), _LEAST_SIGMA, _LARGEST_SIGMA)
    sigmas[~np.isfinite(receiver.positions_lla[rows, 2]), 2] = _UNKNOWN_HEIGHT
    return sigmas


def _lever(receiver: GnssSensor) -> Float64Array:
    return np.zeros(3) if receiver.mount is None else receiver.mount.translation.copy()


_NOISE_SECONDS, _NOISE_SAMPLES = 2.0, 21
"""Time over which the noise is averaged, and how many samples that takes at least."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialSamples:
    """What an IMU on the ego measured.

    Attributes:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 2.
        values: (N, 6) float64: angular velocity [rad/s], specific force [m/s²].
        gaps_ns: (G, 2) int64 [ns], between which samples are missing.
        left_out: samples that were no numbers or not later than others.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    gaps_ns: Int64Array
    left_out: int = 0

    @classmethod
    def of(cls, gyroscope: VectorSamples, accelerometer: VectorSamples) -> "InertialSamples | None":
        """Bring both streams to the times of that with more samples; None where they do not overlap."""
        rate_times, rates, lost_rates = usable_samples(gyroscope)
        force_times, forces, lost_forces = usable_samples(accelerometer)
        if len(rate_times) < 2 or len(force_times) < 2:
            return None
        times = rate_times if len(rate_times) >= len(force_times) else force_times
        first, last = max(rate_times[0], force_times[0]), min(rate_times[-1], force_times[-1])
        times = times[(times >= first) & (times <= last)]
        if len(times) < 2:
            return None
        values = np.hstack([_at(times, rate_times, rates), _at(times, force_times, forces)])
        gaps = np.vstack([gaps_between(rate_times), gaps_between(force_times)])
        inside = (gaps[:, 1] > first) & (gaps[:, 0] < last)
        return cls(times, values, np.unique(gaps[inside], axis=0), lost_rates + lost_forces)

    @classmethod
    def of_scene(cls, scene: Scene) -> "InertialSamples | None":
        """Those of the first IMU of a scene that has both streams; None where there is none."""
        for sensor in scene.sensors:
            if isinstance(sensor, ImuSensor) and GYROSCOPE in sensor.streams and ACCELEROMETER in sensor.streams:
                samples = cls.of(sensor.streams[GYROSCOPE], sensor.streams[ACCELEROMETER])
                if samples is not None:
                    return samples
        return None

    @property
    def period(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.timestamps_ns))) * 1e-9

    def is_measured(self, first_ns: Int64Array, last_ns: Int64Array) -> BoolArray:
        """Which intervals lie within the samples and have no gap in them."""
        slack_ns = round(1.5 * self.period * 1e9)
        measured: BoolArray = (first_ns >= self.timestamps_ns[0] - slack_ns) & (
            last_ns <= self.timestamps_ns[-1] + slack_ns
        )
        for start_ns, stop_ns in self.gaps_ns:
            measured &= (last_ns <= start_ns) | (first_ns >= stop_ns)
        return measured

    def noise_densities(self, times_ns: Int64Array, settings: SmootherSettings) -> Float64Array:
        """Give the densities of the white noise around some times, (N, 2), (rad/s)²/Hz and (m/s²)²/Hz.

        A sample's noise shows in how far it lies from the middle between its neighbours, whose variance is 1.5 times
        that of white noise. What a low rate does not resolve of the motion counts as noise, too: rightly so, since it
        is not known between the samples either.
        """
        if len(self.timestamps_ns) < 3:
            return np.tile([settings.gyroscope_noise**2, settings.accelerometer_noise**2], (len(times_ns), 1))
        values = self.values
        apart = values[1:-1] - 0.5 * (values[:-2] + values[2:])
        squares = np.stack([(apart[:, :3] ** 2).mean(axis=1), (apart[:, 3:] ** 2).mean(axis=1)], axis=1) / 1.5
        width = max(_NOISE_SAMPLES, round(_NOISE_SECONDS / self.period)) | 1
        smooth = _moving_mean(squares, min(width, len(squares))) * self.period
        found = np.stack([np.interp(times_ns, self.timestamps_ns[1:-1], smooth[:, k]) for k in range(2)], axis=1)
        floored: Float64Array = np.maximum(found, [settings.gyroscope_noise**2, settings.accelerometer_noise**2])
        return floored

    def preintegrated(self, knots_ns: Int64Array, *, biases: Float64Array, densities: Float64Array) -> "Preintegrated":
        """Sum up what an IMU measured from each knot to the next.

        Between samples rate and force change evenly; the rotation is exact to the fourth order in the time between
        samples for such a rate, velocity and trajectory are integrated by Simpson's rule over it.

        Args:
            knots_ns: (K,) int64 [ns], strictly increasing; they need not lie on samples.
            biases: (K - 1, 6) to take off.
            densities: (K - 1, 2) of the white noise, (rad/s)²/Hz and (m/s²)²/Hz.
        """
        count = len(knots_ns) - 1
        found = Preintegrated(
            np.empty((count, 3, 3)),
            np.empty((count, 3)),
            np.empty((count, 3)),
            np.empty((count, 9, 6)),
            np.empty((count, 9, 9)),
            np.ascontiguousarray(biases),
        )
        preintegrate(
            self.timestamps_ns, self.values, knots_ns, found.biases, np.ascontiguousarray(densities),
            found.rotations, found.gains,
            found.trajectories, found.slopes, found.covariances,
        )  # fmt: skip
        return found


def _moving_mean(values: Float64Array, width: int) -> Float64Array:
    sums = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    first = np.clip(np.arange(len(values)) - width // 2, 0, len(values) - width)
    mean: Float64Array = np.maximum(sums[first + width] - sums[first], 0.0) / width
    return mean


def _at(wanted_ns: Int64Array, times_ns: Int64Array, values: Float64Array) -> Float64Array:
    if np.array_equal(wanted_ns, times_ns):
        return values
    seconds, known = (wanted_ns - times_ns[0]) * 1e-9, (times_ns - times_ns[0]) * 1e-9
    return np.stack([np.interp(seconds, known, column) for column in values.T], axis=1)


_LONGEST_PERIOD = 1.0
"""Samples of an IMU farther apart on the whole [s] do not determine the motion between them."""

_LONGEST_STEP = 60.0
"""Fixes farther apart on the whole [s] give a trajectory only with an IMU in between."""

_HINT = "are the times in milliseconds, where seconds are expected?"


@dataclass(frozen=True, slots=True, eq=False)
class Preintegrated:
    """What an IMU measured in F intervals, summed up in the axes that the body had at the beginning of each.

    Attributes:
        rotations: (F, 3, 3) float64, `first_from_second`.
        gains: (F, 3) gain of velocity [m/s] without gravity.
        trajectories: (F, 3) trajectory [m] without gravity and without the velocity at the beginning.
        slopes: (F, 9, 6) change of rotation (on the right side [rad]), gain and trajectory with the biases of gyroscope
            and accelerometer.
        covariances: (F, 9, 9) of rotation, gain and trajectory.
        biases: (F, 6) that were taken off.

    Source: Forster, Carlone, Dellaert and Scaramuzza 2017, "On-Manifold Preintegration for Real-Time Visual-Inertial
    Odometry".
    """

    rotations: Float64Array
    gains: Float64Array
    trajectories: Float64Array
    slopes: Float64Array
    covariances: Float64Array
    biases: Float64Array

    def part(self, rows: slice) -> "Preintegrated":
        """Some of the intervals."""
        return Preintegrated(
            self.rotations[rows],
            self.gains[rows],
            self.trajectories[rows],
            self.slopes[rows],
            self.covariances[rows],
            self.biases[rows],
        )


CLOSEST_NS = 20_000_000
"""States lie no closer [ns]: what a fix reports is carried over so short a time without loss."""

_LONGEST_NS = 86_400 * 1_000_000_000
"""No drive lasts longer [ns]: a wrong time is not to be bridged by millions of states."""

_CARRIED = 0.3
"""What the noise of the IMU adds to a fix on the way from the state before it, as a share of the best fix's own."""

_LONGEST_CARRIED = 0.5
"""So long at most [s], since not all that is wrong with an IMU shows in its noise: scales, axes, biases at first."""

_WEIGHT = 9.81
"""Acceleration [m/s²] that a wrong orientation rotates aside."""


def knot_times(
    fix_times_ns: Int64Array,
    samples: InertialSamples | None,
    further_ns: Int64Array,
    settings: SmootherSettings,
) -> Int64Array:
    """Choose the times of the states.

    Args:
        fix_times_ns: (F,) [ns], ascending.
        samples: of the IMU, whose first and last time and gaps get states.
        further_ns: times that should have one, if there is none near them.
        settings: how far states may lie apart.

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
            f"expected at most {_LONGEST_NS / 1e9:g}: is a time wrong?"
        )
    thin = _spaced(marks, np.empty(0, np.int64), np.full(len(marks), CLOSEST_NS))
    thin = _spaced(np.unique(fix_times_ns), thin, _apart_ns(np.unique(fix_times_ns), samples, settings))
    thin = _spaced(further_ns, thin, np.full(len(further_ns), CLOSEST_NS))
    chunks = [thin[:1]]
    for start, stop in zip(thin[:-1].tolist(), thin[1:].tolist(), strict=True):
        count = max(1, int(np.ceil((stop - start) * 1e-9 / settings.longest_interval - 1e-6)))
        shares = np.arange(1, count + 1) * ((stop - start) / count)
        chunks.append(start + np.rint(shares).astype(np.int64))
    knots: Int64Array = np.concatenate(chunks)
    return knots if len(knots) > 1 else np.array([knots[0], knots[0] + CLOSEST_NS])


def _apart_ns(times_ns: Int64Array, samples: InertialSamples | None, settings: SmootherSettings) -> Int64Array:
    """How far a fix at each time may be from the state before it, (F,) [ns]: the IMU's noise has to stay small.

    Source: position by white noise of the acceleration, n² t³ / 3, and by that of the angular velocity under gravity,
    (g n)² t⁵ / 20 (Farrell 2008, "Aided Navigation", 11.4).
    """
    if samples is None:
        return np.full(len(times_ns), CLOSEST_NS)
    rate, force = samples.noise_densities(times_ns, settings).T
    allowed = _CARRIED * settings.least_fix_noise / np.sqrt(2.0)
    seconds = np.minimum((3.0 * allowed**2 / force) ** (1.0 / 3.0), (20.0 * allowed**2 / (_WEIGHT**2 * rate)) ** 0.2)
    apart = np.rint(np.minimum(seconds, _LONGEST_CARRIED) * 1e9).astype(np.int64)
    return np.where(_felt(times_ns, samples), np.maximum(apart, CLOSEST_NS), CLOSEST_NS)


def _felt(times_ns: Int64Array, samples: InertialSamples) -> BoolArray:
    """Which times lie within the samples and in no gap of theirs."""
    felt: BoolArray = (times_ns >= samples.timestamps_ns[0]) & (times_ns <= samples.timestamps_ns[-1])
    for start_ns, stop_ns in samples.gaps_ns:
        felt &= (times_ns <= start_ns) | (times_ns >= stop_ns)
    return felt


def _spaced(times_ns: Int64Array, known_ns: Int64Array, apart_ns: Int64Array) -> Int64Array:
    """Known times and those of others that lie far enough after the one before and not close before the next known."""
    ends = np.append(known_ns, np.iinfo(np.int64).max)
    kept: list[int] = []
    for time, apart, location in zip(
        times_ns.tolist(), apart_ns.tolist(), np.searchsorted(known_ns, times_ns).tolist(), strict=True
    ):
        before = [kept[-1]] if kept else []
        before += [int(known_ns[location - 1])] if location else []
        if int(ends[location]) - time >= CLOSEST_NS and (not before or time - max(before) >= apart):
            kept.append(time)
    return np.union1d(known_ns, np.array(kept, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Positions of antennas, reported by F fixes.

    A fix expects the antenna at p + t v - fall up + R (lever + slope (b - bias)) for a state R, p, v, b, t before it.

    Attributes:
        timestamps_ns: (F,) int64 [ns], ascending.
        locations: (F,) int64, ascending: the state before each fix, or where no IMU measured the nearest.
        seconds: (F,) from the state to the fix.
        positions: (F, 3) [m], world.
        levers: (F, 3) [m], axes of the body at the state: the antenna at the time of the fix, with the trajectory that
            the IMU felt until then.
        falls: (F,) [m] through which gravity draws meanwhile; 0 where no IMU measured.
        slopes: (F, 3, 6) change of `levers` with the biases of gyroscope and accelerometer.
        biases: (F, 6) that `levers` has taken off.
        sigmas: (F, 3) [m], standard deviations along the world's axes.
        receivers: (F,) int64, which receiver each is from.
    """

    timestamps_ns: Int64Array
    locations: Int64Array
    seconds: Float64Array
    positions: Float64Array
    levers: Float64Array
    falls: Float64Array
    slopes: Float64Array
    biases: Float64Array
    sigmas: Float64Array
    receivers: Int64Array

    def __len__(self) -> int:
        return len(self.locations)

    def chosen(self, rows: Int64Array | BoolArray) -> "Fixes":
        """Some of the fixes."""
        return Fixes(*(getattr(self, field.name)[rows] for field in fields(self)))

    def within(self, first: int, last: int) -> "Fixes":
        """Those of states `first` to `last`, without the latter."""
        inside = self.chosen((self.locations >= first) & (self.locations < last))
        return replace(inside, locations=inside.locations - first)

    def variances(self, rotations: Float64Array, own: Float64Array) -> Float64Array:
        """(F, 3) variances of the antenna positions, from the states' orientations and covariances (K, 15, 15)."""
        rotated = rotations[self.locations]
        slopes = np.zeros((len(self), 3, SIZE))
        slopes[:, :, ROTATION] = rotated @ crossed_with(self.levers)
        slopes[:, :, POSITION] = np.eye(3)
        slopes[:, :, VELOCITY] = self.seconds[:, None, None] * np.eye(3)
        slopes[:, :, VELOCITY.stop :] = rotated @ self.slopes
        variances: Float64Array = ((slopes @ own[self.locations]) * slopes).sum(axis=2)
        return variances


def _nearest_states(knots_ns: Int64Array, times_ns: Int64Array) -> Int64Array:
    """The state nearest to each time."""
    after = np.clip(np.searchsorted(knots_ns, times_ns), 1, len(knots_ns) - 1)
    nearer_before = times_ns - knots_ns[after - 1] <= knots_ns[after] - times_ns
    nearest: Int64Array = after - nearer_before
    return nearest


def crossed_with(vectors: Float64Array) -> Float64Array:
    """(F, 3, 3) matrices that take the cross product of what comes with (F, 3) vectors."""
    crossed: Float64Array = np.cross(np.eye(3)[None], vectors[:, None]).swapaxes(1, 2)
    return crossed
