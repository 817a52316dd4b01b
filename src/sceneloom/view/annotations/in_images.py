"""What is drawn into the images of a camera: boxes, shapes, and where cuboids and points are seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.scene.annotations.cuboids import Projection
from sceneloom.scene.annotations.keypoints import PointProjection
from sceneloom.scene.annotations.shapes import ShapeAnnotation, ShapeType
from sceneloom.scene.at import box_2d_at, shape_at
from sceneloom.view.annotations.rows import Group, by_moment, chosen_by_moment, name_of
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import fits

_SAME_NS = 1_000
"""A location in a image belongs to the image of that timestamp, which a file in microseconds may have rounded [ns]."""
_MARK = -3.0
_WIDTH = -1.0


@dataclass(frozen=True, slots=True, eq=False)
class BoxLayer:
    """Shows boxes of one class in the images of a camera."""

    group: Group

    def log(self, times_ns: Int64Array) -> None:
        """Log the boxes at times (M,) [ns]."""
        found = [box_2d_at(one, times_ns) for one in self.group.annotations]
        log_boxes(self.group, times_ns, [boxes for boxes, _ in found], "boxes in images")


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionLayer:
    """Shows where a camera sees cuboids of one class."""

    group: Group
    projections: tuple[Projection, ...]

    def log(self, times_ns: Int64Array) -> None:
        """Log the boxes at times (M,) [ns]."""
        found = [_rows_at(one.timestamps_ns, one.boxes, times_ns) for one in self.projections]
        log_boxes(self.group, times_ns, found, "projections")


def log_boxes(group: Group, times_ns: Int64Array, boxes: Sequence[Float64Array], kind: str) -> None:
    """Log boxes: for each annotation (M, 4) `left top width height` [px], NaN where it is not there."""
    values = np.array(boxes)
    half_sizes = values[..., 2:] / 2
    held = fits(values) & fits(values[..., :2] + half_sizes)
    group.stream.leave_out(kind, np.count_nonzero(~held & ~np.isnan(values).any(axis=2)))
    rows = by_moment(values, there := held)
    columns = sdk().Boxes2D.columns(
        centers=rows[:, :2] + rows[:, 2:] / 2,
        half_sizes=rows[:, 2:] / 2,
        colors=np.full(len(rows), group.colour, np.uint32),
        labels=chosen_by_moment([name_of(one) for one in group.annotations], there),
    )
    cut = columns.partition(there.sum(axis=0))
    group.stream.columns(times_ns, group.path, cut, group.details(there, times_ns), kind=kind)


@dataclass(frozen=True, slots=True, eq=False)
class PointProjectionLayer:
    """Shows where a camera sees named points: one entry of the group for each point."""

    group: Group
    projections: tuple[PointProjection, ...]
    names: tuple[str, ...]

    def log(self, times_ns: Int64Array) -> None:
        """Log the points at times (M,) [ns]."""
        values = np.array([_rows_at(one.timestamps_ns, one.points, times_ns) for one in self.projections])
        there = fits(values)
        lost = np.count_nonzero(~there & ~np.isnan(values).any(axis=2))
        self.group.stream.leave_out("points in images", lost)
        rows = by_moment(values, there)
        columns = sdk().Points2D.columns(
            positions=rows,
            colors=np.full(len(rows), self.group.colour, np.uint32),
            radii=np.full(len(rows), _MARK, np.float32),
            labels=chosen_by_moment(self.names, there),
        )
        self.group.stream.columns(times_ns, self.group.path, columns.partition(there.sum(axis=0)))


def _rows_at(timestamps_ns: Int64Array, values: Float64Array | None, times_ns: Int64Array) -> Float64Array:
    """The rows of values (N, D) at times (M,), NaN where no timestamp is at that time; (M, D)."""
    width = 4 if values is None else values.shape[1]
    found = np.full((len(times_ns), width), np.nan)
    if values is None or len(timestamps_ns) == 0:
        return found
    order = np.argsort(timestamps_ns, kind="stable")
    ordered = timestamps_ns[order]
    at = np.clip(np.searchsorted(ordered, times_ns), 1, max(len(ordered) - 1, 1))
    before = np.abs(times_ns - ordered[at - 1]) <= np.abs(
        ordered[np.minimum(at, len(ordered) - 1)] - times_ns
    )
    rows = order[np.where(before, at - 1, np.minimum(at, len(ordered) - 1))]
    same = np.abs(timestamps_ns[rows] - times_ns) <= _SAME_NS
    found[same] = values[rows[same]]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class ShapeLayer:
    """Shows shapes of one class and kind, in images or in space.

    Attributes:
        group: the shapes and their entity; all have vertices of as many numbers.
        origin: (D,) float64, what is taken off vertices.
    """

    group: Group
    origin: Float64Array

    def log(self, times_ns: Int64Array) -> None:
        """Log the shapes at times (M,) [ns]."""
        rr, group = sdk(), self.group
        found = [shape_at(one, times_ns) for one in group.annotations]
        reported = np.array(
            [[vertices is not None and len(vertices) > 0 for vertices in one] for one in found]
        )
        there = np.array([[_is_whole(vertices, self.origin) for vertices in one] for one in found])
        group.stream.leave_out("shapes", np.count_nonzero(reported & ~there))
        chosen = [found[a][m] - self.origin for m, a in np.argwhere(there.T).tolist()]  # type: ignore[operator]
        owners = chosen_by_moment(group.annotations, there)
        marks, flat = is_mark(group.annotations[0].type), len(self.origin) == 2
        details = group.details(there, times_ns)
        if marks:
            archetype = rr.Points2D if flat else rr.Points3D
            counts = _sums([len(vertices) for vertices in chosen], there.sum(axis=0))
            positions = np.concatenate([*chosen, np.zeros((0, len(self.origin)))])
            radii = np.full(len(positions), _MARK, np.float32)
            columns = archetype.columns(
                positions=positions, radii=radii, colors=np.full(len(positions), group.colour, np.uint32)
            )
        else:
            archetype = rr.LineStrips2D if flat else rr.LineStrips3D
            counts = there.sum(axis=0)
            columns = archetype.columns(
                strips=[closed(owner, line) for owner, line in zip(owners, chosen, strict=True)],
                radii=np.full(len(chosen), _WIDTH, np.float32),
                colors=np.full(len(chosen), group.colour, np.uint32),
                labels=[name_of(owner) for owner in owners],
            )
        group.stream.columns(times_ns, group.path, columns.partition(counts), details, kind="shapes")


def is_mark(kind: ShapeType) -> bool:
    """Whether a shape is points alone."""
    return kind in {ShapeType.POINT, ShapeType.POINT_2D, ShapeType.POINT_TOPDOWN}


def closed(annotation: ShapeAnnotation, vertices: Float64Array) -> Float64Array:
    """The outline of an area, or a line, from its vertices (V, D)."""
    if annotation.is_closed or annotation.type.value.startswith("polygon"):
        return np.concatenate([vertices, vertices[:1]])
    return vertices


def _is_whole(vertices: Float64Array | None, origin: Float64Array) -> bool:
    return vertices is not None and len(vertices) > 0 and bool(fits(vertices - origin).all())


def _sums(sizes: Sequence[int], counts: Int64Array) -> Int64Array:
    """How many vertices each moment has, of as many shapes as `counts` says."""
    stops = np.concatenate([[0], np.cumsum(sizes)])[np.concatenate([[0], np.cumsum(counts)])]
    return np.asarray(np.diff(stops), np.int64)


def by_camera(entries: Sequence[tuple[Any, Any]]) -> Mapping[Any, list[tuple[Any, Any]]]:
    """Pairs of an annotation and one of its entries that name a sensor, by that sensor."""
    found: dict[Any, list[tuple[Any, Any]]] = {}
    for annotation, entry in entries:
        found.setdefault(entry.sensor_id, []).append((annotation, entry))
    return found
