"""Where sensors are: mountings on the ego, and poses in the world, from the tree of frames."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.topics.frames import FrameTree
from sceneloom.formats.topics.roles import Roles
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.pose_source import poses_along
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import PointsFrame


@dataclass(frozen=True, slots=True, eq=False)
class Locations:
    """The frames, and the ego trajectory.

    Attributes:
        tree: of the frames.
        roles: which of them is the ego, and which the world.
        trajectory: `world_from_ego`, the default one; None where none is known.
    """

    tree: FrameTree
    roles: Roles
    trajectory: Poses | None

    def points_frame(self, frame_id: str) -> PointsFrame:
        """Whose frame it is: the world's, the ego's, or a sensor's own."""
        if frame_id == self.roles.world:
            return PointsFrame.WORLD
        return PointsFrame.EGO if frame_id == self.roles.ego else PointsFrame.SENSOR

    def mount(self, frame_id: str) -> RigidTransform | None:
        """`ego_from_sensor`, or None."""
        ego = self.roles.ego
        return None if ego is None else self.tree.mount(ego, frame_id)

    def mounts_at(self, frame_id: str, times_ns: Int64Array) -> list[RigidTransform | None]:
        """`ego_from_sensor` at each of some times, for a sensor that moves on the ego; None beyond what is known."""
        ego = self.roles.ego
        path = None if ego is None else self.tree.path(ego, frame_id)
        if path is None:
            return [self.mount(frame_id)] * len(times_ns)
        samples = path.interpolate(times_ns)
        return [
            RigidTransform.from_quaternion(position, quaternion) if np.isfinite(position).all() else None
            for position, quaternion in zip(samples.positions, samples.quaternions_xyzw, strict=True)
        ]

    def poses(self, frame_id: str, mount: RigidTransform | None, times_ns: Int64Array) -> Poses | None:
        """`world_from_sensor` at some times: along the ego trajectory, else by the sensor's own frames."""
        if len(times_ns) == 0:
            return None
        if mount is not None:
            return poses_along(self.trajectory, {0: mount}, np.zeros(len(times_ns), np.int64), times_ns)
        world = self.roles.world
        return None if world is None or frame_id == world else self.tree.path(world, frame_id)

    def world_from(self, frame_id: str, times_ns: Int64Array) -> tuple[Poses | None, RigidTransform | None]:
        """What takes points of a frame into the world: a path, or one transform; neither where it is not known."""
        world = self.roles.world
        if world is None or frame_id == world:
            return None, RigidTransform.identity()
        path = self.tree.path(world, frame_id)
        if path is not None:
            return path, None
        fixed = self.tree.mount(world, frame_id)
        if fixed is not None:
            return None, fixed
        mount = self.mount(frame_id)
        return (None if mount is None else self.poses(frame_id, mount, times_ns)), None
