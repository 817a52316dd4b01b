"""A scene as a recording: what goes into it, lidar binaries, and the whole folder."""

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import count
from math import radians
from pathlib import Path
from typing import Any, Protocol, Self

import msgspec
import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.errors import CalibrationError, DataError, OptionError, OutputError, PoseError
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.poses import each_mounted, mounting
from sceneloom.formats.base.text_tables import TimeWriter, nanoseconds
from sceneloom.formats.recording.calibration import CALIBRATION_FILE
from sceneloom.formats.recording.cameras import FrameNotes
from sceneloom.formats.recording.lidars import XYZIRT
from sceneloom.formats.recording.lines import LIDAR_MODELS
from sceneloom.formats.recording.reader import RANKS
from sceneloom.formats.recording.spec import DATA_FILE
from sceneloom.formats.recording.vio_config import unknown_keys
from sceneloom.formats.recording.write_images import (
    IMAGES,
    FrameLines,
    ImageRows,
    ImageSink,
    antenna_entry,
    camera_entry,
    cropped,
    grouping_losses,
    image_rows,
    lidar_entry,
    open_sink,
)
from sceneloom.formats.recording.write_lines import (
    FRAMES,
    LineStream,
    NumberLines,
    OneByOne,
    SharedLines,
    SharedText,
    WrittenLine,
    completed,
    main_receiver,
    make_line,
    merged_lines,
    origin_for,
    receiver_origin,
    rows_of,
    timed_lines,
    untimed_lines,
)
from sceneloom.geometry.interpolation import OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between, conjugate_quaternion, rotate_vectors
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, ShootingSensor, shots_of
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor, check_camera_models
from sceneloom.scene.types import Coordinates, PointsFrame


class RecordingNotes(msgspec.Struct):
    """What a scene that was read from a recording keeps of it under `metadata["recording"]`.

    Attributes:
        calibration: all of `calibration.json`.
        vio_config: the text of `vio_config.yaml`.
        other_lines: lines that a scene has no field for.
        other_seconds: by index in `other_lines`, the time of the line before [s], for lines without one.
        further_keys: by stream and key of a row, the text of a line that says more than its sample.
        shared_lines: lines that several streams have a part in.
        trajectory_origins: root key and name of trajectories that were renamed.
        receiver_origins: root key and name of satellite receivers that were renamed.
        sensor_barometer: whether the air pressure came in `sensor` lines.
        frame_lines: of lines of images that are not what would be written else.
    """

    calibration: dict[str, Any] = {}
    vio_config: str | None = None
    other_lines: list[str] = []
    other_seconds: dict[str, float] = {}
    further_keys: dict[str, dict[str, str]] = {}
    shared_lines: list[SharedText] = []
    trajectory_origins: dict[str, tuple[str, str]] = {}
    receiver_origins: dict[str, tuple[str, str]] = {}
    sensor_barometer: bool = False
    frame_lines: FrameNotes | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _WritingPlan:
    """What of a scene is written, and what is known beforehand to be lost.

    Attributes:
        cameras: in the order of `cameraInd`.
        lidars: in the order of `lidarInd`.
        mounts: `ego_from_sensor` of the cameras, then of the lidars.
        trajectories: each with the root key and name that it was read under, or None.
        imu: the inertial unit that is written, or None.
        ego_path: `world_from_ego`, or None.
    """

    scene: Scene
    notes: RecordingNotes
    cameras: Sequence[ShootingSensor]
    lidars: Sequence[LidarSensor]
    mounts: Sequence[RigidTransform]
    trajectories: Sequence[tuple[Trajectory, tuple[str, str] | None]]
    imu: ImuSensor | None
    ego_path: Poses | None
    losses: list[Loss] = field(default_factory=list)

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Look through a scene.

        Raises:
            CalibrationError: nothing says how a camera is mounted.
        """
        notes = _notes(scene)
        trajectories = _trajectories(scene, notes)
        ego_path = _ego_path(scene)
        check_one_ego(scene, ego_path)
        scene = each_mounted(scene, ego_path)
        found = _shooting_sensors(scene)
        cameras = [camera for camera in found if len(shots_of(camera))] or found
        losses: list[Loss] = []
        if ego_path is None and not trajectories:
            ego_path = _ride_along([*scene.lidars, *cameras], trajectories, losses)
        imu = _written_imu(scene)
        losses += _unwritten(scene, cameras, [trajectory for trajectory, _ in trajectories], imu)
        losses += _of_unplaced(scene, trajectories)
        losses += _unreplayable(cameras, scene.lidars, imu, notes.vio_config)
        mounted: list[ShootingSensor | LidarSensor] = [*cameras, *scene.lidars]
        mounts = [_mount(sensor, ego_path, losses) for sensor in mounted]
        return cls(scene, notes, cameras, scene.lidars, mounts, trajectories, imu, ego_path, losses)


def _notes(scene: Scene) -> RecordingNotes:
    try:
        return msgspec.convert(scene.metadata.get("recording", {}), RecordingNotes)
    except msgspec.ValidationError:
        return RecordingNotes()


def _trajectories(scene: Scene, notes: RecordingNotes) -> list[tuple[Trajectory, tuple[str, str] | None]]:
    """The scene's trajectories, and paths of odometry sensors that are none of them."""
    found = list(scene.trajectories.values())
    for sensor in scene.sensors:
        path = sensor.poses if isinstance(sensor, OdometrySensor) else None
        if path is not None and not path.static and not any(same_direction(path, known) for known in found):
            found.append(Trajectory(str(sensor.id), path.timestamps_ns, path.positions, path.quaternions_xyzw))
    return [(trajectory, notes.trajectory_origins.get(trajectory.name)) for trajectory in found]


def _ride_along(
    sensors: Sequence[ShootingSensor | LidarSensor],
    trajectories: list[tuple[Trajectory, tuple[str, str] | None]],
    losses: list[Loss],
) -> Poses | None:
    """Take the trajectory of the first sensor that has one for the ego's.

    So that it and the others' locations are not lost.
    """
    for sensor in sensors:
        path = sensor.poses
        if path is None or path.static or sensor.coordinates is not Coordinates.WORLD or sensor.mount is not None:
            continue
        name = str(sensor.id)
        trajectory = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
        trajectories.append((trajectory, ("pose", name)))
        what = f"written as trajectory {name!r}, which the ego is taken to follow: the scene has no ego trajectory"
        losses.append(Loss(field=f"sensors[{sensor.id}].poses", what=what, support=Support.CONVERTED))
        return path
    return None


def _of_unplaced(scene: Scene, trajectories: Sequence[tuple[Trajectory, tuple[str, str] | None]]) -> list[Loss]:
    """Report that sensors lose their poses.

    The trajectory that reading takes for the ego trajectory has no orientations.
    """
    posed = sum(getattr(sensor, "poses", None) is not None for sensor in scene.sensors)
    ranked = sorted(trajectories, key=lambda pair: RANKS.get((pair[1] or origin_for(pair[0].name))[0], len(RANKS)))
    if not posed or (ranked and ranked[0][0].quaternions_xyzw is not None):
        return []
    what = "left out: there is no trajectory of the ego with orientations that recordings location sensors by"
    return [Loss(field="sensors[].poses", what=what, count=posed)]


def _written_imu(scene: Scene) -> ImuSensor | None:
    """The inertial unit that is written: the first that measures what the vendor's software needs, else the first."""
    units = [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)]
    whole = [unit for unit in units if {"accelerometer", "gyroscope"} <= set(unit.streams)]
    return next(iter([*whole, *units]), None)


def _ego_path(scene: Scene) -> Poses | None:
    oriented = (known.poses for known in scene.trajectories.values() if known.quaternions_xyzw is not None)
    odometry = (sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor))
    return next(oriented, None) or next(odometry, None)


def _mount(sensor: ShootingSensor | LidarSensor, ego_path: Poses | None, losses: list[Loss]) -> RigidTransform:
    mount, lost = mounting(sensor, ego_path, each=True)
    losses.extend(lost)
    if mount is not None:
        return mount
    if not isinstance(sensor, LidarSensor):
        raise CalibrationError(
            f"camera {sensor.id!r}: nothing says how it is mounted on the vehicle (neither a mounting, nor poses of "
            "both it and the ego), and a recording cannot be without imuToCamera"
        )
    what = "taken to be where the IMU is, with the same axes: nothing says how it is mounted"
    losses.append(Loss(field=f"sensors[{sensor.id}].mount", what=what))
    return RigidTransform.identity()


_LIDAR_MODEL = LIDAR_MODELS[0]
"""The one model that the format describes."""

_ABSENT = (
    ("intensities", "0 written: the source has none"),
    ("rings", "0 written: the source has none"),
    ("timestamps_ns", "the sweep's own time written: the source has none per point"),
)

_NO_POSITION = ("colors", "camera_index")

_OWN_EXTRAS = {"file_seconds", "dataFile"}
"""Further fields of a sweep that its line holds."""

_SAME_LOCATION, _SAME_ROTATION = 1e-3, radians(0.01)
"""How far poses may be from each other and still be the same [m], [rad]: as far as those of thinned paths are."""


def _sweep_stream(sensor: LidarSensor, index: int) -> str:
    """The name under which more is kept of a lidar's lines."""
    return f"lidars.{sensor.extras.get('lidarInd', index)}"


class _SweepWriter:
    """Writes the sweeps of one lidar.

    Attributes:
        losses: what could not be written.
    """

    def __init__(
        self,
        sensor: LidarSensor,
        index: int,
        mount: RigidTransform,
        ego_path: Poses | None,
        folder: Path,
        times: TimeWriter,
        further_keys: Mapping[str, str],
    ) -> None:
        """Begin.

        Args:
            sensor: the lidar.
            index: `lidarInd`.
            mount: `ego_from_lidar`.
            ego_path: `world_from_ego`, or None.
            folder: the recording that is being written.
            times: writes the times.
            further_keys: by key of a sweep, the text of a line that once stated more than it.

        Raises:
            PoseError: the points are in the world, and it is not known where the lidar was.
        """
        self.losses = _losses_of_all(sensor)
        self._sensor, self._index, self._mount = sensor, index, mount
        self._folder, self._times = folder, times
        self._names: set[str] = set()
        rows = rows_of(further_keys, sensor.frames.timestamps_ns)
        self._further = {row: further_keys[key] for key, row in rows.items()}
        self._subfolder = f"lidar{index + 1 if index else ''}"
        self._world = _world_poses(sensor, mount, ego_path) if sensor.points_frame is PointsFrame.WORLD else None

    def stream(self) -> LineStream:
        """The lines, each made after its file was written."""
        name = _sweep_stream(self._sensor, self._index)
        return OneByOne(self._sensor.frames.timestamps_ns, self._lines(), name)

    def _lines(self) -> Iterator[WrittenLine]:
        (self._folder / self._subfolder).mkdir(exist_ok=True)
        for k, frame in enumerate(self._sensor.frames):
            name = self._file_name(k, frame)
            (self._folder / name).write_bytes(self._records(frame).tobytes())
            sweep: dict[str, Any] = {"model": _LIDAR_MODEL, "dataFile": name}
            if self._index:
                sweep["lidarInd"] = self._index
            fields: dict[str, Any] = {"lidar": sweep}
            seconds = frame.extras.get("file_seconds")
            line = make_line(fields, frame.timestamp_ns, self._times, seconds)
            further = self._further.get(k)
            yield line if further is None else line._replace(text=completed(line.text, further))

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
        positions = self._in_sensor_frame(frame)
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

    def _in_sensor_frame(self, frame: LidarFrame) -> Float32Array:
        positions = frame.points.positions
        if self._sensor.points_frame is PointsFrame.EGO:
            positions = self._mount.inverse().apply(positions).astype(np.float32)
        elif self._world is not None:
            positions = self._from_world(frame).astype(np.float32)
        return positions

    def _from_world(self, frame: LidarFrame) -> Float64Array:
        """Undo what brought each point into the world at its own time."""
        if self._world is None or not len(frame.points):
            return np.zeros((0, 3))
        samples = self._world.at(_point_times(frame))
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
        for name, what in _ABSENT:
            self._lose(name, what, len(points) if getattr(points, name) is None else 0)
        further = [name for name in _NO_POSITION if getattr(points, name) is not None]
        further += [name for name in points.extras if name != "file_seconds"]
        for name in further:
            self._lose(name, "left out: the format has none", len(points))
        for name in [name for name in frame.extras if name not in _OWN_EXTRAS]:
            field = f"sensors[{self._sensor.id}].frames[].{name}"
            self.losses.append(Loss(field=field, what="left out: the format has none", count=1))

    def _lose(self, name: str, what: str, count: int) -> None:
        if count:
            field = f"sensors[{self._sensor.id}].frames[].points.{name}"
            self.losses.append(Loss(field=field, what=what, count=count))


def _losses_of_all(sensor: LidarSensor) -> list[Loss]:
    """What holds for all sweeps of a lidar."""
    losses = []
    if sensor.model not in (None, _LIDAR_MODEL):
        what = f"{sensor.model!r} written as {_LIDAR_MODEL!r}, the one layout of files that the format has"
        losses.append(Loss(field=f"sensors[{sensor.id}].model", what=what))
    if sensor.points_frame is not PointsFrame.SENSOR:
        what = f"brought from the {sensor.points_frame} frame into the lidar's own, in which recordings keep points"
        losses.append(Loss(field=f"sensors[{sensor.id}].points_frame", what=what, support=Support.CONVERTED))
        what = f"rounded to float32 in the lidar's own frame, from the {sensor.points_frame} frame"
        field, count = f"sensors[{sensor.id}].frames[].points.positions", len(sensor.frames)
        losses.append(Loss(field=field, what=what, count=count, support=Support.CONVERTED))
    return losses


def _point_times(frame: LidarFrame) -> Int64Array:
    timestamps = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if timestamps is None else timestamps


def _world_poses(sensor: LidarSensor, mount: RigidTransform, ego_path: Poses | None) -> PoseSource:
    """Where the lidar was: by its own poses in the world, else by the ego's and the mounting.

    Own poses may be few. Where the ego's with the mounting state the same, these report more of the time between.
    """
    timestamps = sensor.frames.timestamps_ns
    reach_ns = int(np.median(np.diff(timestamps))) if len(timestamps) > 1 else 0
    rider_association = None if ego_path is None else PoseSource(ego_path, mount, reach_ns)
    if sensor.poses is not None and sensor.coordinates is Coordinates.WORLD:
        if rider_association is not None and _agree(rider_association, sensor.poses):
            return rider_association
        return PoseSource(sensor.poses, RigidTransform.identity(), reach_ns)
    if rider_association is None:
        raise PoseError(
            f"lidar {sensor.id!r}: its points are in the world and have to be brought back into its own frame, "
            "but the scene says neither where it was nor where the ego was"
        )
    return rider_association


def _agree(rider_association: PoseSource, poses: Poses) -> bool:
    """Whether a source gives the poses of a path at all its times, but for rounding."""
    if poses.static:
        return False
    samples = rider_association.at(poses.timestamps_ns)
    if (samples.coverage == OUT_OF_REACH).any():
        return False
    distances = np.linalg.norm(samples.positions - poses.positions, axis=1)
    angles = angle_between(samples.quaternions_xyzw, poses.quaternions_xyzw)
    return bool(distances.max() <= _SAME_LOCATION and angles.max() <= _SAME_ROTATION)


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
    plan = _WritingPlan.of(scene)
    check_camera_models(scene, plan.cameras)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        losses = _RecordingWriter(plan, draft, images).write()
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


class _LosingPart(Protocol):
    """A part of the writing that notes what it loses."""

    @property
    def losses(self) -> list[Loss]:
        """What was lost so far."""
        ...


class _RecordingWriter:
    """Writes one recording into an empty folder."""

    def __init__(self, plan: _WritingPlan, folder: Path, images: str) -> None:
        self._plan, self._folder, self._images = plan, folder, images
        self._times = TimeWriter()
        self._numbers = NumberLines(self._times, plan.notes.further_keys)
        self._losses = list(plan.losses)

    def write(self) -> list[Loss]:
        """Write all files; give what was lost."""
        plan = self._plan
        rows = image_rows(plan.cameras, plan.notes.frame_lines)
        with ExitStack() as stack:
            sinks = self._open_sinks(rows, stack)
            keep = _of_recording(plan.scene)
            frames = FrameLines(plan.cameras, sinks, rows, self._times, keep_extras=keep)
            images = frames.stream()
            shared = SharedLines(plan.notes.shared_lines, self._hosts(images))
            self._numbers = NumberLines(
                self._times,
                plan.notes.further_keys,
                shared=shared,
                sensor_barometer=plan.notes.sensor_barometer,
            )
            sweeps = self._sweep_writers(shared)
            # of one time, the small lines come first: a filter then knows all up to an image when it gets it
            self._write_lines(
                [
                    *self._number_streams(shared),
                    *(sweep.stream() for sweep in sweeps),
                    images,
                    _kept_stream(untimed_lines(plan.notes.other_lines, plan.notes.other_seconds)),
                ]
            )
            for sink in sinks:
                sink.close()
        self._write_calibration(sinks)
        if plan.notes.vio_config is not None:
            (self._folder / "vio_config.yaml").write_text(plan.notes.vio_config, encoding="utf-8")
        parts: list[_LosingPart] = [frames, self._numbers, *sweeps, *sinks]
        self._losses.extend(loss for part in parts for loss in part.losses)
        return [*self._losses, *grouping_losses(plan.cameras, rows), *_time_losses(self._times)]

    def _open_sinks(self, rows: ImageRows, stack: ExitStack) -> list[ImageSink]:
        sinks: list[ImageSink] = []
        for index, camera in enumerate(self._plan.cameras if len(rows.images) else ()):
            sinks.append(open_sink(camera, self._folder, index, rows.images[:, index], images=self._images))
            stack.callback(sinks[-1].abandon)
        return sinks

    def _hosts(self, images: LineStream) -> dict[str, Int64Array]:
        """Times of images and sweeps, by the names of their streams."""
        lidars = self._plan.lidars
        sweeps = {_sweep_stream(lidar, k): lidar.frames.timestamps_ns for k, lidar in enumerate(lidars)}
        return {FRAMES: images.timestamps_ns, **sweeps}

    def _sweep_writers(self, shared: SharedLines) -> list[_SweepWriter]:
        plan = self._plan
        writers = []
        for index, lidar in enumerate(plan.lidars):
            mount, name = plan.mounts[len(plan.cameras) + index], _sweep_stream(lidar, index)
            further = {**plan.notes.further_keys.get(name, {}), **shared.texts_for(name)}
            writers.append(_SweepWriter(lidar, index, mount, plan.ego_path, self._folder, self._times, further))
        return writers

    def _number_streams(self, shared: SharedLines) -> list[LineStream]:
        plan, lines, notes = self._plan, self._numbers, self._plan.notes
        receivers = [sensor for sensor in plan.scene.sensors if isinstance(sensor, GnssSensor)]
        streams = [lines.trajectory(trajectory, origin) for trajectory, origin in plan.trajectories]
        streams += [] if plan.imu is None else lines.imu(plan.imu)
        for sensor in receivers:
            streams.append(lines.gnss(sensor, receiver_origin(sensor, notes.receiver_origins, receivers)))
        return [*streams, _kept_stream(shared.lines()), _kept_stream(timed_lines(notes.other_lines))]

    def _write_lines(self, streams: Sequence[LineStream]) -> None:
        with (self._folder / DATA_FILE).open("wb") as file:
            for lines in merged_lines(streams):
                file.write("\n".join([*lines, ""]).encode())
        if not any(len(stream.timestamps_ns) for stream in streams):
            raise DataError(self._plan.scene.source, "", "holds nothing that a recording could hold")

    def _write_calibration(self, sinks: list[ImageSink]) -> None:
        plan = self._plan
        cameras: list[dict[str, Any]] = []
        for index, camera in enumerate(plan.cameras):
            camera_model = cropped(camera.camera, sinks[index].width, sinks[index].height) if sinks else camera.camera
            entry, lost = camera_entry(camera, camera_model, plan.mounts[index])
            cameras.append(entry)
            self._losses.extend(lost)
        lidars = [
            lidar_entry(lidar, index, plan.mounts[len(cameras) + index], _LIDAR_MODEL)
            for index, lidar in enumerate(plan.lidars)
        ]
        antenna = antenna_entry(plan.scene, plan.notes.calibration)
        further = {**plan.notes.calibration, **antenna}
        content = {**further, "cameras": cameras, **({"lidars": lidars} if lidars else {})}
        if cameras or lidars or further:
            text = msgspec.json.format(msgspec.json.encode(content), indent=2)
            (self._folder / CALIBRATION_FILE).write_bytes(text + b"\n")


def _kept_stream(lines: Sequence[WrittenLine]) -> LineStream:
    return OneByOne(np.array([line.timestamp_ns for line in lines], np.int64), lines)


def _time_losses(times: TimeWriter) -> list[Loss]:
    if not times.inexact:
        return []
    what = f"times written exactly, but a 64-bit number of seconds holds them within {times.worst_ns} ns only"
    worst = float(times.worst_ns)
    return [Loss(field="timestamps", what=what, count=times.inexact, support=Support.CONVERTED, largest_error=worst)]


def _shooting_sensors(scene: Scene) -> Sequence[ShootingSensor]:
    """The cameras in the order of `cameraInd`: as they were read from a recording, else those of depth last.

    The vendor's software takes the first two for a pair of stereo images, or for an image and its depth.
    """
    found = [sensor for sensor in scene.sensors if isinstance(sensor, CameraSensor | DepthCameraSensor)]
    if _of_recording(scene):
        return found
    return sorted(found, key=lambda sensor: isinstance(sensor, DepthCameraSensor))


def _of_recording(scene: Scene) -> bool:
    """Whether a scene was read from a recording, be it through a scene file."""
    return scene.format == "recording" or "recording" in scene.metadata


_FIELD = "replay"
"""Under which these stand in a loss report: the recording holds the data all the same."""

_NEEDED = ("accelerometer", "gyroscope")
_MOST_CAMERAS = 2


def _unreplayable(
    cameras: Sequence[ShootingSensor],
    lidars: Sequence[LidarSensor],
    imu: ImuSensor | None,
    vio_config: str | None,
) -> list[Loss]:
    """Name what will not be replayed as it was meant.

    Args:
        cameras: what is written, in the order of `cameraInd`.
        lidars: what is written.
        imu: what is written.
        vio_config: the text of `vio_config.yaml`.
    """
    return [
        *_of_missing(cameras, imu),
        *_of_cameras(cameras),
        *_of_equal_times(cameras, imu),
        *_of_lidars(lidars),
        *_of_settings(vio_config),
    ]


def _of_missing(cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    there = {name for name, samples in imu.streams.items() if len(samples)} if imu is not None else set()
    missing = [name for name in _NEEDED if name not in there]
    if missing and any(len(shots_of(camera)) for camera in cameras):
        yield _loss(f"the vendor's software gives no output without {' and '.join(missing)}")


def _of_cameras(cameras: Sequence[ShootingSensor]) -> Iterator[Loss]:
    if len(cameras) > _MOST_CAMERAS:
        names = ", ".join(str(camera.id) for camera in cameras[_MOST_CAMERAS:])
        yield _loss(f"the vendor's software uses the first two cameras, not {names}", len(cameras) - _MOST_CAMERAS)
    if cameras and isinstance(cameras[0], DepthCameraSensor):
        yield _loss(f"the vendor's software tracks in the first camera, and {cameras[0].id} measures depth")


def _of_equal_times(cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    if imu is None or not cameras:
        return
    timestamps: Int64Array = np.concatenate([shots_of(camera).timestamps_ns for camera in cameras])
    measured = [samples.timestamps_ns for name, samples in imu.streams.items() if name in _NEEDED]
    equal = int(np.isin(np.unique(timestamps), np.concatenate([*measured, np.zeros(0, np.int64)])).sum())
    if equal:
        yield _loss(
            "images have the very times of IMU samples, which makes the vendor's diagnosis suspect that their times "
            "were not measured; they are written as they are",
            equal,
        )


def _of_lidars(lidars: Sequence[LidarSensor]) -> Iterator[Loss]:
    if len(lidars) > 1:
        yield _loss("the vendor's software does not report lidars apart (`lidarInd`)", len(lidars))


def _of_settings(vio_config: str | None) -> Iterator[Loss]:
    unknown = unknown_keys(vio_config or "")
    if unknown:
        named = ", ".join(unknown)
        yield _loss(f"the vendor's software may stop at settings that are not publicly known: {named}", len(unknown))


def _loss(what: str, count: int = 1) -> Loss:
    return Loss(field=_FIELD, what=what, count=count, support=Support.KEPT)


_NO_FIELD = "left out: the format has none"
_RECORDING_EXTRAS = {"calibration", "lidarInd"}


def _unwritten(
    scene: Scene,
    cameras: Sequence[ShootingSensor],
    trajectories: Sequence[Trajectory],
    imu: ImuSensor | None,
) -> list[Loss]:
    """Name everything of a scene that its recording will not hold.

    Args:
        scene: what is written.
        cameras: those of its cameras that are written.
        trajectories: what is written as trajectories.
        imu: the inertial unit that is written.
    """
    return [
        *_of_root(scene),
        *(loss for sensor in scene.sensors for loss in _of_sensor(sensor)),
        *_of_odometry(scene, trajectories),
        *_unwritten_of_cameras(scene, cameras),
        *_of_repeated(scene, imu),
        *_of_ids(scene, cameras, imu),
        *_of_order(scene, cameras, imu),
        *_of_antennas(scene),
        *_of_default(scene, trajectories),
    ]


def _of_root(scene: Scene) -> Iterator[Loss]:
    counts = {
        "annotations": len(scene.annotations),
        "attributes": len(scene.attributes),
        **{f"metadata.{name}": 1 for name in scene.metadata if name != "recording"},
        **{f"extras.{name}": 1 for name in scene.extras},
    }
    yield from (Loss(field=name, what=_NO_FIELD, count=count) for name, count in counts.items() if count)


def _of_sensor(sensor: Sensor) -> Iterator[Loss]:
    if isinstance(sensor, RadarSensor | PointsSensor | PlainSensor):
        yield Loss(field=f"sensors[{sensor.id}]", what=_NO_FIELD)
        return
    for name in sensor.extras:
        if name not in _RECORDING_EXTRAS:
            yield Loss(field=f"sensors[{sensor.id}].{name}", what=_NO_FIELD)
    if sensor.parent_id is not None:
        yield Loss(field=f"sensors[{sensor.id}].parent_id", what=_NO_FIELD)


def _of_odometry(scene: Scene, trajectories: Sequence[Trajectory]) -> Iterator[Loss]:
    """The format knows no sensors of the ego's own motion, but trajectories."""
    names = {trajectory.name for trajectory in trajectories} - set(scene.trajectories)
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor):
            written = f"written as trajectory {str(sensor.id)!r}"
            if sensor.poses.static:
                written = "left out: the format has no path without end"
            elif str(sensor.id) not in names:
                written = "left out: a trajectory says the same"
            left_out = written.startswith("left out")
            yield Loss(
                field=f"sensors[{sensor.id}]",
                what=written,
                support=Support.DROPPED if left_out else Support.CONVERTED,
            )


def _unwritten_of_cameras(scene: Scene, cameras: Sequence[ShootingSensor]) -> Iterator[Loss]:
    for camera in _shooting_sensors(scene):
        if camera not in cameras:
            yield Loss(field=f"sensors[{camera.id}]", what="left out: it has no images, while other cameras have")


def _of_repeated(scene: Scene, imu: ImuSensor | None) -> Iterator[Loss]:
    for sensor in [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor) and sensor is not imu]:
        yield Loss(field=f"sensors[{sensor.id}]", what=f"left out: the format has one {sensor.type} only")


def _of_ids(scene: Scene, cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    """The ids that reading gives differ from the scene's: the format knows sensors by number only."""
    lidars = scene.lidars
    names: dict[str, Sequence[Sensor]] = {
        "camera": cameras,
        "lidar": lidars,
        "imu": [] if imu is None else [imu],
        "gnss": main_receiver([sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]),
    }
    for name, sensors in names.items():
        for index, sensor in enumerate(sensors):
            numbered = name == "camera" or (name == "lidar" and len(lidars) > 1)
            found = f"{name}{index}" if numbered else name
            if sensor.id != found:
                yield Loss(field=f"sensors[{sensor.id}].id", what=f"read back as {found!r}")


def _of_order(scene: Scene, cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    found = [sensor.id for sensor in (*scene.lidars, *cameras, *([] if imu is None else [imu]), *receivers)]
    if found != [sensor.id for sensor in scene.sensors if sensor.id in found]:
        what = "read back in another order: lidars, cameras, those of depth last, IMU, satellite receivers"
        yield Loss(field="sensors", what=what)


def _of_antennas(scene: Scene) -> Iterator[Loss]:
    """The locations of antennas but that of the one receiver for which the format has a field."""
    found = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    for sensor in found:
        if sensor.mount is not None and sensor not in main_receiver(found):
            yield Loss(field=f"sensors[{sensor.id}].mount", what=_NO_FIELD)


def _of_default(scene: Scene, trajectories: Sequence[Trajectory]) -> Iterator[Loss]:
    default = next(iter(scene.trajectories), None)
    names = [trajectory.name for trajectory in trajectories]
    if default != "groundTruth" and "groundTruth" in names:
        yield Loss(field="trajectories.order", what=f"read back with 'groundTruth' first, not {default!r}")
    for trajectory in trajectories:
        if trajectory.covariances is not None:
            yield Loss(field=f"trajectories.{trajectory.name}.covariances", what=_NO_FIELD)
