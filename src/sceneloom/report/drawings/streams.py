"""When each stream of a drive gives something, one line below the other, with its gaps."""

from sceneloom.report.drawings.axes import Axis, tick_text
from sceneloom.report.drawings.svg import Svg, shortened, text_width
from sceneloom.report.numbers.timing import Timing

WIDTH = 720.0
_ROW, _NAME_LETTERS = 26.0, 20
MOST_ROWS = 40


def draw_streams(timing: Timing) -> Svg | None:
    """Draw the streams over time; None where none has a stamp."""
    rows = [stream for stream in timing.streams if stream.start is not None and stream.stop is not None]
    if not rows:
        return None
    first = min(stream.start for stream in rows if stream.start is not None)
    last = max(stream.stop for stream in rows if stream.stop is not None)
    shown = rows[:MOST_ROWS]
    names = [shortened(stream.name, _NAME_LETTERS) for stream in shown]
    left = 14 + max(map(text_width, names))
    height = _ROW * len(shown) + 44
    svg = Svg(WIDTH, height)
    axis = Axis(first, max(last, first + 1e-3), left, WIDTH - 14)
    bottom = _ROW * len(shown) + 8
    if timing.overlap is not None and len(shown) > 1:
        start, stop = axis.place(timing.overlap.start), axis.place(timing.overlap.stop)
        svg.rectangle(start, 2, stop - start, bottom - 2, "overlap", title="when all streams give something")
    for tick in axis.ticks():
        svg.line(axis.place(tick), 2, axis.place(tick), bottom, "grid")
        svg.text(axis.place(tick), bottom + 16, tick_text(tick), "faint", anchor="middle")
    svg.text(WIDTH - 14, bottom + 32, "seconds after the first stamp", "faint", anchor="end")
    for k, stream in enumerate(shown):
        middle = _ROW * k + _ROW / 2 + 4
        svg.text(left - 8, middle + 4, names[k], anchor="end")
        start, stop = axis.place(stream.start or 0.0), axis.place(stream.stop or 0.0)
        told = f"{stream.name}: {stream.count:,} from {stream.start:.3f} to {stream.stop:.3f} s"
        svg.rectangle(start, middle - 6, max(stop - start, 2.0), 12, "fill s1", title=told)
        for gap in stream.gaps:
            a, b = axis.place(gap.start), axis.place(gap.stop)
            lost = f"{stream.name}: nothing from {gap.start:.3f} to {gap.stop:.3f} s"
            svg.rectangle(a, middle - 9, max(b - a, 1.5), 18, "gap", title=lost)
    return svg
