"""Annotations drawn into camera images, onto the map of a sweep and along time; corrections; one image per type.

`save_annotation_images` draws all of a scene's annotations at one moment into a folder.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.errors import OptionError
from sceneloom.formats.base.output import file_stem, filling
from sceneloom.geometry.boxes import EDGES, box_corners
from sceneloom.geometry.rigid import RigidTransform, rotate_vectors
from sceneloom.scene.annotations import (
    DIMENSIONS,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.annotations_at import (
    CuboidAngles,
    active_at,
    attribute_at,
    box_2d_at,
    cuboid_poses,
    points_at,
    shape_at,
)
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.samples import Sample
from sceneloom.scene.scene import Corrections, Scene, frame_times, time_span
from sceneloom.scene.types import Identifier, key_of
from sceneloom.visualization.canvas import (
    BACKGROUND,
    FAINT_INK,
    INK,
    LINE,
    Canvas,
    Colour,
    PilImage,
    leave_out,
    seconds_text,
    several,
    text_height,
)
from sceneloom.visualization.clouds import SIZE_PX, EgoPosition, MapLayout, draw_cloud_above
from sceneloom.visualization.colour_scales import (
    COARSE_DIGITS,
    draw_caption,
    draw_strip,
    framed,
    image_canvas,
    round_up,
    strip_height,
)
from sceneloom.visualization.figures import (
    CORNER_FROM_CENTRE,
    PALETTE,
    Figure,
    Name,
    colour_of_name,
    draw_figure,
    on_map,
    through_camera_model,
    write_names,
)
from sceneloom.visualization.fused_frames import save_image, subdued


def colour_of(annotation: Annotation) -> Colour:
    """Give annotations of one label one colour."""
    return colour_of_name(getattr(annotation, "label", None) or annotation.type)


def _name_of(annotation: Annotation, timestamp_ns: int) -> str:
    """Write the label, or the id, and what attributes state at a time."""
    stated = [
        f"{attribute.name} {_value_text(value)}"
        for attribute in getattr(annotation, "attributes", ())
        for value in attribute_at(attribute, [timestamp_ns])
        if value is not None and attribute.sensor_id is None and attribute.point_index is None
    ]
    return " · ".join([str(getattr(annotation, "label", None) or annotation.id), *stated[:2]])


def figures_in_world(
    scene: Scene, timestamp_ns: int, *, sensor_id: Identifier | None = None
) -> Iterator[tuple[Annotation, Figure]]:
    """Give what has a location in the world at a time [ns]; cuboids as a sensor sees them, where one is named."""
    angles = CuboidAngles.of(scene)
    for annotation in scene.annotations:
        draw = _IN_WORLD.get(str(annotation.type))
        if isinstance(annotation, CuboidAnnotation):
            figure = _cuboid(annotation, timestamp_ns, angles, sensor_id)
        else:
            figure = None if draw is None else draw(annotation, timestamp_ns, angles)
        if figure is not None:
            leave_out("annotations", not figure.is_finite)
            yield annotation, figure


def figures_in_image(scene: Scene, sensor_id: Identifier, timestamp_ns: int) -> Iterator[tuple[Annotation, Figure]]:
    """Give what is drawn in the images of one camera at a time [ns], as pixels in the centre convention."""
    for annotation in scene.annotations:
        draw = _IN_IMAGE.get(str(annotation.type))
        figure = None if draw is None else draw(annotation, sensor_id, timestamp_ns)
        if figure is not None:
            leave_out("annotations", not figure.is_finite)
            yield annotation, figure


def _value_text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _cuboid(
    annotation: CuboidAnnotation, timestamp_ns: int, angles: CuboidAngles, sensor_id: Identifier | None = None
) -> Figure | None:
    poses = cuboid_poses(annotation, [timestamp_ns], angles=angles, sensor_id=sensor_id)
    if not poses.there[0]:
        return None
    corners = box_corners(poses.centers_world[0], poses.sizes_lwh[0], poses.quaternions_xyzw[0])
    edges = tuple(corners[list(edge)] for edge in EDGES)
    nose = np.stack([corners[[0, 1, 2, 3]].mean(axis=0), corners[[0, 3]].mean(axis=0)])
    return _figure(annotation, timestamp_ns, lines=(*edges, nose), anchor=corners[4:].mean(axis=0))


def _figure(annotation: Annotation, timestamp_ns: int, **parts: Any) -> Figure:
    return Figure(_name_of(annotation, timestamp_ns), colour_of(annotation), **parts)


def _shape(annotation: ShapeAnnotation, timestamp_ns: int, corner: float | CuboidAngles = 0.0) -> Figure | None:
    vertices = shape_at(annotation, [timestamp_ns])[0]
    if vertices is None or len(vertices) == 0:
        return None
    vertices = vertices - corner if isinstance(corner, float) else vertices
    anchor = vertices.mean(axis=0)
    if annotation.type.startswith("point"):
        return _figure(annotation, timestamp_ns, marks=vertices, anchor=anchor)
    round_ = annotation.type.startswith("polygon")
    line = np.concatenate([vertices, vertices[:1]]) if round_ or annotation.is_closed else vertices
    areas = (vertices,) if round_ and len(vertices) > 2 else ()
    return _figure(annotation, timestamp_ns, lines=(line,), areas=areas, anchor=anchor)


def _keypoints(annotation: PointsAnnotation, timestamp_ns: int, _: CuboidAngles) -> Figure | None:
    found = [rows[0].reshape(-1, 3) for rows, there in points_at(annotation, [timestamp_ns]) if there[0]]
    marks = np.concatenate(found) if found else np.zeros((0, 3))
    return None if len(marks) == 0 else _figure(annotation, timestamp_ns, marks=marks, anchor=marks.mean(axis=0))


def _shape_in_image(annotation: ShapeAnnotation, sensor_id: Identifier, timestamp_ns: int) -> Figure | None:
    if not _same_id(annotation.sensor_id, sensor_id):
        return None
    return _shape(annotation, timestamp_ns, CORNER_FROM_CENTRE)


def _box_in_image(annotation: Box2DAnnotation, sensor_id: Identifier, timestamp_ns: int) -> Figure | None:
    if not _same_id(annotation.sensor_id, sensor_id):
        return None
    rows, there = box_2d_at(annotation, [timestamp_ns])
    return _rectangle(annotation, timestamp_ns, rows[0]) if there[0] else None


def _projected_cuboid(annotation: CuboidAnnotation, sensor_id: Identifier, timestamp_ns: int) -> Figure | None:
    if not active_at(annotation, sensor_id, [timestamp_ns])[0]:
        return None
    for projection in annotation.projections:
        row = _nearest_row(projection.timestamps_ns, timestamp_ns)
        if _same_id(projection.sensor_id, sensor_id) and row is not None and projection.boxes is not None:
            box = projection.boxes[row]
            return _rectangle(annotation, timestamp_ns, box) if np.isfinite(box).all() else None
    return None


def _projected_points(annotation: PointsAnnotation, sensor_id: Identifier, timestamp_ns: int) -> Figure | None:
    seen = []
    for projections in annotation.projections:
        for projection in projections:
            row = _nearest_row(projection.timestamps_ns, timestamp_ns)
            if _same_id(projection.sensor_id, sensor_id) and row is not None and projection.points is not None:
                seen.append(projection.points[row] - CORNER_FROM_CENTRE)
    marks = np.array([pixel for pixel in seen if np.isfinite(pixel).all()], np.float64).reshape(-1, 2)
    return None if len(marks) == 0 else _figure(annotation, timestamp_ns, marks=marks)


def _rectangle(annotation: Annotation, timestamp_ns: int, box: Float64Array) -> Figure:
    """A `left top width height` box as a closed line."""
    left, top = box[:2] - CORNER_FROM_CENTRE
    right, bottom = left + box[2], top + box[3]
    line = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
    return _figure(annotation, timestamp_ns, lines=(line,), anchor=line[0])


_NEARBY_NS = 60_000_000
"""How far from an image's time the timestamp of a projection may be to be drawn in it [ns]: half a frame at 8 Hz."""


def _nearest_row(timestamps_ns: Any, timestamp_ns: int) -> int | None:
    if len(timestamps_ns) == 0:
        return None
    row = int(np.argmin(np.abs(timestamps_ns - timestamp_ns)))
    return row if abs(int(timestamps_ns[row]) - timestamp_ns) <= _NEARBY_NS else None


def _same_id(one: Identifier | None, other: Identifier | None) -> bool:
    """Whether two ids are the same; `1` is not `"1"`."""
    return one == other and type(one) is type(other)


_IN_WORLD: Mapping[str, Callable[[Any, int, CuboidAngles], Figure | None]] = MappingProxyType(
    {"cuboid": _cuboid, "points": _keypoints, **{str(kind): _shape for kind, count in DIMENSIONS.items() if count == 3}}
)

_IN_IMAGE: Mapping[str, Callable[[Any, Identifier, int], Figure | None]] = MappingProxyType(
    {
        "cuboid": _projected_cuboid,
        "points": _projected_points,
        "box_2d": _box_in_image,
        **{str(kind): _shape_in_image for kind, count in DIMENSIONS.items() if count == 2},
    }
)

_MARGIN = 0.6  # how far a frame around the members of a group keeps from them [m]


def _labelled_locations(scene: Scene, sample: Sample) -> Iterator[tuple[Float64Array, Colour]]:
    """Give the labelled points of the sample's sweeps and of maps, (N, 3) float64 [m] in the world, with colours."""
    for annotation in scene.annotations:
        if not isinstance(annotation, LabeledPointsAnnotation):
            continue
        for part in annotation.labeled_points:
            positions = _positions(scene, sample, part.sensor_id, part.sensor_frame)
            if positions is not None:
                ids = part.point_ids[part.point_ids < len(positions)]
                yield positions[ids], colour_of(annotation)


def _active_events(scene: Scene, timestamp_ns: int) -> list[str]:
    """Names of the events that go on at a time [ns]."""
    return [
        _name_of(annotation, timestamp_ns)
        for annotation in scene.annotations
        if isinstance(annotation, EventAnnotation)
        and annotation.start_ns <= timestamp_ns <= annotation.start_ns + (annotation.duration_ns or 0)
    ]


def _relations_in_world(scene: Scene, timestamp_ns: int) -> Iterator[Figure]:
    """Give links as lines between what they join, groups and objects as frames around what belongs to them."""
    locations = {
        key_of(a.id): figure.anchor for a, figure in figures_in_world(scene, timestamp_ns) if figure.anchor is not None
    }
    for annotation in scene.annotations:
        name = _name_of(annotation, timestamp_ns)
        if isinstance(annotation, LinkAnnotation):
            ends = [locations.get((type(i), i)) for i in (annotation.from_id, annotation.to_id)]
            if ends[0] is not None and ends[1] is not None:
                line = np.stack([ends[0], ends[1]])
                yield Figure(
                    name, colour_of(annotation), (line, *_arrowheads(line, annotation)), anchor=line.mean(axis=0)
                )
        elif isinstance(annotation, GroupAnnotation | ObjectAnnotation):
            members = [a for a in scene.annotations if _same_id(getattr(a, "parent_id", None), annotation.id)]
            inside = [locations.get(key_of(a.id)) for a in members]
            known = [location for location in inside if location is not None]
            if known:
                frame = _frame_around(np.array(known))
                yield Figure(name, colour_of(annotation), (frame,), anchor=frame[0])


def _arrowheads(line: Float64Array, link: LinkAnnotation) -> Iterator[Float64Array]:
    """A head at the end that the link leads to, and at the other, too, where it holds both ways."""
    for start, stop in (line, line[::-1]) if link.is_bidirectional else (line,):
        along = stop[:2] - start[:2]
        length = float(np.hypot(*along))
        if length > 0:
            along = along / length * min(0.9, 0.3 * length)
            across = np.array([-along[1], along[0]]) * 0.45
            for side in (across, -across):
                yield np.stack([stop, [*(stop[:2] - along + side), stop[2]]])


def _frame_around(locations: Float64Array) -> Float64Array:
    """A level rectangle around locations."""
    low, high = locations.min(axis=0) - _MARGIN, locations.max(axis=0) + _MARGIN
    level = float(locations[:, 2].max())
    corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]), (low[0], low[1])]
    return np.array([[x, y, level] for x, y in corners])


def _positions(scene: Scene, sample: Sample, sensor_id: Identifier, frame: int | None) -> Float64Array | None:
    """The points that a part of labelled points means, in the world, if they belong to the sample."""
    sensor = next((s for s in scene.sensors if key_of(s.id) == key_of(sensor_id)), None)
    if isinstance(sensor, PointsSensor):
        return sensor.positions.astype(np.float64)
    sweep = sample.sweep if sensor_id == sample.lidar_id else None
    if not isinstance(sensor, LidarSensor) or sweep is None or frame is None:
        return None
    timestamps = sensor.frames.timestamps_ns
    if not 0 <= frame < len(timestamps) or int(timestamps[frame]) != sweep.timestamp_ns:
        return None
    world_from_points = sample.poses.world_from_points
    if world_from_points is None:
        return None
    return world_from_points.apply(sweep.points.positions.astype(np.float64))


def _image(sample: Sample, camera_id: Identifier) -> Canvas:
    """Begin with a subdued image of a sample; with an empty one of its size where there is none."""
    image, camera = sample.images[camera_id], sample.cameras[camera_id]
    if image is None:
        return image_canvas(np.full((camera.height, camera.width, 3), BACKGROUND, np.uint8))
    return image_canvas(subdued(image.rgb))


def draw_annotations_in_image(scene: Scene, sample: Sample, camera_id: Identifier, *, title: str = "") -> PilImage:
    """Draw an image of a sample with all annotations that have a location in it.

    Boxes, lines, areas and points of the world go through the camera model; what files state in pixels is drawn as they
    state it, in thin lines. Points of labelled points are dots.

    Args:
        sample: has the image.
        title: what the image is about; goes before camera and time.

    Raises:
        DataError: the image cannot be decoded.
        CalibrationError: the camera model has no projection.
    """
    camera, canvas = sample.cameras[camera_id], _image(sample, camera_id)
    timestamp_ns = sample.times_ns.get(camera_id, sample.timestamp_ns)
    names: list[Name] = []
    labelled = 0
    world_from_camera = sample.world_from_camera[camera_id]
    if world_from_camera is not None:
        camera_from_world = world_from_camera.inverse()
        for positions, colour in _labelled_locations(scene, sample):
            pixels = project_unbounded(camera, camera_from_world.apply(positions))
            labelled += canvas.marks(pixels, colour, 1.5) > 0
        for _, figure in figures_in_world(scene, timestamp_ns, sensor_id=camera_id):
            names += draw_figure(canvas, through_camera_model(figure, camera, camera_from_world), thickness=2)
    for _, figure in figures_in_image(scene, camera_id, timestamp_ns):
        names += draw_figure(canvas, figure, thickness=1)
    write_names(canvas, names)
    about = " · ".join(filter(None, [title, str(camera_id), seconds_text(timestamp_ns)]))
    return framed(canvas, [about, _caption(scene, len(names) + labelled, timestamp_ns)])


def _caption(scene: Scene, shown: int, timestamp_ns: int) -> str:
    events = _active_events(scene, timestamp_ns)
    return several(shown, "annotation") + (f"; now: {', '.join(events)}" if events else "")


_MARK_PX = 2.2


def draw_annotations_above(
    scene: Scene,
    sample: Sample,
    *,
    title: str = "annotations from above",
    reach: float | None = None,
    size_px: tuple[int, int] = SIZE_PX,
) -> PilImage:
    """Draw the sweep of a sample as a map, with everything of the annotations that has a location in the world.

    Links are arrows between what they join, groups and objects frames around what belongs to them.

    Args:
        sample: has the sweep.
        reach: from the map's middle to its upper edge [m]; by default it holds most annotations, or points.
        size_px: width and height of the image.

    Raises:
        OptionError: the reach or the size cannot be drawn.
    """
    # of a scene without a sweep its maps
    maps = [sensor.positions for sensor in scene.sensors if isinstance(sensor, PointsSensor)]
    points_world, colors = (np.concatenate(maps) if maps else np.zeros((0, 3))).astype(np.float64), None
    world_from_points = sample.poses.world_from_points if sample.sweep is not None else None
    if sample.sweep is not None and world_from_points is not None:
        points, colors = sample.sweep.points, sample.sweep.points.colors
        points_world = world_from_points.apply(points.positions.astype(np.float64))
    pose = sample.world_from_lidar or next((p for p in sample.world_from_camera.values() if p is not None), None)
    ego = None if pose is None else EgoPosition.facing(pose.translation, [pose.rotation[:, 0]])
    if reach is None:
        reach = _reach_of(scene, sample, ego, size_px[0] / size_px[1])
    events = _active_events(scene, sample.timestamp_ns)
    now = f" · now: {', '.join(events)}" if events else ""
    return draw_cloud_above(
        points_world,
        colors,
        ego=ego,
        caption=[f"{title} · {seconds_text(sample.timestamp_ns)}{now}"],
        reach=reach,
        size_px=size_px,
        over=partial(_draw_over, scene, sample),
    )


def _draw_over(scene: Scene, sample: Sample, plot: Canvas, layout: MapLayout) -> None:
    names: list[Name] = []
    for positions, colour in _labelled_locations(scene, sample):
        plot.marks(layout.pixels(positions), colour, _MARK_PX)
    for figure in _relations_in_world(scene, sample.timestamp_ns):
        names += draw_figure(plot, on_map(figure, layout), thickness=1)
    for _, figure in figures_in_world(scene, sample.timestamp_ns, sensor_id=sample.reference_id):
        names += draw_figure(plot, on_map(figure, layout), thickness=2)
    write_names(plot, names, clear=True)


_FRAMED_PERCENT, _LEAST_FRAMED, _MOST_FRAMED = 90, 15.0, 80.0
"""A map from above shows so many percent of what is annotated by default, within these reaches [m]."""


def _reach_of(scene: Scene, sample: Sample, ego: EgoPosition | None, aspect: float) -> float | None:
    """From the ego to the upper edge of a map [m] on which most annotations are; None where there is none."""
    figures = [figure for _, figure in figures_in_world(scene, sample.timestamp_ns, sensor_id=sample.reference_id)]
    anchors = [
        figure.anchor[:2] for figure in figures if figure.anchor is not None and np.isfinite(figure.anchor).all()
    ]
    if ego is None or not anchors:
        return None
    offsets = np.abs(np.array(anchors) - ego.position_world[:2]) / (aspect, 1.0)
    most = 1.1 * float(np.percentile(offsets.max(axis=1), _FRAMED_PERCENT))
    return round_up(min(max(most, _LEAST_FRAMED), _MOST_FRAMED))


_WIDTH_PX = 1280
_MOST_ROWS = 60
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


def draw_timeline(scene: Scene, *, title: str = "annotations over time", width_px: int = _WIDTH_PX) -> PilImage:
    """Draw when annotations hold: paths with their key frames, events, activations, projections and attributes.

    Types of which there are few come first. More than 60 lines are not drawn, but counted in the caption.
    """
    first_ns, last_ns = time_span(scene) or (0, 1)
    common = Counter(str(annotation.type) for annotation in scene.annotations)
    ordered = sorted(scene.annotations, key=lambda annotation: common[str(annotation.type)])
    rows = [row for annotation in ordered for row in _rows(annotation, first_ns, last_ns)]
    rows[:0] = [_attribute_row(attribute, last_ns, indented=False) for attribute in scene.attributes]
    known = [
        timestamp for row in rows for timestamp in (*row.timestamps, *(end for span in row.spans for end in span[:2]))
    ]
    first_ns, last_ns = min([first_ns, *known]), max([last_ns, *known, first_ns + _SHORTEST_NS])
    text_px = text_height(width_px, 600)
    line = round(_ROW_LETTERS * text_px)
    shown = rows[:_MOST_ROWS]
    height = line * (len(shown) + 2)
    canvas = Canvas.blank(width_px, height + strip_height(text_px), text_px=text_px)
    axis = _Axis(first_ns, last_ns, round(_NAME_SHARE * width_px), width_px - 2 * text_px)
    _draw_ticks(canvas, axis, height - line)
    for number, row in enumerate(shown):
        _draw_row(canvas, axis, row, round((number + 1) * line), line)
    draw_strip(canvas, height)
    left = f"; {several(len(rows) - len(shown), 'more line')} not drawn" if len(rows) > len(shown) else ""
    lines = [title, f"{several(len(scene.annotations), 'annotation')}{left}"]
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
            (column, bottom + 0.8 * canvas.text_px), f"{number * step:g} s", anchor="mm", colour=FAINT_INK, scale=0.86
        )


def _draw_row(canvas: Canvas, axis: _Axis, row: _Row, middle: int, line: int) -> None:
    indent = canvas.text_px * (2 if row.indented else 1)
    room = axis.left - indent - canvas.text_px
    ink = FAINT_INK if row.indented else INK
    canvas.text((indent, middle), canvas.fitted(row.name, room, scale=0.86), anchor="lm", colour=ink, scale=0.86)
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


_GRID = (16, 9)
_DISTANCE = 20.0  # how far away the things are whose pixels are compared [m]
_BEFORE, _AFTER = FAINT_INK, (255, 206, 84)


def draw_calibration(sample: Sample, calibration: CameraCalibration) -> PilImage:
    """Draw where the pixels of a camera go by its calibration: things 20 m away, from where they were seen.

    Raises:
        DataError: the image cannot be decoded.
        CalibrationError: a camera model has no projection.
    """
    camera = sample.cameras[calibration.sensor_id]
    plot = _image(sample, calibration.sensor_id)
    columns, rows = (
        (np.arange(n) + 0.5) * size / n for n, size in zip(_GRID, (camera.width, camera.height), strict=True)
    )
    before = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    points = _DISTANCE * unproject(camera, before)
    correction = RigidTransform.identity()
    if calibration.poses is not None:
        time_ns = sample.times_ns.get(calibration.sensor_id, sample.timestamp_ns)
        pose = calibration.poses.held(np.array([time_ns], np.int64))
        correction = RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])
    after = project_unbounded(calibration.intrinsics or camera, correction.inverse().apply(points))
    shifts = np.linalg.norm(after - before, axis=1)
    for start, stop in zip(before, after, strict=True):
        if np.isfinite(stop).all():
            plot.line([(start[0], start[1]), (stop[0], stop[1])], _AFTER, width=2)
    plot.marks(before, _BEFORE, 1.5)
    largest = float(np.nanmax(shifts)) if np.isfinite(shifts).any() else float("nan")
    stated = f"things {_DISTANCE:g} m away move by {largest:.1f} px at most"
    if calibration.time_offset_ns is not None:
        stated += f"; times by {calibration.time_offset_ns / 1e6:g} ms"
    return framed(plot, [f"{calibration.type} {calibration.id} of {calibration.sensor_id}", stated])


def draw_adjustment(scene: Scene, adjustment: LocalizationAdjustment) -> PilImage:
    """Draw the ego trajectory before and after a localisation adjustment, from above."""
    trajectory = _some_trajectory(scene)
    before = after = np.zeros((0, 3))
    if trajectory is not None:  # p' = A(t) p; beyond its ends the adjustment holds
        at = adjustment.poses.held(trajectory.timestamps_ns)
        before = trajectory.positions
        after = rotate_vectors(at.quaternions_xyzw, before) + at.positions
    both = np.concatenate([before, after]) if len(before) else np.zeros((1, 3))
    middle = (both.min(axis=0) + both.max(axis=0)) / 2
    reach = max(0.6 * float(np.ptp(both[:, :2], axis=0).max()), 1.0)

    def over(plot: Canvas, layout: MapLayout) -> None:
        for line, colour, width in ((before, _BEFORE, 2), (after, _AFTER, 3)):
            pixels = [(float(u), float(v)) for u, v in layout.pixels(line)] if len(line) else []
            if len(pixels) > 1:
                plot.line(pixels, colour, width=width)

    moved = float(np.nanmax(np.linalg.norm(after - before, axis=1))) if len(before) else 0.0
    lines = [
        f"{adjustment.type} {adjustment.id}",
        f"the trajectory moves by {moved:.2f} m at most; grey before, yellow after",
    ]
    return draw_cloud_above(
        middle[None], None, ego=EgoPosition(middle, np.array([1.0, 0.0, 0.0])), caption=lines, reach=reach,
        over=over,
    )  # fmt: skip


def _some_trajectory(scene: Scene) -> Poses | None:
    """Some way through the world: an odometry sensor's, else a trajectory's, else a lidar's."""
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and not sensor.poses.static:
            return sensor.poses
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None:
            return trajectory.poses
    lidars = [s.poses for s in scene.sensors if isinstance(s, LidarSensor | CameraSensor) and s.poses is not None]
    return lidars[0] if lidars else None


_Drawing = tuple[str, Callable[[], PilImage]]
_RELATIONS_REACH = 20.0  # from the ego to the upper edge of a map that shows how annotations belong together [m]


def _related(scene: Scene, chosen: list[Annotation]) -> list[Annotation]:
    """What links join and what belongs to groups and objects."""
    ends: list[Identifier] = []
    parents: list[Identifier] = []
    for annotation in chosen:
        if isinstance(annotation, LinkAnnotation):
            ends += [annotation.from_id, annotation.to_id]
        elif isinstance(annotation, GroupAnnotation | ObjectAnnotation):
            parents.append(annotation.id)
    return [
        a
        for a in scene.annotations
        if not any(a is other for other in chosen)
        and (
            any(_same_id(a.id, end) for end in ends)
            or any(_same_id(getattr(a, "parent_id", None), parent) for parent in parents)
        )
    ]


def _draw_type(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    """Draw annotations of one type as they show best: from above, over time, in a view of their own, else an image."""
    # the image is that of the camera that a shape in images names, else the first one
    chosen: Any = next(annotation for annotation in scene.annotations if str(annotation.type) == type_name)
    if isinstance(chosen, LocalizationAdjustment):
        return draw_adjustment(scene, chosen)
    calibrated = isinstance(chosen, CameraCalibration)
    if (
        sample is None
        or type_name in {"event", "attributes"}
        or (calibrated and chosen.sensor_id not in sample.cameras)
    ):
        return draw_timeline(scene, title=type_name)
    if calibrated:
        return draw_calibration(sample, chosen)
    seen = [key for key, image in sample.images.items() if image is not None]
    if not seen or type_name in {"link", "group", "object"}:
        return draw_annotations_above(scene, sample, title=type_name, reach=_RELATIONS_REACH)
    named = [getattr(annotation, "sensor_id", None) for annotation in scene.annotations]
    camera_id = next((key for key in seen if any(_same_id(key, name) for name in named)), seen[0])
    return draw_annotations_in_image(scene, sample, camera_id, title=type_name)


def save_annotation_images(
    scene: Scene, folder: Path, *, at: float | None = None, overwrite: bool = False
) -> list[Path]:
    """Draw a scene's annotations at one moment into a folder, which is made where it is missing.

    `timeline.png`, `above.png`, `camera_<id>.png` for each camera with images, and `type_<type>.png` for each type
    of annotation that the scene has.

    Args:
        at: seconds after the scene's first timestamp; None for its middle.

    Returns:
        The paths written.

    Raises:
        OutputError: the folder has something in it and `overwrite` is not stated, or it cannot be written.
        DataError: a sweep or image cannot be read.
    """
    corrected, pending = scene.corrected(), scene.pending_corrections
    given = replace(scene, annotations=pending, corrections=Corrections.IGNORE)
    with filling(folder, overwrite=overwrite) as drafts:
        plots = list(_plots(corrected, at))
        if len(corrected.pending_corrections) < len(pending):  # what they change is seen before they are applied
            plots += [drawing for drawing in _plots(given, at) if drawing[0].startswith("type_")]
        for name, draw in plots:
            save_image(draw(), drafts / f"{name}.png")
    return [folder / f"{name}.png" for name, _ in plots]


def _plots(scene: Scene, at: float | None) -> Iterator[_Drawing]:
    yield "timeline", partial(draw_timeline, scene)
    sample = _sample(scene, at)
    if sample is not None:
        yield "above", partial(draw_annotations_above, scene, sample)
        for camera_id, image in sample.images.items():
            if image is not None:
                drawn = partial(draw_annotations_in_image, scene, sample, camera_id)
                yield f"camera_{file_stem(camera_id)}", drawn
    for type_name in dict.fromkeys(str(annotation.type) for annotation in scene.annotations):
        # alone, with what it belongs to
        chosen = [a for a in scene.annotations if str(a.type) == type_name]
        shown = replace(scene, annotations=(*chosen, *_related(scene, chosen)), attributes=())
        yield f"type_{file_stem(type_name)}", partial(_draw_type, shown, sample, type_name)


def _sample(scene: Scene, at: float | None) -> Sample | None:
    """The synchronised set nearest to the chosen time; None for a scene without sweeps and images."""
    references = [lidar.id for lidar in scene.lidars if len(lidar.frames)]
    references += [camera.id for camera in scene.cameras if len(camera.images)]
    span_ns = time_span(scene)
    if not references or span_ns is None:
        return None
    length = (span_ns[1] - span_ns[0]) / 1e9
    if at is not None and not 0.0 <= at <= length:
        raise OptionError(f"{at} s; expected a time within the scene, from 0 to {length:.3f} s")
    time_ns = span_ns[0] + round((length / 2 if at is None else at) * 1e9)
    samples = scene.samples(reference=references[0])
    timestamps_ns = frame_times(scene.sensor(references[0]))
    return samples[int(np.argmin(np.abs(timestamps_ns - time_ns)))]
