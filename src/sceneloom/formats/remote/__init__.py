"""Files and folders behind URLs: range reads, retries, messages without secrets. fsspec is wrapped here alone."""

from sceneloom.formats.remote.patience import Patience
from sceneloom.formats.remote.ranged import GAP, Range, RangedFile, RemoteIdentity, coalesced

__all__ = ["GAP", "Patience", "Range", "RangedFile", "RemoteIdentity", "coalesced"]
