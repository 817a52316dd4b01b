"""Whose an MCAP file is: Foxglove's schemas', or ROS'; told from its first bytes, and its summary where need be."""

import struct
from pathlib import Path

from sceneloom.errors import SceneloomError
from sceneloom.formats.files import open_file
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.mcap.index import McapIndex, read_index
from sceneloom.formats.mcap.records import HEAD, MAGIC, Fields, Op
from sceneloom.formats.topics.file_bytes import FileBytes

ROS_PROFILES = frozenset({"ros1", "ros2"})
ROS_ENCODINGS = frozenset({"cdr", "ros1"})
"""Encodings of messages that only ROS has. Source: MCAP format registry."""

_LONGEST_HEAD = 1 << 16


def is_mcap(path: Path) -> bool:
    """Whether a file begins as an MCAP file does."""
    try:
        if not path.is_file():
            return False
        with open_file(path) as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def is_foxglove_mcap(path: Path) -> bool:
    """Whether a file is an MCAP file that is no bag of ROS."""
    return is_mcap(path) and not is_ros_mcap(path)


def is_ros_mcap(path: Path) -> bool:
    """Whether an MCAP file is a bag of ROS: by its profile, else by the encoding of its messages."""
    if not is_mcap(path):
        return False
    profile = _profile(path)
    if profile in ROS_PROFILES:
        return True
    return not profile and bool(_encodings(path) & ROS_ENCODINGS)


def _profile(path: Path) -> str:
    try:
        with open_file(path) as file:
            file.seek(len(MAGIC))
            op, length = HEAD.unpack(file.read(HEAD.size))
            return Fields(file.read(min(length, _LONGEST_HEAD))).text() if op == Op.HEADER else ""
    except (OSError, ValueError, struct.error):
        return ""


def _encodings(path: Path) -> set[str]:
    index = known_index(path)
    return set() if index is None else {channel.encoding for channel in index.channels.values()}


def known_index(path: Path) -> McapIndex | None:
    """The index of a file as far as it can be read."""
    try:
        file = FileBytes(path)
    except SceneloomError:
        return None
    try:
        return read_index(file, Ledger(lenient=True))
    except SceneloomError:
        return None
    finally:
        file.close()


def near_miss(path: Path) -> str | None:
    """What keeps a file from being an MCAP file that its name says it is."""
    if path.suffix.lower() != ".mcap" or is_mcap(path) or not path.is_file():
        return None
    return "it is called like an MCAP file, but does not begin as one does"
