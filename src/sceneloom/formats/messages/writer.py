"""A scene as streams of records: sensors, trajectories, annotations, and notes of what messages cannot hold."""

import io
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats.base.loss_list import Losses
from sceneloom.formats.messages.annotations import box_2d_stream, cuboid_stream, keys_of
from sceneloom.formats.messages.cameras import MILLIMETRE, camera_model_record, is_foreign
from sceneloom.formats.messages.points import CloudWriter
from sceneloom.formats.messages.records import (
    CompressedImageRecord,
    Dialect,
    FixRecord,
    ImageRecord,
    PoseRecord,
    SampleRecord,
    Stated,
    Stream,
    TransformRecord,
)
from sceneloom.formats.messages.survey import VERSION, attribute_notes, sayable
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import Annotation, Box2DAnnotation, CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, mounts_of_shots
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.contents import KINDS
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, Trajectory, placed_along
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Coordinates, PointsFrame

_LOCATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Trajectories have covariances of rotation, then location; messages of location, then rotate."""


def _trajectory_of(scene: Scene) -> Poses | None:
    """The ego trajectory by which sensors on it are placed: the default trajectory, if it has orientations."""
    default = next(iter(scene.trajectories.values()), None)
    if default is None or default.quaternions_xyzw is None or len(default.timestamps_ns) == 0:
        return None
    return default.poses


def _trajectory_streams(scene: Scene, dialect: Dialect, losses: Losses) -> tuple[list[Stream], list[dict[str, Any]]]:
    """Report each trajectory on a topic of its own; give the streams and the notes of them."""
    parts = _unique_parts([dialect.part(name) for name in scene.trajectories])
    streams, notes = [], []
    for (name, trajectory), part in zip(scene.trajectories.items(), parts, strict=True):
        topic = f"/trajectories/{part}"
        if len(trajectory.timestamps_ns) == 0:
            losses.dropped("trajectories", f"trajectory {name!r} without a pose")
            continue
        streams.append(Stream(trajectory.timestamps_ns, _poses(topic, trajectory, dialect)))
        notes.append({"name": name, "topic": topic})
        losses.dropped(
            f"trajectories[{name}].file_seconds",
            "timestamps of the source",
            count=trajectory.file_seconds is not None,
        )
        if trajectory.covariances is not None and not (dialect.covariances and trajectory.quaternions_xyzw is not None):
            losses.dropped(f"trajectories[{name}].covariances", "messages of poses have none")
    return streams, notes


def _poses(topic: str, trajectory: Trajectory, dialect: Dialect) -> Callable[[int], Iterator[Stated]]:
    def make(k: int) -> Iterator[Stated]:
        rotation = None if trajectory.quaternions_xyzw is None else trajectory.quaternions_xyzw[k]
        spread = None
        if dialect.covariances and trajectory.covariances is not None:
            spread = trajectory.covariances[k][_LOCATION_FIRST][:, _LOCATION_FIRST]
        timestamp_ns = int(trajectory.timestamps_ns[k])
        yield (
            topic,
            PoseRecord(timestamp_ns, dialect.world, trajectory.positions[k], rotation, dialect.ego, spread),
        )

    return make


def _path_stream(path: Poses, topic: str, parent: str, body: str) -> Stream:
    """Report the poses of a path."""

    def make(k: int) -> Iterator[Stated]:
        timestamp_ns = int(path.timestamps_ns[k])
        yield topic, PoseRecord(timestamp_ns, parent, path.positions[k], path.quaternions_xyzw[k], body)

    return Stream(path.timestamps_ns, make)


_IMAGES = ("copy", "jpeg", "png", "raw")
"""How images are written: files and videos as they are and the rest as JPEG; or all in one form."""

_JPEG_QUALITY = 95
_JPEG_START = b"\xff\xd8\xff"
_MOST_STEPS = 65535


def check_images(images: str) -> None:
    """Refuse an unknown option for images.

    Raises:
        OptionError: it does not.
    """
    if images not in _IMAGES:
        raise OptionError(f"images {images!r}; expected one of {', '.join(_IMAGES)}")


@dataclass(slots=True)
class _ShotWriter:
    """Makes the records of a camera.

    Attributes:
        topic: of its images.
        camera_model_topic: of its camera model.
        frame_id: of the camera.
        field: what the model calls its images, for losses.
        losses: takes what is lost.
        fisheye: the name of OpenCV's fisheye camera model.
        images: one of `_IMAGES`.
        packets: of its video, where that is handed on.
        codec: of the video.
        camera_model: that was stated last.
        each_camera_model: whether each image says its camera model, and not only those whose camera model is another
            than before.
    """

    topic: str
    camera_model_topic: str
    frame_id: str
    field: str
    losses: Losses
    fisheye: str
    images: str = "copy"
    packets: Iterator[bytes] | None = None
    codec: str = ""
    camera_model: Camera | None = None
    each_camera_model: bool = False

    def image(self, sensor: CameraSensor, k: int) -> Iterator[Stated]:
        """Make the records of image `k`."""
        image = sensor.images[k]
        yield from self._camera_model(image.camera, image.timestamp_ns)
        self._note_shot(image)
        encoded = None
        if image.encoded is not None and self.images == "copy":
            encoded = image.encoded()
        if encoded is not None and encoded.startswith(_JPEG_START):
            yield self.topic, self._file(image.timestamp_ns, "jpeg", encoded)
        elif self.images == "raw":
            yield self.topic, self._raw(image.timestamp_ns, "rgb8", image.rgb, image.rgb.shape[1] * 3)
        elif self.images == "png":
            yield self.topic, self._file(image.timestamp_ns, "png", _png(image.rgb))
        else:
            what = f"encoded as JPEG of quality {_JPEG_QUALITY}"
            self.losses.approximated(f"{self.field}.rgb", what)
            yield self.topic, self._file(image.timestamp_ns, "jpeg", _jpeg(image.rgb))

    def packet(self, sensor: CameraSensor, k: int) -> Iterator[Stated]:
        """Make the record of the next packet of the video, which shows image `k`."""
        image = sensor.images[k]
        yield from self._camera_model(image.camera, image.timestamp_ns)
        self._note_shot(image)
        if self.packets is not None:
            content = next(self.packets)
            form = {"hevc": "h265"}.get(self.codec, self.codec)
            yield self.topic, self._file(image.timestamp_ns, form, content)

    def depth(self, sensor: DepthCameraSensor, k: int) -> Iterator[Stated]:
        """Make the records of depth image `k`: whole millimetres where the source has these, else floats."""
        frame = sensor.frames[k]
        yield from self._camera_model(frame.camera, frame.timestamp_ns)
        self._note_shot(frame)
        depth = frame.depth
        steps = np.rint(depth.astype(np.float64) / MILLIMETRE)
        if frame.scale == MILLIMETRE and steps.max(initial=0) <= _MOST_STEPS:
            rows = np.ascontiguousarray(steps.astype("<u2"))
            yield self.topic, self._raw(frame.timestamp_ns, "16UC1", rows, depth.shape[1] * 2)
            return
        self.losses.dropped(
            f"{self.field}.scale", "steps of the source; depths are floats", count=frame.scale is not None
        )
        rows = np.ascontiguousarray(depth, "<f4")
        yield self.topic, self._raw(frame.timestamp_ns, "32FC1", rows, depth.shape[1] * 4)

    def _camera_model(self, camera: Camera, timestamp_ns: int) -> Iterator[Stated]:
        """Report the camera model where it is another one than before."""
        if self.each_camera_model or camera != self.camera_model:
            self.camera_model = camera
            yield (
                self.camera_model_topic,
                camera_model_record(camera, timestamp_ns, self.frame_id, self.fisheye),
            )

    def _note_shot(self, shot: Any) -> None:
        self.losses.dropped(f"{self.field}.extras", "further fields of an image", count=bool(shot.extras))

    def _file(self, timestamp_ns: int, form: str, content: bytes) -> CompressedImageRecord:
        return CompressedImageRecord(timestamp_ns, self.frame_id, form, memoryview(content))

    def _raw(self, timestamp_ns: int, encoding: str, rows: Any, step: int) -> ImageRecord:
        height, width = rows.shape[:2]
        data = memoryview(np.ascontiguousarray(rows).view(np.uint8).reshape(-1))  # type: ignore[arg-type]
        return ImageRecord(timestamp_ns, self.frame_id, encoding, width, height, step, data)


def _jpeg(rgb: UInt8Array) -> bytes:
    from simplejpeg import encode_jpeg

    content: bytes = encode_jpeg(np.ascontiguousarray(rgb), _JPEG_QUALITY, "RGB", "444")
    return content


def _png(rgb: UInt8Array) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "PNG", compress_level=1)
    return file.getvalue()


_SAME_M, _SAME_ROTATION = 1e-9, 1e-9
"""Poses that differ from those along the ego trajectory by no more than rounding are not stated once more."""

_Note = dict[str, Any]


@dataclass(slots=True)
class _SensorStreams:
    """Makes streams and notes of sensors.

    Attributes:
        dialect: the habits of the format.
        trajectory: `world_from_ego`, or None.
        losses: takes what is lost.
        start_ns: when what always holds is stated [ns].
        images: one of `written_images.IMAGES`.
        streams: of all sensors so far.
        mounts: parent and `parent_from_child` of each frame that is fixed.
        paths: parent and path of each frame that moves, but for the ego.
        frames: frame of each sensor by its id with type.
    """

    dialect: Dialect
    trajectory: Poses | None
    losses: Losses
    start_ns: int
    images: str
    streams: list[Stream] = field(default_factory=list)
    mounts: dict[str, tuple[str, RigidTransform]] = field(default_factory=dict)
    paths: dict[str, tuple[str, Poses]] = field(default_factory=dict)
    frames: dict[tuple[type, Any], str] = field(default_factory=dict)

    def add(self, sensor: Sensor, part: str) -> _Note:
        """Make the streams of a sensor, and give its note."""
        frame = f"{part}_sensor" if part in {self.dialect.world, self.dialect.ego} else part
        self.frames[type(sensor.id), sensor.id] = frame
        note: _Note = {"id": sensor.id, "type": str(sensor.type), "part": part, "frame": frame}
        if sensor.parent_id is not None:
            note["parent_id"] = sensor.parent_id
        location = f"sensors.{sensor.type}"
        extras, lost = sayable(getattr(sensor, "extras", {}))
        self.losses.dropped(f"{location}.extras", f"values that JSON cannot state: {', '.join(lost)}", count=len(lost))
        if extras:
            note["extras"] = extras
        _WRITERS[type(sensor)](self, sensor, note)
        return note

    def _posed(self, sensor: Any, note: _Note) -> None:
        """Report where a sensor is: mounted on the ego, along the ego trajectory, or on poses of its own."""
        frame = note["frame"]
        note["coordinates"] = str(sensor.coordinates)
        own = mounts_of_shots(sensor) if isinstance(sensor, CameraSensor | DepthCameraSensor) else None
        if own is not None:
            self._mounted_each(sensor, own, note)
        elif sensor.mount is not None:
            note["mount"] = True
            self.mounts[frame] = (self.dialect.ego, sensor.mount)
        poses: Poses | None = sensor.poses
        if poses is None:
            return
        if self._is_derived(sensor, poses, own):
            note["poses"] = "derived"
            return
        parent = self.dialect.ego if sensor.coordinates is Coordinates.EGO else self.dialect.world
        note["poses"] = f"/{note['part']}/pose"
        note["static"] = poses.static
        self.streams.append(_path_stream(poses, note["poses"], parent, frame))
        if own is not None:
            return
        if sensor.mount is None and poses.static:
            self.mounts[frame] = (
                parent,
                RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0]),
            )
        elif sensor.mount is None:
            self.paths[frame] = (parent, poses)

    def _mounted_each(self, sensor: Any, own: Sequence[RigidTransform | None], note: _Note) -> None:
        """Report where each image of a camera was on the ego: for good if that is the same for all.

        Else at its time.
        """
        kind, frame = f"sensors.{sensor.type}", note["frame"]
        first = own[0]
        if first is not None and all(mount is not None and np.array_equal(mount.matrix, first.matrix) for mount in own):
            note["mount"] = True
            self.mounts[frame] = (self.dialect.ego, first)
            what = "the camera's own mounting, which no image has"
            self.losses.dropped(f"{kind}.mount", what, count=sensor.mount is not None)
            return
        timestamps = frame_times(sensor)
        known = [k for k, mount in enumerate(own) if mount is not None]
        times, rows = np.unique(timestamps[known], return_index=True)
        chosen = [own[known[row]] for row in rows.tolist()]
        positions = np.array([mount.translation for mount in chosen if mount is not None])
        quaternions = np.array([mount.quaternion_xyzw for mount in chosen if mount is not None])
        self.paths[frame] = (self.dialect.ego, Poses(times, positions, quaternions))
        note["mounts"] = "each"
        if sensor.mount is not None:
            note["own_mount"] = [*sensor.mount.translation.tolist(), *sensor.mount.quaternion_xyzw.tolist()]
        what = "mountings of single images, written as transforms at their times"
        name = "images" if isinstance(sensor, CameraSensor) else "frames"
        self.losses.converted(f"{kind}.{name}.mount", what, count=len(known))

    def _is_derived(self, sensor: Any, poses: Poses, own: Sequence[RigidTransform | None] | None = None) -> bool:
        """Whether poses are no more than what the mounting and the ego trajectory state."""
        if sensor.coordinates is not Coordinates.WORLD or poses.static:
            return False
        times = frame_times(sensor)
        mounts = [sensor.mount] * len(times) if own is None else own
        along = placed_along(self.trajectory, mounts, times)
        return (
            along is not None
            and np.array_equal(along.timestamps_ns, poses.timestamps_ns)
            and bool(np.abs(along.positions - poses.positions).max() <= _SAME_M)
            and bool(
                (1 - np.abs((along.quaternions_xyzw * poses.quaternions_xyzw).sum(axis=1))).max() <= _SAME_ROTATION
            )
        )

    def _points_frame(self, sensor: Any, note: _Note) -> str:
        note["points_frame"] = str(sensor.points_frame)
        frames = {PointsFrame.WORLD: self.dialect.world, PointsFrame.EGO: self.dialect.ego}
        return frames.get(sensor.points_frame) or str(note["frame"])

    def add_lidar(self, sensor: LidarSensor, note: _Note) -> None:
        """Write the sweeps of a lidar."""
        self._posed(sensor, note)
        if sensor.model is not None:
            note["model"] = sensor.model
        note["topic"] = f"/{note['part']}/points"
        writer = CloudWriter(
            note["topic"],
            self._points_frame(sensor, note),
            "sensors.lidar.frames",
            self.losses,
            self.dialect.intensity,
        )
        self.streams.append(Stream(sensor.frames.timestamps_ns, lambda k: writer.lidar(sensor, k)))

    def add_radar(self, sensor: RadarSensor, note: _Note) -> None:
        """Write the cycles of a radar."""
        self._posed(sensor, note)
        note["topic"] = f"/{note['part']}/points"
        writer = CloudWriter(note["topic"], self._points_frame(sensor, note), "sensors.radar.frames", self.losses)
        self.streams.append(Stream(sensor.frames.timestamps_ns, lambda k: writer.radar(sensor, k)))

    def add_map(self, sensor: PointsSensor, note: _Note) -> None:
        """Write a map as one cloud."""
        note["topic"] = f"/{note['part']}/points"
        writer = CloudWriter(note["topic"], self.dialect.world, "sensors.points", self.losses)
        times = np.full(1, self.start_ns, np.int64)
        self.streams.append(Stream(times, lambda k: writer.map(sensor, int(times[k]))))

    def _shots(self, sensor: Any, note: _Note, tail: str) -> _ShotWriter:
        self._posed(sensor, note)
        if sensor.fps is not None:
            note["fps"] = sensor.fps
        note["topic"] = f"/{note['part']}/{tail}"
        note["camera_model_topic"] = f"/{note['part']}/{self.dialect.camera_model_topic}"
        note["camera_model"] = _camera_model_text(sensor.camera)
        location = f"sensors.{sensor.type}"
        if is_foreign(sensor.camera):
            what = f"model {sensor.camera.model}, which other programs do not know"
            self.losses.converted(f"{location}.camera", what)
        frames = "images" if isinstance(sensor, CameraSensor) else "frames"
        return _ShotWriter(
            note["topic"], note["camera_model_topic"], note["frame"], f"{location}.{frames}", self.losses,
            self.dialect.fisheye,
            self.images, each_camera_model=self.dialect.each_camera_model,
        )  # fmt: skip

    def add_camera(self, sensor: CameraSensor, note: _Note) -> None:
        """Write the images of a camera: its video packet by packet, or one by one."""
        packets = self._packets(sensor, note)
        if packets is not None:
            writer = self._shots(sensor, note, "video")
            writer.packets, writer.codec = iter(packets), packets.codec
            # packets come in another order than they are shown in, so that no camera model holds until the next one
            writer.each_camera_model |= packets.reordered and any(
                image.camera != sensor.camera for image in sensor.images
            )
            order, times = packets.order, sensor.images.timestamps_ns
            self.streams.append(Stream(times, lambda k: writer.packet(sensor, int(order[k]))))
            return
        tail = "image" if self.images == "raw" else "image/compressed"
        writer = self._shots(sensor, note, tail)
        if sensor.video is not None:
            self.losses.dropped("sensors.camera.video", "written as single images")
        self.streams.append(Stream(sensor.images.timestamps_ns, lambda k: writer.image(sensor, k)))

    def _packets(self, sensor: CameraSensor, note: _Note) -> Any:
        """The packets of a camera's video, if they are to be, and can be, handed on."""
        if sensor.video is None or not self.dialect.videos or self.images != "copy" or not len(sensor.images):
            return None
        from sceneloom.formats.video.remux import AnnexBPackets

        packets = AnnexBPackets(sensor.video, len(sensor.images), f"sensors[{sensor.id}].video")
        if packets.obstacle is not None:
            self.losses.approximated("sensors.camera.video", f"written as single images: {packets.obstacle}")
            return None
        if packets.reordered:
            what = (
                "images that need later ones (B frames) are kept; viewers that follow the schema show none: "
                "`--output-option images=jpeg` encodes each image by itself, and they show it"
            )
            self.losses.converted("sensors.camera.video", what)
        note["codec"] = packets.codec
        return packets

    def add_depth_camera(self, sensor: DepthCameraSensor, note: _Note) -> None:
        """Write the images of a camera that measures depth."""
        writer = self._shots(sensor, note, "depth")
        self.losses.dropped("sensors.depth_camera.video", "written as single images", count=sensor.video is not None)
        self.streams.append(Stream(sensor.frames.timestamps_ns, lambda k: writer.depth(sensor, k)))

    def add_odometry(self, sensor: OdometrySensor, note: _Note) -> None:
        """Write the poses of an odometry sensor."""
        note |= {"topic": f"/{note['part']}/pose", "static": sensor.poses.static}
        self.streams.append(_path_stream(sensor.poses, note["topic"], self.dialect.world, note["frame"]))

    def add_gnss(self, sensor: GnssSensor, note: _Note) -> None:
        """Write the fixes of a satellite receiver."""
        note["topic"] = f"/{note['part']}/fix"
        if sensor.mount is not None:
            note["mount"] = True
            self.mounts[note["frame"]] = (self.dialect.ego, sensor.mount)
        self._drop_seconds("sensors.gnss.file_seconds", sensor.file_seconds)
        self.streams.append(Stream(sensor.timestamps_ns, _fixes(sensor, note["topic"], note["frame"])))

    def add_imu(self, sensor: ImuSensor, note: _Note) -> None:
        """Write the streams of an IMU, those with the same times together."""
        note["streams"] = [*sensor.streams]
        groups: dict[tuple[str, bytes], list[str]] = {}
        for name, samples in sensor.streams.items():
            tail = self.dialect.sample_topics.get(name, self.dialect.sample_topics.get("", ""))
            location = f"sensors.imu.streams.{name}"
            if not tail or len(samples) == 0:
                self.losses.dropped(location, "a stream that there are no messages for, or without a value")
                continue
            groups.setdefault((tail, samples.timestamps_ns.tobytes()), []).append(name)
            self._drop_seconds(f"{location}.file_seconds", samples.file_seconds)
        taken: dict[str, int] = {}
        note["topics"] = []
        for (tail, _), names in groups.items():
            taken[tail] = taken.get(tail, 0) + 1
            topic = f"/{note['part']}/{tail}" if taken[tail] == 1 else f"/{note['part']}/{tail}_{taken[tail]}"
            note["topics"].append(topic)
            times = sensor.streams[names[0]].timestamps_ns
            self.streams.append(Stream(times, _samples(sensor, names, topic, self.dialect.ego)))

    def _drop_seconds(self, field: str, seconds: Any) -> None:
        self.losses.dropped(field, "timestamps of the source", count=seconds is not None)


_WRITERS: Mapping[type[Any], Callable[[_SensorStreams, Any, _Note], None]] = MappingProxyType(
    {
        LidarSensor: _SensorStreams.add_lidar,
        RadarSensor: _SensorStreams.add_radar,
        PointsSensor: _SensorStreams.add_map,
        CameraSensor: _SensorStreams.add_camera,
        DepthCameraSensor: _SensorStreams.add_depth_camera,
        OdometrySensor: _SensorStreams.add_odometry,
        GnssSensor: _SensorStreams.add_gnss,
        ImuSensor: _SensorStreams.add_imu,
    }
)


def _fixes(sensor: GnssSensor, topic: str, frame_id: str) -> Callable[[int], Iterator[Stated]]:
    def make(k: int) -> Iterator[Stated]:
        level, upright = float(sensor.accuracies[k]) ** 2, float(sensor.vertical_accuracies[k]) ** 2
        known = not (np.isnan(level) and np.isnan(upright))
        latitude, longitude, altitude = sensor.positions_lla[k].tolist()
        lla = (latitude, longitude, altitude)
        variances = (level, level, upright) if known else None
        yield topic, FixRecord(int(sensor.timestamps_ns[k]), frame_id, lla, variances)

    return make


def _samples(sensor: ImuSensor, names: list[str], topic: str, frame_id: str) -> Callable[[int], Iterator[Stated]]:
    def make(k: int) -> Iterator[Stated]:
        values = {name: tuple(sensor.streams[name].values[k].tolist()) for name in names}
        yield topic, SampleRecord(int(sensor.streams[names[0]].timestamps_ns[k]), frame_id, values)

    return make


_CUBOIDS_TOPIC = "/cuboids"
_FRAMES_TOPIC, FIXED_FRAMES_TOPIC = "/tf", "/tf_static"


class SceneStreams:
    """What a scene becomes in a log.

    Attributes:
        streams: of all records but the notes.
        notes: what no message has a field for, as JSON will have it.
        losses: what is lost; it grows while the streams are followed.
        start_ns, stop_ns: first and last time of all streams [ns].
    """

    def __init__(self, scene: Scene, dialect: Dialect, *, images: str) -> None:
        """Plan the streams; nothing is read but what is needed to know their times.

        Args:
            scene: the drive.
            dialect: the habits of the format.
            images: one of `written_images.IMAGES`.
        """
        self.losses = Losses()
        self.streams: list[Stream] = []
        self._scene, self._dialect = scene, dialect
        parts = _unique_parts([dialect.part(sensor.id) for sensor in scene.sensors])
        held = [
            (sensor, part)
            for sensor, part in zip(scene.sensors, parts, strict=True)
            if not isinstance(sensor, PlainSensor)
        ]
        plain = len(scene.sensors) - len(held)
        self.losses.dropped("sensors.plain", "sensors of a type that there are no messages for", count=plain)
        self.trajectory = _trajectory_of(scene)
        check_one_ego(scene, self.trajectory)
        start_ns = min((int(times[0]) for times in self._known_times()), default=0)
        sensors = _SensorStreams(dialect, self.trajectory, self.losses, start_ns, images)
        sensor_notes = [sensors.add(sensor, part) for sensor, part in held]
        trajectories, trajectory_notes = _trajectory_streams(scene, dialect, self.losses)
        self.streams += [self._fixed_frames(sensors.mounts, start_ns), *self._moving_frames(sensors)]
        self.streams += [*trajectories, *sensors.streams]
        frames = {"ego": dialect.ego, "world": dialect.world}
        self.notes: dict[str, Any] = {"version": VERSION, "frames": frames, "sensors": sensor_notes}
        self.notes |= {
            "trajectories": trajectory_notes,
            "annotations": self._annotations(sensor_notes, sensors.frames),
        }
        self.notes |= self._free_fields()
        self.streams = [stream for stream in self.streams if len(stream.times_ns)]
        self.start_ns = min((int(stream.times_ns[0]) for stream in self.streams), default=0)
        self.stop_ns = max((int(stream.times_ns[-1]) for stream in self.streams), default=0)

    def _known_times(self) -> Iterator[Int64Array]:
        for sensor in self._scene.sensors:
            times = frame_times(sensor)
            if len(times):
                yield times
        for trajectory in self._scene.trajectories.values():
            if len(trajectory.timestamps_ns):
                yield trajectory.timestamps_ns

    def _fixed_frames(self, mounts: Mapping[str, tuple[str, RigidTransform]], start_ns: int) -> Stream:
        """Where frames are in others for good, stated once, at the beginning."""

        def make(k: int) -> Iterator[Stated]:
            del k
            for child, (parent, transform) in mounts.items():
                yield (
                    FIXED_FRAMES_TOPIC,
                    TransformRecord(
                        start_ns, parent, child, transform.translation, transform.quaternion_xyzw, fixed=True
                    ),
                )

        return Stream(np.full(1 if mounts else 0, start_ns, np.int64), make)

    def _moving_frames(self, sensors: _SensorStreams) -> Iterator[Stream]:
        """The ego trajectory, and of sensors that are on no ego."""
        paths = dict(sensors.paths)
        if self.trajectory is not None:
            paths = {self._dialect.ego: (self._dialect.world, self.trajectory), **paths}
        for child, (parent, path) in paths.items():
            yield Stream(path.timestamps_ns, _transforms(parent, child, path))

    def _annotations(
        self, sensor_notes: Sequence[dict[str, Any]], frames: Mapping[tuple[type, Any], str]
    ) -> list[dict[str, Any]]:
        """Draw the boxes; of all other annotations nothing is held."""
        annotations = self._scene.annotations
        keys = dict(zip((id(annotation) for annotation in annotations), keys_of(annotations), strict=True))
        topics: dict[int, str] = {}
        cuboids = [a for a in annotations if isinstance(a, CuboidAnnotation) and len(a.path.timestamps_ns)]
        if cuboids:
            angles = CuboidAngles.of(self._scene)
            named = [keys[id(annotation)] for annotation in cuboids]
            stream = cuboid_stream(cuboids, named, _CUBOIDS_TOPIC, self._dialect.world, angles)
            self.streams.append(stream)
            topics |= {id(annotation): _CUBOIDS_TOPIC for annotation in cuboids}
            what = "angles become unit quaternions, which do not report whole rotations"
            self.losses.converted("annotations.cuboid.path.values", what, count=len(cuboids))
        by_camera: dict[tuple[type, Any], list[Box2DAnnotation]] = {}
        for annotation in annotations:
            if isinstance(annotation, Box2DAnnotation) and len(annotation.path.timestamps_ns):
                by_camera.setdefault((type(annotation.sensor_id), annotation.sensor_id), []).append(annotation)
        for camera, boxes in by_camera.items():
            note = next((n for n in sensor_notes if (type(n["id"]), n["id"]) == camera), None)
            if note is None:
                continue
            topic = note["boxes_topic"] = f"/{note['part']}/annotations"
            named = [keys[id(annotation)] for annotation in boxes]
            self.streams.append(box_2d_stream(boxes, named, topic, frames[camera]))
            topics |= {id(annotation): topic for annotation in boxes}
        self._note_left_out([a for a in annotations if id(a) not in topics])
        return [
            self._annotation_note(annotation, topics[id(annotation)], keys[id(annotation)])
            for annotation in annotations
            if id(annotation) in topics
        ]

    def _note_left_out(self, annotations: Sequence[Annotation]) -> None:
        for annotation in annotations:
            self.losses.dropped(KINDS[type(annotation)], "annotations that there are no plots for")

    def _annotation_note(self, annotation: Any, topic: str, key: str) -> dict[str, Any]:
        kind = KINDS[type(annotation)]
        attributes, lost = attribute_notes(annotation.attributes)
        self.losses.dropped(f"{kind}.attributes", "values that JSON cannot state", count=lost)
        extras, names = sayable(annotation.extras)
        self.losses.dropped(f"{kind}.extras", "values that JSON cannot state", count=len(names))
        self.losses.dropped(f"{kind}.path.extras", "further fields of a path", count=bool(annotation.path.extras))
        timestamps = annotation.path.timestamps_ns
        repeated = len(timestamps) - len(np.unique(timestamps))
        self.losses.dropped(f"{kind}.path.timestamps_ns", "rows with the time of another one", count=repeated)
        for name in ("activations", "projections"):
            count = len(getattr(annotation, name, ()))
            self.losses.dropped(f"{kind}.{name}", "there are no messages for them", count=count)
        note: dict[str, Any] = {"topic": topic, "key": key, "id": annotation.id}
        reported = {
            "parent_id": annotation.parent_id,
            "label": annotation.label,
            "stationary": annotation.stationary,
        }
        note |= {name: value for name, value in reported.items() if value is not None}
        return note | ({"attributes": attributes} if attributes else {}) | ({"extras": extras} if extras else {})

    def _free_fields(self) -> dict[str, Any]:
        scene, found = self._scene, {}
        for name in ("metadata", "extras"):
            kept, lost = sayable(getattr(scene, name))
            self.losses.dropped(name, f"values that JSON cannot state: {', '.join(lost)}", count=len(lost))
            found[name] = kept
        attributes, count = attribute_notes(scene.attributes)
        self.losses.dropped("attributes", "values that JSON cannot state", count=count)
        metadata = dict(found["metadata"])
        if any(isinstance(annotation, CuboidAnnotation) for annotation in scene.annotations):
            ours = metadata.get("sceneloom")
            metadata["sceneloom"] = {
                **(ours if isinstance(ours, dict) else {}),
                "euler_unit": "degrees",
                "euler_order": "xyz",
            }
        found["metadata"] = metadata
        return {**found, "attributes": attributes, "time_offset_ns": scene.time_offset_ns}


def _transforms(parent: str, child: str, path: Any) -> Callable[[int], Iterator[Stated]]:
    def make(k: int) -> Iterator[Stated]:
        yield (
            _FRAMES_TOPIC,
            TransformRecord(int(path.timestamps_ns[k]), parent, child, path.positions[k], path.quaternions_xyzw[k]),
        )

    return make


def _camera_model_text(camera: Camera) -> str:
    """A camera model as JSON, for notes of ours."""
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
    return json.dumps([camera.model, camera.width, camera.height, numbers, list(camera.coefficients)])


def _unique_parts(parts: Iterable[str]) -> list[str]:
    """The same parts, numbered where one is there twice."""
    taken: Counter[str] = Counter()
    found = []
    for part in parts:
        taken[part] += 1
        found.append(part if taken[part] == 1 else f"{part}_{taken[part]}")
    return found
