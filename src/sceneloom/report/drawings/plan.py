"""The ways of the ego from above, with a scale bar, and with north up where north is known."""

from collections.abc import Sequence

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.geodesy import geodetic_from_enu
from sceneloom.pictures.depth_scale import COARSE_DIGITS, round_up
from sceneloom.report.drawings.axes import tick_text
from sceneloom.report.drawings.svg import Svg, series, shortened
from sceneloom.report.numbers.ways import Ways

WIDTH, MOST_HEIGHT, LEAST_HEIGHT = 720.0, 480.0, 240.0
_MARGIN = 34.0
_LEAST_EXTENT = 2.0
"""A map shows at least so many metres."""


def draw_plan(ways: Ways) -> Svg | None:
    """Draw ways and fixes as a map; None where there are none."""
    turn, shift = _north_up(ways)
    lines = [
        (f"line {series(k)}", way.name, np.array([(c.x, c.y) for c in way.corners]) @ turn.T)
        for k, way in enumerate(ways.ways)
        if way.corners
    ]
    fixes = [
        (series(len(lines) + k), f"fixes of {each.sensor}", _fixes(each.places, shift, ways))
        for k, each in enumerate(ways.fixes)
    ]
    if ways.north is None and lines:
        fixes = []
    places = np.concatenate(
        [np.zeros((0, 2)), *(line for _, _, line in lines), *(dots for _, _, dots in fixes)]
    )
    if len(places) == 0:
        return None
    low, high = places.min(axis=0), places.max(axis=0)
    extent = high - low
    room = (WIDTH - 2 * _MARGIN, MOST_HEIGHT - 2 * _MARGIN)
    scale = min(room[0] / max(extent[0], _LEAST_EXTENT), room[1] / max(extent[1], 1e-9))
    height = max(extent[1] * scale + 2 * _MARGIN, LEAST_HEIGHT)
    middle = (low + high) / 2
    svg = Svg(WIDTH, height)

    def placed(points: Float64Array) -> list[tuple[float, float]]:
        moved = (points - middle) * scale
        return [(WIDTH / 2 + x, height / 2 - y) for x, y in moved.tolist()]

    svg.rectangle(0, 0, WIDTH, height, "ground")
    _grid(svg, middle, scale, height)
    for look, name, dots in fixes:
        for x, y in placed(dots):
            svg.circle(x, y, 2.2, f"fill {look}", title=shortened(name, 60))
    for look, name, line in lines:
        drawn = placed(line)
        svg.path(drawn, look, title=shortened(name, 60))
        svg.circle(*drawn[0], 5, f"start {look.split()[-1]}", title=f"{shortened(name, 60)}: start")
        svg.rectangle(
            drawn[-1][0] - 4,
            drawn[-1][1] - 4,
            8,
            8,
            f"fill {look.split()[-1]}",
            title=f"{shortened(name, 60)}: end",
        )
    _scale_bar(svg, scale, height)
    _compass(svg, north=_is_north_up(ways))
    _corners(svg, ways, middle, height)
    return svg


def named_lines(ways: Ways) -> list[tuple[str, str]]:
    """The looks of the lines and dots of a map, each with its name."""
    lines = [way.name for way in ways.ways if way.corners]
    fixes = [] if ways.north is None and lines else [f"fixes of {each.sensor}" for each in ways.fixes]
    return [(series(k), name) for k, name in enumerate([*lines, *fixes])]


def _is_north_up(ways: Ways) -> bool:
    return ways.north is not None or (bool(ways.fixes) and not ways.ways)


def _north_up(ways: Ways) -> tuple[Float64Array, Float64Array]:
    """The turn (2, 2) of the world that brings north up, and where the fixes' origin lies then (2,) [m]."""
    if ways.north is None:
        return np.eye(2), np.zeros(2)
    angle = np.pi / 2 - np.radians(ways.north.direction_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn, turn @ np.array(ways.north.shift[:2])


def _fixes(places: Sequence[tuple[float, ...]], shift: Float64Array, ways: Ways) -> Float64Array:
    east_north = np.array([(place[1], place[2]) for place in places])
    return east_north + (shift if ways.north is not None else 0.0)


def grid_step(scale: float) -> float:
    """The side of the map's squares [m], and the length of its bar, at so many units a metre."""
    return round_up(80.0 / scale, COARSE_DIGITS)


_MOST_LINES = 1000


def _grid(svg: Svg, middle: Float64Array, scale: float, height: float) -> None:
    step = grid_step(scale)
    for axis, length in ((0, WIDTH), (1, height)):
        half = length / 2 / scale
        first, last = np.ceil((middle[axis] - half) / step), np.floor((middle[axis] + half) / step)
        if not last - first < _MOST_LINES:  # places so far off that a grid has no numbers for them
            continue
        for at in np.arange(first, last + 1) * step:
            place = (at - middle[axis]) * scale
            if axis == 0:
                svg.line(WIDTH / 2 + place, 0, WIDTH / 2 + place, height, "grid")
            else:
                svg.line(0, height / 2 - place, WIDTH, height / 2 - place, "grid")


def _scale_bar(svg: Svg, scale: float, height: float) -> None:
    length = grid_step(scale)
    left, y = 16.0, height - 16.0
    svg.line(left, y, left + length * scale, y, "bar")
    for x in (left, left + length * scale):
        svg.line(x, y - 5, x, y + 5, "bar")
    svg.text(left + length * scale + 8, y + 4, f"{tick_text(length)} m")


def _compass(svg: Svg, *, north: bool) -> None:
    """An arrow up that says north, or that y of the world is up."""
    x, y = WIDTH - 30.0, 58.0
    svg.path([(x, y - 36), (x + 8, y), (x, y - 7), (x - 8, y)], "fill ink-fill", closed=True)
    svg.text(x, y + 15, "N" if north else "y", "strong", anchor="middle")
    if not north:
        svg.text(x, y + 30, "x →", "faint", anchor="middle")


def _corners(svg: Svg, ways: Ways, middle: Float64Array, height: float) -> None:
    """Write latitude and longitude of the map's middle, where they are known."""
    if ways.origin_lla is None or not _is_north_up(ways):
        return
    _, shift = _north_up(ways)
    east, north = middle - shift
    latitude, longitude, _ = geodetic_from_enu(np.array([[east, north, 0.0]]), np.array(ways.origin_lla))[
        0
    ].tolist()
    svg.path([(WIDTH / 2 - 5, height / 2), (WIDTH / 2 + 5, height / 2)], "axis")
    svg.path([(WIDTH / 2, height / 2 - 5), (WIDTH / 2, height / 2 + 5)], "axis")
    svg.text(
        WIDTH - 12,
        height - 12,
        f"middle: {degrees_text(latitude, 'NS')}, {degrees_text(longitude, 'EW')}",
        anchor="end",
    )


def degrees_text(value: float, letters: str) -> str:
    """Latitude or longitude to a metre: "49.01126° N"."""
    return f"{abs(value):.5f}° {letters[0] if value >= 0 else letters[1]}"
