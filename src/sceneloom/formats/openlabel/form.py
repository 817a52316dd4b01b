"""What OpenLABEL offers to the table of formats."""

import re
from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.files import open_file
from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import LossReport
from sceneloom.formats.openlabel.holdings import HOLDS
from sceneloom.formats.openlabel.reading import read_openlabel
from sceneloom.formats.openlabel.writing import write_openlabel
from sceneloom.scene.scene import Scene

_BEGINNING = 4096
_FIRST = re.compile(rb"(?:\xef\xbb\xbf)?\s*\{\s*\"openlabel\"\s*:")
_OLD = re.compile(rb"\s*\{\s*\"vcd\"\s*:")
_READING_OPTIONS = ("lenient", "rate_hz")


class OpenLabelFormat:
    """Files of ASAM OpenLABEL 1.0."""

    name = "openlabel"
    suffixes: tuple[str, ...] = (".json",)
    looks_like = 'a .json file that begins with {"openlabel": …'
    holds: Holds = HOLDS

    def recognises(self, path: Path) -> bool:
        """Say whether the only member of the JSON of a file is `openlabel`."""
        return _FIRST.match(_beginning(path)) is not None

    def near_miss(self, path: Path) -> str | None:
        """Say what keeps a file from being of the format: it is older."""
        if _OLD.match(_beginning(path)) is None:
            return None
        return "it is of VCD, which OpenLABEL came from; bring it to OpenLABEL 1.0 with the program `vcd`"

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a file; `read_openlabel` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: the file is wrong.
        """
        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("opening OpenLABEL", given, _READING_OPTIONS)
        return read_openlabel(path, **given)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a file.

        Raises:
            UnknownOptionError: there are no options.
            OutputError: the file exists, or cannot be written.
        """
        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("writing OpenLABEL", given, ())
        return write_openlabel(scene, path, overwrite=overwrite)


def _beginning(path: Path) -> bytes:
    if not path.is_file():
        return b""
    try:
        with open_file(path) as file:
            return file.read(_BEGINNING)
    except OSError:
        return b""


FORMAT = OpenLabelFormat()
