"""Folders whose names tell drives apart."""

from pathlib import Path


def named_folder(path: Path) -> Path:
    """Give a folder by a path that ends in its name, which `.` does not."""
    return path if path.name else path.resolve()
