"""Objects followed through time: what a tracker reports each, and of all at one time."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import (
    AnyArray,
    Float64Array,
    Int64Array,
    UInt8Array,
    check_array,
    hold_array,
    hold_timestamp,
    read_only,
)
from sceneloom.errors import ArrayError
from sceneloom.scene.types import Identifier


class Support(IntEnum):
    """What a state of a track rests on at its time."""

    BOTH = 0
    """A box of a sweep and one of an image."""
    SWEEP = 1
    """A box of a sweep alone."""
    IMAGE = 2
    """A box of an image alone."""
    PREDICTED = 3
    """No box: where its motion leads it."""
    INTERPOLATED = 4
    """No box: between boxes before and after."""


_STATE = {
    "centers": (3,),
    "sizes_lwh": (3,),
    "yaws": (),
    "velocities": (3,),
    "yaw_rates": (),
    "covariances": (10, 10),
    "scores": (),
}
"""The float64 columns of states, and the shape of a row."""


def _check_states(states: "Track | TrackedObjects", count: int, location: str) -> None:
    for name, shape in _STATE.items():
        hold_array(states, f"{location}.{name}", (count, *shape), np.float64)
    hold_array(states, f"{location}.supports", (count,), np.uint8)
    for camera_id, corners in states.corners_xyxy.items():
        check_array(f"{location}.corners_xyxy[{camera_id!r}]", corners, (count, 4), np.float64)


def _freeze(states: "Track | TrackedObjects", names: tuple[str, ...]) -> None:
    for name in (*_STATE, "supports", *names):
        value: AnyArray = getattr(states, name)
        object.__setattr__(states, name, read_only(value))
    corners = {camera_id: read_only(corners) for camera_id, corners in states.corners_xyxy.items()}
    object.__setattr__(states, "corners_xyxy", MappingProxyType(corners))


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One object through time, in the world frame.

    Attributes:
        id: of the object, the same through the drive.
        label: its class.
        timestamps_ns: (K,) int64 [ns], rising.
        centers: (K, 3) float64 [m].
        sizes_lwh: (K, 3) float64 [m], length, width and height.
        yaws: (K,) float64 [rad], heading about the world's z axis, counter-clockwise from its x axis.
        velocities: (K, 3) float64 [m/s] over ground.
        yaw_rates: (K,) float64 [rad/s].
        covariances: (K, 10, 10) float64 of center, size, yaw and velocity in this order.
        scores: (K,) float64, 0 to 1: probability that the object exists, at that time.
        supports: (K,) uint8 of `Support`.
        corners_xyxy: by camera, (K, 4) float64 [px] in the corner convention, NaN where no box of that camera's image
            is the object's.

    Raises:
        ArrayError: shapes or dtypes are wrong, or times do not rise.
    """

    id: int
    label: str
    timestamps_ns: Int64Array
    centers: Float64Array
    sizes_lwh: Float64Array
    yaws: Float64Array
    velocities: Float64Array
    yaw_rates: Float64Array
    covariances: Float64Array
    scores: Float64Array
    supports: UInt8Array
    corners_xyxy: Mapping[Identifier, Float64Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = hold_array(self, "track.timestamps_ns", (None,), np.int64)
        _check_states(self, count, "track")
        if (np.diff(self.timestamps_ns) <= 0).any():
            raise ArrayError(f"track {self.id}: timestamps_ns do not rise")
        _freeze(self, ("timestamps_ns",))

    def __len__(self) -> int:
        return len(self.timestamps_ns)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedObjects:
    """All objects that a tracker believes in at one time, in the world frame.

    Attributes:
        timestamp_ns: the time [ns].
        ids: (N,) int64, of the objects.
        labels: N classes.
        centers, sizes_lwh, yaws, velocities, yaw_rates, covariances, scores, supports, corners_xyxy: as of `Track`, a
            row for each object.

    Raises:
        ArrayError: shapes or dtypes are wrong.
    """

    timestamp_ns: int
    ids: Int64Array
    labels: tuple[str, ...]
    centers: Float64Array
    sizes_lwh: Float64Array
    yaws: Float64Array
    velocities: Float64Array
    yaw_rates: Float64Array
    covariances: Float64Array
    scores: Float64Array
    supports: UInt8Array
    corners_xyxy: Mapping[Identifier, Float64Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        hold_timestamp(self, "objects.timestamp_ns")
        count = hold_array(self, "objects.ids", (None,), np.int64)
        _check_states(self, count, "objects")
        if len(self.labels) != count:
            raise ArrayError(f"objects.labels: {len(self.labels)}; expected {count}")
        _freeze(self, ("ids",))

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Tracks:
    """The objects of a drive.

    Attributes:
        tracks: each once, in the order of their ids.
    """

    tracks: tuple[Track, ...]

    def __len__(self) -> int:
        return len(self.tracks)

    def __iter__(self) -> Iterator[Track]:
        return iter(self.tracks)

    def __getitem__(self, k: int) -> Track:
        return self.tracks[k]
