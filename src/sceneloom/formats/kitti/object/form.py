"""What KITTI's object folders offer to the table of formats."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.kitti.object import place
from sceneloom.formats.kitti.object.reading import open_object
from sceneloom.formats.kitti.object.writing import write_object
from sceneloom.formats.kitti.written.holdings import OBJECT
from sceneloom.formats.loss import Holding, LossReport
from sceneloom.scene import Scene

_WRITING_OPTIONS: tuple[str, ...] = ()
_READING_OPTIONS = ("lenient",)


class ObjectFormat:
    """Frames of KITTI's object benchmark."""

    name = "kitti-object"
    suffixes: tuple[str, ...] = ("",)
    looks_like = "frames of KITTI's object benchmark (velodyne, image_2, calib, label_2)"
    holds: Mapping[str, Holding] = OBJECT

    def recognises(self, path: Path) -> bool:
        """Say whether the path is such a folder."""
        return place.recognises(path)

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder from being one, where it looks like a half one."""
        return place.near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open it; `open_object` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: there are several drives or sequences in it, and none was chosen.
            DataError: something is missing or wrong.
        """
        check_option_names("opening KITTI's object benchmark", options, _READING_OPTIONS)
        return open_object(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene so; `write_object` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            OutputError: the folder exists, or cannot be written.
        """
        check_option_names("writing KITTI's object benchmark", options, _WRITING_OPTIONS)
        return write_object(scene, path, overwrite=overwrite, **options)


FORMAT = ObjectFormat()
