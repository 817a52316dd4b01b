"""What bags of ROS offer to the table of formats, and how they are recognised."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import MissingExtraError, check_option_names, how_to_install
from sceneloom.formats.files import open_file
from sceneloom.formats.loss import Holding, LossReport, approximated, converted, dropped
from sceneloom.formats.mcap.form import is_ros_mcap
from sceneloom.formats.topics.holdings import TOPIC_HOLDS
from sceneloom.scene.scene import Scene

METADATA = "metadata.yaml"
ROOT_KEY = "rosbag2_bagfile_information"
ROS1_MAGIC = b"#ROSBAG V"
_SQLITE_MAGIC = b"SQLite format 3\x00"
_LOOKED_AT = 1 << 16

HOLDS: Mapping[str, Holding] = MappingProxyType(
    {
        **TOPIC_HOLDS,
        "sensors.camera.video": approximated(
            'pictures become JPEG files, unless foxglove_msgs are asked for (pictures="video")'
        ),
        "sensors.imu.streams.magnetometer.values": converted("tesla in place of µT"),
        "sensors.imu.streams.other": dropped(
            "there are messages for temperatures only, which are converted to °C"
        ),
        "annotations.box_2d.path.values": converted("centre and size are written"),
        "trajectories.covariances": converted("place before turn"),
    }
)
"""What a bag of ROS makes of each field of a scene."""
_READING_OPTIONS = ("lenient", "assume_model", "stamps", "ego", "world", "distro")


class _BagFormat:
    """What bags of both kinds share."""

    name: str
    holds = HOLDS

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a bag; `open_bag` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `ros` is not installed.
            DataError: the bag is at fault.
        """
        check_option_names("opening a bag", options, _READING_OPTIONS)
        _check_extra()
        from sceneloom.formats.ros.reader import open_bag

        return open_bag(path, form=self.name, **options)


class Ros1Format(_BagFormat):
    """Bags of ROS 1."""

    name = "ros1"
    suffixes: tuple[str, ...] = (".bag",)
    looks_like = "a bag of ROS 1 (.bag)"

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a bag of ROS 1."""
        return is_ros1(path)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene; `write_ros1` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `ros` is not installed.
            OutputError: the bag exists, or cannot be written.
        """
        check_option_names("writing a bag", options, ("pictures", "distro"))
        _check_extra()
        from sceneloom.formats.ros.scene_to_bag import write_ros1

        return write_ros1(scene, path, overwrite=overwrite, **options)


class Ros2Format(_BagFormat):
    """Bags of ROS 2: folders with a `metadata.yaml`, or their files."""

    name = "ros2"
    suffixes: tuple[str, ...] = (".ros2",)
    looks_like = "a bag of ROS 2 (a folder with metadata.yaml and .db3 or .mcap files; written as NAME.ros2)"

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a bag of ROS 2, or a file of one."""
        return is_ros2(path)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene; `write_ros2` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `ros` is not installed.
            OutputError: the bag exists, or cannot be written.
        """
        check_option_names("writing a bag", options, ("pictures", "storage", "distro"))
        _check_extra()
        from sceneloom.formats.ros.scene_to_bag import write_ros2

        return write_ros2(scene, path, overwrite=overwrite, **options)


ROS1, ROS2 = Ros1Format(), Ros2Format()


def _check_extra() -> None:
    """Look whether what reads and writes bags is installed, before it is imported piece by piece."""
    try:
        import mcap  # noqa: F401 - only whether it is there
        import rosbags  # noqa: F401 - only whether it is there
        import ruamel.yaml  # noqa: F401 - only whether it is there
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('ros')}") from missing


def is_ros1(path: Path) -> bool:
    """Whether a file begins as a bag of ROS 1 does."""
    return _begins(path, ROS1_MAGIC)


def is_ros2(path: Path) -> bool:
    """Whether a folder holds a bag of ROS 2, or a file is one of such a folder."""
    try:
        if path.is_file():
            return _is_sqlite_bag(path) or is_ros_mcap(path)
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
        file.is_file() and (_is_sqlite_bag(file) or (file.suffix == ".mcap" and is_ros_mcap(file)))
        for file in files
    )


def _is_sqlite_bag(path: Path) -> bool:
    if not _begins(path, _SQLITE_MAGIC):
        return False
    with open_file(path) as file:
        content = file.read(_LOOKED_AT)
    # the first page holds the statements that made the tables
    return b"serialization_format" in content and b"topic_id" in content


def _begins(path: Path, magic: bytes) -> bool:
    try:
        if not path.is_file():
            return False
        with open_file(path) as file:
            return file.read(len(magic)) == magic
    except OSError:
        return False
