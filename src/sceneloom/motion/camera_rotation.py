"""The rotation of a camera: corners tracked from image to image, and the rotation between their bearings."""

import math
from dataclasses import dataclass

import numpy as np
from numba import boolean, float32, int64, void

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, UInt8Array, finite_rows
from sceneloom.cameras.projection import unproject
from sceneloom.errors import DataError
from sceneloom.geometry.rigid import matrix_from_rotation_vector, nearest_rotation, rotation_vector_from_matrix
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F32_2D, inlined
from sceneloom.motion.clock.signals import Orientations
from sceneloom.scene.cameras import CameraImage, CameraSensor, Shutter
from sceneloom.scene.types import Progress, reporting

_LEAST_BEARINGS = 16  # fewer bearings do not determine a rotation
_ROUNDS = 12
_FINEST = 1e-6  # least standard deviation of a bearing [rad]
_WIDEST = 0.02  # bearings with larger residuals do not belong to one rotation [rad]
_PRIOR = np.zeros((2, 9))
_PRIOR[0, 3] = _PRIOR[1, 4] = 1.0 / 0.3
"""Weak prior of the direction of motion, which nothing determines where nothing is near [1/rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class BearingRotation:
    """A rotation estimated from bearings.

    Attributes:
        rotation: `second_from_first`, (3, 3).
        agreeing: (N,), which bearings agree with it.
        influences: (N,), share of each bearing in the rotation about its own axis; they sum up to 1.
    """

    rotation: Float64Array
    agreeing: BoolArray
    influences: Float64Array


def rotation_between(first: Float64Array, second: Float64Array) -> BearingRotation | None:
    """Estimate the rotation between two sets of bearings to the same points, most of which are far away.

    Near points move towards or away from the direction of motion; along that direction residuals count less, as much
    as they scatter there more. Outliers have no weight.

    Args:
        first, second: (N, 3) unit vectors in the camera's frame.

    Returns:
        The rotation; None where too few bearings agree with any.

    Source: weights (1 + r²/c²)⁻² are those of Geman and McClure 1985; the direction of motion is the coplanarity
    condition of Longuet-Higgins 1981 for small rotations.
    """
    if len(first) < _LEAST_BEARINGS:
        return None
    rotation, weights = _rotation_alone(first, second)
    rotated = first @ rotation.T
    # the direction of motion, up to its sign: all residuals point to it or away from it
    normals = np.cross(rotated, second - rotated) * weights[:, None]
    ahead = np.asarray(np.linalg.eigh(normals.T @ normals)[1][:, 0], np.float64)
    scales, amounts = np.zeros(2), np.zeros(4)
    for _ in range(_ROUNDS):
        parts, nearness, slopes, sideways = _compare(first @ rotation.T, second, ahead)
        parts[:, 0] -= nearness @ amounts
        scales = np.maximum(1.4826 * np.median(np.abs(parts), axis=0), _FINEST)
        scales[0] = max(scales)
        weights = (1.0 + ((parts / (3.0 * scales)) ** 2).sum(axis=1)) ** -2
        root = np.sqrt(weights)[:, None] / scales
        rows = np.vstack([(slopes * root[:, :, None]).reshape(-1, 9), _PRIOR])
        solution = np.linalg.lstsq(rows, np.append(parts * root, np.zeros(2)), rcond=1e-6)[0]
        rotation = matrix_from_rotation_vector(solution[:3]) @ rotation
        ahead = ahead + np.clip(solution[3:5], -0.3, 0.3) @ sideways
        ahead /= np.linalg.norm(ahead)
        amounts = amounts + solution[5:]
        if np.linalg.norm(solution[:3]) < 1e-7:
            break
    agreeing = np.asarray(weights > 0.25, np.bool_)
    if agreeing.sum() < _LEAST_BEARINGS or scales[1] > _WIDEST:
        return None
    return BearingRotation(rotation, agreeing, _influences(rows, rotation))


def _compare(
    rotated: Float64Array, second: Float64Array, ahead: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Compare bearings (N, 3) that were rotated with those that were seen."""
    # gives (N, 2) residuals along the great circle through `ahead`, and across it; (N, 4) columns of a plane of
    # nearness: what moves along is near; (N, 2, 9) slopes by rotation, direction of motion and nearness; (2, 3)
    # directions across `ahead`
    apart = second - rotated
    along = ahead - (rotated @ ahead)[:, None] * rotated
    reach = np.maximum(np.linalg.norm(along, axis=1), 1e-3)[:, None]
    along /= reach
    across = np.cross(rotated, along)
    sideways = np.linalg.svd(ahead[None])[2][1:]
    nearness = reach * np.hstack([np.ones((len(rotated), 1)), rotated])
    # apart changes by -δ x rotated, across the circle by the direction of motion, too
    slopes = np.zeros((len(rotated), 2, 9))
    slopes[:, 0, :3], slopes[:, 1, :3] = np.cross(rotated, along), np.cross(rotated, across)
    slopes[:, 1, 3:5] = np.cross(rotated, second) @ sideways.T / reach
    slopes[:, 0, 5:] = nearness
    parts = np.stack([(apart * along).sum(axis=1), (apart * across).sum(axis=1)], axis=1)
    return parts, nearness, slopes, sideways


def _rotation_alone(first: Float64Array, second: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The rotation that brings most bearings together, and weights that fall with the distance (Markley 1988)."""
    weights = np.ones(len(first))
    rotation = np.eye(3)
    for _ in range(_ROUNDS):
        rotation, _ = nearest_rotation(np.einsum("n,ni,nj->ij", weights, second, first))
        distances = np.linalg.norm(second - first @ rotation.T, axis=1)
        scale = max(1.4826 * float(np.median(distances)), _FINEST)
        weights = (1.0 + (distances / (2.0 * scale)) ** 2) ** -2
    return rotation, weights


def _influences(rows: Float64Array, rotation: Float64Array) -> Float64Array:
    """The share of each bearing in the rotation about the axis found, by the least squares' rows (2 N + 2, 9)."""
    # if a single bearing saw a larger rotation, the solution's rotation would grow by its share of that
    vector = rotation_vector_from_matrix(rotation)
    axis = vector / max(float(np.linalg.norm(vector)), 1e-12)
    normal = rows.T @ rows
    lengths = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(lengths, lengths), rcond=1e-10) / np.outer(lengths, lengths)
    shares = (rows @ inverse[:, :3] @ axis) * (rows[:, :3] @ axis)
    of_bearings = shares[:-2].reshape(-1, 2).sum(axis=1)
    total = float(of_bearings.sum())
    if not 0.5 < total < 2.0:
        return np.full(len(of_bearings), 1.0 / len(of_bearings))
    return np.asarray(of_bearings / total, np.float64)


_LARGEST_WIDTH = 720
"""Wider images are reduced by a whole factor: a tenth of a small pixel is enough, and they are faster."""

_CELLS = 500  # about so many corners, one in each cell of a grid, so that they are spread over the image
_HALF_WINDOW = 7
_TRACKING_ROUNDS = 20

_LEAST_STRENGTH = 4.0
"""Mean squared gradient along the weaker direction [grey levels²]: well above the noise of an image."""

_FARTHEST_BACK = 0.25
"""Largest distance of a corner that is tracked forth and back [px]. Source: Kalal, Mikolajczyk and Matas 2010,
"Forward-Backward Error"."""

_SMALLEST = 48  # least width and height of an image of the pyramid [px]
_BLUR = np.array([1.0, 4.0, 6.0, 4.0, 1.0], np.float32) / 16.0  # source: Burt and Adelson 1983, a = 0.375
_GREY = np.array([0.299, 0.587, 0.114], np.float32)  # source: ITU-R BT.601, luma


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """A grey image in several resolutions.

    Attributes:
        levels: (h, w) float32 each, halved from one to the next.
        factor: by how much the first is smaller than the image.
    """

    levels: tuple[Float32Array, ...]
    factor: int

    @classmethod
    def of(cls, rgb: UInt8Array) -> "Pyramid":
        """Make it of an image (H, W, 3)."""
        factor = -(-rgb.shape[1] // _LARGEST_WIDTH)
        height, width = rgb.shape[0] // factor, rgb.shape[1] // factor
        grey = rgb[: height * factor, : width * factor].astype(np.float32) @ _GREY
        if factor > 1:
            grey = grey.reshape(height, factor, width, factor).mean(axis=(1, 3), dtype=np.float32)
        levels = [np.ascontiguousarray(grey, np.float32)]
        while min(levels[-1].shape) >= 2 * _SMALLEST:
            levels.append(_halved(levels[-1]))
        return cls(tuple(levels), factor)

    def outer(self, pixels: Float64Array) -> Float64Array:
        """Pixels (N, 2) of the image [px] from those of the first level."""
        return (pixels + 0.5) * self.factor - 0.5


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
    """Track corners (N, 2) of one image to the next one, and back again.

    Returns:
        (N, 2) float32 [px] of the first level, and (N,) bool whether each was found.
    """
    there, found = _tracked(first, second, corners)
    back, found_back = _tracked(second, first, there)
    near = np.linalg.norm(back - corners, axis=1) <= _FARTHEST_BACK
    return there, found & found_back & near


def _tracked(first: Pyramid, second: Pyramid, corners: Float32Array) -> tuple[Float32Array, BoolArray]:
    """Track from the smallest image to the largest. Source: Bouguet 2000."""
    count = min(len(first.levels), len(second.levels))
    found = np.zeros(len(corners), np.bool_)
    guesses = (corners / 2 ** (count - 1)).astype(np.float32)
    for level in reversed(range(count)):
        pixels = np.ascontiguousarray(corners / 2**level, np.float32)
        guesses = np.ascontiguousarray(guesses)
        before = guesses.copy()
        images = first.levels[level], second.levels[level]
        _follow_corners(*images, pixels, _HALF_WINDOW, _TRACKING_ROUNDS, guesses, found)
        if level:
            # what is lost in a small image may be found in a larger one
            lost = ~found
            guesses[lost] = before[lost]
            guesses = guesses * 2
    return guesses, found


def camera_rotation(camera: CameraSensor, *, progress: Progress | None = None) -> Orientations:
    """Estimate a camera's rotation from image to image; images without trackable corners interrupt it.

    With a rolling shutter the times are those at which the lines of the corners were taken.

    Args:
        progress: called after each image.

    Raises:
        CalibrationError: the camera model cannot be used.
    """
    times = camera.images.timestamps_ns
    rows = np.flatnonzero(np.diff(times, prepend=times[:1] - 1) > 0)
    shutter = Shutter.of(camera)
    vectors = np.full((max(len(rows) - 1, 0), 3), np.nan)
    delays = np.zeros(len(rows))
    before: tuple[CameraImage, Pyramid] | None = None
    for number, row in enumerate(reporting(rows.tolist(), progress, len(rows))):
        seen = None
        try:
            image = camera.images[row]
            seen = image, Pyramid.of(image.rgb)
        except DataError:
            pass
        if before is not None and seen is not None:
            vectors[number - 1], early, late = _rotation(before, seen, shutter)
            delays[number - 1] = early if number == 1 else 0.5 * (delays[number - 1] + early)
            delays[number] = late
        before = seen
    timestamps = times[rows] + np.rint(delays * 1e9).astype(np.int64)
    return Orientations.of_steps(np.maximum.accumulate(timestamps), vectors)


def _rotation(
    first: tuple[CameraImage, Pyramid], second: tuple[CameraImage, Pyramid], shutter: Shutter
) -> tuple[Float64Array, float, float]:
    """How a camera rotated between two images (3,) [rad], and when its corners were taken in each [s]."""
    unknown = np.full(3, np.nan), 0.0, 0.0
    (first_image, first_pyramid), (second_image, second_pyramid) = first, second
    if first_pyramid.levels[0].shape != second_pyramid.levels[0].shape:
        return unknown
    corners = find_corners(first_pyramid)
    if len(corners) < _LEAST_BEARINGS:
        return unknown
    there, found = followed(first_pyramid, second_pyramid, corners)
    before = first_pyramid.outer(corners[found].astype(np.float64))
    after = second_pyramid.outer(there[found].astype(np.float64))
    rays_before, rays_after = unproject(first_image.camera, before), unproject(second_image.camera, after)
    usable = finite_rows(rays_before) & finite_rows(rays_after)
    rotated = rotation_between(rays_before[usable], rays_after[usable])
    if rotated is None:
        return unknown
    vector = rotation_vector_from_matrix(rotated.rotation.T)
    early = _delay(shutter, before[usable], rotated.influences, first_image)
    return vector, early, _delay(shutter, after[usable], rotated.influences, second_image)


def _delay(shutter: Shutter, pixels: Float64Array, shares: Float64Array, image: CameraImage) -> float:
    """When the lines of pixels (N, 2), each with its share (N,), are taken after the image's time [s]."""
    if len(pixels) == 0:
        return 0.0
    line = float(pixels[:, 0 if shutter.over_columns else 1] @ shares)
    return float(shutter.delays(np.array([line]), image.camera)[0])


@kernel(void(IN_F32_2D, int64, float32[:, ::1]))
def corner_strengths(grey: Float32Array, half: int, strengths: Float32Array) -> None:
    """How distinctive the window around each pixel is in both directions.

    `grey` (H, W); `half`: the window reaches so many pixels to each side; `strengths` (H, W), written: the smaller
    eigenvalue of the mean product of gradients; 0 near the border.

    Source: Shi and Tomasi 1994, "Good Features to Track", section 4.
    """
    height, width = grey.shape
    strengths[:, :] = np.float32(0.0)
    sums = np.zeros((3, width), np.float32)
    products = np.zeros((3, height, width), np.float32)
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            du = np.float32(0.5) * (grey[i, j + 1] - grey[i, j - 1])
            dv = np.float32(0.5) * (grey[i + 1, j] - grey[i - 1, j])
            products[0, i, j], products[1, i, j], products[2, i, j] = du * du, du * dv, dv * dv
    share = np.float32(1.0 / (2 * half + 1) ** 2)
    for i in range(half + 1, height - half - 1):
        sums[:, :] = np.float32(0.0)
        for k in range(i - half, i + half + 1):
            for j in range(width):
                sums[0, j] += products[0, k, j]
                sums[1, j] += products[1, k, j]
                sums[2, j] += products[2, k, j]
        for j in range(half + 1, width - half - 1):
            uu, uv, vv = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(j - half, j + half + 1):
                uu += sums[0, k]
                uv += sums[1, k]
                vv += sums[2, k]
            middle, apart = np.float32(0.5) * (uu + vv), np.float32(0.5) * (uu - vv)
            least = middle - np.sqrt(apart * apart + uv * uv)
            strengths[i, j] = max(least * share, np.float32(0.0))


@kernel(void(IN_F32_2D, IN_F32_2D, IN_F32_2D, int64, int64, float32[:, ::1], boolean[::1]))
def _follow_corners(
    first: Float32Array, second: Float32Array, pixels: Float32Array, half: int, rounds: int, followed: Float32Array,
    found: BoolArray,
) -> None:  # fmt: skip
    """Find what windows of one image show in another one.

    What the windows differ in by brightness as a whole does not count.

    `first`, `second` (H, W) both; `pixels` (N, 2) [px], column and row in the first image; `half`: windows reach so
    many pixels to each side; `rounds`: at most so many steps; `followed` (N, 2) [px], in the second image: where to
    begin; written; `found` (N,), written: whether the window was found.

    Source: Lucas and Kanade 1981, with the gradient of the first image, Baker and Matthews 2004, section 3.2.
    """
    side = 2 * half + 1
    count = side * side
    shown, slope_u, slope_v = np.empty(count), np.empty(count), np.empty(count)
    for n in range(pixels.shape[0]):
        u, v = float(pixels[n, 0]), float(pixels[n, 1])
        x, y = float(followed[n, 0]), float(followed[n, 1])
        found[n] = False
        if not _holds(first, u, v, half):
            continue
        mean, mean_u, mean_v = 0.0, 0.0, 0.0
        for k in range(count):
            a, b = u + k % side - half, v + k // side - half
            shown[k] = _between(first, a, b)
            slope_u[k] = 0.5 * (_between(first, a + 1, b) - _between(first, a - 1, b))
            slope_v[k] = 0.5 * (_between(first, a, b + 1) - _between(first, a, b - 1))
            mean += shown[k]
            mean_u += slope_u[k]
            mean_v += slope_v[k]
        uu, uv, vv = 1e-9, 0.0, 1e-9
        for k in range(count):
            shown[k] -= mean / count
            slope_u[k] -= mean_u / count
            slope_v[k] -= mean_v / count
            uu += slope_u[k] * slope_u[k]
            uv += slope_u[k] * slope_v[k]
            vv += slope_v[k] * slope_v[k]
        area = uu * vv - uv * uv
        if area <= 1e-9 * (uu + vv) ** 2:
            continue
        for _ in range(rounds):
            if not _holds(second, x, y, half):
                break
            # the slopes have no mean, so that of the difference drops out of both sums
            along_u, along_v = 0.0, 0.0
            for k in range(count):
                left = shown[k] - _between(second, x + k % side - half, y + k // side - half)
                along_u += slope_u[k] * left
                along_v += slope_v[k] * left
            step_u = (vv * along_u - uv * along_v) / area
            step_v = (uu * along_v - uv * along_u) / area
            x, y = x + step_u, y + step_v
            if step_u * step_u + step_v * step_v < 1e-5:
                found[n] = _holds(second, x, y, half)
                break
        followed[n, 0], followed[n, 1] = np.float32(x), np.float32(y)


@inlined
def _between(grey: Float32Array, u: float, v: float) -> float:
    """The brightness at a location between four pixels."""
    j, i = math.floor(u), math.floor(v)
    a, b = u - j, v - i
    upper = (1.0 - a) * grey[i, j] + a * grey[i, j + 1]
    lower = (1.0 - a) * grey[i + 1, j] + a * grey[i + 1, j + 1]
    return float((1.0 - b) * upper + b * lower)


@inlined
def _holds(grey: Float32Array, u: float, v: float, half: int) -> bool:
    """Whether a window around a location, and one pixel more, lies inside the image."""
    height, width = grey.shape
    reach = half + 1.0
    return bool((u >= reach) & (v >= reach) & (u < width - reach - 1) & (v < height - reach - 1))
