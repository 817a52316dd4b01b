"""Whether a drive is still what it was: names, sizes and times of its files, without reading them."""

import os
from hashlib import blake2b
from pathlib import Path

from sceneloom.formats.urls import is_url


def fingerprint(place: str) -> str:
    """Tell a file or folder from what it was at another time; "" where it is not there, or behind a URL.

    Args:
        place: its path.
    """
    if is_url(place):
        return ""
    path = Path(place)
    told = blake2b(digest_size=16)
    try:
        for name, entry in _files(path):
            status = entry.stat()
            told.update(
                f"{name}\0{status.st_size}\0{status.st_mtime_ns}\n".encode("utf-8", "surrogateescape")
            )
    except OSError:
        return ""
    return told.hexdigest()


def _files(path: Path) -> list[tuple[str, Path]]:
    if not path.is_dir():
        return [(path.name, path)]
    found = []
    for folder, inner, files in os.walk(path):
        inner.sort()
        found += [(os.path.relpath(Path(folder, name), path), Path(folder, name)) for name in sorted(files)]
    return found
