"""Which way the axes of a declared sensor frame point: triples of table 2 and plain words.

A *declared* frame is the one in which a session's sensors give their data; it may be rotated or left-handed. Inside,
lidars have x forward, y left, z up, and cameras x right, y down, z forward (optical).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.errors import CalibrationError

_AXIS = re.compile(r"\s*([+-]?)\s*([xyz])\s*", re.IGNORECASE)


class SensorKind(StrEnum):
    """Whose frame is declared."""

    CAMERA = "camera"
    LIDAR = "lidar"


@dataclass(frozen=True, slots=True, eq=False)
class DeclaredAxes:
    """Where forward, right and up of the vehicle point in a declared frame.

    Attributes:
        forward_right_up: (3, 3) float64, the three directions as columns, each a signed axis of the declared frame.

    Raises:
        CalibrationError: the columns are no three different axes.
    """

    forward_right_up: Float64Array

    def __post_init__(self) -> None:
        axes = np.abs(self.forward_right_up)
        if not np.array_equal(axes.sum(axis=0), np.ones(3)) or not np.array_equal(
            axes.sum(axis=1), np.ones(3)
        ):
            raise CalibrationError("axes for forward, right, up; expected x, y and z, each of them once")
        object.__setattr__(self, "forward_right_up", read_only(self.forward_right_up))

    @classmethod
    def of_triple(cls, triple: Sequence[int], *, left_handed: bool) -> "DeclaredAxes":
        """Read a triple of table 2: axis numbers of forward, right and up, negative for the opposite direction.

        There is no -0, so axis 0 carries no sign: it points to where it makes the frame as handed as declared.

        Args:
            triple: `camera_coordinate` or `lidar_coordinate`.
            left_handed: `chirality` 1.

        Raises:
            CalibrationError: the magnitudes are no permutation of 0, 1, 2.

        Source: table 2 of DB34/T 4101-2022, rows 2 to 4; READING of axis triples in docs/CONVENTIONS.md.
        """
        if len(triple) != 3 or sorted(abs(axis) for axis in triple) != [0, 1, 2]:
            raise CalibrationError(
                f"axes {tuple(triple)}; expected 0, 1 and 2 in any order, 1 and 2 with a sign"
            )
        columns = np.zeros((3, 3))
        for location, axis in enumerate(triple):
            columns[abs(axis), location] = -1.0 if axis < 0 else 1.0
        wanted = 1.0 if left_handed else -1.0
        if np.linalg.det(columns) * wanted < 0:
            columns[:, list(map(abs, triple)).index(0)] *= -1.0
        return cls(columns)

    @classmethod
    def of_words(cls, words: str) -> "DeclaredAxes":
        """Read the axes of forward, right and up in plain words, as "+z,+x,-y"; a sign left out is a plus.

        Raises:
            CalibrationError: it is no list of three different axes.
        """
        found = [_AXIS.fullmatch(word) for word in words.split(",")]
        if len(found) != 3 or any(match is None for match in found):
            raise CalibrationError(f"axes {words!r}; expected three of x, y, z with a sign, as in '+z,+x,-y'")
        columns = np.zeros((3, 3))
        for location, match in enumerate(found):
            if match is not None:
                columns["xyz".index(match[2].lower()), location] = -1.0 if match[1] == "-" else 1.0
        return cls(columns)

    @property
    def words(self) -> str:
        """The axes in plain words, as "+z,+x,-y"."""
        rows = np.abs(self.forward_right_up).argmax(axis=0)
        signs = self.forward_right_up[rows, range(3)]
        return ",".join(
            ("+" if sign > 0 else "-") + "xyz"[row] for row, sign in zip(rows, signs, strict=True)
        )

    @property
    def left_handed(self) -> bool:
        """Whether the declared frame is a left-handed one."""
        return bool(np.linalg.det(self.forward_right_up) > 0)

    def standard_from_declared(self, kind: SensorKind) -> Float64Array:
        """Give the (3, 3) float64 matrix that takes declared coordinates into the frame used inside.

        Its determinant is +1, or -1 where the declared frame is left-handed; its transpose takes them back.
        """
        forward, right, up = self.forward_right_up.T
        rows = (right, -up, forward) if kind is SensorKind.CAMERA else (forward, -right, up)
        return read_only(np.array(rows))
