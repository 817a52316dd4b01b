"""What sensors send, as records: raw bytes, images and point clouds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float32Array, UInt8Array
from sceneloom.fusion.messages.basic_types import shown
from sceneloom.fusion.messages.encodings import ENCODINGS, check_pixels
from sceneloom.fusion.messages.tables import IMAGE, POINT_CLOUD, RAW, Table
from sceneloom.fusion.messages.timestamps import Timestamp


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RawData:
    """Bytes as a sensor made them.

    Attributes:
        sensor_id: 0 to 255.
        timestamp: when they were made.
        seq: number in the sequence, a uint32.
        length: how many bytes.
        data: the bytes.

    Raises:
        DataError: a field is missing, of another type or out of range, or `length` is not that of `data`.

    Source: DB34/T 4101-2022, table 4.
    """

    sensor_id: int
    timestamp: Timestamp
    seq: int
    length: int
    data: bytes

    def __post_init__(self) -> None:
        RAW.settle(self)
        if self.length != len(self.data):
            raise RAW.fault("length", f"{self.length}; expected {len(self.data)}, as there are bytes in data")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ImageData:
    """One image.

    Attributes:
        sensor_id: of the camera, 0 to 255.
        timestamp: when it was made.
        seq: number in the sequence, a uint32.
        height, width: of the image [px], at least 1.
        encoding: a name out of `ENCODINGS`.
        channel: values per pixel.
        data: uint8, height * width * channel values row by row; a whole file where the encoding is jpeg or png. Given
            in any shape, kept flat and read-only.

    Raises:
        DataError: a field is missing, of another type or out of range, or they do not belong together.

    Source: DB34/T 4101-2022, table 5.
    """

    sensor_id: int
    timestamp: Timestamp
    seq: int
    height: int
    width: int
    encoding: str
    channel: int
    data: UInt8Array

    def __post_init__(self) -> None:
        IMAGE.settle(self)
        check_pixels(
            IMAGE,
            self.encoding,
            size_hwc=(self.height, self.width, self.channel),
            length=self.data.size,
            channel_name="channel",
            data_name="data",
        )

    @property
    def pixels(self) -> UInt8Array | None:
        """The pixels, (height, width, channel) uint8, a view; None of a file, which wants decoding."""
        if ENCODINGS[self.encoding].is_file:
            return None
        return self.data.reshape(self.height, self.width, self.channel)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PointCloudData:
    """One point cloud.

    Attributes:
        sensor_id: of the lidar, 0 to 255.
        timestamp: when it was measured.
        seq: number in the sequence, a uint32.
        number: how many points.
        fields: what each point has; x, y and z among it.
        fields_number: how many fields.
        data: float32, number * fields_number values point by point; what fuses the cloud leaves out and counts points
            with a number that is not finite, which is how drivers mark missing returns. Given in any shape, kept flat
            and read-only.
        sensor_type: 0 for a mechanical lidar, 1 for a solid-state lidar.
        beam: how many beams a mechanical lidar has, or None.
        ring: the beam that all points are of, where the lidar is mechanical, or None.

    Raises:
        DataError: a field is missing, of another type or out of range, or they do not belong together.

    Source: DB34/T 4101-2022, table 6.
    """

    sensor_id: int
    timestamp: Timestamp
    seq: int
    number: int
    fields: tuple[str, ...]
    fields_number: int
    data: Float32Array
    sensor_type: int = 0
    beam: int | None = None
    ring: int | None = None

    def __post_init__(self) -> None:
        POINT_CLOUD.settle(self)
        check_fields(POINT_CLOUD, "fields", self.fields, self.fields_number)
        check_point_count(
            POINT_CLOUD,
            names=("number", "data"),
            number=self.number,
            fields_number=self.fields_number,
            length=self.data.size,
        )
        for name in ("beam", "ring"):
            if self.sensor_type == 1 and getattr(self, name) is not None:
                raise POINT_CLOUD.fault(name, f"{getattr(self, name)} of a solid-state lidar; expected none")

    @property
    def points(self) -> Float32Array:
        """The points, (number, fields_number) float32, a view."""
        return self.data.reshape(self.number, self.fields_number)

    def columns(self, names: Sequence[str]) -> Float32Array:
        """Some fields of all points, (number, len(names)) float32.

        Raises:
            KeyError: the points have no field of such a name.
        """
        missing = [name for name in names if name not in self.fields]
        if missing:
            raise KeyError(missing[0])
        return np.ascontiguousarray(self.points[:, [self.fields.index(name) for name in names]])


def check_fields(table: Table, name: str, fields: tuple[str, ...], fields_number: int) -> None:
    """Check the names of the fields that points have.

    Raises:
        DataError: x, y or z is missing, a name is empty or stands twice, or there are more or fewer than stated.
    """
    if not {"x", "y", "z"} <= set(fields):
        raise table.fault(name, f"{shown(fields)}; expected x, y and z among them")
    if "" in fields or len(set(fields)) != len(fields):
        raise table.fault(name, f"{shown(fields)}; expected different names")
    if fields_number != len(fields):
        raise table.fault(
            "fields_number", f"{fields_number}; expected {len(fields)}, as there are names in {name}"
        )


def check_point_count(
    table: Table, *, names: tuple[str, str], number: int, fields_number: int, length: int
) -> None:
    """Check that there are as many values as the points need.

    Args:
        names: how the table calls the number of points, and the values.

    Raises:
        DataError: there are more or fewer.
    """
    if length != number * fields_number:
        expected = f"{number * fields_number} ({names[0]} * fields_number)"
        raise table.fault(names[1], f"{length} values; expected {expected}")
