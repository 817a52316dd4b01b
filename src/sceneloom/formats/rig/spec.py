"""Own data: a folder of clouds, images and tables that a manifest `rig.toml` describes. Only read."""

import re
from pathlib import Path

from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.spec import FormatSpec

MANIFEST = "rig.toml"
"""Name of the manifest in a folder."""

_DIGITS = re.compile(r"(\d+)")


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Order numbers inside names by their value: 2 before 10."""
    parts = _DIGITS.split(path.as_posix())
    return tuple((1, int(part), part) if part.isdecimal() and part.isascii() else (0, 0, part) for part in parts)


def _looks_like_manifest(path: Path) -> bool:
    """Whether a path is a folder with a `rig.toml`, that file, or another TOML file with sensors in it."""
    manifest = path / MANIFEST if path.is_dir() else path
    if not manifest.is_file() or manifest.suffix.lower() != ".toml":
        return False
    if manifest.name == MANIFEST:
        return True
    import tomllib

    try:
        text = read_bytes(manifest).decode("utf-8-sig")
        return "sensors" in tomllib.loads(text.replace("\r\n", "\n"), parse_float=str)
    except (DataError, OSError, ValueError, RecursionError):
        return False


FORMAT = FormatSpec(
    name="rig",
    title="a rig",
    looks_like="a folder with a rig.toml, which `sceneloom formats --template rig.toml --from FOLDER` writes",
    suffixes=(".toml",),
    sniff=_looks_like_manifest,
    reader="sceneloom.formats.rig.reader:open_rig",
    read_options=("lenient", "assume_model", "rig"),
    instead="a rig is only read; write a scene file (drive.sfs) or a recording (a folder) instead, or begin a "
    "manifest with `sceneloom formats --template rig.toml`",
)
