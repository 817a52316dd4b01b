"""Projection into images of a rolling shutter whose camera moves.

A point is seen by the line in which it lies at that line's own time, so line and location must be found together. With
s the line for whose time the point is projected, and v(s) the line in which it then lies, f(s) = v(s) - s has to
vanish. From line to line an image moves by less than a line: dv/ds < 1, so that f falls everywhere, and its zero is
the only one. The first step is s := v(s), then come secants; mostly three projections bring f under 0.01 px, and the
point is off by that much times dv/ds. One that is beyond an edge even at the time of that edge is not in the image.
Where the image moves with the shutter as fast as that, f may have no zero, or several: such points are looked for
twelve times at most, then left out and counted.

The camera's pose is taken at 65 times evenly spread over the image, relative to the image's own time, and linear
between them: at 500 degrees a second and 33 ms that is within 0.01 mrad.

Source: Geyer, Meingast and Sastry 2005, "Geometric Models of Rolling-Shutter Cameras".
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import domain_angle, project_unbounded
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.kernels.poses import keep_in_reach, position_at_lines, search_lines
from sceneloom.scene.cameras import Shutter
from sceneloom.scene.poses import PoseSource

_KNOTS = 65

_ATTEMPTS = 12

_TOLERANCE_PX = 0.01

_CHUNK = 16_384

_STILL = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class ShutterDirection:
    """Where a camera was while it took the lines of an image.

    Attributes:
        over_columns: the lines are columns, from the left, instead of rows from the top.
        lines_from_middle: (K, 3, 4) float64, the camera at K times evenly spread from the image's first edge to its
            last, from the camera at the image's time [m].
    """

    over_columns: bool
    lines_from_middle: Float64Array

    def __post_init__(self) -> None:
        check_array("shutter.lines_from_middle", self.lines_from_middle, (None, 3, 4), np.float64)

    @classmethod
    def of(cls, shutter: Shutter, timestamp_ns: int, source: PoseSource) -> "ShutterDirection | None":
        """Give the trajectory of a camera during one image.

        Args:
            shutter: of the camera.
            timestamp_ns: the image's time [ns].
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

    @classmethod
    def at_rest(cls, shutter: Shutter) -> "ShutterDirection":
        """Give the trajectory of a camera that stands: what moves by itself still depends on the line that sees it."""
        return cls(shutter.over_columns, np.tile(np.eye(4)[:3], (2, 1, 1)))

    @property
    def axis(self) -> int:
        """What of a pixel says in which line it is: 0, its column, or 1, its row."""
        return 0 if self.over_columns else 1

    def line_count(self, camera: Camera) -> int:
        """How many lines an image has."""
        return camera.width if self.over_columns else camera.height

    def poses_at(self, lines: FloatArray, camera: Camera) -> Float64Array:
        """Give the camera at the time of lines, from where it was at the image's time.

        Args:
            lines: (N,) rows or columns [px], also between two; those beyond the edges count as at them.

        Returns:
            (N, 3, 4) float64.
        """
        last = len(self.lines_from_middle) - 1
        at = np.clip((np.asarray(lines) + 0.5) / self.line_count(camera), 0.0, 1.0) * last
        knots = np.minimum(at.astype(np.int64), last - 1)
        later = (at - knots)[:, None, None]
        first, second = self.lines_from_middle[knots], self.lines_from_middle[knots + 1]
        poses: Float64Array = first + later * (second - first)
        return poses

    @property
    def rotation(self) -> float:
        """How far the camera rotates at most from its pose at the image's time [rad]."""
        traces = np.trace(self.lines_from_middle[:, :, :3], axis1=1, axis2=2)
        return float(np.arccos(np.clip((traces.min() - 1.0) / 2.0, -1.0, 1.0)))

    @property
    def trajectory(self) -> float:
        """How far the camera moves at most from its location at the image's time [m]."""
        return float(np.linalg.norm(self.lines_from_middle[:, :, 3], axis=1).max())


@dataclass(frozen=True, slots=True, eq=False)
class RolledPoints:
    """The points of a cloud in an image of a rolling shutter.

    Attributes:
        point_ids: (M,) int64, which points fall into the image, ascending.
        pixels: (M, 2) float32 [px].
        points_camera: (M, 3) float64 [m], each in the frame of the camera at the time of the line that sees it.
        unsettled: how many more points may be in the image, since they were within an image's size of it when no
            line had been found for them.
    """

    point_ids: Int64Array
    pixels: Float32Array
    points_camera: Float64Array
    unsettled: int


def project_by_lines(
    points_world: Float64Array, camera: Camera, world_from_camera: RigidTransform, shutter: ShutterDirection
) -> RolledPoints:
    """Project points into an image, each at the time of the line that sees it.

    Args:
        points_world: (N, 3) float64 [m], contiguous; points that are not finite are in no image.
        camera: the camera model, of any model.
        world_from_camera: where the camera was at the image's time.
        shutter: where it was from there, line by line.

    Raises:
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    ids, in_middle = np.empty(len(points_world), np.int64), np.empty((len(points_world), 3))
    camera_from_world = world_from_camera.inverse_matrix
    count = keep_in_reach(
        points_world,
        camera_from_world,
        domain_angle(camera),
        shutter.rotation,
        shutter.trajectory,
        ids,
        in_middle,
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


def pixels_by_lines(
    points_middle: Float64Array, drifts: Float64Array, camera: Camera, shutter: ShutterDirection
) -> Float64Array:
    """Project points that may move, each at the time of the line that sees it, also beyond the image's edges.

    Args:
        points_middle: (N, 3) float64 [m], at the image's time, in the frame of the camera at that time.
        drifts: (N, 3) float64 [m], how far they go in that frame from the first line to the last, evenly.
        camera: the camera model, of any model.
        shutter: where the camera was, line by line.

    Returns:
        (N, 2) float64 [px]; beyond an edge by the time of that edge, NaN for what no line sees.

    Raises:
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    found = _search(np.ascontiguousarray(points_middle), camera, shutter, drifts)
    beyond = np.flatnonzero(np.isnan(found.pixels[:, 0]))
    line_count = shutter.line_count(camera)
    there = np.empty((len(beyond), 3))
    moved = _drifted(points_middle, drifts, found.lines, line_count)
    position_at_lines(moved, beyond, found.lines, shutter.lines_from_middle, line_count, there)
    found.pixels[beyond] = project_unbounded(camera, there)
    return found.pixels


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What the search for lines gives: pixels (N, 2) [px] and locations (N, 3) [m], NaN where no line sees a point.

    `lines` (N,) are those that were looked at last, and `unsettled` the points for which the search was given up.
    """

    pixels: Float64Array
    placed: Float64Array
    lines: Float64Array
    unsettled: Int64Array


def _search(
    in_middle: Float64Array, camera: Camera, shutter: ShutterDirection, drifts: Float64Array | None = None
) -> _Found:
    """Find the line that sees each point."""
    size = len(in_middle)
    line_count = shutter.line_count(camera)
    lines, before, off = (np.full(size, value) for value in (0.5 * (line_count - 1), np.nan, np.nan))
    pixels, placed = np.full((size, 2), np.nan), np.empty((size, 3))
    active = np.arange(size)
    for attempt in range(_ATTEMPTS):
        there, settled = np.empty((len(active), 3)), np.empty(len(active), np.int64)
        looked_at = active.copy()
        moved = in_middle if drifts is None else _drifted(in_middle, drifts, lines, line_count)
        position_at_lines(moved, active, lines, shutter.lines_from_middle, line_count, there)
        found = project_unbounded(camera, there)
        remaining = search_lines(
            found, shutter.axis, attempt, line_count, _TOLERANCE_PX, active, lines, before, off, settled
        )
        settled = settled[settled >= 0]
        pixels[looked_at[settled]], placed[looked_at[settled]] = found[settled], there[settled]
        active = active[:remaining].copy()
        if remaining == 0:
            break
    return _Found(pixels, placed, lines, active)


def _drifted(
    in_middle: Float64Array, drifts: Float64Array, lines: Float64Array, line_count: int
) -> Float64Array:
    moved: Float64Array = in_middle + drifts * ((lines + 0.5) / line_count - 0.5)[:, None]
    return moved


def _project_part(in_middle: Float64Array, camera: Camera, shutter: ShutterDirection) -> RolledPoints:
    """Project a few points, so few that the processor's cache holds them."""
    found = _search(in_middle, camera, shutter)
    pixels = found.pixels.astype(np.float32)
    rows = np.flatnonzero(_in_image(pixels, camera))
    there = np.empty((len(found.unsettled), 3))
    position_at_lines(
        in_middle,
        found.unsettled,
        found.lines,
        shutter.lines_from_middle,
        shutter.line_count(camera),
        there,
    )
    near = _in_image(project_unbounded(camera, there), camera, border=max(camera.width, camera.height))
    return RolledPoints(rows, pixels[rows], found.placed[rows], int(near.sum()))


def _in_image(pixels: FloatArray, camera: Camera, *, border: int = 0) -> BoolArray:
    u, v = pixels.T
    inside: BoolArray = (u >= -0.5 - border) & (u < camera.width - 0.5 + border)
    inside &= (v >= -0.5 - border) & (v < camera.height - 0.5 + border)
    return inside
