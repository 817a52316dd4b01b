"""What folders of Scale's lidar toolkit offer to the table of formats."""

from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError, check_option_names
from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import LossReport
from sceneloom.formats.scale_toolkit.scene_from_folder import open_scale_toolkit
from sceneloom.formats.scale_toolkit.sensors import CLOUDS
from sceneloom.scene import Scene

_READING_OPTIONS = ("lenient", "rate_hz")


class ScaleToolkitFormat:
    """Folders of Scale's lidar toolkit, which are only read."""

    name = "scale-toolkit"
    suffixes: tuple[str, ...] = (".scale-toolkit",)
    looks_like = "a folder with pointcloud/1.ply, poses/1.json and cameras/NAME/extrinsics.json"
    writes = False
    holds: Holds = MappingProxyType({})

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a folder with clouds, and with poses or cameras beside them."""
        return _has_clouds(path) and (
            any((path / "poses").glob("*.json")) or any((path / "cameras").glob("*/extrinsics.json"))
        )

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being one, where that can be guessed."""
        if path.is_dir() and any((path / "cameras").glob("*/extrinsics.json")):
            return "it has cameras/*/extrinsics.json, but no pointcloud/*.ply or *.pcd"
        return None

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a folder; `open_scale_toolkit` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: a file is missing or wrong.
        """
        check_option_names("opening a folder of Scale's lidar toolkit", options, _READING_OPTIONS)
        return open_scale_toolkit(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Refuse: such folders are only read.

        Raises:
            OptionError: always.
        """
        del scene, overwrite, options
        raise OptionError(
            f"{path}: folders of Scale's lidar toolkit are only read; write a scene file (drive.sfs), which Scale's "
            "own library reads with --profile scale"
        )


def _has_clouds(path: Path) -> bool:
    folder = path / "pointcloud"
    return folder.is_dir() and any(file.suffix.lower() in CLOUDS for file in folder.iterdir())


FORMAT = ScaleToolkitFormat()
"""Folders of Scale's lidar toolkit as one of the formats."""
