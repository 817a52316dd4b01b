"""Projection into images of a rolling shutter whose camera moves.

A point is seen by the line in which it is at that line's own time, so line and pixel must be found together. With s the
line for whose time the point is projected, and v(s) the line in which it then is, f(s) = v(s) - s has to vanish. From
line to line an image moves by less than a line: dv/ds < 1, so that f falls everywhere, and its zero is the only one.
The first step is s := v(s), then come secants; mostly three projections bring f under 0.01 px, and the error is that
times dv/ds. A point beyond an edge even at the time of that edge is not in the image. Where the image moves as fast as
the shutter, f may have no zero, or several: such points are searched twelve times at most, then left out and counted.

The camera's pose is taken at 65 times evenly spread over the image, relative to the image's own time, and linear
between them: at 500 degrees a second and 33 ms that is within 0.01 mrad.

Source: Geyer, Meingast and Sastry 2005, "Geometric Models of Rolling-Shutter Cameras".
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import float64, int64, types, void

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import domain_angle, project_unbounded
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F64_1D, IN_F64_2D, IN_F64_3D
from sceneloom.scene.cameras import Shutter
from sceneloom.scene.poses import PoseSource

_KNOTS = 65
_ATTEMPTS = 12
_TOLERANCE_PX = 0.01
_CHUNK = 16_384
_STILL = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class ShutterDirection:
    """Poses of a camera while it took the lines of an image.

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
        """The trajectory of a camera during one image.

        Args:
            shutter: of the camera.
            timestamp_ns: the image's time [ns].
            source: `world_from_camera`.

        Returns:
            None where all lines are taken at once, where the camera did not move, and beyond its poses.
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
        """The trajectory of a stationary camera: moving objects still depend on the line that sees them."""
        return cls(shutter.over_columns, np.tile(np.eye(4)[:3], (2, 1, 1)))

    @property
    def axis(self) -> int:
        """Coordinate of a pixel that is its line: 0, its column, or 1, its row."""
        return 0 if self.over_columns else 1

    def line_count(self, camera: Camera) -> int:
        """Number of lines of an image."""
        return camera.width if self.over_columns else camera.height

    def poses_at(self, lines: FloatArray, camera: Camera) -> Float64Array:
        """Poses of the camera at the time of lines, from that at the image's time.

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
        return np.asarray(first + later * (second - first), np.float64)

    @property
    def rotation(self) -> float:
        """Largest rotation from the camera's pose at the image's time [rad]."""
        traces = np.trace(self.lines_from_middle[:, :, :3], axis1=1, axis2=2)
        return float(np.arccos(np.clip((traces.min() - 1.0) / 2.0, -1.0, 1.0)))

    @property
    def shift(self) -> float:
        """Largest distance from the camera's position at the image's time [m]."""
        return float(np.linalg.norm(self.lines_from_middle[:, :, 3], axis=1).max())


@dataclass(frozen=True, slots=True, eq=False)
class RolledPoints:
    """The points of a cloud in an image of a rolling shutter.

    Attributes:
        point_ids: (M,) int64, which points fall into the image, ascending.
        pixels: (M, 2) float32 [px].
        points_camera: (M, 3) float64 [m], each in the frame of the camera at the time of the line that sees it.
        unsettled: number of further points that may be in the image: no line was found for them, and they were within
            an image's size of it.
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
        world_from_camera: pose of the camera at the image's time.
        shutter: its poses from there, line by line.

    Raises:
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    ids, in_middle = np.empty(len(points_world), np.int64), np.empty((len(points_world), 3))
    camera_from_world = world_from_camera.inverse_matrix
    count = keep_in_reach(
        points_world, camera_from_world, domain_angle(camera), shutter.rotation, shutter.shift, ids, in_middle
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
        drifts: (N, 3) float64 [m], how far they move in that frame from the first line to the last, linearly.
        camera: the camera model, of any model.
        shutter: poses of the camera, line by line.

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
    """What the search for lines gives."""

    pixels: Float64Array  # (N, 2) [px], NaN where no line sees a point
    placed: Float64Array  # (N, 3) [m], likewise
    lines: Float64Array  # (N,), looked at last
    unsettled: Int64Array  # points for which the search was given up


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


def _drifted(in_middle: Float64Array, drifts: Float64Array, lines: Float64Array, line_count: int) -> Float64Array:
    moved: Float64Array = in_middle + drifts * ((lines + 0.5) / line_count - 0.5)[:, None]
    return moved


def _project_part(in_middle: Float64Array, camera: Camera, shutter: ShutterDirection) -> RolledPoints:
    """Project a few points, so few that the processor's cache holds them."""
    found = _search(in_middle, camera, shutter)
    pixels = found.pixels.astype(np.float32)
    rows = np.flatnonzero(_in_image(pixels, camera))
    there = np.empty((len(found.unsettled), 3))
    position_at_lines(
        in_middle, found.unsettled, found.lines, shutter.lines_from_middle, shutter.line_count(camera), there
    )
    near = _in_image(project_unbounded(camera, there), camera, border=max(camera.width, camera.height))
    return RolledPoints(rows, pixels[rows], found.placed[rows], int(near.sum()))


def _in_image(pixels: FloatArray, camera: Camera, *, border: int = 0) -> BoolArray:
    u, v = pixels.T
    inside: BoolArray = (u >= -0.5 - border) & (u < camera.width - 0.5 + border)
    inside &= (v >= -0.5 - border) & (v < camera.height - 0.5 + border)
    return inside


_LEAST_NEARING = 0.05
"""By how much less than a line an image moves from line to line; where that vanishes, steps would be infinite."""


@kernel(int64(IN_F64_2D, IN_F64_2D, float64, float64, float64, int64[::1], float64[:, ::1]))
def keep_in_reach(
    points_world: Float64Array, camera_from_world: Float64Array, domain: float, rotation: float, shift: float,
    point_ids: Int64Array, points_camera: Float64Array,
) -> int:  # fmt: skip
    """Keep the points that a camera model may see at some time while the camera moves.

    `points_world` (N, 3) [m]; `camera_from_world` (3, 4) or (4, 4), at the middle of that time; `domain`: angle off the
    axis that the camera model sees [rad], π at most; `rotation`, `shift`: how far at most the camera rotates [rad] and
    moves [m] from the middle; `point_ids` (N,), written from the beginning on, ascending; `points_camera` (N, 3) [m],
    in the frame of the camera in the middle; written likewise. Returns how many they are.
    """
    m = camera_from_world
    count = 0
    for i in range(points_world.shape[0]):
        a, b, c = points_world[i, 0], points_world[i, 1], points_world[i, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        distance = math.sqrt(x * x + y * y + z * z)
        if not distance < math.inf:
            continue
        parallax = math.asin(shift / distance) if shift < distance else math.pi
        angle = domain + rotation + parallax
        if angle >= math.pi or z >= distance * math.cos(angle):
            point_ids[count] = i
            points_camera[count, 0], points_camera[count, 1], points_camera[count, 2] = x, y, z
            count += 1
    return count


@kernel(void(IN_F64_2D, types.Array(int64, 1, "C", readonly=True), IN_F64_1D, IN_F64_3D, float64, float64[:, ::1]))
def position_at_lines(
    points_camera: Float64Array, active: Int64Array, lines: Float64Array, lines_from_middle: Float64Array,
    line_count: float, placed: Float64Array,
) -> None:  # fmt: skip
    """Give points in the frame of the camera at the time of a line, each at its own.

    Args:
        points_camera: (M, 3) [m], in the frame of the camera at the image's time.
        active: (A,), which of them.
        lines: (M,) [px], -0.5 to line_count - 0.5.
        lines_from_middle: (K, 3, 4), the camera at K times evenly spread from the image's first edge to its last,
            from the camera at the image's time; linear between them.
        line_count: lines of the image.
        placed: (A, 3) [m], written.
    """
    last = lines_from_middle.shape[0] - 1
    per_line = last / line_count
    for k in range(active.shape[0]):
        i = active[k]
        at = (lines[i] + 0.5) * per_line
        knot = min(max(int(at), 0), last - 1)
        later = at - knot
        sooner = 1.0 - later
        x, y, z = points_camera[i, 0], points_camera[i, 1], points_camera[i, 2]
        first, second = lines_from_middle[knot], lines_from_middle[knot + 1]
        for row in range(3):
            placed[k, row] = (
                (sooner * first[row, 0] + later * second[row, 0]) * x
                + (sooner * first[row, 1] + later * second[row, 1]) * y
                + (sooner * first[row, 2] + later * second[row, 2]) * z
                + (sooner * first[row, 3] + later * second[row, 3])
            )


@kernel(int64(
    IN_F64_2D, int64, int64, float64, float64, int64[::1], float64[::1], float64[::1], float64[::1], int64[::1]
))  # fmt: skip
def search_lines(
    pixels: Float64Array, axis: int, attempt: int, line_count: float, tolerance: float, active: Int64Array,
    lines: Float64Array, lines_before: Float64Array, off_before: Float64Array, settled: Int64Array,
) -> int:  # fmt: skip
    """Compare the lines for which points were placed with those in which they then lie, and choose the next.

    A point is off by f(s) = v(s) - s, where v(s) is where it lies at the time of line s. Settled is one whose f is
    nearly 0. The next line is v itself at first, and then where the secant through the last two ends.

    Args:
        pixels: (A, 2) [px], of the active points at the times of their lines; NaN for none.
        axis: 0 if lines are columns, 1 if they are rows.
        attempt: 0 for the first, one more each time.
        line_count: lines of the image.
        tolerance: how far off a settled line may be [px].
        active: (A,), which points are looked at; those that remain are moved to its beginning.
        lines, lines_before, off_before: (M,) [px]; the lines of the active points are replaced.
        settled: (A,), the locations among the active ones of those that have settled, then -1.

    Returns:
        How many remain.
    """
    low, high = -0.5, line_count - 0.5
    remaining = count = 0
    for k in range(active.shape[0]):
        i = active[k]
        line, there = lines[i], pixels[k, axis]
        off = there - line
        if abs(off) <= tolerance:
            settled[count] = k
            count += 1
            continue
        if math.isnan(pixels[k, 0] + there):
            # It may come into the camera model's domain by the first line, or the last.
            if attempt > 1 or lines_before[i] == lines_before[i]:
                continue
            lines[i] = low if attempt == 0 else high
        else:
            nearing = 1.0
            if lines_before[i] == lines_before[i] and line != lines_before[i]:
                nearing = (off_before[i] - off) / (line - lines_before[i])
            outward = (line <= low and off < 0.0) or (line >= high and off > 0.0)
            beyond_both = off * off_before[i] > 0.0 and abs(line - lines_before[i]) >= line_count
            if outward and (nearing > 0.0 or beyond_both):
                continue
            step = off / math.copysign(max(abs(nearing), _LEAST_NEARING), nearing)
            lines_before[i], off_before[i] = line, off
            lines[i] = min(max(line + step, low), high)
        active[remaining] = i
        remaining += 1
    for k in range(count, settled.shape[0]):
        settled[k] = -1
    return remaining
