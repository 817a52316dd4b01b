"""Deskewing: each point by the pose at its own timestamp, and warnings about timestamps."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import EXTRAPOLATED, OUT_OF_REACH, RigidTransform, multiply_quaternions
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.point_times import PointTimes, TimesFound
from sceneloom.scene.poses import PoseSource
from sceneloom.warnings import DataWarning, assumed, repaired, skipped


def points_to_world(frame: LidarFrame, source: PoseSource) -> tuple[Float64Array, bool]:
    """Transform the points of one sweep into the world, each by the pose at its own time.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.

    Returns:
        positions_world: (N, 3) float64 [m].
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: a point's time is beyond the extrapolation limit of the path.
    """
    times = frame.point_times_ns
    if len(times) == 0:
        return np.zeros((0, 3)), False
    knots = BodyKnots.of(source, int(times.min()), int(times.max()))
    return knots.moved(frame.points.positions, times, source.mount), knots.extrapolated


def points_at(frame: LidarFrame, source: PoseSource, moment_ns: int) -> tuple[Float64Array, bool]:
    """Transform the points of one sweep into the sensor's frame at one moment, as if the world had been seen then.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.
        moment_ns: within the sweep or not [ns], such as the time of an image.

    Returns:
        positions: (N, 3) float64 [m], in the sensor's frame at that moment.
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: the moment or a point's time is beyond the extrapolation limit of the path.
    """
    times = frame.point_times_ns
    knots = BodyKnots.of(source, int(times.min(initial=moment_ns)), int(times.max(initial=moment_ns)))
    knots = knots.seen_at(source, moment_ns)
    return knots.moved(frame.points.positions, times, source.mount), knots.extrapolated


@dataclass(frozen=True, slots=True, eq=False)
class BodyKnots:
    """The poses of a moving body over one sweep: linear and slerp between them.

    Attributes:
        timestamps_ns: (K,) int64 [ns], strictly increasing, K >= 1.
        positions: (K, 3) float64 [m].
        quaternions_xyzw: (K, 4) float64, unit.
        extrapolated: whether any is beyond the path's ends.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array
    extrapolated: bool

    @classmethod
    def of(cls, source: PoseSource, first_ns: int, last_ns: int) -> "BodyKnots":
        """Take the poses of a source's path from one time to another, both included.

        Raises:
            PoseError: one of the times is beyond the extrapolation limit of the path.
        """
        span_ns, path_ns = np.array([first_ns, last_ns], np.int64), source.path.timestamps_ns
        first, last = np.searchsorted(path_ns, span_ns, side="right")
        knots_ns = np.unique(np.concatenate([span_ns, path_ns[first:last]]))
        body = source.path.interpolate(knots_ns, reach_ns=source.reach_ns)
        if (body.coverage == OUT_OF_REACH).any():
            raise PoseError(
                f"points from {first_ns} to {last_ns} ns; the poses reach from "
                f"{source.path.start_ns} to {source.path.stop_ns} ns and {source.reach_ns} ns beyond"
            )
        return cls(knots_ns, body.positions, body.quaternions_xyzw, bool((body.coverage == EXTRAPOLATED).any()))

    def seen_at(self, source: PoseSource, moment_ns: int) -> "BodyKnots":
        """The same poses in the frame of a source's sensor at one moment."""
        pose = source.at(np.array([moment_ns], np.int64))
        return self.seen_from(RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]).inverse())

    def seen_from(self, frame_from_world: RigidTransform) -> "BodyKnots":
        """The same poses in another static frame; linear motion and slerp are preserved."""
        return replace(
            self,
            positions=frame_from_world.apply(self.positions),
            quaternions_xyzw=multiply_quaternions(frame_from_world.quaternion_xyzw, self.quaternions_xyzw),
        )

    def moved(
        self, positions: Float32Array, timestamps_ns: Int64Array, body_from_sensor: RigidTransform
    ) -> Float64Array:
        """Transform points of the sensor, (N, 3) [m], by the poses at their times, (N,) [ns]."""
        if len(self.timestamps_ns) == 1:
            world_from_body = RigidTransform.from_quaternion(self.positions[0], self.quaternions_xyzw[0])
            world_from_sensor = world_from_body @ body_from_sensor
            # points of a sensor that is the world's origin stay exactly as they are
            if np.array_equal(world_from_sensor.matrix, np.eye(4)):
                return positions.astype(np.float64)
            return world_from_sensor.apply(positions)
        from sceneloom.kernels.poses import transform_by_path

        moved = np.empty((len(positions), 3))
        transform_by_path(
            np.ascontiguousarray(positions), np.ascontiguousarray(timestamps_ns),
            np.ascontiguousarray(body_from_sensor.matrix[:3]), self.timestamps_ns, self.positions,
            self.quaternions_xyzw, moved,
        )  # fmt: skip
        return moved


_UNTIMED = "{}; the points were taken as measured at the sweep's time, and their times were left out"

_NOTES: Mapping[PointTimes, tuple[Callable[..., DataWarning], str, str]] = MappingProxyType(
    {
        PointTimes.EQUAL: (
            assumed,
            "times-of-points",
            _UNTIMED.format("all points of a sweep have one time, and it is not the sweep's own"),
        ),
        PointTimes.RELATIVE: (
            assumed,
            "relative-point-times",
            "point times are near zero and the sweep's own is not; they were read as relative to the sweep's time",
        ),
        PointTimes.OTHER_CLOCK: (
            assumed,
            "point-times-of-another-clock",
            "point times are not on the clock of their sweep's time; the first of them was taken to be that time",
        ),
        PointTimes.WRONG_UNIT: (
            repaired,
            "unit-of-point-times",
            "point times are {factor} times too {size} for their sweep; they were read in the unit that fits{origin}",
        ),
        PointTimes.UNKNOWN: (
            skipped,
            "unknown-point-times",
            _UNTIMED.format("point times fit neither the sweep's own time nor its period"),
        ),
    }
)  # which warning, its code and message, about each kind of times that is not taken as it is


@dataclass(slots=True)
class PointTimesStatistics:
    """Counts how the point times of sweeps were read."""

    counts: Counter[TimesFound] = field(default_factory=Counter)
    stray_points: int = 0

    def add(self, found: TimesFound) -> None:
        """Count one sweep."""
        self.counts[replace(found, strays=0)] += 1
        self.stray_points += found.strays

    def warnings(self, location: str = "sensors[].frames[].points.timestamps") -> tuple[DataWarning, ...]:
        """What was assumed, repaired or left out, each with the number of sweeps, or of stray points."""
        warnings = []
        for found, count in self.counts.items():
            if found.kind in _NOTES:
                warning, code, template = _NOTES[found.kind]
                message = template.format(
                    factor=int(1 / found.factor if found.factor < 1 else found.factor),
                    size="small" if found.factor < 1 else "large",
                    origin=", relative to the sweep's time" if found.relative else "",
                )
                warnings.append(warning(code, location, message, count=count))
        if self.stray_points:
            message = "times of single points are far from those of their sweep; the sweep's median was taken instead"
            warnings.append(repaired("stray-point-times", location, message, count=self.stray_points))
        return tuple(warnings)
