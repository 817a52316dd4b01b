"""Whether a drive is still what it was: names, sizes and times of its files, without reading them."""

import os
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path

from sceneloom.errors import DataError, MissingExtraError
from sceneloom.formats.urls import is_url
from sceneloom.redaction import redacted


def fingerprint(place: str) -> str:
    """Tell a file or folder from what it was at another time.

    Behind a URL the mark that the server gives a content counts in place of the time.

    Args:
        place: its path or URL.

    Returns:
        "" where it is not there or refused, or where the server gives no marks: nobody knows then whether it changed.

    Raises:
        DataError: the server of a URL does not answer, which may pass.
    """
    told = blake2b(digest_size=16)
    try:
        for name, size, mark in _remote_files(place) if is_url(place) else _files(Path(place)):
            told.update(f"{name}\0{size}\0{mark}\n".encode("utf-8", "surrogateescape"))
    except OSError:
        return ""
    return told.hexdigest()


def _remote_files(url: str) -> list[tuple[str, int, str]]:
    from sceneloom.formats.remote import remote_contents

    try:
        found = remote_contents(url)
    except (DataError, MissingExtraError) as error:
        if error.passing:
            raise
        found = None
    if found is None:
        raise FileNotFoundError(redacted(url))
    return found


def _files(path: Path) -> Iterator[tuple[str, int, int]]:
    for name, entry in _places(path):
        status = entry.stat()
        yield name, status.st_size, status.st_mtime_ns


def _places(path: Path) -> list[tuple[str, Path]]:
    if not path.is_dir():
        return [(path.name, path)]
    found = []
    for folder, inner, files in os.walk(path):
        inner.sort()
        found += [(os.path.relpath(Path(folder, name), path), Path(folder, name)) for name in sorted(files)]
    return found
