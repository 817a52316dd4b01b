"""What nerfstudio offers to the table of formats: it is written, never read."""

from pathlib import Path
from typing import Any

from sceneloom.errors import check_option_names
from sceneloom.formats.loss import LossReport
from sceneloom.formats.posed_pictures.settings import NAMES, PosedSettings
from sceneloom.formats.posed_pictures.writing_only import WrittenOnly
from sceneloom.scene.scene import Scene


class NerfstudioFormat(WrittenOnly):
    """Folders with a `transforms.json`."""

    name = "nerfstudio"
    suffixes: tuple[str, ...] = (".nerfstudio",)
    looks_like = "a folder with transforms.json and images/"
    called = "a folder of nerfstudio"

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Write a folder; the options are those of `PosedSettings`.

        Raises:
            UnknownOptionError: an option is unknown.
            OptionError: a value cannot be followed, or the scene has no pictures.
            OutputError: the folder exists, or cannot be written.
        """
        given = {name: value for name, value in options.items() if value is not None}
        check_option_names("writing nerfstudio", given, NAMES)
        from sceneloom.formats.nerfstudio.writing import write_nerfstudio

        return write_nerfstudio(scene, path, PosedSettings.of(**given), overwrite=overwrite)


FORMAT = NerfstudioFormat()
