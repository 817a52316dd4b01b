"""What every kind of bag offers: connections, and their messages by number."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from sceneloom.arrays import Int64Array


@dataclass(frozen=True, slots=True)
class Connection:
    """A stream of messages of one type.

    Attributes:
        topic: that they are on.
        type: of the messages, "package/msg/Name".
        definition: text that defines the type; "" where the bag has none.
        form: of the text: "ros1msg", "ros2msg" or "ros2idl".
        encoding: of the messages: "cdr" or "ros1".
    """

    topic: str
    type: str
    definition: str
    form: str
    encoding: str


class Bag(Protocol):
    """One file of a bag; it can be pickled."""

    @property
    def connections(self) -> Sequence[Connection]:
        """All streams."""
        ...

    def received(self, number: int) -> Int64Array:
        """When the messages of a connection were recorded, (N,) int64 [ns], in the order of the file."""
        ...

    def data(self, number: int, k: int) -> memoryview:
        """The bytes of message `k` of a connection."""
        ...

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        """How each message of a connection begins."""
        ...

    def close(self) -> None:
        """Release the file."""
        ...


def full_type(name: str) -> str:
    """The name of a type as ROS 2 has it: `sensor_msgs/Image` of ROS 1 is `sensor_msgs/msg/Image`."""
    package, _, rest = name.partition("/")
    return name if not rest or "/" in rest else f"{package}/msg/{rest}"
