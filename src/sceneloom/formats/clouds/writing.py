"""The kinds of files that points are written to, by suffix."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType

from sceneloom.errors import OptionError
from sceneloom.formats.clouds.las import LasWriter
from sceneloom.formats.clouds.pcd_writing import PcdWriter
from sceneloom.formats.clouds.ply_writing import PlyWriter
from sceneloom.formats.clouds.written import CloudWriter
from sceneloom.formats.output import replacing

_WRITERS: Mapping[str, Callable[[Path], CloudWriter]] = MappingProxyType(
    {".las": LasWriter, ".laz": LasWriter, ".ply": PlyWriter, ".pcd": PcdWriter}
)

WRITTEN_SUFFIXES = tuple(_WRITERS)
"""Endings of files that points can be written to."""


def check_cloud_suffix(path: Path) -> None:
    """Refuse a name of a file of points that says no kind of file.

    Raises:
        OptionError: naming those that can be written.
    """
    if path.suffix.lower() not in _WRITERS:
        raise OptionError(
            f"{path}: suffix {path.suffix!r}; expected one of {' '.join(WRITTEN_SUFFIXES)} for a cloud"
        )


@contextmanager
def open_cloud_writer(path: Path, *, overwrite: bool = False) -> Iterator[CloudWriter]:
    """Give what writes points to a file; it is there, whole, when the block ends without an error.

    Raises:
        OptionError: the suffix is none of `WRITTEN_SUFFIXES`.
        OutputError: the file exists, or cannot be written.
    """
    check_cloud_suffix(path)
    with replacing(path, overwrite=overwrite) as draft:
        writer = _WRITERS[path.suffix.lower()](draft)
        try:
            yield writer
        except BaseException:
            with suppress(Exception):  # the draft goes with its folder; what went wrong first is reported
                writer.close()
            raise
        writer.close()
