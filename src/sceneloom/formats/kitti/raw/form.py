"""What KITTI's raw folders offer to the table of formats."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.kitti.raw import place
from sceneloom.formats.kitti.raw.reading import open_raw
from sceneloom.formats.kitti.raw.writing import write_raw
from sceneloom.formats.kitti.written.holdings import RAW
from sceneloom.formats.loss import Holding, LossReport
from sceneloom.scene import Scene

_WRITING_OPTIONS = ("kind", "sequence")
_READING_OPTIONS = ("sequence", "lenient")


class RawFormat:
    """Drives of KITTI's raw data."""

    name = "kitti-raw"
    suffixes: tuple[str, ...] = ("",)
    looks_like = "a drive of KITTI's raw data (2011_09_26_drive_0001_sync), or the folder of its day"
    holds: Mapping[str, Holding] = RAW

    def recognises(self, path: Path) -> bool:
        """Say whether the path is such a folder."""
        return path.is_dir() and (place.is_drive(path) or bool(place.drives_below(path)))

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being one, where it looks like a half one."""
        return place.near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open it; `open_raw` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: there are several drives or sequences in it, and none was chosen.
            DataError: something is missing or wrong.
        """
        check_option_names("opening KITTI's raw data", options, _READING_OPTIONS)
        return open_raw(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene so; `write_raw` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OutputError: the folder exists, or cannot be written.
        """
        check_option_names("writing KITTI's raw data", options, _WRITING_OPTIONS)
        return write_raw(scene, path, overwrite=overwrite, **options)


FORMAT = RawFormat()
