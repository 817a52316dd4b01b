"""Poses over time: sampled poses, named trajectories, and the pose source of a mounted sensor."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array, hold_arrays
from sceneloom.errors import ArrayError, PoseError
from sceneloom.geometry.rigid import RigidTransform, interpolate_poses, normalise_quaternion


@dataclass(frozen=True, slots=True, eq=False)
class PoseSamples:
    """Poses at the times that were asked for.

    Attributes:
        positions: (M, 3) float64 [m]; NaN where out of reach.
        quaternions_xyzw: (M, 4) float64, unit; NaN where out of reach.
        coverage: (M,) uint8: 0 inside the path, 1 extrapolated, 2 out of reach.
    """

    positions: Float64Array
    quaternions_xyzw: Float64Array
    coverage: UInt8Array


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Position and orientation of a moving frame in its parent frame (`parent_from_body`).

    Attributes:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 1.
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, unit within 0.01, scalar last.
        static: the pose holds at all times (only for N = 1: a body that is stationary).

    Raises:
        ArrayError: shapes, order of times or norms are wrong.

    Source: "Poses" of the SFS description.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array
    static: bool = False

    def __repr__(self) -> str:
        return "Poses(static)" if self.static else f"Poses({_extent(self)})"

    def __post_init__(self) -> None:
        count = hold_arrays(
            self,
            "poses",
            {
                "timestamps_ns": (np.int64, "N"),
                "positions": (np.float64, "N", 3),
                "quaternions_xyzw": (np.float64, "N", 4),
            },
            frozen=True,
        )
        if count == 0:
            raise ArrayError("poses: empty; expected at least one pose")
        if self.static and count != 1:
            raise ArrayError(f"poses: {count} poses; an static path has exactly one")
        backwards = np.flatnonzero(self.timestamps_ns[1:] <= self.timestamps_ns[:-1])
        if len(backwards):
            k = int(backwards[0]) + 1
            raise ArrayError(f"poses.timestamps_ns[{k}]: {self.timestamps_ns[k]}; expected strictly increasing times")
        if not (np.isfinite(self.positions).all() and np.isfinite(self.quaternions_xyzw).all()):
            raise ArrayError("poses: a value is not finite")
        with np.errstate(over="ignore"):  # huge numbers have the norm infinity, which is no 1 either
            norms = np.linalg.norm(self.quaternions_xyzw, axis=1)
        off = np.flatnonzero(np.abs(norms - 1.0) > 0.01)
        if len(off):
            k = int(off[0])
            norm = float(norms[k])
            raise ArrayError(f"poses.quaternions_xyzw[{k}]: norm {norm:.4f}; expected 1 within 0.01")

    def __reduce__(self) -> tuple[Any, ...]:
        return Poses, (self.timestamps_ns, self.positions, self.quaternions_xyzw, self.static)

    @classmethod
    def identity(cls) -> "Poses":
        """A body that stands at the origin for all time."""
        return cls(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]), static=True)

    @property
    def start_ns(self) -> int:
        """Time of the first pose [ns]."""
        return int(self.timestamps_ns[0])

    @property
    def stop_ns(self) -> int:
        """Time of the last pose [ns]."""
        return int(self.timestamps_ns[-1])

    def moved(self, origin: Float64Array) -> "Poses":
        """The same path seen from another origin of its parent frame, (3,) float64 [m]; the axes stay."""
        return replace(self, positions=self.positions - origin)

    def interpolate(
        self, timestamps_ns: Int64Array, *, reach_ns: int = 0, mount: RigidTransform | None = None
    ) -> PoseSamples:
        """Give the pose at each time: position linear, rotation slerp between the neighbouring poses.

        Args:
            timestamps_ns: (M,) int64 [ns].
            reach_ns: how far beyond either end the constant velocity of the end segment is continued.
            mount: `body_from_sensor`, to give the poses of that sensor.
        """
        if not self.static:
            path = self.timestamps_ns, self.positions, self.quaternions_xyzw
            return PoseSamples(*interpolate_poses(*path, timestamps_ns, reach_ns=reach_ns, mount=mount))
        count, position, quaternion = len(timestamps_ns), self.positions, normalise_quaternion(self.quaternions_xyzw)
        if mount is not None:
            position, quaternion = mount.carried(position, quaternion)
        inside = np.zeros(count, np.uint8)
        return PoseSamples(np.repeat(position, count, axis=0), np.repeat(quaternion, count, axis=0), inside)

    def held(self, timestamps_ns: Int64Array) -> PoseSamples:
        """Give the pose at each time, (M,) int64 [ns]; beyond the path's ends the end poses hold."""
        if self.static:
            return self.interpolate(timestamps_ns)
        return self.interpolate(np.clip(timestamps_ns, self.start_ns, self.stop_ns))


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The ego trajectory through the world under the name of the method that found it (`world_from_ego`).

    Attributes:
        name: "groundTruth", "pose", the name of a VIO method, …
        timestamps_ns: (N,) int64 [ns], strictly increasing.
        positions: (N, 3) float64 [m], world frame, z up.
        quaternions_xyzw: (N, 4) float64, or None where the method gives positions only.
        file_seconds: (N,) float64 [s], the file's own timestamps, or None.
        covariances: (N, 6, 6) float64, or None: of a small rotation [rad], then a small shift [m], of the ego about the
            world's axes at the pose, relative to where the method began.
    """

    name: str
    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array | None = None
    file_seconds: Float64Array | None = None
    covariances: Float64Array | None = None

    def __repr__(self) -> str:
        positions_only = "" if self.quaternions_xyzw is not None else ", positions only"
        return f"Trajectory({self.name!r}, {_extent(self)}{positions_only})"

    def __post_init__(self) -> None:
        hold_arrays(
            self,
            f"trajectories[{self.name}]",
            {
                "timestamps_ns": (np.int64, "N"),
                "positions": (np.float64, "N", 3),
                "quaternions_xyzw?": (np.float64, "N", 4),
                "file_seconds?": (np.float64, "N"),
                "covariances?": (np.float64, "N", 6, 6),
            },
        )

    @property
    def poses(self) -> Poses:
        """The trajectory as a Poses.

        Raises:
            PoseError: the trajectory has positions only.
        """
        if self.quaternions_xyzw is None:
            raise PoseError(
                f"trajectory {self.name!r} holds positions without orientations; "
                "derive the heading from the motion with `--orientation-from motion`, or choose another with "
                "`--trajectory NAME`"
            )
        return Poses(self.timestamps_ns, self.positions, self.quaternions_xyzw)


def _extent(path: Poses | Trajectory) -> str:
    """How many poses there are, over how long and how far."""
    times, steps = path.timestamps_ns, np.diff(path.positions, axis=0)
    seconds, metres = (int(times[-1] - times[0]) / 1e9 if len(times) else 0.0), np.linalg.norm(steps, axis=1).sum()
    return f"{len(times)} poses over {seconds:.2f} s and {metres:.1f} m"


def same_direction(a: Poses | Trajectory, b: Poses | Trajectory) -> bool:
    """Whether both report the same poses at the same times, number for number."""
    return (
        a.quaternions_xyzw is not None
        and b.quaternions_xyzw is not None
        and np.array_equal(a.timestamps_ns, b.timestamps_ns)
        and np.array_equal(a.positions, b.positions)
        and np.array_equal(a.quaternions_xyzw, b.quaternions_xyzw)
    )


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
        return self.path.interpolate(timestamps_ns, reach_ns=self.reach_ns, mount=self.mount)

    def pose_at(self, timestamp_ns: int) -> RigidTransform | None:
        """Give `world_from_sensor` at one time [ns]; None where it is out of reach."""
        found = self.at(np.array([timestamp_ns], np.int64))
        if not np.isfinite(found.positions).all():
            return None
        return RigidTransform.from_quaternion(found.positions[0], found.quaternions_xyzw[0])


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
    path: Poses | None, mounts: Mapping[int, RigidTransform], chosen: Int64Array, timestamps_ns: Int64Array
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
