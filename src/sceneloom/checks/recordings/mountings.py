"""Rules about where cameras and lidars sit on the vehicle: matrices that are inverted, in millimetres or exchanged."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.reading import warnings_of_code
from sceneloom.checks.recordings.camera_pairs import stereo_pairs
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.errors import CalibrationError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import SILENT_ERROR, nearest_rotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.scene import Scene, Sensor

FARTHEST = 5.0
"""A sensor is no farther from the IMU [m]."""
_MILLIMETRES = 50.0
"""What is farther [m] than this is in millimetres or centimetres."""
WIDEST_BASELINE = 1.0
_NARROWEST_BASELINE = 0.005
"""Two cameras that look the same trajectory are so far apart [m]."""
_SAME_LOCATION, _SAME_ROTATION = 1e-4, 1e-6
"""Mountings whose translations [m] and rotation matrices differ by less were copied, not calibrated."""
_UPRIGHT_DEG, _ROLLED_DEG = 20.0, 45.0
"""A camera stands upright below the first angle off it, and is on its way to its side beyond the second."""
_STEEP_DEG = 65.0
_SAMPLES = 20_000
"""So many samples of the accelerometer, spread over all, report where up is."""
_MATRICES = ("imuToCamera", "imuToCameraMatrix", "imuToLidar", "imuToLidarMatrix")


def _mounts(subject: Subject) -> Iterator[tuple[str, str, RigidTransform]]:
    """Location, name and `sensor_from_imu` of every sensor of the calibration."""
    if subject.recording is None:
        return
    calibration = subject.recording.calibration
    for index, camera in sorted(calibration.cameras.items()):
        if camera.camera_from_imu is not None:
            yield (
                _location(subject, camera.location, "imuToCamera"),
                f"camera {index}",
                camera.camera_from_imu,
            )
    for index, lidar in sorted(calibration.lidars.items()):
        if lidar.lidar_from_imu is not None:
            yield _location(subject, lidar.location, "imuToLidar"), f"lidar {index}", lidar.lidar_from_imu


def _location(subject: Subject, location: str, key: str) -> str:
    folder = "" if subject.recording is None else str(subject.recording.folder)
    return f"{location.removeprefix(folder).lstrip('/')}.{key}"


def _far(subject: Subject) -> Iterator[Hit]:
    for location, name, mount in _mounts(subject):
        x, y, z = mount.inverse().translation
        distance = float(np.linalg.norm(mount.translation))
        if distance > FARTHEST:
            hint = ": probably millimetres" if distance > _MILLIMETRES else ""
            reported = f"{name} is {distance:.1f} m from the IMU ({x:.2f}, {y:.2f}, {z:.2f})"
            yield Hit(location, f"{reported}; expected {FARTHEST:g} m at most{hint}")


def _same(subject: Subject) -> Iterator[Hit]:
    cameras = [(location, name, m) for location, name, m in _mounts(subject) if name.startswith("camera")]
    for (_, first, a), (location, second, b) in combinations(cameras, 2):
        moved = float(np.abs(a.translation - b.translation).max())
        rotated = float(np.abs(a.rotation - b.rotation).max())
        if moved < _SAME_LOCATION and rotated < _SAME_ROTATION:
            yield Hit(location, f"the same as of {first}; expected one of its own for {second}")


def _inverted(subject: Subject) -> Iterator[Hit]:
    """Cameras that lie on their side, while the inverse of their matrix stands upright."""
    up = _up_imu(subject)
    if up is None:
        return
    for location, name, mount in _mounts(subject):
        if not name.startswith("camera"):
            continue
        given, inverse = _posture(mount.rotation, up), _posture(mount.rotation.T, up)
        if given.rolled > _ROLLED_DEG and inverse.rolled < _UPRIGHT_DEG and inverse.steep < _ROLLED_DEG:
            reported = (
                f"{name} lies {given.rolled:.0f}° off upright, by the accelerometer, and its inverse stands upright: "
                "probably inverted or transposed; expected the matrix that takes points of the IMU into the camera"
            )
            yield Hit(location, reported)


def _steep(subject: Subject) -> Iterator[Hit]:
    up = _up_imu(subject)
    if up is None:
        return
    for location, name, mount in _mounts(subject):
        given = _posture(mount.rotation, up)
        if name.startswith("camera") and given.steep > _STEEP_DEG:
            reported = (
                f"{name} looks {given.steep:.0f}° {'up' if given.looks_up else 'down'}, by the accelerometer"
            )
            yield Hit(location, reported)


@dataclass(frozen=True, slots=True)
class _Posture:
    """How a camera stands: angle of the image's lower side off down, and of its view off level [deg]."""

    rolled: float
    steep: float
    looks_up: bool


def _posture(camera_from_imu: Float64Array, up_imu: Float64Array) -> _Posture:
    """How a camera of that rotation (3, 3) stands where `up_imu` (3,), of length 1, points up."""
    _, down, ahead = np.clip(camera_from_imu @ up_imu * (1.0, -1.0, 1.0), -1.0, 1.0)
    return _Posture(
        float(np.degrees(np.arccos(down))), float(np.degrees(abs(np.arcsin(ahead)))), bool(ahead > 0)
    )


def _up_imu(subject: Subject) -> Float64Array | None:
    """The mean direction of what the accelerometer measures, (3,), where it stays the same for long; else None."""
    imu = next((s for s in subject.scene.sensors if isinstance(s, ImuSensor)), None)
    forces = (MappingProxyType({}) if imu is None else imu.streams).get("accelerometer")
    if forces is None or forces.values.shape[1] != 3 or len(forces) == 0:
        return None
    some = forces.values[:: len(forces) // _SAMPLES + 1]
    some = some[np.isfinite(some).all(axis=1)]
    lengths = np.linalg.norm(some, axis=1)
    mean = some.mean(axis=0) if len(some) else np.zeros(3)
    length = float(np.linalg.norm(mean))
    steady = length > 0.8 * float(lengths.mean()) if len(some) and lengths.any() else False
    return mean / length if steady else None


def _baselines(subject: Subject) -> Iterator[Hit]:
    for pair in stereo_pairs(subject):
        location = f"calibration.json: cameras[{pair.second}].imuToCamera"
        length, names = float(np.linalg.norm(pair.baseline)), f"cameras {pair.first} and {pair.second}"
        if length < _NARROWEST_BASELINE:
            if length >= _SAME_LOCATION:
                reported = f"{names} look the same way from {length * 1e3:.1f} mm apart"
                yield Hit(
                    location,
                    f"{reported}; expected {_NARROWEST_BASELINE * 1e3:g} mm to {WIDEST_BASELINE:g} m",
                )
        elif length > WIDEST_BASELINE:
            hint = ": probably millimetres" if length > FARTHEST else ""
            reported = f"{names} look the same way from {length:.2f} m apart; expected {WIDEST_BASELINE:g} m at most{hint}"
            yield Hit(location, reported)


def _left_and_right(subject: Subject) -> Iterator[Hit]:
    for pair in stereo_pairs(subject):
        x, y, z = pair.baseline
        if -x >= _NARROWEST_BASELINE and -x > max(abs(y), abs(z)):
            reported = (
                f"camera {pair.second} is {-x:.3f} m to the left of camera {pair.first}; usual is the right: "
                "see whether videos or entries are exchanged, or both matrices inverted"
            )
            yield Hit(f"calibration.json: cameras[{pair.second}].imuToCamera", reported)


def _with_rotations(scene: Scene) -> Scene:
    """Let entries of the calibration state the rotations that were taken instead of theirs."""
    sensors = tuple(map(_with_rotation, scene.sensors))
    changed = any(new is not old for new, old in zip(sensors, scene.sensors, strict=True))
    return replace(scene, sensors=sensors) if changed else scene


def _with_rotation(sensor: Sensor) -> Sensor:
    if not isinstance(sensor, CameraSensor | DepthCameraSensor | LidarSensor) or sensor.mount is None:
        return sensor
    entry = sensor.extras.get("calibration")
    stale = [key for key in _MATRICES if isinstance(entry, Mapping) and _is_off(entry.get(key))]
    if not stale or not isinstance(entry, Mapping):
        return sensor
    matrix = sensor.mount.inverse().matrix.tolist()
    repaired = MappingProxyType({**entry, **dict.fromkeys(stale, matrix)})
    return replace(sensor, extras=MappingProxyType({**sensor.extras, "calibration": repaired}))


def _is_off(numbers: object) -> bool:
    """Whether a matrix as JSON has it holds a rotation that is off by more than is passed over in silence."""
    try:
        matrix = np.array(numbers, np.float64)
        matrix = matrix.reshape(round(matrix.size**0.5), -1)[:3, :3]
        return nearest_rotation(matrix)[1] > SILENT_ERROR
    except (TypeError, ValueError, CalibrationError):
        return False


RULES: tuple[Rule, ...] = (
    Rule(
        "mounting-rotation",
        Severity.WARNING,
        "Rotations of mountings are orthonormal within 0.001; beyond 0.01 they are refused.",
        "Write rotations with more digits; `--fix` writes the nearest rotation.",
        find=warnings_of_code("rotation-normalised"),
        fix=_with_rotations,
    ),
    Rule(
        "mounting-far",
        Severity.WARNING,
        f"Cameras and lidars are at most {FARTHEST:g} m from the IMU.",
        "Write metres.",
        find=_far,
    ),
    Rule(
        "mounting-repeated",
        Severity.WARNING,
        "No two cameras have one `imuToCamera`.",
        "Write each camera's own.",
        find=_same,
    ),
    Rule(
        "mounting-inverted",
        Severity.WARNING,
        "Cameras do not lie on their side where the inverse of their matrix would stand upright.",
        "Write the matrix by rows that takes points of the IMU into the camera: x right, y down, z forward.",
        find=_inverted,
    ),
    Rule(
        "mounting-steep",
        Severity.HINT,
        f"Cameras look ahead, not up or down by more than {_STEEP_DEG:g}°.",
        "See whether the axes are x right, y down, z forward; it is allowed if the camera is mounted so.",
        find=_steep,
    ),
    Rule(
        "stereo-baseline",
        Severity.WARNING,
        f"Cameras that look the same way are {_NARROWEST_BASELINE * 1e3:g} mm to {WIDEST_BASELINE:g} m apart.",
        "Write metres, and each camera's own mounting.",
        find=_baselines,
    ),
    Rule(
        "stereo-sides",
        Severity.HINT,
        "Of two cameras that look the same way, the first is the left one.",
        "See whether videos, entries or matrices are exchanged; it is allowed if they are not.",
        find=_left_and_right,
    ),
)
