"""Rules about poses of sensors and the ego, corrections of them, and trajectories of recordings against the IMU."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, finite_rows
from sceneloom.checks.recordings.times import Kind, Stream, streams_of_kind
from sceneloom.checks.rule import (
    ERROR,
    HINT,
    WARNING,
    Hit,
    Rule,
    Subject,
    frames_path,
    period_ns,
    seconds,
    timestamps_of,
    unless_recording,
)
from sceneloom.formats.base.poses import GREATEST_NORM_ERROR
from sceneloom.geometry.rigid import (
    angle_between,
    conjugate_quaternion,
    multiply_quaternions,
    normalise_quaternion,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from sceneloom.scene.annotations import CameraCalibration, LocalizationAdjustment, effect_of
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import is_on_ego
from sceneloom.scene.motion import ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Posed, Sensor, scene_period_ns, time_span
from sceneloom.scene.types import Coordinates, Identifier, key_of

FASTEST = 150.0
"""Nothing that carries sensors on the ground is faster [m/s]."""

_STEP_LIMITS, _ROTATION_LIMITS = (FASTEST, 3.0, 1.0), (720.0, 3.0, 15.0)
"""Largest rate [m/s], [deg/s]; so many times the rate of the neighbours is believed, and so much more than that."""


def _placed_sensors(subject: Subject) -> Iterator[tuple[str, Posed]]:
    return ((path, sensor) for path, sensor in subject.sensors() if isinstance(sensor, Posed))


def _without_position(subject: Subject) -> Iterator[Hit]:
    """Sensors of unknown position; not cameras of a recording, whose missing mounting is an error already."""
    reported = any(fault.code == "mounts-missing" for fault in subject.faults)
    for path, sensor in _placed_sensors(subject):
        if reported and isinstance(sensor, CameraSensor):
            continue
        if sensor.poses is None and sensor.mount is None and len(timestamps_of(sensor)):
            yield Hit(f"{path}.poses", "no poses and no mounting; expected where the sensor was")


def _without_trajectory(subject: Subject) -> Iterator[Hit]:
    """Sensors that are mounted on an ego of which no way is known; points in the world need none."""
    if subject.scene.trajectories:
        return
    mounted = [
        path
        for path, sensor in _placed_sensors(subject)
        if sensor.poses is None and sensor.mount is not None and len(timestamps_of(sensor))
    ]
    if mounted:
        yield Hit("trajectories", f"none, and {', '.join(mounted)} are known by their mountings on the ego only")


def _uncovered(subject: Subject) -> Iterator[Hit]:
    for path, sensor in _placed_sensors(subject):
        timestamps_ns = timestamps_of(sensor)
        if sensor.poses is None or sensor.poses.static or not len(timestamps_ns):
            continue
        reach_ns = period_ns(timestamps_ns)
        beyond_ns = np.maximum(sensor.poses.start_ns - timestamps_ns, timestamps_ns - sensor.poses.stop_ns)
        far = np.flatnonzero(beyond_ns > reach_ns)
        if len(far):
            problem = (
                f"{len(far)} of {len(timestamps_ns)} frames lie before the first or after the last pose, by up to "
                f"{seconds(float(beyond_ns.max()))}; expected at most one period of {seconds(reach_ns)}"
            )
            yield Hit(f"{frames_path(path, sensor)}[{far[0]}]", problem, len(far))


def _paths(subject: Subject) -> Iterator[tuple[str, Int64Array, Float64Array, Float64Array | None]]:
    """All ways through space with their locations: of sensors, and trajectories that no odometry sensor reports."""
    reported = set()
    for path, sensor in subject.sensors():
        poses: Poses | None = getattr(sensor, "poses", None)
        if isinstance(poses, Poses):
            yield f"{path}.poses", poses.timestamps_ns, poses.positions, poses.quaternions_xyzw
        if isinstance(sensor, OdometrySensor):
            reported.add(str(sensor.id))
    for name, trajectory in subject.scene.trajectories.items():
        if name not in reported and len(trajectory.timestamps_ns):
            yield (f"trajectories[{name}]", trajectory.timestamps_ns, trajectory.positions, trajectory.quaternions_xyzw)


def _jumps(subject: Subject) -> Iterator[Hit]:
    for path, timestamps_ns, positions, _ in _paths(subject):
        times = np.diff(timestamps_ns) / 1e9
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        for k in np.flatnonzero(_beyond_neighbours(steps, times, _STEP_LIMITS)).tolist():
            yield Hit(f"{path}.values[{k + 1}]", f"{steps[k]:.2f} m in {times[k]:.3f} s, unlike the steps beside it")


def _rotations(subject: Subject) -> Iterator[Hit]:
    for path, timestamps_ns, _, quaternions_xyzw in _paths(subject):
        if quaternions_xyzw is None or len(timestamps_ns) < 2:
            continue
        times = np.diff(timestamps_ns) / 1e9
        rotations = np.degrees(angle_between(quaternions_xyzw[:-1], quaternions_xyzw[1:]))
        for k in np.flatnonzero(_beyond_neighbours(rotations, times, _ROTATION_LIMITS)).tolist():
            problem = f"rotated by {rotations[k]:.1f} degrees in {times[k]:.3f} s, unlike the steps beside it"
            yield Hit(f"{path}.values[{k + 1}]", problem)


_FEWEST_STEPS = 4  # fewer steps do not report what is usual


def _beyond_neighbours(steps: Float64Array, times: Float64Array, limits: tuple[float, float, float]) -> BoolArray:
    """Steps (N,) faster than anything moves, or by far larger than the two before and after would let expect."""
    # the largest of these four does not count: a single wrong pose makes two wrong steps; times are more than 0
    fastest, factor, margin = limits
    wrong: BoolArray = ~(steps <= np.maximum(fastest * times, margin))
    if len(steps) < _FEWEST_STEPS:
        return wrong
    padded = np.pad(steps / times, 2, mode="reflect")
    neighbours = np.stack([padded[shift : shift + len(steps)] for shift in (0, 1, 3, 4)])
    usual = np.sort(neighbours, axis=0)[-2]
    wrong |= steps > factor * usual * times + margin
    return wrong


def _times_of_trajectories(subject: Subject) -> Iterator[Hit]:
    for name, trajectory in subject.scene.trajectories.items():
        timestamps_ns = trajectory.timestamps_ns
        for k in np.flatnonzero(timestamps_ns[1:] <= timestamps_ns[:-1]).tolist():
            timestamp, before = trajectory.timestamps_ns[k + 1], trajectory.timestamps_ns[k]
            yield Hit(f"trajectories[{name}][{k + 1}]", f"{timestamp} ns after {before} ns; expected a later time")


def _odometry_ids(subject: Subject) -> set[tuple[type, str | int]]:
    return {key_of(s.id) for s in subject.scene.sensors if isinstance(s, OdometrySensor)}


def _ego_unknown(subject: Subject) -> Iterator[Hit]:
    if _odometry_ids(subject) or subject.scene.trajectories:
        return
    for path, sensor in subject.sensors():
        if _has_ego_poses(sensor):
            yield Hit(f"{path}.coordinates", "'ego', and no odometry sensor reports where the ego was")


def _ego_points_unknown(subject: Subject) -> Iterator[Hit]:
    if _odometry_ids(subject) or subject.scene.trajectories:
        return
    for path, sensor in subject.sensors():
        if is_on_ego(sensor) and not _has_ego_poses(sensor):
            yield Hit(path, "its points are in the ego's frame, and nothing says where the ego was")


def _has_ego_poses(sensor: Sensor) -> bool:
    return (
        isinstance(sensor, Posed)
        and sensor.coordinates is Coordinates.EGO
        and sensor.poses is not None
        and sensor.mount is None
    )


def _ego_ambiguous(subject: Subject) -> Iterator[Hit]:
    known = _odometry_ids(subject)
    if len(known) < 2:
        return
    for path, sensor in subject.sensors():
        if is_on_ego(sensor) and (type(sensor.parent_id), sensor.parent_id) not in known:
            names = ", ".join(sorted(repr(identifier) for _, identifier in known))
            problem = f"{sensor.parent_id!r} instead of one of {names}; coordinates are 'ego', and there are several"
            yield Hit(f"{path}.parent_id", problem)


# fmt: off
POSE_RULES: tuple[Rule, ...] = (
    Rule("sensor-placed", WARNING, "Every lidar, radar and camera has poses, or a mounting on the ego.",
         "Give the sensor its poses, or its mounting (`sceneloom convert` takes it from a calibration).",
         find=_without_position),
    Rule("ego-trajectory-known", HINT, "Of a drive with mounted sensors the ego trajectory is known.",
         "Find it from the sweeps (`sceneloom fuse --trajectory lidar`), or add one to the drive.",
         find=_without_trajectory),
    Rule("poses-cover-frames", WARNING,
         "The poses of a sensor reach from its first frame to its last, within one period.",
         "Add poses, or cut the frames; those without a pose cannot be placed.", find=_uncovered),
    Rule("poses-jump", WARNING, "No pose lies farther from its neighbours than a vehicle can move.",
         "See whether the trajectory was pieced together, or a fix of the satellites was wrong.",
         find=unless_recording(_jumps)),
    Rule("poses-rotation", WARNING, "No pose is rotated against its neighbours more than a vehicle can rotate.",
         "See whether the order of the quaternion's numbers changes, or an angle wraps.",
         find=unless_recording(_rotations)),
    Rule("trajectory-times-increasing", ERROR, "The poses of each trajectory have strictly increasing times.",
         "Sort them, and leave out those that stand there twice.", find=_times_of_trajectories),
    Rule("ego-odometry", ERROR, "Where poses are in ego coordinates, an odometry sensor reports where the ego was.",
         "Add an odometry sensor with the poses of the ego, or give poses in the world.", find=_ego_unknown),
    Rule("ego-points-placed", WARNING,
         "Where points are in the ego's frame, a trajectory or an odometry sensor reports where the ego was.",
         "Add the trajectory of the ego, or find it from the sweeps (`sceneloom fuse --trajectory lidar`).",
         find=_ego_points_unknown),
    Rule("ego-odometry-unique", ERROR,
         "Where there are several odometry sensors, `parent_id` says in whose ego coordinates a sensor is.",
         "Set `parent_id` to the id of the odometry sensor that is meant.", find=_ego_ambiguous),
)
# fmt: on


def _not_applied(subject: Subject) -> Iterator[Hit]:
    pending = {key_of(correction.id): correction for correction in subject.scene.pending_corrections}
    for path, annotation in subject.annotations():
        correction = pending.get(key_of(annotation.id))
        if correction is not None:
            yield Hit(path, f"{correction.type}: {effect_of(correction)}")


def _several_adjustments(subject: Subject) -> Iterator[Hit]:
    found = list(subject.annotations_of(LocalizationAdjustment))
    for path, adjustment in found[1:]:
        yield Hit(path, f"{adjustment.id!r} is one of {len(found)}, the first is {found[0][0]}; expected one")


def _adjustment_short(subject: Subject) -> Iterator[Hit]:
    # inertial sensors and satellite receivers begin and end as they like; what is corrected are frames
    framed = tuple(s for s in subject.scene.sensors if isinstance(s, LidarSensor | RadarSensor | CameraSensor))
    span = time_span(replace(subject.scene, sensors=framed))
    if span is None:
        return
    period_ns = scene_period_ns(subject.scene)
    for path, adjustment in subject.annotations_of(LocalizationAdjustment):
        poses = adjustment.poses
        if len(poses.timestamps_ns) < 2:
            continue
        missing_ns = max(poses.start_ns - span[0], span[1] - poses.stop_ns)
        if missing_ns > period_ns:
            reported = f"{poses.start_ns} to {poses.stop_ns} ns; the frames' times are {span[0]} to {span[1]} ns"
            yield Hit(f"{path}.poses", reported)


def _several_calibrations(subject: Subject) -> Iterator[Hit]:
    by_camera: dict[tuple[type, Identifier], list[str]] = defaultdict(list)
    for path, calibration in subject.annotations_of(CameraCalibration):
        by_camera[type(calibration.sensor_id), calibration.sensor_id].append(path)
    for (_, sensor_id), paths in by_camera.items():
        for path in paths[1:]:
            yield Hit(path, f"camera {sensor_id!r} has {len(paths)}, the first is {paths[0]}; expected one")


def _calibrates_nothing(subject: Subject) -> Iterator[Hit]:
    for path, calibration in subject.annotations_of(CameraCalibration):
        if calibration.poses is None and calibration.intrinsics is None and not calibration.time_offset_ns:
            yield Hit(path, "neither poses nor intrinsics nor a time offset; expected one of them")


def _other_image_size(subject: Subject) -> Iterator[Hit]:
    for path, calibration in subject.annotations_of(CameraCalibration):
        sensor, camera_model = subject.sensor(calibration.sensor_id), calibration.intrinsics
        if camera_model is None or not isinstance(sensor, CameraSensor):
            continue
        given, usual = (camera_model.width, camera_model.height), (sensor.camera.width, sensor.camera.height)
        if given != usual:
            reported = f"{given[0]} x {given[1]} px; the camera's images are {usual[0]} x {usual[1]} px"
            yield Hit(f"{path}.intrinsics", reported)


# fmt: off
CORRECTION_RULES: tuple[Rule, ...] = (
    Rule("corrections-not-applied", HINT, "Corrections of cameras and of the localization are applied.",
         "Nothing has to be done: what computes applies them. Other programs may not: `sceneloom edit apply` does "
         "it for good.", find=_not_applied),
    Rule("localization-adjustments-several", WARNING, "A scene has one localization adjustment at most.",
         "Keep one: in which order several are applied is not stated.", find=_several_adjustments),
    Rule("localization-adjustment-short", WARNING,
         "A localization adjustment covers the time of the scene, give or take one sweep.",
         "Extend its poses to the scene's ends.", find=_adjustment_short),
    Rule("camera-calibrations-several", WARNING, "A camera has one calibration annotation at most.",
         "Keep one: in which order several are applied is not stated.", find=_several_calibrations),
    Rule("camera-calibration-empty", WARNING, "A camera calibration says something about poses, camera model or time.",
         "Take it out.", find=_calibrates_nothing),
    Rule("camera-calibration-size", WARNING,
         "The camera model of a camera calibration is for images of the camera's size.",
         "Scale its numbers to the size of the images.", find=_other_image_size),
)
# fmt: on


_INTERVAL, _LONGEST_INTERVAL, _MOST_INTERVALS, _FEWEST_INTERVALS = 0.2, 1.0, 2_000, 10
"""Rates are compared over so long [s], or over the time from pose to pose where that is longer; poses farther apart
than the second do not show how the device rotated between them."""

_TORN_FACTOR, _TORN_LENGTH = 5.0, 20.0
"""Samples beyond so many times what 99 % keep to, and longer than this, are blows or broken lines."""

_ENOUGH_FOR_NOISE, _FROM_MEDIAN = 20_000, 1.4826
"""The deviation of a normal distribution is so many times the median of its absolute values."""

_GAP_FACTOR = 5.5  # so many usual intervals without a sample are a gap: the motion during it is not known
_LEAST_CORRELATION = 0.8  # angular velocities of orientations and gyroscope that correlate less do not agree

_GREATEST_TILT_DEG = 25.0
"""So far off up the mean of the accelerometer may be: a vehicle that brakes all the time leaves 20°."""

_LEAST_COHERENCE = 0.6
"""The accelerometer's mean in the world has to be this part of its mean length: gravity does not rotate with a device,
and constant hard manoeuvres leave 0.8."""

_LEAST_ROTATING, _ROTATING_PER_NOISE = 0.03, 2.0
"""The gyroscope's means have to vary so much (rms) [rad/s], and so many times their noise, to be compared."""

_GREATEST_SHIFT, _SHIFT_STEP, _SHIFTS_SHARE = 1.0, 0.02, 0.2
"""Clock offsets are tried up to so long, in such steps [s], and up to this part of the time in common."""

_LEAST_SHIFT = 0.05  # shorter offsets between poses and IMU [s] are for `sceneloom sync` to find
_SURE, _SCALES, _NEAR_DEGREES = 0.9, (0.6, 1.6), 0.2


def _steps_of(stream: Stream, usable: BoolArray) -> tuple[Int64Array, Float64Array]:
    """The usable poses that are the first of their time, (M,) int64, and the times from one to the next [s]."""
    rows = np.flatnonzero(usable)
    rows = rows[np.diff(stream.seconds[rows], prepend=-np.inf) > 0]
    return rows, np.diff(stream.seconds[rows])


def _first_of_each(wrong: BoolArray) -> list[int]:
    """Steps that are wrong; of those that follow each other, as to a wrong pose and back, the first."""
    found: list[int] = np.flatnonzero(wrong & ~np.concatenate([[False], wrong[:-1]])).tolist()
    return found


def _steps_in_lines(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.POSES):
        positions = stream.values[:, :3]
        rows, times = _steps_of(stream, finite_rows(positions))
        steps = np.linalg.norm(np.diff(positions[rows], axis=0), axis=1)
        for k in _first_of_each(_beyond_neighbours(steps, times, _STEP_LIMITS)):
            row = int(rows[k + 1])
            problem = (
                f"{stream.at(row)} is {steps[k]:.2f} m from the pose {times[k]:.3f} s before, "
                f"{steps[k] / times[k]:.1f} m/s, unlike the steps beside it"
            )
            yield stream.hit(row, problem)


def _rotations_in_lines(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.POSES):
        quaternions = stream.values[:, 3:]
        norms = np.sqrt((quaternions * quaternions).sum(axis=1))
        rows, times = _steps_of(stream, np.asarray(np.abs(norms - 1.0) <= GREATEST_NORM_ERROR))
        if len(rows) < 2:
            continue
        rotations = np.degrees(angle_between(quaternions[rows[:-1]], quaternions[rows[1:]]))
        for k in _first_of_each(_beyond_neighbours(rotations, times, _ROTATION_LIMITS)):
            row = int(rows[k + 1])
            problem = (
                f"{stream.at(row)} is rotated by {rotations[k]:.1f} degrees against the pose {times[k]:.3f} s before, "
                "unlike the steps beside it"
            )
            yield stream.hit(row, problem)


class _CleanSamples:
    """Samples with finite values and strictly increasing times."""

    # `seconds` (N,) [s], from an origin; `values` (N, 3); `sums` (N, 3), integral of the values since the first sample;
    # `gaps` (N,), how many gaps lie before each sample

    def __init__(self, seconds: Float64Array, values: Float64Array) -> None:
        self.seconds, self.values = seconds, values
        steps = np.diff(seconds)
        areas = 0.5 * (values[1:] + values[:-1]) * steps[:, None]
        self.sums = np.vstack([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
        self.gaps = np.concatenate([[0], np.cumsum(steps > _GAP_FACTOR * np.median(steps))])

    @classmethod
    def of(cls, samples: VectorSamples | None, origin_ns: int) -> "_CleanSamples | None":
        """Take the usable samples of a stream of three axes; None for fewer than three."""
        if samples is None or samples.values.shape[1] != 3:
            return None
        lengths = np.sqrt((samples.values * samples.values).sum(axis=1))
        finite = lengths[np.isfinite(lengths)]
        # not far beyond what nearly all others are
        farthest = max(_TORN_FACTOR * float(np.percentile(finite, 99.0)), _TORN_LENGTH) if len(finite) else 0.0
        usable = np.flatnonzero(np.isfinite(lengths) & (lengths <= farthest))
        times_ns = samples.timestamps_ns[usable]
        if not (np.diff(times_ns) > 0).all():
            usable = usable[np.unique(times_ns, return_index=True)[1]]
        if len(usable) < 3:
            return None
        return cls((samples.timestamps_ns[usable] - origin_ns) / 1e9, samples.values[usable])

    def means(self, starts: Float64Array, stops: Float64Array) -> Float64Array:
        """The mean value over each interval, (M, 3); NaN where it reaches beyond the samples or over a gap."""
        before, after = self._location(starts), self._location(stops)
        integral = self._sums_at(stops, after) - self._sums_at(starts, before)
        known = (starts >= self.seconds[0]) & (stops <= self.seconds[-1])
        known &= self.gaps[np.minimum(after + 1, len(self.gaps) - 1)] == self.gaps[before]
        means: Float64Array = np.where(known[:, None], integral / (stops - starts)[:, None], np.nan)
        return means

    def noise(self, length: float) -> float:
        """Deviation of means over so long [s] that comes from noise, all axes together."""
        each = _noise_of(np.diff(self.values[:_ENOUGH_FOR_NOISE], axis=0))
        samples = max(1.0, length / float(np.median(np.diff(self.seconds[:_ENOUGH_FOR_NOISE]))))
        return each / float(np.sqrt(samples))

    def _location(self, seconds: Float64Array) -> Int64Array:
        found = np.searchsorted(self.seconds, seconds, side="right") - 1
        return np.clip(found, 0, len(self.seconds) - 1).astype(np.int64)

    def _sums_at(self, seconds: Float64Array, location: Int64Array) -> Float64Array:
        """The sums at times that lie after these samples, (M, 3): looked up once for all axes."""
        first = np.minimum(location, len(self.seconds) - 2)
        share = (seconds - self.seconds[first]) / (self.seconds[first + 1] - self.seconds[first])
        before = self.sums[first]
        return np.asarray(before + share[:, None] * (self.sums[first + 1] - before))


def _noise_of(steps: Float64Array) -> float:
    """Deviation of values, all axes together, from their steps (N, 3)."""
    # second differences of independent errors have six times their variance; smooth motion has none
    return float(np.linalg.norm(_FROM_MEDIAN * np.median(np.abs(np.diff(steps, axis=0)), axis=0) / np.sqrt(6.0)))


@dataclass(frozen=True, slots=True, eq=False)
class _PoseIntervals:
    """A trajectory as intervals between some of its poses."""

    starts: Float64Array  # (M,) [s], counted from the trajectory's first pose
    stops: Float64Array  # (M,) [s], likewise
    first: Int64Array  # (M,), the poses that bound each interval
    last: Int64Array

    @classmethod
    def of(cls, trajectory: Trajectory) -> "_PoseIntervals | None":
        """Choose intervals of about `_INTERVAL`, evenly spread where there are very many; None for too few."""
        seconds = (trajectory.timestamps_ns - trajectory.timestamps_ns[0]) / 1e9
        if len(seconds) < 2:
            return None
        step = max(_INTERVAL, float(np.median(np.diff(seconds))))
        knots = np.flatnonzero(np.diff(np.floor((seconds + 1e-6) / step), prepend=-1.0))
        lengths = np.diff(seconds[knots])
        usable = np.flatnonzero((lengths > 0.5 * step) & (lengths < min(2.0 * step, _LONGEST_INTERVAL + 1e-6)))
        usable = usable[:: len(usable) // _MOST_INTERVALS + 1]
        first, last = knots[usable].astype(np.int64), knots[usable + 1].astype(np.int64)
        return cls(seconds[first], seconds[last], first, last) if len(usable) >= _FEWEST_INTERVALS else None

    @property
    def lengths(self) -> Float64Array:
        """(M,) float64 [s]."""
        return self.stops - self.starts

    def rates(self, quaternions_xyzw: Float64Array) -> Float64Array:
        """Mean angular velocity over each interval in the axes of the device, (M, 3) [rad/s]."""
        rotated = multiply_quaternions(conjugate_quaternion(quaternions_xyzw[self.first]), quaternions_xyzw[self.last])
        return rotation_vector_from_quaternion(rotated) / self.lengths[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """A trajectory compared with the IMU over the same intervals."""

    name: str  # of the trajectory
    up: Float64Array | None  # (3,) mean accelerometer in the world over its mean length
    shifts: Float64Array  # (S,) [s] by which the gyroscope's times were taken to be later; empty: hardly rotated
    correlations: Float64Array  # (S,) of the angular velocities of all axes together
    tolerance: float = 0.0  # between samples and poses [s]; shorter offsets are not known
    measured: float = 0.0  # root mean square of the gyroscope's angular velocities [rad/s]
    reported: float = 0.0  # likewise of the orientations

    @property
    def correlation(self) -> float:
        """Without an offset; 1 where the rotation is not known."""
        return float(self.correlations[len(self.shifts) // 2]) if len(self.shifts) else 1.0

    @property
    def best_correlation(self) -> float:
        """The greatest over all offsets; 1 where the rotation is not known."""
        return float(self.correlations.max()) if len(self.shifts) else 1.0


def _comparisons(subject: Subject) -> Sequence[_Comparison]:
    return subject.table("poses beside the IMU", _compare_all)


def _compare_all(subject: Subject) -> list[_Comparison]:
    imu = next((sensor for sensor in subject.scene.sensors if isinstance(sensor, ImuSensor)), None)
    trajectories = subject.scene.trajectories.values() if imu is not None else ()
    found = [_compared(one, imu) for one in trajectories if one.quaternions_xyzw is not None and imu is not None]
    return [comparison for comparison in found if comparison is not None]


def _compared(trajectory: Trajectory, imu: ImuSensor) -> _Comparison | None:
    intervals = _PoseIntervals.of(trajectory)
    if intervals is None:
        return None
    origin_ns, quaternions = int(trajectory.timestamps_ns[0]), normalise_quaternion(trajectory.poses.quaternions_xyzw)
    up = _up(intervals, quaternions, _CleanSamples.of(imu.streams.get("accelerometer"), origin_ns))
    rates = _CleanSamples.of(imu.streams.get("gyroscope"), origin_ns)
    rotating = None if rates is None else _rotating(intervals, quaternions, rates)
    if rates is None or rotating is None:
        return None if up is None else _Comparison(trajectory.name, up, np.zeros(0), np.zeros(0))
    tolerance = max(float(np.median(np.diff(rates.seconds))), float(np.median(np.diff(trajectory.timestamps_ns))) / 1e9)
    shifts, correlations, measured, reported = rotating
    return _Comparison(trajectory.name, up, shifts, correlations, tolerance, measured, reported)


def _up(intervals: _PoseIntervals, quaternions_xyzw: Float64Array, forces: _CleanSamples | None) -> Float64Array | None:
    """The accelerometer's mean in the world as part of its mean length, (3,); None for too few samples."""
    if forces is None:
        return None
    measured = forces.means(intervals.starts, intervals.stops)
    known = finite_rows(measured)
    if np.count_nonzero(known) < _FEWEST_INTERVALS or not measured[known].any():
        return None
    middle = (intervals.first + intervals.last) // 2
    world = rotate_vectors(quaternions_xyzw[middle], measured)[known]
    return np.asarray(world.mean(axis=0) / np.linalg.norm(measured[known], axis=1).mean())


def _rotating(
    intervals: _PoseIntervals, quaternions_xyzw: Float64Array, rates: _CleanSamples
) -> tuple[Float64Array, Float64Array, float, float] | None:
    """Clock offsets, correlations, measured and reported angular velocities; None where the device hardly rotated."""
    first = rates.means(intervals.starts, intervals.stops)
    if _rms(first[finite_rows(first)]) < 0.5 * _LEAST_ROTATING:  # before rates are measured for every offset
        return None
    overlap = min(rates.seconds[-1], intervals.stops[-1]) - max(rates.seconds[0], intervals.starts[0])
    count = int(min(_GREATEST_SHIFT, max(0.0, _SHIFTS_SHARE * overlap)) / _SHIFT_STEP)
    shifts = np.asarray(np.arange(-count, count + 1) * _SHIFT_STEP, np.float64)
    measured = np.stack([rates.means(intervals.starts + s, intervals.stops + s) for s in shifts])
    known = np.flatnonzero(np.isfinite(measured).all(axis=(0, 2)))
    if len(known) < _FEWEST_INTERVALS:
        return None
    length, some = float(np.median(intervals.lengths)), quaternions_xyzw[:_ENOUGH_FOR_NOISE]
    steps = rotation_vector_from_quaternion(multiply_quaternions(conjugate_quaternion(some[:-1]), some[1:]))
    of_orientations = _noise_of(steps) if len(steps) > 1 else 0.0
    noise = max(rates.noise(length), np.sqrt(2.0) * of_orientations / length)
    if _rms(measured[count][known]) < max(_LEAST_ROTATING, _ROTATING_PER_NOISE * noise):
        return None
    reported = intervals.rates(quaternions_xyzw)[known]
    # a single wrong pose, far beyond the usual, shows nothing about the others
    lengths = np.linalg.norm(reported, axis=1)
    kept = lengths <= 3.0 * np.percentile(lengths, 95.0) + 0.1
    reported, measured = _centred(reported[kept]), measured[:, known[kept]]
    measured = measured - measured.mean(axis=1, keepdims=True)
    products = np.einsum("smk,mk->s", measured, reported)
    sizes = np.sqrt((measured * measured).sum(axis=(1, 2)) * (reported * reported).sum())
    correlations = np.divide(products, sizes, out=np.zeros(len(products)), where=sizes > 0)
    return shifts, correlations, _rms(measured[count]), _rms(reported)


def _centred(rates: Float64Array) -> Float64Array:
    """Rates (M, K) without their mean, which a bias may be."""
    return np.asarray(rates - rates.mean(axis=0)) if len(rates) else rates


def _rms(rates: Float64Array) -> float:
    centred = _centred(rates)
    return float(np.sqrt((centred * centred).sum(axis=1).mean())) if len(rates) else 0.0


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
                f"angular velocities of the orientations and of the gyroscope correlate by {found.correlation:.2f}; "
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
            problem = f"the gyroscope rotates {scale:.3g} times as fast as the orientations of {found.name!r}{hint}"
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
                f"angular velocities agree best ({reached:.3f} instead of {now:.3f}) if the IMU's times are "
                f"{at_least}{abs(shift):.2f} s {later} than those of the poses"
            )
            yield Hit(f"trajectories[{found.name}]", problem)


# fmt: off
POSE_STEP_RULES: tuple[Rule, ...] = (
    Rule("pose-steps", WARNING,
         "Poses of a recording move at up to 150 m/s, and no step is 3 times as fast as those beside it and 1 m "
         "more.", "Check whether the trajectory was pieced together, or tracking was lost and found again.",
         find=_steps_in_lines),
    Rule("pose-rotations", WARNING,
         "Poses of a recording rotate by up to 720 degrees a second, and no step is 3 times as fast as those "
         "beside it and 15 degrees more.",
         "Check whether the signs or the order of the quaternion's numbers change.", find=_rotations_in_lines),
)

POSES_AND_IMU_RULES: tuple[Rule, ...] = (
    Rule("poses-against-gravity", WARNING,
         f"The accelerometer points up in the world of the poses, within {_GREATEST_TILT_DEG:.0f}°.",
         "Write poses of the IMU as device to world, quaternions as x, y, z, w, in a world whose z points up; check "
         "whether the accelerometer has the gyroscope's axes, and points up at rest.", find=_gravity),
    Rule("poses-against-gyroscope", WARNING,
         f"Orientations rotate as the gyroscope measures: their rates correlate by {_LEAST_CORRELATION} or more.",
         "Write poses as device to world, quaternions as x, y, z, w, of the IMU's own axes, in a right-handed world.",
         find=_gyroscope),
    Rule("gyroscope-scale", WARNING,
         f"The gyroscope rotates {_SCALES[0]} to {_SCALES[1]} times as fast as the orientations.",
         "Write radians per second.", find=_scale),
    Rule("poses-clock", WARNING,
         f"Orientations rotate at the time at which the gyroscope does, within {_LEAST_SHIFT} s.",
         "Find the offset with `sceneloom sync`, and bring both to one clock.", find=_clocks),
)
# fmt: on
