"""A log of messages as a scene: topics become sensors, frames become mountings and the ego trajectory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.topics.annotations_from_topics import read_annotations
from sceneloom.formats.topics.cameras import CameraDraft, camera_model_topic_of, draft_camera
from sceneloom.formats.topics.frames import FrameTree
from sceneloom.formats.topics.locations import Locations
from sceneloom.formats.topics.log import TopicLog
from sceneloom.formats.topics.motion import gnss_sensor, imu_sensor, pose_rows, trajectory
from sceneloom.formats.topics.names import sensor_names
from sceneloom.formats.topics.noted import noted_scene_fields, noted_sensors, noted_trajectories
from sceneloom.formats.topics.records import (
    FixRecord,
    Kind,
    PoseRecord,
    SampleRecord,
    TransformRecord,
)
from sceneloom.formats.topics.roles import choose_roles
from sceneloom.formats.topics.survey import Survey, survey
from sceneloom.formats.topics.sweeps_from_topics import CloudDraft, draft_cloud
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.warnings import WarningKind

IMAGE_KINDS = (Kind.IMAGE, Kind.COMPRESSED_IMAGE, Kind.VIDEO)
FROM_FRAMES = "tf"
"""Name of the ego trajectory that the transforms report."""


@dataclass(slots=True)
class Drafts:
    """What the topics of a log are, before it is known where."""

    clouds: list[CloudDraft] = field(default_factory=list)
    cameras: list[CameraDraft] = field(default_factory=list)

    @property
    def frames(self) -> list[str]:
        """The frames of all of them."""
        return [*(draft.frame_id for draft in self.clouds), *(draft.frame_id for draft in self.cameras)]

    def close(self) -> None:
        """Release the videos."""
        for camera in self.cameras:
            if camera.video is not None:
                camera.video.close()


@dataclass(frozen=True, slots=True, eq=False)
class CloseLog:
    """Closes what a scene is read from."""

    log: TopicLog
    drafts: Drafts

    def __call__(self) -> None:
        """Close all."""
        self.drafts.close()
        self.log.close()


def scene_from_topics(
    log: TopicLog,
    ledger: Ledger,
    *,
    form: str,
    metadata: Mapping[str, Any],
    timestamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
) -> Scene:
    """Make a scene of a log.

    Args:
        log: the messages; closed with the scene, or here if it cannot be made.
        ledger: takes warnings and faults.
        form: name of the format.
        metadata: what the file says of itself.
        timestamps: which times of messages count, "header" or "receive".
        ego, world: frames that are to be these.

    Raises:
        DataError: a message is wrong.
        OptionError: a frame that was chosen is not there.
    """
    drafts = Drafts()
    closing = CloseLog(log, drafts)
    try:
        found = survey(log, ledger, timestamps=timestamps)
        _draft_all(found, drafts)
        locations, trajectories = _location(found, drafts, ego=ego, world=world)
        sensors = noted_sensors(found, drafts.clouds, drafts.cameras, locations)
        cameras = {
            note["topic"]: note["id"]
            for note in found.notes.sensors
            if note.get("type") == "camera" and {"topic", "id"} <= note.keys()
        }
        sensors += _foreign_sensors(found, drafts, locations, {sensor.id for sensor in sensors}, cameras)
        annotations = read_annotations(found, locations, cameras)
        fields = noted_scene_fields(found.notes, metadata, form)
    except BaseException:
        closing()
        raise
    return Scene(
        sensors=tuple(sensors),
        annotations=tuple(annotations),
        trajectories=MappingProxyType(trajectories),
        source=log.name,
        format=form,
        warnings=ledger.warnings,
        on_close=closing,
        **fields,
    )


def _draft_all(found: Survey, drafts: Drafts) -> None:
    """Look at the first message of each topic of large ones."""
    camera_model_topics = found.topics(Kind.CAMERA_MODEL)
    noted = {note["topic"]: note.get("camera_model_topic") for note in found.notes.sensors if "topic" in note}
    for topic in found.topics(Kind.CLOUD, *IMAGE_KINDS):
        try:
            if topic.kind is Kind.CLOUD:
                drafts.clouds.append(draft_cloud(found, topic))
                continue
            camera_model = camera_model_topic_of(topic, camera_model_topics)
            if topic.name in noted:
                camera_model = next(
                    (other for other in camera_model_topics if other.name == noted[topic.name]), None
                )
            drafts.cameras.append(draft_camera(found, topic, camera_model))
        except UnknownFormatError as error:
            location = f"{found.log.name}: {topic.name}"
            message = f"images that are not read: {error.problem}"
            found.ledger.note(WarningKind.SKIPPED, "unknown-images", location, message, count=topic.count)
        except DataError as error:
            found.ledger.fault("topics-at-fault", error, count=topic.count)


def _location(
    found: Survey, drafts: Drafts, *, ego: str | None, world: str | None
) -> tuple[Locations, dict[str, Trajectory]]:
    """Find the frames, and the trajectories of the ego."""
    log, ledger, noted = found.log, found.ledger, found.notes.root.get("frames", {})
    tree = FrameTree(found.all_of(Kind.TRANSFORM, TransformRecord), log.name)
    _note_tree(tree, log.name, ledger)
    frames = set(tree.frames)
    chosen = {
        role: stated or (noted.get(role) if noted.get(role) in frames else None)
        for role, stated in (("ego", ego), ("world", world))
    }
    quiet = Ledger(lenient=True) if found.notes.ours else ledger
    small = [record.frame_id for kind, of in _SMALL for record in found.all_of(kind, of)]
    wanted = [*drafts.frames, *dict.fromkeys(small)]
    roles = choose_roles(
        tree, wanted, ego=chosen["ego"], world=chosen["world"], location=log.name, ledger=quiet
    )
    locations = Locations(tree, roles, None)
    trajectories = noted_trajectories(found)
    if not found.notes.ours:
        trajectories = _foreign_trajectories(found, locations)
        loose = sorted({frame for frame in drafts.frames if frame not in frames})
        if loose:
            message = (
                f"frames {', '.join(map(repr, loose))} are in no transform, so their sensors are not placed"
            )
            ledger.note(WarningKind.SKIPPED, "frames-missing", log.name, message, count=len(loose))
    trajectory = next(iter(trajectories.values()), None)
    if trajectory is not None and trajectory.quaternions_xyzw is None:
        message = f"trajectory {trajectory.name!r} holds positions without orientations, so the sensors have no poses"
        ledger.note(WarningKind.SKIPPED, "orientations-missing", log.name, message)
        trajectory = None
    return Locations(tree, roles, None if trajectory is None else trajectory.poses), trajectories


_SMALL: Sequence[tuple[Kind, Any]] = ((Kind.FIX, FixRecord), (Kind.SAMPLE, SampleRecord))


def _note_tree(tree: FrameTree, name: str, ledger: Ledger) -> None:
    if tree.repeated:
        message = "transforms with the time of another one of their frame; the first counts"
        ledger.note(WarningKind.SKIPPED, "repeated-transforms", name, message, count=tree.repeated)
    if tree.other_parents:
        message = "transforms of a frame that another parent was named for before"
        ledger.note(WarningKind.SKIPPED, "other-parents", name, message, count=tree.other_parents)


def _foreign_trajectories(found: Survey, locations: Locations) -> dict[str, Trajectory]:
    """The trajectory that the transforms report, then those of topics of poses."""
    trajectories = {}
    ego, world = locations.roles.ego, locations.roles.world
    if ego is not None and world is not None:
        path = locations.tree.path(world, ego)
        if path is not None:
            trajectories[FROM_FRAMES] = Trajectory(
                FROM_FRAMES, path.timestamps_ns, path.positions, path.quaternions_xyzw
            )
    topics = found.topics(Kind.POSE)
    for topic, name in zip(topics, sensor_names([topic.name for topic in topics]), strict=True):
        rows = pose_rows(found, topic.name, found.of(topic, PoseRecord))
        if rows is not None:
            called = f"{name}~" if name in RESERVED_NAMES or name in trajectories else name
            trajectories[called] = trajectory(called, rows, locations, found)
    return trajectories


RESERVED_NAMES = frozenset({"gnss", "lidar", "identity"})
"""Names of trajectories that are computed."""


def _foreign_sensors(
    found: Survey, drafts: Drafts, locations: Locations, taken: set[Any], camera_ids: dict[str, Any]
) -> list[Sensor]:
    """The sensors that no note of ours speaks of; the ids of cameras are noted down by their topics."""
    noted = {name for note in found.notes.sensors for name in _topics_of(note)}
    topics = [
        topic
        for topic in found.topics(Kind.CLOUD, *IMAGE_KINDS, Kind.SAMPLE, Kind.FIX)
        if topic.name not in noted
    ]
    clouds = {draft.reader.topic.number: draft for draft in drafts.clouds}
    cameras = {draft.topic.number: draft for draft in drafts.cameras}
    sensors: list[Sensor] = []
    for topic, name in zip(topics, sensor_names([topic.name for topic in topics]), strict=True):
        identifier = f"{name}~" if name in taken else name
        location = f"{found.log.name}: {topic.name}"
        if topic.number in clouds:
            sensors.append(clouds[topic.number].placed(identifier, locations))
        elif topic.number in cameras:
            draft = cameras[topic.number]
            mount = locations.mount(draft.frame_id)
            poses = locations.poses(draft.frame_id, mount, draft.frames.timestamps_ns)
            sensors.append(draft.sensor(identifier, mount=mount, poses=poses))
            if not draft.is_depth:
                camera_ids[topic.name] = identifier
        elif topic.kind is Kind.FIX:
            fixes = found.of(topic, FixRecord)
            mount = locations.mount(fixes[0].frame_id) if fixes else None
            sensors.append(gnss_sensor(identifier, fixes, found, location, mount=mount))
        elif topic.kind is Kind.SAMPLE:
            samples = found.of(topic, SampleRecord)
            rotation = locations.mount(samples[0].frame_id) if samples else None
            sensors.append(imu_sensor(identifier, samples, found, location, rotation))
    return sensors


def _topics_of(note: Mapping[str, Any]) -> list[str]:
    return [note["topic"]] if "topic" in note else list(note.get("topics", ()))
