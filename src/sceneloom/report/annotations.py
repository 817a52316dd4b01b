"""Annotation statistics: objects by class, sizes, ranges, points inside, occlusion; images of them; and the section."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, spread_rows
from sceneloom.colouring.cuboid_projection import count_points, observe_cuboids
from sceneloom.errors import OptionError, SceneloomError
from sceneloom.report.content import (
    NOTHING,
    Block,
    Column,
    Drawing,
    Figures,
    Section,
    Table,
    bars,
    columns,
    count,
    line_plot,
    pair_columns,
    percent,
    text_column,
)
from sceneloom.scene.annotations import CuboidAnnotation
from sceneloom.scene.annotations_at import BoxTable
from sceneloom.scene.samples import Sample
from sceneloom.scene.scene import Scene, time_span
from sceneloom.visualization.annotations import draw_annotations_above, draw_annotations_in_image
from sceneloom.visualization.canvas import several

_MOMENTS = 12  # moments at which boxes are looked at, at most
_RANGE_EDGES = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 75.0, 100.0, 150.0)
_POINT_EDGES = (0, 1, 5, 20, 100, 500, 2000)  # borders of the numbers of points in a box
NO_CLASS = "(no class)"
_MOST_TIMES = 120


class Spread(msgspec.Struct, frozen=True, kw_only=True):
    """Some values: how many, the middle one, and what 90 % of them lie between."""

    count: int
    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float] | Float64Array | Int64Array) -> "Spread | None":
        """Sum up values that are finite; None where there are none."""
        known = np.asarray(values, np.float64)
        known = known[np.isfinite(known)]
        if len(known) == 0:
            return None
        low, median, high = np.percentile(known, (5.0, 50.0, 95.0)).tolist()
        return cls(count=len(known), median=median, low=low, high=high)


class ClassNumbers(msgspec.Struct, frozen=True, kw_only=True):
    """The boxes of one class.

    Attributes:
        objects: annotations.
        key_frames: boxes that are stated.
        stationary: objects that are stated to are stationary.
        length, width, height: of the objects, the middle one of each [m].
        seconds: how long objects are there [s]; of those that are not there all the time.
        ranges: distance from the sensor at the moments looked at [m].
        points: points of the lidars in a box at these moments.
        empty_share: of the boxes at these moments, those without any point.
        hidden: which share of a box nearer boxes hide in images, over those in images.
        in_images_share: of the boxes at these moments, those in at least one image; None without cameras.
    """

    label: str
    objects: int
    key_frames: int
    stationary: int
    length: Spread | None
    width: Spread | None
    height: Spread | None
    seconds: Spread | None
    ranges: Spread | None = None
    points: Spread | None = None
    empty_share: float | None = None
    hidden: Spread | None = None
    in_images_share: float | None = None


_MOST_CAMERAS = 4  # cameras whose images are shown with annotations


class Labels(msgspec.Struct, frozen=True, kw_only=True):
    """All annotations of a drive.

    Attributes:
        types: how many of each type.
        classes: of cuboids, the most frequent first.
        moments: at how many moments boxes were looked at, `of` how many.
        over_time: (seconds after the first timestamp, boxes that are there).
        range_edges, range_counts: boxes by distance at these moments; the last count is of those beyond.
        point_edges, point_counts: boxes by points inside; the last count is of those with more.
        attributes: names of attributes of annotations, with how many have them.
        skipped: what could not be reported, and why.
    """

    types: dict[str, int]
    classes: tuple[ClassNumbers, ...] = ()
    moments: int = 0
    of: int = 0
    over_time: tuple[tuple[float, int], ...] = ()
    range_edges: tuple[float, ...] = _RANGE_EDGES
    range_counts: tuple[int, ...] = ()
    point_edges: tuple[int, ...] = _POINT_EDGES
    point_counts: tuple[int, ...] = ()
    attributes: dict[str, int] = msgspec.field(default_factory=dict)
    skipped: tuple[str, ...] = ()

    @classmethod
    def measured(cls, scene: Scene, *, start_ns: int, moments: int = _MOMENTS) -> "Labels | None":
        """Look at the annotations of a scene; None where it has none.

        Args:
            start_ns: the scene's first timestamp [ns].
            moments: so many are looked at more closely, at most.
        """
        if not scene.annotations:
            return None
        types = Counter(str(annotation.type) for annotation in scene.annotations)
        attributes = Counter(
            name
            for annotation in scene.annotations
            for name in dict.fromkeys(attribute.name for attribute in getattr(annotation, "attributes", ()))
        )
        found = cls(types=dict(types), attributes=dict(attributes))
        table = BoxTable(scene)
        if not table.annotations:
            return found
        looks = _look(scene, table, moments)
        _count(scene, looks, moments)
        by_label: dict[str, list[int]] = {}
        for row, annotation in enumerate(table.annotations):
            by_label.setdefault(str(annotation.label or NO_CLASS), []).append(row)
        classes = [_class(label, rows, table.annotations, looks) for label, rows in by_label.items()]
        return msgspec.structs.replace(
            found,
            classes=tuple(sorted(classes, key=lambda numbers: (-numbers.objects, numbers.label))),
            moments=looks.moments,
            of=looks.of,
            over_time=_over_time(scene, table, start_ns),
            range_counts=_binned(looks.get("ranges"), _RANGE_EDGES),
            point_counts=_binned(looks.get("points"), _POINT_EDGES),
            skipped=tuple(looks.skipped),
        )

    def section(self, figures: Figures, missing: str | None) -> Section:
        """How many objects of which class there are, how large, how far, how well seen."""
        rest = self.classes[_MOST_CLASSES:]
        types = [(name.replace("_", " "), count(number)) for name, number in self.types.items()]
        attributes = [(name, count(number)) for name, number in sorted(self.attributes.items())[:_MOST_ATTRIBUTES]]
        tables = [
            Table(
                "Boxes in space by class: the median, and what 90 % lie between",
                _CLASS_COLUMNS,
                self.classes[:_MOST_CLASSES],
                more=f"{len(rest)} further classes with {sum(c.objects for c in rest):,} objects." if rest else "",
            ),
            Table("Annotations by type", pair_columns("Type", "Annotations", numeric=True), types),
            Table(
                f"Attributes of annotations: {len(self.attributes)}",
                pair_columns("Attribute", "Annotations", numeric=True),
                attributes,
                folded=True,
            ),
        ]
        sampled = (
            f"Ranges, points and what hides boxes are of {several(self.moments, 'moment')} out of {self.of:,}, spread "
            "over the drive. Hidden: the share of a box's area in an image that nearer boxes cover, the median."
        )
        return Section(
            key="annotations",
            name="Annotations",
            missing=missing,
            facts=[(name.capitalize(), number) for name, number in types][:8],
            blocks=[
                Block(plots=self._plots()),
                Block(photos=figures.of("annotations")),
                Block(tables=tables),
                Block(lines=[sampled] if self.moments else [], faint=True),
                Block(list_title=f"Not reported: {len(self.skipped)}", listed=self.skipped),
            ],
        )

    def _plots(self) -> list[Drawing]:
        found = []
        shown = self.classes[:_MOST_BARS]
        if shown:
            names, objects = [c.label for c in shown], [c.objects for c in shown]
            labels = [f"{number:,}" for number in objects]
            text = "; ".join(f"{name} {number}" for name, number in zip(names, labels, strict=True))
            found.append(Drawing("Objects by class", text, bars(names, objects, labels=labels)))
        if len(self.over_time) > 1:
            text = f"At most {max(number for _, number in self.over_time):,} boxes at one time"
            svg = line_plot([self.over_time], x_name="time [s]", y_name="boxes", with_zero=True)
            found.append(Drawing("Boxes over time", text, svg))
        if self.range_counts:
            names = [*(f"{a:g}–{b:g}" for a, b in pairwise(self.range_edges)), f"{self.range_edges[-1]:g}+"]
            svg = columns(names, self.range_counts, x_name="range [m]", y_name="boxes")
            found.append(Drawing("Boxes by range", f"Boxes at {several(self.moments, 'moment')} by distance", svg))
        if self.point_counts:
            names = [str(a) if b == a + 1 else f"{a}–{b - 1}" for a, b in pairwise(self.point_edges)]
            names.append(f"{self.point_edges[-1]}+")
            svg = columns(names, self.point_counts, x_name="points inside", y_name="boxes")
            text = f"{self.point_counts[0]:,} of {sum(self.point_counts):,} boxes hold no point"
            found.append(Drawing("Boxes by points inside", text, svg))
        return found

    @staticmethod
    def draw(scene: Scene, figures: Figures) -> None:
        """Draw the annotations at the middle of a drive from above and in images; nothing without frames.

        Raises:
            DataError: a sweep or image cannot be read.
        """
        samples = _samples(scene) if scene.annotations else None
        if not samples:
            return
        sample = samples[len(samples) // 2]
        text = "The sweep in the middle of the drive as a map, with everything of the annotations that has a location"
        figures.add("annotations", "Annotations from above", text, draw_annotations_above(scene, sample))
        shown = [camera_id for camera_id, image in sample.images.items() if image is not None]
        for camera_id in shown[:_MOST_CAMERAS]:
            text = f"The image of camera {camera_id} at the middle of the drive, with the outlines of the annotations"
            image = draw_annotations_in_image(scene, sample, camera_id)
            figures.add("annotations", f"Annotations in {camera_id}", text, image)


_MOST_CLASSES, _MOST_BARS, _MOST_ATTRIBUTES = 40, 14, 100


def _spread(name: str, field: str, digits: int) -> Column:
    """The median of some values, and what 90 % of them lie between."""

    def cell(numbers: Any) -> str:
        spread: Spread | None = getattr(numbers, field)
        if spread is None:
            return NOTHING
        median = f"{spread.median:.{digits}f}"
        if spread.count == 1 or spread.high - spread.low < 0.5 * 10**-digits:
            return median
        return f"{median} ({spread.low:.{digits}f}–{spread.high:.{digits}f})"

    return Column(name, cell)


_CLASS_COLUMNS = (
    text_column("Class", lambda numbers: numbers.label),
    Column("Objects", lambda numbers: count(numbers.objects)),
    Column("Boxes stated", lambda numbers: count(numbers.key_frames)),
    Column("Stationary", lambda numbers: count(numbers.stationary)),
    _spread("Length [m]", "length", 1),
    _spread("Width [m]", "width", 1),
    _spread("Height [m]", "height", 1),
    _spread("There for [s]", "seconds", 1),
    _spread("Range [m]", "ranges", 0),
    _spread("Points inside", "points", 0),
    Column("Without a point", lambda numbers: percent(numbers.empty_share, 0)),
    Column(
        "Hidden in images", lambda numbers: NOTHING if numbers.hidden is None else percent(numbers.hidden.median, 0)
    ),
    Column("In an image", lambda numbers: percent(numbers.in_images_share, 0)),
)


_BY_ROW = {"ranges": "rows of ranges", "seen": "rows of seen", "hidden": "rows of hidden", "points": "rows of points"}
"""What is noted of boxes, and under which name the rows are that it is of."""


@dataclass(slots=True)
class _Looks:
    """What was seen of the boxes at some moments, one entry per box and moment, by row of the table."""

    values: dict[str, list[Any]] = field(
        default_factory=lambda: {name: [np.zeros(0, np.int64)] for name in (*_BY_ROW, *_BY_ROW.values())}
    )
    moments: int = 0
    of: int = 0
    with_cameras: bool = False
    skipped: list[str] = field(default_factory=list)

    def add(self, name: str, rows: Any, values: Any) -> None:
        """Note values of some rows."""
        self.values[_BY_ROW[name]].append(rows)
        self.values[name].append(values)

    def get(self, name: str, rows: Sequence[int] | None = None) -> Any:
        """All values of a name, or those of some rows."""
        values = np.concatenate(self.values[name])
        return values if rows is None else values[np.isin(np.concatenate(self.values[_BY_ROW[name]]), rows)]


def _look(scene: Scene, table: BoxTable, moments: int) -> _Looks:
    """See the boxes from the sensors at some moments: how far they are, which are in images, what hides them."""
    looks, samples = _Looks(), _samples(scene)
    if samples is None:
        return looks
    looks.of, looks.with_cameras = len(samples), any(len(camera.images) for camera in scene.cameras)
    for row in spread_rows(len(samples), moments).tolist():
        try:
            _add(looks, table, samples[row])
        except SceneloomError as error:
            looks.skipped.append(str(error))
            if isinstance(error, OptionError):
                break
    return looks


def _samples(scene: Scene) -> Sequence[Sample] | None:
    """Moments by the sweeps of the first lidar, else by images; None where there are neither."""
    try:
        return scene.samples(reference="lidar" if any(len(x.frames) for x in scene.lidars[:1]) else "camera")
    except OptionError:
        return None


def _add(looks: _Looks, table: BoxTable, sample: Sample) -> None:
    there, boxes = table.find(sample.timestamp_ns, sensor_id=sample.reference_id)
    looks.moments += 1
    if len(there) == 0:
        return
    location = sample.poses.world_from_sensor.get(sample.reference_id)
    ranges = np.full(len(there), np.nan)
    if location is not None:
        ranges = np.linalg.norm(boxes.centers_world - location.translation, axis=1)
    seen = np.zeros(len(there), np.bool_)
    for camera_id, world_from_camera in sample.world_from_camera.items():
        if world_from_camera is None or sample.images.get(camera_id) is None:
            continue
        rows, shown = table.find(sample.times_ns[camera_id], sensor_id=camera_id)
        found = observe_cuboids(sample.cameras[camera_id], world_from_camera, shown, min_pixels=4.0)
        seen[np.isin(there, rows[found.rows])] = True
        looks.add("hidden", rows[found.rows], found.occlusions)
    looks.add("ranges", there, ranges)
    looks.add("seen", there, seen)


def _count(scene: Scene, looks: _Looks, moments: int) -> None:
    """Count the points in boxes at some sweeps."""
    if not any(len(lidar.frames) for lidar in scene.lidars[:1]):
        return
    some = {
        lidar.id: replace(lidar, frames=lidar.frames.chosen(spread_rows(len(lidar.frames), moments)))
        for lidar in scene.lidars
    }
    part = replace(scene, sensors=tuple(some.get(sensor.id, sensor) for sensor in scene.sensors))
    try:
        counts = count_points(part, moment="points")
    except SceneloomError as error:
        looks.skipped.append(f"points in boxes: {error}")
        return
    for lidar in counts.lidars:
        frames, rows = np.nonzero(lidar.there)
        looks.add("points", rows, lidar.counts[frames, rows])


def _class(label: str, rows: list[int], annotations: Sequence[CuboidAnnotation], looks: _Looks) -> ClassNumbers:
    mine = [annotations[row] for row in rows]
    sizes = np.array([np.median(annotation.path.values[:, :3], axis=0) for annotation in mine])
    length, width, height = (Spread.of(sizes[:, axis]) for axis in range(3))
    moving = [a.path.timestamps_ns for a in mine if len(a.path.timestamps_ns) > 1]
    points, seen = looks.get("points", rows), looks.get("seen", rows)
    return ClassNumbers(
        label=label,
        objects=len(mine),
        key_frames=sum(len(a.path.timestamps_ns) for a in mine),
        stationary=sum(a.stationary is True for a in mine),
        length=length,
        width=width,
        height=height,
        seconds=Spread.of([(int(times[-1]) - int(times[0])) / 1e9 for times in moving]),
        ranges=Spread.of(looks.get("ranges", rows)),
        points=Spread.of(points),
        empty_share=float((points == 0).mean()) if len(points) else None,
        hidden=Spread.of(looks.get("hidden", rows)),
        in_images_share=float(seen.mean()) if looks.with_cameras and len(seen) else None,
    )


def _over_time(scene: Scene, table: BoxTable, start_ns: int) -> tuple[tuple[float, int], ...]:
    """How many boxes are there over the drive."""
    span = time_span(scene)
    if span is None or span[0] == span[1]:
        return ()
    steps = range(_MOST_TIMES)
    times = np.array([span[0] + (span[1] - span[0]) * k // (_MOST_TIMES - 1) for k in steps], np.int64)
    counts = np.zeros(len(times), np.int64)
    for annotation in table.annotations:
        timestamps = annotation.path.timestamps_ns
        always = annotation.stationary is True
        counts += always | ((times >= timestamps[0]) & (times <= timestamps[-1]))
    return tuple((round((t - start_ns) / 1e9, 4), n) for t, n in zip(times.tolist(), counts.tolist(), strict=True))


def _binned(values: Sequence[float], edges: Sequence[float]) -> tuple[int, ...]:
    """How many values lie from each border to the next, and from the last one on; those that are none do not count."""
    known = np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    if len(known) == 0:
        return ()
    rows = np.searchsorted(edges, known, side="right") - 1
    return tuple(np.bincount(np.maximum(rows, 0), minlength=len(edges)).tolist())
