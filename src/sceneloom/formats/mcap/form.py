"""What MCAP files with Foxglove's schemas offer to the table of formats, and how they are told from bags of ROS."""

import struct
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import MissingExtraError, SceneloomError, check_option_names, how_to_install
from sceneloom.formats.files import open_file
from sceneloom.formats.loss import KEPT, Holding, LossReport
from sceneloom.formats.topics.holdings import TOPIC_HOLDS, dropped_here
from sceneloom.scene.scene import Scene

MAGIC = b"\x89MCAP0\r\n"
"""What a file begins and ends with."""

HOLDS: Mapping[str, Holding] = MappingProxyType(
    {**TOPIC_HOLDS, "trajectories.covariances": dropped_here("messages of poses have none"), "": KEPT}
)
"""What an MCAP file makes of each field of a scene."""

_ROS_PROFILES = frozenset({"ros1", "ros2"})
_ROS_ENCODINGS = frozenset({"cdr", "ros1"})
"""Encodings of messages that only ROS has. Source: MCAP format registry."""

_HEADER = struct.Struct("<8sBQI")
"""How a file begins: magic, opcode and length of the header, length of the profile's name."""

_READING_OPTIONS = ("lenient", "assume_model", "stamps", "ego", "world")
_WRITING_OPTIONS = ("compression", "pictures")


class McapFormat:
    """MCAP files whose messages are of Foxglove's schemas, as protobuf or JSON."""

    name = "mcap"
    suffixes: tuple[str, ...] = (".mcap",)
    reads_urls = True
    looks_like = "an MCAP file with messages of the Foxglove schemas (.mcap)"
    holds = HOLDS

    def recognises(self, path: Path) -> bool:
        """Say whether the path is an MCAP file that is no bag of ROS."""
        return is_mcap(path) and not is_ros_mcap(path)

    def near_miss(self, path: Path) -> str | None:
        """What keeps a file that looks like one from being one."""
        if path.suffix.lower() != ".mcap" or is_mcap(path) or not path.is_file():
            return None
        return "it is called like an MCAP file, but does not begin as one does"

    def open(self, path: Path | str, **options: Any) -> Scene:
        """Open a file, or the URL of one; `open_mcap` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `mcap` is not installed.
            DataError: the file is at fault.
        """
        check_option_names("opening an MCAP file", options, _READING_OPTIONS)
        _check_extra()
        from sceneloom.formats.mcap.reader import open_mcap

        return open_mcap(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene; `write_mcap` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `mcap` is not installed.
            OutputError: the file exists, or cannot be written.
        """
        check_option_names("writing an MCAP file", options, _WRITING_OPTIONS)
        _check_extra()
        from sceneloom.formats.mcap.scene_to_mcap import write_mcap

        return write_mcap(scene, path, overwrite=overwrite, **options)


FORMAT = McapFormat()


def _check_extra() -> None:
    """Look whether what reads and writes messages is installed, before it is imported piece by piece."""
    try:
        import foxglove_schemas_protobuf  # noqa: F401 - only whether it is there
        import google.protobuf  # noqa: F401 - only whether it is there
        import mcap  # noqa: F401 - only whether it is there
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('mcap')}") from missing


def is_mcap(path: Path) -> bool:
    """Whether a file begins as an MCAP file does."""
    return _beginning(path, len(MAGIC)) == MAGIC


def is_ros_mcap(path: Path) -> bool:
    """Whether an MCAP file is a bag of ROS: by its profile, else by the encoding of its messages."""
    content = _beginning(path, 256)
    if not content.startswith(MAGIC):
        return False
    profile = ""
    if len(content) >= _HEADER.size:
        size = _HEADER.unpack_from(content)[3]
        profile = content[_HEADER.size : _HEADER.size + size].decode("utf-8", "replace")
    if profile in _ROS_PROFILES:
        return True
    return not profile and bool(_encodings(path) & _ROS_ENCODINGS)


def _beginning(path: Path, size: int) -> bytes:
    try:
        if not path.is_file():
            return b""
        with open_file(path) as file:
            return file.read(size)
    except OSError:
        return b""


def _encodings(path: Path) -> set[str]:
    """The encodings of messages, as far as the file can be read."""
    try:
        from sceneloom.formats.ledger import Ledger
        from sceneloom.formats.mcap.index import read_index
        from sceneloom.formats.topics.file_bytes import FileBytes
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
