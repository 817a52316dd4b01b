"""When annotations hold: a line for each, from its first to its last key frame, with what is stated about it below."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.images.annotations.figures import PALETTE, colour_of
from sceneloom.images.canvas import (
    BACKGROUND,
    FAINT_INK,
    INK,
    LINE,
    Canvas,
    Colour,
    PilImage,
    count_text,
    text_height,
)
from sceneloom.images.depth_scale import COARSE_DIGITS, round_up
from sceneloom.images.scale_bar import draw_caption, draw_strip, strip_height
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.relations import EventAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import time_span

WIDTH_PX = 1280
MOST_ROWS = 60
_ROW_LETTERS = 1.5
_NAME_SHARE = 0.3
_TICKS = 8
_SHORTEST_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class _Row:
    """One line of the image: spans [ns] with a text each, and single times."""

    name: str
    colour: Colour
    spans: list[tuple[int, int, str]] = field(default_factory=list)
    timestamps: list[int] = field(default_factory=list)
    indented: bool = False


def draw_timeline(
    scene: Scene, *, title: str = "annotations over time", width_px: int = WIDTH_PX
) -> PilImage:
    """Draw when annotations hold: paths with their key frames, events, activations, projections and attributes.

    Types of which there are few come first. More than 60 lines are not drawn, but counted in the caption.
    """
    first_ns, last_ns = time_span(scene) or (0, 1)
    common = Counter(str(annotation.type) for annotation in scene.annotations)
    ordered = sorted(scene.annotations, key=lambda annotation: common[str(annotation.type)])
    rows = [row for annotation in ordered for row in _rows(annotation, first_ns, last_ns)]
    rows[:0] = [_attribute_row(attribute, last_ns, indented=False) for attribute in scene.attributes]
    known = [
        timestamp
        for row in rows
        for timestamp in (*row.timestamps, *(end for span in row.spans for end in span[:2]))
    ]
    first_ns, last_ns = min([first_ns, *known]), max([last_ns, *known, first_ns + _SHORTEST_NS])
    text_px = text_height(width_px, 600)
    line = round(_ROW_LETTERS * text_px)
    shown = rows[:MOST_ROWS]
    height = line * (len(shown) + 2)
    canvas = Canvas.blank(width_px, height + strip_height(text_px), text_px=text_px)
    axis = _Axis(first_ns, last_ns, round(_NAME_SHARE * width_px), width_px - 2 * text_px)
    _draw_ticks(canvas, axis, height - line)
    for number, row in enumerate(shown):
        _draw_row(canvas, axis, row, round((number + 1) * line), line)
    draw_strip(canvas, height)
    left = f"; {count_text(len(rows) - len(shown), 'more line')} not drawn" if len(rows) > len(shown) else ""
    lines = [title, f"{count_text(len(scene.annotations), 'annotation')}{left}"]
    draw_caption(canvas, height, width_px, lines)
    return canvas.image


@dataclass(frozen=True, slots=True)
class _Axis:
    """Times from `first_ns` to `last_ns` lie between two columns."""

    first_ns: int
    last_ns: int
    left: int
    right: int

    def column(self, timestamp_ns: int) -> float:
        share = (timestamp_ns - self.first_ns) / (self.last_ns - self.first_ns)
        return self.left + share * (self.right - self.left)


def _rows(annotation: Annotation, first_ns: int, last_ns: int) -> Iterator[_Row]:
    colour = colour_of(annotation)
    label = getattr(annotation, "label", None)
    # the label comes first: a long id is cut off
    name = f"{annotation.type} {label} · {annotation.id}" if label else f"{annotation.type} {annotation.id}"
    if isinstance(annotation, EventAnnotation):
        stop_ns = annotation.start_ns + round(annotation.duration_ns or 0)
        yield _Row(name, colour, [(annotation.start_ns, stop_ns, "")], [annotation.start_ns])
    else:
        timestamps = _timestamps(annotation)
        spans = [(min(timestamps), max(timestamps), "")] if timestamps else []
        if not timestamps or getattr(annotation, "stationary", None):
            spans = [(first_ns, last_ns, "")]
        yield _Row(name, colour, spans, timestamps)
    if isinstance(annotation, CuboidAnnotation):
        for activation in annotation.activations:
            starts = activation.timestamps_ns.tolist()
            lengths = activation.durations_ns or (0,) * len(starts)
            seen = [(a, a + round(d), "") for a, d in zip(starts, lengths, strict=True)]
            yield _Row(f"active in {activation.sensor_id}", colour, seen, indented=True)
        for projection in annotation.projections:
            seen_ns = projection.timestamps_ns
            if projection.boxes is not None:
                seen_ns = seen_ns[np.isfinite(projection.boxes).all(axis=1)]
            yield _Row(f"seen by {projection.sensor_id}", colour, timestamps=seen_ns.tolist(), indented=True)
    for attribute in getattr(annotation, "attributes", ()):
        yield _attribute_row(attribute, last_ns, indented=True)


def _timestamps(annotation: Annotation) -> list[int]:
    if isinstance(annotation, CuboidAnnotation | Box2DAnnotation | ShapeAnnotation):
        found: list[int] = annotation.path.timestamps_ns.tolist()
        return found
    if isinstance(annotation, PointsAnnotation):
        return sorted({timestamp for path in annotation.paths for timestamp in path.timestamps_ns.tolist()})
    if isinstance(annotation, LocalizationAdjustment | CameraCalibration) and annotation.poses is not None:
        return [] if annotation.poses.static else annotation.poses.timestamps_ns.tolist()
    return []


def _attribute_row(attribute: AttributePath, last_ns: int, *, indented: bool) -> _Row:
    timestamps = [] if attribute.timestamps_ns is None else attribute.timestamps_ns.tolist()
    texts = [", ".join(value) if isinstance(value, tuple) else str(value) for value in attribute.values]
    stops = [*timestamps[1:], max([last_ns, *timestamps])]
    spans = list(zip(timestamps, stops, texts, strict=False))
    of_sensor = "" if attribute.sensor_id is None else f" ({attribute.sensor_id})"
    return _Row(f"{attribute.name}{of_sensor}", PALETTE[1], spans, timestamps, indented=indented)


def _draw_ticks(canvas: Canvas, axis: _Axis, bottom: int) -> None:
    seconds = (axis.last_ns - axis.first_ns) / 1e9
    step = round_up(seconds / _TICKS, COARSE_DIGITS)
    for number in range(int(seconds / step) + 1):
        column = axis.column(axis.first_ns + round(number * step * 1e9))
        canvas.line([(column, canvas.text_px), (column, bottom)], LINE)
        canvas.text(
            (column, bottom + 0.8 * canvas.text_px),
            f"{number * step:g} s",
            anchor="mm",
            colour=FAINT_INK,
            scale=0.86,
        )


def _draw_row(canvas: Canvas, axis: _Axis, row: _Row, middle: int, line: int) -> None:
    indent = canvas.text_px * (2 if row.indented else 1)
    room = axis.left - indent - canvas.text_px
    ink = FAINT_INK if row.indented else INK
    canvas.text(
        (indent, middle), canvas.fitted(row.name, room, scale=0.86), anchor="lm", colour=ink, scale=0.86
    )
    half = 0.2 * line if row.indented else 0.3 * line
    for start_ns, stop_ns, text in row.spans:
        left, right = axis.column(start_ns), axis.column(stop_ns)
        canvas.rectangle((left, middle - half, max(right, left + 1), middle + half), fill=_dimmed(row.colour))
        if text:
            written = canvas.fitted(text, right - left - 4, scale=0.7)
            canvas.text((left + 3, middle), written, anchor="lm", scale=0.7)
    for timestamp in row.timestamps:
        column = axis.column(timestamp)
        canvas.line([(column, middle - half), (column, middle + half)], row.colour, width=2)


def _dimmed(colour: Colour) -> Colour:
    r, g, b = (round(0.45 * c + 0.55 * d) for c, d in zip(colour, BACKGROUND, strict=True))
    return r, g, b
