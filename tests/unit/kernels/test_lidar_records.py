"""Taking 23-byte records apart, against Python's `struct`."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.formats.recording.lidars import XYZIRT
from sceneloom.kernels.packed import unpack

FLOAT32 = st.floats(width=32)
RECORDS = st.lists(
    st.tuples(
        FLOAT32, FLOAT32, FLOAT32, st.integers(0, 255), st.integers(0, 65535), st.floats(-9.2e9, 9.2e9)
    ),
    max_size=9,
)


@pytest.mark.parametrize("address", range(4))
@given(records=RECORDS)
def test_every_field_is_what_struct_finds_wherever_the_records_begin(address, records):
    content = b"?" * address + b"".join(struct.pack("<fffBHd", *record) for record in records)
    packed = np.frombuffer(content, np.uint8)[address:].view(XYZIRT)
    count = len(records)
    positions, intensities = np.full((count, 3), 7, np.float32), np.full(count, 7, np.uint8)
    rings, seconds, times = np.full(count, 7, np.uint16), np.full(count, 7.0), np.full(count, 7, np.int64)
    unpack(packed, positions, intensities, rings, seconds, times)
    expected = list(struct.iter_unpack("<fffBHd", content[address:]))
    np.testing.assert_array_equal(positions, np.array([r[:3] for r in expected], np.float32).reshape(-1, 3))
    assert intensities.tolist() == [r[3] for r in expected]
    assert rings.tolist() == [r[4] for r in expected]
    assert seconds.tobytes() == b"".join(struct.pack("<d", r[5]) for r in expected)
    # `round` takes halves to even
    assert times.tolist() == [round(r[5] * 1e9) for r in expected]
