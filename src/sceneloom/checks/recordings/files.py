"""Rules about the files of a recording: what it has, `frames` and `lidar` lines, settings, and `calibration.json`."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from itertools import combinations
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, unproject
from sceneloom.checks.faults import as_read, warnings_of_code
from sceneloom.checks.recordings.times import Kind, streams_of_kind
from sceneloom.checks.rule import HINT, WARNING, Find, FrameInHand, Hit, Rule, Subject, frames_spread, with_each
from sceneloom.errors import CalibrationError
from sceneloom.formats.recording.contents import CALIBRATION_FILE, CAMERA_MODEL_READINGS, FrameColumns, time_order, view
from sceneloom.formats.recording.reader import VIO_CONFIG_FILE
from sceneloom.formats.recording.vio_config import KNOWN_KEYS, read_vio_config
from sceneloom.geometry.rigid import SILENT_ERROR, RigidTransform, nearest_rotation
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.scene import Scene, Sensor

CAMERA_KEYS = frozenset(
    (
        *("model", "distortionModel", "distortionCoefficients", "focalLengthX", "focalLengthY", "cameraInd"),
        *("principalPointX", "principalPointY", "imageWidth", "imageHeight", "depthScale", "depthToCamera"),
        *("imuToCamera", "imuToCameraMatrix", "imuToCameraShiftSeconds"),
        *("shutterRollTimeSeconds", "rollingShutterLeftToRight", "exposureTimeSeconds"),
    )
)
LIDAR_KEYS = frozenset({"model", "lidarInd", "imuToLidar", "imuToLidarMatrix"})
ROOT_KEYS = frozenset(
    {"cameras", "lidars", "imuToOutput", "imuToGnss", "imuForward", "imuToMagnetometer", "imuToOdometer"}
)
"""Keys that the format has, or the vendor's software writes."""

_SECONDS = {
    "shutterRollTimeSeconds": (0.0, 0.1),
    "exposureTimeSeconds": (0.0, 1.0),
    "imuToCameraShiftSeconds": (-0.5, 0.5),
}  # times outside these [s] belong to no camera that moves

_PADDED = {"brown-conrady": (5, 8)}  # lists of the first length are read, and other programs want the second

SHORTEST, LONGEST = 0.2, 5.0
"""Focal lengths outside these parts of the image's width are rare: they see 136° and more, or 11° and less."""

MOST_UNEQUAL, OFF_CENTRE = 1.1, 0.2
"""Focal lengths of square pixels differ by less; the principal point lies within this part of the image's size around
its centre."""

_PARTS, _MILLIMETRES = 2.0, 50.0
"""A focal length up to the first number is none in pixels but in widths of the image, up to the second in mm."""

_HALVES, _NEAR = (2.0, 4.0, 0.5, 0.25), 0.05
"""A principal point at so many times the centre, within this share, comes from images that were resized."""

_ALIKE_DEG = 15.0  # cameras whose axes differ by no more are a pair [deg]

FARTHEST, _MOUNTINGS_MILLIMETRES = 5.0, 50.0
"""A sensor is no farther from the IMU [m]; numbers beyond the second are millimetres or centimetres."""

_NARROWEST_BASELINE, WIDEST_BASELINE = 0.005, 1.0
"""Two cameras that look the same way are so far apart [m]."""

_SAME_LOCATION, _SAME_ROTATION = 1e-4, 1e-6
"""Mountings whose translations [m] and rotation matrices differ by less were copied, not calibrated."""

_UPRIGHT_DEG, _ROLLED_DEG, _STEEP_DEG = 20.0, 45.0, 65.0
"""A camera is upright below the first angle, on its way to its side beyond the second, and looks up or down beyond the
third."""

_SAMPLES = 20_000  # so many samples of the accelerometer, spread over all, show where up is
_MATRICES = ("imuToCamera", "imuToCameraMatrix", "imuToLidar", "imuToLidarMatrix")
_WIDTH, _LOOKED_AT = 192, 4  # so many images are compared at this width [px], or at their own where that is less

_WIDEST_SHIFT, _CLEAR_SHIFT, _PATCH = 16, 1.5, 12
"""Disparities are searched up to the first, and reported from the second on [px]."""

_TEXTURE, _MATCHED, _CLEARLY = 6.0, 0.5, 0.7
"""A patch needs so much contrast (standard deviation, of 255) to be matched, has at most this part of it left where it
is, and has to fit so much better on one side than on the other."""

_FEWEST_PATCHES, _MOST_WRONG = 20, 0.5


def _entries(subject: Subject, name: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    content = {} if subject.recording is None else subject.recording.calibration.content
    listed = content.get(name)
    for index, entry in enumerate(listed if isinstance(listed, list) else ()):
        if isinstance(entry, dict):
            yield f"calibration.json: {name}[{index}]", entry


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def _spelling(subject: Subject) -> Iterator[Hit]:
    for name, key in (("cameras", "imuToCamera"), ("lidars", "imuToLidar")):
        for location, entry in _entries(subject, name):
            if name == "cameras":
                yield from _spelling_of_model(location, entry)
            other = f"{key}Matrix"
            if other in entry and key not in entry:
                yield Hit(f"{location}.{other}", f"expected the key `{key}`")
            matrix = entry.get(key, entry.get(other))
            if isinstance(matrix, list) and len(matrix) == 16:
                yield Hit(f"{location}.{key}", "16 numbers, read column by column; expected 4 rows of 4")


def _spelling_of_model(location: str, entry: Mapping[str, Any]) -> Iterator[Hit]:
    key = "model" if "model" in entry else "distortionModel"
    name = entry.get(key)
    usual = {_plain(known): known for known in CAMERA_MODEL_READINGS}.get(_plain(name) if isinstance(name, str) else "")
    if usual is None:
        return
    if name != usual:
        yield Hit(f"{location}.{key}", f"{name!r}; expected {usual!r}")
    if key != "model":
        yield Hit(f"{location}.{key}", "expected the key `model`")
    coefficients = entry.get("distortionCoefficients")
    given, wanted = _PADDED.get(usual, (-1, -1))
    if isinstance(coefficients, list) and len(coefficients) == given:
        yield Hit(f"{location}.distortionCoefficients", f"{given} numbers; expected {wanted}, padded with 0")


def _unknown_keys(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    listed = [("calibration.json: ", subject.recording.calibration.content, ROOT_KEYS)]
    for name, known in (("cameras", CAMERA_KEYS), ("lidars", LIDAR_KEYS)):
        listed += [(f"{location}.", entry, known) for location, entry in _entries(subject, name)]
    for location, entry, known in listed:
        plain = {_plain(name): name for name in known}
        for key in entry:
            if key not in known:
                near = get_close_matches(_plain(key), plain, n=1)
                meant = f"; is {plain[near[0]]!r} meant?" if near else ""
                yield Hit(f"{location}{key}", f"not used{meant}")


def _times(*keys: str) -> Any:
    def find(subject: Subject) -> Iterator[Hit]:
        for location, entry in _entries(subject, "cameras"):
            for key in keys:
                seconds, (least, most) = entry.get(key), _SECONDS[key]
                if isinstance(seconds, int | float) and not least <= seconds <= most:
                    expected = f"expected at most {most:g} either way" if least < 0 else f"expected 0 to {most:g}"
                    hint = ": probably milliseconds" if seconds > most or least < 0 else ""
                    yield Hit(f"{location}.{key}", f"{seconds:g} s; {expected}{hint}")

    return find


@dataclass(frozen=True, slots=True)
class _Intrinsics:
    """Intrinsics of a calibration where they stand, as the file has them, for images of a size [px]."""

    location: str
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def _intrinsics(subject: Subject) -> Iterator[_Intrinsics]:
    """The intrinsics of the calibration that are complete, each with the image size that it is for."""
    if subject.recording is None:
        return
    sizes = {str(c.id): (c.camera.width, c.camera.height) for c in subject.scene.cameras}
    for index, camera in sorted(subject.recording.calibration.cameras.items()):
        p = camera.parameters
        size = sizes.get(f"camera{index}")
        if p.imageWidth is not None and p.imageHeight is not None and min(p.imageWidth, p.imageHeight) >= 1:
            size = int(p.imageWidth), int(p.imageHeight)
        numbers = (p.focalLengthX, p.focalLengthY, p.principalPointX, p.principalPointY)
        if size is not None and None not in numbers:
            fx, fy, cx, cy = (float("nan") if number is None else float(number) for number in numbers)
            yield _Intrinsics(_in_folder(subject, camera.location), fx, fy, cx, cy, *size)


def _in_folder(subject: Subject, location: str) -> str:
    folder = "" if subject.recording is None else str(subject.recording.folder)
    return location.removeprefix(folder).lstrip("/")


def _focal_lengths(subject: Subject) -> Iterator[Hit]:
    for k in _intrinsics(subject):
        larger, smaller = max(k.fx, k.fy), min(k.fx, k.fy)
        if smaller <= 0:
            problem = f"{k.fx:g}, focalLengthY {k.fy:g}; expected positive numbers"
        elif not SHORTEST * k.width <= larger <= LONGEST * k.width:
            unit = ": probably in millimetres" if larger <= _MILLIMETRES else ""
            unit = ": probably in parts of the image's width" if larger <= _PARTS else unit
            problem = (
                f"{k.fx:g} px for images {k.width} px wide; expected {SHORTEST * k.width:g} to {LONGEST * k.width:g}"
                f"{unit}"
            )
        elif larger > MOST_UNEQUAL * smaller:
            problem = f"{k.fx:g}, focalLengthY {k.fy:g}; expected nearly equal ones, as of square pixels"
        else:
            continue
        yield Hit(f"{k.location}.focalLengthX", problem)


def _principal_points(subject: Subject) -> Iterator[Hit]:
    for k in _intrinsics(subject):
        x, y = (k.width - 1) / 2, (k.height - 1) / 2
        if max(abs(k.cx - x) / k.width, abs(k.cy - y) / k.height) > OFF_CENTRE:
            problem = (
                f"{k.cx:g}, principalPointY {k.cy:g} in images of {k.width}x{k.height}; expected a point near "
                f"{x:g}, {y:g}{_meant(k)}"
            )
            yield Hit(f"{k.location}.principalPointX", problem)


def _meant(k: _Intrinsics) -> str:
    def near(x: float, y: float) -> bool:
        return abs(k.cx - x) <= _NEAR * x and abs(k.cy - y) <= _NEAR * y

    if abs(k.cx) <= 1 and abs(k.cy) <= 1:
        return ": probably in parts of the image"
    if near(k.height / 2, k.width / 2):
        return ": probably x and y are exchanged"
    for times in _HALVES:
        if near(times * k.width / 2, times * k.height / 2):
            return f": probably for images {times:g} times as wide and high"
    return ""


def _mounts(subject: Subject, *, cameras_only: bool = False) -> Iterator[tuple[str, str, RigidTransform]]:
    """Location, name and `sensor_from_imu` of every sensor of the calibration."""
    if subject.recording is None:
        return
    calibration = subject.recording.calibration
    for index, camera in sorted(calibration.cameras.items()):
        if camera.camera_from_imu is not None:
            location = f"{_in_folder(subject, camera.location)}.imuToCamera"
            yield location, f"camera {index}", camera.camera_from_imu
    for index, lidar in sorted(calibration.lidars.items()) if not cameras_only else ():
        if lidar.lidar_from_imu is not None:
            yield f"{_in_folder(subject, lidar.location)}.imuToLidar", f"lidar {index}", lidar.lidar_from_imu


def _far(subject: Subject) -> Iterator[Hit]:
    for location, name, mount in _mounts(subject):
        x, y, z = mount.inverse().translation
        distance = float(np.linalg.norm(mount.translation))
        if distance > FARTHEST:
            hint = ": probably millimetres" if distance > _MOUNTINGS_MILLIMETRES else ""
            problem = f"{name} is {distance:.1f} m from the IMU ({x:.2f}, {y:.2f}, {z:.2f})"
            yield Hit(location, f"{problem}; expected {FARTHEST:g} m at most{hint}")


def _same(subject: Subject) -> Iterator[Hit]:
    for (_, first, a), (location, second, b) in combinations(_mounts(subject, cameras_only=True), 2):
        moved = float(np.abs(a.translation - b.translation).max())
        rotated = float(np.abs(a.rotation - b.rotation).max())
        if moved < _SAME_LOCATION and rotated < _SAME_ROTATION:
            yield Hit(location, f"the same as of {first}; expected one of its own for {second}")


def _inverted(subject: Subject) -> Iterator[Hit]:
    """Cameras that lie on their side, while the inverse of their matrix is upright."""
    for location, name, mount, up in _mounts_with_up(subject):
        (rolled, _), (inverse, steep) = _posture(mount.rotation, up), _posture(mount.rotation.T, up)
        if rolled > _ROLLED_DEG and inverse < _UPRIGHT_DEG and abs(steep) < _ROLLED_DEG:
            problem = (
                f"{name} lies {rolled:.0f}° off upright, by the accelerometer, and its inverse stands upright: "
                "probably inverted or transposed; expected the matrix that takes points of the IMU into the camera"
            )
            yield Hit(location, problem)


def _steep(subject: Subject) -> Iterator[Hit]:
    for location, name, mount, up in _mounts_with_up(subject):
        _, steep = _posture(mount.rotation, up)
        if abs(steep) > _STEEP_DEG:
            way = "up" if steep > 0 else "down"
            yield Hit(location, f"{name} looks {abs(steep):.0f}° {way}, by the accelerometer")


def _posture(camera_from_imu: Float64Array, up_imu: Float64Array) -> tuple[float, float]:
    """Angles of the image's lower side off down, and of the view above level [deg]; `up_imu` (3,) is of length 1."""
    _, down, ahead = np.clip(camera_from_imu @ up_imu * (1.0, -1.0, 1.0), -1.0, 1.0)
    return float(np.degrees(np.arccos(down))), float(np.degrees(np.arcsin(ahead)))


def _mounts_with_up(subject: Subject) -> Iterator[tuple[str, str, RigidTransform, Float64Array]]:
    """Mountings of cameras with the mean direction of the accelerometer, (3,), where it stays the same for long."""
    imu = next((s for s in subject.scene.sensors if isinstance(s, ImuSensor)), None)
    forces = None if imu is None else imu.streams.get("accelerometer")
    if forces is None or forces.values.shape[1] != 3 or len(forces) == 0:
        return
    some = forces.values[:: len(forces) // _SAMPLES + 1]
    some = some[np.isfinite(some).all(axis=1)]
    lengths = np.linalg.norm(some, axis=1)
    mean = some.mean(axis=0) if len(some) else np.zeros(3)
    length = float(np.linalg.norm(mean))
    if lengths.any() and length > 0.8 * float(lengths.mean()):
        for location, name, mount in _mounts(subject, cameras_only=True):
            yield location, name, mount, mean / length


@dataclass(frozen=True, slots=True, eq=False)
class _CameraPair:
    """Two cameras that look the same way: their `cameraInd`, and `first_from_second`."""

    first: int
    second: int
    first_from_second: RigidTransform

    @property
    def baseline(self) -> Float64Array:
        """Where the second camera is, seen from the first, (3,) [m]: x right, y down, z forward."""
        return self.first_from_second.translation

    @property
    def location(self) -> str:
        """Where findings about the pair are reported."""
        return f"calibration.json: cameras[{self.second}].imuToCamera"


def _stereo_pairs(subject: Subject) -> Sequence[_CameraPair]:
    """All pairs by their mountings in the calibration."""
    return subject.table("stereo pairs", _pairs)


def _pairs(subject: Subject) -> list[_CameraPair]:
    if subject.recording is None:
        return []
    cameras = subject.recording.calibration.cameras
    mounted = [(index, c.camera_from_imu) for index, c in sorted(cameras.items()) if c.camera_from_imu is not None]
    pairs = [_CameraPair(first, second, a @ b.inverse()) for (first, a), (second, b) in combinations(mounted, 2)]
    cosines = [np.clip((np.trace(pair.first_from_second.rotation) - 1) / 2, -1.0, 1.0) for pair in pairs]
    return [pair for pair, cosine in zip(pairs, cosines, strict=True) if np.degrees(np.arccos(cosine)) <= _ALIKE_DEG]


def _baselines(subject: Subject) -> Iterator[Hit]:
    for pair in _stereo_pairs(subject):
        length = float(np.linalg.norm(pair.baseline))
        if _SAME_LOCATION <= length < _NARROWEST_BASELINE:
            problem = f"{length * 1e3:.1f} mm apart; expected {_NARROWEST_BASELINE * 1e3:g} mm to {WIDEST_BASELINE:g} m"
        elif length > WIDEST_BASELINE:
            hint = ": probably millimetres" if length > FARTHEST else ""
            problem = f"{length:.2f} m apart; expected {WIDEST_BASELINE:g} m at most{hint}"
        else:
            continue
        yield Hit(pair.location, f"cameras {pair.first} and {pair.second} look the same way from {problem}")


def _left_and_right(subject: Subject) -> Iterator[Hit]:
    for pair in _stereo_pairs(subject):
        x, y, z = pair.baseline
        if -x >= _NARROWEST_BASELINE and -x > max(abs(y), abs(z)):
            problem = (
                f"camera {pair.second} is {-x:.3f} m to the left of camera {pair.first}; usual is the right: "
                "check whether videos or entries are exchanged, or both matrices inverted"
            )
            yield Hit(pair.location, problem)


def _with_rotations(scene: Scene) -> Scene:
    """Let entries of the calibration state the rotations that were taken instead of theirs."""
    return with_each(scene, "sensors", _with_rotation)


def _with_rotation(sensor: Sensor) -> Sensor:
    if not isinstance(sensor, CameraSensor | DepthCameraSensor | LidarSensor) or sensor.mount is None:
        return sensor
    entry = sensor.extras.get("calibration")
    stale = [key for key in _MATRICES if isinstance(entry, Mapping) and _is_off(entry.get(key))]
    if not stale or not isinstance(entry, Mapping):
        return sensor
    repaired = MappingProxyType({**entry, **dict.fromkeys(stale, sensor.mount.inverse().matrix.tolist())})
    return replace(sensor, extras=MappingProxyType({**sensor.extras, "calibration": repaired}))


def _is_off(numbers: object) -> bool:
    """Whether a matrix as JSON has it contains a rotation that is off by more than rounding."""
    try:
        matrix = np.array(numbers, np.float64)
        matrix = matrix.reshape(round(matrix.size**0.5), -1)[:3, :3]
        return nearest_rotation(matrix)[1] > SILENT_ERROR
    except (TypeError, ValueError, CalibrationError):
        return False


@dataclass(slots=True)
class _Views:
    """Some small grey images of each camera by their times [ns], kept until the second camera of a pair comes."""

    images: dict[int, dict[int, Float64Array]] = field(default_factory=dict)
    models: dict[int, Camera] = field(default_factory=dict)


def _views(subject: Subject) -> _Views:
    return subject.table("images of stereo pairs", lambda _: _Views())


def _look(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Keep some images of cameras that are one of a pair; what they show is reported at the end."""
    camera, image, views = frame.sensor, frame.frame, _views(subject)
    if isinstance(camera, CameraSensor) and isinstance(image, CameraImage):
        name = str(camera.id).removeprefix("camera")
        index = int(name) if name.isdigit() else -1
        is_paired = any(index in {pair.first, pair.second} for pair in _stereo_pairs(subject))
        if is_paired and frame.number in frames_spread(len(camera.images), _LOOKED_AT):
            model = camera.camera
            width = min(_WIDTH, model.width)
            views.models[index] = model.resized(width, max(1, round(model.height * width / model.width)))
            small = _grey(image.rgb, views.models[index])
            views.images.setdefault(index, {})[image.timestamp_ns] = small
    return iter(())


def _grey(rgb: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], model: Camera) -> Float64Array:
    """Mean brightness over the pixels of a smaller image, (height, width) float64."""
    rows = np.linspace(0, rgb.shape[0], model.height + 1).astype(int)
    columns = np.linspace(0, rgb.shape[1], model.width + 1).astype(int)
    sums = np.add.reduceat(np.add.reduceat(rgb.mean(axis=2), rows[:-1], axis=0), columns[:-1], axis=1)
    grey: Float64Array = sums / np.outer(np.diff(rows), np.diff(columns))
    return grey


def _wrong_side(subject: Subject) -> Iterator[Hit]:
    views = _views(subject)
    for pair in _stereo_pairs(subject):
        if not pair.baseline.any():
            continue
        first, second = views.images.get(pair.first, {}), views.images.get(pair.second, {})
        right = wrong = 0
        for time in first.keys() & second.keys():
            models = views.models[pair.first], views.models[pair.second]
            there, back = _sides(pair, models, first[time], second[time])
            right, wrong = right + there, wrong + back
        if right + wrong >= _FEWEST_PATCHES and wrong > _MOST_WRONG * (right + wrong):
            problem = (
                f"{wrong} of {right + wrong} patches that show near things shift between the images of cameras "
                f"{pair.first} and {pair.second} against the side on which their mountings put them: probably "
                "videos or entries are exchanged, or the matrices inverted"
            )
            yield Hit(pair.location, problem)


def _sides(
    pair: _CameraPair, models: tuple[Camera, Camera], first: Float64Array, second: Float64Array
) -> tuple[int, int]:
    """How many patches of the first image shift as the mountings state, and how many the other way."""
    height, width = first.shape
    v, u = np.mgrid[0:height, 0:width]
    rays = unproject(models[0], np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    rays = rays / rays[:, 2:]
    second_from_first = pair.first_from_second.inverse()
    rotated = second_from_first.rotate(rays)
    shifts = np.arange(-_WIDEST_SHIFT, _WIDEST_SHIFT + 1)
    every = []  # mean differences over each patch if all of it shifts by so many pixels; NaN beyond the second image
    for shift in shifts.astype(np.float64).tolist():
        away = second_from_first.translation * shift / (models[0].fx * float(np.linalg.norm(pair.baseline)))
        pixels, visible = project(models[1], rotated + away)
        columns = np.clip(np.rint(np.nan_to_num(pixels[:, 0])), 0, second.shape[1] - 1).astype(int)
        rows = np.clip(np.rint(np.nan_to_num(pixels[:, 1])), 0, second.shape[0] - 1).astype(int)
        differences = np.where(visible, np.abs(second[rows, columns] - first.ravel()), np.nan)
        every.append(_patches(differences.reshape(height, width)))
    costs = np.stack(every)
    contrast = np.sqrt(np.maximum(_patches(first * first) - _patches(first) ** 2, 0.0))
    matched = np.isfinite(costs).all(axis=0) & (costs.min(axis=0) < _MATCHED * contrast)
    costs = costs[:, matched & (contrast > _TEXTURE)]
    if costs.shape[1] == 0:
        return 0, 0
    best, least = shifts[costs.argmin(axis=0)], costs.min(axis=0)
    ahead, behind = costs[shifts > 0].min(axis=0), costs[shifts < 0].min(axis=0)
    right = (best >= _CLEAR_SHIFT) & (least < _CLEARLY * behind)
    wrong = (best <= -_CLEAR_SHIFT) & (least < _CLEARLY * ahead)
    return int(right.sum()), int(wrong.sum())


def _patches(values: Float64Array) -> Float64Array:
    """Means over squares of pixels."""
    height, width = (length // _PATCH for length in values.shape)
    cut = values[: height * _PATCH, : width * _PATCH]
    means: Float64Array = cut.reshape(height, _PATCH, width, _PATCH).mean(axis=(1, 3))
    return means


# fmt: off
CALIBRATION_RULES: tuple[Rule, ...] = (
    Rule("calibration-spelling", WARNING,
         "Keys, models and lists of a calibration are spelt as the vendor's software reads them.",
         "Use `imuToCamera` of 4 rows, `model` in small letters with a dash, and 8 numbers for `brown-conrady`.",
         find=_spelling, fix=as_read),
    Rule("calibration-keys-known", HINT, "Every key of a calibration is one of the format.",
         "Check whether it is misspelt; it is kept as it is.", find=_unknown_keys),
    Rule("calibration-shutter", WARNING,
         f"A shutter rolls for {_SECONDS['shutterRollTimeSeconds'][1]:g} s at most, and is open for "
         f"{_SECONDS['exposureTimeSeconds'][1]:g} s at most.", "Write seconds.",
         find=_times("shutterRollTimeSeconds", "exposureTimeSeconds")),
    Rule("calibration-shift", WARNING,
         f"`imuToCameraShiftSeconds` is {_SECONDS['imuToCameraShiftSeconds'][1]:g} s at most.", "Write seconds.",
         find=_times("imuToCameraShiftSeconds")),
    Rule("calibration-focal-length", WARNING,
         f"Focal lengths of a calibration are {SHORTEST:g} to {LONGEST:g} image widths, and differ by less than "
         f"{MOST_UNEQUAL - 1:.0%}.", "Write pixels of the images that imageWidth and imageHeight state.",
         find=_focal_lengths),
    Rule("calibration-principal-point", WARNING,
         f"Principal points of a calibration lie within {OFF_CENTRE:.0%} of the image's size around its centre.",
         "Check whether the camera model was calibrated for another size, or the image cropped without moving the "
         "point.", find=_principal_points),
    Rule("calibration-size", WARNING,
         "Images have the `imageWidth` and `imageHeight` that their camera model is calibrated for.",
         "Write the numbers for the images as they are; `--fix` scales them, which is wrong for cropped images.",
         find=warnings_of_code("camera-model-scaled"), fix=as_read),
    Rule("mounting-rotation", WARNING,
         "Rotations of mountings are orthonormal within 0.001; beyond 0.01 they are refused.",
         "Write rotations with more digits; `--fix` writes the nearest rotation.",
         find=warnings_of_code("rotation-normalised"), fix=_with_rotations),
    Rule("mounting-far", WARNING, f"Cameras and lidars are at most {FARTHEST:g} m from the IMU.",
         "Write metres.", find=_far),
    Rule("mounting-repeated", WARNING, "No two cameras have one `imuToCamera`.", "Write each camera's own.",
         find=_same),
    Rule("mounting-inverted", WARNING,
         "Cameras do not lie on their side where the inverse of their matrix would be upright.",
         "Write the matrix by rows that takes points of the IMU into the camera: x right, y down, z forward.",
         find=_inverted),
    Rule("mounting-steep", HINT, f"Cameras look ahead, not up or down by more than {_STEEP_DEG:g}°.",
         "Check whether the axes are x right, y down, z forward; it is allowed if the camera is mounted so.",
         find=_steep),
    Rule("stereo-baseline", WARNING,
         f"Cameras that look the same way are {_NARROWEST_BASELINE * 1e3:g} mm to {WIDEST_BASELINE:g} m apart.",
         "Write metres, and each camera's own mounting.", find=_baselines),
    Rule("stereo-sides", HINT, "Of two cameras that look the same way, the first is the left one.",
         "Check whether videos, entries or matrices are exchanged; it is allowed if they are not.",
         find=_left_and_right),
    Rule("stereo-images", WARNING,
         "Near things shift between the images of a stereo pair to the side that the mountings show.",
         "Check whether videos or entries of the cameras are exchanged, or their matrices inverted.", look=_look,
         conclude=_wrong_side),
)
# fmt: on


_IMU = (Kind.ACCELEROMETER, Kind.GYROSCOPE)


def _without_imu(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None or subject.recording.alone or next(streams_of_kind(subject, *Kind), None) is None:
        return
    there = {stream.kind for stream in streams_of_kind(subject, *_IMU)}
    lacking = [kind.value for kind in _IMU if kind not in there]
    if lacking:
        yield Hit(subject.recording.data_name, f"no {' and no '.join(lacking)} lines")


def _without_calibration(subject: Subject) -> Iterator[Hit]:
    """A recording without the file; where that leaves cameras out, these are reported instead."""
    if subject.recording is None or subject.recording.alone or subject.recording.calibration.path.exists():
        return
    if not any(fault.code == "cameras-without-calibration" for fault in subject.faults):
        yield Hit(CALIBRATION_FILE, "there is none")


# fmt: off
PRESENCE_RULES: tuple[Rule, ...] = (
    Rule("imu-there", WARNING, "A recording has an accelerometer and a gyroscope.",
         "Record them; software for visual-inertial odometry, the vendor's too, gives nothing without.",
         find=_without_imu),
    Rule("calibration-there", WARNING, "A recording has a `calibration.json`.",
         "Write one, though its list of cameras be empty: the format asks for it.", find=_without_calibration),
    Rule("json-plain", WARNING,
         "Files of JSON begin without a byte order mark, and `data.jsonl` ends without blank lines.",
         "Write them without: other programs stop at them; `--fix` does.",
         find=warnings_of_code("byte-order-mark", "blank-lines-at-end"), fix=as_read),
    Rule("poses-without-orientation", WARNING, "Either all poses of a trajectory have an orientation, or none.",
         "See why some lack it; they are left out of the trajectory, and their lines are kept.",
         find=warnings_of_code("poses-without-orientation")),
)
# fmt: on


def _counted_anew(scene: Scene) -> Scene:
    """Let `frames` lines be numbered from 0."""
    return _with_notes(scene, lambda notes: {**notes, "first": 0})


def _with_all_cameras(scene: Scene) -> Scene:
    """Let lines that lack images report it of every camera."""
    cameras = {
        int(found[1])
        for sensor in scene.sensors
        if isinstance(sensor, CameraSensor | DepthCameraSensor)
        and (found := re.fullmatch(r"camera(\d+)", str(sensor.id)))
    }

    def listed(text: str) -> str:
        line = msgspec.json.decode(text)
        entries = line.get("frames")
        if not isinstance(entries, list):
            return text
        missing = sorted(cameras - {entry["cameraInd"] for entry in entries})
        more = [{"cameraInd": index, "missingBitmap": True} for index in missing]
        return msgspec.json.encode({**line, "frames": [*entries, *more]}).decode()

    return _with_notes(scene, lambda notes: {**notes, "texts": [listed(text) for text in notes.get("texts", [])]})


def _with_notes(scene: Scene, change: Callable[[Mapping[str, Any]], dict[str, Any]]) -> Scene:
    """Change what is kept of `frames` lines; the same scene where that changes nothing."""
    kept = scene.metadata.get("recording")
    notes = kept.get("frame_lines") if isinstance(kept, Mapping) else None
    if not isinstance(kept, Mapping) or not isinstance(notes, Mapping) or change(notes) == notes:
        return scene
    recording = MappingProxyType({**kept, "frame_lines": change(notes)})
    return replace(scene, metadata=MappingProxyType({**scene.metadata, "recording": recording}))


_IN_STEP = 0.002  # images of a stereo pair are taken within this time [s]
_NO_STEP = 0.1  # taken for the time from line to line [s] where the lines show none


def _over_frames(judge: Callable[[FrameColumns], Iterator[Hit]]) -> Find:
    """A rule over the `frames` lines of a recording, in the order of the file, where there are any."""

    def find(subject: Subject) -> Iterator[Hit]:
        frames = None if subject.recording is None else subject.recording.columns.frames
        return judge(frames) if frames is not None and len(frames.numbers) else iter(())

    return find


def _by_time(frames: FrameColumns) -> tuple[Int64Array, Int64Array]:
    """Numbers, and the lines that they stand in, in the order of time."""
    order = time_order(view(frames.seconds))
    return np.asarray(frames.numbers, np.int64)[order], np.asarray(frames.lines, np.int64)[order]


def _at(line: int) -> str:
    return f"data.jsonl: line {line}"


def _begin(frames: FrameColumns) -> Iterator[Hit]:
    numbers, lines = _by_time(frames)
    if numbers.min() != 0:
        row = int(numbers.argmin())
        yield Hit(_at(lines[row]), f"number: the first is {numbers[row]}; expected 0")


def _order(frames: FrameColumns) -> Iterator[Hit]:
    numbers, lines = _by_time(frames)
    for row in np.flatnonzero(np.diff(numbers) <= 0).tolist():
        yield Hit(_at(lines[row + 1]), f"number: {numbers[row + 1]} after {numbers[row]}; expected {numbers[row] + 1}")


def _gaps(frames: FrameColumns) -> Iterator[Hit]:
    numbers, lines = _by_time(frames)
    for row in np.flatnonzero(np.diff(numbers) > 1).tolist():
        before, after = int(numbers[row]), int(numbers[row + 1])
        missing = str(before + 1) if after == before + 2 else f"{before + 1} to {after - 1}"
        yield Hit(_at(lines[row + 1]), f"number: {after} after {before}; {missing} missing", after - before - 1)


def _without_cameras(frames: FrameColumns) -> Iterator[Hit]:
    """Lines that lack a camera which other lines have."""
    if not frames.cameras:
        yield Hit(_at(frames.lines[0]), "frames: no line names a camera; expected one entry each", len(frames.lines))
    for index, camera in sorted(frames.cameras.items()):
        has_it = np.zeros(len(frames.lines), np.bool_)
        has_it[np.asarray(camera.rows, np.int64)] = True
        lacking = np.flatnonzero(~has_it)
        if len(lacking):
            reported = f"frames: cameraInd {index} is missing in {len(lacking)} of {len(frames.lines)} lines"
            yield Hit(_at(frames.lines[int(lacking[0])]), reported, len(lacking))


def _entry_times(frames: FrameColumns) -> Iterator[Hit]:
    line_seconds = view(frames.seconds)
    steps = np.diff(np.sort(line_seconds))
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else _NO_STEP
    for index, camera in sorted(frames.cameras.items()):
        rows = np.asarray(camera.rows, np.int64)
        off = view(camera.seconds) - line_seconds[rows]
        wrong = np.flatnonzero(np.abs(off) > 0.5 * period)
        if len(wrong):
            worst = int(wrong[np.abs(off[wrong]).argmax()])
            reported = (
                f"frames[].time of camera {index} is up to {off[worst]:+.3f} s off its line's time in {len(wrong)} of "
                f"{len(rows)} lines; expected less than half a period of {period:.3f} s"
            )
            yield Hit(_at(frames.lines[rows[worst]]), reported, len(wrong))


def _out_of_step(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    frames = subject.recording.columns.frames
    for pair in _stereo_pairs(subject):
        rows, apart = _apart(frames, pair.first, pair.second)
        wrong = np.flatnonzero(np.abs(apart) > _IN_STEP)
        if len(wrong):
            reported = (
                f"images of cameras {pair.first} and {pair.second}, which look the same way, are "
                f"{np.median(np.abs(apart[wrong])) * 1e3:.1f} ms apart in {len(wrong)} of {len(rows)} lines; "
                f"expected at most {_IN_STEP * 1e3:g} ms"
            )
            yield Hit(_at(frames.lines[rows[wrong[0]]]), reported, len(wrong))


def _apart(frames: FrameColumns, first: int, second: int) -> tuple[Int64Array, Float64Array]:
    """Rows of lines that have both cameras, and how much later the second camera's image is [s]."""
    if first not in frames.cameras or second not in frames.cameras:
        return np.zeros(0, np.int64), np.zeros(0)
    a, b = frames.cameras[first], frames.cameras[second]
    rows, in_a, in_b = np.intersect1d(
        np.asarray(a.rows, np.int64), np.asarray(b.rows, np.int64), assume_unique=True, return_indices=True
    )
    return rows.astype(np.int64), view(b.seconds)[in_b] - view(a.seconds)[in_a]


# fmt: off
FRAME_LINE_RULES: tuple[Rule, ...] = (
    Rule("frame-numbers-begin", HINT, "`number` of the first `frames` line is 0.",
         "Count from 0: what counts from elsewhere takes other images of the video in some programs.",
         find=_over_frames(_begin), fix=_counted_anew),
    Rule("frame-numbers-increasing", WARNING,
         "`number` grows from `frames` line to `frames` line, in the order of their times.",
         "See which image each line means: it is known by its number; `--fix` numbers them by time, and the video "
         "with them.", find=_over_frames(_order), fix=_counted_anew),
    Rule("frame-numbers-gaps", WARNING, "`number` grows by one from `frames` line to `frames` line.",
         "See whether frames were dropped; `--fix` numbers the lines anew and takes images without a line out.",
         find=_over_frames(_gaps), fix=_counted_anew),
    Rule("frames-without-camera", WARNING, "Every `frames` line names every camera.",
         "Add the camera, with `missingBitmap` where it has no image: the vendor's software refuses other lines.",
         find=_over_frames(_without_cameras), fix=_with_all_cameras),
    Rule("frames-missing-bitmap", HINT, "No entry of a `frames` line says `missingBitmap`.",
         "See whether the camera dropped images.", find=warnings_of_code("missing-bitmaps")),
    Rule("frame-entry-times", WARNING, "`frames[].time` lies within half a period of its line's time.",
         "Write the time at which the image was taken, on the clock of the other lines.",
         find=_over_frames(_entry_times)),
    Rule("stereo-in-step", WARNING, f"Cameras that look the same way take their images within {_IN_STEP * 1e3:g} ms.",
         "Trigger both together, or give them lines of their own: a pair is taken for one moment.", find=_out_of_step),
)
# fmt: on

_FAR_M, _NEAR_M = 400.0, 0.5  # half of a sweep's points lie nearer than the first, and farther than the second [m]
_RANGED_SWEEPS = 16
_FEWEST_POINTS = 20


def _doubled(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    lidars = subject.recording.columns.lidars
    counts = Counter(name for lidar in lidars.values() for name in lidar.texts)
    seen: dict[str, int] = {}
    for lidar in lidars.values():
        for name, line in zip(lidar.texts, lidar.lines, strict=True):
            if counts[name] > 1 and name in seen:
                reported = f"lidar.dataFile: {name!r} is that of line {seen[name]}, too; expected one of its own"
                yield Hit(f"data.jsonl: line {line}", reported)
            seen.setdefault(name, line)


def _ranges(subject: Subject) -> dict[str, list[float]]:
    """Median distances of the points of some sweeps of each lidar [m]."""
    return subject.table("median ranges of lidars", lambda _: {})


def _take_range(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Take the median distance of some sweeps; what they show is reported at the end."""
    sweep, lidar = frame.frame, frame.sensor
    if subject.recording is not None and isinstance(lidar, LidarSensor) and isinstance(sweep, LidarFrame):
        found = _ranges(subject).setdefault(frame.sensor_path, [])
        if frame.number in frames_spread(len(lidar.frames), _RANGED_SWEEPS):
            distances = np.linalg.norm(sweep.points.positions.astype(np.float64), axis=1)
            distances = distances[np.isfinite(distances) & (distances > 0)]
            found += [float(np.median(distances))] if len(distances) >= _FEWEST_POINTS else []
    return iter(())


def _absurd(subject: Subject) -> Iterator[Hit]:
    for path, found in _ranges(subject).items():
        middle = float(np.median(found)) if found else 1.0
        if _NEAR_M <= middle <= _FAR_M:
            continue
        meant = "probably millimetres or centimetres" if middle > _FAR_M else "probably kilometres, or noise"
        reported = f"half of the points are farther than {middle:.3g} m; expected {_NEAR_M:g} to {_FAR_M:g}: {meant}"
        yield Hit(f"{path}.frames[].points.positions", reported, len(found))


# fmt: off
LIDAR_LINE_RULES: tuple[Rule, ...] = (
    Rule("lidar-file-repeated", WARNING, "No two `lidar` lines name one file.",
         "Give each sweep its own file; see whether a file was overwritten.", find=_doubled),
    Rule("lidar-range", WARNING, f"The middle distance of a lidar's points is {_NEAR_M:g} to {_FAR_M:g} m.",
         "Write metres.", look=_take_range, conclude=_absurd),
)
# fmt: on


def _config_text(subject: Subject) -> str:
    """The text of the settings; "" where there are none, and for what is no recording."""
    kept = None if subject.recording is None else subject.scene.metadata.get("recording")
    text = kept.get("vio_config") if isinstance(kept, Mapping) else None
    return text if isinstance(text, str) else ""


def _unknown(subject: Subject) -> Iterator[Hit]:
    known = {key.lower(): key for key in KNOWN_KEYS}
    for setting in read_vio_config(_config_text(subject)).settings:
        if setting.key not in KNOWN_KEYS:
            near = get_close_matches(setting.key.lower(), known, n=1, cutoff=0.8)
            meant = f"; is {known[near[0]]!r} meant?" if near else ""
            yield Hit(f"{VIO_CONFIG_FILE}: line {setting.line}", f"{setting.key!r} is not publicly known{meant}")


def _repeated(subject: Subject) -> Iterator[Hit]:
    lines: dict[str, list[str]] = {}
    for setting in read_vio_config(_config_text(subject)).settings:
        lines.setdefault(setting.key, []).append(str(setting.line))
    for key, numbers in sorted(lines.items()):
        if len(numbers) > 1:
            where, reported = f"{VIO_CONFIG_FILE}: line {numbers[1]}", f"{key!r} stands in lines {', '.join(numbers)}"
            yield Hit(where, f"{reported}; expected once")


def _strange(subject: Subject) -> Iterator[Hit]:
    for number, line in read_vio_config(_config_text(subject)).strange.items():
        yield Hit(f"{VIO_CONFIG_FILE}: line {number}", f"{line[:60]!r}; expected a setting, `key: value`")


# fmt: off
CONFIGURATION_RULES: tuple[Rule, ...] = (
    Rule("config-keys-known", WARNING, "Every setting of `vio_config.yaml` has a name that is publicly known.",
         "See whether it is misspelt: the vendor's software stops at settings that it does not know.", find=_unknown),
    Rule("config-keys-unique", WARNING, "No setting of `vio_config.yaml` stands there twice.",
         "Leave one of them out.", find=_repeated),
    Rule("config-lines-settings", WARNING,
         "Every line of `vio_config.yaml` is a setting, `key: value`, or belongs to the one above it.",
         "Write a blank behind the colon, indent what belongs to a setting, or mark the line as a comment with `#`.",
         find=_strange),
)
# fmt: on
"""Rules that read the settings as they are kept."""
