"""The rotation of a camera: corners tracked from image to image, and the rotation between their bearings."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from sceneloom.cameras.projection import unproject
from sceneloom.errors import DataError
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.clock.signals import Orientations, finite_rows
from sceneloom.scene.cameras import CameraImage, CameraSensor, Shutter
from sceneloom.scene.types import Progress

_LEAST_BEARINGS = 16
"""With fewer directions a rotation is not believed."""

_ROUNDS = 12

_FINEST = 1e-6
"""No direction is known better [rad]."""

_WIDEST = 0.02
"""Where directions agree no better than this, they are not of one rotation [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class BearingRotation:
    """A rotation that directions report.

    Attributes:
        rotation: `second_from_first`, (3, 3).
        agreeing: (N,), which directions agree with it.
        influences: (N,), what share each direction has in the rotation about its own axis; they sum up to 1.
    """

    rotation: Float64Array
    agreeing: BoolArray
    influences: Float64Array


def rotation_between(first: Float64Array, second: Float64Array) -> BearingRotation | None:
    """Find the rotation between two sets of directions to the same things, most of which are far away.

    What is near moves towards or away from the point to which the camera goes; along that direction differences count
    less, as much as they scatter there more. What fits neither has no weight.

    Args:
        first, second: (N, 3) unit vectors in the camera's frame.

    Returns:
        The rotation; None where too few directions agree with any.

    Source: weights (1 + r²/c²)⁻² are those of Geman and McClure 1985; the direction of the trajectory is the
        coplanarity
    condition of Longuet-Higgins 1981 for small rotations.
    """
    if len(first) < _LEAST_BEARINGS:
        return None
    rotation, weights = _rotation_alone(first, second)
    rotated = first @ rotation.T
    ahead = _trajectory(rotated, second - rotated, weights)
    scales, amounts = np.zeros(2), np.zeros(4)
    for _ in range(_ROUNDS):
        view = _View.of(first @ rotation.T, second, ahead)
        parts = view.parts.copy()
        parts[:, 0] -= view.nearness @ amounts
        scales = np.maximum(1.4826 * np.median(np.abs(parts), axis=0), _FINEST)
        scales[0] = max(scales)
        weights = (1.0 + ((parts / (3.0 * scales)) ** 2).sum(axis=1)) ** -2
        root = np.sqrt(weights)[:, None] / scales
        rows = np.vstack([(view.slopes * root[:, :, None]).reshape(-1, 9), _HELD])
        solution = np.linalg.lstsq(rows, np.append(parts * root, np.zeros(2)), rcond=1e-6)[0]
        rotation = matrix_from_quaternion(quaternion_from_rotation_vector(solution[:3])) @ rotation
        ahead = view.rotated_trajectory(solution[3:5])
        amounts = amounts + solution[5:]
        if np.linalg.norm(solution[:3]) < 1e-7:
            break
    agreeing = np.asarray(weights > 0.25, np.bool_)
    if agreeing.sum() < _LEAST_BEARINGS or scales[1] > _WIDEST:
        return None
    return BearingRotation(rotation, agreeing, _influences(rows, rotation))


def _influences(rows: Float64Array, rotation: Float64Array) -> Float64Array:
    """What share each direction has in a rotation about the axis of the rotation that was found.

    If a single direction saw a larger rotation, the solution's rotation would grow by its share of that.

    Args:
        rows: (2 N + 2, 9), of the least squares.
        rotation: (3, 3).
    """
    vector = rotation_vector_from_quaternion(quaternion_from_matrix(rotation))
    axis = vector / max(float(np.linalg.norm(vector)), 1e-12)
    normal = rows.T @ rows
    lengths = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(lengths, lengths), rcond=1e-10) / np.outer(lengths, lengths)
    shares = (rows @ inverse[:, :3] @ axis) * (rows[:, :3] @ axis)
    of_directions = shares[:-2].reshape(-1, 2).sum(axis=1)
    total = float(of_directions.sum())
    if not 0.5 < total < 2.0:
        return np.full(len(of_directions), 1.0 / len(of_directions))
    return np.asarray(of_directions / total, np.float64)


_HELD = np.zeros((2, 9))

_HELD[0, 3] = _HELD[1, 4] = 1.0 / 0.3
"""The direction of the trajectory is held, weakly: where nothing is near, nothing reports it [1/rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """How far directions differ, and how a small rotation and another direction of motion change that.

    Attributes:
        ahead: (3,), where the camera goes.
        sideways: (2, 3), two directions across it.
        parts: (N, 2): along the great circle through `ahead`, and across it.
        nearness: (N, 4), columns of a plane of nearness: what moves along is near.
        slopes: (N, 2, 9): by the rotation, the trajectory's direction, and the nearness.
    """

    ahead: Float64Array
    sideways: Float64Array
    parts: Float64Array
    nearness: Float64Array
    slopes: Float64Array

    @classmethod
    def of(cls, rotated: Float64Array, second: Float64Array, ahead: Float64Array) -> "_View":
        """Compare directions (N, 3) that were rotated with those that were seen."""
        apart = second - rotated
        along = ahead - (rotated @ ahead)[:, None] * rotated
        reach = np.maximum(np.linalg.norm(along, axis=1), 1e-3)[:, None]
        along /= reach
        across = np.cross(rotated, along)
        sideways = np.linalg.svd(ahead[None])[2][1:]
        nearness = reach * np.hstack([np.ones((len(rotated), 1)), rotated])
        # apart changes by -δ × rotated, across the circle by the direction of motion, too
        slopes = np.zeros((len(rotated), 2, 9))
        slopes[:, 0, :3], slopes[:, 1, :3] = np.cross(rotated, along), np.cross(rotated, across)
        slopes[:, 1, 3:5] = np.cross(rotated, second) @ sideways.T / reach
        slopes[:, 0, 5:] = nearness
        parts = np.stack([(apart * along).sum(axis=1), (apart * across).sum(axis=1)], axis=1)
        return cls(ahead, sideways, parts, nearness, slopes)

    def rotated_trajectory(self, steps: Float64Array) -> Float64Array:
        """The trajectory's direction after small steps (2,) sideways."""
        trajectory = self.ahead + np.clip(steps, -0.3, 0.3) @ self.sideways
        return np.asarray(trajectory / np.linalg.norm(trajectory), np.float64)


def _rotation_alone(first: Float64Array, second: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The rotation that takes most of the directions near to where they are, by weights that fall with the distance.

    Source: Wahba 1965, solved by the singular values as in Markley 1988.
    """
    weights = np.ones(len(first))
    rotation = np.eye(3)
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weights, second, first))
        rotation = (u * np.array([1.0, 1.0, np.linalg.det(u @ vt)])) @ vt
        distances = np.linalg.norm(second - first @ rotation.T, axis=1)
        scale = max(1.4826 * float(np.median(distances)), _FINEST)
        weights = (1.0 + (distances / (2.0 * scale)) ** 2) ** -2
    return rotation, weights


def _trajectory(rotated: Float64Array, apart: Float64Array, weights: Float64Array) -> Float64Array:
    """The direction in which the camera went, up to its sign: all differences point to it or away from it."""
    normals = np.cross(rotated, apart) * weights[:, None]
    _, vectors = np.linalg.eigh(normals.T @ normals)
    return np.asarray(vectors[:, 0], np.float64)


_LARGEST_WIDTH = 720
"""Wider images are shrunk by a whole number: a tenth of a small pixel is enough, and they are quicker."""

_CELLS = 500
"""About so many corners, one in each cell of a grid, so that they are spread over the image."""

_HALF_WINDOW = 7
_CORNERS_ROUNDS = 20

_LEAST_STRENGTH = 4.0
"""Mean squared gradient along the weaker direction [grey levels²]: well above the noise of an image."""

_FARTHEST_BACK = 0.25
"""A corner that is followed back comes at most so far from where it was [px]. Source: Kalal, Mikolajczyk and Matas
2010, "Forward-Backward Error"."""

_SMALLEST = 48
"""No image of the pyramid is narrower or lower [px]."""

_BLUR = np.array([1.0, 4.0, 6.0, 4.0, 1.0], np.float32) / 16.0
"""Source: Burt and Adelson 1983, a = 0.375."""


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """An image in grey, and smaller and smaller.

    Attributes:
        levels: (h, w) float32 each, halved from one to the next.
        shrunk: by how much the first is smaller than the image.
    """

    levels: tuple[Float32Array, ...]
    shrunk: int

    @classmethod
    def of(cls, rgb: UInt8Array) -> "Pyramid":
        """Make it of an image (H, W, 3)."""
        shrunk = -(-rgb.shape[1] // _LARGEST_WIDTH)
        height, width = rgb.shape[0] // shrunk, rgb.shape[1] // shrunk
        small = rgb[: height * shrunk, : width * shrunk].astype(np.float32) @ _GREY
        if shrunk > 1:
            small = _shrunk(small, shrunk)
        levels = [np.ascontiguousarray(small, np.float32)]
        while min(levels[-1].shape) >= 2 * _SMALLEST:
            levels.append(_halved(levels[-1]))
        return cls(tuple(levels), shrunk)

    def outer(self, pixels: Float64Array) -> Float64Array:
        """Take locations (N, 2) of the first level into the image [px]."""
        return (pixels + 0.5) * self.shrunk - 0.5


_GREY = np.array([0.299, 0.587, 0.114], np.float32)
"""Source: ITU-R BT.601, luma."""


def _shrunk(grey: Float32Array, times: int) -> Float32Array:
    """The means of squares of so many pixels a side."""
    height, width = grey.shape
    squares = grey.reshape(height // times, times, width // times, times)
    means: Float32Array = squares.mean(axis=(1, 3), dtype=np.float32)
    return means


def _halved(grey: Float32Array) -> Float32Array:
    height, width = grey.shape
    wide: Float32Array = np.pad(grey, ((2, 2), (2, 2)), mode="edge")
    upright = np.zeros((height, width + 4), np.float32)
    blurred = np.zeros((height, width), np.float32)
    for k, weight in enumerate(_BLUR):
        upright += weight * wide[k : k + height]
    for k, weight in enumerate(_BLUR):
        blurred += weight * upright[:, k : k + width]
    return np.ascontiguousarray(blurred[::2, ::2], np.float32)


def find_corners(pyramid: Pyramid) -> Float32Array:
    """Find corners spread over an image: (N, 2) float32 [px] of the first level."""
    from sceneloom.kernels.images import corner_strengths

    grey = pyramid.levels[0]
    strengths = np.empty_like(grey)
    corner_strengths(grey, 2, strengths)
    border = _HALF_WINDOW + 2
    strengths[:border] = strengths[-border:] = 0.0
    strengths[:, :border] = strengths[:, -border:] = 0.0
    height, width = grey.shape
    cell = max(8, int(np.sqrt(height * width / _CELLS)))
    rows, columns = height // cell, width // cell
    if rows == 0 or columns == 0:
        return np.zeros((0, 2), np.float32)
    squares = strengths[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    cells = squares.transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
    best = cells.argmax(axis=1)
    strong = cells[np.arange(len(cells)), best] > _LEAST_STRENGTH
    numbers = np.flatnonzero(strong)
    v = numbers // columns * cell + best[strong] // cell
    u = numbers % columns * cell + best[strong] % cell
    return np.stack([u, v], axis=1).astype(np.float32)


def followed(first: Pyramid, second: Pyramid, corners: Float32Array) -> tuple[Float32Array, BoolArray]:
    """Find corners (N, 2) of one image in the next one, there and back again.

    Returns:
        (N, 2) float32 [px] of the first level, and (N,) bool whether each was found.
    """
    there, found = _through_levels(first, second, corners)
    back, found_back = _through_levels(second, first, there)
    near = np.linalg.norm(back - corners, axis=1) <= _FARTHEST_BACK
    return there, found & found_back & near


def _through_levels(first: Pyramid, second: Pyramid, corners: Float32Array) -> tuple[Float32Array, BoolArray]:
    """From the smallest image to the largest. Source: Bouguet 2000."""
    from sceneloom.kernels.images import follow_corners

    count = min(len(first.levels), len(second.levels))
    found = np.zeros(len(corners), np.bool_)
    guesses = (corners / 2 ** (count - 1)).astype(np.float32)
    for level in reversed(range(count)):
        pixels = np.ascontiguousarray(corners / 2**level, np.float32)
        guesses = np.ascontiguousarray(guesses)
        before = guesses.copy()
        follow_corners(first.levels[level], second.levels[level], pixels, _HALF_WINDOW, _CORNERS_ROUNDS, guesses, found)
        if level:
            # what is lost in a small image may be found in a larger one
            lost = ~found
            guesses[lost] = before[lost]
            guesses = guesses * 2
    return guesses, found


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """An image with its pyramid."""

    image: CameraImage
    pyramid: Pyramid


def camera_rotation(camera: CameraSensor, *, progress: Progress | None = None) -> Orientations:
    """Follow a camera's rotating from image to image; images that show nothing to follow break it.

    With a rolling shutter the times are those at which the lines of the corners were taken.

    Args:
        progress: reported after each image.

    Raises:
        CalibrationError: the camera model cannot be used.
    """
    times = camera.images.timestamps_ns
    rows = np.flatnonzero(np.diff(times, prepend=times[:1] - 1) > 0)
    shutter = Shutter.of(camera)
    vectors = np.full((max(len(rows) - 1, 0), 3), np.nan)
    delays = np.zeros(len(rows))
    before: _Seen | None = None
    for number, row in enumerate(rows.tolist()):
        seen = _seen(camera, row)
        if before is not None and seen is not None:
            vectors[number - 1], early, late = _rotation(before, seen, shutter)
            delays[number - 1] = early if number == 1 else 0.5 * (delays[number - 1] + early)
            delays[number] = late
        before = seen
        if progress is not None:
            progress(number + 1, len(rows))
    timestamps = times[rows] + np.rint(delays * 1e9).astype(np.int64)
    return Orientations.of_steps(np.maximum.accumulate(timestamps), vectors)


def _seen(camera: CameraSensor, row: int) -> _Seen | None:
    try:
        image = camera.images[row]
        return _Seen(image, Pyramid.of(image.rgb))
    except DataError:
        return None


def _rotation(first: _Seen, second: _Seen, shutter: Shutter) -> tuple[Float64Array, float, float]:
    """Give how a camera rotated between two images (3,) [rad], and when its corners were taken in each [s]."""
    unknown = np.full(3, np.nan), 0.0, 0.0
    if first.pyramid.levels[0].shape != second.pyramid.levels[0].shape:
        return unknown
    corners = find_corners(first.pyramid)
    if len(corners) < _LEAST_BEARINGS:
        return unknown
    there, found = followed(first.pyramid, second.pyramid, corners)
    before = first.pyramid.outer(corners[found].astype(np.float64))
    after = second.pyramid.outer(there[found].astype(np.float64))
    rays_before = unproject(first.image.camera, before)
    rays_after = unproject(second.image.camera, after)
    usable = finite_rows(rays_before) & finite_rows(rays_after)
    rotated = rotation_between(rays_before[usable], rays_after[usable])
    if rotated is None:
        return unknown
    vector = rotation_vector_from_quaternion(quaternion_from_matrix(rotated.rotation.T))
    early = _delay(shutter, before[usable], rotated.influences, first.image)
    late = _delay(shutter, after[usable], rotated.influences, second.image)
    return vector, early, late


def _delay(shutter: Shutter, pixels: Float64Array, shares: Float64Array, image: CameraImage) -> float:
    """When the lines of pixels (N, 2), each with its share (N,), are taken after the image's time [s]."""
    if len(pixels) == 0:
        return 0.0
    line = float(pixels[:, 0 if shutter.over_columns else 1] @ shares)
    return float(shutter.delays(np.array([line]), image.camera)[0])
