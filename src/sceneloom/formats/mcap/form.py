"""What MCAP files with Foxglove's schemas offer to the table of formats."""

from pathlib import Path
from typing import Any

from sceneloom.errors import MissingExtraError, check_option_names, how_to_install
from sceneloom.formats.loss import LossReport
from sceneloom.formats.mcap.holdings import HOLDS
from sceneloom.formats.mcap.sniffing import is_foxglove_mcap, near_miss
from sceneloom.scene.scene import Scene

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
        return is_foxglove_mcap(path)

    def near_miss(self, path: Path) -> str | None:
        """What keeps a file that looks like one from being one."""
        return near_miss(path)

    def open(self, path: Path | str, **options: Any) -> Scene:
        """Open a file, or the URL of one; `open_mcap` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            MissingExtraError: the extra `mcap` is not installed.
            DataError: the file is at fault.
        """
        check_option_names("opening an MCAP file", options, _READING_OPTIONS)
        _check_extra()
        from sceneloom.formats.mcap.scene_from_mcap import open_mcap

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


def _check_extra() -> None:
    """Look whether what reads and writes messages is installed, before it is imported piece by piece."""
    try:
        import foxglove_schemas_protobuf  # noqa: F401 - only whether it is there
        import google.protobuf  # noqa: F401 - only whether it is there
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('mcap')}") from missing


FORMAT = McapFormat()
