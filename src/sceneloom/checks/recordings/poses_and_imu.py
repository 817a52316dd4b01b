"""Rules about poses that do not agree with the IMU: gravity, rotating, clocks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.checks.recordings.rotating import CleanSamples, PoseIntervals, finite_rows, orientation_noise
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.geometry.rotations import normalise_quaternion
from sceneloom.scene.findings import Severity
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.poses import Trajectory

_LEAST_CORRELATION = 0.8
"""Rotate rates of orientations and of the gyroscope that correlate less do not agree."""
_GREATEST_TILT_DEG = 25.0
"""So far off up the mean of the accelerometer may be: a vehicle that brakes all the time leaves 20°."""
_LEAST_COHERENCE = 0.6
"""The accelerometer's mean in the world has to be this part of its mean length: gravity does not rotate with a device,
and hard rotates all the time leave 0.8."""
_LEAST_ROTATING, _ROTATING_PER_NOISE = 0.03, 2.0
"""The gyroscope's means have to vary so much (rms) [rad/s], and so many times their noise, to be compared."""
_FEWEST_INTERVALS = 10
_GREATEST_SHIFT, _SHIFT_STEP, _SHIFTS_SHARE = 1.0, 0.02, 0.2
"""Shifts of the clocks are tried up to so long, in such steps [s], and up to this part of the time in common."""
_LEAST_SHIFT = 0.05
"""Shorter shifts between poses and IMU [s] are for `sceneloom sync` to find."""
_SURE = 0.9
_SCALES = (0.6, 1.6)
_NEAR_DEGREES = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """A trajectory beside what the IMU measured over the same intervals.

    Attributes:
        name: of the trajectory.
        up: (3,) mean of the accelerometer in the world, as part of its mean length; None where not known.
        shifts: (S,) float64 [s], by which the gyroscope's times were taken to be later; empty where it hardly rotated.
        correlations: (S,) of the yaw rates of all axes together.
        tolerance: samples and poses are so far apart [s] that shorter shifts are not known.
        measured, reported: root mean square of the yaw rates of the gyroscope and of the orientations [rad/s].
    """

    name: str
    up: Float64Array | None
    shifts: Float64Array
    correlations: Float64Array
    tolerance: float
    measured: float
    reported: float

    @property
    def correlation(self) -> float:
        """Without a shift; 1 where the rotating is not known."""
        return float(self.correlations[len(self.shifts) // 2]) if len(self.shifts) else 1.0

    @property
    def best_correlation(self) -> float:
        """The greatest over all shifts; 1 where the rotating is not known."""
        return float(self.correlations.max()) if len(self.shifts) else 1.0


def _comparisons(subject: Subject) -> Sequence[_Comparison]:
    return subject.table("poses beside the IMU", _compare_all)


def _compare_all(subject: Subject) -> list[_Comparison]:
    imu = next((sensor for sensor in subject.scene.sensors if isinstance(sensor, ImuSensor)), None)
    trajectories = [
        trajectory
        for trajectory in subject.scene.trajectories.values()
        if trajectory.quaternions_xyzw is not None
    ]
    found = [] if imu is None else [_compared(trajectory, imu) for trajectory in trajectories]
    return [comparison for comparison in found if comparison is not None]


def _compared(trajectory: Trajectory, imu: ImuSensor) -> _Comparison | None:
    intervals = PoseIntervals.of(trajectory)
    if len(intervals) < _FEWEST_INTERVALS:
        return None
    origin_ns = int(trajectory.timestamps_ns[0])
    quaternions = normalise_quaternion(trajectory.poses.quaternions_xyzw)
    up = _up(intervals, quaternions, CleanSamples.of(imu.streams.get("accelerometer"), origin_ns))
    rates = CleanSamples.of(imu.streams.get("gyroscope"), origin_ns)
    rotating = None if rates is None else _rotating(intervals, quaternions, rates)
    if rates is None or rotating is None:
        none = np.zeros(0)
        return None if up is None else _Comparison(trajectory.name, up, none, none, 0.0, 0.0, 0.0)
    tolerance = max(
        float(np.median(np.diff(rates.seconds))), float(np.median(np.diff(trajectory.timestamps_ns))) / 1e9
    )
    shifts, correlations, measured, reported = rotating
    return _Comparison(trajectory.name, up, shifts, correlations, tolerance, measured, reported)


def _up(
    intervals: PoseIntervals, quaternions_xyzw: Float64Array, forces: CleanSamples | None
) -> Float64Array | None:
    """The accelerometer's mean in the world as part of its mean length, (3,); None for too few samples."""
    if forces is None:
        return None
    measured = forces.means(intervals.starts, intervals.stops)
    known = finite_rows(measured)
    if np.count_nonzero(known) < _FEWEST_INTERVALS or not measured[known].any():
        return None
    world = intervals.to_world(quaternions_xyzw, measured)[known]
    return np.asarray(world.mean(axis=0) / np.linalg.norm(measured[known], axis=1).mean())


def _rotating(
    intervals: PoseIntervals, quaternions_xyzw: Float64Array, rates: CleanSamples
) -> tuple[Float64Array, Float64Array, float, float] | None:
    """Shifts, correlations, measured and reported yaw rates; None where the device hardly rotated."""
    first = rates.means(intervals.starts, intervals.stops)
    if _rms(first[finite_rows(first)]) < 0.5 * _LEAST_ROTATING:  # before rates are measured for every shift
        return None
    overlap = min(rates.seconds[-1], intervals.stops[-1]) - max(rates.seconds[0], intervals.starts[0])
    count = int(min(_GREATEST_SHIFT, max(0.0, _SHIFTS_SHARE * overlap)) / _SHIFT_STEP)
    shifts = np.asarray(np.arange(-count, count + 1) * _SHIFT_STEP, np.float64)
    measured = np.stack([rates.means(intervals.starts + s, intervals.stops + s) for s in shifts])
    known = np.flatnonzero(np.isfinite(measured).all(axis=(0, 2)))
    if len(known) < _FEWEST_INTERVALS:
        return None
    length = float(np.median(intervals.lengths))
    noise = max(rates.noise(length), np.sqrt(2.0) * orientation_noise(quaternions_xyzw) / length)
    if _rms(measured[count][known]) < max(_LEAST_ROTATING, _ROTATING_PER_NOISE * noise):
        return None
    reported = intervals.rates(quaternions_xyzw)[known]
    kept = _without_jumps(reported)
    reported, measured = _centred(reported[kept]), measured[:, known[kept]]
    measured = measured - measured.mean(axis=1, keepdims=True)
    products = np.einsum("smk,mk->s", measured, reported)
    lengths = np.sqrt((measured * measured).sum(axis=(1, 2)) * (reported * reported).sum())
    correlations = np.divide(products, lengths, out=np.zeros(len(products)), where=lengths > 0)
    return shifts, correlations, _rms(measured[count]), _rms(reported)


def _centred(rates: Float64Array) -> Float64Array:
    """Rates (M, K) without their mean, which a bias may be."""
    return np.asarray(rates - rates.mean(axis=0)) if len(rates) else rates


def _rms(rates: Float64Array) -> float:
    centred = _centred(rates)
    return float(np.sqrt((centred * centred).sum(axis=1).mean())) if len(rates) else 0.0


def _without_jumps(rates: Float64Array) -> BoolArray:
    """Which rates are not far beyond the usual, (M,) bool: a single wrong pose shows nothing about the others."""
    lengths = np.linalg.norm(rates, axis=1)
    return np.asarray(lengths <= 3.0 * np.percentile(lengths, 95.0) + 0.1)


def _gravity(subject: Subject) -> Iterator[Hit]:
    for found in _comparisons(subject):
        coherence = 0.0 if found.up is None else float(np.linalg.norm(found.up))
        if found.up is None or coherence == 0.0:
            continue
        x, y, z = found.up / coherence
        tilt_deg = float(np.degrees(np.arccos(np.clip(z, -1.0, 1.0))))
        if tilt_deg > _GREATEST_TILT_DEG or coherence < _LEAST_COHERENCE:
            problem = (
                f"the accelerometer's mean, converted to the world, points to {x:.2f}, {y:.2f}, {z:.2f}, "
                f"{tilt_deg:.0f}° off up, and is {coherence:.0%} as long as in the device; expected 0, 0, 1 "
                f"within {_GREATEST_TILT_DEG:.0f}°, and {_LEAST_COHERENCE:.0%} or more"
            )
            yield Hit(f"trajectories[{found.name}]", problem)


def _gyroscope(subject: Subject) -> Iterator[Hit]:
    for found in _comparisons(subject):
        if found.best_correlation < _LEAST_CORRELATION:
            problem = (
                f"yaw rates of the orientations and of the gyroscope correlate by {found.correlation:.2f}; "
                f"expected at least {_LEAST_CORRELATION}"
            )
            still = "" if found.reported else ": the orientations do not rotate"
            yield Hit(f"trajectories[{found.name}]", f"{problem}{still}")


def _scale(subject: Subject) -> Iterator[Hit]:
    for found in _comparisons(subject):
        if not found.reported or found.best_correlation <= _SURE:
            continue
        scale = found.measured / found.reported
        if not _SCALES[0] <= scale <= _SCALES[1]:
            hint = ": probably degrees per second" if abs(np.radians(scale) - 1) < _NEAR_DEGREES else ""
            problem = (
                f"the gyroscope rotates {scale:.3g} times as fast as the orientations of {found.name!r}{hint}"
            )
            yield Hit("sensors[imu].streams.gyroscope", problem)


def _clocks(subject: Subject) -> Iterator[Hit]:
    for found in _comparisons(subject):
        if len(found.shifts) < 3:
            continue
        best = int(found.correlations.argmax())
        shift, now, reached = float(found.shifts[best]), found.correlation, found.best_correlation
        is_better = reached > _SURE and 1.0 - reached < 0.5 * (1.0 - now)
        if abs(shift) > max(_LEAST_SHIFT, found.tolerance) and is_better:
            later = "later" if shift > 0 else "earlier"
            at_least = "at least " if best in {0, len(found.shifts) - 1} else ""
            problem = (
                f"yaw rates agree best ({reached:.3f} instead of {now:.3f}) if the IMU's times are "
                f"{at_least}{abs(shift):.2f} s {later} than those of the poses"
            )
            yield Hit(f"trajectories[{found.name}]", problem)


RULES: tuple[Rule, ...] = (
    Rule(
        "poses-against-gravity",
        Severity.WARNING,
        f"What the accelerometer measures points up in the world of the poses, within {_GREATEST_TILT_DEG:.0f}°.",
        "Write poses of the IMU as device to world, quaternions as x, y, z, w, in a world whose z points up; see "
        "whether the accelerometer has the gyroscope's axes, and points up at rest.",
        find=_gravity,
    ),
    Rule(
        "poses-against-gyroscope",
        Severity.WARNING,
        f"Orientations rotate as the gyroscope measures: their rates correlate by {_LEAST_CORRELATION} or more.",
        "Write poses as device to world, quaternions as x, y, z, w, of the IMU's own axes, in a right-handed world.",
        find=_gyroscope,
    ),
    Rule(
        "gyroscope-scale",
        Severity.WARNING,
        f"The gyroscope rotates {_SCALES[0]} to {_SCALES[1]} times as fast as the orientations.",
        "Write radians per second.",
        find=_scale,
    ),
    Rule(
        "poses-clock",
        Severity.WARNING,
        f"Orientations rotate at the time at which the gyroscope does, within {_LEAST_SHIFT} s.",
        "Find the offset with `sceneloom sync`, and bring both to one clock.",
        find=_clocks,
    ),
)
