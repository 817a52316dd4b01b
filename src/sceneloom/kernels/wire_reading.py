"""Lists of records out of the bytes of protobuf messages, into one array of words; the unusual is left to others.

Unusual is all that a writer need not write: fields that are not known or come twice, lists in chunks, numbers of more
than 32 bits, and records that do not agree with the list about its number and time.

Source: protobuf.dev, "Encoding".
"""

import numpy as np
from numba import njit

from sceneloom.arrays import Int64Array, UInt8Array, UInt32Array
from sceneloom.kernels.cache import kernel

FLOAT, FLOATS, UNSIGNED, SIGNED, TEXT, TIME, SEQ = range(1, 8)
"""What a field of a record holds; 0 for a field that is not known. SEQ is the number of the list."""
KNOWN = 128
"""Numbers of fields are below this."""

_VARINT, _LENGTH, _FIXED_32 = 0, 2, 5
_LARGEST = 2**32 - 1
_BYTES = "Array(uint8, 1, 'C', readonly=True)"
_FORM, _START, _SIZE, _INNER = range(4)


@njit(nogil=True, error_model="numpy")
def _number(content, position, stop):  # type: ignore[no-untyped-def]
    """A number of up to 32 bits and where it ends; -1 for both where there is none."""
    number = np.int64(0)
    for k in range(5):
        if position >= stop:
            break
        byte = content[position]
        position += 1
        number |= np.int64(byte & 0x7F) << (7 * k)
        if byte < 0x80:
            return (number, position) if number <= _LARGEST else (-1, -1)
    return -1, -1


@njit(nogil=True, error_model="numpy")
def _length(content, position, stop):  # type: ignore[no-untyped-def]
    """Where the content of a field begins and ends that reports its length; -1 for both where it ends beyond `stop`."""
    length, begin = _number(content, position, stop)
    return (begin, begin + length) if 0 <= length <= stop - begin else (-1, -1)


@njit(nogil=True, error_model="numpy")
def _time(content, position, stop):  # type: ignore[no-untyped-def]
    """Seconds and nanoseconds of a timestamp; -1 for both where there is something unusual."""
    stated = np.zeros(2, np.int64)
    reported = 0
    while position < stop:
        tag, position = _number(content, position, stop)
        field = tag >> 3
        if tag & 7 != _VARINT or field < 1 or field > 2 or reported & field:
            return -1, -1
        stated[field - 1], position = _number(content, position, stop)
        if position < 0:
            return -1, -1
        reported |= field
    return stated[0], stated[1]


@njit(nogil=True, error_model="numpy")
def _word(content, position):  # type: ignore[no-untyped-def]
    """Four bytes, lowest first."""
    return (
        np.uint32(content[position])
        | np.uint32(content[position + 1]) << 8
        | np.uint32(content[position + 2]) << 16
        | np.uint32(content[position + 3]) << 24
    )


@njit(nogil=True, error_model="numpy")
def _floats(content, position, stop, at, size, words):  # type: ignore[no-untyped-def]
    """Read as many numbers as a field holds; where it ends, -1 where it holds another count."""
    begin, end = _length(content, position, stop)
    if begin < 0 or end - begin != 4 * size:
        return -1
    for k in range(size):
        words[at + k] = _word(content, begin + 4 * k)
    return end


@njit(nogil=True, error_model="numpy")
def _whole(content, position, stop, form, at, words):  # type: ignore[no-untyped-def]
    """Read a whole number, and give where it ends; signed ones zigzag about 0."""
    number, position = _number(content, position, stop)
    if position >= 0:
        words[at] = np.uint32(((number >> 1) ^ -(number & 1)) & _LARGEST if form == SIGNED else number)
    return position


@njit(nogil=True, error_model="numpy")
def _record(content, position, stop, n, common, fields, latest, words, texts, counts):  # type: ignore[no-untyped-def]
    """Read one record; whether it is as usual, and says of itself what the list says of all."""
    count, seq, s, ns = len(texts), 0, 0, 0
    while position < stop:
        tag, position = _number(content, position, stop)
        field, wire = tag >> 3, tag & 7
        if tag < 0 or field >= KNOWN or latest[field] == n:
            return False
        form, size = fields[field, _FORM], fields[field, _SIZE]
        at = fields[field, _START] * count + n * size + fields[field, _INNER]
        latest[field] = n
        counts[field] += 1
        if form == FLOAT and wire == _FIXED_32 and position + 4 <= stop:
            words[at], position = _word(content, position), position + 4
        elif form == FLOATS and wire == _LENGTH:
            position = _floats(content, position, stop, at, size, words)
        elif form in (UNSIGNED, SIGNED) and wire == _VARINT:
            position = _whole(content, position, stop, form, at, words)
        elif form == SEQ and wire == _VARINT:
            seq, position = _number(content, position, stop)
        elif form == TEXT and wire == _LENGTH:
            texts[n, 0], texts[n, 1] = _length(content, position, stop)
            position = texts[n, 1]
        elif form == TIME and wire == _LENGTH:
            begin, position = _length(content, position, stop)
            if begin >= 0:
                s, ns = _time(content, begin, position)
        else:
            return False
        if position < 0:
            return False
    return seq == common[0] and s == common[1] and ns == common[2]


@njit(nogil=True, error_model="numpy")
def _head(content, start, stop, heads):  # type: ignore[no-untyped-def]
    """Read what a list says of itself: sensor, number, seconds, nanoseconds, and how many records it has.

    The last is -1 where there is something unusual, such as no time.
    """
    sensor, seq, s, ns, count, reported, position = 0, 0, -1, -1, 0, 0, start
    while position < stop:
        tag, position = _number(content, position, stop)
        field, wire = tag >> 3, tag & 7
        if field == heads[3] and wire == _LENGTH:
            position = _length(content, position, stop)[1]
            count += 1
        elif field == heads[0] and wire == _VARINT and not reported & 1:
            sensor, position = _number(content, position, stop)
            reported |= 1
        elif field == heads[1] and wire == _VARINT and not reported & 2:
            seq, position = _number(content, position, stop)
            reported |= 2
        elif field == heads[2] and wire == _LENGTH and not reported & 4:
            begin, position = _length(content, position, stop)
            reported |= 4
            if position >= 0:
                s, ns = _time(content, begin, position)
        else:
            position = -1
        if position < 0:
            return sensor, seq, s, ns, -1
    return sensor, seq, s, ns, (count if s >= 0 else -1)


@kernel(
    f"Tuple((UniTuple(int64, 5), uint32[::1], int64[:,::1], int64[::1]))({_BYTES}, int64, int64, UniTuple(int64, 4), "
    "Array(int64, 2, 'C', readonly=True), int64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def read_list(
    content: UInt8Array,
    start: int,
    stop: int,
    heads: tuple[int, int, int, int],
    fields: Int64Array,
    width: int,
) -> tuple[tuple[int, int, int, int, int], UInt32Array, Int64Array, Int64Array]:
    """Read a list of records.

    Args:
        content: bytes in which the message of the list stands.
        start, stop: where it begins and ends.
        heads: the numbers of its fields: sensor, number, time and the records.
        fields: (KNOWN, 4), for each field of a record what it holds, in which of its words its column begins, how
            many words a row of that column has, and which of these is the first of the field.
        width: words of a record.

    Returns:
        head: sensor, number, seconds, nanoseconds, and how many records there are; the last is -1 where there is
            something unusual, and then the rest means nothing.
        words: (N * width,) uint32, the columns one after the other: the bits of float32 numbers, int32 or uint32; 0 for
            what is not there.
        texts: (N, 2) int64, where the text of each record begins and ends in the content.
        counts: (KNOWN,) int64, how many records have each field.
    """
    head = _head(content, start, stop, heads)
    count = max(head[4], 0)
    words, texts = np.zeros(count * width, np.uint32), np.zeros((count, 2), np.int64)
    counts, latest = np.zeros(KNOWN, np.int64), np.full(KNOWN, -1)
    if head[4] < 0:
        return head, words, texts, counts
    common, position, n = (head[1], head[2], head[3]), start, 0
    while n < count:
        tag, position = _number(content, position, stop)
        if tag & 7 == _VARINT:
            position = _number(content, position, stop)[1]
            continue
        begin, position = _length(content, position, stop)
        if tag >> 3 == heads[3]:
            if not _record(content, begin, position, n, common, fields, latest, words, texts, counts):
                return (head[0], head[1], head[2], head[3], -1), words, texts, counts
            n += 1
    return head, words, texts, counts
