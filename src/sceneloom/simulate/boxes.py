"""The boxes of everything in the street, at any times and as annotations."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.simulate.movers import Mover
from sceneloom.simulate.street import Street, StreetObject

_EVERY_NS = 50_000_000
"""Distance of the samples of a moving box [ns].

Between them lines miss an acceleration a by a dt² / 8: 3 mm at 10 m/s², a car in the tightest bend, and 0.04 degrees
at 2 rad/s².
"""


@dataclass(frozen=True, slots=True, eq=False)
class BoxTruth:
    """Where every object is at T times: first those that stand, then those that move, I of them.

    Attributes:
        timestamps_ns: (T,) int64 [ns].
        instances: (I,) int64, as in instance images.
        labels: I of them.
        sizes_lwh: (I, 3) float64 [m].
        centers_world: (T, I, 3) float64 [m].
        yaws: (T, I) float64 [rad], counter-clockwise from the world's x.
        velocities: (T, I, 3) float64 [m/s], world frame.
        yaw_rates: (T, I) float64 [rad/s].
        present: (T, I) bool, whether it is in the street; elsewhere the numbers mean nothing.
    """

    timestamps_ns: Int64Array
    instances: Int64Array
    labels: tuple[str, ...]
    sizes_lwh: Float64Array
    centers_world: Float64Array
    yaws: Float64Array
    velocities: Float64Array
    yaw_rates: Float64Array
    present: BoolArray


def boxes_of(street: Street, timestamps_ns: Int64Array) -> BoxTruth:
    """Give the boxes of a street at (T,) int64 times [ns]."""
    times = np.asarray(timestamps_ns, np.int64).reshape(-1)
    things: tuple[StreetObject | Mover, ...] = (*street.objects, *street.movers.things)
    sizes = np.array([thing.size_lwh for thing in things], np.float64).reshape(-1, 3)
    count, stationary = len(times), len(street.objects)
    locations = np.array([(*thing.center_world, thing.yaw) for thing in street.objects]).reshape(-1, 4)
    which = np.arange(len(street.movers))[None, :]
    states = street.movers.states(which, times[:, None])
    lifted = states.positions + np.array([0.0, 0.0, 0.5]) * sizes[stationary:]
    still = np.zeros((count, stationary))
    return BoxTruth(
        times,
        np.array([thing.instance for thing in things], np.int64),
        tuple(thing.label for thing in things),
        sizes,
        np.concatenate([np.broadcast_to(locations[:, :3], (count, stationary, 3)), lifted], axis=1),
        np.concatenate([np.broadcast_to(locations[:, 3], (count, stationary)), states.yaws], axis=1),
        np.concatenate([np.zeros((count, stationary, 3)), states.velocities], axis=1),
        np.concatenate([still, states.yaw_rates], axis=1),
        np.concatenate([still == 0.0, street.movers.present(which, times[:, None])], axis=1),
    )


def annotations_of(street: Street, labels: Collection[str], *, start_ns: int) -> tuple[CuboidAnnotation, ...]:
    """Give a box for each object of some classes; angles in degrees.

    What moves has a path while it is in the street, sampled every 50 ms: between samples a line stays within 1 cm, up
    to an acceleration of 30 m/s², and the shortest arc within 0.1 degrees of the truth. Samples lie on `start_ns` and
    all multiples of their distance.
    """
    stationary = tuple(
        _annotation(thing, np.array([start_ns], np.int64), [(*thing.center_world, thing.yaw)], stands=True)
        for thing in street.objects
        if thing.label in labels
    )
    return stationary + tuple(_moving(street, k, start_ns) for k in range(len(street.movers)))


def _moving(street: Street, k: int, start_ns: int) -> CuboidAnnotation:
    thing = street.movers.things[k]
    timestamps = np.array([start_ns], np.int64) if thing.stands else _samples(thing, start_ns)
    states = street.movers.states(np.full(len(timestamps), k), timestamps)
    heights = np.full(len(timestamps), 0.5 * thing.size_lwh[2])
    locations = np.column_stack([states.positions[:, :2], heights, states.yaws])
    return _annotation(thing, timestamps, locations, stands=thing.stands)


def _samples(thing: Mover, start_ns: int) -> Int64Array:
    """Times while it is in the street, its first and last included."""
    first, last = (-(-(thing.first_ns - start_ns) // _EVERY_NS), (thing.last_ns - start_ns) // _EVERY_NS)
    inner = start_ns + _EVERY_NS * np.arange(first, last + 1, dtype=np.int64)
    return np.unique(np.concatenate([[thing.first_ns], inner, [thing.last_ns]])).astype(np.int64)


def _annotation(
    thing: StreetObject | Mover, timestamps: Int64Array, locations: ArrayLike, *, stands: bool
) -> CuboidAnnotation:
    """A box from x, y, z and yaw (T, 4)."""
    x_y_z_yaw = np.asarray(locations, np.float64)
    values = np.zeros((len(timestamps), 9))
    values[:, :3], values[:, 3:6] = thing.size_lwh, x_y_z_yaw[:, :3]
    values[:, 8] = np.degrees(x_y_z_yaw[:, 3])
    return CuboidAnnotation(
        f"{thing.label}-{thing.instance}",
        CuboidPath(timestamps, values),
        label=thing.label,
        stationary=stands,
    )
