"""Masks of images by their runs, as COCO has them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.base.files import MOST_PIXELS

MASKS = "mask_rle"
"""Extra field of a path of 2D boxes: the masks that these bound, one per row, as `{"size": [h, w], "counts": text}`."""


@dataclass(frozen=True, slots=True)
class Mask:
    """A mask by its runs, column by column from the top left; the first run is outside of it.

    Attributes:
        height, width: of the image [px].
        runs: their lengths.
    """

    height: int
    width: int
    runs: tuple[int, ...]

    def __post_init__(self) -> None:
        total = self.height * self.width
        if min(self.height, self.width) < 1 or total > MOST_PIXELS or min(self.runs, default=-1) < 0:
            raise ValueError(f"a mask of {self.width}x{self.height}; expected 1 to {MOST_PIXELS} pixels and runs")
        if sum(self.runs) != total:
            raise ValueError(f"runs of {sum(self.runs)} pixels; expected {self.width}x{self.height}")

    @classmethod
    def of_pixels(cls, height: int, width: int, columns: Int64Array, rows: Int64Array) -> "Mask":
        """Make a mask of the pixels in it, in any order."""
        if len(columns) and (min(columns.min(), rows.min()) < 0 or columns.max() >= width or rows.max() >= height):
            raise ValueError(f"pixels outside of {width}x{height}")
        numbers = np.unique(columns * height + rows)
        breaks = np.flatnonzero(np.diff(numbers) > 1)
        starts = numbers[np.concatenate([[0], breaks + 1])] if len(numbers) else numbers
        stops = numbers[np.concatenate([breaks, [len(numbers) - 1]])] + 1 if len(numbers) else numbers
        edges = np.concatenate([[0], np.stack([starts, stops], axis=1).reshape(-1), [height * width]])
        return cls(height, width, tuple(np.diff(edges).tolist()))

    def pixels(self) -> tuple[Int64Array, Int64Array]:
        """Columns and rows of the pixels in it, column by column."""
        stops = np.cumsum(np.array(self.runs, np.int64))
        starts = np.concatenate([[0], stops[:-1]])
        inside = [np.arange(a, b) for a, b in zip(starts[1::2].tolist(), stops[1::2].tolist(), strict=True)]
        numbers = np.concatenate([np.zeros(0, np.int64), *inside]).astype(np.int64)
        return numbers // self.height, numbers % self.height

    @property
    def area(self) -> int:
        """How many pixels are in it."""
        return sum(self.runs[1::2])

    def box(self) -> Float64Array:
        """Left, top, width and height of what it covers [px]; all 0 where that is nothing."""
        stops = np.cumsum(np.array(self.runs, np.int64))
        starts = np.concatenate([[0], stops[:-1]])[1::2]
        inside = starts < stops[1::2]
        first, last = starts[inside], stops[1::2][inside] - 1
        if not len(first):
            return np.zeros(4)
        left, right = int(first[0]) // self.height, int(last[-1]) // self.height
        crosses = bool((first // self.height != last // self.height).any())
        top = 0 if crosses else int((first % self.height).min())
        bottom = self.height - 1 if crosses else int((last % self.height).max())
        return np.array([left, top, right + 1 - left, bottom + 1 - top], np.float64)

    def record(self) -> dict[str, Any]:
        """As COCO writes it, compressed."""
        return {"size": [self.height, self.width], "counts": packed_runs(self.runs)}

    @classmethod
    def of_record(cls, record: Any) -> "Mask":
        """Read it as COCO writes it, compressed or not.

        Raises:
            ValueError: it is none.
        """
        size = record.get("size") if isinstance(record, Mapping) else None
        if not isinstance(size, list | tuple) or len(size) != 2 or not all(type(one) is int for one in size):
            raise ValueError(f"{str(record)[:40]!r}; expected a mask with `size` [height, width] and `counts`")
        counts = record.get("counts")
        if isinstance(counts, str):
            counts = unpacked_runs(counts)
        if not isinstance(counts, list | tuple) or not all(type(one) is int for one in counts):
            raise ValueError("`counts` is no text and no list of whole numbers")
        return cls(size[0], size[1], tuple(counts))


def packed_runs(runs: Sequence[int]) -> str:
    """Write runs as COCO's text: from the fourth on the difference to the one before the last, in groups of five bits.

    Source: `rleToString` of the COCO API.
    """
    found = []
    for k, run in enumerate(runs):
        value = run - runs[k - 2] if k > 2 else run
        more = True
        while more:
            bits, value = value & 31, value >> 5
            more = value != (-1 if bits & 16 else 0)
            found.append(chr(48 + bits + 32 * more))
    return "".join(found)


def unpacked_runs(text: str) -> list[int]:
    """Read `packed_runs`.

    Raises:
        ValueError: the text is none.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift > 60:
            raise ValueError(f"{character!r} in the text of a mask; expected characters from '0' to 'o'")
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            value -= (1 << shift) if bits & 16 else 0
            runs.append(value + runs[-2] if len(runs) > 2 else value)
            value = shift = 0
    if shift:
        raise ValueError("the text of a mask ends within a number")
    return runs
