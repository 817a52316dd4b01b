"""Packed bytes: LZF, lidar records, ranges of beams, protobuf lists both ways, points in steps, depths in runs.

Unusual is all that a writer need not write: fields that are unknown or come twice, lists in parts, numbers of more than
32 bits, and records that do not agree with the list about its number and time.

Source: protobuf.dev, "Encoding"; numbers that are 0 and empty texts are left out, vectors are packed.
"""

import numba
import numpy as np
from numba import float32, float64, int64, types, uint8, uint16, uint32, void

from sceneloom.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    Float64Array,
    Int64Array,
    UInt8Array,
    UInt16Array,
    UInt32Array,
)
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import (
    IN_BOOL_1D,
    IN_F32_1D,
    IN_F32_2D,
    IN_F32_3D,
    IN_F64_1D,
    IN_I64_1D,
    IN_I64_2D,
    IN_U8_1D,
    IN_U8_2D,
    inlined,
    part,
    read_only,
)

LARGEST_RATIO = 264 / 3
"""A back reference of three bytes stands for at most 264: no stream can unfold to more than this times its length."""

_LITERALS = 32
_LONG = 7
_SHORTEST = 2


@kernel(int64(IN_U8_1D, uint8[::1]))
def unfold(packed: UInt8Array, unpacked: UInt8Array) -> int:
    """Unfold an LZF stream into an array that has the length of what was packed.

    A control byte below 32 is followed by that many plus one literal bytes. Otherwise its upper three bits are a
    length (7: plus the next byte), its lower five and the next byte a distance: length + 2 bytes are repeated from
    distance + 1 bytes back, one by one, so that they may overlap.

    Returns:
        How many bytes were unfolded; -1 where the stream breaks off, reaches before its begin, or is too long.

    Source: the description in lzf_d.c of Marc Lehmann's liblzf; PCL's pcd_io uses the same stream.
    """
    source, target = 0, 0
    while source < packed.size:
        control = int(packed[source])
        source += 1
        if control < _LITERALS:
            length = control + 1
            if source + length > packed.size or target + length > unpacked.size:
                return -1
            for k in range(length):
                unpacked[target + k] = packed[source + k]
            source += length
        else:
            length = control >> 5
            if length == _LONG:
                if source >= packed.size:
                    return -1
                length += int(packed[source])
                source += 1
            if source >= packed.size:
                return -1
            back = target - ((control & 31) << 8) - int(packed[source]) - 1
            source += 1
            length += _SHORTEST
            if back < 0 or target + length > unpacked.size:
                return -1
            for k in range(length):
                unpacked[target + k] = unpacked[back + k]
        target += length
    return target


_FARTHEST_BACK = 1 << 13
_LONGEST_COPY = 264
_TABLE_BITS = 14


def longest_fold(size: int) -> int:
    """How many bytes the stream of so many bytes has at most: all literals, a control byte for each 32."""
    return size + (size + _LITERALS - 1) // _LITERALS + 8


@kernel(int64(IN_U8_1D, uint8[::1]))
def fold(plain: UInt8Array, packed: UInt8Array) -> int:
    """Fold bytes into an LZF stream, which `unfold` describes: the last location of each three bytes is looked back to.

    `plain`: what is packed; `packed`: of at least `longest_fold(plain.size)` bytes. Returns how many bytes the stream
    has.
    """
    locations = np.full(1 << _TABLE_BITS, -1, np.int64)
    source, target, literals = 0, 1, 0
    while source < plain.size:
        length, back = 0, 0
        if source + 2 < plain.size:
            three = (int(plain[source]) << 16) | (int(plain[source + 1]) << 8) | int(plain[source + 2])
            row = ((three * 2654435761) >> 8) & ((1 << _TABLE_BITS) - 1)
            before = locations[row]
            locations[row] = source
            back = source - before - 1
            if before >= 0 and back < _FARTHEST_BACK:
                longest = min(_LONGEST_COPY, plain.size - source)
                while length < longest and plain[before + length] == plain[source + length]:
                    length += 1
        if length < 3:
            packed[target] = plain[source]
            source, target, literals = source + 1, target + 1, literals + 1
            if literals == _LITERALS:
                packed[target - literals - 1] = literals - 1
                target, literals = target + 1, 0
            continue
        if literals:
            packed[target - literals - 1] = literals - 1
        else:
            target -= 1
        short = length - _SHORTEST
        packed[target] = (min(short, _LONG) << 5) | (back >> 8)
        target += 1
        if short >= _LONG:
            packed[target] = short - _LONG
            target += 1
        packed[target] = back & 255
        # room for the control byte of the next literals
        source, target, literals = source + length, target + 2, 0
    if literals:
        packed[target - literals - 1] = literals - 1
        return target
    return target - 1


_RECORD = numba.from_dtype(
    np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2"), ("timestamp", "<f8")])
)

_RECORDS = types.Array(_RECORD, 1, "C", readonly=True)


@kernel(void(_RECORDS, float32[:, ::1], uint8[::1], uint16[::1], float64[::1], int64[::1]))
def unpack(
    records: AnyArray, positions: Float32Array, intensities: UInt8Array, rings: UInt16Array, seconds: Float64Array,
    timestamps_ns: Int64Array,
) -> None:  # fmt: skip
    """Take N records apart in one pass, which memory bounds.

    `records` (N,) packed, their times within what int64 nanoseconds hold; `positions` (N, 3) [m], filled; `intensities`
    (N,), filled; `rings` (N,), filled; `seconds` (N,) [s], filled with the times as they are; `timestamps_ns` (N,)
    [ns], filled with round(t · 1e9), halves to even.
    """
    for k in range(len(records)):
        record = records[k]
        positions[k, 0], positions[k, 1], positions[k, 2] = record["x"], record["y"], record["z"]
        intensities[k] = record["intensity"]
        rings[k] = record["ring"]
        seconds[k] = record["timestamp"]
        timestamps_ns[k] = np.int64(np.rint(record["timestamp"] * 1e9))


FLOAT, FLOATS, UNSIGNED, SIGNED, TEXT, TIME, SEQ = range(1, 8)
"""What a field of a record holds; 0 for a field that is not known. SEQ is the number of the list."""

KNOWN = 128
"""Numbers of fields are below this."""

_VARINT, _LENGTH, _FIXED_32 = 0, 2, 5
_LARGEST = 2**32 - 1
_BYTES = "Array(uint8, 1, 'C', readonly=True)"
_FORM, _START, _SIZE, _INNER = range(4)


@part
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


@part
def _length(content, position, stop):  # type: ignore[no-untyped-def]
    """Where the content of a field begins and ends that reports its length; -1 for both where it ends beyond `stop`."""
    length, begin = _number(content, position, stop)
    return (begin, begin + length) if 0 <= length <= stop - begin else (-1, -1)


@part
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


@part
def _word(content, position):  # type: ignore[no-untyped-def]
    """Four bytes, lowest first."""
    return (
        np.uint32(content[position])
        | np.uint32(content[position + 1]) << 8
        | np.uint32(content[position + 2]) << 16
        | np.uint32(content[position + 3]) << 24
    )


@part
def _floats(content, position, stop, at, size, words):  # type: ignore[no-untyped-def]
    """Read as many numbers as a field holds; where it ends, -1 where it holds another count."""
    begin, end = _length(content, position, stop)
    if begin < 0 or end - begin != 4 * size:
        return -1
    for k in range(size):
        words[at + k] = _word(content, begin + 4 * k)
    return end


@part
def _whole(content, position, stop, form, at, words):  # type: ignore[no-untyped-def]
    """Read a whole number, and give where it ends; signed ones zigzag about 0."""
    number, position = _number(content, position, stop)
    if position >= 0:
        words[at] = np.uint32(((number >> 1) ^ -(number & 1)) & _LARGEST if form == SIGNED else number)
    return position


@part
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


@part
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
    "Array(int64, 2, 'C', readonly=True), int64)"
)
def read_list(
    content: UInt8Array, start: int, stop: int, heads: tuple[int, int, int, int], fields: Int64Array, width: int
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


OPTIONAL = 8
"""What a field of a record holds, beside those of `wire_reading`: a signed number that some records have."""

_NUMBER, _FORM_OUT, _START_OUT, _SIZE_OUT, _INNER_OUT = range(5)
_HEAD = 12  # the most bytes that stand before the content of a field
_TIME_BYTES = 12


@part
def _put(out, at, number):  # type: ignore[no-untyped-def]
    """Write a number, seven bits a byte, lowest first; where it ends."""
    while number > 0x7F:
        out[at] = np.uint8(number & 0x7F | 0x80)
        number >>= 7
        at += 1
    out[at] = np.uint8(number)
    return at + 1


@part
def _put_words(out, at, words, first, size):  # type: ignore[no-untyped-def]
    """Write words of four bytes, lowest first; where they end."""
    for k in range(first, first + size):
        word = words[k]
        for byte in range(4):
            out[at] = np.uint8(word >> np.uint32(8 * byte) & np.uint32(0xFF))
            at += 1
    return at


@part
def _put_time(out, at, number, s, ns):  # type: ignore[no-untyped-def]
    """Write a timestamp as the content of a field; where it ends."""
    at = _put(out, at, number << 3 | _LENGTH)
    begin = at + 1
    end = begin
    if s:
        end = _put(out, _put(out, end, 1 << 3 | _VARINT), s)
    if ns:
        end = _put(out, _put(out, end, 2 << 3 | _VARINT), ns)
    out[at] = np.uint8(end - begin)
    return end


@inlined
def _zigzag(word):  # type: ignore[no-untyped-def]
    """An int32 as it is written: small where it is near 0."""
    number = np.int64(np.int32(word))
    return (number << 1) ^ (number >> 63)


@part
def _put_whole(out, at, number, value):  # type: ignore[no-untyped-def]
    """Write a whole number as a field; where it ends."""
    return _put(out, _put(out, at, number << 3 | _VARINT), value)


@part
def _put_text(out, at, number, letters, first, last):  # type: ignore[no-untyped-def]
    """Write some of the letters as a field, none for none; where it ends."""
    if last == first:
        return at
    at = _put(out, _put(out, at, number << 3 | _LENGTH), last - first)
    for k in range(first, last):
        out[at] = letters[k]
        at += 1
    return at


@part
def _put_record(out, at, n, count, fields, words, texts, letters, given, common):  # type: ignore[no-untyped-def]
    """Write the fields of one record; where they end."""
    for f in range(len(fields)):
        number, form, size, inner = (
            fields[f, _NUMBER],
            fields[f, _FORM_OUT],
            fields[f, _SIZE_OUT],
            fields[f, _INNER_OUT],
        )
        first = fields[f, _START_OUT] * count + n * size
        if form == FLOAT and words[first + inner]:
            at = _put_words(out, _put(out, at, number << 3 | _FIXED_32), words, first + inner, 1)
        elif form == FLOATS:
            at = _put(out, _put(out, at, number << 3 | _LENGTH), 4 * size)
            at = _put_words(out, at, words, first, size)
        elif form == UNSIGNED and words[first + inner]:
            at = _put_whole(out, at, number, np.int64(words[first + inner]))
        elif form == SIGNED and words[first + inner]:
            at = _put_whole(out, at, number, _zigzag(words[first + inner]))
        elif form == OPTIONAL and given[inner, n]:
            at = _put_whole(out, at, number, _zigzag(words[first]))
        elif form == SEQ and common[0]:
            at = _put_whole(out, at, number, common[0])
        elif form == TIME:
            at = _put_time(out, at, number, common[1], common[2])
        elif form == TEXT:
            at = _put_text(out, at, number, letters, texts[n, 0], texts[n, 1])
    return at


@kernel(
    "uint8[::1](int64, int64, Array(int64, 2, 'C', readonly=True), uint32[::1], int64[:,::1], "
    "Array(uint8, 1, 'C', readonly=True), boolean[:,::1], UniTuple(int64, 3))"
)
def write_list(
    group: int, count: int, fields: Int64Array, words: UInt32Array, texts: Int64Array, letters: UInt8Array,
    given: BoolArray, common: tuple[int, int, int],
) -> UInt8Array:  # fmt: skip
    """Write records as a repeated field of a message.

    Args:
        group: the number of that field.
        count: how many records.
        fields: (F, 5), for each field of a record its number, what it holds, in which of the words of a record the
            column that it belongs to begins, how many words a row of that column has, and which of these is the first
            of the field; of an OPTIONAL one the last is its row of `given`. They rise.
        words: (count * width,), the columns one after the other: the bits of float32 numbers, int32 or uint32.
        texts: (count, 2), where the text of each record begins and ends among the letters.
        letters: (L,), of all texts.
        given: (O, count), which records have an OPTIONAL field.
        common: number, seconds and nanoseconds of the list, which its records state again.

    Returns:
        (B,) uint8.
    """
    long = len(letters)
    for n in range(count):
        long += texts[n, 1] - texts[n, 0] + _HEAD + len(fields) * (_HEAD + _TIME_BYTES)
    out, at = np.empty(long + 4 * len(words), np.uint8), 0
    for n in range(count):
        begin = at + _HEAD
        end = _put_record(out, begin, n, count, fields, words, texts, letters, given, common)
        at = _put(out, _put(out, at, group << 3 | _LENGTH), end - begin)
        for k in range(begin, end):
            out[at] = out[k]
            at += 1
    return out[:at].copy()


_BITS = (int64, int64, int64, int64)
"""A field of a pixel's words: number of the word, its lowest bit, the mask of its bits, and how far they go left."""


@inlined
def _pixel_bits(words: UInt32Array, pixel: int, word: int, bit: int, mask: int, left: int) -> int:
    value: int = ((int64(words[pixel, word]) >> bit) & mask) << left
    return value


@kernel(
    int64(
        *(read_only(uint32, 2), *_BITS, IN_BOOL_1D, IN_I64_1D, IN_I64_1D, IN_F32_2D, IN_F32_2D),
        *(float32[:, ::1], int64[::1], uint16[::1], int64[::1]),
    )
)
def place_ranges(
    words: UInt32Array,
    word: int,
    bit: int,
    mask: int,
    left: int,
    valid: BoolArray,
    beams: Int64Array,
    times_ns: Int64Array,
    directions: Float32Array,
    origins: Float32Array,
    positions: Float32Array,
    stamps_ns: Int64Array,
    rings: UInt16Array,
    index: Int64Array,
) -> int:
    """Place the ranges of the pixels of columns along their beams.

    Args:
        words: (M * H, W) of pixels, in which `word`, `bit`, `mask` and `left` are the range [mm], 0 for no return.
        valid: (M,) whether a column counts.
        beams: (M,) row of a column's first beam in `directions`.
        times_ns: (M,) [ns].
        directions, origins: (B, 3) of beams; where they begin [m].
        positions, stamps_ns, rings, index: (M * H or more, …), filled: positions [m], times, rows of the beams, and the
            pixel of each return.

    Returns:
        How many returns there are.
    """
    count = 0
    rows = words.shape[0] // max(len(valid), 1)
    for column in range(len(valid)):
        if not valid[column]:
            continue
        for row in range(rows):
            pixel = column * rows + row
            millimetres = _pixel_bits(words, pixel, word, bit, mask, left)
            if millimetres == 0:
                continue
            beam = beams[column] + row
            metres = float32(millimetres) * float32(0.001)
            for axis in range(3):
                positions[count, axis] = directions[beam, axis] * metres + origins[beam, axis]
            stamps_ns[count] = times_ns[column]
            rings[count] = row
            index[count] = pixel
            count += 1
    return count


@kernel([void(read_only(uint32, 2), *_BITS, IN_I64_1D, kind[::1]) for kind in (uint8, uint16, uint32)])
def pick_bits(
    words: UInt32Array, word: int, bit: int, mask: int, left: int, pixels: Int64Array, values: AnyArray
) -> None:
    """Fill `values` (N,) with a field of the pixels (N,) of `words` (M, W)."""
    for k in range(len(pixels)):
        values[k] = _pixel_bits(words, pixels[k], word, bit, mask, left)


@inlined
def _turned(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle that grows by less than 0.03 rad: Taylor's series, within 1e-11."""
    square = angle * angle
    more_cosine, more_sine = 1.0 - square * (0.5 - square / 24.0), angle * (1.0 - square / 6.0)
    return cosine * more_cosine - sine * more_sine, sine * more_cosine + cosine * more_sine


@kernel(
    int64(
        *(IN_BOOL_1D, IN_I64_1D, read_only(uint16, 2), IN_U8_2D, IN_F32_1D, IN_F64_1D, IN_F64_1D, IN_F64_1D),
        *(IN_I64_1D, IN_I64_1D, IN_F32_3D, IN_I64_1D, IN_F32_1D),
        *(float32[:, ::1], uint8[::1], int64[::1], uint16[::1], int64[::1]),
    )
)
def place_polar(
    counted: BoolArray,
    numbers: Int64Array,
    distances: UInt16Array,
    intensities: UInt8Array,
    unit_m: Float32Array,
    azimuths: Float64Array,
    offsets: Float64Array,
    elevations: Float64Array,
    times_ns: Int64Array,
    channels_ns: Int64Array,
    adjustments: Float32Array,
    steps: Int64Array,
    weights: Float32Array,
    positions: Float32Array,
    reflected: UInt8Array,
    stamps_ns: Int64Array,
    rings: UInt16Array,
    blocks: Int64Array,
) -> int:
    """Place the returns of blocks of channels: x along azimuth 0, y where the azimuth grows, z up.

    Args:
        counted: (M,) whether a block counts.
        numbers: (M,) of a block among those of one firing, from 0; of equal returns of a firing one counts.
        distances, intensities: (M, C), distances in `unit_m` (M,), 0 where nothing returned.
        azimuths: (M,) of blocks [rad].
        offsets, elevations: (C,) of channels [rad]: what is added to the azimuth; above the horizon.
        times_ns, channels_ns: (M,), (C,) [ns], which are added.
        adjustments: (2, S, C) [rad], below 0.03: of elevation and azimuth, a circle of steps; (2, 0, C) for none.
        steps, weights: (M,) the step before a block, and how much of the way to the next it is.
        positions, reflected, stamps_ns, rings, blocks: filled: positions [m], intensities, times, channels, blocks.

    Returns:
        How many returns there are.
    """
    count, circle = 0, adjustments.shape[1]
    cosines, sines = np.cos(elevations), np.sin(elevations)
    cosines_aside, sines_aside = np.cos(offsets), np.sin(offsets)
    for block in range(distances.shape[0]):
        if not counted[block]:
            continue
        cosine_of_block, sine_of_block = np.cos(azimuths[block]), np.sin(azimuths[block])
        before = steps[block]
        after = before + 1 if before + 1 < circle else 0
        for channel in range(distances.shape[1]):
            value, intensity, repeated = distances[block, channel], intensities[block, channel], False
            for other in range(block - numbers[block], block):
                repeated |= distances[other, channel] == value and intensities[other, channel] == intensity
            if value == 0 or repeated:
                continue
            distance = value * unit_m[block]
            x = cosine_of_block * cosines_aside[channel] - sine_of_block * sines_aside[channel]
            y = sine_of_block * cosines_aside[channel] + cosine_of_block * sines_aside[channel]
            cosine, sine = cosines[channel], sines[channel]
            if circle:
                weight = weights[block]
                up, aside = adjustments[0], adjustments[1]
                cosine, sine = _turned(cosine, sine, up[before, channel] * (1 - weight) + up[after, channel] * weight)
                x, y = _turned(x, y, aside[before, channel] * (1 - weight) + aside[after, channel] * weight)
            positions[count, 0] = distance * cosine * x
            positions[count, 1] = distance * cosine * y
            positions[count, 2] = distance * sine
            reflected[count] = intensity
            stamps_ns[count] = times_ns[block] + channels_ns[channel]
            rings[count] = channel
            blocks[count] = block
            count += 1
    return count


COPIED, STEPPED, MIXED, GORILLA = 0, 1, 2, 3
"""How `read_points` finds a field's value: as it stands, by a step from the point before, by the bits that differ
from the point before in all bytes, or in as few bits as they take."""

NO_NUMBER = np.iinfo(np.int64).min
"""Stands for NaN where values are steps."""

_LONGEST_VARINT_BITS = 63
_NO_WINDOW = 255
_BITS_LEADING, _BITS_LENGTH = 5, 6
_STEPS, _PALETTE, _RUNS_OF_STEPS = 0, 1, 3


@part
def _varint(content, position, stop):  # type: ignore[no-untyped-def]
    """A number, seven bits a byte, lowest first, and where it ends; -1 where it does not end before `stop`."""
    number, bits = np.uint64(0), 0
    while position < stop and bits < _LONGEST_VARINT_BITS + 7:
        byte = np.uint64(content[position])
        position += 1
        number |= (byte & np.uint64(0x7F)) << np.uint64(bits)
        if byte < np.uint64(0x80):
            return number, position
        bits += 7
    return number, -1


@part
def _step(number):  # type: ignore[no-untyped-def]
    """The signed number that is written as `number`, one more than its zigzag form: 0 is kept for NaN."""
    zigzag = number - np.uint64(1)
    return np.int64(zigzag >> np.uint64(1)) ^ -np.int64(zigzag & np.uint64(1))


@part
def _bits(content, position, stop, held, count, wanted):  # type: ignore[no-untyped-def]
    """The next bits, lowest first: these, where the bytes go on, and what is left of the last byte and its length."""
    found, have = np.uint64(0), 0
    while have < wanted:
        if count == 0:
            if position >= stop:
                return found, -1, held, count
            held, count = np.uint64(content[position]), 8
            position += 1
        taken = min(count, wanted - have)
        mask = (np.uint64(1) << np.uint64(taken)) - np.uint64(1)
        found |= (held & mask) << np.uint64(have)
        held, count, have = held >> np.uint64(taken), count - taken, have + taken
    return found, position, held, count


@part
def _value(content, position, size):  # type: ignore[no-untyped-def]
    """The bits of a value of `size` bytes, lowest byte first."""
    whole = np.uint64(0)
    for b in range(size):
        whole |= np.uint64(content[position + b]) << np.uint64(8 * b)
    return whole


@part
def _changed(content, position, stop, window, width):  # type: ignore[no-untyped-def]
    """The bits in which a value differs from the one before, and where they end; -1 where they break off.

    `window` (2,): how many bits before and behind those that were stated last are equal; filled.
    """
    flag, position, held, left = _bits(content, position, stop, np.uint64(0), 0, 1)
    if position < 0 or flag == 0:
        return np.uint64(0), position
    control, position, held, left = _bits(content, position, stop, held, left, 1)
    if position >= 0 and control:
        leading, position, held, left = _bits(content, position, stop, held, left, _BITS_LEADING)
        length = np.uint64(0)
        if position >= 0:
            length, position, held, left = _bits(content, position, stop, held, left, _BITS_LENGTH)
        window[0] = np.int64(leading)
        window[1] = width - np.int64(leading) - np.int64(length) - 1
    if position < 0 or window[1] < 0 or window[0] + window[1] >= width:
        return np.uint64(0), -1
    changed, position, held, left = _bits(content, position, stop, held, left, width - window[0] - window[1])
    return changed << np.uint64(window[1]), position


@part
def _next_value(content, position, stop, field, before, window, is_first):  # type: ignore[no-untyped-def]
    """The bits of a field's next value, where they end, -1 where they break off, and whether it is NaN."""
    way, size = field[0], field[1]
    if way == STEPPED:
        number, position = _varint(content, position, stop)
        if number == 0:
            return np.uint64(0), (position if field[2] else -1), True
        return before + np.uint64(_step(number)), position, False
    if way == GORILLA and not is_first:
        changed, position = _changed(content, position, stop, window, 8 * size)
        return before ^ changed, position, False
    if position + size > stop:
        return before, -1, False
    whole = _value(content, position, size)
    return (before ^ whole if way == MIXED else whole), position + size, False


@kernel(int64(IN_U8_1D, int64, IN_I64_2D, int64[:, ::1]))
def read_points(content: UInt8Array, start: int, fields: Int64Array, values: Int64Array) -> int:
    """Read the fields of points that stand one point after another, each value by that of the point before.

    Args:
        content: the bytes.
        start: where the first point begins.
        fields: (F, 3) of each field: `COPIED`, `STEPPED`, `MIXED` or `GORILLA`; its bytes; whether a step may be NaN,
            after which the next one counts from 0.
        values: (F, N), filled: the bits of a value as they stand, or the sum of the steps, `NO_NUMBER` for NaN.

    Returns:
        Where the last point ends; -1 where the bytes break off, or a step is of more than 64 bits or none.

    Source: field_decoder.hpp and encoding_utils.hpp of Cloudini; Pelkonen et al. 2015, "Gorilla", 4.1.2, of which each
    value here begins with a byte of its own.
    """
    stop, position = content.size, start
    before = np.zeros(fields.shape[0], np.uint64)
    windows = np.full((fields.shape[0], 2), _NO_WINDOW, np.int64)
    for k in range(values.shape[1]):
        for f in range(fields.shape[0]):
            before[f], position, is_nan = _next_value(content, position, stop, fields[f], before[f], windows[f], k == 0)
            if position < 0:
                return -1
            values[f, k] = NO_NUMBER if is_nan else np.int64(before[f])
    return position


@part
def _read_palette(content, position, size, values):  # type: ignore[no-untyped-def]
    """Values by their numbers in a list of `size` bytes each, which stands before; where they end, or -1."""
    stop = content.size
    if position + 2 > stop:
        return -1
    count = np.int64(content[position]) | np.int64(content[position + 1]) << 8
    palette, position = position + 2, position + 2 + count * size
    width = 0
    while (count - 1) >> width > 0:
        width += 1
    if count == 0 or position + (width * values.size + 7) // 8 > stop:
        return -1
    held, left = np.uint64(0), 0
    for k in range(values.size):
        index, position, held, left = _bits(content, position, stop, held, left, width)
        if position < 0 or np.int64(index) >= count:
            return -1
        values[k] = np.int64(_value(content, palette + np.int64(index) * size, size))
    return position


@part
def _read_repeated(content, position, size, values, steps):  # type: ignore[no-untyped-def]
    """Values, or steps from one to the next, with how often each comes; where they end, or -1."""
    stop, done, total = content.size, 0, np.uint64(0)
    if position + 4 > stop:
        return -1
    runs = np.int64(_value(content, position, 4))
    position += 4
    for _ in range(runs):
        if steps:
            number, position = _varint(content, position, stop)
            whole = np.uint64(_step(number))
            if number == 0:
                return -1
        else:
            if position + size > stop:
                return -1
            whole, position = _value(content, position, size), position + size
        length, position = _varint(content, position, stop) if position >= 0 else (np.uint64(0), -1)
        if position < 0 or length > np.uint64(values.size - done):
            return -1
        for k in range(done, done + int(length)):
            total = total + whole if steps else whole
            values[k] = np.int64(total)
        done = done + int(length)
    return position if done == values.size else -1


@kernel(int64(IN_U8_1D, int64, int64, int64[::1]))
def read_column(content: UInt8Array, start: int, size: int, values: Int64Array) -> int:
    """Read the values of one field of all points: in steps, from a palette, or in runs.

    Args:
        content: the bytes.
        start: of the section.
        size: of a value [byte].
        values: (N,), filled, as in `read_points`.

    Returns:
        Where the section ends; -1 where it breaks off, is of another kind, or holds more or fewer than N values.

    Source: v5_codec.cpp of Cloudini, sections of adaptive integers: 0 steps, 1 palette, 2 runs, 3 runs of steps.
    """
    position = start + 1
    if start >= content.size or content[start] > _RUNS_OF_STEPS:
        return -1
    if content[start] == _PALETTE:
        return int(_read_palette(content, position, size, values))
    if content[start] != _STEPS:
        return int(_read_repeated(content, position, size, values, content[start] == _RUNS_OF_STEPS))
    total = np.uint64(0)
    for k in range(values.size):
        number, position = _varint(content, position, content.size)
        if position < 0 or number == 0:
            return -1
        total += np.uint64(_step(number))
        values[k] = np.int64(total)
    return position


@part
def _nibbles(content, place):  # type: ignore[no-untyped-def]
    """A number, three bits a nibble, lowest first, and where it ends; -1 where the bytes break off.

    `place` counts nibbles; words of four bytes stand lowest byte first, and begin with their highest nibble.
    """
    number, bits = np.int64(0), 0
    while place < content.size * 2 and bits < 36:
        byte = content[(place >> 3) * 4 + 3 - (place & 7) // 2]
        nibble = np.int64(byte >> 4 if place % 2 == 0 else byte & 0xF)
        place += 1
        number |= (nibble & 7) << bits
        if nibble < 8:
            return number, place
        bits += 3
    return number, -1


@kernel(int64(IN_U8_1D, uint16[::1]))
def read_runs(content: UInt8Array, pixels: UInt16Array) -> int:
    """Read depths in runs of zeros and of steps from one that is not zero to the next (RVL).

    Args:
        content: whole words of four bytes.
        pixels: (N,), filled.

    Returns:
        How many pixels there were; -1 where the bytes break off, or hold more than N.

    Source: Wilson 2017, "Fast Lossless Depth Image Compression", listing 1.
    """
    place, done, depth = 0, 0, 0
    while done < pixels.size:
        zeros, place = _nibbles(content, place)
        if place < 0 or zeros > pixels.size - done:
            return -1
        pixels[done : done + zeros] = 0
        done += zeros
        others, place = _nibbles(content, place)
        if place < 0 or others > pixels.size - done or zeros + others == 0:
            return -1
        for _ in range(others):
            number, place = _nibbles(content, place)
            if place < 0:
                return -1
            depth += (number >> 1) ^ -(number & 1)
            pixels[done] = depth & 0xFFFF
            done += 1
    return done
