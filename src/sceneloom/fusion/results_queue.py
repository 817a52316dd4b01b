"""Results on their way out, clause 5.7: numbered, reported, and kept until they are fetched."""

from collections.abc import Callable

from sceneloom.fusion.algorithms import FusionType
from sceneloom.fusion.counters import Counters
from sceneloom.fusion.events import Announcer, Result
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.records import ResultRecord, size_of
from sceneloom.fusion.results import ResultQueue
from sceneloom.fusion.rig import RigResult


class ResultsQueue:
    """The results of both fusion types: given by one thread at a time, fetched by several."""

    def __init__(
        self,
        counters: Counters,
        announcer: Announcer,
        *,
        on_result: Callable[[], None] | None,
        most_bytes: int,
    ) -> None:
        """Hold nothing yet.

        Args:
            counters: where results are counted.
            announcer: reported each result.
            on_result: called as soon as a result can be fetched.
            most_bytes: how large the results of one type that wait may be together.
        """
        self._counters = counters
        self._announcer = announcer
        self._on_result = on_result
        self._most_bytes = most_bytes
        self._given = dict.fromkeys(FusionType, 0)
        self._queues: dict[FusionType, ResultQueue[Result]] = {kind: ResultQueue() for kind in FusionType}

    def __len__(self) -> int:
        """How many results wait to be fetched."""
        return sum(len(queue) for queue in self._queues.values())

    def give(self, found: RigResult) -> None:
        """Let a result be fetched."""
        kind, record, properties = _type_of(found.record), found.record, found.setting.properties
        result = Result(self._given[kind], record, properties, found.found)
        self._given[kind] += 1
        self._counters.add(_COUNTED[kind])
        self._announcer.notify(result)
        dropped = self._queues[kind].put(
            result,
            size=size_of(record),
            most=properties["result_queue_length"],
            most_bytes=self._most_bytes,
        )
        self._counters.add("dropped.results", dropped)
        if self._on_result is not None:
            self._on_result()

    def get(self, kind: FusionType, timeout_s: float) -> Result | None:
        """Fetch the oldest result, waiting for one; None where none came in time."""
        return self._queues[kind].get(timeout_s)

    def put_back(self, result: Result) -> None:
        """Take back a result that could not be delivered; it is the next one again."""
        self._queues[_type_of(result.record)].put_back(
            result, size=size_of(result.record), before=lambda other: result.number < other.number
        )
        if self._on_result is not None:
            self._on_result()

    def close(self) -> None:
        """Let all who wait for results go."""
        for queue in self._queues.values():
            queue.close()


_COUNTED = {kind: f"results.{kind.name.lower()}" for kind in FusionType}


def _type_of(record: ResultRecord) -> FusionType:
    return FusionType.DETECTIONS if isinstance(record, FusedDetections) else FusionType.SENSOR_DATA
