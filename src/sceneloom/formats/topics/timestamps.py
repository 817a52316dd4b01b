"""The times of messages: what their heads state counts, unless that cannot be; then when they were received does."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.topics.log import Topic
from sceneloom.scene.warnings import WarningKind

TIMESTAMPS = ("header", "receive")
"""Which times can be asked for."""

FAR_NS = 60_000_000_000
"""No network delays messages by more than this: another clock timestamped them."""

_ZERO_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class TopicTimes:
    """The times of one topic's messages.

    Attributes:
        topic: the topic.
        timestamps_ns: (N,) int64 [ns], as the messages state.
        received_ns: (N,) int64 [ns], when they were recorded.
        fixed: whether the messages state what always holds, at whatever time.
    """

    topic: Topic
    timestamps_ns: Int64Array
    received_ns: Int64Array
    fixed: bool = False

    @property
    def unset(self) -> BoolArray:
        """(N,) bool, which messages are timestamped 0 and were received at another time."""
        unset: BoolArray = (self.timestamps_ns == 0) & (np.abs(self.received_ns) > _ZERO_NS)
        return unset

    @property
    def delay_ns(self) -> int | None:
        """How long after its timestamp a message was received, in the middle; None where no message has a timestamp."""
        timestamped = ~self.unset
        if self.fixed or not timestamped.any():
            return None
        return int(np.median(self.received_ns[timestamped] - self.timestamps_ns[timestamped]))


def settle_times(
    all_times: Sequence[TopicTimes], name: str, ledger: Ledger, *, wanted: str | None
) -> dict[int, Int64Array]:
    """Decide which time of each message counts.

    Args:
        all_times: of all topics.
        name: what messages call the log.
        ledger: takes what was decided.
        wanted: "header" or "receive" for all messages; None: the head's, unless topics are on different clocks.

    Returns:
        (N,) int64 [ns] by the number of the topic.

    Raises:
        DataError: the heads of some topics are on another clock than those of others.
        OptionError: `wanted` is none of the two.
    """
    if wanted not in (None, *TIMESTAMPS):
        raise OptionError(f"timestamps {wanted!r}; expected one of {', '.join(TIMESTAMPS)}")
    strangers = _strangers(all_times, name, ledger) if wanted is None else frozenset()
    found = {}
    for times in all_times:
        if wanted == "receive" or times.topic.number in strangers:
            found[times.topic.number] = times.received_ns
            continue
        unset = times.unset
        if unset.any() and not times.fixed:
            message = "messages timestamped 0; the time at which they were received counts"
            location = f"{name}: {times.topic.name}"
            ledger.note(WarningKind.REPAIRED, "timestamps-zero", location, message, count=int(unset.sum()))
        found[times.topic.number] = np.where(unset, times.received_ns, times.timestamps_ns)
    return found


def _strangers(all_times: Sequence[TopicTimes], name: str, ledger: Ledger) -> frozenset[int]:
    """The topics whose timestamps are of another clock than those of the others."""
    delays = {
        times.topic.number: (times.topic.name, delay)
        for times in all_times
        if (delay := times.delay_ns) is not None
    }
    if not delays:
        return frozenset()
    near = {number for number, (_, delay) in delays.items() if abs(delay) <= FAR_NS}
    if not near:
        usual = int(np.median([delay for _, delay in delays.values()]))
        near = {number for number, (_, delay) in delays.items() if abs(delay - usual) <= FAR_NS}
        message = f"messages were received {usual / 1e9:.3f} s after their timestamps; the timestamps count"
        ledger.note(WarningKind.ASSUMED, "received-much-later", name, message, count=len(near))
    far = {number: row for number, row in delays.items() if number not in near}
    if far:
        reported = "; ".join(f"{topic} {delay / 1e9:+.3f} s" for topic, delay in sorted(far.values()))
        usual = int(np.median([delays[number][1] for number in near]))
        problem = (
            f"mixed time bases: messages were received {usual / 1e9:+.3f} s after their timestamps, but of {reported}; "
            'expected one clock: state timestamps="receive" to go by when they were received, timestamps="header" by '
            "the "
            "timestamps as they are, or `--lenient` to go by when those few were received"
        )
        ledger.fault("mixed-time-bases", DataError(name, "", problem), count=len(far))
    return frozenset(far)


def in_order(timestamps_ns: Int64Array, location: str, ledger: Ledger) -> Int64Array:
    """Give the rows in the order of their times, the first of several with one time."""
    if (np.diff(timestamps_ns) < 0).any():
        count = int((np.diff(timestamps_ns) < 0).sum())
        message = "messages out of order; sorted by their times"
        ledger.note(WarningKind.REPAIRED, "messages-sorted", location, message, count=count)
    _, rows = np.unique(timestamps_ns, return_index=True)
    if len(rows) < len(timestamps_ns):
        message = "messages with the time of another one; the first counts"
        ledger.note(
            WarningKind.SKIPPED,
            "repeated-timestamps",
            location,
            message,
            count=len(timestamps_ns) - len(rows),
        )
    return rows.astype(np.int64)
