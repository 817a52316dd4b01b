"""A scene as streams of records: what its sensors measured, where they were, what was stated; and notes of the rest."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.topics.dialect import Dialect, Losses
from sceneloom.formats.topics.names import unique_parts
from sceneloom.formats.topics.notes import VERSION, attribute_notes, sayable
from sceneloom.formats.topics.records import TransformRecord
from sceneloom.formats.topics.sensor_streams import SensorStreams
from sceneloom.formats.topics.streams import Stated, Stream
from sceneloom.formats.topics.written_boxes import box_2d_stream, cuboid_stream, keys_of
from sceneloom.formats.topics.written_trajectories import trajectory_of, trajectory_streams
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.contents import KINDS
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import check_one_ego
from sceneloom.scene.span import frame_times

CUBOIDS_TOPIC = "/cuboids"
FRAMES_TOPIC, FIXED_FRAMES_TOPIC = "/tf", "/tf_static"


class SceneStreams:
    """What a scene becomes in a log.

    Attributes:
        streams: of all records but the notes.
        notes: what no message has a location for, as JSON will have it.
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
        parts = unique_parts([dialect.part(sensor.id) for sensor in scene.sensors])
        held = [
            (sensor, part)
            for sensor, part in zip(scene.sensors, parts, strict=True)
            if not isinstance(sensor, PlainSensor)
        ]
        plain = len(scene.sensors) - len(held)
        self.losses.dropped("sensors.plain", "sensors of a type that there are no messages for", count=plain)
        self.trajectory = trajectory_of(scene)
        check_one_ego(scene, self.trajectory)
        start_ns = min((int(times[0]) for times in self._known_times()), default=0)
        sensors = SensorStreams(dialect, self.trajectory, self.losses, start_ns, images)
        sensor_notes = [sensors.add(sensor, part) for sensor, part in held]
        trajectories, trajectory_notes = trajectory_streams(scene, dialect, self.losses)
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

    def _moving_frames(self, sensors: SensorStreams) -> Iterator[Stream]:
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
            stream = cuboid_stream(cuboids, named, CUBOIDS_TOPIC, self._dialect.world, angles)
            self.streams.append(stream)
            topics |= {id(annotation): CUBOIDS_TOPIC for annotation in cuboids}
            what = "angles become unit quaternions, which do not report whole rotations"
            self.losses.converted("annotations.cuboid.path.values", what, count=len(cuboids))
        by_camera: dict[tuple[type, Any], list[Box2DAnnotation]] = {}
        for annotation in annotations:
            if isinstance(annotation, Box2DAnnotation) and len(annotation.path.timestamps_ns):
                by_camera.setdefault((type(annotation.sensor_id), annotation.sensor_id), []).append(
                    annotation
                )
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
        self.losses.dropped(
            f"{kind}.path.extras", "further fields of a path", count=bool(annotation.path.extras)
        )
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
        return (
            note | ({"attributes": attributes} if attributes else {}) | ({"extras": extras} if extras else {})
        )

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
            FRAMES_TOPIC,
            TransformRecord(
                int(path.timestamps_ns[k]), parent, child, path.positions[k], path.quaternions_xyzw[k]
            ),
        )

    return make
