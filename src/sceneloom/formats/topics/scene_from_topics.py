"""A log of messages as a scene: topics become sensors, frames become mountings and the way of the ego."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.topics.annotations_from_topics import read_annotations
from sceneloom.formats.topics.cameras import CameraDraft, draft_camera, lens_topic_of
from sceneloom.formats.topics.frames import FrameTree
from sceneloom.formats.topics.log import TopicLog
from sceneloom.formats.topics.motion import gnss_sensor, imu_sensor, pose_rows, trajectory
from sceneloom.formats.topics.names import sensor_names
from sceneloom.formats.topics.noted import noted_scene_fields, noted_sensors, noted_trajectories
from sceneloom.formats.topics.places import Places
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
from sceneloom.scene.notices import NoticeKind
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor

PICTURE_KINDS = (Kind.IMAGE, Kind.PICTURE, Kind.VIDEO)
FROM_FRAMES = "tf"
"""Name of the way of the ego that the transforms tell."""


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
    stamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
) -> Scene:
    """Make a scene of a log.

    Args:
        log: the messages; closed with the scene, or here if it cannot be made.
        ledger: takes notices and faults.
        form: name of the format.
        metadata: what the file says of itself.
        stamps: which times of messages count, "header" or "receive".
        ego, world: frames that are to be these.

    Raises:
        DataError: a message is wrong.
        OptionError: a frame that was chosen is not there.
    """
    drafts = Drafts()
    closing = CloseLog(log, drafts)
    try:
        found = survey(log, ledger, stamps=stamps)
        _draft_all(found, drafts)
        places, trajectories = _place(found, drafts, ego=ego, world=world)
        sensors = noted_sensors(found, drafts.clouds, drafts.cameras, places)
        cameras = {
            note["topic"]: note["id"]
            for note in found.notes.sensors
            if note.get("type") == "camera" and {"topic", "id"} <= note.keys()
        }
        sensors += _foreign_sensors(found, drafts, places, {sensor.id for sensor in sensors}, cameras)
        annotations = read_annotations(found, places, cameras)
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
        notices=ledger.notices,
        on_close=closing,
        **fields,
    )


def _draft_all(found: Survey, drafts: Drafts) -> None:
    """Look at the first message of each topic of large ones."""
    lens_topics = found.topics(Kind.LENS)
    noted = {note["topic"]: note.get("lens_topic") for note in found.notes.sensors if "topic" in note}
    for topic in found.topics(Kind.CLOUD, *PICTURE_KINDS):
        try:
            if topic.kind is Kind.CLOUD:
                drafts.clouds.append(draft_cloud(found, topic))
                continue
            lens = lens_topic_of(topic, lens_topics)
            if topic.name in noted:
                lens = next((other for other in lens_topics if other.name == noted[topic.name]), None)
            drafts.cameras.append(draft_camera(found, topic, lens))
        except UnknownFormatError as error:
            place = f"{found.log.name}: {topic.name}"
            message = f"pictures that are not read: {error.problem}"
            found.ledger.note(NoticeKind.SKIPPED, "unknown-pictures", place, message, count=topic.count)
        except DataError as error:
            found.ledger.fault("topics-at-fault", error, count=topic.count)


def _place(
    found: Survey, drafts: Drafts, *, ego: str | None, world: str | None
) -> tuple[Places, dict[str, Trajectory]]:
    """Find the frames, and the ways of the ego."""
    log, ledger, noted = found.log, found.ledger, found.notes.root.get("frames", {})
    tree = FrameTree(found.all_of(Kind.TRANSFORM, TransformRecord), log.name)
    _note_tree(tree, log.name, ledger)
    frames = set(tree.frames)
    chosen = {
        role: said or (noted.get(role) if noted.get(role) in frames else None)
        for role, said in (("ego", ego), ("world", world))
    }
    quiet = Ledger(lenient=True) if found.notes.ours else ledger
    small = [record.frame_id for kind, of in _SMALL for record in found.all_of(kind, of)]
    wanted = [*drafts.frames, *dict.fromkeys(small)]
    roles = choose_roles(tree, wanted, ego=chosen["ego"], world=chosen["world"], place=log.name, ledger=quiet)
    places = Places(tree, roles, None)
    trajectories = noted_trajectories(found)
    if not found.notes.ours:
        trajectories = _foreign_trajectories(found, places)
        loose = sorted({frame for frame in drafts.frames if frame not in frames})
        if loose:
            message = (
                f"frames {', '.join(map(repr, loose))} are in no transform, so their sensors are not placed"
            )
            ledger.note(NoticeKind.SKIPPED, "frames-missing", log.name, message, count=len(loose))
    way = next(iter(trajectories.values()), None)
    if way is not None and way.quaternions_xyzw is None:
        message = (
            f"trajectory {way.name!r} holds positions without orientations, so the sensors have no poses"
        )
        ledger.note(NoticeKind.SKIPPED, "orientations-missing", log.name, message)
        way = None
    return Places(tree, roles, None if way is None else way.poses), trajectories


_SMALL: Sequence[tuple[Kind, Any]] = ((Kind.FIX, FixRecord), (Kind.SAMPLE, SampleRecord))


def _note_tree(tree: FrameTree, name: str, ledger: Ledger) -> None:
    if tree.repeated:
        message = "transforms with the time of another one of their frame; the first counts"
        ledger.note(NoticeKind.SKIPPED, "repeated-transforms", name, message, count=tree.repeated)
    if tree.other_parents:
        message = "transforms of a frame that another parent was named for before"
        ledger.note(NoticeKind.SKIPPED, "other-parents", name, message, count=tree.other_parents)


def _foreign_trajectories(found: Survey, places: Places) -> dict[str, Trajectory]:
    """The way that the transforms tell, then those of topics of poses."""
    trajectories = {}
    ego, world = places.roles.ego, places.roles.world
    if ego is not None and world is not None:
        path = places.tree.path(world, ego)
        if path is not None:
            trajectories[FROM_FRAMES] = Trajectory(
                FROM_FRAMES, path.timestamps_ns, path.positions, path.quaternions_xyzw
            )
    topics = found.topics(Kind.POSE)
    for topic, name in zip(topics, sensor_names([topic.name for topic in topics]), strict=True):
        rows = pose_rows(found, topic.name, found.of(topic, PoseRecord))
        if rows is not None:
            called = f"{name}~" if name in RESERVED_NAMES or name in trajectories else name
            trajectories[called] = trajectory(called, rows, places, found)
    return trajectories


RESERVED_NAMES = frozenset({"gnss", "lidar", "identity"})
"""Names of ways that are computed."""


def _foreign_sensors(
    found: Survey, drafts: Drafts, places: Places, taken: set[Any], camera_ids: dict[str, Any]
) -> list[Sensor]:
    """The sensors that no note of ours speaks of; the ids of cameras are noted down by their topics."""
    noted = {name for note in found.notes.sensors for name in _topics_of(note)}
    topics = [
        topic
        for topic in found.topics(Kind.CLOUD, *PICTURE_KINDS, Kind.SAMPLE, Kind.FIX)
        if topic.name not in noted
    ]
    clouds = {draft.reader.topic.number: draft for draft in drafts.clouds}
    cameras = {draft.topic.number: draft for draft in drafts.cameras}
    sensors: list[Sensor] = []
    for topic, name in zip(topics, sensor_names([topic.name for topic in topics]), strict=True):
        identifier = f"{name}~" if name in taken else name
        place = f"{found.log.name}: {topic.name}"
        if topic.number in clouds:
            sensors.append(clouds[topic.number].placed(identifier, places))
        elif topic.number in cameras:
            draft = cameras[topic.number]
            mount = places.mount(draft.frame_id)
            poses = places.poses(draft.frame_id, mount, draft.frames.timestamps_ns)
            sensors.append(draft.sensor(identifier, mount=mount, poses=poses))
            if not draft.is_depth:
                camera_ids[topic.name] = identifier
        elif topic.kind is Kind.FIX:
            fixes = found.of(topic, FixRecord)
            mount = places.mount(fixes[0].frame_id) if fixes else None
            sensors.append(gnss_sensor(identifier, fixes, found, place, mount=mount))
        elif topic.kind is Kind.SAMPLE:
            samples = found.of(topic, SampleRecord)
            turn = places.mount(samples[0].frame_id) if samples else None
            sensors.append(imu_sensor(identifier, samples, found, place, turn))
    return sensors


def _topics_of(note: Mapping[str, Any]) -> list[str]:
    return [note["topic"]] if "topic" in note else list(note.get("topics", ()))
