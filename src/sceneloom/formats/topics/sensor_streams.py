"""The sensors of a scene as streams of records, each with a note of what messages do not state."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.formats.topics.camera_models import camera_model_text, is_foreign
from sceneloom.formats.topics.dialect import Dialect, Losses
from sceneloom.formats.topics.notes import sayable
from sceneloom.formats.topics.records import FixRecord, SampleRecord
from sceneloom.formats.topics.streams import Stated, Stream
from sceneloom.formats.topics.written_images import ShotWriter
from sceneloom.formats.topics.written_points import CloudWriter
from sceneloom.formats.topics.written_trajectories import path_stream
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.pose_source import placed_along
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Sensor
from sceneloom.scene.shooting import mounts_of_shots
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates, PointsFrame

_SAME_M, _SAME_ROTATION = 1e-9, 1e-9
"""Poses that differ from those along the ego trajectory by no more than rounding are not stated once more."""

Note = dict[str, Any]


@dataclass(slots=True)
class SensorStreams:
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

    def add(self, sensor: Sensor, part: str) -> Note:
        """Make the streams of a sensor, and give its note."""
        frame = f"{part}_sensor" if part in {self.dialect.world, self.dialect.ego} else part
        self.frames[type(sensor.id), sensor.id] = frame
        note: Note = {"id": sensor.id, "type": str(sensor.type), "part": part, "frame": frame}
        if sensor.parent_id is not None:
            note["parent_id"] = sensor.parent_id
        location = f"sensors.{sensor.type}"
        extras, lost = sayable(getattr(sensor, "extras", {}))
        self.losses.dropped(
            f"{location}.extras", f"values that JSON cannot state: {', '.join(lost)}", count=len(lost)
        )
        if extras:
            note["extras"] = extras
        _WRITERS[type(sensor)](self, sensor, note)
        return note

    def _posed(self, sensor: Any, note: Note) -> None:
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
        self.streams.append(path_stream(poses, note["poses"], parent, frame))
        if own is not None:
            return
        if sensor.mount is None and poses.static:
            self.mounts[frame] = (
                parent,
                RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0]),
            )
        elif sensor.mount is None:
            self.paths[frame] = (parent, poses)

    def _mounted_each(self, sensor: Any, own: Sequence[RigidTransform | None], note: Note) -> None:
        """Report where each image of a camera was on the ego: for good if that is the same for all.

        Else at its time.
        """
        kind, frame = f"sensors.{sensor.type}", note["frame"]
        first = own[0]
        if first is not None and all(
            mount is not None and np.array_equal(mount.matrix, first.matrix) for mount in own
        ):
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

    def _is_derived(
        self, sensor: Any, poses: Poses, own: Sequence[RigidTransform | None] | None = None
    ) -> bool:
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
                (1 - np.abs((along.quaternions_xyzw * poses.quaternions_xyzw).sum(axis=1))).max()
                <= _SAME_ROTATION
            )
        )

    def _points_frame(self, sensor: Any, note: Note) -> str:
        note["points_frame"] = str(sensor.points_frame)
        frames = {PointsFrame.WORLD: self.dialect.world, PointsFrame.EGO: self.dialect.ego}
        return frames.get(sensor.points_frame) or str(note["frame"])

    def add_lidar(self, sensor: LidarSensor, note: Note) -> None:
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

    def add_radar(self, sensor: RadarSensor, note: Note) -> None:
        """Write the cycles of a radar."""
        self._posed(sensor, note)
        note["topic"] = f"/{note['part']}/points"
        writer = CloudWriter(
            note["topic"], self._points_frame(sensor, note), "sensors.radar.frames", self.losses
        )
        self.streams.append(Stream(sensor.frames.timestamps_ns, lambda k: writer.radar(sensor, k)))

    def add_map(self, sensor: PointsSensor, note: Note) -> None:
        """Write a map as one cloud."""
        note["topic"] = f"/{note['part']}/points"
        writer = CloudWriter(note["topic"], self.dialect.world, "sensors.points", self.losses)
        times = np.full(1, self.start_ns, np.int64)
        self.streams.append(Stream(times, lambda k: writer.map(sensor, int(times[k]))))

    def _shots(self, sensor: Any, note: Note, tail: str) -> ShotWriter:
        self._posed(sensor, note)
        if sensor.fps is not None:
            note["fps"] = sensor.fps
        note["topic"] = f"/{note['part']}/{tail}"
        note["camera_model_topic"] = f"/{note['part']}/{self.dialect.camera_model_topic}"
        note["camera_model"] = camera_model_text(sensor.camera)
        location = f"sensors.{sensor.type}"
        if is_foreign(sensor.camera):
            what = f"model {sensor.camera.model}, which other programs do not know"
            self.losses.converted(f"{location}.camera", what)
        frames = "images" if isinstance(sensor, CameraSensor) else "frames"
        return ShotWriter(
            note["topic"], note["camera_model_topic"], note["frame"], f"{location}.{frames}", self.losses, self.dialect.fisheye,
            self.images, each_camera_model=self.dialect.each_camera_model,
        )  # fmt: skip

    def add_camera(self, sensor: CameraSensor, note: Note) -> None:
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

    def _packets(self, sensor: CameraSensor, note: Note) -> Any:
        """The packets of a camera's video, if they are to be, and can be, handed on."""
        if sensor.video is None or not self.dialect.videos or self.images != "copy" or not len(sensor.images):
            return None
        from sceneloom.formats.topics.video_packets import AnnexBPackets

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

    def add_depth_camera(self, sensor: DepthCameraSensor, note: Note) -> None:
        """Write the images of a camera that measures depth."""
        writer = self._shots(sensor, note, "depth")
        self.losses.dropped(
            "sensors.depth_camera.video", "written as single images", count=sensor.video is not None
        )
        self.streams.append(Stream(sensor.frames.timestamps_ns, lambda k: writer.depth(sensor, k)))

    def add_odometry(self, sensor: OdometrySensor, note: Note) -> None:
        """Write the poses of an odometry sensor."""
        note |= {"topic": f"/{note['part']}/pose", "static": sensor.poses.static}
        self.streams.append(path_stream(sensor.poses, note["topic"], self.dialect.world, note["frame"]))

    def add_gnss(self, sensor: GnssSensor, note: Note) -> None:
        """Write the fixes of a satellite receiver."""
        note["topic"] = f"/{note['part']}/fix"
        if sensor.mount is not None:
            note["mount"] = True
            self.mounts[note["frame"]] = (self.dialect.ego, sensor.mount)
        self._drop_seconds("sensors.gnss.file_seconds", sensor.file_seconds)
        self.streams.append(Stream(sensor.timestamps_ns, _fixes(sensor, note["topic"], note["frame"])))

    def add_imu(self, sensor: ImuSensor, note: Note) -> None:
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


_WRITERS: Mapping[type[Any], Callable[[SensorStreams, Any, Note], None]] = MappingProxyType(
    {
        LidarSensor: SensorStreams.add_lidar,
        RadarSensor: SensorStreams.add_radar,
        PointsSensor: SensorStreams.add_map,
        CameraSensor: SensorStreams.add_camera,
        DepthCameraSensor: SensorStreams.add_depth_camera,
        OdometrySensor: SensorStreams.add_odometry,
        GnssSensor: SensorStreams.add_gnss,
        ImuSensor: SensorStreams.add_imu,
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


def _samples(
    sensor: ImuSensor, names: list[str], topic: str, frame_id: str
) -> Callable[[int], Iterator[Stated]]:
    def make(k: int) -> Iterator[Stated]:
        values = {name: tuple(sensor.streams[name].values[k].tolist()) for name in names}
        yield topic, SampleRecord(int(sensor.streams[names[0]].timestamps_ns[k]), frame_id, values)

    return make
