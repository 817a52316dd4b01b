"""Which keyframes a path needs in another frame, so that it is true at the frames between them, too."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import radians
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.geometry.interpolation import thin_poses
from sceneloom.geometry.rotations import multiply_quaternions
from sceneloom.scene.types import Identifier

LOCATION_TOLERANCE, ROTATION_TOLERANCE = 1e-3, radians(0.01)
"""A keyframe is added at a frame's time where without it something would be further off then [m], [rad]."""

PathKey = tuple[type, Identifier, int]
"""A path of an annotation: type of its id, its id, number of the path among those of its points."""

ROUNDED_NS = 500
"""How far rounding to microseconds, the coarsest unit of files, moves a timestamp [ns]."""

Sampler = Callable[[Int64Array], tuple[Float64Array, Float64Array | None]]
"""Gives, at times (M,), locations (M, V, 3) [m] in the old frame that shall be true, and a rotation (M, 4) or None."""


@dataclass(frozen=True, slots=True)
class AddedKeyframes:
    """What a path got because it moves otherwise in the new frame.

    Attributes:
        timestamps_ns: of the added keyframes.
        stationary: whether it was stationary in the old frame.
    """

    timestamps_ns: tuple[int, ...]
    stationary: bool


@dataclass(slots=True)
class KeyframeStatistics:
    """What became of paths.

    Attributes:
        added: keyframes that were added, by path; of every path where the change is not constant.
        left_out: how many were left out, since the change is not known at their times.
    """

    added: dict[PathKey, AddedKeyframes] = field(default_factory=dict)
    left_out: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Keyframer:
    """Chooses the keyframes of paths in another frame.

    Attributes:
        change: `new_from_old`.
        span_ns: what is stationary in the old frame moves in the new one: it gets keyframes from the first to the last
            of these times. None: it is stationary in both.
        looks_ns: (L,) int64 [ns], ascending, when paths shall be true besides at their keyframes: the times of the
            scene's frames, since annotations are about what these show.
        added_before: what an earlier change added, to be taken away again.
        statistics: reported all choices.
    """

    change: FrameChange
    span_ns: tuple[int, int] | None = None
    looks_ns: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    added_before: Mapping[PathKey, AddedKeyframes] = field(default_factory=lambda: MappingProxyType({}))
    statistics: KeyframeStatistics = field(default_factory=KeyframeStatistics)

    def own_rows(self, path: PathKey, timestamps_ns: Int64Array) -> Int64Array:
        """The rows of a path without those that an earlier change added; one where no others are left."""
        before = self.added_before.get(path)
        if before is None:
            return np.arange(len(timestamps_ns))
        own = np.flatnonzero(~_near(timestamps_ns, np.array(before.timestamps_ns, np.int64)))
        return own if len(own) else np.arange(min(1, len(timestamps_ns)))

    def stationary(self, path: PathKey, *, was: bool | None) -> bool | None:
        """Whether what was stationary, or did not, is stationary in the new frame."""
        before = self.added_before.get(path)
        if before is not None and before.stationary:
            return True
        return False if was and self._sets_moving else was

    @property
    def _sets_moving(self) -> bool:
        return self.span_ns is not None and not self.change.is_constant

    def times(
        self, path: PathKey, timestamps_ns: Int64Array, *, stationary: bool, sample: Sampler
    ) -> Int64Array:
        """Give the times (K,) int64 [ns] of the keyframes in the new frame, ascending; none where it is not known.

        Args:
            path: which one.
            timestamps_ns: (N,) its keyframes in the old frame, in order.
            stationary: whether it is stationary in the old frame.
            sample: where it is in the old frame.
        """
        moving = stationary and self._sets_moving
        times = self._within_span(timestamps_ns) if moving else np.unique(timestamps_ns)
        times = times[self.change.at(times).coverage <= KNOWN]
        # what an earlier change took apart is put together as it was
        looks = times if path in self.added_before else self._looks(times)
        if len(looks) > len(times):
            times = np.union1d(times, looks[self._bends(looks, times, sample)])
        added = np.setdiff1d(times, timestamps_ns)
        if not moving:
            self.statistics.left_out += len(np.setdiff1d(timestamps_ns, times))
        if not self.change.is_constant:
            self.statistics.added[path] = AddedKeyframes(tuple(added.tolist()), moving)
        return times

    def _within_span(self, timestamps_ns: Int64Array) -> Int64Array:
        """The span's ends and the keyframes between them."""
        span = np.array(self.span_ns, np.int64)
        return np.union1d(span, timestamps_ns[(timestamps_ns >= span[0]) & (timestamps_ns <= span[1])])

    def _looks(self, times_ns: Int64Array) -> Int64Array:
        """These times, and those of the scene's frames between the first and the last of them."""
        if self.change.is_constant or len(times_ns) < 2:
            return times_ns
        looks = self.looks_ns
        return np.union1d(times_ns, looks[(looks > times_ns[0]) & (looks < times_ns[-1])])

    def _bends(self, looks_ns: Int64Array, required_ns: Int64Array, sample: Sampler) -> Int64Array:
        """Rows of the looks that are needed besides the required times."""
        locations, rotations = sample(looks_ns)
        change = self.change.at(looks_ns)
        known = np.flatnonzero(change.coverage <= KNOWN)
        new = self.change.locations(looks_ns[known], locations[known])
        quaternions = change.quaternions_xyzw[known] * 0.0 + (0.0, 0.0, 0.0, 1.0)
        if rotations is not None:
            quaternions = multiply_quaternions(change.quaternions_xyzw[known], rotations[known])
        rows = [
            thin_poses(
                looks_ns[known],
                np.ascontiguousarray(new[:, vertex]),
                quaternions,
                required_ns,
                position_tolerance=LOCATION_TOLERANCE,
                rotation_tolerance=ROTATION_TOLERANCE,
            )
            for vertex in range(new.shape[1])
        ]
        return known[np.unique(np.concatenate(rows))] if rows else known[:0]


def _near(timestamps_ns: Int64Array, others_ns: Int64Array) -> BoolArray:
    """Report which timestamps are one of the others, as a file of microseconds may have rounded it."""
    others = np.sort(others_ns)
    near = np.zeros(len(timestamps_ns), np.bool_)
    after = np.searchsorted(others, timestamps_ns)
    for locations in (after - 1, after):
        there = np.flatnonzero((locations >= 0) & (locations < len(others)))
        near[there] |= np.abs(timestamps_ns[there] - others[locations[there]]) <= ROUNDED_NS
    return near
