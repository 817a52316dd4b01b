"""The checkerboard that stands in for what a drive does not show."""

import re
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError

_TEXT = re.compile(r"(\d+)x(\d+):([\d.]+)(?::([\d.]+)x([\d.]+))?")


@dataclass(frozen=True, slots=True)
class Board:
    """A flat rectangle with a checkerboard in its middle.

    Attributes:
        columns, rows: inner corners of the pattern, where four squares meet.
        square: side of a square [m].
        width, height: of the whole board [m], along columns and rows.

    Raises:
        OptionError: a number is out of bounds.
    """

    columns: int
    rows: int
    square: float
    width: float
    height: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or max(self.columns, self.rows) > 100:
            raise OptionError(
                f"board of {self.columns}x{self.rows} inner corners; expected 3 to 100 each way"
            )
        least = (self.columns * self.square, self.rows * self.square)
        if not (self.square > 0 and self.width > least[0] and self.height > least[1]):
            raise OptionError(
                f"board of {self.width} x {self.height} m with squares of {self.square} m; expected a pattern that fits"
            )

    @classmethod
    def parse(cls, text: str) -> "Board":
        """Read `COLUMNSxROWS:SQUARE[:WIDTHxHEIGHT]`, inner corners and metres; without a size squares go to the edge.

        Raises:
            OptionError: it is written otherwise.
        """
        found = _TEXT.fullmatch(text.strip())
        if found is None:
            raise OptionError(
                f"board {text!r}; expected COLUMNSxROWS:SQUARE[:WIDTHxHEIGHT], like 7x5:0.1:0.9x0.7"
            )
        columns, rows, square = int(found[1]), int(found[2]), float(found[3])
        width = float(found[4] or (columns + 1) * square)
        height = float(found[5] or (rows + 1) * square)
        return cls(columns, rows, square, width, height)

    @property
    def corners(self) -> Float64Array:
        """The inner corners on the board, (rows columns, 3) [m], row after row, the board's middle at the origin."""
        across = (np.arange(self.columns) - (self.columns - 1) / 2.0) * self.square
        down = (np.arange(self.rows) - (self.rows - 1) / 2.0) * self.square
        u, v = np.meshgrid(across, down)
        return np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=1)
