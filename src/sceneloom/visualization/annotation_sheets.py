"""All visualisations of a scene's annotations: the timeline, calibrations and pose adjustments.

One image per annotation type, saved to a folder.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.errors import OptionError
from sceneloom.formats.base.output import file_stem, filling
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.samples import Sample
from sceneloom.scene.scene import Corrections, Scene, frame_times, time_span
from sceneloom.scene.types import Identifier
from sceneloom.visualization.annotations import (
    PALETTE,
    colour_of,
    draw_annotations_above,
    draw_annotations_in_image,
    draw_marks,
    image,
    same_id,
)
from sceneloom.visualization.canvas import (
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
from sceneloom.visualization.clouds import SIZE_PX, EgoPosition, MapLayout, draw_cloud_above
from sceneloom.visualization.colour_scales import (
    COARSE_DIGITS,
    draw_caption,
    draw_strip,
    round_up,
    strip_height,
)
from sceneloom.visualization.fused_frames import framed, save_image

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


def draw_timeline(
    scene: Scene, *, title: str = "annotations over time", width_px: int = _WIDTH_PX
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
    shown = rows[:_MOST_ROWS]
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


_GRID = (16, 9)

_DISTANCE = 20.0
"""How far away the things are whose pixels are compared [m]."""

_BEFORE, _AFTER = FAINT_INK, (255, 206, 84)


def draw_calibration(sample: Sample, calibration: CameraCalibration) -> PilImage:
    """Draw where the pixels of a camera go by its calibration: things 20 m away, from where they were seen.

    Raises:
        DataError: the image cannot be decoded.
        CalibrationError: a camera model has no projection.
    """
    camera = sample.cameras[calibration.sensor_id]
    plot = image(sample, calibration.sensor_id)
    columns, rows = (
        (np.arange(n) + 0.5) * size / n for n, size in zip(_GRID, (camera.width, camera.height), strict=True)
    )
    before = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    points = _DISTANCE * unproject(camera, before)
    correction = _correction(calibration, sample.times_ns.get(calibration.sensor_id, sample.timestamp_ns))
    after = project_unbounded(calibration.intrinsics or camera, correction.inverse().apply(points))
    shifts = np.linalg.norm(after - before, axis=1)
    for start, stop in zip(before, after, strict=True):
        if np.isfinite(stop).all():
            plot.line([(start[0], start[1]), (stop[0], stop[1])], _AFTER, width=2)
    draw_marks(plot, before, _BEFORE, 1.5)
    largest = float(np.nanmax(shifts)) if np.isfinite(shifts).any() else float("nan")
    stated = f"things {_DISTANCE:g} m away move by {largest:.1f} px at most"
    if calibration.time_offset_ns is not None:
        stated += f"; times by {calibration.time_offset_ns / 1e6:g} ms"
    return framed(plot, [f"{calibration.type} {calibration.id} of {calibration.sensor_id}", stated])


def draw_adjustment(
    scene: Scene, adjustment: LocalizationAdjustment, *, size_px: tuple[int, int] = SIZE_PX
) -> PilImage:
    """Draw the ego trajectory before and after a localisation adjustment, from above."""
    trajectory = _trajectory(scene)
    before = np.zeros((0, 3)) if trajectory is None else trajectory.positions
    after = before if trajectory is None else _adjusted(trajectory, adjustment.poses)
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
        size_px=size_px, over=over,
    )  # fmt: skip


def _grid(camera: Camera) -> Float64Array:
    columns = (np.arange(_GRID[0]) + 0.5) * camera.width / _GRID[0]
    rows = (np.arange(_GRID[1]) + 0.5) * camera.height / _GRID[1]
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _correction(calibration: CameraCalibration, timestamp_ns: int) -> RigidTransform:
    if calibration.poses is None:
        return RigidTransform.identity()
    pose = calibration.poses.held(np.array([timestamp_ns], np.int64))
    return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])


def _trajectory(scene: Scene) -> Poses | None:
    """Some way through the world: an odometry sensor's, else a trajectory's, else a lidar's."""
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and not sensor.poses.static:
            return sensor.poses
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None:
            return trajectory.poses
    lidars = [
        s.poses for s in scene.sensors if isinstance(s, LidarSensor | CameraSensor) and s.poses is not None
    ]
    return lidars[0] if lidars else None


def _adjusted(trajectory: Poses, adjustment: Poses) -> Float64Array:
    """P' = A(t) p; beyond its ends the adjustment holds."""
    at = adjustment.held(trajectory.timestamps_ns)
    return rotate_vectors(at.quaternions_xyzw, trajectory.positions) + at.positions


_Drawing = tuple[str, Callable[[], PilImage]]

_Draw = Callable[[Scene, Sample | None, str], PilImage]

_REACH = 20.0
"""From the ego to the upper edge of a map that shows how annotations belong together [m]."""


def _plots_by_type(scene: Scene, sample: Sample | None) -> Iterator[_Drawing]:
    """Name each type of annotation that the scene has, and state how to draw it: alone, and what it belongs to."""
    for type_name in dict.fromkeys(str(annotation.type) for annotation in scene.annotations):
        chosen = [a for a in scene.annotations if str(a.type) == type_name]
        shown = replace(scene, annotations=(*chosen, *_related(scene, chosen)), attributes=())
        draw = _VIEWS.get(type_name, _in_image)
        yield type_name, partial(draw, shown, sample, type_name)


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
            any(same_id(a.id, end) for end in ends)
            or any(same_id(getattr(a, "parent_id", None), parent) for parent in parents)
        )
    ]


def _in_image(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    """In the image of the camera that a shape in images names, else of the first one; else from above."""
    seen = [] if sample is None else [key for key, image in sample.images.items() if image is not None]
    if sample is None or not seen:
        return _above(scene, sample, type_name)
    named = [getattr(annotation, "sensor_id", None) for annotation in scene.annotations]
    camera_id = next((key for key in seen if any(same_id(key, name) for name in named)), seen[0])
    return draw_annotations_in_image(scene, sample, camera_id, title=type_name)


def _above(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    if sample is None:
        return draw_timeline(scene, title=type_name)
    return draw_annotations_above(scene, sample, title=type_name, reach=_REACH)


def _over_time(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    del sample
    return draw_timeline(scene, title=type_name)


def _adjustment(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    del sample, type_name
    chosen = next(a for a in scene.annotations if isinstance(a, LocalizationAdjustment))
    return draw_adjustment(scene, chosen)


def _calibration(scene: Scene, sample: Sample | None, type_name: str) -> PilImage:
    chosen = next(a for a in scene.annotations if isinstance(a, CameraCalibration))
    if sample is None or chosen.sensor_id not in sample.cameras:
        return draw_timeline(scene, title=type_name)
    return draw_calibration(sample, chosen)


_VIEWS: Mapping[str, _Draw] = MappingProxyType(
    {
        "link": _above,
        "group": _above,
        "object": _above,
        "event": _over_time,
        "attributes": _over_time,
        "localization_adjustment": _adjustment,
        "camera_calibration": _calibration,
    }
)
"""What shows best from above, over time, or in a view of its own; everything else is shown in an image."""


def save_annotation_images(
    scene: Scene, folder: Path, *, at: float | None = None, overwrite: bool = False
) -> list[Path]:
    """Draw a scene's annotations at one moment into a folder, which is made where it is missing.

    `timeline.png`, `above.png`, `camera_<id>.png` for each camera with images, and `type_<type>.png` for each type
    of annotation that the scene has.

    Args:
        scene: what the annotations are of.
        folder: where the images go.
        at: seconds after the scene's first timestamp; None for its middle.
        overwrite: replace files that are there.

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
        if len(corrected.pending_corrections) < len(
            pending
        ):  # what they change is seen before they are applied
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
    for type_name, draw in _plots_by_type(scene, sample):
        yield f"type_{file_stem(type_name)}", draw


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
