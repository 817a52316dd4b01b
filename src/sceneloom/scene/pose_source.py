"""Where a sensor was at any time: a path, and how the sensor is mounted on what moves along it."""

from dataclasses import dataclass, replace

from sceneloom.arrays import Int64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.poses import PosePath, PoseSamples


@dataclass(frozen=True, slots=True, eq=False)
class PoseSource:
    """Gives `world_from_sensor(t) = path(t) ∘ mount`.

    Attributes:
        path: the moving body in the world (the ego, or the sensor itself).
        mount: `body_from_sensor`.
        reach_ns: how far beyond the path's ends its velocity is continued.
        own: whether the path is the sensor's own, so that a mounting on the ego says nothing more about it.
    """

    path: PosePath
    mount: RigidTransform
    reach_ns: int = 0
    own: bool = False

    def mounted(self, ego_from_sensor: RigidTransform | None) -> "PoseSource":
        """The same way of the ego with another mounting, if there is one; a sensor's own path stays as it is."""
        return self if self.own or ego_from_sensor is None else replace(self, mount=ego_from_sensor)

    def at(self, timestamps_ns: Int64Array) -> PoseSamples:
        """Give `world_from_sensor` at each time, (M,) int64 [ns]."""
        body = self.path.interpolate(timestamps_ns, reach_ns=self.reach_ns)
        return PoseSamples(
            rotate_vectors(body.quaternions_xyzw, self.mount.translation) + body.positions,
            multiply_quaternions(body.quaternions_xyzw, self.mount.quaternion_xyzw),
            body.coverage,
        )
