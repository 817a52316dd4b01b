"""File names from ids: any id gives a name that stays in its folder and that every file system takes."""

from collections.abc import Iterable
from urllib.parse import quote
from zlib import crc32

from sceneloom.scene.types import Identifier

_LONGEST = 120
"""Longer ids are cut: most file systems allow 255 bytes for a name."""

_EMPTY = "%"
"""What stands for an empty id: no other id is written so."""


def file_stem(identifier: Identifier) -> str:
    """Rotate an id into a part of a file name; what a file name cannot hold is written as %XX."""
    stem = quote(str(identifier), safe=" ()+,=@").replace("~", "%7E")
    stem = f"%2E{stem[1:]}" if stem.startswith(".") else stem or _EMPTY
    return stem if len(stem) <= _LONGEST else f"{stem[:_LONGEST]}~{crc32(stem.encode()):08x}"


def file_stems(identifiers: Iterable[Identifier]) -> list[str]:
    """Rotate ids into parts of file names that differ from each other, in upper or lower case, too."""
    stems: list[str] = []
    taken: dict[str, int] = {}
    for stem in map(file_stem, identifiers):
        number = taken[stem.casefold()] = taken.get(stem.casefold(), 0) + 1
        stems.append(stem if number == 1 else f"{stem}~{number}")
    return stems
