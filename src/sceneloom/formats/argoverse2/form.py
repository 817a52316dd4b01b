"""What Argoverse 2 offers to the table of formats."""

from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError, check_option_names
from sceneloom.formats.argoverse2 import place
from sceneloom.formats.argoverse2.scene_from_log import open_argoverse2
from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import LossReport
from sceneloom.scene import Scene

_READING_OPTIONS = ("lenient", "sequence", "one_lidar", "distorted")


class Argoverse2Format:
    """Logs of Argoverse 2, which are only read."""

    name = "argoverse2"
    suffixes: tuple[str, ...] = (".argoverse2",)
    looks_like = f"a folder with {place.POSES}, calibration/ and sensors/lidar/*.feather"
    writes = False
    holds: Holds = MappingProxyType({})

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a log, or a folder of logs."""
        return place.recognises(path)

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being a log, where that can be guessed."""
        return place.near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a log; `open_argoverse2` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: a file is missing or wrong.
            OptionError: a log has to be chosen.
            MissingExtraError: pyarrow is not installed.
        """
        check_option_names("opening Argoverse 2", options, _READING_OPTIONS)
        return open_argoverse2(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Refuse: logs are only read.

        Raises:
            OptionError: always.
        """
        del scene, overwrite, options
        raise OptionError(
            f"{path}: Argoverse 2 is only read; write a scene file (drive.sfs) or a recording (a folder) in its place"
        )


FORMAT = Argoverse2Format()
"""Logs of Argoverse 2 as one of the formats."""
