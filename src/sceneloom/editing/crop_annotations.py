"""Which annotations stay when a scene is cropped in space."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.editing.region import Placed, ever_held
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations.keypoints import PointsAnnotation, locations_of
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.at import cuboid_at, point_at, shape_at


@dataclass(frozen=True, slots=True, eq=False)
class SpaceCrop:
    """Keeps the annotations that lie in a region at some time.

    Attributes:
        alternatives: the region around the world, the ego, or each of the sensors.
        times_ns: (T,) int64 [ns], ascending: of the scene's frames. A thing is looked at at these and at its keyframes.
        angles: how the angles of cuboids are meant.
    """

    alternatives: tuple[tuple[Placed, ...], ...]
    times_ns: Int64Array
    angles: CuboidAngles

    def __call__(self, annotation: Annotation) -> Annotation | None:
        """Give the annotation, its path cut if it is a cuboid; None where it is never inside."""
        crop = next((crop for kind, crop in _CROPS.items() if isinstance(annotation, kind)), None)
        return annotation if crop is None else crop(self, annotation)

    def looks(self, timestamps_ns: Int64Array, *, stationary: bool) -> Int64Array:
        """The times at which a path is looked at."""
        times = self.times_ns
        if not stationary:
            times = times[(times >= timestamps_ns.min()) & (times <= timestamps_ns.max())]
        return np.union1d(timestamps_ns, times)

    def inside(self, times_ns: Int64Array, locations: Float64Array) -> BoolArray:
        """Report at which times a thing with vertices (M, V, 3) is inside."""
        return ever_held(self.alternatives, times_ns, locations)


def _cropped_cuboid(crop: SpaceCrop, annotation: CuboidAnnotation) -> CuboidAnnotation | None:
    path, stationary = annotation.path, bool(annotation.stationary)
    if len(path.timestamps_ns) == 0:
        return annotation
    times = crop.looks(path.timestamps_ns, stationary=stationary)
    centers = cuboid_at(annotation, times, angles=crop.angles)[0][:, 3:6]
    inside = np.flatnonzero(crop.inside(times, centers[:, None]))
    if len(inside) == 0:
        return None
    if stationary or len(inside) == len(times):
        return annotation
    timestamps_ns = path.timestamps_ns
    # one keyframe before and one after, so that nothing changes in between
    first = max(int(np.searchsorted(timestamps_ns, times[inside[0]], side="right")) - 1, 0)
    last = min(int(np.searchsorted(timestamps_ns, times[inside[-1]])), len(timestamps_ns) - 1)
    cut = CuboidPath(timestamps_ns[first : last + 1], path.values[first : last + 1], path.extras)
    return replace(
        annotation,
        path=cut,
        activations=tuple(_between(entry, cut.timestamps_ns) for entry in annotation.activations),
        projections=tuple(_between(entry, cut.timestamps_ns) for entry in annotation.projections),
    )


def _between(entry: Any, timestamps_ns: Int64Array) -> Any:
    """Of an activation or a projection what lies between the first and the last keyframe."""
    kept = (entry.timestamps_ns >= timestamps_ns[0]) & (entry.timestamps_ns <= timestamps_ns[-1])
    rows = np.flatnonzero(kept)
    chosen: dict[str, Any] = {"timestamps_ns": entry.timestamps_ns[rows]}
    for name in ("durations_ns", "cuboids", "boxes", "confirmed"):
        values = getattr(entry, name, None)
        if values is not None:
            chosen[name] = (
                tuple(values[row] for row in rows.tolist()) if isinstance(values, tuple) else values[rows]
            )
    return replace(entry, **chosen)


def _cropped_shape(crop: SpaceCrop, annotation: ShapeAnnotation) -> ShapeAnnotation | None:
    timestamps_ns = annotation.path.timestamps_ns
    if annotation.dimensions == 2 or len(timestamps_ns) == 0:
        return annotation
    times = crop.looks(timestamps_ns, stationary=bool(annotation.stationary))
    found = shape_at(annotation, times)
    widest = max((len(vertices) for vertices in found if vertices is not None), default=0)
    locations = np.full((len(times), widest, 3), np.nan)
    for row, vertices in zip(locations, found, strict=True):
        if vertices is not None:
            row[: len(vertices)] = vertices
    return annotation if crop.inside(times, locations).any() else None


def _cropped_points(crop: SpaceCrop, annotation: PointsAnnotation) -> PointsAnnotation | None:
    stationary = bool(annotation.stationary)
    placed = [p for p in annotation.paths if len(p.timestamps_ns) and p.values.shape[1] % 3 == 0]
    for path in placed:
        times = crop.looks(path.timestamps_ns, stationary=stationary)
        locations = locations_of(point_at(path, times, stationary=stationary)[0])
        if crop.inside(times, locations).any():
            return annotation
    return None if placed else annotation


_CROPS: Mapping[type, Callable[[SpaceCrop, Any], Annotation | None]] = MappingProxyType(
    {CuboidAnnotation: _cropped_cuboid, ShapeAnnotation: _cropped_shape, PointsAnnotation: _cropped_points}
)
"""How the annotations that have a location in space are cropped; the others stay."""
