"""Raw pixels of messages, by the names of their encodings, as images or depths."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import cast

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, UInt8Array
from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.topics.records import ImageRecord

MILLIMETRE = 0.001
"""Metres per step of depths in whole numbers. Source: REP 118, "Depth Images"."""


@dataclass(frozen=True, slots=True)
class Encoding:
    """How pixels stand in the bytes.

    Attributes:
        dtype: of each value.
        values: of each pixel.
        order: which of them are red, green and blue; () for depths.
        bayer: colours of the two first pixels of the two first rows, "" for none.
    """

    dtype: str
    values: int = 1
    order: tuple[int, ...] = (0, 0, 0)
    bayer: str = ""


def _bayer() -> dict[str, Encoding]:
    return {
        f"bayer_{pattern}{suffix}": Encoding(dtype, bayer=pattern)
        for pattern in ("rggb", "bggr", "gbrg", "grbg")
        for suffix, dtype in (("8", "u1"), ("16", "u2"))
    }


ENCODINGS: Mapping[str, Encoding] = MappingProxyType(
    {
        "rgb8": Encoding("u1", 3, (0, 1, 2)),
        "bgr8": Encoding("u1", 3, (2, 1, 0)),
        "rgba8": Encoding("u1", 4, (0, 1, 2)),
        "bgra8": Encoding("u1", 4, (2, 1, 0)),
        "rgb16": Encoding("u2", 3, (0, 1, 2)),
        "bgr16": Encoding("u2", 3, (2, 1, 0)),
        "mono8": Encoding("u1"),
        "mono16": Encoding("u2"),
        "8UC1": Encoding("u1"),
        "8UC3": Encoding("u1", 3, (2, 1, 0)),
        "8UC4": Encoding("u1", 4, (2, 1, 0)),
        "16UC1": Encoding("u2", order=()),
        "32FC1": Encoding("f4", order=()),
        **_bayer(),
    }
)
"""Source: sensor_msgs/image_encodings.hpp of ROS; the schema RawImage of Foxglove takes the same names."""


def encoding_of(record: ImageRecord, owner: str, location: str) -> Encoding:
    """Find the encoding of a message.

    Raises:
        UnknownFormatError: it is unknown.
    """
    encoding = ENCODINGS.get(record.encoding)
    if encoding is None:
        known = ", ".join(ENCODINGS)
        raise UnknownFormatError(owner, location, f"encoding {record.encoding!r}; expected one of {known}")
    return encoding


def values_of(record: ImageRecord, owner: str, location: str) -> AnyArray:
    """Give the values of all pixels, (height, width, K) of the encoding's dtype, in native byte order.

    Raises:
        DataError: the encoding is unknown, or the bytes do not fit the size.
    """
    encoding = encoding_of(record, owner, location)
    dtype = np.dtype(encoding.dtype).newbyteorder(">" if record.big_endian else "<")
    row = record.width * encoding.values * dtype.itemsize
    step = record.step or row
    if record.width <= 0 or record.height <= 0 or step < row or len(record.data) < record.height * step:
        problem = (
            f"{len(record.data)} bytes in rows of {step} for {record.width}x{record.height} pixels of "
            f"{record.encoding}; expected rows of {row} or more, and all of them"
        )
        raise DataError(owner, location, problem)
    content = np.frombuffer(record.data, np.uint8, record.height * step).reshape(record.height, step)
    values = np.ascontiguousarray(content[:, :row]).view(dtype)
    native = values.astype(dtype.newbyteorder("="), copy=False)
    return native.reshape(record.height, record.width, encoding.values)


def image_of(record: ImageRecord, owner: str, location: str) -> UInt8Array:
    """Give an image, (height, width, 3) uint8 red green blue; of 16 bits the upper eight.

    Raises:
        DataError: as for `values_of`, or the pixels are depths.
    """
    encoding = encoding_of(record, owner, location)
    if not encoding.order:
        raise DataError(owner, location, f"encoding {record.encoding!r} is of depths; expected an image")
    values = values_of(record, owner, location)
    if values.dtype == np.uint16:
        values = (values >> 8).astype(np.uint8)
    if encoding.bayer:
        return _colours(values[:, :, 0], encoding.bayer)
    return np.ascontiguousarray(values[:, :, list(encoding.order)])


def depth_of(record: ImageRecord, owner: str, location: str) -> Float32Array:
    """Give depths, (height, width) float32 [m], 0 for none.

    Raises:
        DataError: as for `values_of`.
    """
    values = values_of(record, owner, location)[:, :, 0]
    if values.dtype == np.uint16:
        return (values * np.float64(MILLIMETRE)).astype(np.float32)
    return cast("Float32Array", np.where(np.isfinite(values) & (values > 0), values, np.float32(0)))


def _colours(mosaic: UInt8Array, pattern: str) -> UInt8Array:
    """Give each pixel the colours that it lacks as means of the nearest pixels that have them."""
    height, width = mosaic.shape
    image = np.empty((height, width, 3), np.uint8)
    for channel, letter in enumerate("rgb"):
        mask = np.zeros((height, width), np.uint16)
        for location, colour in enumerate(pattern):
            if colour == letter:
                mask[location // 2 :: 2, location % 2 :: 2] = 1
        image[:, :, channel] = _filled(mosaic.astype(np.uint16), mask)
    return image


def _filled(values: AnyArray, mask: AnyArray) -> AnyArray:
    """Keep the values where the mask is 1, and give the others the mean of those around, side before corner."""
    sums, counts = _around(values * mask), _around(mask)
    means = (sums + counts // 2) // np.maximum(counts, 1)
    return np.where(mask, values, means).astype(np.uint8)


def _around(values: AnyArray) -> AnyArray:
    """Sums over three by three pixels, weighted 1 2 1 both ways, as bilinear interpolation does."""
    padded = np.pad(values, 1)
    rows: AnyArray = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    return cast("AnyArray", rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:])
