"""Plots with two axes: lines over time, columns of a histogram, bars beside names."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.pictures.depth_scale import COARSE_DIGITS, round_up
from sceneloom.report.drawings.svg import LETTER, Svg, series, shortened, text_width

WIDTH, HEIGHT = 360.0, 190.0
_TOP, _RIGHT, _BOTTOM = 12.0, 12.0, 38.0
_Y_ROOM = 36.0


@dataclass(frozen=True, slots=True)
class Axis:
    """Values from `low` to `high` lie between two places [units], ticks so far apart as `room` at least."""

    low: float
    high: float
    first: float
    last: float
    room: float = 58.0

    def place(self, value: float) -> float:
        """Where a value lies."""
        return self.first + (value - self.low) / (self.high - self.low) * (self.last - self.first)

    def ticks(self) -> list[float]:
        """Round values, not too near to one another."""
        count = max(2.0, abs(self.last - self.first) / self.room)
        step = round_up((self.high - self.low) / count, COARSE_DIGITS)
        numbers = np.arange(np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9) + 1)
        return [float(n * step) + 0.0 for n in numbers]


def spanning(values: Sequence[float], *, with_zero: bool = False) -> tuple[float, float]:
    """What values lie between, never nothing wide."""
    known = [value for value in values if np.isfinite(value)] or [0.0]
    low, high = min(known), max(known)
    if with_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    least = max(1e-3 * max(abs(low), abs(high)), 1e-6)
    return (low, high) if high - low > least else (low - least if not with_zero else low, high + least)


def tick_text(value: float) -> str:
    """A tick's number: with blanks between thousands, without needless digits."""
    return f"{value:,.6g}".replace(",", "\N{NARROW NO-BREAK SPACE}") if abs(value) >= 1e4 else f"{value:.6g}"


@dataclass(frozen=True, slots=True)
class Frame:
    """A plot's axes with their grid and names, drawn first."""

    svg: Svg
    x: Axis
    y: Axis

    @classmethod
    def drawn(
        cls,
        x: tuple[float, float],
        y: tuple[float, float],
        *,
        x_name: str,
        y_name: str,
        size: tuple[float, float] = (WIDTH, HEIGHT),
        x_ticks: bool = True,
    ) -> "Frame":
        """Draw the axes of a plot of values between these ends; names are of what, with units."""
        svg = Svg(*size)
        y_axis = Axis(*y, size[1] - _BOTTOM, _TOP + 14, _Y_ROOM)
        left = 14 + LETTER * max((len(tick_text(tick)) for tick in y_axis.ticks()), default=1)
        x_axis = Axis(*x, left, size[0] - _RIGHT)
        for tick in y_axis.ticks():
            at = y_axis.place(tick)
            svg.line(left, at, size[0] - _RIGHT, at, "grid")
            svg.text(left - 5, at + 4, tick_text(tick), "faint", anchor="end")
        if x_ticks:
            for tick in x_axis.ticks():
                at = x_axis.place(tick)
                svg.line(at, y_axis.first, at, y_axis.first + 4, "axis")
                svg.text(at, y_axis.first + 16, tick_text(tick), "faint", anchor="middle")
        svg.line(left, y_axis.first, size[0] - _RIGHT, y_axis.first, "axis")
        svg.text(size[0] - _RIGHT, size[1] - 5, x_name, "faint", anchor="end")
        svg.text(2, _TOP, y_name, "faint")
        return cls(svg, x_axis, y_axis)


def line_plot(
    lines: Sequence[Sequence[tuple[float, float]]], *, x_name: str, y_name: str, with_zero: bool = False
) -> Svg:
    """Lines through (x, y), one look after the other."""
    x = spanning([point[0] for line in lines for point in line])
    y = spanning([point[1] for line in lines for point in line], with_zero=with_zero)
    frame = Frame.drawn(x, y, x_name=x_name, y_name=y_name)
    for number_of, line in enumerate(lines):
        places = [(frame.x.place(a), frame.y.place(b)) for a, b in line]
        frame.svg.path(places, f"line {series(number_of)}")
    return frame.svg


def histogram(
    edges: Sequence[float], counts: Sequence[float], *, x_name: str, y_name: str, unit: str = ""
) -> Svg:
    """Columns between (B + 1) edges, as wide as these."""
    frame = Frame.drawn((edges[0], edges[-1]), spanning(counts, with_zero=True), x_name=x_name, y_name=y_name)
    for low, high, count in zip(edges, edges[1:], counts, strict=False):
        left, right, top = frame.x.place(low), frame.x.place(high), frame.y.place(count)
        told = f"{low:.4g} to {high:.4g} {unit}: {count:,.6g}"
        frame.svg.rectangle(left + 0.3, top, right - left - 0.6, frame.y.first - top, "fill s1", title=told)
    return frame.svg


def columns(
    names: Sequence[str], counts: Sequence[float], *, x_name: str, y_name: str, unit: str = ""
) -> Svg:
    """Columns of one width, each with its name below."""
    frame = Frame.drawn(
        (0.0, float(len(names))),
        spanning(counts, with_zero=True),
        x_name=x_name,
        y_name=y_name,
        x_ticks=False,
    )
    width = (frame.x.last - frame.x.first) / max(len(names), 1)
    every = max(1, int(-(-(LETTER * max(map(len, names), default=1) + 6.0) // width)))
    for k, (name, count) in enumerate(zip(names, counts, strict=True)):
        left, top = frame.x.place(k), frame.y.place(count)
        told = f"{name} {unit}: {count:,.6g}"
        frame.svg.rectangle(left + 1, top, width - 2, frame.y.first - top, "fill s1", title=told)
        if k % every == 0:
            frame.svg.text(left + width / 2, frame.y.first + 16, name, "faint", anchor="middle")
    return frame.svg


def bars(
    names: Sequence[str], values: Sequence[float], *, told: Sequence[str], most: float | None = None
) -> Svg:
    """Bars to the right, each beside its name, with what it stands for behind it."""
    row = 24.0
    svg = Svg(WIDTH, row * len(names) + 6)
    shown = [shortened(name, 22) for name in names]
    left = 10 + max(map(text_width, shown), default=1.0)
    room = WIDTH - left - 12 - max(map(text_width, told), default=1.0)
    top = max([*values, 1e-12]) if most is None else most
    for k, (name, value, text) in enumerate(zip(names, values, told, strict=True)):
        at = row * k + 4
        svg.text(left - 6, at + 14, shown[k], anchor="end")
        svg.rectangle(left, at + 3, max(room * value / top, 1.0), 14, "fill s1", title=f"{name}: {text}")
        svg.text(left + max(room * value / top, 1.0) + 5, at + 14, text, "faint")
    return svg
