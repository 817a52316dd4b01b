"""What the reader of a format of messages has to offer, so that a scene can be made of its topics."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from sceneloom.arrays import Int64Array
from sceneloom.formats.topics.records import AnyRecord, Kind


@dataclass(frozen=True, slots=True)
class Topic:
    """A stream of messages.

    Attributes:
        number: of the stream in its log.
        name: of the topic.
        schema: name of the messages' type.
        kind: what they state; None where we do not know such messages.
        count: how many there are.
        why: what keeps us from reading them, where `kind` is None.
    """

    number: int
    name: str
    schema: str
    kind: Kind | None
    count: int
    why: str = "of a type that is not read"


class TopicLog(Protocol):
    """Messages that are read by their topic and number, in the order of the file; it can be pickled."""

    @property
    def name(self) -> str:
        """What messages call the log."""
        ...

    @property
    def topics(self) -> Sequence[Topic]:
        """All streams."""
        ...

    @property
    def notes(self) -> str | None:
        """What our own writer left as JSON, or None."""
        ...

    def receive_times(self, topic: Topic) -> Int64Array:
        """When each message was recorded, (N,) int64 [ns]."""
        ...

    def timestamps(self, topic: Topic) -> tuple[Int64Array, bool]:
        """The time that each message says itself, (N,) int64 [ns], and whether all of them were looked at."""
        ...

    def read(self, topic: Topic, k: int) -> Sequence[AnyRecord]:
        """What message `k` says."""
        ...

    def close(self) -> None:
        """Release the files."""
        ...
