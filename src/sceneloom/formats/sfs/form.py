"""The row that this format has in the table of formats."""

from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.loss import LossReport
from sceneloom.formats.sfs.container import has_scene_header
from sceneloom.formats.sfs.examination import examine
from sceneloom.formats.sfs.faults import Examination
from sceneloom.formats.sfs.holdings import HOLDS
from sceneloom.formats.sfs.reading import read_scene
from sceneloom.formats.sfs.source import ReadingOptions
from sceneloom.formats.sfs.writing import write_scene
from sceneloom.formats.urls import path_or_url
from sceneloom.scene.scene import Scene


class SfsFormat:
    """Sensor Fusion Scene files."""

    name = "sfs"
    suffixes: tuple[str, ...] = (".sfs",)
    reads_urls = True
    looks_like = "a file that begins with the JSON header of a scene"
    holds = HOLDS
    holds_corrections = True

    def recognises(self, path: Path) -> bool:
        """Say whether a file begins with the header of a scene."""
        return has_scene_header(path)

    def open(self, path: Path | str, **options: Any) -> Scene:
        """Open a file, or the URL of one, lazily; the options are those of `ReadingOptions`, None for what is not said.

        Raises:
            DataError: the file is at fault.
            OptionError: an option or its value is not known.
        """
        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("opening a scene file", given, tuple(ReadingOptions.__dataclass_fields__))
        return read_scene(path_or_url(path), ReadingOptions(**given))

    def examine(self, path: Path | str, **options: Any) -> Examination:
        """Give all faults of a file, or of the URL of one, and the scene of all that is sound; options as for `open`.

        Raises:
            OptionError: an option or its value is not known.
        """
        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("opening a scene file", given, tuple(ReadingOptions.__dataclass_fields__))
        return examine(path_or_url(path), ReadingOptions(**given))

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a scene; the options are those of `write_scene`, None for what is not said.

        Raises:
            OptionError: an option or its value is not known, or something cannot be held by the format.
            DataError: a frame or picture cannot be read.
            OutputError: the file exists, or cannot be written.
        """
        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("writing a scene file", given, ("profile", "time_unit", "time_offset_ns"))
        return write_scene(scene, path, overwrite=overwrite, **given)


FORMAT = SfsFormat()
