"""Sensors, ways and free fields of messages that our own writer wrote, with what it noted beside them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.topics.camera_models import camera_model_from_text
from sceneloom.formats.topics.cameras import CameraDraft
from sceneloom.formats.topics.locations import Locations
from sceneloom.formats.topics.motion import PoseRows, gnss_sensor, imu_sensor, pose_rows
from sceneloom.formats.topics.notes import Notes, attributes_from
from sceneloom.formats.topics.records import FixRecord, Kind, PoseRecord, SampleRecord
from sceneloom.formats.topics.survey import Survey
from sceneloom.formats.topics.sweeps_from_topics import CloudDraft
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import normalise_quaternion
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import ImuSensor, OdometrySensor
from sceneloom.scene.pose_source import placed_along
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import Coordinates, PointsFrame

Note = Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class OwnMounts:
    """Makes the images of a camera with a mounting of its own for each.

    Attributes:
        frames: the images or depth images without.
        mounts: `ego_from_camera` of each, or None.
    """

    frames: LazyFrames[Any]
    mounts: Sequence[RigidTransform | None]

    def __call__(self, k: int) -> Any:
        """Make image `k` without reading it."""
        return replace(self.frames[k], mount=self.mounts[k])


class _Noted:
    """Makes the sensors of notes."""

    def __init__(
        self,
        survey: Survey,
        clouds: Sequence[CloudDraft],
        cameras: Sequence[CameraDraft],
        locations: Locations,
    ) -> None:
        self.survey, self.locations = survey, locations
        self.clouds = {draft.reader.topic.name: draft for draft in clouds}
        self.cameras = {draft.topic.name: draft for draft in cameras}

    def of(self, topic: str, kind: Kind, record_type: type[Any]) -> list[Any]:
        """The records of a topic by its name."""
        return [
            record
            for found in self.survey.topics(kind)
            if found.name == topic
            for record in self.survey.of(found, record_type)
        ]

    def common(self, note: Note) -> dict[str, Any]:
        """Fields of every sensor."""
        fields: dict[str, Any] = {"parent_id": note.get("parent_id")}
        return fields | ({"extras": MappingProxyType(note["extras"])} if note.get("extras") else {})

    def posed(self, note: Note, times_ns: Any) -> dict[str, Any]:
        """Fields of sensors that are somewhere."""
        mount = self.locations.mount(note["frame"]) if note.get("mount") else None
        if "own_mount" in note:
            numbers = np.array(note["own_mount"], np.float64)
            mount = RigidTransform.from_quaternion(numbers[:3], normalise_quaternion(numbers[3:7]))
        fields = self.common(note) | {
            "mount": mount,
            "coordinates": Coordinates(note.get("coordinates", "world")),
        }
        reported = note.get("poses")
        if reported == "derived" and note.get("mounts") == "each":
            mounts = self.locations.mounts_at(note["frame"], times_ns)
            fields["poses"] = placed_along(self.locations.trajectory, mounts, times_ns)
        elif reported == "derived":
            fields["poses"] = self.locations.poses(note["frame"], mount, times_ns)
        elif reported is not None:
            rows = self.rows(reported)
            fields["poses"] = None if rows is None else path_of(rows, static=bool(note.get("static")))
        return fields

    def rows(self, topic: str) -> PoseRows | None:
        return pose_rows(self.survey, topic, self.of(topic, Kind.POSE, PoseRecord))

    def lidar(self, note: Note) -> Sensor:
        frame = {"points_frame": PointsFrame(note["points_frame"]), "model": note.get("model")}
        return self.swept(note, LidarSensor, radar=False, **frame)

    def radar(self, note: Note) -> Sensor:
        return self.swept(note, RadarSensor, radar=True, points_frame=PointsFrame(note["points_frame"]))

    def swept(self, note: Note, sensor_type: type[Any], *, radar: bool, **fields: Any) -> Sensor:
        draft = self.clouds.get(note["topic"])
        if draft is None:
            nothing: LazyFrames[LidarFrame | RadarFrame] = LazyFrames.of([], [])
            made: Sensor = sensor_type(
                note["id"], nothing, **self.posed(note, nothing.timestamps_ns), **fields
            )
            return made
        return draft.sensor(note["id"], radar=radar, **self.posed(note, draft.reader.starts_ns), **fields)

    def cloud_map(self, note: Note) -> Sensor:
        return self.clouds[note["topic"]].points(note["id"], **self.common(note))

    def camera(self, note: Note) -> Sensor:
        draft = self.cameras.get(note["topic"])
        if draft is None:
            kind: type[Any] = CameraSensor if note["type"] == "camera" else DepthCameraSensor
            nothing: LazyFrames[Any] = LazyFrames.of([], [])
            further = self.posed(note, nothing.timestamps_ns) | {"fps": note.get("fps")}
            made: Sensor = kind(note["id"], camera_model_from_text(note["camera_model"]), nothing, **further)
            return made
        times = draft.frames.timestamps_ns
        if note.get("mounts") == "each":
            own = OwnMounts(draft.frames, self.locations.mounts_at(note["frame"], times))
            draft = replace(draft, frames=LazyFrames(times, own))
        return draft.sensor(note["id"], fps=note.get("fps"), **self.posed(note, times))

    def gnss(self, note: Note) -> Sensor:
        mount = self.locations.mount(note["frame"]) if note.get("mount") else None
        fixes = self.of(note["topic"], Kind.FIX, FixRecord)
        location = f"{self.survey.log.name}: {note['topic']}"
        return gnss_sensor(note["id"], fixes, self.survey, location, mount=mount, **self.common(note))

    def imu(self, note: Note) -> Sensor:
        found: dict[str, Any] = {}
        for topic in note["topics"]:
            samples = self.of(topic, Kind.SAMPLE, SampleRecord)
            location = f"{self.survey.log.name}: {topic}"
            found |= imu_sensor(note["id"], samples, self.survey, location).streams
        order = [name for name in note.get("streams", ()) if name in found]
        streams = {name: found[name] for name in (*order, *(name for name in found if name not in order))}
        return ImuSensor(note["id"], MappingProxyType(streams), **self.common(note))

    def odometry(self, note: Note) -> Sensor:
        rows = self.rows(note["topic"])
        if rows is None:
            raise DataError(self.survey.log.name, note["topic"], "no poses; expected those of the odometry")
        return OdometrySensor(note["id"], path_of(rows, static=bool(note.get("static"))), **self.common(note))

    makers: Mapping[str, Callable[["_Noted", Note], Sensor]] = MappingProxyType(
        {
            "lidar": lidar,
            "radar": radar,
            "points": cloud_map,
            "camera": camera,
            "depth_camera": camera,
            "gnss": gnss,
            "imu": imu,
            "odometry": odometry,
        }
    )


def noted_sensors(
    survey: Survey, clouds: Sequence[CloudDraft], cameras: Sequence[CameraDraft], locations: Locations
) -> list[Sensor]:
    """The sensors that notes speak of, in their order.

    Raises:
        DataError: the notes do not fit the messages.
    """
    noted, sensors = _Noted(survey, clouds, cameras, locations), []
    for note in survey.notes.sensors:
        try:
            sensors.append(noted.makers[note["type"]](noted, note))
        except (KeyError, ValueError, TypeError) as error:
            problem = f"note of sensor {note.get('id')!r} does not fit the messages: {error!r}"
            survey.ledger.fault("notes-at-fault", DataError(survey.log.name, "sceneloom.scene", problem))
        except DataError as error:
            survey.ledger.fault("topics-at-fault", error)
    return sensors


def path_of(rows: PoseRows, *, static: bool) -> Poses:
    """The path that rows report; without orientations nothing rotates."""
    quaternions = rows.quaternions_xyzw
    if quaternions is None:
        quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows.timestamps_ns), 1))
    return Poses(rows.timestamps_ns, rows.positions, quaternions, static=static)


def noted_trajectories(survey: Survey) -> dict[str, Trajectory]:
    """The ways that notes speak of, in their order."""
    found = {}
    topics = {topic.name: topic for topic in survey.topics(Kind.POSE)}
    for note in survey.notes.trajectories:
        topic = topics.get(note.get("topic", ""))
        rows = None if topic is None else pose_rows(survey, topic.name, survey.of(topic, PoseRecord))
        if rows is not None:
            name = str(note["name"])
            found[name] = Trajectory(
                name,
                rows.timestamps_ns,
                rows.positions,
                rows.quaternions_xyzw,
                covariances=rows.covariances,
            )
    return found


def noted_scene_fields(notes: Notes, metadata: Mapping[str, Any], form: str) -> dict[str, Any]:
    """Fields of the scene itself."""
    if not notes.ours:
        euler = {"euler_unit": "degrees", "euler_order": "xyz"}
        return {"metadata": MappingProxyType({"sceneloom": euler, form: dict(metadata)})}
    return {
        "metadata": MappingProxyType(notes.root.get("metadata", {})),
        "extras": MappingProxyType(notes.root.get("extras", {})),
        "attributes": attributes_from(notes.root.get("attributes", ())),
        "time_offset_ns": int(notes.root.get("time_offset_ns", 0)),
    }
