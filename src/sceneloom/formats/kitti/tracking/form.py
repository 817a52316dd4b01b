"""What KITTI's tracking folders offer to the table of formats."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.kitti.tracking import place
from sceneloom.formats.kitti.tracking.reading import open_tracking
from sceneloom.formats.kitti.tracking.writing import write_tracking
from sceneloom.formats.kitti.written.holdings import TRACKING
from sceneloom.formats.loss import Holding, LossReport
from sceneloom.scene import Scene

_WRITING_OPTIONS: tuple[str, ...] = ("sequence",)
_READING_OPTIONS = ("sequence", "lenient")


class TrackingFormat:
    """Sequences of KITTI's tracking benchmark."""

    name = "kitti-tracking"
    suffixes: tuple[str, ...] = ("",)
    looks_like = "sequences of KITTI's tracking benchmark (velodyne/0000, image_02/0000, label_02, calib)"
    holds: Mapping[str, Holding] = TRACKING

    def recognises(self, path: Path) -> bool:
        """Say whether the path is such a folder."""
        return place.recognises(path)

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being one, where it looks like a half one."""
        return place.near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open it; `open_tracking` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: there are several drives or sequences in it, and none was chosen.
            DataError: something is missing or wrong.
        """
        check_option_names("opening KITTI's tracking benchmark", options, _READING_OPTIONS)
        return open_tracking(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene so; `write_tracking` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OutputError: the folder exists, or cannot be written.
        """
        check_option_names("writing KITTI's tracking benchmark", options, _WRITING_OPTIONS)
        return write_tracking(scene, path, overwrite=overwrite, **options)


FORMAT = TrackingFormat()
