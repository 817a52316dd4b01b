"""LZF, the compression of `binary_compressed` PCD files."""

import numpy as np
from numba import int64, types, uint8

from sceneloom.arrays import UInt8Array
from sceneloom.kernels.cache import kernel

LARGEST_RATIO = 264 / 3
"""A back reference of three bytes stands for at most 264: no stream can unfold to more than this times its length."""

_LITERALS = 32
_LONG = 7
_SHORTEST = 2

_IN_U8 = types.Array(uint8, 1, "C", readonly=True)


@kernel(int64(_IN_U8, uint8[::1]), cache=True, nogil=True)
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


@kernel(int64(_IN_U8, uint8[::1]), cache=True, nogil=True)
def fold(plain: UInt8Array, packed: UInt8Array) -> int:
    """Fold bytes into an LZF stream, which `unfold` describes: the last location of each three bytes is looked back to.

    Args:
        plain: what is packed.
        packed: of at least `longest_fold(plain.size)` bytes.

    Returns:
        How many bytes the stream has.
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
