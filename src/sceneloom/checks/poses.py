"""Rules about poses of sensors and the ego, and about corrections of them."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.checks.rule import (
    ERROR,
    HINT,
    WARNING,
    Hit,
    Rule,
    Subject,
    beyond_neighbours,
    frames_path,
    period_ns,
    seconds,
    timestamps_of,
    unless_recording,
)
from sceneloom.geometry.rigid import angle_between
from sceneloom.scene.annotations import CameraCalibration, LocalizationAdjustment, effect_of
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import Posed, is_on_ego
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Sensor, scene_period_ns, time_span
from sceneloom.scene.types import Coordinates, Identifier, key_of

FASTEST = 150.0
"""Nothing that carries sensors on the ground is faster [m/s]."""

FASTEST_ROTATION_DEG = 720.0
"""No vehicle rotates faster [deg/s]."""

STEP_FACTOR, STEP_MARGIN = 3.0, 1.0
ROTATION_FACTOR, ROTATION_MARGIN_DEG = 3.0, 15.0


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
        for k in np.flatnonzero(beyond_neighbours(steps, times, FASTEST, STEP_FACTOR, STEP_MARGIN)).tolist():
            yield Hit(f"{path}.values[{k + 1}]", f"{steps[k]:.2f} m in {times[k]:.3f} s, unlike the steps beside it")


def _rotations(subject: Subject) -> Iterator[Hit]:
    for path, timestamps_ns, _, quaternions_xyzw in _paths(subject):
        if quaternions_xyzw is None or len(timestamps_ns) < 2:
            continue
        times = np.diff(timestamps_ns) / 1e9
        rotations = np.degrees(angle_between(quaternions_xyzw[:-1], quaternions_xyzw[1:]))
        wrong = beyond_neighbours(rotations, times, FASTEST_ROTATION_DEG, ROTATION_FACTOR, ROTATION_MARGIN_DEG)
        for k in np.flatnonzero(wrong).tolist():
            problem = f"rotated by {rotations[k]:.1f} degrees in {times[k]:.3f} s, unlike the steps beside it"
            yield Hit(f"{path}.values[{k + 1}]", problem)


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
