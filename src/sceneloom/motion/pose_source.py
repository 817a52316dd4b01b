"""Where a sensor was at any time: a path, and how the sensor is mounted on what moves along it."""

from dataclasses import dataclass

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
    """

    path: PosePath
    mount: RigidTransform
    reach_ns: int = 0

    def mounted(self, mount: RigidTransform) -> "PoseSource":
        """The same path with another mounting."""
        return PoseSource(self.path, mount, self.reach_ns)

    def at(self, timestamps_ns: Int64Array) -> PoseSamples:
        """Give `world_from_sensor` at each time, (M,) int64 [ns]."""
        body = self.path.interpolate(timestamps_ns, reach_ns=self.reach_ns)
        return PoseSamples(
            rotate_vectors(body.quaternions_xyzw, self.mount.translation) + body.positions,
            multiply_quaternions(body.quaternions_xyzw, self.mount.quaternion_xyzw),
            body.coverage,
        )
