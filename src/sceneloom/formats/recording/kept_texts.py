"""Lines that were kept as text, put back: by the samples that they were read with, or where they stood."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.line_shapes import RECORD_KEYS
from sceneloom.formats.recording.merged_lines import BEFORE_ALL_NS, FRAMES, WrittenLine

_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(dict[str, Any]).decode
_decode_raw = msgspec.json.Decoder(dict[str, msgspec.Raw]).decode


def completed(text: str, before: str) -> str:
    """Write a line with what else it once stated.

    Args:
        text: the line as it is made from its sample.
        before: the line that the sample was read from.
    """
    merged = _over(_decode(before), _decode(text))
    # the time may have more decimals than a 64-bit number
    return _encode({**merged, "time": _decode_raw(text)["time"]}).decode()


def _over(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    both = {
        key: _over(old[key], value) if isinstance(value, dict) and isinstance(old.get(key), dict) else value
        for key, value in new.items()
    }
    return {**old, **both}


def rows_of(keys: Iterable[str], timestamps_ns: Int64Array) -> dict[str, int]:
    """Find the rows that keys name (`TIME`, or `TIME#1` for the second of that time); some may be there no longer.

    Args:
        keys: as `Columns.row_keys` makes them.
        timestamps_ns: (N,) int64 [ns], ascending.
    """
    found = {}
    for key in keys:
        timestamp, _, count = key.partition("#")
        if not (timestamp.removeprefix("-").isdecimal() and (count or "0").isdecimal()):
            continue
        row = int(np.searchsorted(timestamps_ns, int(timestamp))) + int(count or 0)
        if row < len(timestamps_ns) and timestamps_ns[row] == int(timestamp):
            found[key] = row
    return found


class SharedText(msgspec.Struct):
    """A line that several streams have a part in.

    Attributes:
        text: the line.
        records: stream and key of each part.
    """

    text: str
    records: list[tuple[str, str]] = []


class SharedLines:
    """Brings the samples of lines that several streams have a part in back into one line.

    A line that reports a sweep or of images is written with these; all others are written here.
    """

    def __init__(self, entries: Sequence[SharedText], hosts: Mapping[str, Int64Array]) -> None:
        """Begin.

        Args:
            entries: the lines.
            hosts: times of sweeps and images that are written, by their streams' names, (N,) int64 [ns], ascending.
        """
        self._texts = [entry.text for entry in entries]
        self._parts: list[list[str]] = [[] for _ in entries]
        self._index: dict[str, dict[str, int]] = {}
        self._hosted: dict[int, str] = {}
        self._of_hosts: dict[str, dict[str, str]] = {}
        for location, entry in enumerate(entries):
            for stream, key in entry.records:
                self._index.setdefault(stream, {})[key] = location
                if stream in hosts and rows_of([key], hosts[stream]):
                    self._hosted[location] = stream
                    self._of_hosts.setdefault(stream, {})[key] = entry.text
            timestamp = _timestamp_of(entry.text)
            images = hosts.get(FRAMES, np.zeros(0, np.int64))
            if (
                timestamp is not None
                and "frames" in _keys_of(entry.text)
                and rows_of([str(timestamp)], images)
            ):
                self._hosted[location] = FRAMES

    def texts_for(self, stream: str) -> dict[str, str]:
        """Give the lines that are written with the sweeps of a lidar, by their keys."""
        return self._of_hosts.get(stream, {})

    def rows(self, stream: str, timestamps_ns: Int64Array) -> dict[int, int]:
        """Find the rows of a stream, at times (N,) [ns], that have a part in such lines.

        Each with the line's location.
        """
        keys = self._index.get(stream, {})
        return {row: keys[key] for key, row in rows_of(keys, timestamps_ns).items()}

    def give(self, location: int, text: str) -> None:
        """Hand over a part: the line that would be made of it alone."""
        self._parts[location].append(text)

    def lines(self) -> list[WrittenLine]:
        """Give the lines in the order of their times."""
        lines = []
        for location, (text, parts) in enumerate(zip(self._texts, self._parts, strict=True)):
            if parts and location not in self._hosted:
                whole = _without_hosts(text)
                for part in parts:
                    whole = completed(part, whole)
                lines.append(written_line(whole))
        return sorted(lines, key=lambda line: line[:2])


def _without_hosts(text: str) -> str:
    """A line that no sweep and no image is written with says nothing of any."""
    fields = _decode_raw(text)
    kept = {key: value for key, value in fields.items() if key not in {"frames", "number", "lidar"}}
    return text if len(kept) == len(fields) or not kept.keys() & RECORD_KEYS else _encode(kept).decode()


def timed_lines(texts: Sequence[str]) -> list[WrittenLine]:
    """Lines that hold nothing that a scene has a location for, as they were; those that have a time."""
    lines = [written_line(text) for text in texts]
    return sorted((line for line in lines if line.timestamp_ns != BEFORE_ALL_NS), key=lambda line: line[:2])


def untimed_lines(texts: Sequence[str], anchors: Mapping[str, float]) -> list[WrittenLine]:
    """The others, which follow the lines of another time.

    Args:
        texts: all such lines, in the order of the file.
        anchors: by index in `texts`, the time of the line before [s]; lines that have none come first.
    """
    lines = []
    for location, text in enumerate(texts):
        if written_line(text).timestamp_ns == BEFORE_ALL_NS:
            seconds = anchors.get(str(location))
            timestamp = (BEFORE_ALL_NS, 0.0) if seconds is None else (round(seconds * 1e9), seconds)
            lines.append(WrittenLine(*timestamp, text.strip()))
    return sorted(lines, key=lambda line: line[:2])


def written_line(text: str) -> WrittenLine:
    """A line with its time."""
    found = _seconds_of(text)
    if found is None:
        return WrittenLine(BEFORE_ALL_NS, 0.0, text.strip())
    return WrittenLine(round(found * 1e9), found, text.strip())


def _timestamp_of(text: str) -> int | None:
    seconds = _seconds_of(text)
    return None if seconds is None else round(seconds * 1e9)


def _keys_of(text: str) -> frozenset[str]:
    try:
        return frozenset(_decode_raw(text))
    except DECODER_FAULTS:
        return frozenset()


def _seconds_of(text: str) -> float | None:
    try:
        line = msgspec.json.decode(text)
    except DECODER_FAULTS:
        return None
    seconds = line.get("time") if isinstance(line, dict) else None
    return float(seconds) if isinstance(seconds, int | float) and abs(seconds) < 9.2e9 else None
