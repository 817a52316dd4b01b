"""Sends a drive to a service as its sensors would, or a session log once more.

Sensor ids and calibrations of table 3 first, then records and the ego trajectory in time order, at a rate.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Protocol, Self

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, spread_rows
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import fit
from sceneloom.db34t.protobuf import from_protobuf, path_of, property_of, value_from_protobuf
from sceneloom.db34t.records import CalibrationData, SentRecord, kind_of
from sceneloom.db34t.scene_objects import boxes_2d_record, boxes_3d_record, image_data_of, point_cloud_of
from sceneloom.db34t.setting import CAMERA_MODELS, CalibrationEntry, DeclaredAxes, Property, calibration_data
from sceneloom.db34t.types import Cause, Outcome
from sceneloom.editing.move_world import to_sensor
from sceneloom.errors import CalibrationError, DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_trajectory import find_ego_motion
from sceneloom.pipeline.play import in_time_order
from sceneloom.scene.annotations import Box2DAnnotation, CuboidAnnotation
from sceneloom.scene.annotations_at import BoxTable
from sceneloom.scene.cameras import CameraImage, CameraSensor, Shutter
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.ego import EgoMotion, points_source, sensor_source
from sceneloom.scene.point_times import RawTimes, timed_frame
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns, sweep_period_ns, time_span, usual_period_ns
from sceneloom.scene.types import Identifier, PointsFrame, Progress, reporting
from sceneloom.service.session_log import read_log
from sceneloom.warnings import DataWarning, assumed, skipped

_CAMERA_AXES, _LIDAR_AXES = "+z,+x,-y", "+x,-y,+z"
"""Where forward, right and up point in the frames of a scene: what a session has to be reported."""

_MOST_SENSORS = 256
_LOOKED_AT = 9  # times at which a camera and a lidar without extrinsics are compared


@dataclass(frozen=True, slots=True, eq=False)
class _SentRig:
    """What a session has to know before the first record."""

    scene: Scene
    numbers: Mapping[Identifier, int]
    calibrations: tuple[CalibrationEntry, ...]
    camera_models: Mapping[int, Camera]
    sources: Mapping[Identifier, PoseSource | None]
    at_once: frozenset[Identifier]
    path: Poses | None
    warnings: tuple[DataWarning, ...]


def sent_rig(scene: Scene, *, trajectory: str | None = None, heading: str | None = None) -> _SentRig:
    """Number the sensors of a scene and calibrate each camera with each lidar.

    Args:
        trajectory: the ego trajectory by name, as `fuse` takes it; None for the one that the scene has, if any.
        heading: "motion" to derive orientations where it has positions only.

    Raises:
        DataError: there are no lidars or no cameras, or too many sensors.
        PoseError: it is not known where a sensor is.
    """
    scene = scene.corrected()
    at_once = frozenset(lidar.id for lidar in scene.lidars if lidar.points_frame is PointsFrame.WORLD)
    if at_once:
        scene = to_sensor(scene, trajectory=trajectory, heading=heading)
    lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
    cameras = [camera for camera in scene.cameras if len(camera.images)]
    if not lidars or not cameras:
        problem = f"{len(lidars)} lidars with sweeps, {len(cameras)} cameras with images; expected one of each"
        raise DataError(scene.source, "", problem)
    if len(lidars) + len(cameras) > _MOST_SENSORS:
        raise DataError(scene.source, "", f"more than {_MOST_SENSORS} sensors, as many as a session can number")
    ids = (*(lidar.id for lidar in lidars), *(camera.id for camera in cameras))
    numbers = {sensor_id: number for number, sensor_id in enumerate(ids)}
    ego, warnings = _ego(scene, trajectory, heading)
    reach_ns = scene_period_ns(scene)
    locations = _Locations(scene, ego, reach_ns)
    calibrations: list[CalibrationEntry] = []
    camera_models: dict[int, Camera] = {}
    for camera, lidar in product(cameras, lidars):
        camera_from_points, loose = locations.between(camera, lidar)
        data, camera_model, reported = _table_3(camera, camera_from_points)
        calibrations.append(CalibrationEntry(numbers[camera.id], numbers[lidar.id], data))
        if camera_model is not None:
            camera_models[numbers[camera.id]] = camera_model
        warnings += [*loose, *(reported if lidar is lidars[0] else ())]
    sources = {lidar.id: locations.of_points(lidar) for lidar in lidars}
    path = _path(sources[lidars[0].id])
    return _SentRig(scene, numbers, tuple(calibrations), camera_models, sources, at_once, path, tuple(warnings))


def _table_3(
    camera: CameraSensor, camera_from_points: RigidTransform
) -> tuple[CalibrationData, Camera | None, list[DataWarning]]:
    """The record of a camera; of a camera model that table 3 cannot hold the nearest one, with the model itself."""
    axes = DeclaredAxes.of_words(_CAMERA_AXES), DeclaredAxes.of_words(_LIDAR_AXES)
    model = camera.camera
    try:
        return calibration_data(model, camera_from_points, *axes), None, []
    except CalibrationError:
        pass
    exactly = "the property `camera_models` states it exactly"
    fixed = [name for name in MODELS["brown_conrady"].coefficient_names if name not in ("k1", "k2", "p1", "p2", "k3")]
    try:
        found = fit(model, "brown_conrady", fixed=fixed)
    except CalibrationError as error:
        nearest = replace(model, model="pinhole", coefficients=())
        message = f"a {model.model} camera model, which table 3 cannot hold nearly ({error}); {exactly}"
    else:
        coefficients = found.camera.coefficients
        nearest = replace(found.camera, coefficients=(*coefficients[:5], *[0.0] * (len(coefficients) - 5)))
        message = f"{found.message(model)}, for table 3; {exactly}"
    warning = assumed("camera-model-beyond-table-3", f"sensors[{camera.id}]", message)
    return calibration_data(nearest, camera_from_points, *axes), model, [warning]


def _format_camera_models(camera_models: Mapping[int, Camera]) -> str:
    """Write the value of the property `camera_models`."""
    entries = {
        str(number): {
            "model": camera_model.model,
            "image_size": [camera_model.width, camera_model.height],
            **{name: getattr(camera_model, name) for name in ("fx", "fy", "cx", "cy")},
            "coefficients": list(camera_model.coefficients),
        }
        for number, camera_model in camera_models.items()
    }
    return msgspec.json.encode(entries).decode()


def _format_sensors(rig: _SentRig) -> str:
    """Write the value of the property `sensors`: what shutters roll; empty where none does, as kinds need no saying."""
    shutters = {rig.numbers[camera.id]: Shutter.of(camera) for camera in rig.scene.cameras if camera.id in rig.numbers}
    if not any(shutter.seconds for shutter in shutters.values()):
        return ""
    entries: dict[str, dict[str, Any]] = {str(number): {"kind": "lidar"} for number in rig.numbers.values()}
    for number, shutter in shutters.items():
        entries[str(number)] = {
            "kind": "camera",
            "shutter_roll_s": shutter.seconds,
            "shutter_left_to_right": shutter.over_columns,
        }
    return msgspec.json.encode(entries).decode()


def _ego(scene: Scene, trajectory: str | None, heading: str | None) -> tuple[EgoMotion | None, list[DataWarning]]:
    """The ego trajectory as far as it is known without looking for it."""
    if trajectory is not None:
        return find_ego_motion(scene, name=trajectory, heading=heading), []
    if not scene.trajectories:
        return None, []
    try:
        return find_ego_motion(scene, heading=heading), []
    except PoseError as error:
        message = f"sent without motion: {error}"
        return None, [skipped("motion-unknown", scene.source, message)]


def _path(source: PoseSource | None) -> Poses | None:
    if source is None or source.path.static:
        return None
    times = source.path.timestamps_ns
    poses = source.at(times)
    return Poses(times, poses.positions, poses.quaternions_xyzw)


@dataclass(frozen=True, slots=True)
class _Locations:
    """Where cameras and points of lidars are, one from another."""

    scene: Scene
    ego: EgoMotion | None
    reach_ns: int

    def of_points(self, lidar: LidarSensor) -> PoseSource | None:
        """Takes the points of a lidar into the world; None where that is not known."""
        try:
            return points_source(self.scene, lidar, self.ego, reach_ns=self.reach_ns)
        except PoseError:
            return None

    def between(self, camera: CameraSensor, lidar: LidarSensor) -> tuple[RigidTransform, list[DataWarning]]:
        """`camera_from_points`, by their extrinsics, else by where both were at the same times."""
        # a record of table 3 holds one transform: where the camera moves against the lidar, this is a warning
        ego_from_points = RigidTransform.identity() if lidar.points_frame is PointsFrame.EGO else lidar.mount
        if camera.mount is not None and ego_from_points is not None:
            return camera.mount.inverse() @ ego_from_points, []
        found = list(self._seen(camera, lidar))
        if not found:
            raise PoseError(
                f"{self.scene.source}: camera {camera.id!r} and lidar {lidar.id!r} are at no time where both are known"
            )
        middle = found[len(found) // 2]
        offset = max(float(np.linalg.norm(each.translation - middle.translation)) for each in found)
        rotation = max(np.linalg.norm(each.rotation @ middle.rotation.T - np.eye(3)) / np.sqrt(2) for each in found)
        if offset <= 0.02 and rotation <= 0.005:  # poses of a rigid rig are off by less [m, rad]
            return middle, []
        message = (
            f"it moves against lidar {lidar.id!r} by up to {offset:.3f} m and {np.degrees(rotation):.2f}°; its pose in "
            "the middle of the drive was taken"
        )
        return middle, [assumed("mounting-moves", f"sensors[{camera.id}]", message)]

    def _seen(self, camera: CameraSensor, lidar: LidarSensor) -> Iterator[RigidTransform]:
        of_camera = sensor_source(self.scene, camera, self.ego, reach_ns=self.reach_ns)
        of_points = points_source(self.scene, lidar, self.ego, reach_ns=self.reach_ns)
        if of_points is None:
            return
        times = camera.images.timestamps_ns
        times = times[spread_rows(len(times), _LOOKED_AT, nearest=False)]
        cameras, points = of_camera.at(times), of_points.at(times)
        for k in np.flatnonzero((cameras.coverage < 2) & (points.coverage < 2)):
            world_from_camera = RigidTransform.from_quaternion(cameras.positions[k], cameras.quaternions_xyzw[k])
            world_from_points = RigidTransform.from_quaternion(points.positions[k], points.quaternions_xyzw[k])
            yield world_from_camera.inverse() @ world_from_points


@dataclass(slots=True)
class _Maker:
    """Makes records of frames, and numbers them; cuts the ego trajectory into parts."""

    rig: _SentRig
    shift_ns: int = field(init=False)  # whole seconds that move times before 0, since timestamps cannot state these
    _sent_poses: int = 0
    _seqs: dict[Identifier, int] = field(default_factory=dict)
    _raw_times: dict[Identifier, RawTimes | None] = field(default_factory=dict)
    _tracks: "dict[Identifier, list[_Track]]" = field(default_factory=dict)
    _boxes: BoxTable = field(init=False)
    _lidars: dict[Identifier, LidarSensor] = field(init=False)

    def __post_init__(self) -> None:
        self._boxes = BoxTable(self.rig.scene)
        self._lidars = {lidar.id: lidar for lidar in self.rig.scene.lidars}
        span = time_span(self.rig.scene)
        first_ns = 0 if span is None else span[0]
        if self.rig.path is not None:
            first_ns = min(first_ns, self.rig.path.start_ns)
        self.shift_ns = max(-(first_ns // 1_000_000_000), 0) * 1_000_000_000

    def motion_until(self, timestamp_ns: int) -> Poses | None:
        """The poses that were not sent before, to two periods beyond a time; None where there are none."""
        path = self.rig.path
        if path is None:
            return None
        until_ns = min(timestamp_ns + 2 * scene_period_ns(self.rig.scene), 2**63 - 1)
        stop = int(np.searchsorted(path.timestamps_ns, until_ns, side="right"))
        rows = slice(self._sent_poses, stop)
        if stop <= self._sent_poses:
            return None
        if int(path.timestamps_ns[rows.start]) + self.shift_ns >= 2**63 or self.shift_ns >= 2**63:
            first_ns, most_s = int(path.timestamps_ns[0]), 2**63 / 1e9
            raise OptionError(f"times from {first_ns} ns; messages hold {most_s:.0f} s from the first")
        self._sent_poses = stop
        return Poses(path.timestamps_ns[rows] + self.shift_ns, path.positions[rows], path.quaternions_xyzw[rows])

    def records(self, sensor_id: Identifier, frame: LidarFrame | CameraImage) -> list[SentRecord]:
        """The records of a frame: the frame itself, then the boxes in it."""
        self._seqs[sensor_id] = self._seqs.get(sensor_id, -1) + 1
        numbers: dict[str, Any] = {"sensor_id": self.rig.numbers[sensor_id], "seq": self._seqs[sensor_id]}
        records: list[SentRecord] = []
        if isinstance(frame, LidarFrame):
            if sensor_id in self.rig.at_once:
                frame = replace(frame, points=replace(frame.points, timestamps_ns=None))
            period_ns = sweep_period_ns(self._lidars[sensor_id])
            timed = timed_frame(frame, period_ns, previous=self._raw_times.get(sensor_id))
            self._raw_times[sensor_id] = timed.raw
            records.append(point_cloud_of(_shifted(timed.frame, self.shift_ns), **numbers))
            boxes_3d = self._boxes_3d(sensor_id, frame.timestamp_ns)
            records += [] if boxes_3d is None else [boxes_3d_record(boxes_3d, **numbers)]
        else:
            moved = replace(frame, timestamp_ns=frame.timestamp_ns + self.shift_ns)
            records.append(image_data_of(moved, encoding="rgb8" if frame.encoded is None else "jpeg", **numbers))
            size_wh = frame.camera.width, frame.camera.height
            boxes_2d = self._boxes_2d(sensor_id, frame.timestamp_ns)
            records += [] if boxes_2d is None else [boxes_2d_record(boxes_2d, size_wh=size_wh, **numbers)]
        return records

    def _boxes_3d(self, lidar_id: Identifier, time_ns: int) -> Boxes3D | None:
        """The cuboids of the scene as a detector in the sweep would state them; None where there are none at all."""
        source = self.rig.sources[lidar_id]
        if not self._boxes.annotations or source is None:
            return None
        world_from_points = source.pose_at(time_ns)
        if world_from_points is None:
            return None
        points_from_world = world_from_points.inverse()
        rows, found = self._boxes.find(time_ns, sensor_id=lidar_id)
        headings = points_from_world.rotate(found.rotations_world[:, :, 0])
        return Boxes3D(
            time_ns + self.shift_ns,
            points_from_world.apply(found.centers_world),
            found.sizes_lwh,
            np.arctan2(headings[:, 1], headings[:, 0]),
            np.ones(len(found)),
            tuple(label or "object" for label in found.labels),  # the tables require a class
            ids=rows.astype(np.int64),
        )

    def _tracks_in(self, camera_id: Identifier) -> "list[_Track]":
        """The boxes of a camera's images over time: annotations of their own, and cuboids as it sees them."""
        if camera_id not in self._tracks:
            found: list[_Track] = []
            for row, annotation in enumerate(self.rig.scene.annotations):
                label = getattr(annotation, "label", None) or "object"
                if isinstance(annotation, Box2DAnnotation) and annotation.sensor_id == camera_id:
                    path = annotation.path
                    found.append(_Track(row, label, path.timestamps_ns, path.values, bool(annotation.stationary)))
                elif isinstance(annotation, CuboidAnnotation):
                    found += [
                        _Track(row, label, seen.timestamps_ns, seen.boxes)
                        for seen in annotation.projections
                        if seen.sensor_id == camera_id and seen.boxes is not None
                    ]
            self._tracks[camera_id] = found
        return self._tracks[camera_id]

    def _boxes_2d(self, camera_id: Identifier, time_ns: int) -> Boxes2D | None:
        """The boxes of the scene in an image; None where the scene has none of its camera."""
        tracks = self._tracks_in(camera_id)
        if not tracks:
            return None
        boxes = np.array([track.at(time_ns) for track in tracks])
        there = np.flatnonzero((boxes[:, 2:] > 0).all(axis=1))
        left_top = boxes[there, :2]
        return Boxes2D(
            time_ns + self.shift_ns,
            np.hstack([left_top, left_top + boxes[there, 2:]]),
            np.ones(len(there)),
            tuple(tracks[k].label for k in there),
            ids=np.array([tracks[k].row for k in there], np.int64),
        )


@dataclass(frozen=True, slots=True)
class _Track:
    """One object in the images of a camera."""

    row: int
    label: str
    timestamps_ns: Int64Array  # (N,) [ns]
    boxes: Float64Array  # (N, 4) [px], left, top, width, height; NaN where it is not seen
    always: bool = False

    def at(self, time_ns: int) -> list[float]:
        """Left, top, width, height [px]; all 0 where it is not there or not seen."""
        times = self.timestamps_ns
        if len(times) and (self.always or times[0] <= time_ns <= times[-1]):
            box = [float(np.interp(time_ns, times, self.boxes[:, k])) for k in range(4)]
            if np.isfinite(box).all():
                return box
        return [0.0] * 4


def _shifted(frame: LidarFrame, shift_ns: int) -> LidarFrame:
    times = frame.points.timestamps_ns
    if shift_ns == 0:
        return frame
    points = frame.points if times is None else replace(frame.points, timestamps_ns=times + shift_ns)
    return replace(frame, timestamp_ns=frame.timestamp_ns + shift_ns, points=points)


_WAITS_S = tuple(0.002 * 2**k for k in range(8))
"""How long a sender waits where the session's queue is full, each time anew: half a second in all."""

PATIENCE_MS = 1000
"""How long a session has to wait for what belongs together at least: reading a drive takes its time, and may pause."""


class Receiver(Protocol):
    """What is sent to: a client of the service, or a fusion interface; methods by clause of the standard."""

    def add_property(self, name: str, description: str, type: str) -> Outcome:
        """Clause 5.3."""

    def set_property(self, name: str, value: Any) -> Outcome:
        """Clause 5.4."""

    def get_property(self, name: str) -> Any:
        """Clause 5.5."""

    def set_calibration(self, data: CalibrationData, *, camera_id: int = 0, lidar_id: int = 0) -> Outcome:
        """Table 3."""

    def send_motion(self, path: Poses) -> Outcome:
        """Report where the vehicle was."""

    def send(self, record: SentRecord) -> Outcome:
        """Clause 5.6."""

    def flush(self) -> Any:
        """Fuse what waits."""


@dataclass(frozen=True, slots=True)
class SendReport:
    """What was sent.

    Attributes:
        source: the drive or the log.
        sent: records by kind, and poses as `motion`.
        refused: how many of them were not taken, by cause.
        seconds: how long it took.
        sensors: what number each sensor has in the session.
        warnings: what was assumed or left out.
    """

    source: str
    sent: Mapping[str, int]
    refused: Mapping[str, int]
    seconds: float
    sensors: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[DataWarning, ...] = ()

    @classmethod
    def of(cls, source: str, begun: float, sessions: "Iterable[Statistics]", **more: Any) -> Self:
        """Sum the statistics of sessions that began at `begun`, by the performance counter [s]."""
        sent, refused = Counter[str](), Counter[str]()
        for statistics in sessions:
            sent += statistics.sent
            refused += statistics.refused
        seconds = time.perf_counter() - begun
        return cls(source, dict(sorted(sent.items())), dict(sorted(refused.items())), seconds, **more)


@dataclass(slots=True)
class Pace:
    """Holds records back until they are due.

    Attributes:
        rate: 1 for as fast as it was, 2 for twice as fast, 0 for as fast as possible.
        clock: seconds, never backwards.
        wait: waits for so many seconds.
    """

    rate: float
    clock: Callable[[], float] = time.monotonic
    wait: Callable[[float], None] = time.sleep
    _begun: tuple[float, int] | None = None

    def until(self, time_ns: int) -> None:
        """Return when something of that time is due."""
        if self.rate <= 0:
            return
        if self._begun is None:
            self._begun = self.clock(), time_ns
        begun_s, first_ns = self._begun
        left_s = begun_s + (time_ns - first_ns) / 1e9 / self.rate - self.clock()
        if left_s > 0:
            self.wait(left_s)


@dataclass(slots=True)
class Statistics:
    """Sends records, and counts them and what was refused."""

    receiver: Receiver
    pace: Pace
    sent: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)

    def send(self, record: SentRecord) -> None:
        """Send one record; as fast as possible means as fast as the session has room."""
        outcome = self.receiver.send(record)
        for wait_s in _WAITS_S if self.pace.rate <= 0 else ():
            if outcome.cause is not Cause.QUEUE_FULL:
                break
            self.pace.wait(wait_s)
            outcome = self.receiver.send(record)
        if self.pace.rate <= 0 and outcome.cause is Cause.QUEUE_FULL:
            # what is there waits for partners that do not come
            self.receiver.flush()
            outcome = self.receiver.send(record)
        self.count(kind_of(record).name, outcome)

    def send_motion(self, path: Poses) -> None:
        """Send poses."""
        self.count("motion", self.receiver.send_motion(path), len(path.timestamps_ns))

    def count(self, name: str, outcome: Outcome, number: int = 1) -> None:
        """Count what was sent."""
        self.sent[name] += number
        if not outcome:
            self.refused[str(outcome.cause) or "no-cause"] += number


def send_scene(
    scene: Scene,
    receiver: Receiver,
    *,
    rate: float = 1.0,
    trajectory: str | None = None,
    heading: str | None = None,
    lenient: bool = False,
    progress: Progress | None = None,
    pace: Pace | None = None,
) -> SendReport:
    """Configure a session for the sensors of a scene and send all that they measured, in the order of time.

    Lidars are numbered from 0, then cameras. Sweeps, images, boxes of the scene's annotations and the ego trajectory
    are sent; times before 0 are moved by whole seconds, for a timestamp cannot state them.

    Args:
        rate: 1 for as fast as it was, 2 for twice as fast, 0 for as fast as the session takes it.
        trajectory: the ego trajectory by name; None for the one that the scene has, if any.
        heading: "motion" to derive orientations where it has positions only.
        lenient: pass over frames that cannot be read.
        progress: called after each frame.
        pace: holds records back; None for one of that rate.

    Raises:
        DataError: the scene has no lidar or no camera, or a frame cannot be read.
        PoseError: it is not known where a sensor is.
        OptionError: the session refuses the configuration.
    """
    begun = time.perf_counter()
    rig = sent_rig(scene, trajectory=trajectory, heading=heading)
    statistics = Statistics(receiver, pace or Pace(rate))
    _configure(receiver, rig)
    unread: list[DataWarning] = []
    with _refusing(receiver, statistics.pace.rate):
        _send_frames(rig, statistics, unread if lenient else None, progress)
    receiver.flush()
    numbers = {str(sensor_id): number for sensor_id, number in rig.numbers.items()}
    warnings = (*rig.scene.warnings, *rig.warnings, *unread)
    return SendReport.of(rig.scene.source, begun, [statistics], sensors=numbers, warnings=warnings)


def _send_frames(
    rig: _SentRig, statistics: Statistics, unread: list[DataWarning] | None, progress: Progress | None
) -> None:
    total = sum(len(lidar.frames) for lidar in rig.scene.lidars)
    total += sum(len(camera.images) for camera in rig.scene.cameras)
    maker = _Maker(rig)
    frames = (frame for frame in in_time_order(rig.scene) if frame[1] in rig.numbers)
    for timestamp_ns, sensor_id, read in reporting(frames, progress, total):
        motion = maker.motion_until(timestamp_ns)
        statistics.pace.until(timestamp_ns)
        try:
            records = maker.records(sensor_id, read())
        except DataError as error:
            if unread is None:
                raise
            unread.append(skipped("frame-unreadable", "", str(error)))
            records = []
        if motion is not None:
            statistics.send_motion(motion)
        for record in records:
            statistics.send(record)


def _configure(receiver: Receiver, rig: _SentRig) -> None:
    """Report what the session has to know: frames, how often sensors measure, camera models and where they are."""
    settings: dict[str, Any] = {
        "camera_axes": _CAMERA_AXES,
        "lidar_axes": _LIDAR_AXES,
        "sensors": _format_sensors(rig),
        "lidar_frequency": _frequency(sweep_period_ns(lidar) for lidar in rig.scene.lidars if lidar.id in rig.numbers),
        "camera_frequency": _frequency(
            usual_period_ns(camera.images.timestamps_ns) for camera in rig.scene.cameras if camera.id in rig.numbers
        ),
    }
    fastest = max(settings["lidar_frequency"], settings["camera_frequency"])
    room = math.ceil(1.5 * fastest * PATIENCE_MS / 1e3) + 16  # what comes while others are waited for
    least = {"pairing_timeout_ms": PATIENCE_MS, "queue_length": room}
    settings |= {name: value for name, value in least.items() if receiver.get_property(name) < value}
    if rig.camera_models:
        receiver.add_property(CAMERA_MODELS, "camera models that table 3 cannot state, as JSON by camera_id", "string")
        settings[CAMERA_MODELS] = _format_camera_models(rig.camera_models)
    for name, value in settings.items():
        _must(receiver.set_property(name, value), f"property {name}")
    for entry in rig.calibrations:
        _set_calibration(receiver, entry.data, entry.camera_id, entry.lidar_id)


def _set_calibration(receiver: Receiver, data: CalibrationData, camera_id: int, lidar_id: int) -> None:
    outcome = receiver.set_calibration(data, camera_id=camera_id, lidar_id=lidar_id)
    _must(outcome, f"calibration of camera {camera_id} and lidar {lidar_id}")


def _frequency(periods_ns: Iterable[int]) -> int:
    """Of the slowest sensor of a kind [Hz], at least 1."""
    return max(round(1e9 / max(periods_ns)), 1)


@contextmanager
def _refusing(receiver: Receiver, rate: float) -> Iterator[None]:
    """Let a session refuse what it has no room for, rather than drop it, while records come as fast as they can."""
    if rate > 0:
        yield
        return
    before = receiver.get_property("queue_policy")
    _must(receiver.set_property("queue_policy", "refuse"), "property queue_policy")
    try:
        yield
    finally:
        receiver.set_property("queue_policy", before)


def _must(outcome: Outcome, what: str) -> None:
    """Make an error of what a session refuses and nothing works without."""
    if not outcome:
        raise OptionError(f"the session refuses the {what}: {outcome.cause}: {outcome.reason}")


def send_log(path: str | Path, open_session: Callable[[str], Receiver], *, rate: float = 1.0) -> SendReport:
    """Send what was taken in the sessions of a log, in its order.

    What was refused or dropped is not sent again. Results are the same byte for byte as long as the receiving sessions
    drop nothing and no pause lets them fuse what waits earlier than it was; `replay` excludes both.

    Args:
        open_session: gives what is sent to, by the name of the session in the log.
        rate: 1 for as fast as it came, 2 for twice as fast, 0 for as fast as the sessions take it.

    Raises:
        DataError: the file is no log, or what stands in it is faulty.
        OptionError: a session refuses the configuration.
    """
    begun, pace = time.perf_counter(), Pace(rate)
    sessions: dict[str, _ResentSession] = {}
    for entry in read_log(Path(path)):
        if entry.what not in _RESENT:
            continue
        if entry.session not in sessions:
            sessions[entry.session] = _ResentSession(Statistics(open_session(entry.session), pace))
        pace.until(entry.log_time_ns)
        sessions[entry.session].take(entry.what, entry.message)
    for session in sessions.values():
        session.end()
    return SendReport.of(str(path), begun, [session.statistics for session in sessions.values()])


@dataclass(slots=True)
class _ResentSession:
    """One session of a log that is sent again."""

    statistics: Statistics
    _known: dict[str, Property] = field(default_factory=dict)
    _policy: str | None = None

    def take(self, what: str, message: Any) -> None:
        """Do what an entry says."""
        receiver = self.statistics.receiver
        match what:
            case "properties":
                for found in map(property_of, message.properties):
                    self._set(found)
            case "algorithms":
                # of both types; the type that the log says is set last
                chosen = receiver.get_property(_TYPE)
                for number, name in enumerate(value_from_protobuf(message)):
                    _must(receiver.set_property(_TYPE, number), f"property {_TYPE}")
                    _must(receiver.set_property(_ALGORITHM, name), f"property {_ALGORITHM}")
                _must(receiver.set_property(_TYPE, chosen), f"property {_TYPE}")
            case "calibration":
                data = from_protobuf(message.calibration)
                _set_calibration(receiver, data, message.camera_id, message.lidar_id)
            case "record":
                self.statistics.send(from_protobuf(message))
            case "motion":
                self.statistics.send_motion(path_of(message))
            case "flush":
                receiver.flush()

    def _set(self, found: Property) -> None:
        """Add and set a property if it is not so yet; the algorithms follow by themselves."""
        receiver, known = self.statistics.receiver, self._known.get(found.name)
        if not found.predefined and known is None:
            outcome = receiver.add_property(found.name, found.description, str(found.type))
            if outcome.cause is not Cause.KNOWN_NAME:
                _must(outcome, f"property {found.name}")
        value = found.value
        if found.name == _POLICY and self.statistics.pace.rate <= 0:
            # as fast as possible, what there is no room for is sent again; in the end it is as it was
            self._policy, value = found.value, "refuse"
        if value is not None and found.name != _ALGORITHM:
            before = receiver.get_property(found.name) if known is None else known.value
            if before != value or value == "refuse":
                _must(receiver.set_property(found.name, value), f"property {found.name}")
        self._known[found.name] = found

    def end(self) -> None:
        """Leave the session as the log left it."""
        if self._policy is not None:
            self.statistics.receiver.set_property(_POLICY, self._policy)


_POLICY, _TYPE, _ALGORITHM = "queue_policy", "fusion_type", "fusion_algorithm"

_RESENT = ("properties", "algorithms", "calibration", "record", "motion", "flush")
"""What is sent again of the entries of a log."""
