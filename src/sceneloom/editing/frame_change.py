"""From one frame into another over time, through a frame that both are known in."""

from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    rotate_vectors,
)
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses, PoseSamples

KNOWN = 1
"""Greatest coverage of a pose that is used: inside its path, or extrapolated within reach."""


_MOST_REMEMBERED = 16
"""Series of times whose changes are kept for the next time they are asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameChange:
    """`new_from_old` over time.

    Attributes:
        hub_from_old: where the old frame is in the one between; None where it is that one.
        hub_from_new: the same of the new frame.
        held: beyond the ends of a path its end poses hold, instead of nothing.
    """

    hub_from_old: PoseSource | None = None
    hub_from_new: PoseSource | None = None
    held: bool = False
    _remembered: dict[bytes, PoseSamples] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def constant(cls, new_from_old: RigidTransform) -> "FrameChange":
        """The same change at all times."""
        return cls(PoseSource(Poses.identity(), new_from_old))

    @property
    def is_constant(self) -> bool:
        """Whether it is the same at all times."""
        return all(source.path.static for source in self._sources)

    @property
    def knots_ns(self) -> Int64Array:
        """Times (K,) int64 [ns], ascending, at which the paths behind it have poses."""
        timestamps = [source.path.timestamps_ns for source in self._sources if not source.path.static]
        return np.unique(np.concatenate(timestamps)) if timestamps else np.zeros(0, np.int64)

    @property
    def _sources(self) -> list[PoseSource]:
        return [source for source in (self.hub_from_old, self.hub_from_new) if source is not None]

    def inverse(self) -> "FrameChange":
        """`old_from_new`."""
        return FrameChange(self.hub_from_new, self.hub_from_old, self.held)

    def at(self, timestamps_ns: Int64Array) -> PoseSamples:
        """Give `new_from_old` at each time, (M,) int64 [ns]; NaN where it is not known."""
        # annotations of one scene are asked for at the same times over and over
        key = timestamps_ns.tobytes()
        if key not in self._remembered:
            if len(self._remembered) >= _MOST_REMEMBERED:
                self._remembered.clear()
            self._remembered[key] = self._computed(timestamps_ns)
        return self._remembered[key]

    def _computed(self, timestamps_ns: Int64Array) -> PoseSamples:
        hub_from_old = self._of(self.hub_from_old, timestamps_ns)
        if self.hub_from_new is None:
            return hub_from_old
        hub_from_new = self._of(self.hub_from_new, timestamps_ns)
        back = conjugate_quaternion(hub_from_new.quaternions_xyzw)
        return PoseSamples(
            rotate_vectors(back, hub_from_old.positions - hub_from_new.positions),
            multiply_quaternions(back, hub_from_old.quaternions_xyzw),
            np.maximum(hub_from_old.coverage, hub_from_new.coverage),
        )

    def _of(self, source: PoseSource | None, timestamps_ns: Int64Array) -> PoseSamples:
        if source is None:
            return Poses.identity().interpolate(timestamps_ns)
        path = source.path
        if self.held and not path.static:
            return source.at(np.clip(timestamps_ns, path.start_ns, path.stop_ns))
        return source.at(timestamps_ns)

    def transform(self, timestamp_ns: int) -> RigidTransform:
        """`new_from_old` at a time at which it is known."""
        pose = self.at(np.array([timestamp_ns], np.int64))
        return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])

    def locations(self, timestamps_ns: Int64Array, locations: FloatArray) -> Float64Array:
        """Take locations (M, ..., 3) [m] of the old frame into the new one, row k at time k; NaN where not known."""
        pose = self.at(timestamps_ns)
        lead = (len(timestamps_ns), *(1,) * (np.ndim(locations) - 2), 3)
        rotations = matrix_from_quaternion(pose.quaternions_xyzw)
        rotated = np.einsum("mij,m...j->m...i", rotations, np.asarray(locations, np.float64))
        moved: Float64Array = rotated + pose.positions.reshape(lead)
        return moved

    def poses(
        self, timestamps_ns: Int64Array, positions: Float64Array, quaternions_xyzw: Float64Array
    ) -> PoseSamples:
        """Give `new_from_body` of a body whose `old_from_body` is given at each time, (M, 3) and (M, 4)."""
        change = self.at(timestamps_ns)
        return PoseSamples(
            rotate_vectors(change.quaternions_xyzw, positions) + change.positions,
            multiply_quaternions(change.quaternions_xyzw, quaternions_xyzw),
            change.coverage,
        )

    def path(self, path: Poses, *, times_ns: Int64Array | None = None) -> Poses | None:
        """Give `new_from_body` of a path, at its own times; None where the change is known at none of them.

        Args:
            path: `old_from_body`.
            times_ns: (M,) int64 [ns], ascending, the times to give instead of the path's own: what an static path
                needs where the change is not constant.
        """
        if path.static and self.is_constant:
            times_ns, static = path.timestamps_ns, True
        else:
            static = False
        times = path.timestamps_ns if times_ns is None else times_ns
        old = path.interpolate(times) if times_ns is not None else None
        positions = path.positions if old is None else old.positions
        rotations = path.quaternions_xyzw if old is None else old.quaternions_xyzw
        new = self.poses(times, positions, rotations)
        known = (new.coverage <= KNOWN) & np.isfinite(new.positions[:, 0])
        if not known.any():
            return None
        return Poses(times[known], new.positions[known], new.quaternions_xyzw[known], static=static)
