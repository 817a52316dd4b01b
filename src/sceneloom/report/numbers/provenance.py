"""What a report was made of and by: versions, settings, and a hash of what was read."""

import hashlib
import platform
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.formats.files import open_file
from sceneloom.scene.scene import Scene
from sceneloom.version import __version__

MOST_HASHED = 1_000_000_000
"""Larger drives are hashed by names, sizes, first and last bytes of their files [bytes]."""
_ENDS = 1_000_000
_PACKAGES = ("numpy", "scipy", "numba", "av", "pillow")
_MOST_ENTRY = 400


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Where a report comes from.

    Attributes:
        made: when, in UTC, to the second.
        sceneloom, python, system: versions.
        packages: versions of what computes.
        settings: those of the report that were stated.
        sha256: of what was read; None where it is in memory, or behind a URL.
        hashed: what the hash is of: "file", "folder", or "ends" for names, sizes, and first and last bytes.
        size_bytes: of what was read.
        reported: what the drive reports how it came about, by name, as short texts.
    """

    made: str
    sceneloom: str
    python: str
    system: str
    packages: dict[str, str]
    settings: dict[str, str]
    sha256: str | None = None
    hashed: str | None = None
    size_bytes: int | None = None
    reported: dict[str, str] = msgspec.field(default_factory=dict)


def provenance_of(
    scene: Scene, path: Path | None, settings: Mapping[str, Any], *, made: datetime | None = None
) -> Provenance:
    """Collect what a report says of itself and of its source.

    Args:
        path: the file or folder that was read; None for others.
        settings: that were stated, by name.
        made: when; None for now.
    """
    digest, hashed, size = (None, None, None) if path is None else hash_of(path)
    return Provenance(
        made=(made or datetime.now(UTC)).astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        sceneloom=__version__,
        python=platform.python_version(),
        system=platform.system(),
        packages={name: _version(name) for name in _PACKAGES},
        settings={name: str(value) for name, value in settings.items()},
        sha256=digest,
        hashed=hashed,
        size_bytes=size,
        reported=_reported(scene),
    )


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "?"


def hash_of(path: Path) -> tuple[str | None, str | None, int | None]:
    """SHA-256 of a file, or of a folder's names and contents in order of the names; what it is of; the bytes.

    A file's hash is what `sha256sum` gives.
    """
    try:
        files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        sizes = [file.stat().st_size for file in files]
    except OSError:
        return None, None, None
    whole = sum(sizes) <= MOST_HASHED
    digest = hashlib.sha256()
    try:
        for file, size in zip(files, sizes, strict=True):
            if not (path.is_file() and whole):
                digest.update(
                    f"{file.relative_to(path).as_posix()}\0{size}\0".encode(errors="surrogateescape")
                )
            for part in _parts(file, size, whole=whole):
                digest.update(part)
    except OSError:
        return None, None, sum(sizes)
    kind = "ends" if not whole else "file" if path.is_file() else "folder"
    return digest.hexdigest(), kind, sum(sizes)


def _parts(file: Path, size: int, *, whole: bool) -> Iterator[bytes]:
    with open_file(file) as content:
        if whole:
            while part := content.read(_ENDS):
                yield part
            return
        yield content.read(_ENDS)
        content.seek(max(size - _ENDS, 0))
        yield content.read(_ENDS)


def _reported(scene: Scene) -> dict[str, str]:
    """Entries of a scene's metadata as texts, ours one by one, each cut off where it is long."""
    ours = scene.metadata.get("sceneloom")
    entries = {name: value for name, value in scene.metadata.items() if name != "sceneloom"}
    if isinstance(ours, Mapping):
        entries |= {f"sceneloom.{name}": value for name, value in ours.items()}
    return {str(name): _text(value) for name, value in list(entries.items())[:60]}


def _text(value: Any) -> str:
    try:
        text = msgspec.json.encode(value, enc_hook=_described).decode("utf-8", "replace")
    except (TypeError, ValueError, UnicodeError, RecursionError):
        text = _described(value)
    return text if len(text) <= _MOST_ENTRY else f"{text[:_MOST_ENTRY]}… ({len(text):,} characters)"


def _described(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    shape = getattr(value, "shape", None)
    return f"array {shape}" if shape is not None else str(value)[:_MOST_ENTRY]
