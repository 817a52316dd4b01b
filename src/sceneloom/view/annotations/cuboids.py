"""Cuboids with the trajectory that each has come."""

from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.at import CuboidPoses, cuboid_poses
from sceneloom.view.annotations.rows import Group, by_moment, chosen_by_moment, name_of
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import fits

HISTORY_NS = 3_000_000_000
"""So much of an object's trajectory trails behind it [ns]."""
TRAIL_WIDTH = -1.5
"""Negative widths are points of the screen, not metres."""
_MOVED = 0.5
"""What moved less than that in all has no trail [m]."""
_POINTS_OF_TRAIL = 24


EDGES = "majorwireframe"
"""Boxes are drawn as their edges: what is in them stays in view."""


def edges_only() -> Any:
    """What makes boxes be drawn as edges, for an entity that is given boxes over time."""
    return sdk().Boxes3D.from_fields(fill_mode=EDGES)


@dataclass(frozen=True, slots=True, eq=False)
class CuboidLayer:
    """Shows cuboids of one class that are there for a time.

    Attributes:
        group: the cuboids and their entity.
        angles: how their angles are meant.
        origin: (3,) float64 [m], what is taken off locations.
    """

    group: Group
    angles: CuboidAngles
    origin: Float64Array

    def log(self, times_ns: Int64Array) -> None:
        """Log boxes and trails at times (M,) [ns]."""
        group = self.group
        poses = [cuboid_poses(one, times_ns, angles=self.angles) for one in group.annotations]
        held = np.array([_held(p, self.origin) for p in poses])
        there = np.array([p.there for p in poses])
        group.stream.leave_out("cuboid moments", np.count_nonzero(there & ~held))
        there &= held
        centers = by_moment(np.array([p.centers_world for p in poses]) - self.origin, there)
        boxes = sdk().Boxes3D.columns(
            centers=centers,
            half_sizes=by_moment(np.array([p.sizes_lwh for p in poses]), there) / 2,
            quaternions=by_moment(np.array([p.quaternions_xyzw for p in poses]), there),
            colors=np.full(len(centers), group.colour, np.uint32),
            labels=chosen_by_moment([name_of(one) for one in group.annotations], there),
        )
        cut = boxes.partition(there.sum(axis=0))
        group.stream.static(group.path, edges_only())
        group.stream.columns(times_ns, group.path, cut, group.details(there, times_ns), kind="cuboid moments")
        self._trails(times_ns, there)

    def _trails(self, times_ns: Int64Array, there: BoolArray) -> None:
        moving = [a for a, one in enumerate(self.group.annotations) if _moves(one)]
        strips: list[Float64Array] = []
        counts = np.zeros(len(times_ns), np.int64)
        for m, time_ns in enumerate(times_ns.tolist()):
            trails = [self._trail(a, time_ns) for a in moving if there[a, m]]
            lines = [strip - self.origin for strip in trails]
            long = [line for line in (line[fits(line)] for line in lines) if len(line) > 1]
            strips += long
            counts[m] = len(long)
        if moving:
            drawn = sdk().LineStrips3D.columns(
                strips=strips,
                colors=np.full(len(strips), self.group.colour, np.uint32),
                radii=np.full(len(strips), TRAIL_WIDTH, np.float32),
            )
            self.group.stream.columns(times_ns, f"{self.group.path}/trails", drawn.partition(counts))

    def _trail(self, a: int, time_ns: int) -> Float64Array:
        path = self.group.annotations[a].path
        return trail(path.timestamps_ns, path.values[:, 3:6], time_ns)


def _held(poses: CuboidPoses, origin: Float64Array) -> BoolArray:
    """Which moments the viewer can hold, (M,)."""
    rotated = fits(poses.quaternions_xyzw)
    return np.asarray(fits(poses.centers_world - origin) & fits(poses.sizes_lwh) & rotated, np.bool_)


def _moves(annotation: CuboidAnnotation) -> bool:
    locations = annotation.path.values[:, 3:6]
    finite = locations[np.isfinite(locations).all(axis=1)]
    return len(finite) > 1 and bool(np.ptp(finite, axis=0).max() > _MOVED)


def trail(timestamps_ns: Int64Array, locations: Float64Array, time_ns: int) -> Float64Array:
    """The last part (K, 3) [m] of a trajectory up to a time [ns], thinned to what shows.

    Args:
        timestamps_ns: (N,) int64 [ns], ascending.
        locations: (N, 3) [m].
        time_ns: the end.
    """
    start, stop = np.searchsorted(timestamps_ns, [time_ns - HISTORY_NS, time_ns + 1])
    count = min(_POINTS_OF_TRAIL, int(stop - start))
    rows = np.unique(np.linspace(start, stop - 1, max(count, 0)).astype(np.int64))
    part = locations[rows]
    return part[np.isfinite(part).all(axis=1)]


def stands(annotation: CuboidAnnotation) -> bool:
    """Whether a cuboid is there at all times in one location, with attributes that do not change."""
    fixed = all(not attribute.is_timed for attribute in annotation.attributes)
    return bool(annotation.stationary) and len(annotation.path.timestamps_ns) == 1 and fixed


def show_stationary(group: Group, angles: CuboidAngles, origin: Float64Array) -> None:
    """Show cuboids that stand."""
    timestamps = [one.path.timestamps_ns[:1] for one in group.annotations]
    poses = [
        cuboid_poses(one, t, angles=angles) for one, t in zip(group.annotations, timestamps, strict=True)
    ]
    held = [bool(_held(p, origin).all()) for p in poses]
    group.stream.leave_out("stationary cuboids", held.count(False))
    group = replace(group, annotations=tuple(compress(group.annotations, held)))
    poses = list(compress(poses, held))
    if not poses:
        return
    boxes = sdk().Boxes3D(
        centers=np.concatenate([p.centers_world for p in poses]) - origin,
        half_sizes=np.concatenate([p.sizes_lwh for p in poses]) / 2,
        quaternions=np.concatenate([p.quaternions_xyzw for p in poses]),
        colors=np.full(len(poses), group.colour, np.uint32),
        labels=[name_of(one) for one in group.annotations],
        show_labels=False,
        fill_mode=EDGES,
    )
    group.stream.static(group.path, boxes, group.lasting_details())
    group.stream.count("stationary cuboids", len(poses))
