"""Lidar records of 23 bytes, taken apart."""

import numba
import numpy as np
from numba import float32, float64, int64, types, uint8, uint16, void

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array, UInt16Array
from sceneloom.kernels.cache import kernel

_RECORD = numba.from_dtype(
    np.dtype(
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2"), ("timestamp", "<f8")]
    )
)
_RECORDS = types.Array(_RECORD, 1, "C", readonly=True)


@kernel(
    void(_RECORDS, float32[:, ::1], uint8[::1], uint16[::1], float64[::1], int64[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def unpack(
    records: AnyArray,
    positions: Float32Array,
    intensities: UInt8Array,
    rings: UInt16Array,
    seconds: Float64Array,
    timestamps_ns: Int64Array,
) -> None:
    """Take N records apart in one pass, which memory bounds.

    Args:
        records: (N,) packed, their times within what int64 nanoseconds hold.
        positions: (N, 3) [m], filled.
        intensities: (N,), filled.
        rings: (N,), filled.
        seconds: (N,) [s], filled with the times as they are.
        timestamps_ns: (N,) [ns], filled with round(t · 1e9), halves to even.
    """
    for k in range(len(records)):
        record = records[k]
        positions[k, 0], positions[k, 1], positions[k, 2] = record["x"], record["y"], record["z"]
        intensities[k] = record["intensity"]
        rings[k] = record["ring"]
        seconds[k] = record["timestamp"]
        timestamps_ns[k] = np.int64(np.rint(record["timestamp"] * 1e9))
