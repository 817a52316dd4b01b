"""In which order lines of one time stand: told by a rank of each stream, and by what deviates from that."""

from collections.abc import Mapping, Sequence
from heapq import heappop, heappush
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt16Array
from sceneloom.formats.recording.column_arrays import is_sorted, line_seconds, nanoseconds
from sceneloom.formats.recording.columns import NOTHING, SEVERAL, TEXT, RecordingColumns

BEFORE_ALL_NS = -(2**63)
"""Stands for the time of lines without one that no line with one comes before."""

FRAMES, OTHER, SHARED = "frames", "other", "shared"
"""Names of the streams of pictures, of lines kept as text, and of lines that several streams have a part in."""


class LineOrder(msgspec.Struct):
    """The order of lines of one time.

    Attributes:
        streams: names, in the order in which their lines usually stand.
        exceptions: by time [ns] as text, for each line of that time the place of its stream in `streams`.
    """

    streams: list[str] = []
    exceptions: dict[str, list[int]] = {}

    def ranks(self, names: Sequence[str]) -> Int64Array:
        """Give the rank of each of some streams, (N,) int64; those that are not known come last, in their order."""
        known = {name: rank for rank, name in enumerate(self.streams)}
        return np.array([known.get(name, len(known) + place) for place, name in enumerate(names)], np.int64)

    def places(self, names: Sequence[str], stamps: Sequence[Int64Array]) -> list[Int64Array]:
        """Give the place of each line of each stream among those of its time.

        Args:
            names: of the streams.
            stamps: their times, (N,) int64 [ns], ascending.
        """
        ranks = self.ranks(names)
        places = [np.full(len(times), rank, np.int64) for times, rank in zip(stamps, ranks, strict=True)]
        index = {name: place for place, name in enumerate(names)}
        for text, sequence in self.exceptions.items():
            members = [index.get(self.streams[rank], -1) for rank in sequence if rank < len(self.streams)]
            spans = {m: _span(stamps[m], int(text)) for m in set(members) if m >= 0}
            counts = {m: members.count(m) for m in spans}
            if any(len(range(*span.indices(1 << 62))) != counts[m] for m, span in spans.items()):
                continue
            for m, span in spans.items():
                places[m][span] = [place for place, member in enumerate(members) if member == m]
        return places


def _span(stamps: Int64Array, timestamp_ns: int) -> slice:
    return slice(
        int(np.searchsorted(stamps, timestamp_ns)), int(np.searchsorted(stamps, timestamp_ns, side="right"))
    )


def filled_seconds(columns: RecordingColumns) -> Float64Array:
    """Give the time of each line in the order of the file, (N,) float64 [s]; of lines without one, that before.

    Lines without one that no line with one comes before have -inf.
    """
    seconds = line_seconds(columns)
    timed = ~np.isnan(seconds)
    if timed.all():
        return seconds
    last = np.maximum.accumulate(np.where(timed, np.arange(len(seconds)), -1))
    return np.where(last >= 0, seconds[last], -np.inf)


def line_order(
    columns: RecordingColumns, names: Mapping[int, str], as_text: Int64Array, seconds: Float64Array
) -> dict[str, Any]:
    """Find the order of lines of one time; empty where no two lines of different streams have one.

    Args:
        names: of the streams, by their codes.
        as_text: (M,) int64, numbers of lines whose samples are kept as text.
        seconds: (N,) float64 [s], times of the lines.
    """
    codes = np.array(columns.log.codes, np.uint16)
    codes[as_text - 1] = TEXT
    known = np.flatnonzero(codes != NOTHING)
    codes, seconds = codes[known], seconds[known]
    if not is_sorted(seconds):
        order = np.argsort(seconds, kind="stable")
        codes, seconds = codes[order], seconds[order]
    tied = np.flatnonzero((seconds[1:] == seconds[:-1]) & (codes[1:] != codes[:-1]))
    if not len(tied):
        return {}
    by_rank = _usual_order(codes, tied)
    ranks = np.zeros(int(codes.max()) + 1, np.int64)
    ranks[by_rank] = np.arange(len(by_rank))
    against = tied[ranks[codes[tied]] > ranks[codes[tied + 1]]]
    stamps = _stamps(seconds)
    exceptions = {
        str(stamp): ranks[codes[_span(stamps, stamp)]].tolist()
        for stamp in np.unique(stamps[against]).tolist()
    }
    special = {TEXT: OTHER, SEVERAL: SHARED, columns.frames.code: FRAMES}
    streams = [special.get(code) or names.get(code, "") for code in by_rank]
    return {"streams": streams, **({"exceptions": exceptions} if exceptions else {})}


def _usual_order(codes: UInt16Array, tied: Int64Array) -> list[int]:
    """Order streams by which of them stands behind which other one at most times.

    Where that leads round in a circle, the stream is next of which the fewest lines stand behind those still left.
    """
    pairs, counts = np.unique(np.stack([codes[tied], codes[tied + 1]]), axis=1, return_counts=True)
    found = dict(zip(map(tuple, pairs.T.tolist()), counts.tolist(), strict=True))
    followers: dict[int, list[tuple[int, int]]] = {code: [] for code in np.unique(codes).tolist()}
    held = dict.fromkeys(followers, 0)
    for (first, second), count in found.items():
        more = count - found.get((second, first), 0)
        if more > 0:
            followers[first].append((second, more))
            held[second] += more
    order: dict[int, None] = {}
    waiting = sorted((weight, code) for code, weight in held.items())
    while waiting:
        _, code = heappop(waiting)
        if code in order:
            continue
        order[code] = None
        for follower, count in followers[code]:
            held[follower] -= count
            heappush(waiting, (held[follower], follower))
    return list(order)


def _stamps(seconds: Float64Array) -> Int64Array:
    timed = np.isfinite(seconds)
    return np.where(timed, nanoseconds(np.where(timed, seconds, 0.0)), BEFORE_ALL_NS)
