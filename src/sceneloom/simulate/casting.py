"""Rays of a sensor cast into the street."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.simulate import street as simulate_street
from sceneloom.simulate.painting import paint_rays
from sceneloom.simulate.raycast import SKY, count_silhouettes, trace_rays
from sceneloom.simulate.street import Street

SKY_INSTANCE, GROUND_INSTANCE = -1, 0
"""What instance images state where there is no object."""

_WORKERS = 16  # rows that count at the same time

_BLOCK, _SHARES = 64, 8
"""Bundles are dealt out in blocks (a row of tiles or so) to this many shares, so that threads finish together."""


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Directions in a sensor's frame, sorted into bundles of neighbours.

    Attributes:
        directions: (N, 3) float64, unit.
        pose_of_ray: (N,) int32, which of the sensor's poses a ray starts from.
        bundle_starts: (B + 1,) int64, the first ray of each bundle and N.
        slots: (N,) int64, where a ray's answer goes.
        slot_count: length of the answers; slots without a ray stay empty.
    """

    directions: Float64Array
    pose_of_ray: AnyArray
    bundle_starts: Int64Array
    slots: Int64Array
    slot_count: int

    @classmethod
    def bundled(
        cls, directions: Float64Array, bundle_of_ray: Int64Array, *, pose_of_ray: Int64Array | None = None
    ) -> "Rays":
        """Sort rays by the bundle they belong to; rays that are not finite are left out.

        Args:
            directions: (N, 3) float64, unit; ray k answers in slot k.
            bundle_of_ray: (N,) int64, any numbers, equal for neighbours.
            pose_of_ray: (N,) int64, None where all rays share one pose.
        """
        used = np.flatnonzero(np.isfinite(directions).all(axis=1))
        _, bundle = np.unique(bundle_of_ray[used], return_inverse=True)
        bundle = bundle + (bundle // _BLOCK % _SHARES) * len(directions)
        rotation = np.argsort(bundle, kind="stable")
        order, edges = used[rotation], np.flatnonzero(np.diff(bundle[rotation])) + 1
        starts = np.concatenate([[0], edges, [len(order)]]) if len(order) else np.zeros(1)
        poses = np.zeros(len(order)) if pose_of_ray is None else pose_of_ray[order]
        return cls(
            np.ascontiguousarray(directions[order], np.float64),
            poses.astype(np.int32),
            starts.astype(np.int64),
            order.astype(np.int64),
            len(directions),
        )

    def spread(self) -> Float64Array:
        """The directions by slot, (slot_count, 3) float64; undefined in slots without a ray."""
        directions = np.empty((self.slot_count, 3))
        directions[self.slots] = self.directions
        return directions


@dataclass(frozen=True, slots=True, eq=False)
class Moving:
    """What is near a sensor, and where it is at each of its poses if it moves.

    Attributes:
        frame_of_shape: (P,) int32, for each body of the street the column of `frames`, -1 where it is stationary or is
            too far away.
        frames: (M, F, 3, 4) float64 `frame_from_world`.
        spheres: (P, 4) float64 [m], balls that hold the bodies at all of the poses' times.
        candidates: (C,) int32, the bodies that are near enough.
    """

    frame_of_shape: AnyArray
    frames: Float64Array
    spheres: Float64Array
    candidates: AnyArray


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What rays met, one answer per slot.

    Attributes:
        ranges: (S,) float64 [m], 0 where nothing was met.
        shapes: (S,) int32, number of the shape among the street's bodies, or `GROUND` or `SKY` of the ray caster.
        moving: where what moves was at the times of the rays.
    """

    ranges: Float64Array
    shapes: AnyArray
    moving: Moving


@dataclass(frozen=True, slots=True, eq=False)
class Paint:
    """How the met surfaces look, one answer per slot.

    Attributes:
        colors: (S, 3) uint8.
        facings: (S,) float32, cosine between ray and normal, 0 where nothing was met.
    """

    colors: UInt8Array
    facings: Float32Array


def cast(
    street: Street, rays: Rays, rotations: Float64Array, origins: Float64Array, times_ns: Int64Array, *, reach: float
) -> Hits:
    """Find what each ray meets first.

    Args:
        rotations: (M, 3, 3) float64 `world_from_sensor`, one per pose.
        origins: (M, 3) float64 [m], world frame.
        times_ns: (M,) int64 [ns], when each pose holds: what moves is met where it is then.
        reach: how far the rays go [m].
    """
    ranges = np.zeros(rays.slot_count)
    shapes = np.full(rays.slot_count, SKY, np.int32)
    bodies = street.bodies
    moving = _moving(street, origins, times_ns, reach=reach)
    trace_rays(
        rays.directions,
        rays.pose_of_ray,
        np.ascontiguousarray(rotations, np.float64),
        np.ascontiguousarray(origins, np.float64),
        rays.bundle_starts,
        rays.slots,
        bodies.kinds,
        bodies.maps,
        moving.frame_of_shape,
        moving.frames,
        moving.spheres,
        moving.candidates,
        float(reach),
        ranges,
        shapes,
    )
    return Hits(ranges, shapes, moving)


def silhouettes(
    street: Street, rays: Rays, rotations: Float64Array, origins: Float64Array, times_ns: Int64Array, *, reach: float
) -> Int64Array:
    """Count for each object, whatever stands or moves, the rays that would meet it if it were alone.

    Args:
        rotations, origins, times_ns, reach: as in `cast`.

    Returns:
        (I,) int64, by instance number - 1.
    """
    bodies = street.bodies
    moving = _moving(street, origins, times_ns, reach=reach)
    counts = np.zeros((_WORKERS, len(street.objects) + len(street.movers)), np.int64)
    count_silhouettes(
        rays.directions,
        rays.pose_of_ray,
        np.ascontiguousarray(rotations, np.float64),
        np.ascontiguousarray(origins, np.float64),
        rays.bundle_starts,
        bodies.kinds,
        bodies.maps,
        (bodies.instances - 1).astype(np.int32),
        moving.frame_of_shape,
        moving.frames,
        moving.spheres,
        moving.candidates,
        float(reach),
        counts,
    )
    totals: Int64Array = counts.sum(axis=0)
    return totals


def _moving(street: Street, origins: Float64Array, times_ns: Int64Array, *, reach: float) -> Moving:
    """Find what rays of a length can meet from origins (M, 3) at (M,) times, and where what moves is then."""
    middle = origins.mean(axis=0)
    within = reach + float(np.linalg.norm(origins - middle, axis=1).max())
    movers, first = street.movers, len(street.shapes)
    frame_of_shape = np.full(len(street.bodies), -1, np.int32)
    frames, spheres = np.zeros((len(times_ns), 0, 3, 4)), street.bodies.spheres
    candidates = np.flatnonzero(np.linalg.norm(spheres[:first, :3] - middle, axis=1) < within + spheres[:first, 3])
    near = movers.near(middle, times_ns, within=within)
    if len(near):
        placed = movers.placed(near, times_ns)
        frames, spheres = placed.frames, spheres.copy()
        frame_of_shape[first + placed.shapes] = placed.frame_of_shape
        spheres[first + placed.shapes] = placed.spheres
        candidates = np.concatenate([candidates, first + placed.shapes])
    return Moving(frame_of_shape, frames, spheres, candidates.astype(np.int32))


def paint(
    street: Street, rays: Rays, rotations: Float64Array, origins: Float64Array, hits: Hits, *, pixel_angle: float = 0.0
) -> Paint:
    """Colour what the rays met, with the poses that they were cast with.

    Args:
        rotations, origins: as in `cast`; what moves stays where `hits` found it.
        pixel_angle: width of a ray [rad], 0 for the bare surface.
    """
    colors = np.zeros((rays.slot_count, 3), np.uint8)
    facings = np.zeros(rays.slot_count, np.float32)
    shapes = street.bodies
    paint_rays(
        rays.directions,
        rays.pose_of_ray,
        np.ascontiguousarray(rotations, np.float64),
        np.ascontiguousarray(origins, np.float64),
        rays.slots,
        hits.ranges,
        hits.shapes,
        shapes.kinds,
        shapes.maps,
        hits.moving.frame_of_shape,
        hits.moving.frames,
        shapes.halves,
        shapes.patterns,
        shapes.palettes,
        shapes.measures,
        shapes.instances,
        street.ground.nodes,
        street.ground.corner,
        street.ground.cell,
        np.array(simulate_street.PALETTE, np.float64),
        float(pixel_angle),
        colors,
        facings,
    )
    return Paint(colors, facings)


def instances_of(street: Street, hits: Hits) -> AnyArray:
    """Give the instance number of each hit, (S,) int32."""
    numbers = np.append(street.bodies.instances, [SKY_INSTANCE, GROUND_INSTANCE]).astype(np.int32)
    # The ray caster's SKY and GROUND are -2 and -1, so they index the two entries at the end.
    return numbers[hits.shapes]


def bundles_by_direction(directions: Float64Array, *, across: int = 64) -> Int64Array:
    """Put unit directions (N, 3) that point nearly the same way under one number: cells of a cube's faces."""
    largest = np.argmax(np.abs(directions), axis=1)
    rows = np.arange(len(directions))
    scaled = directions / np.maximum(1e-300, np.abs(directions[rows, largest]))[:, None]
    cells = np.clip(((scaled + 1.0) * (0.5 * across)).astype(np.int64), 0, across - 1)
    face = 2 * largest + (directions[rows, largest] > 0)
    a, b = cells[rows, (largest + 1) % 3], cells[rows, (largest + 2) % 3]
    numbers: Int64Array = (face * across + a) * across + b
    return numbers
