"""A log of messages as a scene: topics become sensors, frames become extrinsics and the ego trajectory."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.messages.annotations import read_annotations
from sceneloom.formats.messages.cameras import CameraDraft, draft_camera
from sceneloom.formats.messages.frames import FrameTree, Locations, choose_roles
from sceneloom.formats.messages.points import CloudDraft, draft_cloud
from sceneloom.formats.messages.records import (
    FixRecord,
    Kind,
    PoseRecord,
    SampleRecord,
    Topic,
    TopicLog,
    TransformRecord,
)
from sceneloom.formats.messages.survey import (
    Notes,
    Survey,
    attributes_from,
    in_order,
    nearest,
    sensor_names,
    survey,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory, placed_along
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Coordinates, PointsFrame
from sceneloom.warnings import WarningKind

_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Messages have covariances of location, then rotate; trajectories of rotation, then location."""

_VECTORS = frozenset({"accelerometer", "gyroscope", "magnetometer"})


@dataclass(frozen=True, slots=True, eq=False)
class _PoseRows:
    """The poses of a topic, in order.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, or None where some are not stated.
        covariances: (N, 6, 6) float64 as trajectories have them, or None.
        frame_id, body: the frames that the first one names.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array | None
    covariances: Float64Array | None
    frame_id: str
    body: str


def _pose_rows(survey: Survey, name: str, records: Sequence[PoseRecord]) -> _PoseRows | None:
    """Bring the poses of a topic into order; None where there are none.

    Raises:
        DataError: one of them is none.
    """
    location = f"{survey.log.name}: {name}"
    kept = []
    for k, record in enumerate(records):
        fault = _pose_fault(record)
        if fault is None:
            kept.append(record)
        else:
            survey.ledger.fault("poses-at-fault", DataError(survey.log.name, f"{name}[{k}]", fault))
    if not kept:
        return None
    rows = in_order(np.array([record.timestamp_ns for record in kept], np.int64), location, survey.ledger)
    chosen = [kept[row] for row in rows.tolist()]
    rotations = [record.quaternion_xyzw for record in chosen]
    spreads = [record.covariance for record in chosen]
    quaternions = [rotation for rotation in rotations if rotation is not None]
    covariances = [spread for spread in spreads if spread is not None]
    if 0 < len(quaternions) < len(chosen):
        message = "poses with and without orientation; none of the orientations is used"
        survey.ledger.note(WarningKind.SKIPPED, "orientations-missing", location, message, count=len(quaternions))
    return _PoseRows(
        np.array([record.timestamp_ns for record in chosen], np.int64),
        np.array([record.position for record in chosen]),
        np.array(quaternions) if len(quaternions) == len(chosen) else None,
        np.array(covariances)[:, _ROTATION_FIRST][:, :, _ROTATION_FIRST] if len(covariances) == len(chosen) else None,
        chosen[0].frame_id,
        chosen[0].body,
    )


def _pose_fault(record: PoseRecord) -> str | None:
    if not np.isfinite(record.position).all():
        return f"position {record.position.tolist()}; expected finite numbers"
    if record.quaternion_xyzw is None:
        return None
    norms, wrong = lengths_of(record.quaternion_xyzw[None])
    if wrong[0]:
        return f"orientation {record.quaternion_xyzw.tolist()} of length {norms[0]:.4g}; expected 1 within 0.01"
    return None


def _trajectory(name: str, rows: _PoseRows, locations: Locations, survey: Survey) -> Trajectory:
    """The ego trajectory that a topic reports, if need be through the frame of the body that it is of."""
    location = f"{survey.log.name}: {name}"
    ego = locations.roles.ego
    body_from_ego = None
    if rows.body and ego is not None and rows.body != ego:
        mount = locations.mount(rows.body)
        if mount is None:
            message = f"poses of frame {rows.body!r}, which is not connected with {ego!r}, are taken for the ego's"
            survey.ledger.note(WarningKind.ASSUMED, "pose-of-other-body", location, message)
        else:
            body_from_ego = mount.inverse()
    positions, quaternions = rows.positions, rows.quaternions_xyzw
    if body_from_ego is not None and quaternions is not None:
        positions = rotate_vectors(quaternions, body_from_ego.translation) + positions
        quaternions = multiply_quaternions(quaternions, body_from_ego.quaternion_xyzw)
    return Trajectory(
        name,
        read_only(rows.timestamps_ns),
        read_only(positions),
        None if quaternions is None else read_only(quaternions),
        covariances=None if rows.covariances is None else read_only(rows.covariances),
    )


def _gnss_sensor(
    sensor_id: str | int, records: Sequence[FixRecord], survey: Survey, location: str, **fields: Any
) -> GnssSensor:
    """A satellite receiver from its fixes; those without reception are left out."""
    received = [record for record in records if record.received]
    if len(received) < len(records):
        count = len(records) - len(received)
        survey.ledger.note(WarningKind.SKIPPED, "no-reception", location, "fixes without reception", count=count)
    rows = in_order(np.array([record.timestamp_ns for record in received], np.int64), location, survey.ledger)
    chosen = [received[row] for row in rows.tolist()]
    unknown = (np.nan, np.nan, np.nan)
    variances = np.array([record.variances or unknown for record in chosen]).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        deviations = np.sqrt(np.where(variances >= 0, variances, np.nan))
        equal = deviations[:, 0] == deviations[:, 1]
        level = np.where(equal, deviations[:, 0], np.sqrt((variances[:, 0] + variances[:, 1]) / 2))
    return GnssSensor(
        sensor_id,
        read_only(np.array([record.timestamp_ns for record in chosen], np.int64)),
        read_only(np.array([record.lla for record in chosen], np.float64).reshape(-1, 3)),
        read_only(level),
        read_only(deviations[:, 2]),
        **fields,
    )


def _imu_sensor(
    sensor_id: str | int,
    records: Sequence[SampleRecord],
    survey: Survey,
    location: str,
    ego_from_imu: RigidTransform | None = None,
    **fields: Any,
) -> ImuSensor:
    """An inertial unit from its samples, in the axes of the ego where these are known."""
    by_stream: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
    for record in records:
        for name, values in record.values.items():
            by_stream.setdefault(name, []).append((record.timestamp_ns, values))
    rotation = None if ego_from_imu is None else ego_from_imu.rotation
    if rotation is not None and np.array_equal(rotation, np.eye(3)):
        rotation = None
    if rotation is not None:
        message = (
            "measurements were converted to the axes of the ego; that the unit sits elsewhere is not accounted for"
        )
        survey.ledger.note(WarningKind.ASSUMED, "imu-rotated", location, message)
    streams: Mapping[str, VectorSamples] = MappingProxyType(
        {name: _stream(name, rows, rotation, survey, location) for name, rows in by_stream.items()}
    )
    return ImuSensor(sensor_id, streams, **fields)


def _stream(
    name: str,
    rows: Sequence[tuple[int, tuple[float, ...]]],
    rotation: Float64Array | None,
    survey: Survey,
    location: str,
) -> VectorSamples:
    widths = {len(values) for _, values in rows}
    if len(widths) > 1:
        raise DataError(survey.log.name, location, f"{name} of {sorted(widths)} values; expected as many each time")
    order = in_order(np.array([time for time, _ in rows], np.int64), f"{location}.{name}", survey.ledger)
    values = np.array([rows[row][1] for row in order.tolist()], np.float64).reshape(len(order), -1)
    if rotation is not None and name in _VECTORS and values.shape[1] == 3:
        values = values @ rotation.T
    return VectorSamples(read_only(np.array([rows[row][0] for row in order.tolist()], np.int64)), read_only(values))


_Note = Mapping[str, Any]


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

    def common(self, note: _Note) -> dict[str, Any]:
        """Fields of every sensor."""
        fields: dict[str, Any] = {"parent_id": note.get("parent_id")}
        return fields | ({"extras": MappingProxyType(note["extras"])} if note.get("extras") else {})

    def posed(self, note: _Note, times_ns: Any) -> dict[str, Any]:
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
            fields["poses"] = None if rows is None else _path_of(rows, static=bool(note.get("static")))
        return fields

    def rows(self, topic: str) -> _PoseRows | None:
        return _pose_rows(self.survey, topic, self.of(topic, Kind.POSE, PoseRecord))

    def lidar(self, note: _Note) -> Sensor:
        frame = {"points_frame": PointsFrame(note["points_frame"]), "model": note.get("model")}
        return self.swept(note, LidarSensor, radar=False, **frame)

    def radar(self, note: _Note) -> Sensor:
        return self.swept(note, RadarSensor, radar=True, points_frame=PointsFrame(note["points_frame"]))

    def swept(self, note: _Note, sensor_type: type[Any], *, radar: bool, **fields: Any) -> Sensor:
        draft = self.clouds.get(note["topic"])
        if draft is None:
            nothing: LazyFrames[LidarFrame | RadarFrame] = LazyFrames.of([], [])
            made: Sensor = sensor_type(note["id"], nothing, **self.posed(note, nothing.timestamps_ns), **fields)
            return made
        return draft.sensor(note["id"], radar=radar, **self.posed(note, draft.reader.starts_ns), **fields)

    def cloud_map(self, note: _Note) -> Sensor:
        return self.clouds[note["topic"]].points(note["id"], **self.common(note))

    def camera(self, note: _Note) -> Sensor:
        draft = self.cameras.get(note["topic"])
        if draft is None:
            kind: type[Any] = CameraSensor if note["type"] == "camera" else DepthCameraSensor
            nothing: LazyFrames[Any] = LazyFrames.of([], [])
            further = self.posed(note, nothing.timestamps_ns) | {"fps": note.get("fps")}
            made: Sensor = kind(note["id"], _camera_model_from_text(note["camera_model"]), nothing, **further)
            return made
        times = draft.frames.timestamps_ns
        if note.get("mounts") == "each":
            own = OwnMounts(draft.frames, self.locations.mounts_at(note["frame"], times))
            draft = replace(draft, frames=LazyFrames(times, own))
        return draft.sensor(note["id"], fps=note.get("fps"), **self.posed(note, times))

    def gnss(self, note: _Note) -> Sensor:
        mount = self.locations.mount(note["frame"]) if note.get("mount") else None
        fixes = self.of(note["topic"], Kind.FIX, FixRecord)
        location = f"{self.survey.log.name}: {note['topic']}"
        return _gnss_sensor(note["id"], fixes, self.survey, location, mount=mount, **self.common(note))

    def imu(self, note: _Note) -> Sensor:
        found: dict[str, Any] = {}
        for topic in note["topics"]:
            samples = self.of(topic, Kind.SAMPLE, SampleRecord)
            location = f"{self.survey.log.name}: {topic}"
            found |= _imu_sensor(note["id"], samples, self.survey, location).streams
        order = [name for name in note.get("streams", ()) if name in found]
        streams = {name: found[name] for name in (*order, *(name for name in found if name not in order))}
        return ImuSensor(note["id"], MappingProxyType(streams), **self.common(note))

    def odometry(self, note: _Note) -> Sensor:
        rows = self.rows(note["topic"])
        if rows is None:
            raise DataError(self.survey.log.name, note["topic"], "no poses; expected those of the odometry")
        return OdometrySensor(note["id"], _path_of(rows, static=bool(note.get("static"))), **self.common(note))

    makers: Mapping[str, Callable[["_Noted", _Note], Sensor]] = MappingProxyType(
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


def _noted_sensors(
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


def _path_of(rows: _PoseRows, *, static: bool) -> Poses:
    """The path that rows report; without orientations nothing rotates."""
    quaternions = rows.quaternions_xyzw
    if quaternions is None:
        quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows.timestamps_ns), 1))
    return Poses(rows.timestamps_ns, rows.positions, quaternions, static=static)


def _noted_trajectories(survey: Survey) -> dict[str, Trajectory]:
    """The trajectories that notes describe, in their order."""
    found = {}
    topics = {topic.name: topic for topic in survey.topics(Kind.POSE)}
    for note in survey.notes.trajectories:
        topic = topics.get(note.get("topic", ""))
        rows = None if topic is None else _pose_rows(survey, topic.name, survey.of(topic, PoseRecord))
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


def _noted_scene_fields(notes: Notes, metadata: Mapping[str, Any], form: str) -> dict[str, Any]:
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


_IMAGE_KINDS = (Kind.IMAGE, Kind.COMPRESSED_IMAGE, Kind.VIDEO)

_FROM_FRAMES = "tf"
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
        sensors = _noted_sensors(found, drafts.clouds, drafts.cameras, locations)
        cameras = {
            note["topic"]: note["id"]
            for note in found.notes.sensors
            if note.get("type") == "camera" and {"topic", "id"} <= note.keys()
        }
        sensors += _foreign_sensors(found, drafts, locations, {sensor.id for sensor in sensors}, cameras)
        annotations = read_annotations(found, locations, cameras)
        fields = _noted_scene_fields(found.notes, metadata, form)
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
    for topic in found.topics(Kind.CLOUD, *_IMAGE_KINDS):
        try:
            if topic.kind is Kind.CLOUD:
                drafts.clouds.append(draft_cloud(found, topic))
                continue
            camera_model = _camera_model_topic_of(topic, camera_model_topics)
            if topic.name in noted:
                camera_model = next((other for other in camera_model_topics if other.name == noted[topic.name]), None)
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
    roles = choose_roles(tree, wanted, ego=chosen["ego"], world=chosen["world"], location=log.name, ledger=quiet)
    locations = Locations(tree, roles, None)
    trajectories = _noted_trajectories(found)
    if not found.notes.ours:
        trajectories = _foreign_trajectories(found, locations)
        loose = sorted({frame for frame in drafts.frames if frame not in frames})
        if loose:
            message = f"frames {', '.join(map(repr, loose))} are in no transform, so their sensors are not placed"
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
            trajectories[_FROM_FRAMES] = Trajectory(
                _FROM_FRAMES, path.timestamps_ns, path.positions, path.quaternions_xyzw
            )
    topics = found.topics(Kind.POSE)
    for topic, name in zip(topics, sensor_names([topic.name for topic in topics]), strict=True):
        rows = _pose_rows(found, topic.name, found.of(topic, PoseRecord))
        if rows is not None:
            called = f"{name}~" if name in _RESERVED_NAMES or name in trajectories else name
            trajectories[called] = _trajectory(called, rows, locations, found)
    return trajectories


_RESERVED_NAMES = frozenset({"gnss", "lidar", "identity"})
"""Names of trajectories that are computed."""


def _foreign_sensors(
    found: Survey, drafts: Drafts, locations: Locations, taken: set[Any], camera_ids: dict[str, Any]
) -> list[Sensor]:
    """The sensors that no note of ours speaks of; the ids of cameras are noted down by their topics."""
    noted = {name for note in found.notes.sensors for name in _topics_of(note)}
    topics = [
        topic for topic in found.topics(Kind.CLOUD, *_IMAGE_KINDS, Kind.SAMPLE, Kind.FIX) if topic.name not in noted
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
            sensors.append(_gnss_sensor(identifier, fixes, found, location, mount=mount))
        elif topic.kind is Kind.SAMPLE:
            samples = found.of(topic, SampleRecord)
            rotation = locations.mount(samples[0].frame_id) if samples else None
            sensors.append(_imu_sensor(identifier, samples, found, location, rotation))
    return sensors


def _topics_of(note: Mapping[str, Any]) -> list[str]:
    return [note["topic"]] if "topic" in note else list(note.get("topics", ()))


def _camera_model_from_text(text: str) -> Camera:
    """The camera model of `camera_model_text`."""
    model, width, height, numbers, coefficients = json.loads(text)
    fx, fy, cx, cy = numbers
    return Camera(model, width, height, fx, fy, cx, cy, tuple(coefficients))


def _camera_model_topic_of(topic: Topic, camera_model_topics: Sequence[Topic]) -> Topic | None:
    """The topic of camera models that stands beside a topic of images."""
    by_name: Mapping[str, Topic] = MappingProxyType({other.name: other for other in camera_model_topics})
    name = nearest(topic.name, by_name)
    return None if name is None else by_name[name]
