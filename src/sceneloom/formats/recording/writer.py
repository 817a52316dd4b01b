"""A scene as a recording: what goes into it, lidar binaries, and the whole folder."""

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from math import radians
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import CalibrationError, DataError, OptionError, OutputError, PoseError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.poses import each_mounted, mounting
from sceneloom.formats.base.text_tables import TimeWriter, nanoseconds
from sceneloom.formats.recording.calibration import CALIBRATION_FILE, rigid_transform
from sceneloom.formats.recording.cameras import FrameNotes
from sceneloom.formats.recording.json_faults import DECODER_FAULTS, FARTHEST_TIME
from sceneloom.formats.recording.lidars import XYZIRT
from sceneloom.formats.recording.lines import GPS_ORIGIN, LIDAR_MODELS, Origin
from sceneloom.formats.recording.reader import RANKS
from sceneloom.formats.recording.spec import DATA_FILE
from sceneloom.formats.recording.vio_config import KNOWN_KEYS, read_vio_config
from sceneloom.formats.recording.write_calibration import camera_model_entry, matrix_entry
from sceneloom.formats.recording.write_images import IMAGES, FrameLines
from sceneloom.formats.recording.write_lines import (
    LineStream,
    NumberLines,
    make_line,
    merged_lines,
    origin_for,
    rows_of,
)
from sceneloom.geometry.rigid import OUT_OF_REACH, RigidTransform, angle_between, conjugate_quaternion, rotate_vectors
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, ShootingSensor, shots_of
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor, check_camera_models
from sceneloom.scene.types import Coordinates, PointsFrame

_LIDAR_MODEL = LIDAR_MODELS[0]  # the one model that the format describes

_KIND = FolderKind(
    "recording",
    (
        r"data\d*\.(jsonl|mkv|mp4|mov|avi|ts)",
        r"calibration\.json",
        r"vio_config\.yaml",
        r"frames\d+/\d{8}\.png",
        r"lidar\d*/\w[\w.-]*\.(bin|dat|raw)",
        r"README(\.\w+)?",
    ),
    r"data\.jsonl",
)
"""What a recording's folder holds; one with anything else in it is somebody's own."""

_SAME_POSITION, _SAME_ROTATION = 1e-3, radians(0.01)
"""How far poses may be from each other and still be the same [m], [rad]: as far as those of thinned paths are."""

_NO_FIELD = "left out: the format has none"
_RECORDING_EXTRAS = {"calibration", "lidarInd"}
_NEEDED = ("accelerometer", "gyroscope")
_MOST_CAMERAS = 2


def write_recording(scene: Scene, path: Path, *, overwrite: bool = False, images: str = "copy") -> LossReport:
    """Write a scene as a recording; frames are read, written and let go one by one.

    Args:
        scene: what to write.
        path: the folder that is made.
        overwrite: replace the folder if it is a recording, or empty, but for a README; nobody else's folder is ever
            replaced.
        images: "copy" copies a camera's own video packet by packet, cut to the images that are left, where that can
            be done, and encodes H.264 else, or FFV1 where that video has lost nothing; "lossless" encodes FFV1 then;
            "h264" copies only what is H.264 already; "ffv1" (video) and "png" (files) lose nothing.

    Returns:
        What the format could not hold.

    Raises:
        OptionError: `images` is none of these.
        OutputError: the path exists, lies inside a recording, or cannot be written.
        CalibrationError: no model of the format comes near a camera model, or a camera's mounting is unknown.
        PoseError: points are in the world, and it is not known where their lidar was.
        DataError: what the scene is read from is damaged, or has nothing that a recording can hold.
    """
    if images not in IMAGES:
        raise OptionError(f"images {images!r}; expected one of: {', '.join(IMAGES)}")
    check_outside_recordings(path)
    plan = _WritingPlan(scene)
    check_camera_models(scene, plan.cameras)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        losses = _write(plan, draft, images)
        for note in path.glob("README*"):
            if note.is_file():
                shutil.copy2(note, draft)
    return LossReport.of(losses)


def check_outside_recordings(path: Path) -> None:
    """Refuse a folder inside a recording, which would then be part of that one: of its copies, archives and checks.

    Raises:
        OutputError: a folder above the path has a `data.jsonl`.
    """
    for above in path.absolute().parents:
        if (above / DATA_FILE).is_file():
            raise OutputError(f"{path}: lies inside the recording {above}; choose a location beside it")


class _Notes(msgspec.Struct):
    """What a scene that was read from a recording keeps of it under `metadata["recording"]`."""

    calibration: dict[str, Any] = {}  # all of `calibration.json`
    vio_config: str | None = None  # the text of `vio_config.yaml`
    other_lines: list[str] = []  # unknown lines; poses at a time that is taken, or without others' orientation
    other_seconds: dict[str, float] = {}  # by index in `other_lines`, the time of the line before [s], if it has none
    further_keys: dict[str, dict[str, str]] = {}  # lines that say more, by stream ("gnss.rtkgps", "lidars.0") and key
    trajectory_origins: dict[str, tuple[str, str]] = {}  # root key ("": the root itself) and name, where renamed
    receiver_origins: dict[str, tuple[str, str]] = {}  # the same of satellite receivers but that of `gps` lines
    sensor_barometer: bool = False  # air pressure came in `sensor` lines
    frame_lines: FrameNotes | None = None  # of lines of images that are not what would be written else


class _WritingPlan:
    """What of a scene is written, and what is known beforehand to be lost; `mounts`: of cameras, then lidars."""

    def __init__(self, scene: Scene) -> None:
        try:
            self.notes = msgspec.convert(scene.metadata.get("recording", {}), _Notes)
        except msgspec.ValidationError:
            self.notes = _Notes()
        self.of_recording = scene.format == "recording" or "recording" in scene.metadata  # be it through a scene file
        self.losses: list[Loss] = []
        self.trajectories = self._find_trajectories(scene)  # each with the root key and name it was read under
        oriented = (known.poses for known in scene.trajectories.values() if known.quaternions_xyzw is not None)
        odometry = (sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor))
        self.ego_path: Poses | None = next(oriented, None) or next(odometry, None)  # `world_from_ego`
        check_one_ego(scene, self.ego_path)
        self.scene = scene = each_mounted(scene, self.ego_path)
        self.lidars: Sequence[LidarSensor] = scene.lidars
        shooting = [sensor for sensor in scene.sensors if isinstance(sensor, CameraSensor | DepthCameraSensor)]
        if not self.of_recording:
            # the vendor's software takes the first two for a pair of stereo images, or for an image and its depth
            shooting.sort(key=lambda sensor: isinstance(sensor, DepthCameraSensor))
        self.cameras: Sequence[ShootingSensor] = [camera for camera in shooting if len(shots_of(camera))] or shooting
        if self.ego_path is None and not self.trajectories:
            self.ego_path = self._ego_path_of_sensor()
        units = [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)]
        whole = [unit for unit in units if set(_NEEDED) <= set(unit.streams)]
        self.imu = next(iter([*whole, *units]), None)
        self.receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
        self.losses += [*_unwritten(self, shooting), *_renamed(self), *_unplaced(self), *_not_replayed(self)]
        self.mounts = [self._mount(sensor) for sensor in (*self.cameras, *self.lidars)]

    def _find_trajectories(self, scene: Scene) -> list[tuple[Trajectory, Origin | None]]:
        """The scene's trajectories, and paths of odometry sensors that are none of them."""
        found = list(scene.trajectories.values())
        for sensor in scene.sensors:
            path = sensor.poses if isinstance(sensor, OdometrySensor) else None
            if path is not None and not path.static and not any(same_direction(path, known) for known in found):
                found.append(Trajectory(str(sensor.id), path.timestamps_ns, path.positions, path.quaternions_xyzw))
        return [(trajectory, self.notes.trajectory_origins.get(trajectory.name)) for trajectory in found]

    def _ego_path_of_sensor(self) -> Poses | None:
        """The trajectory of the first sensor that has one, so that it and the others' positions are not lost."""
        for sensor in (*self.lidars, *self.cameras):
            path, in_world = sensor.poses, sensor.coordinates is Coordinates.WORLD
            if path is None or path.static or not in_world or sensor.mount is not None:
                continue
            name = str(sensor.id)
            trajectory = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
            self.trajectories.append((trajectory, ("pose", name)))
            what = f"written as trajectory {name!r}, which the ego is taken to follow: the scene has no ego trajectory"
            self.losses.append(Loss(field=f"sensors[{sensor.id}].poses", what=what, support=Support.CONVERTED))
            return path
        return None

    def _mount(self, sensor: ShootingSensor | LidarSensor) -> RigidTransform:
        mount, lost = mounting(sensor, self.ego_path, each=True)
        self.losses.extend(lost)
        if mount is not None:
            return mount
        if not isinstance(sensor, LidarSensor):
            raise CalibrationError(
                f"camera {sensor.id!r}: nothing says how it is mounted on the vehicle (neither a mounting, nor poses "
                "of both it and the ego), and a recording cannot be without imuToCamera"
            )
        what = "taken to be where the IMU is, with the same axes: nothing says how it is mounted"
        self.losses.append(Loss(field=f"sensors[{sensor.id}].mount", what=what))
        return RigidTransform.identity()


def _unwritten(plan: _WritingPlan, shooting: Sequence[ShootingSensor]) -> Iterator[Loss]:
    """Name everything of a scene that its recording will not hold; `shooting` are all of its cameras."""
    scene = plan.scene
    counts = {
        "annotations": len(scene.annotations),
        "attributes": len(scene.attributes),
        **{f"metadata.{name}": 1 for name in scene.metadata if name != "recording"},
        **{f"extras.{name}": 1 for name in scene.extras},
    }
    yield from (Loss(field=name, what=_NO_FIELD, count=count) for name, count in counts.items() if count)
    new_names = {trajectory.name for trajectory, _ in plan.trajectories} - set(scene.trajectories)
    for sensor in scene.sensors:
        field = f"sensors[{sensor.id}]"
        if isinstance(sensor, RadarSensor | PointsSensor | PlainSensor):
            yield Loss(field=field, what=_NO_FIELD)
            continue
        yield from (Loss(field=f"{field}.{k}", what=_NO_FIELD) for k in sensor.extras if k not in _RECORDING_EXTRAS)
        if sensor.parent_id is not None:
            yield Loss(field=f"{field}.parent_id", what=_NO_FIELD)
        if isinstance(sensor, OdometrySensor):
            if sensor.poses.static:
                yield Loss(field=field, what="left out: the format has no static trajectories")
            elif str(sensor.id) not in new_names:
                yield Loss(field=field, what="left out: a trajectory says the same")
            else:
                what = f"written as trajectory {str(sensor.id)!r}"
                yield Loss(field=field, what=what, support=Support.CONVERTED)
        if sensor in shooting and sensor not in plan.cameras:
            yield Loss(field=field, what="left out: it has no images, while other cameras have")
        if isinstance(sensor, ImuSensor) and sensor is not plan.imu:
            yield Loss(field=field, what=f"left out: the format has one {sensor.type} only")
        if isinstance(sensor, GnssSensor) and sensor.mount is not None and sensor not in _main_receiver(plan.receivers):
            yield Loss(field=f"{field}.mount", what=_NO_FIELD)
    names = [trajectory.name for trajectory, _ in plan.trajectories if trajectory.covariances is not None]
    yield from (Loss(field=f"trajectories.{name}.covariances", what=_NO_FIELD) for name in names)


def _renamed(plan: _WritingPlan) -> Iterator[Loss]:
    """Name what is read back with other ids, or in another order."""
    default, names = next(iter(plan.scene.trajectories), None), [trajectory.name for trajectory, _ in plan.trajectories]
    if default != "groundTruth" and "groundTruth" in names:
        yield Loss(field="trajectories.order", what=f"read back with 'groundTruth' first, not {default!r}")
    lidars, imu = plan.lidars, [] if plan.imu is None else [plan.imu]
    # the format knows sensors by number only
    read_back: list[tuple[Sensor, str]] = [(camera, f"camera{index}") for index, camera in enumerate(plan.cameras)]
    read_back += [(lidar, f"lidar{index}" if len(lidars) > 1 else "lidar") for index, lidar in enumerate(lidars)]
    read_back += [(sensor, "imu") for sensor in imu] + [(sensor, "gnss") for sensor in _main_receiver(plan.receivers)]
    for sensor, name in read_back:
        if sensor.id != name:
            yield Loss(field=f"sensors[{sensor.id}].id", what=f"read back as {name!r}")
    order = [sensor.id for sensor in (*lidars, *plan.cameras, *imu, *plan.receivers)]
    if order != [sensor.id for sensor in plan.scene.sensors if sensor.id in order]:
        what = "read back in another order: lidars, cameras, those of depth last, IMU, satellite receivers"
        yield Loss(field="sensors", what=what)


def _unplaced(plan: _WritingPlan) -> list[Loss]:
    """Sensors lose their poses where the trajectory that is read as the ego trajectory has no orientations."""

    def rank(pair: tuple[Trajectory, Origin | None]) -> int:
        return RANKS.get((pair[1] or origin_for(pair[0].name))[0], len(RANKS))

    posed = sum(getattr(sensor, "poses", None) is not None for sensor in plan.scene.sensors)
    first = min(plan.trajectories, key=rank, default=None)
    if not posed or (first is not None and first[0].quaternions_xyzw is not None):
        return []
    what = "left out: there is no ego trajectory with orientations, which recordings locate sensors by"
    return [Loss(field="sensors[].poses", what=what, count=posed)]


def _not_replayed(plan: _WritingPlan) -> Iterator[Loss]:
    """Name what the vendor's software will not replay as it was meant: the recording holds the data all the same."""

    def loss(what: str, count: int = 1) -> Loss:
        return Loss(field="replay", what=what, count=count, support=Support.KEPT)

    cameras, streams = plan.cameras, {} if plan.imu is None else plan.imu.streams
    missing = [name for name in _NEEDED if name not in streams or not len(streams[name])]
    if missing and any(len(shots_of(camera)) for camera in cameras):
        yield loss(f"the vendor's software gives no output without {' and '.join(missing)}")
    if len(cameras) > _MOST_CAMERAS:
        names = ", ".join(str(camera.id) for camera in cameras[_MOST_CAMERAS:])
        yield loss(f"the vendor's software uses the first two cameras, not {names}", len(cameras) - _MOST_CAMERAS)
    if cameras and isinstance(cameras[0], DepthCameraSensor):
        yield loss(f"the vendor's software tracks in the first camera, and {cameras[0].id} measures depth")
    if plan.imu is not None and cameras:
        timestamps = np.unique(np.concatenate([shots_of(camera).timestamps_ns for camera in cameras]))
        measured = [streams[name].timestamps_ns for name in _NEEDED if name in streams]
        equal = int(np.isin(timestamps, np.concatenate([*measured, np.zeros(0, np.int64)])).sum())
        if equal:
            what = (
                "images have exactly the times of IMU samples, which makes the vendor's diagnosis suspect that their "
                "times were not measured; they are written as they are"
            )
            yield loss(what, equal)
    if len(plan.lidars) > 1:
        yield loss("the vendor's software does not report lidars apart (`lidarInd`)", len(plan.lidars))
    unknown = unknown_keys(plan.notes.vio_config or "")
    if unknown:
        named = ", ".join(unknown)
        yield loss(f"the vendor's software may stop at settings that are not publicly known: {named}", len(unknown))


def _write(plan: _WritingPlan, folder: Path, images: str) -> list[Loss]:
    """Write all files into an empty folder; give what was lost."""
    times, notes = TimeWriter(), plan.notes
    numbers = NumberLines(times, notes.further_keys, sensor_barometer=notes.sensor_barometer)
    sweeps = [_SweepWriter(plan, index, folder, times) for index in range(len(plan.lidars))]
    keep_extras = plan.of_recording
    with FrameLines(plan.cameras, folder, notes.frame_lines, times, images=images, keep_extras=keep_extras) as frames:
        # of one time, the small lines come first: a filter then knows all up to an image when it gets it
        streams = [numbers.trajectory(trajectory, origin) for trajectory, origin in plan.trajectories]
        streams += [] if plan.imu is None else numbers.imu(plan.imu)
        for sensor in plan.receivers:
            streams.append(numbers.gnss(sensor, _receiver_origin(sensor, notes.receiver_origins, plan.receivers)))
        streams += [sweep.stream() for sweep in sweeps]
        streams += [frames.stream(), _kept_lines(notes.other_lines, notes.other_seconds)]
        with (folder / DATA_FILE).open("wb") as file:
            for lines in merged_lines(streams):
                file.write("\n".join([*lines, ""]).encode())
        if not any(len(stream.timestamps_ns) for stream in streams):
            raise DataError(plan.scene.source, "", "holds nothing that a recording could hold")
        frames.close()
    calibration_losses = _write_calibration(plan, frames.sizes, folder)
    if notes.vio_config is not None:
        (folder / "vio_config.yaml").write_text(notes.vio_config, encoding="utf-8")
    losses = [*plan.losses, *calibration_losses, *frames.losses, *numbers.losses]
    losses += [loss for sweep in sweeps for loss in sweep.losses] + frames.image_losses
    if times.inexact:
        what = f"times written exactly, but a 64-bit number of seconds holds them within {times.worst_ns} ns only"
        worst, converted = float(times.worst_ns), Support.CONVERTED
        losses.append(Loss(field="timestamps", what=what, count=times.inexact, support=converted, largest_error=worst))
    return losses


def _write_calibration(plan: _WritingPlan, sizes: Sequence[tuple[int, int]], folder: Path) -> list[Loss]:
    """Write `calibration.json`; `sizes` are those of the images as they are written, where there are any [px]."""
    losses: list[Loss] = []
    cameras: list[dict[str, Any]] = []
    for index, sensor in enumerate(plan.cameras):
        camera = sensor.camera
        if sizes:
            # of images whose last rows and columns are cut off, nothing else changes
            camera = replace(camera, width=sizes[index][0], height=sizes[index][1])
        fields, how_far = camera_model_entry(camera)
        if how_far is not None:
            losses.append(Loss(field=f"sensors[{sensor.id}].camera", what=how_far, support=Support.APPROXIMATED))
        unknown = {k: v for k, v in _entry_before(sensor).items() if k != "distortionModel"}
        cameras.append(_with_mount({**unknown, **fields}, "imuToCamera", plan.mounts[index]))
    lidar_mounts = plan.mounts[len(cameras) :]
    lidars = [_lidar_entry(lidar, k, lidar_mounts[k]) for k, lidar in enumerate(plan.lidars)]
    further, main = dict(plan.notes.calibration), _main_receiver(plan.receivers)
    if main and main[0].mount is not None:
        further.setdefault("imuToGnss", matrix_entry(main[0].mount.inverse()))
    content = {**further, "cameras": cameras, **({"lidars": lidars} if lidars else {})}
    if cameras or lidars or further:
        text = msgspec.json.format(msgspec.json.encode(content), indent=2)
        (folder / CALIBRATION_FILE).write_bytes(text + b"\n")
    return losses


def _entry_before(sensor: ShootingSensor | LidarSensor) -> dict[str, Any]:
    entry = sensor.extras.get("calibration")
    return dict(entry) if isinstance(entry, Mapping) else {}


def _lidar_entry(sensor: LidarSensor, index: int, mount: RigidTransform) -> dict[str, Any]:
    before = {**_entry_before(sensor), "model": _LIDAR_MODEL}
    before = {k: v for k, v in before.items() if k != "lidarInd" or index} | ({"lidarInd": index} if index else {})
    return _with_mount(before, "imuToLidar", mount)


def _with_mount(entry: Mapping[str, Any], key: str, mount: RigidTransform) -> dict[str, Any]:
    """Write a mounting, `ego_from_sensor`: with the numbers that it was read from, where they still mean it."""
    matrix, unknown = matrix_entry(mount.inverse()), {k: v for k, v in entry.items() if k != f"{key}Matrix"}
    for numbers in (entry[name] for name in (key, f"{key}Matrix") if name in entry):
        try:
            read = rigid_transform(numbers, "", Ledger(lenient=True)).inverse()
            if np.shape(numbers) == (4, 4) and np.array_equal(read.matrix, mount.matrix):
                matrix = [list(map(float, row)) for row in numbers]
                break
        except (CalibrationError, *DECODER_FAULTS, TypeError):
            continue
    return {**unknown, key: matrix}


class _SweepWriter:
    """Writes the sweeps of one lidar."""

    def __init__(self, plan: _WritingPlan, index: int, folder: Path, times: TimeWriter) -> None:
        self._sensor = sensor = plan.lidars[index]
        self._index, self._mount = index, plan.mounts[len(plan.cameras) + index]
        self._folder, self._times = folder, times
        further = plan.notes.further_keys.get(f"lidars.{sensor.extras.get('lidarInd', index)}", {})
        self._further = rows_of(further, sensor.frames.timestamps_ns)
        self._names: set[str] = set()
        self._subfolder = f"lidar{index + 1 if index else ''}"
        in_world = sensor.points_frame is PointsFrame.WORLD
        self._world = _world_poses(sensor, self._mount, plan.ego_path) if in_world else None
        self.losses: list[Loss] = []
        field = f"sensors[{sensor.id}]"
        if sensor.model not in (None, _LIDAR_MODEL):
            what = f"{sensor.model!r} written as {_LIDAR_MODEL!r}, the one layout of files that the format has"
            self.losses.append(Loss(field=f"{field}.model", what=what))
        if sensor.points_frame is not PointsFrame.SENSOR:
            frame, converted = sensor.points_frame, Support.CONVERTED
            what = f"brought from the {frame} frame into the lidar's own, in which recordings keep points"
            self.losses.append(Loss(field=f"{field}.points_frame", what=what, support=converted))
            what, number = f"rounded to float32 in the lidar's own frame, from the {frame} frame", len(sensor.frames)
            field = f"{field}.frames[].points.positions"
            self.losses.append(Loss(field=field, what=what, count=number, support=converted))

    def stream(self) -> LineStream:
        """The lines, each made after its file was written."""
        return LineStream(self._sensor.frames.timestamps_ns, self._lines())

    def _lines(self) -> Iterator[str]:
        (self._folder / self._subfolder).mkdir(exist_ok=True)
        for k, frame in enumerate(self._sensor.frames):
            name = self._file_name(k, frame)
            (self._folder / name).write_bytes(self._records(frame).tobytes())
            sweep: dict[str, Any] = {"model": _LIDAR_MODEL, "dataFile": name}
            if self._index:
                sweep["lidarInd"] = self._index
            seconds = frame.extras.get("file_seconds")
            yield make_line({"lidar": sweep}, frame.timestamp_ns, self._times, seconds, self._further.get(k))

    def _file_name(self, k: int, frame: LidarFrame) -> str:
        """The name that the file had in a recording, where that is free and in the lidar's folder; else a number."""
        name = frame.extras.get("dataFile")
        own = re.compile(rf"{self._subfolder}/\w[\w.-]*")
        if not isinstance(name, str) or not own.fullmatch(name) or name in self._names:
            name = next(n for n in (f"{self._subfolder}/{i:06d}.bin" for i in count(k)) if n not in self._names)
        self._names.add(name)
        return name

    def _records(self, frame: LidarFrame) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        points = frame.points
        self._note_losses(frame)
        records = np.zeros(len(points), XYZIRT)
        positions = frame.points.positions
        if self._sensor.points_frame is PointsFrame.EGO:
            positions = self._mount.inverse().apply(positions).astype(np.float32)
        elif self._world is not None:
            positions = self._from_world(frame, self._world).astype(np.float32)
        for axis, name in enumerate("xyz"):
            records[name] = positions[:, axis]
        if points.intensities is not None:
            records["intensity"] = points.intensities
        if points.rings is not None:
            records["ring"] = points.rings
        records["timestamp"] = self._seconds(frame)
        return records

    def _seconds(self, frame: LidarFrame) -> Float64Array:
        """Times as numbers: those that the file had, where they still mean the same time."""
        timestamps = _point_times(frame)
        seconds: Float64Array = timestamps / 1e9
        before = frame.points.extras.get("file_seconds")
        if isinstance(before, np.ndarray) and before.shape == timestamps.shape:
            seconds = np.where(nanoseconds(before) == timestamps, before, seconds)
        inexact = int((nanoseconds(seconds) != timestamps).sum())
        self._lose("timestamps_ns", "rounded to what a 64-bit number of seconds holds", inexact)
        return seconds

    def _from_world(self, frame: LidarFrame, poses: PoseSource) -> Float64Array:
        """Undo what brought each point into the world at its own time."""
        if not len(frame.points):
            return np.zeros((0, 3))
        samples = poses.at(_point_times(frame))
        unknown = int(np.isnan(samples.positions[:, 0]).sum())
        if unknown:
            raise PoseError(
                f"lidar {self._sensor.id!r}: sweep at {frame.timestamp_ns} ns: no pose for {unknown} of its points, "
                "which are in the world and have to be brought back into the lidar's frame"
            )
        offsets = frame.points.positions.astype(np.float64) - samples.positions
        return rotate_vectors(conjugate_quaternion(samples.quaternions_xyzw), offsets)

    def _note_losses(self, frame: LidarFrame) -> None:
        points: LidarPoints = frame.points
        absent = {
            "intensities": "0 written: the source has none",
            "rings": "0 written: the source has none",
            "timestamps_ns": "the sweep's own time written: the source has none per point",
        }
        for name, what in absent.items():
            self._lose(name, what, len(points) if getattr(points, name) is None else 0)
        unwritten = [name for name in ("colors", "camera_index") if getattr(points, name) is not None]
        for name in [*unwritten, *(name for name in points.extras if name != "file_seconds")]:
            self._lose(name, _NO_FIELD, len(points))
        for name in [name for name in frame.extras if name not in {"file_seconds", "dataFile"}]:
            self.losses.append(Loss(field=f"sensors[{self._sensor.id}].frames[].{name}", what=_NO_FIELD))

    def _lose(self, name: str, what: str, count: int) -> None:
        if count:
            field = f"sensors[{self._sensor.id}].frames[].points.{name}"
            self.losses.append(Loss(field=field, what=what, count=count))


def _point_times(frame: LidarFrame) -> Int64Array:
    timestamps = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if timestamps is None else timestamps


def _world_poses(sensor: LidarSensor, mount: RigidTransform, ego_path: Poses | None) -> PoseSource:
    """Poses of the lidar: its own, but the ego's with the mounting, of more times, where these state the same."""
    timestamps = sensor.frames.timestamps_ns
    reach_ns = int(np.median(np.diff(timestamps))) if len(timestamps) > 1 else 0
    along_ego = None if ego_path is None else PoseSource(ego_path, mount, reach_ns)
    if sensor.poses is not None and sensor.coordinates is Coordinates.WORLD:
        if along_ego is not None and _agree(along_ego, sensor.poses):
            return along_ego
        return PoseSource(sensor.poses, RigidTransform.identity(), reach_ns)
    if along_ego is None:
        raise PoseError(
            f"lidar {sensor.id!r}: its points are in the world and have to be brought back into its own frame, "
            "but the scene says neither where it was nor where the ego was"
        )
    return along_ego


def _agree(along_ego: PoseSource, poses: Poses) -> bool:
    """Whether a source gives the poses of a path at all its times, but for rounding."""
    if poses.static:
        return False
    samples = along_ego.at(poses.timestamps_ns)
    if (samples.coverage == OUT_OF_REACH).any():
        return False
    distances = np.linalg.norm(samples.positions - poses.positions, axis=1)
    angles = angle_between(samples.quaternions_xyzw, poses.quaternions_xyzw)
    return bool(distances.max() <= _SAME_POSITION and angles.max() <= _SAME_ROTATION)


def _kept_lines(texts: Sequence[str], anchors: Mapping[str, float]) -> LineStream:
    """Unknown lines in time order; `anchors` are times [s] of lines before those without one, which else come first."""
    seconds = [_seconds_of(text, anchors.get(str(k))) for k, text in enumerate(texts)]
    timestamps = np.array([-(2**63) if s is None else round(s * 1e9) for s in seconds], np.int64)
    order = np.argsort(timestamps, kind="stable")
    return LineStream(timestamps[order], (texts[k].strip() for k in order.tolist()))


def _seconds_of(text: str, anchor: float | None) -> float | None:
    try:
        line = msgspec.json.decode(text)
    except DECODER_FAULTS:
        return anchor
    seconds = line.get("time") if isinstance(line, dict) else None
    return float(seconds) if isinstance(seconds, int | float) and abs(seconds) < FARTHEST_TIME else anchor


def _receiver_origin(sensor: GnssSensor, origins: Mapping[str, Origin], receivers: Sequence[GnssSensor]) -> Origin:
    """Root key and name of a receiver's lines: those that it was read under, `gps` for the first one, else its id."""
    name = str(sensor.id)
    if name in origins:
        return origins[name]
    if sensor in _main_receiver([other for other in receivers if str(other.id) not in origins]):
        return GPS_ORIGIN
    return origin_for(name)


def _main_receiver(receivers: Sequence[GnssSensor]) -> list[GnssSensor]:
    """Give the one whose lines are `gps` lines: the one that is called so, else the first that has no other name."""
    others = [sensor for sensor in receivers if sensor.id != "rtkgps"]
    return [sensor for sensor in others if sensor.id == "gnss"][:1] or others[:1]


def unknown_keys(text: str) -> list[str]:
    """The names of settings that are not publicly known, in the order of the lines; the SDK stops at those it lacks."""
    return [setting.key for setting in read_vio_config(text).settings if setting.key not in KNOWN_KEYS]
