"""Rules about shapes and attributes: vertices, crossing edges, flat areas, and values that the format has."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.checks.rule import ERROR, HINT, WARNING, Find, Hit, Rule, Subject, annotation_parts, with_each
from sceneloom.scene.annotations import AttributePath, PointsAnnotation, ShapeAnnotation, ShapeType
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import key_of

_AREAS = (ShapeType.POLYGON, ShapeType.POLYGON_2D, ShapeType.POLYGON_TOPDOWN)
_LINES = (ShapeType.POLYLINE, ShapeType.POLYLINE_2D)
_POINTS = (ShapeType.POINT, ShapeType.POINT_2D, ShapeType.POINT_TOPDOWN)
LEAST_VERTICES = {**dict.fromkeys(_AREAS, 3), **dict.fromkeys(_LINES, 2), **dict.fromkeys(_POINTS, 1)}
"""How many vertices a shape needs."""

_OUTLINES_IN_SPACE = frozenset({ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN, ShapeType.POLYLINE})
_SMOOTHER = 0.5
"""Triples that are read as pairs go back and forth between x, y and z, and so do pairs that are read as triples."""

_FLAT_SHARE, _FLAT_M = 0.01, 0.02
"""A polygon is flat if its vertices lie this near to a plane: by its size, and at least the noise of a lidar [m]."""

_MOST_VERTICES = 1_000  # longer outlines are not searched for crossings: the search grows with the square


def _of_shapes(judge: Callable[[ShapeAnnotation, Float64Array], str]) -> Find:
    """Give a hit for each shape that has keyframes with a problem, not ""; the first one is reported."""

    def find(subject: Subject) -> Iterator[Hit]:
        for path, shape in subject.annotations_of(ShapeAnnotation):
            found = [(k, problem) for k, v in enumerate(shape.path.vertices) if (problem := judge(shape, v))]
            if found:
                yield Hit(f"{path}.path.values[{found[0][0]}]", found[0][1], count=len(found))

    return find


def _too_few(shape: ShapeAnnotation, vertices: Float64Array) -> str:
    least = LEAST_VERTICES[shape.type]
    return f"{len(vertices)} vertices; a {shape.type} has at least {least}" if len(vertices) < least else ""


def _several_points(shape: ShapeAnnotation, vertices: Float64Array) -> str:
    several = LEAST_VERTICES[shape.type] == 1 and len(vertices) > 1
    return f"{len(vertices)} vertices; a {shape.type} has one" if several else ""


def _vertex_not_finite(_: ShapeAnnotation, vertices: Float64Array) -> str:
    rows = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    return f"vertex {rows[0]} is {vertices[rows[0]].tolist()}; expected finite numbers" if len(rows) else ""


def _not_finite(subject: Subject) -> Iterator[Hit]:
    yield from _of_shapes(_vertex_not_finite)(subject)
    table = annotation_parts(subject, "points")
    for number, path in enumerate(table.parts):
        rows = np.flatnonzero(~np.isfinite(path.values).all(axis=1))
        if len(rows):
            location = f"{table.location(subject, number)}.values[{rows[0]}]"
            yield Hit(location, f"{path.values[rows[0]].tolist()}; expected finite numbers", count=len(rows))


def _not_flat(shape: ShapeAnnotation, vertices: Float64Array) -> str:
    if shape.type != ShapeType.POLYGON or len(vertices) < 4 or not np.isfinite(vertices).all():
        return ""
    centred = vertices - vertices.mean(axis=0)
    away = float(np.abs(centred @ np.linalg.svd(centred, full_matrices=False)[2][2]).max())
    size = float(2 * np.linalg.norm(centred, axis=1).max())
    is_flat = away <= max(_FLAT_M, _FLAT_SHARE * size)
    return "" if is_flat else f"a vertex lies {away:.3f} m off the plane of a polygon {size:.1f} m across"


def _crossing(shape: ShapeAnnotation, vertices: Float64Array) -> str:
    if shape.type not in _AREAS or not 4 <= len(vertices) <= _MOST_VERTICES or not np.isfinite(vertices).all():
        return ""
    outline = vertices[:, :2]  # as drawn, or from above
    if shape.type == ShapeType.POLYGON:
        centred = vertices - vertices.mean(axis=0)
        outline = np.asarray(centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T)
    pair = _crossing_edges(outline)
    return "" if pair is None else f"edges {pair[0]} and {pair[1]} cross; expected an outline"


def _crossing_edges(outline: Float64Array) -> tuple[int, int] | None:
    """Find two edges that cross inside both: the ends of each lie on different sides of the other; touching is none."""
    if np.array_equal(outline[0], outline[-1]):
        outline = outline[:-1]
    starts, stops = outline, np.roll(outline, -1, axis=0)
    parted = _sides(starts, stops, starts) * _sides(starts, stops, stops) < 0
    pairs = np.argwhere(np.triu(parted & parted.T, 1))
    return (int(pairs[0, 0]), int(pairs[0, 1])) if len(pairs) else None


def _sides(starts: Float64Array, stops: Float64Array, points: Float64Array) -> Float64Array:
    """(E, P): on which side of each edge each point lies, -1, 0 or 1; 0 within rounding of the edge's line."""
    along = stops - starts
    away = points[None] - starts[:, None]
    rotations = along[:, None, 0] * away[..., 1] - along[:, None, 1] * away[..., 0]
    reach = np.abs(along).sum(axis=1)[:, None] * np.abs(away).sum(axis=2)
    return np.asarray(np.where(np.abs(rotations) <= 1e-9 * reach, 0.0, np.sign(rotations)))


def _counts_change(subject: Subject) -> Iterator[Hit]:
    for path, shape in subject.annotations_of(ShapeAnnotation):
        counts = [len(vertices) for vertices in shape.path.vertices]
        changes = [k for k in range(1, len(counts)) if counts[k] != counts[k - 1]]
        if changes:
            k = changes[0]
            problem = f"{counts[k]} vertices after {counts[k - 1]}; between them no shape can be computed"
            yield Hit(f"{path}.path.values[{k}]", problem, count=len(changes))


def _pairs_as_triples(subject: Subject) -> Iterator[Hit]:
    """Outlines in space whose rows fit pairs as well: smoother, whole, or beside others that are pairs."""
    others = any(warning.code == "no-height" for warning in subject.notes)
    for path, shape in subject.annotations_of(ShapeAnnotation):
        if shape.type not in _OUTLINES_IN_SPACE or not shape.path.vertices:
            continue
        rows = [vertices.reshape(-1) for vertices in shape.path.vertices]
        if any(row.size % 6 or not row.size or not np.isfinite(row).all() for row in rows):
            continue
        if all((vertices[:, 2] == 0).all() for vertices in shape.path.vertices):
            continue  # pairs that were read as such
        as_triples, as_pairs = (sum(_bends(row.reshape(-1, width)) for row in rows) for width in (3, 2))
        least = LEAST_VERTICES[shape.type]
        few = any(row.size // 3 < least <= row.size // 2 for row in rows)
        if not (others or few or as_pairs < _SMOOTHER * as_triples):
            continue
        count = rows[0].size
        why = "as in other annotations of the file" if others else "as which they are smoother"
        why = f"as triples they are too few for a {shape.type}" if few else why
        read = f"{count} numbers, read as {count // 3} x, y, z triples"
        yield Hit(f"{path}.path.values", f"{read}; they may be {count // 2} x, y pairs, {why}")


def _bends(vertices: Float64Array) -> float:
    """How much a line bends in all [m]: the sum of its second differences."""
    return float(np.linalg.norm(np.diff(vertices, n=2, axis=0), axis=1).sum())


def _counts_of_points(subject: Subject) -> Iterator[Hit]:
    for path, points in subject.annotations_of(PointsAnnotation):
        count = len(points.paths)
        if points.labels is not None and len(points.labels) != count:
            yield Hit(f"{path}.labels", f"{len(points.labels)} labels for {count} points; expected as many")
        if points.projections and len(points.projections) != count:
            problem = f"projections of {len(points.projections)} points, of {count}; expected as many"
            yield Hit(f"{path}.projections", problem)
        for k, point in enumerate(points.paths):
            if point.values.shape[1] != 3 and len(point.values):
                problem = f"{point.values.shape[1]} numbers in a row; expected x, y, z of one point"
                yield Hit(f"{path}.paths[{k}].values", problem)


def _ids_of_points(subject: Subject) -> Iterator[Hit]:
    for path, points in subject.annotations_of(PointsAnnotation):
        seen: dict[tuple[type, object], int] = {}
        for k, point in enumerate(points.paths):
            first = k if point.id is None else seen.setdefault(key_of(point.id), k)
            if first != k:
                yield Hit(f"{path}.paths[{k}].id", f"{point.id!r} is the id of paths[{first}], too")


class _Stated(NamedTuple):
    """An attribute with its location: its name and values, how many timestamps it has, and whether it is static."""

    path: str
    name: Any
    values: tuple[Any, ...]
    time_count: int | None
    static: bool


def _all_attributes(subject: Subject) -> list[_Stated]:
    placed: list[tuple[str, AttributePath | Mapping[str, Any]]]
    placed = [(f"attributes[{k}]", attribute) for k, attribute in enumerate(subject.scene.attributes)]
    for path, annotation in subject.annotations():
        own = getattr(annotation, "attributes", ())
        placed += [(f"{path}.attributes[{k}]", attribute) for k, attribute in enumerate(own)]
    found = []
    name: Any
    times: Any
    values: Any
    for path, one in placed:
        if isinstance(one, AttributePath):
            name, times, values, static = one.name, one.timestamps_ns, one.values, one.static
        else:
            name, times, values, static = (one.get(key) for key in ("name", "timestamps", "values", "static"))
        count = None if times is None else len(times)
        found.append(_Stated(path, name, () if values is None else tuple(values), count, bool(static)))
    return found


def _of_attributes(judge: Callable[[_Stated], tuple[int | None, int, str] | None]) -> Find:
    """Give a hit for each attribute with a problem: at which value, None for all of it, how many, and what."""

    def find(subject: Subject) -> Iterator[Hit]:
        for stated in subject.table("attributes", _all_attributes):
            found = judge(stated)
            if found is not None:
                row, count, problem = found
                where = "" if row is None else ".values" if row < 0 else f".values[{row}]"
                yield Hit(f"{stated.path}{where}", f"{stated.name!r} {problem}", count=count)

    return find


def _is_usual(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return all(isinstance(text, str) for text in value)
    return isinstance(value, str | int | float) and not isinstance(value, bool)


def _same(one: Any, other: Any) -> bool:
    """Whether two values are equal; of what is no value of the format only the very object is."""
    return one is other or (_is_usual(one) and _is_usual(other) and bool(one == other))


def _unusual(stated: _Stated) -> tuple[int, int, str] | None:
    odd = [k for k, value in enumerate(stated.values) if not _is_usual(value)]
    expected = "expected text, a number or a list of texts"
    return (odd[0], len(odd), f"is {stated.values[odd[0]]!r}; {expected}") if odd else None


def _kind(value: Any) -> str:
    if isinstance(value, str):
        return "text"
    return "a list" if isinstance(value, tuple | list) else "a number"


def _of_several_kinds(stated: _Stated) -> tuple[int, int, str] | None:
    kinds = dict.fromkeys(_kind(value) for value in stated.values if _is_usual(value))
    return (-1, 1, f"is {' and '.join(kinds)} alternately") if len(kinds) > 1 else None


def _static_changes(stated: _Stated) -> tuple[int, int, str] | None:
    different = [k for k, value in enumerate(stated.values) if not _same(value, stated.values[0])]
    if not stated.static or not different:
        return None
    problem = f"is static and {stated.values[0]!r}, then {stated.values[different[0]]!r}"
    return different[0], len(different), problem


def _static_repeats(stated: _Stated) -> tuple[None, int, str] | None:
    count = len(stated.values)
    if stated.static and count > 1 and all(_same(value, stated.values[0]) for value in stated.values):
        return None, 1, f"is static and reported {count} times; once is enough"
    return None


def _without_times(stated: _Stated) -> tuple[None, int, str] | None:
    count = len(stated.values)
    if not stated.static and stated.time_count is None and count > 1:
        return None, 1, f"has {count} values and no timestamps"
    if not stated.static and stated.time_count is not None and stated.time_count != count:
        return None, 1, f"has {stated.time_count} timestamps and {count} values"
    return None


def _static_once(scene: Scene) -> Scene:
    """Keep the first of the equal values of static attributes of annotations."""

    def once(one: Any) -> Any:
        if not isinstance(one, AttributePath) or not one.static or len(one.values) < 2:
            return one
        if not all(_same(value, one.values[0]) for value in one.values):
            return one
        times = None if one.timestamps_ns is None else read_only(one.timestamps_ns[:1])
        return replace(one, values=one.values[:1], timestamps_ns=times)

    def repaired(annotation: Any) -> Any:
        return with_each(annotation, "attributes", once) if hasattr(annotation, "attributes") else annotation

    return with_each(scene, "annotations", repaired)


# fmt: off
SHAPE_RULES: tuple[Rule, ...] = (
    Rule("shape-vertices", ERROR, "A polygon has three vertices or more, a polyline two, a point one.",
         "Draw the missing vertices, or remove the keyframe.", find=_of_shapes(_too_few)),
    Rule("point-of-several", WARNING, "A point has one vertex.",
         "Make a points annotation or a polyline of it.", find=_of_shapes(_several_points)),
    Rule("shape-not-finite", ERROR, "All numbers of shapes and points are finite.", "Remove the keyframe.",
         find=_not_finite),
    Rule("polygon-not-flat", WARNING,
         f"A polygon in space lies in one plane, within {_FLAT_SHARE:.0%} of its size and {_FLAT_M:g} m.",
         "Move the vertices into one plane; for an area on the ground use `polygon_topdown`.",
         find=_of_shapes(_not_flat)),
    Rule("polygon-crosses-itself", WARNING, "The edges of a polygon do not cross.",
         "Sort the vertices along the outline, or make two polygons.", find=_of_shapes(_crossing)),
    Rule("shape-vertices-pairs", WARNING, "Vertices of polygons and polylines in space are x, y, z triples.",
         "Open the file with `--vertices pairs`, and write it again.", find=_pairs_as_triples),
    Rule("vertex-count-changes", HINT,
         "A shape has equally many vertices in all keyframes, so that it is known between them.",
         "Draw the same vertices in every keyframe.", find=_counts_change),
    Rule("points-annotation-counts", ERROR,
         "A points annotation has a label and a list of projections for each point, and rows of x, y, z.",
         "Give each point its own, in the order of `paths`.", find=_counts_of_points),
    Rule("points-annotation-ids", ERROR, "The points of a points annotation have ids of their own.",
         "Rename all but one.", find=_ids_of_points),
)

ATTRIBUTE_RULES: tuple[Rule, ...] = (
    Rule("attribute-value-type", WARNING, "The value of an attribute is text, a number or a list of texts.",
         "Write truth values as text or as 0 and 1, and leave out what is not known.", find=_of_attributes(_unusual)),
    Rule("attribute-kinds-mixed", HINT, "All values of an attribute are of one kind.",
         "Write them all as text, or all as numbers.", find=_of_attributes(_of_several_kinds)),
    Rule("attribute-static-changes", WARNING, "A static attribute has one value.",
         "Remove `static`, or decide which value holds.", find=_of_attributes(_static_changes)),
    Rule("attribute-static-repeats", HINT, "A static attribute is reported once.",
         "Keep the first of the equal values.", find=_of_attributes(_static_repeats), fix=_static_once),
    Rule("attribute-times", ERROR, "An attribute that changes has a timestamp for each value.",
         "Give each value its time.", find=_of_attributes(_without_times)),
)
# fmt: on
