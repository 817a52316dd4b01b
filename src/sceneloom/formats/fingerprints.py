"""Whether a drive is still what it was: names, sizes and times of its files, without reading them."""

import os
import time
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path
from threading import Lock

from sceneloom.errors import DataError, MissingExtraError
from sceneloom.formats.urls import is_url
from sceneloom.redaction import redacted

_LONG_SECONDS, _LASTING = 0.2, 20
_LATE: dict[str, tuple[str, float]] = {}
_LOCK = Lock()


def fingerprint(location: str) -> str:
    """Report a file or folder from what it was at another time.

    Behind a URL the mark that the server gives a content counts instead of the time.

    Args:
        location: its path or URL.

    Returns:
        "" where it is not there or refused, or where the server gives no marks: nobody knows then whether it changed.

    Raises:
        DataError: the server of a URL does not answer, which may pass.
    """
    reported = blake2b(digest_size=16)
    try:
        for name, size, mark in _remote_files(location) if is_url(location) else _files(Path(location)):
            reported.update(f"{name}\0{size}\0{mark}\n".encode("utf-8", "surrogateescape"))
    except OSError:
        return ""
    return reported.hexdigest()


def late_fingerprint(location: str) -> str:
    """Do as `fingerprint`, but of a data set whose files take long to look at, give for a while what was found before.

    One that is older than the reading of a drive lets the drive count as changed at worst. It is given twenty times as
    long as it took, so that the drives of a data set, each read for itself, wait little for it.
    """
    with _LOCK:
        found, until = _LATE.get(location, ("", 0.0))
        begun = time.monotonic()
        if begun < until:
            return found
        found = fingerprint(location)
        spent = time.monotonic() - begun
        _LATE.clear()
        if spent > _LONG_SECONDS:
            _LATE[location] = found, begun + _LASTING * spent
        return found


def _remote_files(url: str) -> list[tuple[str, int, str]]:
    from sceneloom.formats.remote.fetching import remote_contents

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
    for name, entry in _locations(path):
        status = entry.stat()
        yield name, status.st_size, status.st_mtime_ns


def _locations(path: Path) -> list[tuple[str, Path]]:
    if not path.is_dir():
        return [(path.name, path)]
    found = []
    for folder, inner, files in os.walk(path):
        inner.sort()
        found += [(os.path.relpath(Path(folder, name), path), Path(folder, name)) for name in sorted(files)]
    return found
