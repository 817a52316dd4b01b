"""LZF, the compression of `binary_compressed` PCD files."""

import numba
from numba import int64, types, uint8

from sceneloom.arrays import UInt8Array

LARGEST_RATIO = 264 / 3
"""A back reference of three bytes stands for at most 264: no stream can unfold to more than this times its length."""

_LITERALS = 32
_LONG = 7
_SHORTEST = 2

_IN_U8 = types.Array(uint8, 1, "C", readonly=True)


@numba.njit(int64(_IN_U8, uint8[::1]), cache=True, nogil=True)
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
