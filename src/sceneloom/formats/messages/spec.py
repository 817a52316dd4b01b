"""MCAP files and bags of ROS 1 and ROS 2: how they are recognised, their options and supported fields."""

import struct
from functools import partial
from pathlib import Path
from types import MappingProxyType

from sceneloom.errors import SceneloomError
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.losses import KEPT, Holding, Supports, approximated, converted, dropped
from sceneloom.formats.base.spec import FormatSpec, begins, first_bytes

METADATA = "metadata.yaml"
ROOT_KEY = "rosbag2_bagfile_information"
MCAP_MAGIC = b"\x89MCAP0\r\n"
_SQLITE = b"SQLite format 3\x00"
_ROS_PROFILES = frozenset({"ros1", "ros2"})
_ROS_ENCODINGS = frozenset({"cdr", "ros1"})  # encodings of messages that only ROS has. Source: MCAP format registry

_HEADER = struct.Struct("<8sBQI")
"""How a file begins: magic, opcode and length of the header, length of the profile's name."""

_LOOKED_AT = 1 << 16

# Recognising


def _is_ros_mcap(path: Path) -> bool:
    """Whether an MCAP file is a bag of ROS: by its profile, else by the encoding of its messages."""
    content = first_bytes(path, 256)
    if not content.startswith(MCAP_MAGIC):
        return False
    profile = ""
    if len(content) >= _HEADER.size:
        size = _HEADER.unpack_from(content)[3]
        profile = content[_HEADER.size : _HEADER.size + size].decode("utf-8", "replace")
    if profile in _ROS_PROFILES:
        return True
    return not profile and bool(_encodings(path) & _ROS_ENCODINGS)


def _encodings(path: Path) -> set[str]:
    """The encodings of messages, as far as the file can be read."""
    try:
        from sceneloom.formats.base.diagnostics import Ledger
        from sceneloom.formats.messages.file_bytes import FileBytes
        from sceneloom.formats.messages.mcap_files import read_index
    except ImportError:
        return set()
    try:
        file = FileBytes(path)
        try:
            index = read_index(file, Ledger(lenient=True))
        finally:
            file.close()
    except SceneloomError:
        return set()
    return {channel.message_encoding for channel in index.channels.values()}


def _mcap_near_miss(path: Path) -> str | None:
    if path.suffix.lower() != ".mcap" or begins(path, MCAP_MAGIC) or not path.is_file():
        return None
    return "it is called like an MCAP file, but does not begin as one does"


def _is_ros2(path: Path) -> bool:
    """Whether a folder holds a bag of ROS 2, or a file is one of such a folder."""
    try:
        if path.is_file():
            return _is_sqlite_bag(path) or _is_ros_mcap(path)
        return path.is_dir() and (_has_metadata(path) or _holds_messages(path))
    except OSError:
        return False


def _has_metadata(folder: Path) -> bool:
    metadata = folder / METADATA
    if not metadata.is_file():
        return False
    with open_file(metadata) as file:
        return ROOT_KEY.encode() in file.read(_LOOKED_AT)


def _holds_messages(folder: Path) -> bool:
    """Whether a folder without metadata holds files of messages and nothing else."""
    files = [file for file in folder.iterdir() if not file.name.startswith(".")]
    return bool(files) and all(
        file.is_file() and (_is_sqlite_bag(file) or (file.suffix == ".mcap" and _is_ros_mcap(file))) for file in files
    )


def _is_sqlite_bag(path: Path) -> bool:
    # the first page holds the statements that made the tables
    content = first_bytes(path, _LOOKED_AT)
    return content.startswith(_SQLITE) and b"serialization_format" in content and b"topic_id" in content


# Supported fields


_NO_MESSAGE = "there are no messages for it"
_SOURCE_TIMESTAMPS = "timestamps of the source are not written beside our own"
_JSON = converted("written as JSON; values that JSON cannot state are dropped, which is reported")
_ALONG = converted("reported by the mounting and the ego trajectory where these state the same, within their rounding")
_QUATERNION = converted("rotations become unit quaternions")


def _swept(kind: str) -> dict[str, Holding]:
    return {
        f"{kind}.mount": _QUATERNION,
        f"{kind}.poses": _ALONG,
        f"{kind}.extras": _JSON,
        f"{kind}.frames.extras": dropped(_NO_MESSAGE),
        f"{kind}.frames.points.extras": converted(
            "fields of 32 bits, and floats of 64; whole numbers of 64 bits become floats, others than one number for "
            "each point are dropped, which is reported"
        ),
    }


def _seeing(kind: str, frames: str) -> dict[str, Holding]:
    return {
        f"{kind}.mount": _QUATERNION,
        f"{kind}.poses": _ALONG,
        f"{kind}.extras": _JSON,
        f"{kind}.camera": converted("camera models that other programs do not know are written as only we read them"),
        f"{kind}.{frames}.mount": converted("transforms, at the times of images where they are not all the same"),
        f"{kind}.{frames}.extras": dropped(_NO_MESSAGE),
    }


_STREAMS = ("accelerometer", "gyroscope", "magnetometer", "other")
_SUPPORTS: Supports = MappingProxyType(
    {
        "": KEPT,
        **_swept("sensors.lidar"),
        **_swept("sensors.radar"),
        **_seeing("sensors.camera", "images"),
        **_seeing("sensors.depth_camera", "frames"),
        **{f"sensors.{kind}.extras": _JSON for kind in ("points", "odometry", "imu", "gnss")},
        "sensors.gnss.mount": _QUATERNION,
        "sensors.camera.images.encoded": converted("JPEG files are copied"),
        "sensors.camera.video": converted("H.264 and HEVC are copied packet by packet, others become JPEG files"),
        "sensors.depth_camera.video": dropped("depth images are written one by one"),
        "sensors.depth_camera.frames.scale": converted("millimetres are kept; other steps become floats of metres"),
        **{f"sensors.imu.streams.{name}.file_seconds": dropped(_SOURCE_TIMESTAMPS) for name in _STREAMS},
        "sensors.gnss.accuracies": converted("variances are written, as large to the east as to the north"),
        "sensors.gnss.vertical_accuracies": converted("variances are written"),
        "sensors.gnss.file_seconds": dropped(_SOURCE_TIMESTAMPS),
        "sensors.plain": dropped(_NO_MESSAGE),
        "sensors.order": KEPT,
        "trajectories.file_seconds": dropped(_SOURCE_TIMESTAMPS),
        "annotations": dropped("there are plots of cuboids and of boxes in images only"),
        "annotations.order": KEPT,
        "annotations.cuboid": KEPT,
        "annotations.cuboid.path.values": converted(
            "angles become unit quaternions, which do not report whole rotations"
        ),
        **{f"annotations.cuboid.{name}": dropped(_NO_MESSAGE) for name in ("activations", "projections")},
        "annotations.box_2d": KEPT,
        "annotations.box_2d.path.values": converted("corners are written, whose differences are the size"),
        **{f"annotations.{kind}.path.extras": dropped(_NO_MESSAGE) for kind in ("cuboid", "box_2d")},
        **{f"annotations.{kind}.{name}": _JSON for kind in ("cuboid", "box_2d") for name in ("extras", "attributes")},
        **dict.fromkeys(("attributes", "metadata", "extras"), _JSON),
    }
)

_BAG_SUPPORTS: Supports = MappingProxyType(
    {
        **_SUPPORTS,
        "sensors.camera.video": approximated(
            'images become JPEG files, unless foxglove_msgs are asked for (images="video")'
        ),
        "sensors.imu.streams.magnetometer.values": converted("tesla instead of µT"),
        "sensors.imu.streams.other": dropped("there are messages for temperatures only, which are converted to °C"),
        "annotations.box_2d.path.values": converted("centre and size are written"),
        "trajectories.covariances": converted("location before rotate"),
    }
)

_READ_OPTIONS = ("lenient", "assume_model", "timestamps", "ego", "world", "rig")

MCAP = FormatSpec(
    name="mcap",
    title="an MCAP file",
    looks_like="an MCAP file with messages of the Foxglove schemas (.mcap)",
    suffixes=(".mcap",),
    sniff=lambda path: begins(path, MCAP_MAGIC) and not _is_ros_mcap(path),
    near_miss=_mcap_near_miss,
    reader="sceneloom.formats.messages.mcap:open_mcap",
    read_options=_READ_OPTIONS,
    reads_urls=True,
    writer="sceneloom.formats.messages.mcap:write_mcap",
    write_options=("compression", "images"),
    supports=MappingProxyType({**_SUPPORTS, "trajectories.covariances": dropped("messages of poses have none")}),
    extra="mcap",
    needs=("foxglove_schemas_protobuf", "google.protobuf", "mcap"),
)

ROS1 = FormatSpec(
    name="ros1",
    title="a bag",
    looks_like="a bag of ROS 1 (.bag)",
    suffixes=(".bag",),
    sniff=partial(begins, magic=b"#ROSBAG V"),
    reader="sceneloom.formats.messages.ros:open_ros1",
    read_options=(*_READ_OPTIONS, "distro", "metadata", "angles", "model"),
    writer="sceneloom.formats.messages.ros:write_ros1",
    write_options=("images", "distro"),
    supports=_BAG_SUPPORTS,
    extra="ros",
    needs=("mcap", "rosbags", "ruamel.yaml"),
)

ROS2 = FormatSpec(
    name="ros2",
    title="a bag",
    looks_like="a bag of ROS 2 (a folder with metadata.yaml and .db3 or .mcap files; written as NAME.ros2)",
    suffixes=(".ros2",),
    sniff=_is_ros2,
    reader="sceneloom.formats.messages.ros:open_ros2",
    read_options=(*_READ_OPTIONS, "distro", "metadata", "angles", "model"),
    writer="sceneloom.formats.messages.ros:write_ros2",
    write_options=("images", "storage", "distro"),
    supports=_BAG_SUPPORTS,
    extra="ros",
    needs=("mcap", "rosbags", "ruamel.yaml"),
)
