"""Unfolding LZF, against a slow reading of its description.

Taking 23-byte records apart, against Python's `struct`.
"""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.formats.recording.contents import XYZIRT
from sceneloom.kernels.packed import LARGEST_RATIO, unfold, unpack


def unfold_slowly(packed):
    """Take one instruction after the other; None where the stream is damaged."""
    rest, out = list(packed), []
    try:
        while rest:
            control = rest.pop(0)
            if control < 32:
                out += [rest.pop(0) for _ in range(control + 1)]
                continue
            length = control >> 5
            if length == 7:
                length += rest.pop(0)
            distance = ((control & 31) << 8) + rest.pop(0) + 1
            if distance > len(out):
                return None
            for _ in range(length + 2):
                out.append(out[-distance])
    except IndexError:
        return None
    return bytes(out)


def unfolded(packed, size):
    target = np.full(size, 99, np.uint8)
    done = unfold(np.frombuffer(packed, np.uint8), target)
    return target.tobytes() if done == size else None


@pytest.mark.parametrize(
    ("packed", "expected"),
    [
        (b"\x02abc", b"abc"),
        (b"\x00a\x20\x00", b"aaaa"),
        (b"\x01ab\xe0\x05\x01", b"abababababababab"),
        (b"\x02abc\x40\x02\x00d", b"abcabcad"),
        (b"", b""),
    ],
)
def test_streams_made_by_hand_unfold(packed, expected):
    assert (unfold_slowly(packed), unfolded(packed, len(expected))) == (expected, expected)


@given(st.binary(max_size=60))
def test_any_bytes_unfold_as_the_description_says(packed):
    expected = unfold_slowly(packed)
    size = 1 if expected is None else len(expected)
    if expected is not None:
        assert unfolded(packed, size) == expected
        assert size <= len(packed) * LARGEST_RATIO
        assert unfolded(packed, size + 1) is None, "too little"
    if size > 1:
        assert unfolded(packed, size - 1) is None, "too much"


FLOAT32 = st.floats(width=32)

RECORDS = st.lists(
    st.tuples(FLOAT32, FLOAT32, FLOAT32, st.integers(0, 255), st.integers(0, 65535), st.floats(-9.2e9, 9.2e9)),
    max_size=9,
)


@pytest.mark.parametrize("address", range(4))
@given(records=RECORDS)
def test_every_field_is_what_struct_finds_wherever_the_records_begin(address, records):
    content = b"?" * address + b"".join(struct.pack("<fffBHd", *record) for record in records)
    packed, count = np.frombuffer(content, np.uint8)[address:].view(XYZIRT), len(records)
    positions, intensities = np.full((count, 3), 7, np.float32), np.full(count, 7, np.uint8)
    rings, seconds, times = np.full(count, 7, np.uint16), np.full(count, 7.0), np.full(count, 7, np.int64)
    unpack(packed, positions, intensities, rings, seconds, times)
    expected = list(struct.iter_unpack("<fffBHd", content[address:]))
    np.testing.assert_array_equal(positions, np.array([r[:3] for r in expected], np.float32).reshape(-1, 3))
    assert (intensities.tolist(), rings.tolist()) == ([r[3] for r in expected], [r[4] for r in expected])
    assert seconds.tobytes() == b"".join(struct.pack("<d", r[5]) for r in expected)
    # `round` takes halves to even
    assert times.tolist() == [round(r[5] * 1e9) for r in expected]
