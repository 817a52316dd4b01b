"""Write a drive of KITTI's raw data, synchronised (`sync`) or each sensor by itself (`extract`)."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError, SceneloomError
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.poses import mounting
from sceneloom.formats.base.written_ego import ego_trajectory, egos_at
from sceneloom.formats.kitti.calibration import CAMERAS, SPARE_CAMERA, Mounted
from sceneloom.formats.kitti.frames_writer import (
    NONE,
    PARALLEL_WITHIN,
    Choice,
    Timeline,
    kept_of,
    nearest_frames,
    report_unwritten,
    write_image,
)
from sceneloom.formats.kitti.oxts import IMU_ID, oxts_lines
from sceneloom.formats.kitti.raw_reader import (
    CAM_TO_CAM,
    FURTHER_FIELDS,
    IMU_TO_VELO,
    ORDER,
    POSE_FIELDS,
    STATES,
    VELO_TO_CAM,
    Tracklet,
    read_raw_calibration,
)
from sceneloom.formats.kitti.raw_reader import FILE as TRACKLETS
from sceneloom.formats.kitti.sensors import times_in_rotation
from sceneloom.formats.kitti.spec import RAW_CAMERAS
from sceneloom.formats.kitti.text import write_lines
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation
from sceneloom.geometry.rigid import RigidTransform, angle_between, matrix_from_quaternion
from sceneloom.scene.annotations import CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, activated, active_at, attribute_at, cuboid_poses
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier


def _write_raw_calibration(folder: Path, mounted: Mounted, kept: Mapping[str, Any] | None, *, rectified: bool) -> None:
    """Write the files of a day: those that the scene was read with (`kept`) where these still hold, else new ones."""
    if kept and all(isinstance(texts, Mapping) for texts in kept.values()):
        for name, texts in kept.items():
            if name in (CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO):
                write_lines(folder / name, (f"{key}: {text}" for key, text in texts.items()))
        if _says(folder, mounted, rectified=rectified):
            return
        for name in (CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO):
            (folder / name).unlink(missing_ok=True)
    for name, entries in _built(mounted, rectified=rectified).items():
        write_lines(folder / name, (f"{key}: {text}" for key, text in entries.items()))


def _says(folder: Path, mounted: Mounted, *, rectified: bool) -> bool:
    """Whether the files of a folder state what the scene says."""
    try:
        read = read_raw_calibration(folder, tuple(mounted.camera_models), rectified=rectified)
    except SceneloomError:
        return False
    if any(read.camera_models[number] != camera_model for number, camera_model in mounted.camera_models.items()):
        return False
    return mounted.files_lidar_from_lidar(read.camera_from_lidar, read.lidar_from_imu) is not None


def _built(mounted: Mounted, *, rectified: bool) -> dict[str, dict[str, str]]:
    """Entries of the files: the reference camera stands for camera 0, unless there is one."""
    base = mounted.camera_from_lidar.get(0, mounted.rectified_from_lidar)
    reference = mounted.camera_models.get(mounted.reference or 0, SPARE_CAMERA)
    between: dict[str, str] = {"calib_time": "01-Jan-1970 00:00:00", "corner_dist": "0.0"}
    for number in range(CAMERAS):
        camera_model = mounted.camera_models.get(number, reference)
        placed = RigidTransform.identity()
        if number in mounted.camera_from_lidar and mounted.camera_from_lidar[number] is not base:
            placed = mounted.camera_from_lidar[number] @ base.inverse()
        between |= _camera_entries(number, camera_model, placed, rectified=rectified)
    files = {CAM_TO_CAM: between, VELO_TO_CAM: {**_rigid(base), "delta_f": "0 0", "delta_c": "0 0"}}
    if mounted.lidar_from_imu is not None:
        files[IMU_TO_VELO] = _rigid(mounted.lidar_from_imu)
    return files


def _camera_entries(
    number: int, camera_model: Camera, camera_from_first: RigidTransform, *, rectified: bool
) -> dict[str, str]:
    """Entries before and after rectification: the same if rectified, else a rotation to the first camera's axes."""
    rotation = np.eye(3) if rectified else camera_from_first.rotation.T
    shift = rotation @ camera_from_first.translation
    projection = np.column_stack([camera_model.matrix, camera_model.matrix @ shift])
    distortion = [*camera_model.coefficients[:5], *(0.0,) * (5 - len(camera_model.coefficients[:5]))]
    entries: dict[str, Any] = {
        "S": (float(camera_model.width), float(camera_model.height)),
        "K": camera_model.matrix,
        "D": distortion,
        "R": camera_from_first.rotation,
        "T": camera_from_first.translation,
        "S_rect": (float(camera_model.width), float(camera_model.height)),
        "R_rect": rotation,
        "P_rect": projection,
    }
    return {f"{name}_{number:02d}": _numbers(values) for name, values in entries.items()}


def _rigid(transform: RigidTransform) -> dict[str, str]:
    return {"R": _numbers(transform.rotation), "T": _numbers(transform.translation)}


def _numbers(values: Any) -> str:
    flat: Float64Array = np.asarray(values, np.float64).reshape(-1)
    return " ".join(map(repr, flat.tolist()))


_WELL_REPORTED = 0.05
"""Largest error of point times from directions, as a share of a rotation; beyond it they are not written."""

_NAMES = ("timestamps_start.txt", "timestamps.txt", "timestamps_end.txt")


@dataclass(slots=True)
class _RotationWriter:
    """Writes sweeps into `velodyne_points` and remembers their times."""

    choice: Choice
    folder: Path
    _rotations: list[tuple[int, int, int] | None] = field(default_factory=list)
    _starts: list[int] = field(default_factory=list)
    _rotated: bool = True
    _worst_ns: int = 0
    _timed_points: int = 0

    def __post_init__(self) -> None:
        (self.folder / "data").mkdir(parents=True)

    def write(self, frame: LidarFrame, number: int) -> None:
        """Write a sweep; frames without one have blank lines."""
        self._rotations += [None] * (number - len(self._rotations))
        frame = self.choice.finite(frame)
        positions = self.choice.write_sweep(frame, self.folder / "data" / f"{number:010d}.bin")
        self._rotations.append(self._rotation(frame, positions))
        self._starts.append(frame.timestamp_ns)

    def _rotation(self, frame: LidarFrame, positions: Float32Array) -> tuple[int, int, int]:
        """When a sweep began, looked ahead and ended [ns]; of points without times all are its own time."""
        times = frame.points.timestamps_ns
        start = frame.timestamp_ns
        forward, end = frame.extras.get("forward_ns"), frame.extras.get("end_ns")
        if times is None or not len(times) or times.min() == times.max():
            if isinstance(forward, int) and isinstance(end, int):
                return start, forward, end
            self._rotated = False
            return start, start, start
        if not (isinstance(forward, int) and isinstance(end, int) and start <= forward <= end):
            start = min(start, int(times.min()))
            forward, end = frame.reference_ns, max(int(times.max()), frame.reference_ns)
        error = int(np.abs(times_in_rotation(positions, start, forward, end) - times).max())
        self._rotated = self._rotated and error <= _WELL_REPORTED * max(end - start, 1)
        self._worst_ns = max(self._worst_ns, error)
        self._timed_points += len(times)
        return start, forward, end

    def moments_ns(self, frames_ns: Int64Array) -> Int64Array:
        """Times of frames as `timestamps.txt` reports them, (F,) int64 [ns]; of those without a sweep as given."""
        reported = frames_ns.copy()
        for number, rotation in enumerate(self._rotations):
            if rotation is not None:
                reported[number] = rotation[1]
        return reported

    def close(self) -> None:
        """Write the times; starts and ends only where they report those of points."""
        for column, name in enumerate(_NAMES):
            if self._rotated or name == "timestamps.txt":
                times = (
                    "" if rotation is None else _format_timestamp(rotation[column]) for rotation in self._rotations
                )
                write_lines(self.folder / name, times)
        losses, field = self.choice.losses, "sensors.lidar.frames.points.timestamps_ns"
        if not self._rotated:
            what = "left out: points have other times than by one counter-clockwise rotation from behind"
            losses.dropped(field, what, count=self._timed_points)
        elif self._worst_ns:
            what = "reported by the directions of points in one rotation, counter-clockwise from behind [s]"
            losses.approximated(field, what, count=self._timed_points, error=self._worst_ns / 1e9)
        column = 0 if self._rotated else 1
        reported = [rotation[column] for rotation in self._rotations if rotation is not None]
        away = [abs(a - b) for a, b in zip(reported, self._starts, strict=True)]
        what, worst = "the moment of the sweep in place of its start [s]", max(away, default=0) / 1e9
        losses.approximated("sensors.lidar.frames.timestamp_ns", what, count=sum(map(bool, away)), error=worst)


_LABELLED = 2.0  # the state of a pose that was labelled. Source: the development kit's tracklets.h


def _tracklets_of(choice: Choice, timestamps_ns: Int64Array, starts_ns: Int64Array) -> list[Tracklet]:
    """A tracklet for each run of frames that a cuboid is in; `starts_ns`: when sweeps of the frames began."""
    angles, losses = CuboidAngles.of(choice.scene), choice.losses
    lidar_id = None if choice.lidar is None else choice.lidar.id
    found: list[Tracklet] = []
    boxes = [a for a in choice.scene.annotations if isinstance(a, CuboidAnnotation)]
    for annotation in boxes:
        frames, times = _frames(annotation, timestamps_ns)
        active = active_at(annotation, lidar_id, timestamps_ns[frames], since_ns=starts_ns[frames])
        what = "left out in frames in which it is not active for the lidar"
        losses.dropped("annotations.cuboid.path.values", what, count=int((~active).sum()))
        frames, times = frames[active], times[active]
        cuts = np.flatnonzero(np.diff(frames) > 1) + 1
        runs = list(zip(np.split(frames, cuts), np.split(times, cuts), strict=True)) if len(frames) else []
        if not runs:
            losses.dropped("annotations.cuboid", "left out: in no frame")
        if len(runs) > 1:
            what = "cut where it is in no frame: a tracklet is in all frames between its first and last"
            losses.approximated("annotations.cuboid.id", what)
        if str(annotation.id) != str(len(found)) and runs:
            losses.dropped("annotations.cuboid.id", "tracklets have no ids; read back, they are counted")
        report_unwritten(annotation, STATES, "left out: a tracklet has no field for it", losses, seen=0)
        for run, run_times in runs:
            world_from_lidar = [ego @ choice.ego_from_lidar for ego in egos_at(choice.ego_path, run_times)]
            tracklet, error = _tracklet(annotation, run, run_times, world_from_lidar, angles, lidar_id)
            found.append(tracklet)
            if error > 0:
                what = "a tracklet has one size: that of its middle frame [m]"
                losses.approximated("annotations.cuboid.path.values", what, error=error)
    return found


def _frames(annotation: CuboidAnnotation, timestamps_ns: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Frames with a box and its times: those of its timestamps, one per frame, else all from its first to its last."""
    timestamps = annotation.path.timestamps_ns
    if annotation.stationary and len(timestamps):
        return np.arange(len(timestamps_ns)), timestamps_ns
    own = nearest_frames(timestamps_ns, timestamps)
    if not len(timestamps):
        return own, timestamps
    inside = np.flatnonzero((timestamps_ns >= timestamps[0]) & (timestamps_ns <= timestamps[-1]))
    reported = {projection.timestamps_ns.tobytes() for projection in annotation.projections}
    is_own = bool((own != NONE).all()) and len(np.unique(own)) == len(own)
    if is_own and (2 * len(own) > len(inside) or timestamps.tobytes() in reported):
        return own, timestamps
    return inside, timestamps_ns[inside]


def _tracklet(
    annotation: CuboidAnnotation,
    frames: Int64Array,
    times: Int64Array,
    world_from_lidar: Sequence[RigidTransform],
    angles: CuboidAngles,
    lidar_id: Identifier | None,
) -> tuple[Tracklet, float]:
    """A run of frames as a tracklet, and how far sizes are from the one that it has [m]."""
    poses = activated(annotation, lidar_id, times, cuboid_poses(annotation, times, angles=angles), angles=angles)
    length, width, height = poses.sizes_lwh[len(frames) // 2].tolist()
    error = float(np.abs(poses.sizes_lwh - np.array([length, width, height])).max())
    rows = np.full((len(frames), len(POSE_FIELDS) + len(FURTHER_FIELDS)), -1.0)
    for k, placed in enumerate(world_from_lidar):
        lidar_from_world = placed.inverse()
        rotation = lidar_from_world.rotation @ matrix_from_quaternion(poses.quaternions_xyzw[k])
        center = lidar_from_world.apply(poses.centers_world[k])
        rows[k, :3] = center - rotation @ np.array([0.0, 0.0, height / 2])
        rows[k, 3:6] = cuboid_angles_from_rotation(rotation, unit=AngleUnit.RADIANS, order=ORDER)
    rows[:, 6:] = _states(annotation, times)
    return Tracklet(annotation.label or "Misc", (height, width, length), int(frames[0]), rows), error


def _states(annotation: CuboidAnnotation, times_ns: Int64Array) -> Float64Array:
    """What a box says in the words of tracklets; -1 where it does not."""
    states = np.full((len(times_ns), len(STATES)), -1.0)
    states[:, 0] = _LABELLED
    reported = {attribute.name: attribute for attribute in annotation.attributes}
    for column, name in enumerate(STATES):
        if name in reported:
            values = attribute_at(reported[name], times_ns)
            numbers = [value if isinstance(value, int | float) else -1.0 for value in values]
            states[:, column] = np.nan_to_num(np.array(numbers, np.float64), nan=-1.0)
    return states


_SLOTS = (2, 3, 0, 1)  # numbers of cameras, those of the coloured ones first

_HELD = frozenset({LidarSensor, CameraSensor, ImuSensor, GnssSensor, OdometrySensor, CuboidAnnotation})
"""Kinds of sensors and annotations that a drive can hold."""

_MODELS = {"sync": frozenset({"pinhole"}), "extract": frozenset({"pinhole", "brown_conrady"})}
_DRIVE = re.compile(r"(\d{4}_\d\d_\d\d)_drive_(\d{4})_(sync|extract)")
_DRIVE_PATH = r"\d{4}_\d\d_\d\d/(?P<one>.+)"

_KIND = FolderKind(
    "folder of KITTI's raw data",
    (
        r"\d{4}_\d\d_\d\d/calib_\w+\.txt",
        rf"{_DRIVE_PATH}/(velodyne_points|oxts|image_\d\d)/timestamps\w*\.txt",
        rf"{_DRIVE_PATH}/(velodyne_points|oxts|image_\d\d)/data/\d{{10}}\.(bin|txt|png|jpe?g)",
        rf"{_DRIVE_PATH}/{re.escape(TRACKLETS)}",
    ),
    r"\d{4}_\d\d_\d\d/calib_\w+\.txt",
)


def write_raw(
    scene: Scene, path: Path, *, overwrite: bool = False, kind: str | None = None, sequence: str | None = None
) -> LossReport:
    """Write a scene as a drive in the folder of its day, below the path.

    Args:
        kind: "sync", one frame of all sensors with rectified images, or "extract", each sensor by itself with the
            camera models' distortion; None for "sync" where all images are of camera models without distortion that
            look the same way, one for each sweep.
        sequence: number of the drive, four digits; None for that which the scene was read from, else "0001".

    Raises:
        OptionError: the kind or the number is none.
    """
    if kind not in (None, *_MODELS):
        raise OptionError(f"kind {kind!r}; expected one of {', '.join(_MODELS)}")
    kind = kind or _kind_of(scene)
    choice = Choice.of(scene, _SLOTS, _HELD, rectified=kind == "sync", models=_MODELS[kind])
    day, drive = _names(scene, choice, kind, sequence)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        folder = draft / day / drive
        folder.mkdir(parents=True)
        with_imu = choice.ego_path is not None or not choice.ego_is_lidar
        mounted = choice.mounted(with_imu=with_imu)
        kept = kept_of(scene)
        reported = kept.get("calibration") if kept.get("benchmark") == "raw" else None
        _write_raw_calibration(draft / day, mounted, reported, rectified=kind == "sync")
        timeline = choice.timeline(one_time=False, report=kind == "sync")
        choice.losses.extend(choice.image_losses())
        if kind == "sync":
            times = _write_sync(choice, timeline, folder)
        else:
            times = _write_extract(choice, timeline.timestamps_ns, folder)
        _write_oxts(choice, _oxts_times(choice, times, kind), folder / "oxts")
        if any(isinstance(annotation, CuboidAnnotation) for annotation in scene.annotations):
            starts = np.minimum(timeline.starts_ns(choice.lidar), times)
            text = _format_tracklets(_tracklets_of(choice, times, starts))
            (folder / TRACKLETS).write_text(text, "utf-8", newline="\n")
    return LossReport.of(choice.losses)


def _kind_of(scene: Scene) -> str:
    """The kind that holds most: `extract` for images that are distorted, rotated, or not one for each sweep."""
    kept = kept_of(scene)
    if kept.get("benchmark") == "raw":
        return "sync" if kept.get("rectified", True) else "extract"
    path = ego_trajectory(scene)
    mounts = [mount for camera in scene.cameras if (mount := mounting(camera, path, each=True)[0]) is not None]
    if any(camera.camera.model == "brown_conrady" for camera in scene.cameras):
        return "extract"
    if any(
        float(angle_between(mount.quaternion_xyzw, mounts[0].quaternion_xyzw)) > PARALLEL_WITHIN for mount in mounts
    ):
        return "extract"
    counts = {len(camera.images) for camera in scene.cameras if len(camera.images)}
    counts |= {len(lidar.frames) for lidar in scene.lidars[:1]}
    return "sync" if len(counts) <= 1 else "extract"


def _names(scene: Scene, choice: Choice, kind: str, sequence: str | None) -> tuple[str, str]:
    """Names of the day's folder and of the drive's."""
    kept = _DRIVE.fullmatch(str(kept_of(scene).get("drive", "")))
    number = sequence or (kept[2] if kept else "0001")
    if not (number.isascii() and number.isdigit() and len(number) <= 4):
        raise OptionError(f"sequence {number!r}; expected up to four digits, as 0001")
    timestamps = [] if choice.lidar is None else [choice.lidar.frames.timestamps_ns]
    timestamps += [camera.images.timestamps_ns for camera in choice.cameras.values()]
    first = min((int(times[0]) for times in timestamps if len(times)), default=0)
    day = kept[1] if kept else _format_timestamp(first)[:10].replace("-", "_")
    return day, f"{day}_drive_{int(number):04d}_{kind}"


def _write_sync(choice: Choice, timeline: Timeline, folder: Path) -> Int64Array:
    """Write sweeps and images; gives the times of frames as they are reported."""
    lidar = choice.lidar
    rotations = _RotationWriter(choice, folder / "velodyne_points") if lidar is not None and len(lidar.frames) else None
    timestamps: dict[int, list[str]] = {number: [] for number, c in choice.cameras.items() if len(c.images)}
    for number in timestamps:
        (folder / RAW_CAMERAS[number] / "data").mkdir(parents=True)
    for k in range(len(timeline)):
        sweep = int(timeline.sweeps[k])
        if rotations is not None and lidar is not None and sweep != NONE:
            rotations.write(lidar.frames[sweep], k)
        for number, lines in timestamps.items():
            row = int(timeline.images[number][k])
            if row == NONE:
                lines.append("")
                continue
            image = choice.cameras[number].images[row]
            write_image(choice.cameras[number], image, folder / RAW_CAMERAS[number] / "data" / f"{k:010d}.png")
            lines.append(_format_timestamp(image.timestamp_ns))
    for number, lines in timestamps.items():
        write_lines(folder / RAW_CAMERAS[number] / "timestamps.txt", lines)
    if rotations is None:
        return timeline.timestamps_ns
    rotations.close()
    return rotations.moments_ns(timeline.timestamps_ns)


def _write_extract(choice: Choice, times: Int64Array, folder: Path) -> Int64Array:
    """Write sweeps and images; gives the times of sweeps as they are reported, else `times`."""
    if choice.lidar is not None and len(choice.lidar.frames):
        rotations = _RotationWriter(choice, folder / "velodyne_points")
        for k, frame in enumerate(choice.lidar.frames):
            rotations.write(frame, k)
        times = rotations.moments_ns(choice.lidar.frames.timestamps_ns)
        rotations.close()
    for number, camera in choice.cameras.items():
        if not len(camera.images):
            continue
        location = folder / RAW_CAMERAS[number]
        (location / "data").mkdir(parents=True)
        for k, image in enumerate(camera.images):
            write_image(camera, image, location / "data" / f"{k:010d}.png")
        timestamps = [_format_timestamp(time) for time in camera.images.timestamps_ns.tolist()]
        write_lines(location / "timestamps.txt", timestamps)
    return times


def _oxts_times(choice: Choice, times: Int64Array, kind: str) -> Int64Array:
    """When lines of the OXTS unit are: those that were read, else one for each frame, or for each value of the IMU."""
    path = choice.ego_path
    units = [sensor for sensor in choice.scene.sensors if isinstance(sensor, ImuSensor)]
    imu = next((sensor for sensor in units if sensor.streams), None)
    if imu is not None and imu.id == IMU_ID and kept_of(choice.scene).get("benchmark") == "raw":
        return next(iter(imu.streams.values())).timestamps_ns
    if kind == "sync" or path is None or path.static:
        return times
    timestamps = path.timestamps_ns
    if imu is not None and "accelerometer" in imu.streams:
        timestamps = imu.streams["accelerometer"].timestamps_ns
    inside: Int64Array = np.unique(timestamps[(timestamps >= path.start_ns) & (timestamps <= path.stop_ns)])
    return inside if len(inside) else path.timestamps_ns


def _write_oxts(choice: Choice, times: Int64Array, folder: Path) -> None:
    if choice.ego_path is None or not len(times):
        return
    lines = oxts_lines(choice.scene, choice.ego_path, times)
    (folder / "data").mkdir(parents=True)
    for k, line in enumerate(lines.texts()):
        write_lines(folder / "data" / f"{k:010d}.txt", [line])
    write_lines(folder / "timestamps.txt", map(_format_timestamp, times.tolist()))
    choice.losses.extend(lines.losses)


def _format_timestamp(timestamp_ns: int) -> str:
    """Write a time as KITTI does, all nine digits of the second: `2011-09-26 13:02:25.594360375`."""
    seconds, nanoseconds = divmod(timestamp_ns, 10**9)
    moment = datetime.fromtimestamp(seconds, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{nanoseconds:09d}"


def _format_tracklets(tracklets: Sequence[Tracklet]) -> str:
    """The text of a file of tracklets, as boost's archives have it."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>',
        "<!DOCTYPE boost_serialization>",
        '<boost_serialization signature="serialization::archive" version="9">',
        '<tracklets class_id="0" tracking_level="0" version="0">',
        f"\t<count>{len(tracklets)}</count>",
        "\t<item_version>1</item_version>",
    ]
    for k, tracklet in enumerate(tracklets):
        lines += _tracklet_lines(tracklet, is_first=k == 0)
    return "\n".join([*lines, "</tracklets>", "</boost_serialization>", ""])


def _tracklet_lines(tracklet: Tracklet, *, is_first: bool) -> list[str]:
    from xml.sax.saxutils import escape

    head, pose_head, list_head = "", "", ""
    if is_first:
        head, list_head = (f' class_id="{n}" tracking_level="0" version="{v}"' for n, v in ((1, 1), (2, 0)))
        pose_head = ' class_id="3" tracking_level="0" version="1"'
    lines = [
        f"\t<item{head}>",
        f"\t\t<objectType>{escape(tracklet.label)}</objectType>",
        *(f"\t\t<{name}>{size!r}</{name}>" for name, size in zip("hwl", tracklet.size_hwl, strict=True)),
        f"\t\t<first_frame>{tracklet.first_frame}</first_frame>",
        f"\t\t<poses{list_head}>",
        f"\t\t\t<count>{len(tracklet.poses)}</count>",
        "\t\t\t<item_version>2</item_version>",
    ]
    for k, row in enumerate(tracklet.poses.tolist()):
        lines.append(f"\t\t\t<item{pose_head if k == 0 else ''}>")
        fields = zip((*POSE_FIELDS, *FURTHER_FIELDS), row, strict=True)
        lines += [f"\t\t\t\t<{name}>{_text(name, value)}</{name}>" for name, value in fields]
        lines.append("\t\t\t</item>")
    return [*lines, "\t\t</poses>", "\t\t<finished>1</finished>", "\t</item>"]


def _text(name: str, value: float) -> str:
    """A number of a pose: states are whole."""
    return repr(value) if name in POSE_FIELDS[:6] or value != int(value) else str(int(value))
