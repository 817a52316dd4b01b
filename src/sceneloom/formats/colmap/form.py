"""What COLMAP offers to the table of formats: it is written, never read."""

from pathlib import Path
from typing import Any

from sceneloom.errors import OptionError, check_option_names
from sceneloom.formats.loss import LossReport
from sceneloom.formats.posed_pictures.settings import NAMES, PosedSettings
from sceneloom.formats.posed_pictures.writing_only import WrittenOnly
from sceneloom.scene.scene import Scene

FORMS = ("txt", "bin", "both")
"""How the model's files are written."""


class ColmapFormat(WrittenOnly):
    """Folders with `images` and `sparse/0`."""

    name = "colmap"
    suffixes: tuple[str, ...] = (".colmap",)
    looks_like = "a folder with images/ and sparse/0/cameras.txt, images.txt, points3D.txt"
    called = "a COLMAP model"

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a folder; the options are those of `PosedSettings`, and `model`: "txt", "bin" or "both".

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: a value cannot be followed, or the scene has no pictures.
            OutputError: the folder exists, or cannot be written.
        """
        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("writing COLMAP", given, (*NAMES, "model"))
        model = given.pop("model", FORMS[0])
        if model not in FORMS:
            raise OptionError(f"model {model!r}; expected one of {', '.join(FORMS)}")
        from sceneloom.formats.colmap.writing import write_colmap

        return write_colmap(scene, path, PosedSettings.of(**given), model=model, overwrite=overwrite)


FORMAT = ColmapFormat()
