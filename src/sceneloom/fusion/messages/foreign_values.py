"""Values out of messages of other systems, which come as mappings: each is checked before it is used."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import Float32Array, Float64Array
from sceneloom.errors import DataError
from sceneloom.fusion.messages.basic_types import BasicType, check_basic, shown
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData
from sceneloom.fusion.messages.timestamps import Timestamp

ForeignRecord = ImageData | PointCloudData | Boxes3d | Boxes2d
"""The records that messages of other systems become."""


@dataclass(frozen=True, slots=True)
class ForeignMessage:
    """A message of another system.

    Attributes:
        owner: its type, for messages.
        content: its fields.
        place: where it stands in the message that holds it, for messages.
    """

    owner: str
    content: Mapping[str, Any]
    place: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.content, Mapping):
            raise DataError(self.owner, self.place, f"{shown(self.content)}; expected an object")

    def fault(self, name: str, problem: str) -> DataError:
        """What is wrong with a field."""
        return DataError(self.owner, f"{self.place}.{name}" if self.place else name, problem)

    def value(self, name: str) -> Any:
        """A field.

        Raises:
            DataError: it is missing.
        """
        if name not in self.content:
            raise self.fault(name, "missing")
        return self.content[name]

    def inner(self, name: str) -> "ForeignMessage":
        """A message in a field."""
        return ForeignMessage(self.owner, self.value(name), f"{self.place}.{name}" if self.place else name)

    def each(self, name: str) -> list["ForeignMessage"]:
        """The messages of a list.

        Raises:
            DataError: it is missing or no list of messages.
        """
        values = self.value(name)
        if not isinstance(values, Sequence) or isinstance(values, str | bytes):
            raise self.fault(name, f"{shown(values)}; expected a list")
        place = f"{self.place}.{name}" if self.place else name
        return [ForeignMessage(self.owner, value, f"{place}[{k}]") for k, value in enumerate(values)]

    def number(self, name: str) -> float:
        """A finite number."""
        return float(self._checked(BasicType.DOUBLE, name))

    def whole(self, name: str) -> int:
        """A uint32."""
        return int(self._checked(BasicType.UINT32, name))

    def text(self, name: str) -> str:
        """A text."""
        return str(self._checked(BasicType.STRING, name))

    def vector(self, names: str) -> Float64Array:
        """Numbers by their names, one letter each."""
        return np.array([self.number(name) for name in names])

    def content_bytes(self, name: str) -> bytes:
        """Bytes, or a list or array of them."""
        value = self.value(name)
        if isinstance(value, bytes):
            return value
        if isinstance(value, bytearray | memoryview):
            return bytes(value)
        if isinstance(value, np.ndarray) and value.dtype in (np.uint8, np.int8):
            return value.tobytes()
        if isinstance(value, list | tuple) and all(type(k) is int and 0 <= k <= 255 for k in value):
            return bytes(value)
        raise self.fault(name, f"{shown(value)}; expected bytes")

    def timestamp(self, seconds: str, nanoseconds: str) -> Timestamp:
        """The time that two fields say."""
        return Timestamp(self.whole(seconds), self._below_a_second(nanoseconds))

    def _below_a_second(self, name: str) -> int:
        value = self.whole(name)
        if value >= 10**9:
            raise self.fault(name, f"{value}; expected 0 to 999999999")
        return value

    def _checked(self, kind: BasicType, name: str) -> Any:
        place = f"{self.place}.{name}" if self.place else name
        return check_basic(kind, self.value(name), owner=self.owner, place=place)


def rows_of_three(vectors: Sequence[ArrayLike]) -> Float32Array:
    """Give vectors as (N, 3) float32."""
    return np.array(vectors, np.float64).reshape(len(vectors), 3).astype(np.float32)


def quaternion_of_direction(direction: Sequence[float]) -> Float64Array:
    """Give the turn of the x axis into a direction, without roll.

    Args:
        direction: (3,), not 0, of any length.

    Returns:
        (4,) x, y, z, w.
    """
    dx, dy, dz = (float(part) for part in direction)
    yaw, pitch = np.arctan2(dy, dx) / 2, -np.arctan2(dz, np.hypot(dx, dy)) / 2
    # the turn about z after the turn about y
    return np.array(
        [
            -np.sin(yaw) * np.sin(pitch),
            np.cos(yaw) * np.sin(pitch),
            np.sin(yaw) * np.cos(pitch),
            np.cos(yaw) * np.cos(pitch),
        ]
    )


def direction_of_quaternion(message: ForeignMessage) -> Float64Array:
    """Give where the x axis points after a turn, (3,), unit.

    Raises:
        DataError: it is no turn: all four numbers are 0, or they are not finite.
    """
    quaternion = message.vector("xyzw")
    norm = float(np.linalg.norm(quaternion))
    if not 0 < norm < np.inf:
        raise DataError(message.owner, message.place, f"{quaternion.tolist()}; expected a quaternion")
    x, y, z, w = quaternion / norm
    return np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
