"""The one ego trajectory that a scene is placed by."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import SceneloomError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion, multiply_quaternions, normalise_quaternion
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.part import cut_path
from sceneloom.scene.part_annotations import Interval
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning

_FAR = 1e9
"""No location on earth is known by such numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class EgoMotion:
    """The chosen ego trajectory.

    Attributes:
        name: the trajectory's name, or "identity".
        path: `world_from_ego`.
        heading: "motion" where the orientation was derived from the motion, else None.
        covariances: (N, 6, 6) float64, one per pose of the path, as in `Trajectory`; None where not known.
        warnings: what was assumed or met on the way to it.
        enu_origin_lla: latitude, longitude [deg] and height above the WGS84 ellipsoid [m] of the location whose east,
            north and up are the world's axes, where these are known; `moved` leaves it where it is.
    """

    name: str
    path: Poses
    heading: str | None = None
    covariances: Float64Array | None = None
    warnings: tuple[DataWarning, ...] = field(default=())
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
        """The same way in another world, whose axes may be rotated."""
        rotation = world_from_here.rotation
        path = Poses(
            self.path.timestamps_ns,
            world_from_here.apply(self.path.positions),
            multiply_quaternions(world_from_here.quaternion_xyzw, self.path.quaternions_xyzw),
            static=self.path.static,
        )
        if self.covariances is None:
            return replace(self, path=path, enu_origin_lla=None)
        axes = np.kron(np.eye(2), rotation)
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


@dataclass(frozen=True, slots=True, eq=False)
class EgoAxes:
    """How the ego's frame lies on the vehicle.

    Attributes:
        body_from_ego: (3, 3) float64, rows: the vehicle's forward, left and up in the ego's frame.
        known: whether something says so; else the axes are taken as x forward, y left, z up.
    """

    body_from_ego: Float64Array
    known: bool


_LEAST_PATH = 0.5
"""A path shorter than this says nothing of the forward axis [m]."""
_STEADY = 0.8
"""Least length of a mean of unit vectors that are one direction."""
_NEAR_AXIS = np.cos(np.pi / 4)
_GRAVITY = (8.0, 11.5)
"""Mean specific force of an IMU that may be taken as gravity [m/s²]."""


def ego_axes(scene: Scene) -> EgoAxes:
    """Find the vehicle's forward and upward direction in the ego's frame.

    Up is against gravity as accelerometers measure it, else the world's z by the poses of the ego. Forward is
    `imuForward` of a recording, else where the ego moves. Formats other than recordings define the ego's x as forward:
    there the motion counts only where it is neither along x nor backwards.
    """
    free = scene.format == "recording"
    path = _posed_path(scene)
    up = _measured_up(scene)
    if up is None and path is not None:
        up = _steady(_unrotated(path.quaternions_xyzw, np.array([[0.0, 0.0, 1.0]])))
    known_up = up is not None
    if up is None or (not free and up[2] > _NEAR_AXIS):
        up = np.array([0.0, 0.0, 1.0])
    forward = _stated_forward(scene)
    if forward is None and path is not None:
        forward = _moved_forward(path)
        if forward is not None and not free and abs(forward[0]) > _NEAR_AXIS:
            forward = None
    known = forward is not None if free else True
    if forward is None:
        forward = np.array([1.0, 0.0, 0.0])
    forward = forward - up * (forward @ up)
    length = float(np.linalg.norm(forward))
    if length < 0.1:
        return EgoAxes(np.eye(3), known=False)
    forward = forward / length
    return EgoAxes(np.stack([forward, np.cross(up, forward), up]), known and (known_up or not free))


def _posed_path(scene: Scene) -> Poses | None:
    """The first trajectory with orientations, of its first 10,000 poses."""
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None and len(trajectory.timestamps_ns) > 1:
            try:
                rows = slice(0, 10_000)
                return Poses(
                    trajectory.timestamps_ns[rows],
                    trajectory.positions[rows],
                    trajectory.quaternions_xyzw[rows],
                )
            except SceneloomError:
                continue
    return None


def _measured_up(scene: Scene) -> Float64Array | None:
    """Against gravity, by the mean of the first accelerometer; the first 10,000 samples."""
    for sensor in scene.sensors:
        stream = sensor.streams.get("accelerometer") if isinstance(sensor, ImuSensor) else None
        if stream is None or stream.values.shape[1] != 3 or not len(stream):
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            mean = np.nanmedian(stream.values[:10_000], axis=0)
            length = float(np.linalg.norm(mean))
        if _GRAVITY[0] <= length <= _GRAVITY[1]:
            return np.asarray(mean / length, np.float64)
    return None


def _stated_forward(scene: Scene) -> Float64Array | None:
    """`imuForward` of a recording's calibration."""
    reported: Any = scene.metadata.get("recording")
    for name in ("calibration", "imuForward"):
        reported = reported.get(name) if isinstance(reported, Mapping) else None
    if isinstance(reported, Mapping):
        reported = [reported.get(axis) for axis in "xyz"]
    if not isinstance(reported, list | tuple) or len(reported) != 3:
        return None
    if not all(isinstance(each, int | float) and np.isfinite(each) for each in reported):
        return None
    length = float(np.linalg.norm(np.array(reported, np.float64)))
    return np.array(reported, np.float64) / length if 0.0 < length < np.inf else None


def _moved_forward(path: Poses) -> Float64Array | None:
    """The direction in the ego's frame in which it moves; None where it hardly moves, or now this way and now that."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.diff(path.positions, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        total = float(lengths.sum())
        if not _LEAST_PATH <= total < 1e12:
            return None
        local = _unrotated(path.quaternions_xyzw[:-1], steps)
    return _steady(local / total * len(local))


def _unrotated(quaternions_xyzw: Float64Array, vectors: Float64Array) -> Float64Array:
    """Vectors of the parent frame, (N, 3) or (1, 3), in the frames of the body."""
    rotations = matrix_from_quaternion(normalise_quaternion(quaternions_xyzw))
    return np.asarray(
        np.einsum("nij,ni->nj", rotations, np.broadcast_to(vectors, (len(rotations), 3))), np.float64
    )


def _steady(vectors: Float64Array) -> Float64Array | None:
    """The mean direction of vectors whose mean length is 1; None where they point into several."""
    mean = np.asarray(vectors.mean(axis=0), np.float64)
    length = float(np.linalg.norm(mean))
    return mean / length if length >= _STEADY else None


def stated_origin(scene: Scene) -> tuple[float, float, float] | None:
    """The location whose east, north and up are the axes of the scene's world, as its metadata state it.

    Returns:
        latitude, longitude [deg] and height above the WGS84 ellipsoid [m]; None where nothing such is stated, or the
        world was moved since.
    """
    ours = scene.metadata.get("sceneloom")
    stated = ours.get("enu_origin") if isinstance(ours, Mapping) and "world_from_file" not in ours else None
    if not isinstance(stated, Mapping):
        return None
    numbers = [stated.get(name) for name in ("latitude", "longitude", "altitude")]
    if not all(isinstance(number, int | float) and abs(number) < _FAR for number in numbers):
        return None
    latitude, longitude, altitude = map(float, numbers)  # type: ignore[arg-type]
    return latitude, longitude, altitude
