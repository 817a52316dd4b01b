"""Points in a picture whose lines were taken one after the other, by a camera that moved meanwhile.

A point is seen by the line in which it lies at that line's own time, so line and place must be found together. With
s the line for whose time the point is projected, and v(s) the line in which it then lies, f(s) = v(s) - s has to
vanish. From line to line a picture moves by less than a line: dv/ds < 1, so that f falls everywhere, and its zero is
the only one. The first step is s := v(s), then come secants; mostly three projections bring f under 0.01 px, and the
point is off by that much times dv/ds. One that is beyond an edge even at the time of that edge is not in the picture.
Where the picture moves with the shutter as fast as that, f may have no zero, or several: such points are looked for
twelve times at most, then left out and counted.

The camera's pose is taken at 65 times evenly spread over the picture, relative to the picture's own time, and linear
between them: at 500 degrees a second and 33 ms that is within 0.01 mrad.

Source: Geyer, Meingast and Sastry 2005, "Geometric Models of Rolling-Shutter Cameras".
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import domain_angle, project_unbounded
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.kernels.rolling_lines import keep_in_reach, place_at_lines, search_lines
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.shutter import Shutter

_KNOTS = 65
_ATTEMPTS = 12
_TOLERANCE_PX = 0.01
_CHUNK = 16_384
_STILL = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class ShutterWay:
    """Where a camera was while it took the lines of a picture.

    Attributes:
        over_columns: the lines are columns, from the left, in place of rows from the top.
        lines_from_middle: (K, 3, 4) float64, the camera at K times evenly spread from the picture's first edge to its
            last, from the camera at the picture's time [m].
    """

    over_columns: bool
    lines_from_middle: Float64Array

    def __post_init__(self) -> None:
        check_array("shutter.lines_from_middle", self.lines_from_middle, (None, 3, 4), np.float64)

    @classmethod
    def of(cls, shutter: Shutter, timestamp_ns: int, source: PoseSource) -> "ShutterWay | None":
        """Give the way of a camera during one picture.

        Args:
            shutter: of the camera.
            timestamp_ns: the picture's time [ns].
            source: `world_from_camera`.

        Returns:
            None where all lines are taken at once, where the camera did not move, and where its poses do not reach.
        """
        if shutter.seconds == 0.0:
            return None
        times_ns = np.append(shutter.knots_ns(timestamp_ns, _KNOTS), timestamp_ns)
        samples = source.at(times_ns)
        if (samples.coverage == 2).any():
            return None
        rotations = matrix_from_quaternion(samples.quaternions_xyzw)
        to_line = rotations[:-1].transpose(0, 2, 1)
        shifts = to_line @ (samples.positions[-1] - samples.positions[:-1])[:, :, None]
        moved = np.concatenate([to_line @ rotations[-1], shifts], axis=2)
        return None if np.abs(moved - np.eye(4)[:3]).max() < _STILL else cls(shutter.over_columns, moved)

    @property
    def turn(self) -> float:
        """How far the camera turns at most from its pose at the picture's time [rad]."""
        traces = np.trace(self.lines_from_middle[:, :, :3], axis1=1, axis2=2)
        return float(np.arccos(np.clip((traces.min() - 1.0) / 2.0, -1.0, 1.0)))

    @property
    def way(self) -> float:
        """How far the camera moves at most from its place at the picture's time [m]."""
        return float(np.linalg.norm(self.lines_from_middle[:, :, 3], axis=1).max())


@dataclass(frozen=True, slots=True, eq=False)
class RolledPoints:
    """The points of a cloud in a picture of a rolling shutter.

    Attributes:
        point_ids: (M,) int64, which points fall into the picture, ascending.
        pixels: (M, 2) float32 [px].
        points_camera: (M, 3) float64 [m], each in the frame of the camera at the time of the line that sees it.
        unsettled: how many more points may be in the picture, since they were within a picture's size of it when no
            line had been found for them.
    """

    point_ids: Int64Array
    pixels: Float32Array
    points_camera: Float64Array
    unsettled: int


def project_by_lines(
    points_world: Float64Array, camera: Camera, world_from_camera: RigidTransform, shutter: ShutterWay
) -> RolledPoints:
    """Project points into a picture, each at the time of the line that sees it.

    Args:
        points_world: (N, 3) float64 [m], contiguous; points that are not finite are in no picture.
        camera: the lens, of any model.
        world_from_camera: where the camera was at the picture's time.
        shutter: where it was from there, line by line.

    Raises:
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    ids, in_middle = np.empty(len(points_world), np.int64), np.empty((len(points_world), 3))
    camera_from_world = world_from_camera.inverse().matrix
    count = keep_in_reach(
        points_world, camera_from_world, domain_angle(camera), shutter.turn, shutter.way, ids, in_middle
    )
    parts = [
        _project_part(in_middle[start : min(start + _CHUNK, count)], camera, shutter)
        for start in range(0, count, _CHUNK)
    ]
    if not parts:
        nothing = np.zeros((0, 3))
        return RolledPoints(np.zeros(0, np.int64), np.zeros((0, 2), np.float32), nothing, 0)
    rows = np.concatenate([part.point_ids + k * _CHUNK for k, part in enumerate(parts)])
    return RolledPoints(
        ids[rows],
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.points_camera for part in parts]),
        sum(part.unsettled for part in parts),
    )


def _project_part(in_middle: Float64Array, camera: Camera, shutter: ShutterWay) -> RolledPoints:
    """Project a few points, so few that the processor's cache holds them."""
    size = len(in_middle)
    lines, before, off = (np.full(size, value) for value in (0.0, np.nan, np.nan))
    line_count = camera.width if shutter.over_columns else camera.height
    lines += 0.5 * (line_count - 1)
    pixels, placed = np.full((size, 2), np.nan, np.float32), np.empty((size, 3))
    active = np.arange(size)
    for attempt in range(_ATTEMPTS):
        there, settled = np.empty((len(active), 3)), np.empty(len(active), np.int64)
        looked_at = active.copy()
        place_at_lines(in_middle, active, lines, shutter.lines_from_middle, line_count, there)
        found = project_unbounded(camera, there)
        axis = 0 if shutter.over_columns else 1
        remaining = search_lines(
            found, axis, attempt, line_count, _TOLERANCE_PX, active, lines, before, off, settled
        )
        settled = settled[settled >= 0]
        pixels[looked_at[settled]], placed[looked_at[settled]] = found[settled], there[settled]
        active = active[:remaining].copy()
        if remaining == 0:
            break
    rows = np.flatnonzero(_in_picture(pixels, camera))
    there = np.empty((len(active), 3))
    place_at_lines(in_middle, active, lines, shutter.lines_from_middle, line_count, there)
    near = _in_picture(project_unbounded(camera, there), camera, border=max(camera.width, camera.height))
    return RolledPoints(rows, pixels[rows], placed[rows], int(near.sum()))


def _in_picture(pixels: FloatArray, camera: Camera, *, border: int = 0) -> BoolArray:
    u, v = pixels.T
    inside: BoolArray = (u >= -0.5 - border) & (u < camera.width - 0.5 + border)
    inside &= (v >= -0.5 - border) & (v < camera.height - 0.5 + border)
    return inside
