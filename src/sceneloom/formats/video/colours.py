"""Red, green and blue of a decoded picture: by a kernel of ours where it follows the converter, else by that."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from av.video.frame import VideoFrame
from av.video.plane import VideoPlane
from av.video.reformatter import Interpolation, VideoReformatter

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.kernels.halved_chroma import conversion_factors, rgb_from_halved_chroma

_TO_RGB = Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
"""Chroma interpolated, results rounded: half a level off the formulas, where the fast way is 1 to 3 dark."""

_HALVED = frozenset({"yuv420p", "yuvj420p"})
"""FFmpeg's names of pixels in three planes of bytes, the colours at half the resolution both ways."""

_SHARES = ((0.299, 0.114), (0.2126, 0.0722))
"""Of red and of blue in brightness. Source: ITU-R BT.601-7 and BT.709-6, clause 3."""

_PROBE_WIDTH, _PROBE_HEIGHT = 32, 16
"""Enough for a few dozen samples of colour away from the edges."""


@dataclass(frozen=True, slots=True, eq=False)
class _Formula:
    """Arguments of the kernel: its factors, and how far right of the even column a colour sample lies."""

    factors: Int64Array
    half_columns: int

    def rgb(self, frame: VideoFrame) -> UInt8Array:
        luma, blue, red = (_rows(plane) for plane in frame.planes)
        rgb = np.empty((frame.height, frame.width, 3), np.uint8)
        rgb_from_halved_chroma(
            luma, blue, red, self.factors, self.half_columns, rgb.reshape(frame.height, 3 * frame.width)
        )
        return rgb


_FORMULAS = tuple(
    _Formula(conversion_factors(*shares, full=full), half_columns)
    for shares, full, half_columns in product(_SHARES, (False, True), (0, 1))
)


class Colours:
    """Converts the pictures of one stream; for one thread at a time."""

    def __init__(self) -> None:
        self._reformatter = VideoReformatter()
        self._formulas: dict[tuple[str, int, int], _Formula | None] = {}

    def rgb(self, frame: VideoFrame) -> UInt8Array:
        """Give (height, width, 3) uint8, red green blue.

        Raises:
            av.FFmpegError, ValueError: the converter does not know the picture's pixels.
        """
        formula = self._formula_of(frame)
        return formula.rgb(frame) if formula is not None else self._converted(frame)

    def _converted(self, frame: VideoFrame) -> UInt8Array:
        image = self._reformatter.reformat(frame, format="rgb24", interpolation=_TO_RGB, threads=1)
        return np.ascontiguousarray(image.to_ndarray())

    def _formula_of(self, frame: VideoFrame) -> _Formula | None:
        if frame.format.name not in _HALVED or frame.width % 2 or frame.height % 2:
            return None
        if any(plane.line_size < plane.width for plane in frame.planes):
            return None
        kind = (frame.format.name, frame.colorspace, frame.color_range)
        if kind not in self._formulas:
            self._formulas[kind] = _formula_like_converter(frame)
        return self._formulas[kind]


def _formula_like_converter(frame: VideoFrame) -> _Formula | None:
    """Find what does as the converter does with a picture that bears all the marks of this one.

    What a stream says of its colours the converter may know better: where their samples lie is told to nobody else.
    """
    probe = VideoReformatter().reformat(frame, width=_PROBE_WIDTH, height=_PROBE_HEIGHT)
    if probe is frame:
        return None
    random = np.random.default_rng(0)
    for plane in probe.planes:
        plane.update(random.integers(60, 190, plane.buffer_size, dtype=np.uint8).tobytes())
    image = VideoReformatter().reformat(probe, format="rgb24", interpolation=_TO_RGB, threads=1)
    converted = image.to_ndarray().astype(np.int16)
    for formula in _FORMULAS:
        if np.abs(formula.rgb(probe) - converted).max() <= 1:
            return formula
    return None


def _rows(plane: VideoPlane) -> UInt8Array:
    """(height, at least width), the memory of the plane itself."""
    return np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)
