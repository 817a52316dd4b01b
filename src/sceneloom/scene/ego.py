"""The one way of the ego that a scene is placed by."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions
from sceneloom.scene.notices import Notice
from sceneloom.scene.part import cut_path
from sceneloom.scene.part_annotations import Interval
from sceneloom.scene.poses import PosePath, Trajectory
from sceneloom.scene.scene import Scene

_FAR = 1e9
"""No place on earth is told by such numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class EgoMotion:
    """The chosen way of the ego.

    Attributes:
        name: the trajectory's name, or "identity".
        path: `world_from_ego`.
        heading: "motion" where the orientation was derived from the motion, else None.
        covariances: (N, 6, 6) float64, one per pose of the path, as in `Trajectory`; None where not known.
        notices: what was assumed or met on the way to it.
        enu_origin_lla: latitude, longitude [deg] and height above the WGS84 ellipsoid [m] of the place whose east,
            north and up are the world's axes, where these are known; `moved` leaves it where it is.
    """

    name: str
    path: PosePath
    heading: str | None = None
    covariances: Float64Array | None = None
    notices: tuple[Notice, ...] = field(default=())
    enu_origin_lla: tuple[float, float, float] | None = None

    @classmethod
    def of(cls, trajectory: Trajectory) -> "EgoMotion":
        """Follow a trajectory that has orientations.

        Raises:
            PoseError: it has none.
        """
        return cls(trajectory.name, trajectory.poses, covariances=trajectory.covariances)

    def moved(self, origin_world: Float64Array) -> "EgoMotion":
        """The same way seen from another origin, (3,) float64 [m]; the axes stay."""
        return replace(self, path=self.path.moved(origin_world))

    def seen_from(self, world_from_here: RigidTransform) -> "EgoMotion":
        """The same way in another world, whose axes may be turned."""
        turn = world_from_here.rotation
        path = PosePath(
            self.path.timestamps_ns,
            world_from_here.apply(self.path.positions),
            multiply_quaternions(world_from_here.quaternion_xyzw, self.path.quaternions_xyzw),
            endless=self.path.endless,
        )
        if self.covariances is None:
            return replace(self, path=path, enu_origin_lla=None)
        axes = np.kron(np.eye(2), turn)
        return replace(self, path=path, covariances=axes @ self.covariances @ axes.T, enu_origin_lla=None)

    def within(self, part: Interval | None) -> "EgoMotion":
        """The way in and around a part of the drive; None: all of it."""
        if part is None:
            return self
        path = cut_path(self.path, part)
        if self.covariances is None:
            return replace(self, path=path)
        kept = np.isin(self.path.timestamps_ns, path.timestamps_ns)
        return replace(self, path=path, covariances=self.covariances[kept])


def stated_origin(scene: Scene) -> tuple[float, float, float] | None:
    """The place whose east, north and up are the axes of the scene's world, as its metadata say it.

    Returns:
        latitude, longitude [deg] and height above the WGS84 ellipsoid [m]; None where nothing such is said, or the
        world was moved since.
    """
    ours = scene.metadata.get("sceneloom")
    said = ours.get("enu_origin") if isinstance(ours, Mapping) and "world_from_file" not in ours else None
    if not isinstance(said, Mapping):
        return None
    numbers = [said.get(name) for name in ("latitude", "longitude", "altitude")]
    if not all(isinstance(number, int | float) and abs(number) < _FAR for number in numbers):
        return None
    latitude, longitude, altitude = map(float, numbers)  # type: ignore[arg-type]
    return latitude, longitude, altitude
