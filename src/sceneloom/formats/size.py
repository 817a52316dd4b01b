"""How much a recording or a scene takes on disk."""

from pathlib import Path


def size_on_disk(path: Path | str) -> int | None:
    """Bytes of a file, or of all files below a folder; None for what is behind a URL."""
    if isinstance(path, str):
        return None
    if path.is_file():
        return path.stat().st_size
    return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())
