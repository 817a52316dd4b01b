"""Chunks of MCAP files that are compressed; the libraries are imported when there is one."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, cast

from sceneloom.errors import MissingExtraError, OptionError, how_to_install
from sceneloom.formats.files import most_unpacked

COMPRESSIONS = ("none", "lz4", "zstd")
"""What chunks can be compressed with."""


def compressor(name: str) -> Callable[[bytes], bytes] | None:
    """Give what compresses a chunk; None for "none".

    Raises:
        OptionError: there is no compression of that name.
        MissingExtraError: its library is not installed.
    """
    if name not in COMPRESSIONS:
        raise OptionError(f"compression {name!r}; expected one of {', '.join(COMPRESSIONS)}")
    if name == "none":
        return None
    if name == "lz4":
        return cast("Callable[[bytes], bytes]", _lz4().compress)
    return cast("Callable[[bytes], bytes]", _zstd().ZstdCompressor(level=1).compress)


def decompress(compression: str, content: bytes, size: int) -> bytes:
    """Give the first `size` bytes of what was compressed.

    Raises:
        ValueError: the bytes are damaged, of a compression that is not known, or would become too many.
        MissingExtraError: its library is not installed.
    """
    if compression not in _DECOMPRESSORS:
        raise ValueError(f"compression {compression!r}; expected one of {', '.join(_DECOMPRESSORS)}")
    check_ratio(compression, content, size)
    return _DECOMPRESSORS[compression](content, size)


def check_ratio(compression: str, content: bytes, size: int) -> None:
    """Refuse to unpack what declares to become far more than chunks of messages do, before memory is asked for.

    Raises:
        ValueError: it is compressed, and `size` is more than `most_unpacked` allows.
    """
    most = most_unpacked(len(content))
    if compression and size > most:
        raise ValueError(f"{len(content)} bytes that unpack to {size}; expected {most} at most")


def _lz4() -> Any:
    try:
        import lz4.frame
    except ImportError as missing:
        raise _missing(missing) from missing
    return lz4.frame


def _zstd() -> Any:
    try:
        import zstandard
    except ImportError as missing:
        raise _missing(missing) from missing
    return zstandard


def _missing(error: ImportError) -> MissingExtraError:
    return MissingExtraError(f"{error}; install the extra: {how_to_install('mcap')}")


def _from_lz4(content: bytes, size: int) -> bytes:
    try:
        found: bytes = _lz4().LZ4FrameDecompressor().decompress(content, max_length=size)
    except (RuntimeError, EOFError, MemoryError) as error:
        raise ValueError(f"cannot be decompressed as lz4: {error}") from error
    return found


def _from_zstd(content: bytes, size: int) -> bytes:
    library = _zstd()
    try:
        with library.ZstdDecompressor().stream_reader(content) as reader:
            found: bytes = reader.read(size)
    except (library.ZstdError, MemoryError) as error:
        raise ValueError(f"cannot be decompressed as zstd: {error}") from error
    return found


_DECOMPRESSORS: Mapping[str, Callable[[bytes, int], bytes]] = MappingProxyType(
    {"": lambda content, size: content[:size], "lz4": _from_lz4, "zstd": _from_zstd}
)
