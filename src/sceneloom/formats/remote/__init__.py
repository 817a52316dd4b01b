"""Files and folders behind URLs: range reads, retries, messages without secrets. fsspec is wrapped here alone."""

from sceneloom.formats.remote.fetching import Fetched, fetch, find_urls, names_below, remote_contents
from sceneloom.formats.remote.patience import Patience
from sceneloom.formats.remote.ranged import GAP, Range, RangedFile, RemoteIdentity, coalesced
from sceneloom.formats.remote.uploads import (
    MARKER,
    check_remote_output,
    output_name,
    put_first,
    upload,
    uploading,
)

__all__ = [
    "GAP",
    "MARKER",
    "Fetched",
    "Patience",
    "Range",
    "RangedFile",
    "RemoteIdentity",
    "check_remote_output",
    "coalesced",
    "fetch",
    "find_urls",
    "names_below",
    "output_name",
    "put_first",
    "remote_contents",
    "upload",
    "uploading",
]
