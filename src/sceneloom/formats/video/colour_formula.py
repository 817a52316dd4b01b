"""Which formula FFmpeg's converter follows for the colours of a stream, and the same in a kernel of ours."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from av.video.frame import VideoFrame
from av.video.plane import VideoPlane
from av.video.reformatter import VideoReformatter

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.formats.video.colours import convert
from sceneloom.kernels.halved_chroma import conversion_factors, rgb_from_halved_chroma

_SHARES = ((0.299, 0.114), (0.2126, 0.0722))
"""Of red and of blue in brightness. Source: ITU-R BT.601-7 and BT.709-6, clause 3."""

_PROBE_WIDTH, _PROBE_HEIGHT = 32, 16
"""Room for a hundred samples of colour."""


@dataclass(frozen=True, slots=True, eq=False)
class ColourFormula:
    """How brightness and halved colours become red, green and blue.

    Attributes:
        factors: (6,) as the kernel takes them.
        half_columns: how far right of the even column a sample of colour lies, in halves of a pixel: 0 or 1.
    """

    factors: Int64Array
    half_columns: int

    def rgb(self, frame: VideoFrame) -> UInt8Array:
        """Give (height, width, 3) uint8 of an image of even size in three planes of bytes."""
        luma, blue, red = (_rows(plane) for plane in frame.planes)
        rgb = np.empty((frame.height, frame.width, 3), np.uint8)
        lines = rgb.reshape(frame.height, 3 * frame.width)
        rgb_from_halved_chroma(luma, blue, red, self.factors, self.half_columns, lines)
        return rgb


_FORMULAS = tuple(
    ColourFormula(conversion_factors(*shares, full=full), half_columns)
    for shares, full, half_columns in product(_SHARES, (False, True), (0, 1))
)


def formula_like_converter(frame: VideoFrame) -> ColourFormula | None:
    """Find the formula that gives what the converter gives, within a level, for an image marked like this one.

    The marks that state where samples of colour lie are shown to the converter only, so it is asked by an image that
    it marks itself. None where no formula of ours does.
    """
    probe = VideoReformatter().reformat(frame, width=_PROBE_WIDTH, height=_PROBE_HEIGHT)
    if probe is frame:
        return None
    random = np.random.default_rng(0)
    for plane in probe.planes:
        plane.update(random.integers(60, 190, plane.buffer_size, dtype=np.uint8).tobytes())
    expected = convert(probe, VideoReformatter()).astype(np.int16)
    for formula in _FORMULAS:
        if np.abs(formula.rgb(probe) - expected).max() <= 1:
            return formula
    return None


def _rows(plane: VideoPlane) -> UInt8Array:
    """(height, at least width), the memory of the plane itself."""
    return np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)
