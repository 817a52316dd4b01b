"""What a list of boxes does not state itself: whose they are, when its frames were, and how frames lie."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, eq=False)
class ListContext:
    """The sensor whose detector wrote a list.

    Attributes:
        sensor_id: the lidar, or the camera.
        timestamps_ns: of its sweeps or images, (N,) int64 [ns], rising: by them, frames are numbered.
        number: `sensor_id` of the records that are its own; None for all.
        others: those of other sensors that are known, whose records are no matter.
        source: `world_from_sensor`, for boxes in the world; None where it is not known.
        sensor_from_camera: takes the rectified camera's frame into the sensor's, for KITTI's boxes in space; None where
            it is not known.
        label: class of all boxes of a list that has none; None for that of its folder's name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    number: int | None = None
    others: frozenset[int] = frozenset()
    source: PoseSource | None = None
    sensor_from_camera: RigidTransform | None = None
    label: str | None = None

    def time_of(self, frame: int, path: Path, location: str) -> int:
        """When a frame was [ns].

        Raises:
            DataError: the sensor has no frame of that number.
        """
        if not 0 <= frame < len(self.timestamps_ns):
            raise DataError(
                path,
                location,
                f"frame {frame}; expected 0 to {len(self.timestamps_ns) - 1}, as sensor {self.sensor_id!r} has them",
            )
        return int(self.timestamps_ns[frame])


Read3D = Callable[[Path, ListContext, Ledger], Sequence[Boxes3D]]
Read2D = Callable[[Path, ListContext, Ledger], Sequence[Boxes2D]]


@dataclass(frozen=True, slots=True)
class ListForm:
    """One form of lists.

    Attributes:
        name: of the form.
        looks_like: what a person knows it by.
        recognises: whether the beginning of a file, its blanks taken off, is of this form.
        read_3d: reads boxes in space; None where the form has none.
        read_2d: reads boxes in images; None where the form has none.
    """

    name: str
    looks_like: str
    recognises: Callable[[str], bool]
    read_3d: Read3D | None = None
    read_2d: Read2D | None = None


def sorted_by_time(lists: Sequence[Boxes3D] | Sequence[Boxes2D]) -> list[int]:
    """The numbers of lists in the order of their times."""
    times = np.array([boxes.timestamp_ns for boxes in lists], np.int64)
    order: list[int] = np.argsort(times, kind="stable").tolist()
    return order
