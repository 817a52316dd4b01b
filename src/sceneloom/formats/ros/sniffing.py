"""Whether a path is a bag of ROS: by names of files in a folder, and first bytes."""

from pathlib import Path

from sceneloom.formats.files import open_file
from sceneloom.formats.mcap.form import is_ros_mcap

METADATA = "metadata.yaml"
ROOT_KEY = "rosbag2_bagfile_information"
ROS1_MAGIC = b"#ROSBAG V"
_SQLITE_MAGIC = b"SQLite format 3\x00"
_LOOKED_AT = 1 << 16


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
