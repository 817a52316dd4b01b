"""Where a sensor was at any time: a path, and how the sensor is mounted on what moves along it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.poses import Poses, PoseSamples


@dataclass(frozen=True, slots=True, eq=False)
class PoseSource:
    """Gives `world_from_sensor(t) = path(t) ∘ mount`.

    Attributes:
        path: the moving body in the world (the ego, or the sensor itself).
        mount: `body_from_sensor`.
        reach_ns: how far beyond the path's ends its velocity is continued.
        own: whether the path is the sensor's own, so that a mounting on the ego says nothing more about it.
    """

    path: Poses
    mount: RigidTransform
    reach_ns: int = 0
    own: bool = False

    def mounted(self, ego_from_sensor: RigidTransform | None) -> "PoseSource":
        """The same ego trajectory with another mounting, if there is one; a sensor's own path stays as it is."""
        return self if self.own or ego_from_sensor is None else replace(self, mount=ego_from_sensor)

    def at(self, timestamps_ns: Int64Array) -> PoseSamples:
        """Give `world_from_sensor` at each time, (M,) int64 [ns]."""
        body = self.path.interpolate(timestamps_ns, reach_ns=self.reach_ns)
        return PoseSamples(
            rotate_vectors(body.quaternions_xyzw, self.mount.translation) + body.positions,
            multiply_quaternions(body.quaternions_xyzw, self.mount.quaternion_xyzw),
            body.coverage,
        )


def placed_along(
    path: Poses | None, mounts: Sequence[RigidTransform | None], timestamps_ns: Int64Array
) -> Poses | None:
    """As `poses_along`, with the mounting at each of the times, (N,) of them, None where it is not known."""
    numbers: dict[bytes, int] = {}
    known: dict[int, RigidTransform] = {}
    chosen = np.full(len(mounts), -1, np.int64)
    for k, mount in enumerate(mounts):
        if mount is not None:
            chosen[k] = number = numbers.setdefault(mount.matrix.tobytes(), len(numbers))
            known[number] = mount
    return poses_along(path, known, chosen, timestamps_ns) if len(timestamps_ns) else None


def poses_along(
    path: Poses | None,
    mounts: Mapping[int, RigidTransform],
    chosen: Int64Array,
    timestamps_ns: Int64Array,
) -> Poses | None:
    """Give `world_from_sensor` at those of the times that the path covers; None where there are none.

    Args:
        path: `world_from_ego`, or None where it is not known.
        mounts: `ego_from_sensor` by number.
        chosen: (N,) int64, number of the mounting at each time; a time whose mounting is not known gets no pose.
        timestamps_ns: (N,) int64 [ns], ascending; of equal ones the first counts.
    """
    if path is None:
        return None
    times, rows = np.unique(timestamps_ns, return_index=True)
    numbers = chosen[rows]
    positions, quaternions = np.full((len(times), 3), np.nan), np.full((len(times), 4), np.nan)
    for number in np.unique(numbers).tolist():
        if number in mounts:
            same = numbers == number
            samples = PoseSource(path, mounts[number]).at(times[same])
            positions[same], quaternions[same] = samples.positions, samples.quaternions_xyzw
    known = np.isfinite(positions[:, 0])
    if not known.any():
        return None
    return Poses(times[known], positions[known], quaternions[known])
