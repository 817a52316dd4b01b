"""Which annotations concern one thing, and so are one object of a file."""

from collections.abc import Iterator, Sequence
from typing import Any

from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.annotations.relations import ObjectAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.types import Key, key_of

_PARTS = (CuboidAnnotation, Box2DAnnotation, ShapeAnnotation, PointsAnnotation, LabeledPointsAnnotation)


def things(annotations: Sequence[Annotation]) -> Iterator[tuple[Annotation, list[Annotation]]]:
    """Give each annotation that stands for a thing, in their order, with those that report more of the same thing.

    What has an object or a cuboid as its parent, by `parent_id`, and is of no other class reports more of that. A
    cuboid below a cuboid is a thing of its own.
    """
    by_id: dict[Key, Annotation] = {key_of(one.id): one for one in annotations}
    parts: dict[Key, list[Annotation]] = {}
    labels: dict[Key, str | None] = {key_of(one.id): _label(one) for one in annotations}
    alone: list[Annotation] = []
    for one in annotations:
        host = _host(one, by_id)
        key, label = key_of(host.id), _label(one)
        if host is one or (label and labels[key] and label != labels[key]):
            alone.append(one)
            continue
        labels[key] = labels[key] or label
        parts.setdefault(key, []).append(one)
    for one in alone:
        yield one, parts.get(key_of(one.id), [])


def _label(annotation: Any) -> str | None:
    return getattr(annotation, "label", None) or None


def _host(annotation: Annotation, by_id: dict[Key, Annotation]) -> Annotation:
    """The annotation of the thing that another one reports: itself, or what it belongs to."""
    host, above = annotation, _above(annotation, by_id)
    if isinstance(above, CuboidAnnotation):
        host, above = above, _above(above, by_id)
        above = above if isinstance(above, ObjectAnnotation) else None
    return host if above is None else above


def _above(annotation: Any, by_id: dict[Key, Annotation]) -> Annotation | None:
    if annotation.parent_id is None or not isinstance(annotation, _PARTS) or not _is_whole(annotation):
        return None
    parent = by_id.get(key_of(annotation.parent_id))
    is_cuboid = isinstance(parent, CuboidAnnotation) and _is_whole(parent)
    if isinstance(parent, ObjectAnnotation) or (is_cuboid and not isinstance(annotation, CuboidAnnotation)):
        labels = {_label(annotation), _label(parent)} - {None}
        return parent if len(labels) < 2 else None
    return None


def _is_whole(annotation: Any) -> bool:
    """Whether the data of an object state the annotation in one piece: at some time, and by one type of data."""
    if isinstance(annotation, ShapeAnnotation):
        return len({len(vertices) == 1 for vertices in annotation.path.vertices}) == 1
    return not hasattr(annotation, "path") or len(annotation.path.timestamps_ns) > 0
