"""What the nuScenes schema offers to the table of formats."""

from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import LossReport
from sceneloom.formats.nuscenes.holdings import HOLDS
from sceneloom.formats.nuscenes.place import near_miss, table_folders
from sceneloom.formats.nuscenes.scene_from_tables import open_nuscenes
from sceneloom.formats.nuscenes.writing import write_nuscenes
from sceneloom.scene import Scene

_READING_OPTIONS = ("lenient", "sequence", "keyframes")
_WRITING_OPTIONS = ("version", "keyframe_rate_hz", "pictures")


class NuscenesFormat:
    """Data sets in the nuScenes schema."""

    name = "nuscenes"
    suffixes: tuple[str, ...] = ("",)
    looks_like = "a folder with v1.0-mini/sample_data.json and the other tables of the nuScenes schema"
    holds: Holds = HOLDS

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a folder with the tables of a data set, or the folder of the tables itself."""
        return bool(table_folders(path))

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being a data set, where that can be guessed."""
        return near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a scene; `open_nuscenes` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: a table or a file is missing or wrong.
            OptionError: a scene has to be chosen.
        """
        check_option_names("opening nuScenes", options, _READING_OPTIONS)
        return open_nuscenes(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene as a data set; `write_nuscenes` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OutputError: the folder exists, or cannot be written.
        """
        check_option_names("writing nuScenes", options, _WRITING_OPTIONS)
        return write_nuscenes(scene, path, overwrite=overwrite, **options)


FORMAT = NuscenesFormat()
"""The nuScenes schema as one of the formats."""
