"""Bags whose messages are compressed one by one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.ros.bags import Bag, Connection

_LARGEST = 1 << 31


@dataclass(frozen=True, slots=True, eq=False)
class UnpackedBag:
    """Unpacks the messages of a bag as they are read."""

    bag: Bag
    compression: str

    @property
    def connections(self) -> Sequence[Connection]:
        """All streams."""
        return self.bag.connections

    def received(self, number: int) -> Int64Array:
        """When the messages of a connection were recorded."""
        return self.bag.received(number)

    def data(self, number: int, k: int) -> memoryview:
        """The bytes of message `k` of a connection.

        Raises:
            DataError: it is damaged, or of another compression than zstd.
        """
        place = f"{self.connections[number].topic}[{k}]"
        if self.compression != "zstd":
            raise DataError(place, "", f"compression {self.compression!r}; expected zstd")
        try:
            import zstandard
        except ImportError as missing:
            raise MissingExtraError(f"{missing}; install the extra: {how_to_install('ros')}") from missing
        try:
            with zstandard.ZstdDecompressor().stream_reader(bytes(self.bag.data(number, k))) as reader:
                return memoryview(reader.read(_LARGEST))
        except (zstandard.ZstdError, MemoryError) as error:
            raise DataError(place, "", f"cannot be decompressed: {error}") from error

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        """How each message of a connection begins; they are unpacked whole."""
        return (bytes(self.data(number, k)[:size]) for k in range(len(self.received(number))))

    def close(self) -> None:
        """Release the file."""
        self.bag.close()
