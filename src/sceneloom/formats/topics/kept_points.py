"""Sweeps whose points stay as they are packed in their message until somebody asks for one of their fields."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sceneloom.formats.topics.records import CloudRecord
from sceneloom.scene.clouds import LidarPoints

if TYPE_CHECKING:
    from sceneloom.formats.topics.sweeps import CloudReader


@dataclass(frozen=True, slots=True, eq=False)
class KeptPoints:
    """The points of a message of ours, which can be copied into another as they are.

    Attributes:
        reader: of the message.
        row: number of the sweep.
        record: the message.
        count: how many points it has.
    """

    reader: "CloudReader"
    row: int
    record: CloudRecord
    count: int

    def __len__(self) -> int:
        return self.count

    def unpacked(self) -> LidarPoints:
        """Take them apart.

        Raises:
            DataError: a time is impossible.
        """
        return self.reader.unpacked(self.row, self.record)[0]


def can_be_kept(record: CloudRecord) -> bool:
    """Whether a message is as we write them: nothing in it has to be brought to another scale or location."""
    intensity = next((field for field in record.fields if field.name == "intensity"), None)
    return (
        (record.frame_from_points is None or np.array_equal(record.frame_from_points.matrix, np.eye(4)))
        and record.row_bytes is None
        and (intensity is None or intensity.dtype.str[1:] in ("u1", "f4"))
    )


def kept_record(points: LidarPoints, timestamp_ns: int) -> CloudRecord | None:
    """The message that points of a sweep of that time stand in, where it can be copied as it is."""
    packed = points.packed_records()
    if not isinstance(packed, KeptPoints) or packed.record.timestamp_ns != timestamp_ns:
        return None
    return packed.record
