"""Lists of records as the bytes of protobuf messages, as the library writes them: fields in the order of their numbers.

Source: protobuf.dev, "Encoding"; numbers that are 0 and empty texts are left out, vectors are packed.
"""

import numpy as np
from numba import njit

from sceneloom.arrays import BoolArray, Int64Array, UInt8Array, UInt32Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.wire_reading import FLOAT, FLOATS, SEQ, SIGNED, TEXT, TIME, UNSIGNED

OPTIONAL = 8
"""What a field of a record holds, beside those of `wire_reading`: a signed number that some records have."""

_VARINT, _LENGTH, _FIXED_32 = 0, 2, 5
_NUMBER, _FORM, _START, _SIZE, _INNER = range(5)
_HEAD = 12
"""The most bytes that stand before the content of a field."""
_TIME_BYTES = 12


@njit(nogil=True, error_model="numpy")
def _put(out, at, number):  # type: ignore[no-untyped-def]
    """Write a number, seven bits a byte, lowest first; where it ends."""
    while number > 0x7F:
        out[at] = np.uint8(number & 0x7F | 0x80)
        number >>= 7
        at += 1
    out[at] = np.uint8(number)
    return at + 1


@njit(nogil=True, error_model="numpy")
def _put_words(out, at, words, first, size):  # type: ignore[no-untyped-def]
    """Write words of four bytes, lowest first; where they end."""
    for k in range(first, first + size):
        word = words[k]
        for byte in range(4):
            out[at] = np.uint8(word >> np.uint32(8 * byte) & np.uint32(0xFF))
            at += 1
    return at


@njit(nogil=True, error_model="numpy")
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


@njit(nogil=True, error_model="numpy", inline="always")
def _zigzag(word):  # type: ignore[no-untyped-def]
    """An int32 as it is written: small where it is near 0."""
    number = np.int64(np.int32(word))
    return (number << 1) ^ (number >> 63)


@njit(nogil=True, error_model="numpy")
def _put_whole(out, at, number, value):  # type: ignore[no-untyped-def]
    """Write a whole number as a field; where it ends."""
    return _put(out, _put(out, at, number << 3 | _VARINT), value)


@njit(nogil=True, error_model="numpy")
def _put_text(out, at, number, letters, first, last):  # type: ignore[no-untyped-def]
    """Write some of the letters as a field, none for none; where it ends."""
    if last == first:
        return at
    at = _put(out, _put(out, at, number << 3 | _LENGTH), last - first)
    for k in range(first, last):
        out[at] = letters[k]
        at += 1
    return at


@njit(nogil=True, error_model="numpy")
def _put_record(out, at, n, count, fields, words, texts, letters, given, common):  # type: ignore[no-untyped-def]
    """Write the fields of one record; where they end."""
    for f in range(len(fields)):
        number, form, size, inner = fields[f, _NUMBER], fields[f, _FORM], fields[f, _SIZE], fields[f, _INNER]
        first = fields[f, _START] * count + n * size
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
    "Array(uint8, 1, 'C', readonly=True), boolean[:,::1], UniTuple(int64, 3))",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def write_list(
    group: int,
    count: int,
    fields: Int64Array,
    words: UInt32Array,
    texts: Int64Array,
    letters: UInt8Array,
    given: BoolArray,
    common: tuple[int, int, int],
) -> UInt8Array:
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
