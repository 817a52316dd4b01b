"""Addresses of files that are not on this machine's disks."""

import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+(::[a-zA-Z][a-zA-Z0-9+.-]+)*://")
"""A scheme of two letters or more, which no drive has, or several, as fsspec chains them."""


def is_url(path: object) -> bool:
    """Whether text is an address such as `https://host/drive.sfs` or `s3://bucket/drive.sfs`."""
    return isinstance(path, str) and _URL.match(path) is not None


def path_or_url(text: str | Path) -> Path | str:
    """Give the path that text names, `file://` resolved, or the text itself where it is a URL."""
    if isinstance(text, Path):
        return text
    if not is_url(text):
        return Path(text)
    parts = urlsplit(str(text))
    return Path(unquote(parts.path)) if parts.scheme.lower() == "file" else str(text)
