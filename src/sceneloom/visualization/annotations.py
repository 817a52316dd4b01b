"""Annotations drawn into camera images and onto the map of a sweep: lines, areas, marks and names."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any
from zlib import crc32

import numpy as np

from sceneloom.arrays import Float64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded
from sceneloom.geometry.boxes import EDGES, box_corners
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import (
    Annotation,
    Box2DAnnotation,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
    PointsAnnotation,
    ShapeAnnotation,
    ShapeType,
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
from sceneloom.scene.clouds import LidarSensor, PointsSensor
from sceneloom.scene.samples import Sample
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, key_of
from sceneloom.visualization.canvas import (
    BACKGROUND,
    Canvas,
    Colour,
    PilImage,
    count_text,
    leave_out,
    seconds_text,
)
from sceneloom.visualization.clouds import SIZE_PX, EgoPosition, MapLayout, draw_cloud_above, sample_polyline
from sceneloom.visualization.fused_frames import framed, image_canvas, subdued

PALETTE: tuple[Colour, ...] = (
    (255, 122, 69), (82, 196, 255), (138, 226, 52), (255, 206, 84), (214, 137, 255), (64, 224, 190),
    (255, 110, 160), (168, 184, 255), (222, 222, 120), (255, 160, 122),
)  # fmt: skip
"""Colours that stand out from images and from each other."""

CORNER_FROM_CENTRE = 0.5
"""Boxes and vertices of files count from the image's corner, pixels that are drawn from the centre of the first."""


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """One annotation at one time.

    Attributes:
        name: what is written beside it.
        colour: what it is drawn in.
        lines: (K, D) vertices each, joined in order: locations [m] in the world (D = 3), or pixels [px] (D = 2).
        areas: (K, D) vertices each of areas to be tinted.
        marks: (M, D) single points.
        anchor: (D,) where its name goes, or None where there is nothing to see.
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


def colour_of(annotation: Annotation) -> Colour:
    """Give annotations of one label one colour."""
    label = getattr(annotation, "label", None) or annotation.type
    return PALETTE[crc32(str(label).encode(errors="surrogatepass")) % len(PALETTE)]


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
        draw = _IN_WORLD.get(_key(annotation))
        if isinstance(annotation, CuboidAnnotation):
            figure = _cuboid(annotation, timestamp_ns, angles, sensor_id)
        else:
            figure = None if draw is None else draw(annotation, timestamp_ns, angles)
        if figure is not None:
            leave_out("annotations", not figure.is_finite)
            yield annotation, figure


def figures_in_image(
    scene: Scene, sensor_id: Identifier, timestamp_ns: int
) -> Iterator[tuple[Annotation, Figure]]:
    """Give what is drawn in the images of one camera at a time [ns], as pixels in the centre convention."""
    for annotation in scene.annotations:
        draw = _IN_IMAGE.get(_key(annotation))
        figure = None if draw is None else draw(annotation, sensor_id, timestamp_ns)
        if figure is not None:
            leave_out("annotations", not figure.is_finite)
            yield annotation, figure


def _key(annotation: Annotation) -> str:
    return str(annotation.type)


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


_CLOSED = frozenset({ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN, ShapeType.POLYGON_2D})

_MARKS = frozenset({ShapeType.POINT, ShapeType.POINT_TOPDOWN, ShapeType.POINT_2D})


def _shape(annotation: ShapeAnnotation, timestamp_ns: int, vertices: Float64Array) -> Figure | None:
    if len(vertices) == 0:
        return None
    anchor = vertices.mean(axis=0)
    if annotation.type in _MARKS:
        return _figure(annotation, timestamp_ns, marks=vertices, anchor=anchor)
    round_ = annotation.type in _CLOSED
    line = np.concatenate([vertices, vertices[:1]]) if round_ or annotation.is_closed else vertices
    areas = (vertices,) if round_ and len(vertices) > 2 else ()
    return _figure(annotation, timestamp_ns, lines=(line,), areas=areas, anchor=anchor)


def _shape_in_world(annotation: ShapeAnnotation, timestamp_ns: int, _: CuboidAngles) -> Figure | None:
    vertices = shape_at(annotation, [timestamp_ns])[0]
    return None if vertices is None else _shape(annotation, timestamp_ns, vertices)


def _keypoints(annotation: PointsAnnotation, timestamp_ns: int, _: CuboidAngles) -> Figure | None:
    found = [rows[0].reshape(-1, 3) for rows, there in points_at(annotation, [timestamp_ns]) if there[0]]
    marks = np.concatenate(found) if found else np.zeros((0, 3))
    return (
        None if len(marks) == 0 else _figure(annotation, timestamp_ns, marks=marks, anchor=marks.mean(axis=0))
    )


def _shape_in_image(annotation: ShapeAnnotation, sensor_id: Identifier, timestamp_ns: int) -> Figure | None:
    if not same_id(annotation.sensor_id, sensor_id):
        return None
    vertices = shape_at(annotation, [timestamp_ns])[0]
    return None if vertices is None else _shape(annotation, timestamp_ns, vertices - CORNER_FROM_CENTRE)


def _box_in_image(annotation: Box2DAnnotation, sensor_id: Identifier, timestamp_ns: int) -> Figure | None:
    if not same_id(annotation.sensor_id, sensor_id):
        return None
    rows, there = box_2d_at(annotation, [timestamp_ns])
    return _rectangle(annotation, timestamp_ns, rows[0]) if there[0] else None


def _projected_cuboid(
    annotation: CuboidAnnotation, sensor_id: Identifier, timestamp_ns: int
) -> Figure | None:
    if not active_at(annotation, sensor_id, [timestamp_ns])[0]:
        return None
    for projection in annotation.projections:
        row = _nearest_row(projection.timestamps_ns, timestamp_ns)
        if same_id(projection.sensor_id, sensor_id) and row is not None and projection.boxes is not None:
            box = projection.boxes[row]
            return _rectangle(annotation, timestamp_ns, box) if np.isfinite(box).all() else None
    return None


def _projected_points(
    annotation: PointsAnnotation, sensor_id: Identifier, timestamp_ns: int
) -> Figure | None:
    seen = []
    for projections in annotation.projections:
        for projection in projections:
            row = _nearest_row(projection.timestamps_ns, timestamp_ns)
            if same_id(projection.sensor_id, sensor_id) and row is not None and projection.points is not None:
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


def same_id(one: Identifier | None, other: Identifier | None) -> bool:
    """Whether two ids are the same; `1` is not `"1"`."""
    return one == other and type(one) is type(other)


def _members_of(scene: Scene, parent_id: Identifier) -> Sequence[Annotation]:
    """The annotations that belong to another one."""
    return [a for a in scene.annotations if same_id(getattr(a, "parent_id", None), parent_id)]


_SHAPES_2D = (ShapeType.POLYLINE_2D, ShapeType.POLYGON_2D, ShapeType.POINT_2D)

_SHAPES_3D = (
    ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN, ShapeType.POLYLINE, ShapeType.POINT, ShapeType.POINT_TOPDOWN,
)  # fmt: skip

_IN_WORLD: Mapping[str, Callable[[Any, int, CuboidAngles], Figure | None]] = MappingProxyType(
    {"cuboid": _cuboid, "points": _keypoints, **{str(kind): _shape_in_world for kind in _SHAPES_3D}}
)

_IN_IMAGE: Mapping[str, Callable[[Any, Identifier, int], Figure | None]] = MappingProxyType(
    {
        "cuboid": _projected_cuboid,
        "points": _projected_points,
        "box_2d": _box_in_image,
        **{str(kind): _shape_in_image for kind in _SHAPES_2D},
    }
)

_MARGIN = 0.6
"""How far a frame around the members of a group keeps from them [m]."""


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
        key_of(a.id): figure.anchor
        for a, figure in figures_in_world(scene, timestamp_ns)
        if figure.anchor is not None
    }
    for annotation in scene.annotations:
        name = _name_of(annotation, timestamp_ns)
        if isinstance(annotation, LinkAnnotation):
            ends = [locations.get((type(i), i)) for i in (annotation.from_id, annotation.to_id)]
            if ends[0] is not None and ends[1] is not None:
                line = np.stack([ends[0], ends[1]])
                yield Figure(
                    name,
                    colour_of(annotation),
                    (line, *_arrowheads(line, annotation)),
                    anchor=line.mean(axis=0),
                )
        elif isinstance(annotation, GroupAnnotation | ObjectAnnotation):
            inside = [locations.get(key_of(a.id)) for a in _members_of(scene, annotation.id)]
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


_TINT = 0.28

_SMALL = 0.8

Name = tuple[Figure, Float64Array]
"""A figure, and the pixel at which its name goes."""


def image(sample: Sample, camera_id: Identifier) -> Canvas:
    """Begin with a subdued image of a sample; with an empty one of its size where there is none.

    Raises:
        DataError: the image cannot be decoded.
    """
    image, camera = sample.images[camera_id], sample.cameras[camera_id]
    if image is None:
        return image_canvas(np.full((camera.height, camera.width, 3), BACKGROUND, np.uint8))
    return image_canvas(subdued(image.rgb))


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
        draw_marks(canvas, seen.marks, seen.colour, 1.2 + 1.6 * thickness)
    anchor = seen.anchor
    return [] if anchor is None or not np.isfinite(anchor).all() else [(seen, anchor)]


def draw_marks(canvas: Canvas, pixels: Float64Array, colour: Colour, radius: float) -> int:
    """Draw a disc of a radius [px] at each of (N, 2) pixels that are on the canvas; gives how many those are."""
    finite = pixels[np.isfinite(pixels).all(axis=1)]
    shown = finite[((finite >= 0) & (finite < canvas.image.size)).all(axis=1)]
    for location in _tuples(shown):
        canvas.disc(location, radius, colour)
    return len(shown)


def write_names(canvas: Canvas, names: list[Name]) -> None:
    """Write names, lower ones first; one that would cover another is left out."""
    taken: list[tuple[float, float, float]] = []
    for figure, (column, row) in sorted(names, key=lambda item: -float(item[1][1])):
        text = canvas.fitted(figure.name, 0.4 * canvas.image.width, scale=_SMALL)
        half = canvas.text_width(text, scale=_SMALL) / 2 + 3
        line = 1.1 * canvas.text_px
        location = float(np.clip(column, half, max(canvas.image.width - half, half)))
        level = float(np.clip(row - 0.7 * line, line, canvas.image.height - line))
        if all(abs(location - p) > half + h or abs(level - v) > line for p, v, h in taken):
            canvas.label((location, level), text, colour=figure.colour, scale=_SMALL)
            taken.append((location, level, half))


def _clamped(pixels: Float64Array, size: tuple[int, int]) -> Float64Array:
    """Keep coordinates within what Pillow can draw."""
    reach = 4.0 * max(size)
    return np.clip(pixels, -reach, reach)


def _tuples(pixels: Float64Array) -> list[tuple[float, float]]:
    return [(float(column), float(row)) for column, row in pixels]


_CHUNKS = 48
"""A straight line of the world is bent by a camera model: it is drawn in so many chunks."""

_JUMP_SHARE = 0.5
"""Neighbouring chunks farther apart than this share of the image are not joined: a camera model may see both sides."""


def draw_annotations_in_image(
    scene: Scene, sample: Sample, camera_id: Identifier, *, title: str = ""
) -> PilImage:
    """Draw an image of a sample with all annotations that have a location in it.

    Boxes, lines, areas and points of the world go through the camera model; what files state in pixels is drawn as they
    state it, in thin lines. Points of labelled points are dots.

    Args:
        scene: what the annotations are of.
        sample: has the image.
        camera_id: the camera.
        title: what the image is about; goes before camera and time.

    Raises:
        DataError: the image cannot be decoded.
        CalibrationError: the camera model has no projection.
    """
    camera, canvas = sample.cameras[camera_id], image(sample, camera_id)
    timestamp_ns = sample.times_ns.get(camera_id, sample.timestamp_ns)
    names: list[Name] = []
    labelled = 0
    world_from_camera = sample.world_from_camera[camera_id]
    if world_from_camera is not None:
        camera_from_world = world_from_camera.inverse()
        for positions, colour in _labelled_locations(scene, sample):
            labelled += draw_marks(canvas, _pixels(camera, camera_from_world, positions), colour, 1.5) > 0
        for _, figure in figures_in_world(scene, timestamp_ns, sensor_id=camera_id):
            names += draw_figure(canvas, through_camera_model(figure, camera, camera_from_world), thickness=2)
    for _, figure in figures_in_image(scene, camera_id, timestamp_ns):
        names += draw_figure(canvas, figure, thickness=1)
    write_names(canvas, names)
    about = " · ".join(filter(None, [title, str(camera_id), seconds_text(timestamp_ns)]))
    return framed(canvas, [about, _caption(scene, len(names) + labelled, timestamp_ns)])


def _caption(scene: Scene, shown: int, timestamp_ns: int) -> str:
    events = _active_events(scene, timestamp_ns)
    return count_text(shown, "annotation") + (f"; now: {', '.join(events)}" if events else "")


def through_camera_model(figure: Figure, camera: Camera, camera_from_world: RigidTransform) -> Figure:
    """The same figure as pixels; lines end where the camera model sees no further."""
    lines = tuple(part for line in figure.lines for part in _projected_line(line, camera, camera_from_world))
    areas = tuple(_pixels(camera, camera_from_world, _bent(area)) for area in figure.areas)
    marks = None if figure.marks is None else _pixels(camera, camera_from_world, figure.marks)
    anchor = None if figure.anchor is None else _pixels(camera, camera_from_world, figure.anchor[None])[0]
    whole = tuple(area for area in areas if np.isfinite(area).all())
    return Figure(figure.name, figure.colour, lines, whole, marks, anchor)


def _bent(vertices: Float64Array) -> Float64Array:
    closed = np.concatenate([vertices, vertices[:1]])
    length = float(np.linalg.norm(np.diff(closed, axis=0), axis=1).sum())
    return sample_polyline(closed, max(length / _CHUNKS, 1e-6))


def _pixels(camera: Camera, camera_from_world: RigidTransform, positions: Float64Array) -> Float64Array:
    return project_unbounded(camera, camera_from_world.apply(positions))


def _projected_line(
    line: Float64Array, camera: Camera, camera_from_world: RigidTransform
) -> Iterator[Float64Array]:
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    pixels = _pixels(camera, camera_from_world, sample_polyline(line, max(length / _CHUNKS, 1e-6)))
    reach = _JUMP_SHARE * max(camera.width, camera.height)
    jumps = np.abs(np.diff(pixels, axis=0)).max(axis=1, initial=0.0)
    broken = np.flatnonzero(~(jumps <= reach)) + 1  # a NaN breaks the line, too
    for part in np.split(pixels, broken):
        if len(part) > 1 and np.isfinite(part).all():
            yield part


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
        scene: what the annotations are of.
        sample: has the sweep.
        title: what the image is about.
        reach: from the map's middle to its upper edge [m]; by default it holds most of the points.
        size_px: width and height of the image.

    Raises:
        OptionError: the reach or the size cannot be drawn.
    """
    points_world, colors = _cloud(scene, sample)
    pose = sample.world_from_lidar or next(
        (p for p in sample.world_from_camera.values() if p is not None), None
    )
    ego = None if pose is None else EgoPosition(pose.translation, _level(pose.rotation))
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


def _cloud(scene: Scene, sample: Sample) -> tuple[Float64Array, UInt8Array | None]:
    """The sweep in the world; of a scene without one its maps."""
    world_from_points = sample.poses.world_from_points if sample.sweep is not None else None
    if sample.sweep is not None and world_from_points is not None:
        return world_from_points.apply(
            sample.sweep.points.positions.astype(np.float64)
        ), sample.sweep.points.colors
    maps = [sensor.positions for sensor in scene.sensors if isinstance(sensor, PointsSensor)]
    return (np.concatenate(maps) if maps else np.zeros((0, 3))).astype(np.float64), None


def _level(rotation_world: Float64Array) -> Float64Array:
    """Where a sensor's x axis leads, level; the world's x where it points up or down."""
    forward = rotation_world[:, 0] * (1.0, 1.0, 0.0)
    length = float(np.linalg.norm(forward))
    return forward / length if length > 0.1 else np.array([1.0, 0.0, 0.0])


def _draw_over(scene: Scene, sample: Sample, plot: Canvas, layout: MapLayout) -> None:
    names: list[Name] = []
    for positions, colour in _labelled_locations(scene, sample):
        draw_marks(plot, layout.pixels(positions), colour, _MARK_PX)
    for figure in _relations_in_world(scene, sample.timestamp_ns):
        names += draw_figure(plot, on_map(figure, layout), thickness=1)
    for _, figure in figures_in_world(scene, sample.timestamp_ns, sensor_id=sample.reference_id):
        names += draw_figure(plot, on_map(figure, layout), thickness=2)
    write_names(plot, names)


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
