"""Red, green and blue of a decoded image: by a formula of ours where there is one, else by FFmpeg's converter."""

from typing import TYPE_CHECKING

import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter

from sceneloom.arrays import UInt8Array

if TYPE_CHECKING:
    from sceneloom.formats.video.colour_formula import ColourFormula

_TO_RGB = Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
"""Chroma interpolated, results rounded: half a level off the formulas, where the fast way is 1 to 3 dark."""

_HALVED = frozenset({"yuv420p", "yuvj420p"})
"""FFmpeg's names of pixels in three planes of bytes, the colours at half the resolution both ways."""


class Colours:
    """Converts the images of one stream; for one thread at a time."""

    def __init__(self) -> None:
        self._reformatter = VideoReformatter()
        self._formulas: dict[tuple[str, int, int, bool], ColourFormula | None] = {}

    def rgb(self, frame: VideoFrame) -> UInt8Array:
        """Give (height, width, 3) uint8, red green blue.

        Raises:
            av.FFmpegError, ValueError: the converter does not know the image's pixels.
        """
        formula = self._formula_of(frame) if _is_halved(frame) else None
        return convert(frame, self._reformatter) if formula is None else formula.rgb(frame)

    def _formula_of(self, frame: VideoFrame) -> "ColourFormula | None":
        kind = (frame.format.name, frame.colorspace, frame.color_range, frame.interlaced_frame)
        if kind not in self._formulas:
            # loads the compiler: for images only, not for opening and counting
            from sceneloom.formats.video.colour_formula import formula_like_converter

            self._formulas[kind] = formula_like_converter(frame)
        return self._formulas[kind]


def convert(frame: VideoFrame, reformatter: VideoReformatter) -> UInt8Array:
    """Have FFmpeg's converter give (height, width, 3) uint8, red green blue, of any kind of pixels.

    Raises:
        av.FFmpegError, ValueError: it does not know them.
    """
    image = reformatter.reformat(frame, format="rgb24", interpolation=_TO_RGB, threads=1)
    return np.ascontiguousarray(image.to_ndarray())


def _is_halved(frame: VideoFrame) -> bool:
    """Whether all colours are halves; of an odd size the converter stretches them, and rows may stand upside down."""
    even = not (frame.width % 2 or frame.height % 2)
    return (
        frame.format.name in _HALVED
        and even
        and all(plane.line_size >= plane.width for plane in frame.planes)
    )
