"""What KITTI's odometry folders offer to the table of formats."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.kitti.odometry import place
from sceneloom.formats.kitti.odometry.reading import open_odometry
from sceneloom.formats.kitti.odometry.writing import write_odometry
from sceneloom.formats.kitti.written.holdings import ODOMETRY
from sceneloom.formats.loss import Holding, LossReport
from sceneloom.scene import Scene

_WRITING_OPTIONS: tuple[str, ...] = ("sequence",)
_READING_OPTIONS = ("sequence", "labels", "lenient")


class OdometryFormat:
    """Sequences of KITTI's odometry benchmark."""

    name = "kitti-odometry"
    suffixes: tuple[str, ...] = ("",)
    looks_like = (
        "sequences of KITTI's odometry benchmark (sequences/00, poses/00.txt), with SemanticKITTI's labels"
    )
    holds: Mapping[str, Holding] = ODOMETRY

    def recognises(self, path: Path) -> bool:
        """Say whether the path is such a folder."""
        return place.recognises(path)

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being one, where it looks like a half one."""
        return place.near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open it; `open_odometry` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: there are several drives or sequences in it, and none was chosen.
            DataError: something is missing or wrong.
        """
        check_option_names("opening KITTI's odometry benchmark", options, _READING_OPTIONS)
        return open_odometry(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene so; `write_odometry` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OutputError: the folder exists, or cannot be written.
        """
        check_option_names("writing KITTI's odometry benchmark", options, _WRITING_OPTIONS)
        return write_odometry(scene, path, overwrite=overwrite, **options)


FORMAT = OdometryFormat()
