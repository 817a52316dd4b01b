"""What the rig format offers to the table of formats."""

from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OutputError, check_option_names
from sceneloom.formats.holdings import Holds
from sceneloom.formats.loss import LossReport
from sceneloom.formats.rig.manifest import looks_like_manifest
from sceneloom.formats.rig.scene_from_rig import open_rig
from sceneloom.scene.scene import Scene

_READING_OPTIONS = ("lenient", "assume_model")


class RigFormat:
    """Folders with a `rig.toml`."""

    name = "rig"
    suffixes: tuple[str, ...] = (".toml",)
    looks_like = (
        "a folder with a rig.toml, which `sceneloom formats --template rig.toml --from FOLDER` writes"
    )

    writes = False
    holds: Holds = MappingProxyType({})

    def recognises(self, path: Path) -> bool:
        """Say whether the path is a folder with a `rig.toml`, that file, or a TOML file with sensors in it."""
        return looks_like_manifest(path)

    def open(self, path: Path, **options: Any) -> Scene:
        """Open a folder or its manifest; `open_rig` describes the options.

        Raises:
            UnknownOptionError: an option is unknown.
            DataError: the manifest, or what it names, is at fault.
        """
        check_option_names("opening a rig", options, _READING_OPTIONS)
        return open_rig(path, **options)

    def write(self, scene: Scene, path: Path, *, overwrite: bool = False, **options: Any) -> LossReport:
        """Refuse: the folder is there for data that other programs wrote.

        Raises:
            OutputError: always.
        """
        del scene, overwrite, options
        raise OutputError(
            f"{path}: a rig is only read; write a scene file (drive.sfs) or a recording (a folder) in its place, "
            "or begin a manifest with `sceneloom formats --template rig.toml`"
        )


FORMAT = RigFormat()
