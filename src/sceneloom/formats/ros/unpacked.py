"""Bags whose messages are compressed one by one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.files import check_unpacked, most_unpacked
from sceneloom.formats.ros.bags import Bag, Connection


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
            packed = bytes(self.bag.data(number, k))
            most = most_unpacked(len(packed))
            with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
                content = memoryview(reader.read(most + 1))
        except (zstandard.ZstdError, MemoryError) as error:
            raise DataError(place, "", f"cannot be decompressed: {error}") from error
        check_unpacked(place, "", len(packed), len(content))
        return content

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        """How each message of a connection begins; they are unpacked whole."""
        return (bytes(self.data(number, k)[:size]) for k in range(len(self.received(number))))

    def close(self) -> None:
        """Release the file."""
        self.bag.close()
