"""Whether a file that is opened again is still the file that was opened first."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

from sceneloom.errors import DataError


class Identity(Protocol):
    """What reports a file, wherever it is, from one that takes its location."""

    @property
    def name(self) -> str:
        """What messages call it."""
        ...

    @property
    def path(self) -> Path | str:
        """Where other processes find it."""
        ...

    def check(self) -> None:
        """Refuse a file that is not the one that was opened."""
        ...


@dataclass(frozen=True, slots=True)
class FileIdentity:
    """A file as it was when it was opened.

    Attributes:
        name: what messages call it.
        path: where it is, from the root, so that processes in other folders find it.
        size: its length [bytes].
        modified_ns: when it was last written to [ns].
    """

    name: str
    path: Path
    size: int
    modified_ns: int

    @classmethod
    def of(cls, path: Path, *, descriptor: int | None = None) -> Self:
        """Look at a file, or at an open descriptor of it.

        Raises:
            OSError: it cannot be looked at.
        """
        status = path.stat() if descriptor is None else os.fstat(descriptor)
        return cls(str(path), path.absolute(), status.st_size, status.st_mtime_ns)

    def check(self) -> None:
        """Refuse a file that is not the one that was opened: what was read of it before would not fit.

        Raises:
            DataError: it was changed, replaced or removed.
        """
        try:
            now = self.path.stat()
        except OSError as error:
            problem = f"cannot be opened again: {error.strerror or error}"
            raise DataError(self.name, "", problem) from error
        if (now.st_size, now.st_mtime_ns) != (self.size, self.modified_ns):
            problem = (
                f"was changed after it was opened: it has {now.st_size} bytes and had {self.size}, "
                f"written {(now.st_mtime_ns - self.modified_ns) / 1e9:+.3f} s apart; open the scene anew"
            )
            raise DataError(self.name, "", problem)
