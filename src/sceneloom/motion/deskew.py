"""Lidar points by the sensor's pose at each point's own time: into the world, or into any frame the poses lead to."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.interpolation import EXTRAPOLATED, OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.pose_source import PoseSource


def points_to_world(frame: LidarFrame, source: PoseSource) -> tuple[Float64Array, bool]:
    """Take the points of one sweep from the sensor's frame into the world, undoing the motion during the sweep.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.

    Returns:
        positions_world: (N, 3) float64 [m].
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: a point's time lies beyond the reach of the path.
    """
    times = _point_times(frame)
    if len(times) == 0:
        return np.zeros((0, 3)), False
    knots = BodyKnots.of(source, int(times.min()), int(times.max()))
    return knots.moved(frame.points.positions, times, source.mount), knots.extrapolated


def points_at(frame: LidarFrame, source: PoseSource, moment_ns: int) -> tuple[Float64Array, bool]:
    """Take the points of one sweep to where the sensor would have seen them at any one moment, had they was stationary.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.
        moment_ns: within the sweep or not [ns], such as the time of an image.

    Returns:
        positions: (N, 3) float64 [m], in the sensor's frame at that moment.
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: the moment or a point's time lies beyond the reach of the path.
    """
    times = _point_times(frame)
    first_ns, last_ns = int(times.min(initial=moment_ns)), int(times.max(initial=moment_ns))
    knots = BodyKnots.of(source, first_ns, last_ns)
    pose = source.at(np.array([moment_ns], np.int64))
    at_moment = RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])
    moved = knots.seen_from(at_moment.inverse()).moved(frame.points.positions, times, source.mount)
    return moved, knots.extrapolated


def _point_times(frame: LidarFrame) -> Int64Array:
    times = frame.points.timestamps_ns
    if times is None or len(times) == 0:
        return np.full(len(frame.points), frame.timestamp_ns, np.int64)
    return times


@dataclass(frozen=True, slots=True, eq=False)
class BodyKnots:
    """The poses of a moving body over one sweep: linear and slerp between them.

    Attributes:
        timestamps_ns: (K,) int64 [ns], strictly increasing, K >= 1.
        positions: (K, 3) float64 [m].
        quaternions_xyzw: (K, 4) float64, unit.
        extrapolated: whether any lies beyond the path's ends.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array
    extrapolated: bool

    @classmethod
    def of(cls, source: PoseSource, first_ns: int, last_ns: int) -> "BodyKnots":
        """Take the poses of a source's path from one time to another, both included.

        Raises:
            PoseError: one of the times lies beyond the reach of the path.
        """
        span_ns = np.array([first_ns, last_ns], np.int64)
        knots_ns = _knots_within(source.path.timestamps_ns, span_ns)
        body = source.path.interpolate(knots_ns, reach_ns=source.reach_ns)
        if (body.coverage == OUT_OF_REACH).any():
            raise PoseError(
                f"points from {first_ns} to {last_ns} ns; the poses reach from "
                f"{source.path.start_ns} to {source.path.stop_ns} ns and {source.reach_ns} ns beyond"
            )
        return cls(
            knots_ns, body.positions, body.quaternions_xyzw, bool((body.coverage == EXTRAPOLATED).any())
        )

    def seen_from(self, frame_from_world: RigidTransform) -> "BodyKnots":
        """The same poses in another frame that is stationary; linear ways and slerp stay what they are."""
        return replace(
            self,
            positions=frame_from_world.apply(self.positions),
            quaternions_xyzw=multiply_quaternions(frame_from_world.quaternion_xyzw, self.quaternions_xyzw),
        )

    def moved(
        self, positions: Float32Array, timestamps_ns: Int64Array, body_from_sensor: RigidTransform
    ) -> Float64Array:
        """Take points of the sensor, (N, 3) [m], each at its time, (N,) [ns], to where the poses lead, (N, 3)."""
        if len(self.timestamps_ns) == 1:
            world_from_body = RigidTransform.from_quaternion(self.positions[0], self.quaternions_xyzw[0])
            return _taken(world_from_body @ body_from_sensor, positions)
        from sceneloom.kernels.path_transform import transform_by_path

        moved = np.empty((len(positions), 3))
        transform_by_path(
            np.ascontiguousarray(positions),
            np.ascontiguousarray(timestamps_ns),
            np.ascontiguousarray(body_from_sensor.matrix[:3]),
            self.timestamps_ns,
            self.positions,
            self.quaternions_xyzw,
            moved,
        )
        return moved


def _taken(world_from_sensor: RigidTransform, positions: Float32Array) -> Float64Array:
    """Take points through one transform; those of a sensor that is the world's origin are as they were."""
    if np.array_equal(world_from_sensor.matrix, np.eye(4)):
        return positions.astype(np.float64)
    return world_from_sensor.apply(positions)


def _knots_within(path_ns: Int64Array, span_ns: Int64Array) -> Int64Array:
    """The path's own times inside the span, and the span's ends."""
    first, last = np.searchsorted(path_ns, span_ns, side="right")
    return np.unique(np.concatenate([span_ns, path_ns[first:last]]))
