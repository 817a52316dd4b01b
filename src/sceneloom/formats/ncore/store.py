"""Component stores of NCore: groups and arrays of zarr 2 in an indexed tar archive or a folder, read and written.

An archive (`.zarr.itar`) is a tar file whose last block leads to an index of its members; a folder (`.zarr`) has a file
for each. Members are read one by one when they are asked for.

Source: "Zarr storage specification version 2"; "C-Blosc header format"; RFC 8949 (CBOR); `ncore.impl.data.stores` of
the package nvidia-ncore for the index.
"""

import json
import lzma
import math
import struct
import tarfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, UInt8Array
from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.base.files import FileIdentity, check_unpacked, open_file, read_bytes

ARCHIVE, FOLDER = ".zarr.itar", ".zarr"
"""Endings of the two kinds of stores."""

_CONSOLIDATED = ".zmetadata.cbor.xz"
_ATTRIBUTES, _GROUP, _ARRAY = ".zattrs", ".zgroup", ".zarray"
_INDEX = struct.Struct("<4sIQI")  # magic, kind, offset, size
_MAGIC, _XZ_CBOR = b"itar", 1
_COLUMNS = ("items", "offset_datas", "sizes")
_MOST_INDEX = 1 << 30  # unpacked [bytes]
_MOST_CHUNKS = 1 << 16


class Store:
    """One component store, opened for reading; pickled by its path.

    Attributes:
        path: the archive or folder.
    """

    def __init__(self, path: Path) -> None:
        """Read the index of an archive.

        Raises:
            DataError: it is no such store, or its index is damaged.
        """
        self.path = path
        self._members: dict[str, tuple[int, int]] = {}
        self._identity: FileIdentity | None = None
        if not path.is_dir():
            try:
                self._identity = FileIdentity.of(path)
                with open_file(path) as file:
                    self._members = _read_index(path, file, self._identity.size)
            except OSError as error:
                raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
        self._children: dict[str, list[str]] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopened, (self.path, self._identity)

    def check(self, identity: FileIdentity | None) -> None:
        """Refuse an archive that is not the one that was pickled."""
        if identity is not None:
            identity.check()

    def content(self, key: str) -> bytes | None:
        """The bytes of a member, None where there is none."""
        if self._identity is None:
            file = self.path.joinpath(*key.split("/"))
            return read_bytes(file) if file.is_file() else None
        if key not in self._members:
            return None
        self._identity.check()
        offset, size = self._members[key]
        try:
            with open_file(self.path) as stream:
                stream.seek(offset)
                content = stream.read(size)
        except OSError as error:
            raise DataError(self.path, key, f"cannot be read: {error.strerror or error}") from error
        if len(content) != size:
            raise DataError(self.path, key, f"{len(content)} bytes; expected {size}")
        return content

    def names(self, group: str) -> list[str]:
        """Names of the groups and arrays in a group."""
        if self._identity is None:
            folder = self.path.joinpath(*filter(None, group.split("/")))
            return sorted(entry.name for entry in folder.iterdir() if entry.is_dir()) if folder.is_dir() else []
        if self._children is None:
            found: dict[str, dict[str, None]] = {}
            for key in self._members:
                parts = key.split("/")[:-1]
                for k, name in enumerate(parts):
                    found.setdefault("/".join(parts[:k]), {})[name] = None
            self._children = {parent: sorted(names) for parent, names in found.items()}
        return self._children.get(group, [])

    def has_array(self, key: str) -> bool:
        """Whether there is an array."""
        return self.content(f"{key}/{_ARRAY}") is not None

    def attributes(self, key: str) -> dict[str, Any]:
        """What is stated of a group or array.

        Raises:
            DataError: it is no JSON object.
        """
        found = self._json(f"{key}/{_ATTRIBUTES}" if key else _ATTRIBUTES)
        return {} if found is None else found

    def array(self, key: str) -> AnyArray:
        """Read a whole array.

        Raises:
            DataError: it is missing, damaged, of a type that is none of NumPy's plain ones, or packed in a way that is
                not known.
            MissingExtraError: what unpacks it is not installed.
        """
        shape, chunks, dtype, about = self._layout(key)
        compressor = about.get("compressor")
        grid = [-(-length // chunk) for length, chunk in zip(shape, chunks, strict=True)]
        if math.prod(grid) > _MOST_CHUNKS:
            raise self._fault(key, f"{math.prod(grid)} chunks; expected {_MOST_CHUNKS} at most")
        separator = about.get("dimension_separator") or "."
        names = [separator.join(map(str, at)) or "0" for at in product(*map(range, grid))]
        packed = {name: content for name in names if (content := self.content(f"{key}/{name}")) is not None}
        whole = math.prod(shape) * dtype.itemsize
        check_unpacked(self.path, key, sum(map(len, packed.values())), whole)
        fill = about.get("fill_value")
        values = np.zeros(shape, dtype)
        if fill not in (None, 0, 0.0, "", False) and len(packed) < len(names):
            values[...] = math.nan if fill == "NaN" else fill
        size = math.prod(chunks) * dtype.itemsize
        for at, name in zip(product(*map(range, grid)), names, strict=True):
            if name not in packed:
                continue
            check_unpacked(self.path, f"{key}/{name}", len(packed[name]), size)
            content = self._unpacked(f"{key}/{name}", packed[name], compressor, size)
            chunk = np.frombuffer(content, dtype).reshape(chunks, order=about.get("order", "C"))
            target = tuple(
                slice(k * step, min((k + 1) * step, n)) for k, step, n in zip(at, chunks, shape, strict=True)
            )
            values[target] = chunk[tuple(slice(0, part.stop - part.start) for part in target)]
        return values

    def blob(self, key: str) -> tuple[bytes, str]:
        """The bytes of an array of one text, such as an encoded image, and its attribute `format`."""
        shape, _, dtype, about = self._layout(key)
        content = self.content(f"{key}/0")
        if shape or dtype.kind != "S" or content is None:
            raise self._fault(key, f"an array {shape} of {dtype}; expected one text of bytes")
        if about.get("compressor") is not None:
            check_unpacked(self.path, key, len(content), dtype.itemsize)
        content = self._unpacked(key, content, about.get("compressor"), dtype.itemsize)
        return content, str(self.attributes(key).get("format", ""))

    def _json(self, key: str) -> dict[str, Any] | None:
        content = self.content(key)
        if content is None:
            return None
        try:
            found = msgspec.json.decode(content)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            try:
                found = json.loads(content)  # numbers that are none, as Python writes them
            except (ValueError, RecursionError) as error:
                raise self._fault(key, f"is no JSON: {error}") from error
        if not isinstance(found, dict):
            raise self._fault(key, f"{type(found).__name__}; expected a JSON object")
        return found

    def _layout(self, key: str) -> tuple[tuple[int, ...], tuple[int, ...], np.dtype[Any], dict[str, Any]]:
        """Shape, shape of chunks, type and further properties of an array."""
        about = self._json(f"{key}/{_ARRAY}")
        if about is None:
            raise self._fault(key, "is missing; expected an array")
        shape, chunks = about.get("shape"), about.get("chunks")
        whole = False
        if isinstance(shape, list) and isinstance(chunks, list) and len(shape) == len(chunks):
            numbers = all(type(n) is int and 0 <= n < 1 << 40 for n in (*shape, *chunks))
            whole = numbers and all(n > 0 for n in chunks)
        if not whole or about.get("zarr_format") != 2 or about.get("filters") or about.get("order", "C") not in "CF":
            expected = "an array of zarr 2 with `shape` and `chunks`, and without filters"
            raise self._fault(key, f"{str(about)[:80]}; expected {expected}")
        try:
            dtype = np.dtype(about.get("dtype"))
        except (TypeError, ValueError, SyntaxError) as error:
            raise self._fault(key, f"dtype {about.get('dtype')!r}: {error}") from error
        if dtype.kind not in "fiubS" or dtype.itemsize == 0:
            raise self._fault(key, f"dtype {about.get('dtype')!r}; expected numbers or a text of bytes")
        return tuple(shape or ()), tuple(chunks or ()), dtype, about

    def _unpacked(self, key: str, content: bytes, compressor: Any, size: int) -> bytes:
        name = compressor.get("id") if isinstance(compressor, dict) else compressor
        if name is not None and name not in _CODECS:
            known = ", ".join(sorted(_CODECS))
            raise self._fault(key, f"packed by {name!r}; expected none or one of {known}")
        try:
            unpacked = content if name is None else _CODECS[name](content, size)
        except (ValueError, IndexError, struct.error, zlib.error) as error:
            raise self._fault(key, f"cannot be unpacked: {error}") from error
        if len(unpacked) != size:
            raise self._fault(key, f"{len(unpacked)} bytes; expected {size}")
        return unpacked

    def _fault(self, key: str, problem: str) -> DataError:
        return DataError(self.path, key, problem)


def _reopened(path: Path, identity: FileIdentity | None) -> Store:
    store = Store(path)
    store.check(identity)
    return store


def _read_index(path: Path, file: BinaryIO, size: int) -> dict[str, tuple[int, int]]:
    """Offsets and sizes of the members of an archive [bytes]."""
    file.seek(max(size - tarfile.BLOCKSIZE, 0))
    block = file.read(tarfile.BLOCKSIZE)
    magic, kind, start, length = _INDEX.unpack(block[: _INDEX.size].ljust(_INDEX.size, b"\0"))
    if magic != _MAGIC or kind != _XZ_CBOR:
        problem = f"its last block begins with {block[:4]!r}; expected the index of an indexed tar archive, b'itar'"
        raise DataError(path, "", f"{problem} of kind {_XZ_CBOR}: is the file cut off?")
    if start + length > size:
        raise DataError(path, "index", f"{length} bytes at {start}; the file has {size}")
    file.seek(start)
    try:
        unpacker = lzma.LZMADecompressor()
        content = unpacker.decompress(file.read(length), _MOST_INDEX)
        members = _members(_from_cbor(content), start)
    except (lzma.LZMAError, ValueError, KeyError, TypeError, IndexError, struct.error, RecursionError) as error:
        raise DataError(path, "index", f"is damaged: {error}") from error
    return members


def _members(table: Any, end: int) -> dict[str, tuple[int, int]]:
    """The rows of an index, whose members end before a byte; ValueError where one does not."""
    members = {}
    for name, offset, count in zip(*(table[name] for name in _COLUMNS), strict=True):
        if not isinstance(name, str) or type(offset) is not int or type(count) is not int:
            raise ValueError(f"a row {name!r}, {offset!r}, {count!r}")
        if not (offset >= 0 and count >= 0 and offset + count <= end):
            raise ValueError(f"{name}: {count} bytes at {offset}, beyond the members")
        members[name] = (offset, count)
    return members


# what chunks are packed with


def _from_zlib(content: bytes, size: int) -> bytes:
    unpacker = zlib.decompressobj(wbits=47)  # of zlib or gzip
    return unpacker.decompress(content, size + 1)


def _from_lz4(content: bytes, size: int) -> bytes:
    try:
        from lz4 import block
    except ImportError as error:
        raise MissingExtraError(f"this sequence needs lz4: install it with {how_to_install('ncore')}") from error
    try:
        unpacked: bytes = block.decompress(content, uncompressed_size=size)
    except block.LZ4BlockError as error:
        raise ValueError(str(error)) from error
    return unpacked


def _from_zstd(content: bytes, size: int) -> bytes:
    try:
        import zstandard
    except ImportError as error:
        raise MissingExtraError(f"this sequence needs zstandard: install it with {how_to_install('ncore')}") from error
    try:
        unpacked: bytes = zstandard.ZstdDecompressor().decompress(content, max_output_size=size)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error
    return unpacked


_BLOSC_HEAD = struct.Struct("<4B3I")  # version, version of the codec, flags, itemsize, bytes, block, packed bytes
_SHUFFLED, _COPIED, _BITS_SHUFFLED, _WHOLE = 1, 2, 4, 16
_INNER: Mapping[int, Callable[[bytes, int], bytes]] = MappingProxyType({1: _from_lz4, 3: _from_zlib, 4: _from_zstd})


def _from_blosc(content: bytes, size: int) -> bytes:
    """Unpack a buffer of C-Blosc 1.

    Source: "C-Blosc header format" and "README_CHUNK_FORMAT" of C-Blosc 1.
    """
    _, _, flags, itemsize, count, block, packed = _BLOSC_HEAD.unpack_from(content)
    if count != size or packed > len(content) or itemsize == 0 or (block == 0 and count):
        raise ValueError(f"a buffer of Blosc for {count} bytes; expected {size}")
    if flags & _COPIED:
        return content[_BLOSC_HEAD.size : _BLOSC_HEAD.size + count]
    if flags >> 5 not in _INNER:
        raise ValueError(f"codec {flags >> 5} of Blosc; expected LZ4, zlib or Zstandard")
    unpack = _INNER[flags >> 5]
    blocks = -(-count // block) if count else 0
    starts = struct.unpack_from(f"<{blocks}I", content, _BLOSC_HEAD.size)
    parts = []
    for k, start in enumerate(starts):
        length = min(block, count - k * block)
        streams = 1 if flags & _WHOLE or length < block else itemsize
        part, at = bytearray(), start
        for _ in range(streams):
            (packed,) = struct.unpack_from("<I", content, at)
            stream = content[at + 4 : at + 4 + packed]
            share = length // streams
            part += stream if packed == share else unpack(stream, share)
            at += 4 + packed
        parts.append(_unshuffled(np.frombuffer(part, np.uint8), itemsize, flags).tobytes())
    return b"".join(parts)


def _unshuffled(content: UInt8Array, itemsize: int, flags: int) -> UInt8Array:
    items = len(content) // itemsize
    whole = items * itemsize
    if flags & _BITS_SHUFFLED:
        if items % 8 or not items:
            return content
        bits = np.unpackbits(content[:whole].reshape(itemsize, 8, items // 8), axis=-1, bitorder="little")
        rows = np.packbits(bits.transpose(2, 0, 1), axis=-1, bitorder="little")
    elif flags & _SHUFFLED and itemsize > 1:
        rows = content[:whole].reshape(itemsize, items).T
    else:
        return content
    return np.concatenate([rows.reshape(-1), content[whole:]])


_CODECS: Mapping[str, Callable[[bytes, int], bytes]] = MappingProxyType(
    {"blosc": _from_blosc, "zlib": _from_zlib, "gzip": _from_zlib, "zstd": _from_zstd}
)


# CBOR, as far as the index has it


def _from_cbor(content: bytes) -> Any:
    value, end = _cbor_at(content, 0)
    if end != len(content):
        raise ValueError(f"{len(content) - end} bytes after the end")
    return value


def _cbor_at(content: bytes, at: int) -> tuple[Any, int]:
    """The value at an offset, and where the next one is."""
    kind, short = content[at] >> 5, content[at] & 31
    at += 1
    number: int = short
    if 24 <= short <= 27:
        width = 1 << (short - 24)
        if kind == 7 and width > 1:
            form = {2: ">e", 4: ">f", 8: ">d"}[width]
            return struct.unpack_from(form, content, at)[0], at + width
        if at + width > len(content):
            raise ValueError("it ends within a number")
        number, at = int.from_bytes(content[at : at + width], "big"), at + width
    elif short > 27:
        raise ValueError(f"a value of unknown length at byte {at - 1}")
    if kind < 2:
        return (number if kind == 0 else -1 - number), at
    if kind < 4:
        if at + number > len(content):
            raise ValueError("it ends within a text")
        raw = content[at : at + number]
        return (raw if kind == 2 else raw.decode()), at + number
    if kind < 6:
        if number > len(content):
            raise ValueError(f"a list of {number} values; there are {len(content)} bytes")
        values = []
        for _ in range(number * (kind - 3)):
            value, at = _cbor_at(content, at)
            values.append(value)
        return (values if kind == 4 else dict(zip(values[::2], values[1::2], strict=True))), at
    if kind == 6:
        return _cbor_at(content, at)
    return {20: False, 21: True}.get(number), at


def _to_cbor(value: Any) -> Iterator[bytes]:
    if value is None or isinstance(value, bool):
        yield {None: b"\xf6", False: b"\xf4", True: b"\xf5"}[value]
    elif isinstance(value, int):
        yield _cbor_head(0, value) if value >= 0 else _cbor_head(1, -1 - value)
    elif isinstance(value, float):
        yield b"\xfb" + struct.pack(">d", value)
    elif isinstance(value, str):
        raw = value.encode()
        yield _cbor_head(3, len(raw)) + raw
    elif isinstance(value, Mapping):
        yield _cbor_head(5, len(value))
        for key, one in value.items():
            yield from _to_cbor(key)
            yield from _to_cbor(one)
    else:
        yield _cbor_head(4, len(value))
        for one in value:
            yield from _to_cbor(one)


def _cbor_head(kind: int, number: int) -> bytes:
    if number < 24:
        return bytes([kind << 5 | number])
    power = next(power for power in range(4) if number < 1 << (8 << power))
    return bytes([kind << 5 | 24 + power]) + number.to_bytes(1 << power, "big")


class StoreWriter:
    """Writes an archive; what is put is on the disk at once, and only the index and metadata are kept."""

    def __init__(self, file: BinaryIO) -> None:
        """Begin an archive in an empty file."""
        self._file = file
        self._index: dict[str, tuple[int, int]] = {}
        self._metadata: dict[str, Any] = {}

    def group(self, key: str, attributes: Mapping[str, Any] | None = None) -> None:
        """Put a group; its parents have to be put as well."""
        prefix = f"{key}/" if key else ""
        self._put_json(prefix + _GROUP, {"zarr_format": 2})
        if attributes is not None:
            self._put_json(prefix + _ATTRIBUTES, attributes)

    def array(
        self,
        key: str,
        values: AnyArray,
        *,
        chunks: Sequence[int] | None = None,
        attributes: Mapping[str, Any] | None = None,
    ) -> None:
        """Put an array, packed with zlib.

        Args:
            key: its name.
            values: numbers.
            chunks: how many rows of the first axis a chunk has, and the length of the others; None for one chunk.
            attributes: what is stated of it.
        """
        values = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"), copy=False)
        sizes = [max(1, n) for n in (values.shape if chunks is None else chunks)]
        fill: Any = False if values.dtype.kind == "b" else 0.0 if values.dtype.kind == "f" else 0
        self._put_json(
            f"{key}/{_ARRAY}", _about(values.shape, sizes, values.dtype.str, {"id": "zlib", "level": 1}, fill)
        )
        if attributes is not None:
            self._put_json(f"{key}/{_ATTRIBUTES}", attributes)
        grid = [-(-n // size) for n, size in zip(values.shape, sizes, strict=True)]
        for at in product(*map(range, grid)):
            part = values[tuple(slice(k * size, (k + 1) * size) for k, size in zip(at, sizes, strict=True))]
            if part.shape != tuple(sizes):
                part = np.pad(part, [(0, size - n) for n, size in zip(part.shape, sizes, strict=True)])
            self._put(f"{key}/{'.'.join(map(str, at)) or '0'}", zlib.compress(np.ascontiguousarray(part).tobytes(), 1))

    def blob(self, key: str, content: bytes, form: str) -> None:
        """Put an array that is one text of bytes, as it is, and its format."""
        self._put_json(f"{key}/{_ARRAY}", _about((), (), f"|S{len(content)}", None, ""))
        self._put_json(f"{key}/{_ATTRIBUTES}", {"format": form})
        self._put(f"{key}/0", content)

    def finish(self) -> None:
        """Put the metadata of all once more together, and end the file with its index."""
        whole = {"zarr_consolidated_format": 1, "metadata": self._metadata}
        self._put(_CONSOLIDATED, lzma.compress(b"".join(_to_cbor(whole)), preset=1))
        self._file.write(bytes(2 * tarfile.BLOCKSIZE))
        self._fill(tarfile.RECORDSIZE)
        start = self._file.tell()
        rows = self._index.values()
        columns = ([*self._index], [offset for offset, _ in rows], [count for _, count in rows])
        table = dict(zip(_COLUMNS, columns, strict=True))
        packed = lzma.compress(b"".join(_to_cbor(table)), preset=1)
        self._file.write(packed)
        self._fill(tarfile.BLOCKSIZE)
        self._file.write(_INDEX.pack(_MAGIC, _XZ_CBOR, start, len(packed)))
        self._fill(tarfile.BLOCKSIZE)

    def _put_json(self, key: str, value: Mapping[str, Any]) -> None:
        self._metadata[key] = value
        self._put(key, json.dumps(value, allow_nan=False).encode())

    def _put(self, key: str, content: bytes) -> None:
        member = tarfile.TarInfo(key)
        member.size = len(content)
        self._file.write(member.tobuf(tarfile.PAX_FORMAT, "utf-8", "surrogateescape"))
        self._index[key] = (self._file.tell(), len(content))
        self._file.write(content)
        self._fill(tarfile.BLOCKSIZE)

    def _fill(self, size: int) -> None:
        self._file.write(bytes(-self._file.tell() % size))


def _about(
    shape: Sequence[int], chunks: Sequence[int], dtype: str, compressor: Mapping[str, Any] | None, fill: Any
) -> dict[str, Any]:
    """The properties of an array, as zarr 2 has them."""
    return {
        "zarr_format": 2,
        "shape": [*shape],
        "chunks": [*chunks],
        "dtype": dtype,
        "compressor": None if compressor is None else dict(compressor),
        "fill_value": fill,
        "order": "C",
        "filters": None,
    }
