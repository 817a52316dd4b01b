"""What folders of the EuRoC layout offer to the table of formats: they are only read."""

from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError, check_option_names
from sceneloom.formats.euroc_mav.place import mav_folder, near_miss
from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import LossReport
from sceneloom.scene.scene import Scene


class EurocFormat:
    """Folders with `mav0/cam0` and `mav0/imu0`."""

    name = "euroc-mav"
    suffixes: tuple[str, ...] = (".mav0",)
    looks_like = "a folder with mav0/cam0/data.csv or mav0/imu0/data.csv, as the EuRoC datasets have them"
    writes = False
    holds: Holds = MappingProxyType({})

    def recognises(self, path: Path) -> bool:
        """Say whether the path is such a folder, or its `mav0`."""
        return mav_folder(path) is not None

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a folder with a `mav0` from being a drive."""
        return near_miss(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a folder; the option `lenient` leaves out what is wrong, and counts it.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: files are missing or wrong.
        """
        from sceneloom.formats.euroc_mav.reading import read_euroc

        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("opening a EuRoC folder", given, ("lenient",))
        return read_euroc(path, **given)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Refuse: such folders are only read.

        Raises:
            OptionError: always.
        """
        del scene, overwrite, options
        raise OptionError(
            f"{path}: a EuRoC folder is only read; write a scene file (drive.sfs), a recording (a folder), or its "
            "trajectory (way.csv)"
        )


FORMAT = EurocFormat()
