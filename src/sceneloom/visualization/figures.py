"""Figures: lines, areas, marks and a name, in the world or as pixels, and how they are drawn."""

from collections.abc import Iterator
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.visualization.canvas import Canvas, Colour
from sceneloom.visualization.clouds import MapLayout, sample_polyline

PALETTE: tuple[Colour, ...] = (
    (255, 122, 69), (82, 196, 255), (138, 226, 52), (255, 214, 64), (190, 120, 255), (0, 205, 170),
    (255, 92, 168), (110, 130, 255), (235, 235, 235), (205, 150, 100),
)  # fmt: skip
"""Colours that stand out from images and from each other."""

_FAMILIES: tuple[tuple[int, tuple[str, ...]], ...] = (
    (6, ("ped", "person", "people", "human")),
    (3, ("motor",)),
    (2, ("cycl", "bike", "rider", "wheeled")),
    (7, ("truck", "bus", "trailer", "van", "tram", "construction_vehicle", "heavy")),
    (1, ("car", "vehicle", "automobile")),
    (0, ("cone", "bollard", "barrier", "sign", "pole")),
)  # the colours that classes have whose names hold such a word; the first that fits counts

_OTHERS = (4, 5, 8, 9)  # the colours of all other names


def colour_of_name(name: object) -> Colour:
    """The colour of a class or an object, the same in every drive: that of its family, else another one."""
    word = str(name).lower()
    known = next((colour for colour, parts in _FAMILIES if any(part in word for part in parts)), None)
    return PALETTE[_OTHERS[crc32(word.encode(errors="surrogatepass")) % len(_OTHERS)] if known is None else known]


CORNER_FROM_CENTRE = 0.5
"""Boxes and vertices of files count from the image's corner, pixels that are drawn from the centre of the first."""


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """What is drawn of one thing at one time.

    Attributes:
        lines: (K, D) vertices each, joined in order: locations [m] in the world (D = 3), or pixels [px] (D = 2).
        areas: (K, D) vertices each of areas to be tinted.
        marks: (M, D) single points.
        anchor: (D,) where its name goes, or None.
    """

    name: str
    colour: Colour
    lines: tuple[Float64Array, ...] = ()
    areas: tuple[Float64Array, ...] = ()
    marks: Float64Array | None = None
    anchor: Float64Array | None = None

    @property
    def is_finite(self) -> bool:
        """Whether all of it has a location."""
        parts = (*self.lines, *self.areas, *(() if self.marks is None else (self.marks,)))
        return all(bool(np.isfinite(part).all()) for part in parts)


_CHUNKS = 48  # a straight line of the world is bent by a camera model: it is drawn in so many chunks
_JUMP_SHARE = 0.5
"""Neighbouring chunks farther apart than this share of the image are not joined: a camera model may see both sides."""
_TINT = 0.28
_SMALL = 0.8
Name = tuple[Figure, Float64Array]
"""A figure, and the pixel at which its name goes."""


def draw_figure(canvas: Canvas, seen: Figure, *, thickness: int) -> list[Name]:
    """Draw a figure whose vertices are pixels; gives the position of its name if anything of it lies on the canvas."""
    size = canvas.image.size
    parts = [*seen.lines, *seen.areas, *([] if seen.marks is None else [seen.marks])]
    if not any(((part > -1) & (part < size)).all(axis=1).any() for part in parts):
        return []
    for area in seen.areas:
        canvas.polygon(_tuples(_clamped(area, size)), seen.colour, opacity=_TINT)
    for line in seen.lines:
        canvas.line(_tuples(_clamped(line, size)), seen.colour, width=thickness)
    if seen.marks is not None:
        canvas.marks(seen.marks, seen.colour, 1.2 + 1.6 * thickness)
    anchor = seen.anchor
    return [] if anchor is None or not np.isfinite(anchor).all() else [(seen, anchor)]


def write_names(canvas: Canvas, names: list[Name], *, clear: bool = False) -> None:
    """Write names, lower ones first; one that would cover another, or with `clear` another's figure, is left out."""
    taken: list[tuple[float, float, float, float]] = []
    outlines = {id(figure): _outline(figure, anchor) for figure, anchor in names}
    if clear:
        taken += outlines.values()
    for figure, (column, row) in sorted(names, key=lambda item: -float(item[1][1])):
        text = canvas.fitted(figure.name, 0.4 * canvas.image.width, scale=_SMALL)
        half = canvas.text_width(text, scale=_SMALL) / 2 + 3
        line = 1.1 * canvas.text_px
        left, top, right, bottom = outlines[id(figure)]
        beside = [(left + right) / 2, top - 0.6 * line], [(left + right) / 2, bottom + 0.6 * line]
        further = [right + half + 2, (top + bottom) / 2], [left - half - 2, (top + bottom) / 2]
        for x, y in (*beside, *further) if clear else ((column, row - 0.7 * line),):
            location = float(np.clip(x, half, max(canvas.image.width - half, half)))
            level = float(np.clip(y, line, canvas.image.height - line))
            plate = location - half, level - line / 2, location + half, level + line / 2
            if not any(_overlap(plate, other) for other in taken):
                canvas.label((location, level), text, colour=figure.colour, scale=_SMALL)
                taken.append(plate)
                break


def _outline(figure: Figure, anchor: Float64Array) -> tuple[float, float, float, float]:
    """The rectangle around a figure in pixels: left, top, right, bottom."""
    corners = np.concatenate([*figure.lines, anchor[None]])
    return (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist())


def _overlap(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _clamped(pixels: Float64Array, size: tuple[int, int]) -> Float64Array:
    """Keep coordinates within what Pillow can draw."""
    reach = 4.0 * max(size)
    return np.clip(pixels, -reach, reach)


def _tuples(pixels: Float64Array) -> list[tuple[float, float]]:
    return [(float(column), float(row)) for column, row in pixels]


def through_camera_model(figure: Figure, camera: Camera, camera_from_world: RigidTransform) -> Figure:
    """The same figure as pixels; lines end where the camera model sees no further."""
    lines = tuple(part for line in figure.lines for part in _projected_line(line, camera, camera_from_world))
    areas = tuple(_pixels_of(camera, camera_from_world, _bent(area)) for area in figure.areas)
    marks = None if figure.marks is None else _pixels_of(camera, camera_from_world, figure.marks)
    anchor = None if figure.anchor is None else _pixels_of(camera, camera_from_world, figure.anchor[None])[0]
    whole = tuple(area for area in areas if np.isfinite(area).all())
    return Figure(figure.name, figure.colour, lines, whole, marks, anchor)


def _bent(vertices: Float64Array) -> Float64Array:
    closed = np.concatenate([vertices, vertices[:1]])
    length = float(np.linalg.norm(np.diff(closed, axis=0), axis=1).sum())
    return sample_polyline(closed, max(length / _CHUNKS, 1e-6))


def _pixels_of(camera: Camera, camera_from_world: RigidTransform, positions: Float64Array) -> Float64Array:
    """Pixels (N, 2) [px] of world points (N, 3) [m], NaN where the camera model sees none."""
    return project_unbounded(camera, camera_from_world.apply(positions))


def _projected_line(line: Float64Array, camera: Camera, camera_from_world: RigidTransform) -> Iterator[Float64Array]:
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    pixels = _pixels_of(camera, camera_from_world, sample_polyline(line, max(length / _CHUNKS, 1e-6)))
    reach = _JUMP_SHARE * max(camera.width, camera.height)
    jumps = np.abs(np.diff(pixels, axis=0)).max(axis=1, initial=0.0)
    broken = np.flatnonzero(~(jumps <= reach)) + 1  # a NaN breaks the line, too
    for part in np.split(pixels, broken):
        if len(part) > 1 and np.isfinite(part).all():
            yield part


def on_map(figure: Figure, layout: MapLayout) -> Figure:
    """The same figure as pixels of the map."""
    return Figure(
        figure.name,
        figure.colour,
        tuple(map(layout.pixels, figure.lines)),
        tuple(map(layout.pixels, figure.areas)),
        None if figure.marks is None else layout.pixels(figure.marks),
        None if figure.anchor is None else layout.pixels(figure.anchor[None])[0],
    )
