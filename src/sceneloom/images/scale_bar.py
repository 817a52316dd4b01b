"""The strip under an image: what it shows on the left, how to read its colours or lengths on the right."""

from collections.abc import Sequence

import numpy as np

from sceneloom.images.canvas import FAINT_INK, INK, LINE, STRIP, Canvas
from sceneloom.images.depth_scale import DepthScale

STRIP_LINES = 3.6
"""Height of the strip in heights of its letters."""
_SMALL = 0.86
_BAR_SHARE = 0.46
_BAR_MOST_LETTERS = 40


def strip_height(text_px: int) -> int:
    """Height of the strip [px]."""
    return round(STRIP_LINES * text_px)


def draw_strip(canvas: Canvas, top: int) -> None:
    """Fill the strip from row `top` to the end of the canvas."""
    canvas.rectangle((0, top, canvas.image.width - 1, canvas.image.height - 1), fill=STRIP)


def draw_caption(canvas: Canvas, top: int, width: float, lines: Sequence[str]) -> None:
    """Write up to two lines at the left of the strip, cut to `width` [px]."""
    size = canvas.text_px
    title, *details = lines
    canvas.text((size, top + 1.3 * size), canvas.fitted(title, width - 2 * size), anchor="lm")
    for detail in details[:1]:
        text = canvas.fitted(detail, width - 2 * size, scale=_SMALL)
        canvas.text((size, top + 2.5 * size), text, anchor="lm", colour=FAINT_INK, scale=_SMALL)


def bar_span(canvas: Canvas) -> tuple[int, int]:
    """Columns [px] of the first and last colour of the scale bar."""
    size = canvas.text_px
    length = min(round(_BAR_SHARE * canvas.image.width), _BAR_MOST_LETTERS * size)
    last = canvas.image.width - 1 - 2 * size
    return last - length, last


def draw_depth_bar(canvas: Canvas, top: int, scale: DepthScale) -> float:
    """Draw the colour map with its depths at the right of the strip; gives the width left for the caption [px]."""
    size = canvas.text_px
    first, last = bar_span(canvas)
    head, foot = top + round(0.7 * size), top + round(1.75 * size)
    colours = scale.map.colours(np.linspace(0.0, 1.0, last - first + 1))
    canvas.paste(np.repeat(colours[None], foot - head, axis=0), first, head)
    for depth, label, location in placed_ticks(canvas, scale, first, last):
        column = first + round(float(scale.fractions(np.array(depth))) * (last - first))
        canvas.line([(column, foot), (column, foot + round(0.3 * size))], FAINT_INK)
        canvas.text((location, top + 2.7 * size), label, anchor="mm", scale=_SMALL)
    title = "depth"
    canvas.text((first - 0.7 * size, (head + foot) / 2), title, anchor="rm", colour=FAINT_INK, scale=_SMALL)
    return first - 1.4 * size - canvas.text_width(title, scale=_SMALL)


def placed_ticks(canvas: Canvas, scale: DepthScale, first: int, last: int) -> list[tuple[float, str, float]]:
    """Choose the ticks whose labels do not touch: (depth [m], label, column of the label's middle [px])."""
    gap = 0.7 * canvas.text_px
    taken: list[tuple[float, float]] = []
    placed = []
    for depth in scale.ticks():
        label = f"{depth:g} m" if depth == scale.far else f"{depth:g}"
        middle = first + float(scale.fractions(np.array(depth))) * (last - first)
        half = canvas.text_width(label, scale=_SMALL) / 2 + gap / 2
        if all(middle + half <= left or middle - half >= right for left, right in taken):
            taken.append((middle - half, middle + half))
            placed.append((depth, label, middle))
    return placed


def draw_length_bar(canvas: Canvas, top: int, length_m: float, px_per_m: float) -> float:
    """Draw a line of known length at the right of the strip; gives the width left for the caption [px]."""
    size = canvas.text_px
    last = canvas.image.width - 1 - 2 * size
    first, row = last - round(length_m * px_per_m), top + 1.3 * size
    canvas.line([(first, row), (last, row)], INK, width=max(2, size // 7))
    for column in (first, last):
        canvas.line([(column, row - 0.35 * size), (column, row + 0.35 * size)], INK, width=max(2, size // 7))
    canvas.text(((first + last) / 2, top + 2.5 * size), f"{length_m:g} m", anchor="mm", scale=_SMALL)
    canvas.line([(0, top), (canvas.image.width - 1, top)], LINE)
    return first - size
