"""Conventions of extrinsics: every reading of the numbers is tried, and the points and images of a drive rank them."""

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames
from sceneloom.calibrate.measures import Agreement, Change, measured_image
from sceneloom.cameras.projection import project
from sceneloom.checks.cuboids import possible_points_frames
from sceneloom.checks.rule import Subject
from sceneloom.errors import DataError, PoseError
from sceneloom.formats.base.files import read_settings
from sceneloom.geometry.euler import AngleUnit, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion, nearest_rotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, Progress, reporting
from sceneloom.warnings import DataWarning

_MOST_FRAMES = 8  # images that each extrinsic is judged by

CAMERA_AXES: Mapping[str, Float64Array] = MappingProxyType(
    {
        "x right, y down, z forward": np.eye(3),
        "x right, y up, z backward": np.diag([1.0, -1.0, -1.0]),
        "x forward, y left, z up": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
        "x forward, y right, z down": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    }
)
"""Axes of the camera frame, and the rotation from them into x right, y down, z forward."""

LIDAR_AXES: Mapping[str, Float64Array] = MappingProxyType(
    {
        "those of the points": np.eye(3),
        "x, y along the points' -y, x": rotation_from_cuboid_angles((0, 0, 90)),
        "x, y along the points' y, -x": rotation_from_cuboid_angles((0, 0, -90)),
        "x, y along the points' -x, -y": rotation_from_cuboid_angles((0, 0, 180)),
    }
)
"""Axes of the lidar frame, and the rotation into them from those that its points have."""

UNITS_NS: Mapping[str, int] = MappingProxyType(
    {"seconds": 1_000_000_000, "milliseconds": 1_000_000, "microseconds": 1_000, "nanoseconds": 1}
)
"""Units of time [ns]."""

_CHOICES = (
    *("layout", "order of parts", "quaternion", "angles", "order of angles"),
    *("direction", "camera axes", "lidar axes"),
)
_AS_READ = {
    "layout": "rows",
    "direction": "camera from lidar",
    "camera axes": "x right, y down, z forward",
    "lidar axes": "those of the points",
}
_SHAPES = {16: (4, 4), 12: (3, 4), 9: (3, 3)}
_COUNTS = frozenset({6, 7, *_SHAPES})
_TOLERANCE = 1e-2  # how far rounded numbers of a rotation or a quaternion may be from one

_SAME_ROTATION, _SAME_TRANSLATION = np.radians(0.2), 0.02  # transforms within this [rad], [m] cannot be told apart

_RATES_HZ = {
    "lidar": (1.0, 100.0),
    "camera": (0.5, 500.0),
    "radar": (1.0, 200.0),
    "imu": (10.0, 8000.0),
    "gnss": (0.1, 100.0),
}
_YEARS_S = (315_532_800.0, 4_102_444_800.0)  # from 1980, when GPS time begins, to 2100, in seconds after 1970
_LEAST_EPOCH_S = 1e8  # larger numbers of seconds than this count from an epoch: no drive lasts three years

_MOST_APART, _UPRIGHT_DEG, _LEAST_SHARE = 10.0, 50.0, 0.005
"""A camera is at most so far from the lidar [m] and from upright [deg], and sees at least this share of the points."""
_NEAR, _MOST_POINTS, _LEAST_POINTS = 40.0, 20_000, 200
_CLEAR, _LEAD = 2.0, 1.2
"""Standard deviations of a clear agreement, which chance does not reach, and by which it leads all others."""
_AXIS_ROTATIONS, _NEAREST_DEG, _FARTHEST_DEG, _SEED = 24, 2.5, 7.0, 7
_TRANSLATIONS = ("translation", "position", "t", "T", "trans", "xyz")
_ROTATIONS = ("rotation", "heading", "quaternion", "orientation", "R", "r", "q", "rpy", "rot")
_MOST_FOUND = 1_000
_BLANKS = str.maketrans(",[]", "   ")
Score = Callable[[Float64Array], float]
"""How clearly points fit the images under a (4, 4) `camera_from_points`, in standard deviations."""


@dataclass(frozen=True, slots=True)
class Extrinsic:
    """Numbers that can be an extrinsic.

    Attributes:
        location: in the file, by its keys.
        numbers: 6, 7, 9, 12 or 16.
        known: choices that names in the file settle.
        apart: nine numbers of a rotation matrix, then three of a translation that stood beside it.
    """

    location: str
    numbers: tuple[float, ...]
    known: Mapping[str, str] = field(default_factory=dict)
    apart: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One reading of an extrinsic: its value of each open choice, and (4, 4) from the points into the camera."""

    choices: Mapping[str, str]
    camera_from_points: Float64Array


class ExtrinsicFound(msgspec.Struct, frozen=True, kw_only=True):
    """The convention of one extrinsic.

    Attributes:
        location: in its file, or which sensors it relates.
        camera, lidar: sensors of the drive that it was judged by; None without a drive.
        possible: possible values of each choice that the extrinsic leaves open: direction, layout, order, unit, axes.
        decided: whether the transform is known.
        as_read: whether it is what the drive was read with; None where that is not known, or it is not the drive's own.
        camera_from_lidar: (4, 4) by rows, from the points' frame into x right, y down, z forward; None: not decided.
        reason: why it was decided so, or why not.
    """

    location: str
    camera: str | int | None = None
    lidar: str | int | None = None
    possible: dict[str, tuple[str, ...]] = {}
    decided: bool = False
    as_read: bool | None = None
    camera_from_lidar: list[list[float]] | None = None
    reason: str


class PointsFound(msgspec.Struct, frozen=True, kw_only=True):
    """The frames that the points of a lidar can be in; none where nothing shows it."""

    lidar: str | int
    stated: str
    possible: tuple[str, ...]


class TimesFound(msgspec.Struct, frozen=True, kw_only=True):
    """The units in which the timestamps of a sensor, read as seconds, give a plausible rate."""

    sensor: str | int
    kind: str
    possible: tuple[str, ...]


class ConventionsReport(msgspec.Struct, frozen=True, kw_only=True):
    """The conventions of a calibration file or a drive.

    Attributes:
        source: the file or drive.
        extrinsics: the convention of each.
        points: the frames of the points, of a drive.
        times: the units of the timestamps, of a drive.
        corrections: warnings about the corrections that the drive contains.
    """

    source: str
    extrinsics: tuple[ExtrinsicFound, ...]
    points: tuple[PointsFound, ...] = ()
    times: tuple[TimesFound, ...] = ()
    corrections: tuple[DataWarning, ...] = ()

    @property
    def wrong(self) -> bool:
        """Whether something of the drive is not what it was read as."""
        return (
            any(found.as_read is False for found in self.extrinsics)
            or any(found.possible and found.stated not in found.possible for found in self.points)
            or any(found.possible and "seconds" not in found.possible for found in self.times)
        )


def check_file(
    path: Path,
    scene: Scene | None = None,
    *,
    camera_id: Identifier | None = None,
    lidar_id: Identifier | None = None,
    progress: Progress | None = None,
) -> ConventionsReport:
    """Find the conventions of the extrinsics in a file.

    Args:
        path: any JSON, TOML or text file with extrinsics of a camera and a lidar.
        scene: a drive with these sensors; without one, only implausible readings are ruled out.
        camera_id, lidar_id: the sensors that the file relates; None for the scene's first ones.
        progress: called after each extrinsic.

    Raises:
        DataError: the file has no extrinsic, or the drive cannot be read.
        OptionError: the scene has no such sensor.
        PoseError: the scene's points cannot be brought to the time of its images.
    """
    extrinsics = read_extrinsics(path)
    scene = None if scene is None else scene.corrected()
    frames = () if scene is None else calibration_frames(scene, camera_id, lidar_id, _MOST_FRAMES)
    score = score_by_rotation(frames) if frames else None
    found = tuple(decide(one, frames, score) for one in reporting(extrinsics, progress, len(extrinsics)))
    corrections = () if scene is None else scene.correction_warnings
    return ConventionsReport(source=str(path), extrinsics=found, corrections=corrections)


def check_drive(scene: Scene, *, progress: Progress | None = None) -> ConventionsReport:
    """Check whether extrinsics, frames of points and timestamps of a drive are what it was read with.

    Raises:
        DataError: an image or a sweep cannot be read.
    """
    scene = scene.corrected()
    lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
    pairs = [(camera, lidar) for lidar in lidars[:1] for camera in scene.cameras if len(camera.images)]
    found = [_judged_pair(scene, *pair) for pair in reporting(pairs, progress, len(pairs))]
    points = []
    for lidar in lidars:
        possible = tuple(frame.value for frame in possible_points_frames(Subject(scene), lidar))
        points.append(PointsFound(lidar=lidar.id, stated=lidar.points_frame.value, possible=possible))
    times = []
    for sensor in scene.sensors:
        timestamps = _timestamps(sensor)
        if len(timestamps) > 1:
            units = time_units((timestamps * 1e-9).tolist(), str(sensor.type))
            times.append(TimesFound(sensor=sensor.id, kind=str(sensor.type), possible=units))
    return ConventionsReport(
        source=scene.source,
        extrinsics=tuple(found),
        points=tuple(points),
        times=tuple(times),
        corrections=scene.correction_warnings,
    )


def _judged_pair(scene: Scene, camera: CameraSensor, lidar: LidarSensor) -> ExtrinsicFound:
    """Judge the extrinsic by which the drive relates a camera and a lidar."""
    location = f"camera {camera.id}, lidar {lidar.id}"
    try:
        frames = calibration_frames(scene, camera.id, lidar.id, _MOST_FRAMES)
    except PoseError as error:
        return ExtrinsicFound(location=location, camera=camera.id, lidar=lidar.id, reason=str(error))
    numbers = tuple(frames[0].camera_from_lidar.matrix.reshape(-1).tolist())
    found = decide(Extrinsic(location, numbers), frames, score_by_rotation(frames))
    if not found.possible:
        return found
    right = all(_AS_READ[name] in values for name, values in found.possible.items())
    return msgspec.structs.replace(found, as_read=(found.decided or None) if right else False)


def _timestamps(sensor: Sensor) -> Int64Array:
    """When a sensor measured, (N,) int64 [ns]; of an IMU its stream of the most samples."""
    none = np.zeros(0, np.int64)
    match sensor:
        case CameraSensor():
            return sensor.images.timestamps_ns
        case LidarSensor() | RadarSensor():
            return sensor.frames.timestamps_ns
        case GnssSensor():
            return sensor.timestamps_ns
        case ImuSensor():
            return max((stream.timestamps_ns for stream in sensor.streams.values()), key=len, default=none)
    return none


def time_units(timestamps: Sequence[float], kind: str) -> tuple[str, ...]:
    """List the units in which timestamps of a sensor give a plausible rate and date.

    Args:
        timestamps: of successive measurements, in any order, in an unknown unit.
        kind: lidar, camera, radar, imu or gnss.

    Returns:
        Names out of `UNITS_NS`; none where no unit fits, or fewer than two timestamps differ.
    """
    times = np.unique(np.asarray(timestamps, np.float64))
    times = times[np.isfinite(times)]
    if len(times) < 2:
        return ()
    step, first = float(np.median(np.diff(times))), float(times[0])
    slowest, fastest = _RATES_HZ[kind]
    fitting = []
    for unit, unit_ns in UNITS_NS.items():
        seconds = first * unit_ns * 1e-9
        is_date = abs(seconds) < _LEAST_EPOCH_S or _YEARS_S[0] <= seconds <= _YEARS_S[1]
        if is_date and slowest <= 1e9 / (step * unit_ns) <= fastest:
            fitting.append(unit)
    return tuple(fitting)


def decide(extrinsic: Extrinsic, frames: Sequence[CalibrationFrame] = (), score: Score | None = None) -> ExtrinsicFound:
    """Find the convention of an extrinsic.

    Implausible readings are ruled out first: a camera far from the lidar, or not upright, or one that sees nothing of
    what the lidar sees. Of the rest those remain whose score is not clearly below the best.

    Args:
        extrinsic: the numbers.
        frames: of the drive whose camera and lidar it relates; none without a drive.
        score: of these frames; None to judge by plausibility alone.
    """
    up = _find_up(frames) if frames else np.array([0.0, 0.0, 1.0])
    left = [
        group
        for group in groups(hypotheses(extrinsic.numbers, extrinsic.known, apart=extrinsic.apart))
        if _is_plausible(group[0].camera_from_points, up, frames)
    ]
    count = len(left)
    if not left:
        reason = "no reading puts an upright camera where it sees what the lidar sees"
    elif count == 1:
        reason = "all other readings put the camera on its side, upside down, too far away, or where it sees nothing"
    elif score is None:
        reason = "several readings put an upright camera near the lidar, and there is no drive to distinguish them"
    else:
        scores = [score(group[0].camera_from_points) for group in left]
        best = max(scores)
        if best < _CLEAR:
            reason = f"none of {count} possible readings matches points and images clearly"
        else:
            left = [group for group, own in zip(left, scores, strict=True) if own > best - _LEAD]
            reason = f"{len(left)} of {count} possible readings match points and images about equally"
            if len(left) == 1:
                reason = f"of {count} possible readings it alone matches points and images ({best:.1f} sigma)"
    possible: dict[str, tuple[str, ...]] = {}
    for name in _CHOICES:
        values = dict.fromkeys(one.choices[name] for group in left for one in group if name in one.choices)
        if values:
            possible[name] = tuple(values)
    return ExtrinsicFound(
        location=extrinsic.location,
        camera=frames[0].camera_id if frames else None,
        lidar=frames[0].lidar_id if frames else None,
        possible=possible,
        decided=len(left) == 1,
        camera_from_lidar=left[0][0].camera_from_points.tolist() if len(left) == 1 else None,
        reason=reason,
    )


def hypotheses(
    numbers: Sequence[float] | Float64Array, known: Mapping[str, str] | None = None, *, apart: bool = False
) -> tuple[Hypothesis, ...]:
    """List all readings of the 6, 7, 9, 12 or 16 numbers of an extrinsic; `known` and `apart` as of `Extrinsic`."""
    given = np.asarray(numbers, np.float64)
    found = []
    for written, matrix, translation in _readings(given, apart=apart) if np.isfinite(given).all() else ():
        rotation, error = nearest_rotation(matrix)
        if error > _TOLERANCE:
            continue
        stated = RigidTransform(rotation, translation.copy())
        directions = {"camera from lidar": stated.matrix, "lidar from camera": stated.inverse().matrix}
        for direction, camera_axes, lidar_axes in product(directions, CAMERA_AXES, LIDAR_AXES):
            own = {**written, "direction": direction, "camera axes": camera_axes, "lidar axes": lidar_axes}
            if any(own.get(name, value) != value for name, value in (known or {}).items()):
                continue
            left, right = np.eye(4), np.eye(4)
            left[:3, :3], right[:3, :3] = CAMERA_AXES[camera_axes], LIDAR_AXES[lidar_axes]
            found.append(Hypothesis(own, left @ directions[direction] @ right))
    return tuple(found)


def _readings(numbers: Float64Array, *, apart: bool) -> Iterator[tuple[dict[str, str], Float64Array, Float64Array]]:
    """Read numbers as matrices, quaternions or angles: the choices, (3, 3) of about a rotation, and (3,)."""
    if numbers.size in _SHAPES:
        rows, columns = (3, 3) if apart else _SHAPES[numbers.size]
        table = numbers[: rows * columns]
        for layout, matrix in (("rows", table.reshape(rows, columns)), ("columns", table.reshape(columns, rows).T)):
            beside = numbers[9:] if apart else matrix[:3, 3] if columns == 4 else np.zeros(3)
            if rows == 3 or np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() <= 1e-6:
                yield {"layout": layout}, matrix[:3, :3], beside
        return
    if numbers.size not in _COUNTS:
        return
    for parts, translation, rotation in (
        ("translation first", numbers[:3], numbers[3:]),
        ("rotation first", numbers[-3:], numbers[:-3]),
    ):
        own = {"order of parts": parts}
        norm = float(np.linalg.norm(rotation))
        if len(rotation) == 4 and abs(norm - 1.0) <= _TOLERANCE:
            for order, xyzw in (("x y z w", rotation), ("w x y z", np.roll(rotation, -1))):
                yield {**own, "quaternion": order}, matrix_from_quaternion(xyzw / norm), translation
        if len(rotation) == 3:
            for unit, (name, order) in product(AngleUnit, (("Rz Ry Rx", "zyx"), ("Rx Ry Rz", "xyz"))):
                if np.abs(rotation).max() <= (360.0 if unit is AngleUnit.DEGREES else 2 * np.pi + 1e-6):
                    matrix = rotation_from_cuboid_angles(rotation, unit=unit, order=order)
                    yield {**own, "angles": unit.value, "order of angles": name}, matrix, translation


def groups(found: Sequence[Hypothesis]) -> list[list[Hypothesis]]:
    """Group hypotheses of the same transform."""
    result: list[list[Hypothesis]] = []
    for one in found:
        for group in result:
            if _are_same(one.camera_from_points, group[0].camera_from_points):
                group.append(one)
                break
        else:
            result.append([one])
    return result


def _are_same(a: Float64Array, b: Float64Array) -> bool:
    between = a[:3, :3].T @ b[:3, :3]
    # for small angles the sine is exact, while the cosine has lost its digits
    sine = np.linalg.norm(between - between.T) / np.sqrt(8.0)
    near = sine <= np.sin(_SAME_ROTATION) and np.trace(between) > 1.0
    return bool(near and np.linalg.norm(a[:3, 3] - b[:3, 3]) <= _SAME_TRANSLATION)


def _is_plausible(
    camera_from_points: Float64Array, up: Float64Array | None, frames: Sequence[CalibrationFrame]
) -> bool:
    """Whether the camera is near the lidar and upright, and sees enough of what the lidar sees."""
    if np.linalg.norm(camera_from_points[:3, 3]) >= _MOST_APART:
        return False
    if up is not None and -(camera_from_points[1, :3] @ up) <= np.cos(np.radians(_UPRIGHT_DEG)):
        return False
    shares = []
    for frame in frames:
        some = frame.points_lidar[:: len(frame.points_lidar) // _MOST_POINTS + 1]
        placed = some @ camera_from_points[:3, :3].T + camera_from_points[:3, 3]
        shares.append(float(project(frame.camera, placed)[1].mean()) if len(some) else 0.0)
    return not shares or float(np.mean(shares)) >= _LEAST_SHARE


def _find_up(frames: Sequence[CalibrationFrame]) -> Float64Array | None:
    """Which axis of the points' frame is up, (3,); None where it is not clear."""
    # a sweep spreads along the ground, so it is thinnest along the vertical, and its heights trail off upwards
    votes = np.zeros(6)
    for frame in frames:
        near = frame.points_lidar[np.linalg.norm(frame.points_lidar, axis=1) < _NEAR]
        if len(near) < _LEAST_POINTS:
            continue
        some = near[:: len(near) // _MOST_POINTS + 1]
        low, middle, high = np.quantile(some, [0.02, 0.5, 0.98], axis=0)
        axis = int(np.argmin(high - low))
        votes[2 * axis + (high[axis] - middle[axis] < middle[axis] - low[axis])] += 1
    if votes.sum() == 0 or votes.max() < 0.75 * votes.sum():
        return None
    axis, downward = divmod(int(np.argmax(votes)), 2)
    return np.asarray(np.eye(3)[axis] * (-1.0 if downward else 1.0))


def score_by_rotation(frames: Sequence[CalibrationFrame]) -> Score:
    """Give the function that scores candidates for `camera_from_points`.

    The score is by how many standard deviations all frames together agree better with the candidate than with the
    same one rotated by 2.5 to 7 degrees, in the mean over the measures; about 0 for a wrong candidate. The worth of an
    edge score differs from scene to scene, so a candidate is compared with itself.
    """
    generator = np.random.default_rng(_SEED)
    axes = generator.normal(size=(_AXIS_ROTATIONS, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    angles = np.radians(np.linspace(_NEAREST_DEG, _FARTHEST_DEG, _AXIS_ROTATIONS))
    rotations = [Change.rotation(rotation) for rotation in axes * angles[:, None]]
    images = [measured_image(frame.grey, frame.camera) for frame in frames]
    known: dict[bytes, float] = {}

    def score(camera_from_points: Float64Array) -> float:
        key = np.round(camera_from_points, 6).tobytes()
        if key not in known:
            candidate, _ = RigidTransform.nearest(camera_from_points)
            changed = [replace(frame, camera_from_lidar=candidate) for frame in frames]
            agreement = Agreement(changed, images=images)
            stated = agreement.score(Change()).values()
            rotated = np.stack([agreement.score(rotation).values() for rotation in rotations])
            rows = [k for k in range(len(stated)) if np.isfinite(rotated[:, k]).sum() > _AXIS_ROTATIONS // 2]
            clear = [(stated[k] - np.nanmean(rotated[:, k])) / np.nanstd(rotated[:, k]) for k in rows]
            known[key] = float(np.mean([value for value in clear if np.isfinite(value)] or [0.0]))
        return known[key]

    return score


def read_extrinsics(path: Path) -> tuple[Extrinsic, ...]:
    """Find all numbers of a file that can be an extrinsic.

    Raises:
        DataError: the file cannot be read, or contains none.
    """
    try:
        text = read_settings(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(str(path), "", f"{error}; expected a text with an extrinsic in it") from error
    found: list[Extrinsic] = []
    try:
        for extrinsic in _walk(_parsed(text), ""):
            if hypotheses(extrinsic.numbers, extrinsic.known, apart=extrinsic.apart):
                found.append(extrinsic)
            if len(found) == _MOST_FOUND:
                break
    except OverflowError as error:  # whole numbers may have any length
        raise DataError(str(path), "", f"{error}; expected the numbers of an extrinsic") from error
    if not found:
        raise DataError(
            str(path), "", "no extrinsic in it; expected 16, 12 or 9 numbers of a matrix, 7 of a translation and a "
            "quaternion, or 6 of a translation and angles",
        )  # fmt: skip
    return tuple(found)


def _parsed(text: str) -> Any:
    """Parse JSON, TOML, or lines of names and numbers; lines without a name continue the one before."""
    with suppress(msgspec.DecodeError, RecursionError):
        return msgspec.json.decode(text.encode())
    with suppress(ValueError, RecursionError):
        return tomllib.loads(text)
    named: dict[str, list[float]] = {}
    name = ""
    for line in text.splitlines():
        head, separator, tail = line.partition(":")
        words = (tail if separator else line).translate(_BLANKS).split()
        if separator:
            name = head.strip()
        elif words:
            try:
                float(words[0])
            except ValueError:
                name, *words = words
        with suppress(ValueError):
            named.setdefault(name, []).extend([float(word) for word in words])
    return named


def _walk(value: Any, location: str) -> Iterator[Extrinsic]:
    numbers = _numbers(value)
    if numbers is not None:
        if len(numbers) in _COUNTS:
            yield Extrinsic(location or "the file", numbers)
    elif isinstance(value, dict):
        parts = _parts(value, location or "the file")
        if parts is not None:
            yield parts
        for key, inner in value.items():
            if parts is None or key not in (*_TRANSLATIONS, *_ROTATIONS):
                yield from _walk(inner, f"{location}.{key}" if location else str(key))
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from _walk(inner, f"{location}[{number}]")


def _numbers(value: Any) -> tuple[float, ...] | None:
    """Flatten a list of numbers, or of lists of them; None for anything else."""
    if not isinstance(value, list) or not value:
        return None
    flat = [number for row in value for number in row] if all(isinstance(row, list) for row in value) else value
    return tuple(map(float, flat)) if all(type(number) in {int, float} for number in flat) else None


def _parts(value: dict[str, Any], location: str) -> Extrinsic | None:
    """Join a translation and a rotation that stand side by side; None where there are none."""
    first = {"order of parts": "translation first"}
    for letter in ("", "p", "t"):
        flat = _vector(value, (*(f"{letter}{axis}" for axis in "xyz"), "qx", "qy", "qz", "qw"))
        if flat is not None:
            return Extrinsic(location, flat, {**first, "quaternion": "x y z w"})
    translation = next((_vector(value[name], tuple("xyz")) for name in _TRANSLATIONS if name in value), None)
    rotation = next((value[name] for name in _ROTATIONS if name in value), None)
    if translation is None or rotation is None:
        return None
    quaternion = _vector(rotation, tuple("xyzw")) if isinstance(rotation, dict) else None
    if quaternion is not None:
        return Extrinsic(location, (*translation, *quaternion), {**first, "quaternion": "x y z w"})
    numbers = _numbers(rotation)
    if numbers is None or len(numbers) not in {3, 4, 9}:
        return None
    if len(numbers) == 9:
        return Extrinsic(location, (*numbers, *translation), apart=True)
    return Extrinsic(location, (*translation, *numbers), first)


def _vector(value: Any, names: tuple[str, ...]) -> tuple[float, ...] | None:
    """Numbers by their names, or in the order of a list of as many."""
    numbers = _numbers([value.get(name) for name in names] if isinstance(value, dict) else value)
    return numbers if numbers is not None and len(numbers) == len(names) else None
