"""File names from ids: any id gives a name that stays in its folder and that every file system takes."""

from urllib.parse import quote
from zlib import crc32

from sceneloom.scene import Identifier

_LONGEST = 120
"""Longer ids are cut: most file systems allow 255 bytes for a name."""


def file_stem(identifier: Identifier) -> str:
    """Turn an id into a part of a file name; what a file name cannot hold is written as %XX."""
    stem = quote(str(identifier), safe=" ()+,=@").replace("~", "%7E")
    stem = f"%2E{stem[1:]}" if stem.startswith(".") else stem
    return stem if len(stem) <= _LONGEST else f"{stem[:_LONGEST]}~{crc32(stem.encode()):08x}"
