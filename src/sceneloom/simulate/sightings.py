"""What a detector could see of the objects of some classes: where they are, and how much hides them."""

from collections.abc import Collection

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.scene import Boxes3D, PointsFrame
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast, instances_of
from sceneloom.simulate.street import Street

_GRID = (7, 5, 5)
"""Lines of sight to an object along its length, width and height."""
_INNER = 0.84
"""They end within this share of its box, whose rim is mostly air."""


def objects_at(street: Street, time_ns: int, labels: Collection[str]) -> tuple[Boxes3D, Int64Array]:
    """Give the exact boxes of all objects of some classes, in the world frame with score 1, and their instances."""
    stands = [thing for thing in street.objects if thing.label in labels]
    movers = street.movers
    there = (
        movers.present(np.arange(len(movers)), np.array(time_ns, np.int64))
        if len(movers)
        else np.zeros(0, np.bool_)
    )
    which = np.array([k for k in np.flatnonzero(there) if movers.things[k].label in labels], np.int64)
    moving, states = [movers.things[k] for k in which], movers.states(which, np.full(len(which), time_ns))
    sizes = np.array([thing.size_lwh for thing in (*stands, *moving)], np.float64).reshape(-1, 3)
    centers = np.array([thing.center_world for thing in stands], np.float64).reshape(-1, 3)
    feet = states.positions + np.array([0.0, 0.0, 0.5]) * sizes[len(stands) :]
    boxes = Boxes3D(
        time_ns,
        np.concatenate([centers, feet]),
        sizes,
        np.concatenate([[thing.yaw for thing in stands], states.yaws]),
        np.ones(len(sizes)),
        tuple(thing.label for thing in (*stands, *moving)),
        velocities=np.concatenate([np.zeros_like(centers), states.velocities]),
        frame=PointsFrame.WORLD,
    )
    return boxes, np.array([thing.instance for thing in (*stands, *moving)], np.int64)


def occlusions_from(
    street: Street, origin_world: Float64Array, objects: Boxes3D, instances: Int64Array
) -> Float64Array:
    """Estimate which share of each object is hidden from a place, at the time of the boxes.

    Of the lines of sight into its box, those count that end on the object or before they come near it.

    Args:
        street: with everything that can hide something.
        origin_world: (3,) float64 [m], where one looks from.
        objects: their boxes in the world frame.
        instances: (N,) int64, which they are.

    Returns:
        (N,) float64, 0 in plain view to 1.
    """
    if len(objects) == 0:
        return np.zeros(0)
    distances, hits_range, hit = _looked_at(street, origin_world, objects)
    radii = np.linalg.norm(objects.sizes_lwh, axis=1)[:, None] / 2
    own: BoolArray = hit == instances[:, None]
    before = ~own & (hits_range > 0.0) & (hits_range < distances - radii)
    counted = own.sum(axis=1) + before.sum(axis=1)
    shares: Float64Array = before.sum(axis=1) / np.maximum(1, counted)
    return shares


def _looked_at(
    street: Street, origin_world: Float64Array, objects: Boxes3D
) -> tuple[Float64Array, Float64Array, Int64Array]:
    """Distance to the objects [m] (N, 1), and range [m] and instance of what is met on lines into them (N, R)."""
    steps = [_INNER * ((np.arange(count) + 0.5) / count - 0.5) for count in _GRID]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    inner = grid * objects.sizes_lwh[:, None]
    cosine, sine = np.cos(objects.yaws)[:, None], np.sin(objects.yaws)[:, None]
    turned = (cosine * inner[..., 0] - sine * inner[..., 1], sine * inner[..., 0] + cosine * inner[..., 1])
    ends = objects.centers[:, None] + np.stack([*turned, inner[..., 2]], axis=-1)
    apart = (ends - origin_world).reshape(-1, 3)
    directions = apart / np.maximum(1e-9, np.linalg.norm(apart, axis=1))[:, None]
    distances = np.linalg.norm(objects.centers - origin_world, axis=1)[:, None]
    rays = Rays.bundled(directions, bundles_by_direction(directions))
    times = np.array([objects.timestamp_ns], np.int64)
    hits = cast(
        street, rays, np.eye(3)[None], origin_world[None].copy(), times, reach=float(distances.max()) + 20.0
    )
    shape = (len(objects), len(grid))
    return distances, hits.ranges.reshape(shape), instances_of(street, hits).astype(np.int64).reshape(shape)
