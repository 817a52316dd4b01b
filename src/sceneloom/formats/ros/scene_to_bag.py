"""A scene as a bag of ROS 1 or 2, written by rosbags."""

import json
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import FolderKind, replacing
from sceneloom.formats.ros.reader import NOTES_TOPIC
from sceneloom.formats.ros.typestores import distro_store
from sceneloom.formats.ros.writing import Messages
from sceneloom.formats.topics.dialect import Dialect
from sceneloom.formats.topics.names import ros_part
from sceneloom.formats.topics.records import AnyRecord, NotesRecord
from sceneloom.formats.topics.scene_streams import FIXED_FRAMES_TOPIC, SceneStreams
from sceneloom.formats.topics.streams import merged
from sceneloom.formats.topics.written_images import check_images
from sceneloom.scene.scene import Scene

STORAGES = ("sqlite3", "mcap")
"""What files of ROS 2 bags can be."""

_SECOND_NS = 1_000_000_000


def _dialect(*, videos: bool) -> Dialect:
    return Dialect(
        name="ROS",
        world="map",
        ego="base_link",
        part=ros_part,
        fisheye="equidistant",
        camera_model_topic="camera_info",
        sample_topics=MappingProxyType(
            {
                "accelerometer": "data",
                "gyroscope": "data",
                "magnetometer": "mag",
                "imuTemperature": "temperature",
            }
        ),
        videos=videos,
        covariances=True,
        each_camera_model=True,
        intensity="f4",
    )


_KIND = FolderKind("bag of ROS 2", (r"metadata\.yaml", r"(?P<one>.+)\.(mcap|db3)"), r"metadata\.yaml")


def write_ros1(
    scene: Scene, path: Path, *, overwrite: bool = False, images: str = "jpeg", distro: str = "noetic"
) -> LossReport:
    """Write a `.bag`; one message is in memory at a time.

    Args:
        scene: the drive.
        path: of the file.
        overwrite: whether a file that is there may be replaced.
        images: see `write_ros2`.
        distro: of ROS 1, whose types are written.

    Raises:
        OptionError: there is no such distribution, or way of writing images.
        OutputError: the file exists, or cannot be written.
    """
    from rosbags.rosbag1 import Writer

    with replacing(path, overwrite=overwrite) as draft, Writer(draft) as bag:
        return _write(scene, bag, distro, images, ros1=True)


def write_ros2(
    scene: Scene,
    path: Path,
    *,
    overwrite: bool = False,
    storage: str = "mcap",
    images: str = "jpeg",
    distro: str = "humble",
) -> LossReport:
    """Write a folder with `metadata.yaml`; one message is in memory at a time.

    Args:
        scene: the drive.
        path: of the folder.
        overwrite: whether a folder that is there may be replaced.
        storage: "mcap" or "sqlite3".
        images: "jpeg" and "copy" write JPEG files, copied where the scene has them, "png" and "raw" lose nothing,
            "video" hands on videos packet by packet as messages of foxglove_msgs.
        distro: of ROS 2, whose types are written.

    Raises:
        OptionError: there is no such storage, distribution, or way of writing images.
        OutputError: the folder exists, or cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    if storage not in STORAGES:
        raise OptionError(f"storage {storage!r}; expected one of {', '.join(STORAGES)}")
    plugin = StoragePlugin[storage.upper()]
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        draft.rmdir()
        with Writer(draft, version=9, storage_plugin=plugin) as bag:
            return _write(scene, bag, distro, images, ros1=False)


def _write(scene: Scene, bag: Any, distro: str, images: str, *, ros1: bool) -> LossReport:
    videos = images == "video"
    form = "copy" if videos or images == "jpeg" else images
    check_images(form)
    plan = SceneStreams(scene, _dialect(videos=videos), images=form)
    shift_ns = -(plan.start_ns // _SECOND_NS) * _SECOND_NS if plan.start_ns < 0 else 0
    store = distro_store(distro)
    if ("std_msgs/msg/Header" in store.types) and _has_number(store) is not ros1:
        raise OptionError(f"distro {distro!r}; expected one of ROS {1 if ros1 else 2}")
    if shift_ns:
        plan.notes["time_shift_ns"] = shift_ns
        what = f"times begin {shift_ns // _SECOND_NS} s later: ROS knows none before 0"
        plan.losses.converted("time_offset_ns", what)
    records = _Records(bag, store, Messages(store, ros1=ros1, shift_ns=shift_ns), shift_ns, ros1=ros1)
    records.add(plan.start_ns, NOTES_TOPIC, NotesRecord(0, json.dumps(plan.notes)))
    for time_ns, topic, record in merged(plan.streams):
        records.add(time_ns, topic, record)
    return LossReport.of(plan.losses.all)


def _has_number(store: Any) -> bool:
    return any(name == "seq" for name, _ in store.fielddefs["std_msgs/msg/Header"][1])


class _Records:
    """Writes records to a bag; connections are added when they are first needed."""

    def __init__(self, bag: Any, store: Any, messages: Messages, shift_ns: int, *, ros1: bool) -> None:
        self._bag, self._store, self._messages, self._shift_ns = bag, store, messages, shift_ns
        self._ros1 = ros1
        self._connections: dict[tuple[str, str], Any] = {}

    def add(self, time_ns: int, topic: str, record: AnyRecord) -> None:
        kind, message = self._messages.of(record)
        serialise = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        try:
            self._bag.write(self._connection(topic, kind), time_ns + self._shift_ns, serialise(message, kind))
        except (OverflowError, ValueError) as error:
            raise OutputError(f"{topic}: {kind} cannot be written: {error}") from error

    def _connection(self, topic: str, kind: str) -> Any:
        known = self._connections.get((topic, kind))
        if known is None:
            further: dict[str, Any] = {}
            if topic in {FIXED_FRAMES_TOPIC, NOTES_TOPIC}:
                further = {"latching": 1} if self._ros1 else {"offered_qos_profiles": [_latched()]}
            known = self._bag.add_connection(topic, kind, typestore=self._store, **further)
            self._connections[topic, kind] = known
        return known


def _latched() -> Any:
    """The quality of service of topics that whoever comes later gets, too."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        avoid_ros_namespace_conventions=False,
    )
