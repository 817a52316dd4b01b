"""What PandaSet offers to the table of formats."""

from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError, check_option_names
from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import LossReport
from sceneloom.formats.pandaset import place
from sceneloom.formats.pandaset.scene_from_folder import open_pandaset
from sceneloom.scene import Scene

_READING_OPTIONS = ("lenient", "sequence")


class PandasetFormat:
    """Drives of PandaSet, which are only read."""

    name = "pandaset"
    suffixes: tuple[str, ...] = (".pandaset",)
    looks_like = "a folder with lidar/00.pkl.gz, lidar/poses.json and camera/"
    writes = False
    holds: Holds = MappingProxyType({})

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a drive, or a folder of drives."""
        return place.recognises(path)

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being a drive, where that can be guessed."""
        return place.near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a drive; `open_pandaset` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: a file is missing or wrong.
            OptionError: a drive has to be chosen.
        """
        check_option_names("opening PandaSet", options, _READING_OPTIONS)
        return open_pandaset(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Refuse: drives are only read.

        Raises:
            OptionError: always.
        """
        del scene, overwrite, options
        raise OptionError(
            f"{path}: PandaSet is only read; write a scene file (drive.sfs) or a recording (a folder) in its place"
        )


FORMAT = PandasetFormat()
"""Drives of PandaSet as one of the formats."""
